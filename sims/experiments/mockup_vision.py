"""Frames of the mock-up's camera, compared with the truth: ``adcs run mockup --part sky``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from adcs.io.frame_files import read_frame
from adcs.mockup.vision.camera import Camera, Pose, camera_of_footprint, undistorted
from adcs.mockup.vision.centroids import NoLightsError, Stars, find_stars
from adcs.mockup.vision.paper_matcher import CameraFix, Matcher
from adcs.mockup.vision.sky import LedSky
from adcs.stars.identification import NoFix
from arrays.io.errors import check_not_negative
from arrays.typing import BoolArray, ByteArray, FloatArray
from sims.mockup.frames import Frame, FrameQuality, Motion, rendered_frame

Finder = Callable[[ByteArray], Stars]
REACH_M = (1.25, 1.0)
"""Largest |X| and |Y| of the poses, as in the figures of the source paper."""
FALSE_POSITION_M = 0.02
FALSE_HEADING_RAD = math.radians(2.0)


@dataclass(frozen=True, kw_only=True)
class SkySetup(FrameQuality):
    """Number and quality of simulated frames, and the calibration of the camera.

    Attributes
    ----------
    poses : int
        Number of frames, at random places and headings.
    speed_m_s, turn_rate_rad_s : float
        Motion during the exposure, in random directions.
    footprint_m : float
        Width of the visible part of the ceiling.
    k1, believed_k1 : float
        True distortion of the camera, and that of its calibration.
    reach_m : tuple, shape (2,)
        Largest |X| and |Y|.

    Raises
    ------
    ValueError
        A number is out of range.
    """

    poses: int = 120
    speed_m_s: float = 0.0
    turn_rate_rad_s: float = 0.0
    footprint_m: float = 0.9
    k1: float = 0.0
    believed_k1: float = 0.0
    reach_m: tuple[float, float] = REACH_M

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.poses < 1:
            raise ValueError(f"Input poses must be 1 or more; instead received {self.poses}.")
        most = Camera.width_px * Camera.height_px
        if not 0 <= self.hot_pixels <= most:
            raise ValueError(f"Input hot_pixels must be 0 to {most}; instead received {self.hot_pixels}.")
        check_not_negative(speed_m_s=self.speed_m_s, turn_rate_rad_s=self.turn_rate_rad_s)

    @property
    def camera(self) -> Camera:
        """The camera that takes the frames."""
        return camera_of_footprint(self.footprint_m, self.k1)

    @property
    def believed_camera(self) -> Camera:
        """The camera as its user knows it."""
        return camera_of_footprint(self.footprint_m, self.believed_k1)


@dataclass(frozen=True, eq=False)
class FrameResult:
    """Stars and fix of one frame.

    ``identify_s``, ``frame_s``: computing time of the identification, and from the image to the fix.
    """

    stars: Stars
    fix: CameraFix | NoFix
    identify_s: float
    frame_s: float

    @property
    def pose(self) -> FloatArray:
        """X, Y [m] and heading [rad] of the fix, shape (3,); NaN without one."""
        return np.array(
            [*self.fix.position_m, self.fix.heading_rad] if isinstance(self.fix, CameraFix) else [np.nan] * 3
        )

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the pose, shape (3,); NaN without a fix."""
        fix = self.fix
        return np.array([fix.sigma_m, fix.sigma_m, fix.sigma_rad] if isinstance(fix, CameraFix) else [np.nan] * 3)

    @property
    def matched(self) -> int:
        """Number of identified stars."""
        return len(self.fix.stars) if isinstance(self.fix, CameraFix) else 0

    @property
    def reason(self) -> str:
        """Reason of a missing fix; empty if there is one."""
        return "" if isinstance(self.fix, CameraFix) else self.fix.reason


@dataclass(frozen=True, eq=False)
class SkyRun:
    """Frames and their results, row by row."""

    truth: FloatArray  # (n, 3): X, Y [m] and heading [rad]
    results: tuple[FrameResult, ...]

    @cached_property
    def estimates(self) -> FloatArray:
        """X, Y and heading, shape (n, 3); NaN without a fix."""
        return np.array([result.pose for result in self.results])

    @property
    def found(self) -> BoolArray:
        """Frames with a fix, shape (n,)."""
        return np.isfinite(self.estimates[:, 0])

    @property
    def position_errors_m(self) -> FloatArray:
        """Distances from the truth, shape (n,); NaN without a fix."""
        return np.hypot(*(self.estimates - self.truth)[:, :2].T)

    @property
    def heading_errors_rad(self) -> FloatArray:
        """Errors of the heading from -π to π, shape (n,); NaN without a fix."""
        error = self.estimates[:, 2] - self.truth[:, 2]
        return np.angle(np.exp(1j * error))

    @property
    def good(self) -> BoolArray:
        """Fixes within 20 mm and 2° of the truth, shape (n,)."""
        near = self.position_errors_m <= FALSE_POSITION_M
        return near & (np.abs(self.heading_errors_rad) <= FALSE_HEADING_RAD)

    @property
    def false_fixes(self) -> BoolArray:
        """Fixes with larger errors, shape (n,)."""
        return self.found & ~self.good

    def summary(self) -> dict[str, Any]:
        """Return the statistics of the run; rms errors are over good fixes, None without any.

        Returns
        -------
        dict
            ``poses``, ``success`` (good fixes of all frames), ``false_fixes``, ``position_rms_mm``,
            ``heading_rms_deg``, ``identify_ms_median`` and ``frame_ms_median``.
        """
        good = self.good
        position = _rms(self.position_errors_m[good])
        heading = _rms(self.heading_errors_rad[good])
        return {
            "poses": len(good),
            "success": float(good.mean()),
            "false_fixes": int(self.false_fixes.sum()),
            "position_rms_mm": None if position is None else 1e3 * position,
            "heading_rms_deg": None if heading is None else math.degrees(heading),
            "identify_ms_median": 1e3 * float(np.median([result.identify_s for result in self.results])),
            "frame_ms_median": 1e3 * float(np.median([result.frame_s for result in self.results])),
        }


def _rms(values: FloatArray) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if values.size else None


def frame_result(image: ByteArray, camera: Camera, matcher: Matcher, finder: Finder = find_stars) -> FrameResult:
    """Return the fix of one frame, with computing times; a black frame has no stars.

    ``image``: shape (height, width). ``camera``: with its calibration. ``finder``: a function of
    :mod:`adcs.mockup.vision.centroids`.
    """
    begin = time.perf_counter()
    try:
        stars = finder(image)
    except NoLightsError:
        stars = Stars(np.empty((0, 2)), np.empty(0), np.empty(0, dtype=np.intp), float(np.median(image)), math.nan)
    points = undistorted(camera, stars.positions_px)
    located = time.perf_counter()
    fix = matcher.identify(points)
    end = time.perf_counter()
    return FrameResult(stars, fix, end - located, end - begin)


def sky_run(
    sky: LedSky,
    matcher: Matcher,
    setup: SkySetup = SkySetup(),
    seeds: Sequence[int] = (0,),
    progress: Callable[[int], None] | None = None,
    finder: Finder = find_stars,
) -> SkyRun:
    """Render frames at random poses, find the lights, identify them, and compare with the truth.

    Parameters
    ----------
    sky : LedSky
        Lights that the camera looks up at.
    matcher : Matcher
        Matcher for the catalogue of that sky and a camera of that footprint, such as :func:`adcs.mockup.odds_matcher`.
    setup : SkySetup
        Frames, and the calibration of the camera.
    seeds : sequence of int
        Seeds of the runs. The random numbers of a frame do not depend on the other frames.
    progress : callable, optional
        Called with the number of frames finished since the last call.
    finder : callable
        Function of :mod:`adcs.mockup.vision.centroids`.

    Returns
    -------
    SkyRun
        Results of all frames; `summary` has their statistics.

    Examples
    --------
    >>> from adcs import mockup
    >>> from sims import experiments
    >>> from sims.experiments.mockup_vision import SkySetup
    >>> sky, setup = mockup.led_sky(), SkySetup(poses=3)
    >>> catalogue = mockup.TriangleCatalogue.of(sky.positions_m)
    >>> matcher = mockup.odds_matcher(catalogue, setup.camera)
    >>> experiments.sky_run(sky, matcher, setup).summary()["false_fixes"]
    0
    """
    truth, results = [], []
    for seed, row in product(seeds, range(setup.poses)):
        pose, frame = random_frame(sky, setup, seed, row)
        truth.append([*pose.position_m, pose.heading_rad])
        results.append(frame_result(frame.image, setup.believed_camera, matcher, finder))
        if progress is not None:
            progress(1)
    return SkyRun(np.array(truth), tuple(results))


def random_frame(sky: LedSky, setup: SkySetup, seed: int, row: int) -> tuple[Pose, Frame]:
    """Return pose and frame of a row of :func:`sky_run`, in the middle of the exposure."""
    rng = np.random.default_rng([seed, row])
    x, y, heading = rng.uniform(-1.0, 1.0, 3) * [*setup.reach_m, math.pi]
    course, turn = rng.uniform(-math.pi, math.pi), rng.choice([-1.0, 1.0])
    velocity = (setup.speed_m_s * math.cos(course), setup.speed_m_s * math.sin(course))
    pose, motion = Pose(x, y, heading), Motion(velocity, turn * setup.turn_rate_rad_s)
    return pose, rendered_frame(sky, setup.camera, pose, rng, motion, setup)


def identified_files(
    paths: Iterable[Path], camera: Camera, matcher: Matcher, finder: Finder = find_stars
) -> dict[Path, FrameResult]:
    """Locate frames in PNG files; return the results by their paths.

    Parameters
    ----------
    paths : iterable of Path
        PNG files of the frames.
    camera : Camera
        Camera with its calibration; the frames must have its size.
    matcher, finder : callable
        Functions as in :func:`sky_run`.

    Returns
    -------
    dict of Path to FrameResult
        Result of every frame.

    Examples
    --------
    >>> from pathlib import Path
    >>> from adcs import mockup
    >>> from sims import experiments
    >>> camera, paths = mockup.Camera(), sorted(Path("frames").glob("*.png"))
    >>> catalogue = mockup.TriangleCatalogue.of(mockup.led_sky().positions_m)
    >>> matcher = mockup.odds_matcher(catalogue, camera)
    >>> found = experiments.identified_files(paths, camera, matcher)
    """
    return {path: frame_result(read_frame(path, camera), camera, matcher, finder) for path in paths}
