"""Options of ``adcs run mockup``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from arrays.io.errors import InputError, naming
from magloc.cli.framework import Count, Seed, refuse_outside, whole_number
from sims.experiments.mockup_settings import SETTLED_S, Method, Unknowns

if TYPE_CHECKING:
    from adcs.mockup.vision.camera import Camera
    from adcs.mockup.vision.paper_matcher import Matcher
    from adcs.mockup.vision.sky import LedSky
    from sims.experiments.mockup_camera import TableCamera
    from sims.experiments.mockup_vision import Finder, SkySetup
    from sims.mockup.table_run import TableScenario

Part = Literal["sky", "fusion", "zeros", "all"]
MatcherName = Literal["paper", "robust", "odds"]
StarFinder = Literal["bright", "faint", "level"]
FusionName = Literal[Method, "all"]
Number0 = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=0))]
_EVERYWHERE = {"part", "seeds", "seed"}
_OF_THE_CAMERA = (
    *("matcher", "lost", "spurious", "hot_pixels", "noise_dn", "footprint_m", "k1", "believed_k1", "stars", "sky"),
)
_BELONGS: dict[str, tuple[str, ...]] = {
    "sky": (*_OF_THE_CAMERA, "poses", "speed_m_s", "turn_deg_s", "frames"),
    "fusion": (
        "fusion",
        "duration",
        "false_fixes",
        "failed",
        "overtaken",
        "repeated",
        "delay_s",
        "outage",
        "samples",
        "fixes",
    ),
    "zeros": ("unknowns", "start_fixes", "duration"),
    "all": (*_OF_THE_CAMERA, "fusion", "duration", "delay_s", "outage"),
}
_OF_FRAMES = ("part", "frames", "sky", "matcher", "footprint_m", "believed_k1", "stars")
"""Options of frames that are read from files; all others belong to simulated frames."""
_OF_RECORDS = ("part", "samples", "fixes", "fusion")
"""Options of a recording; all others belong to simulated drives."""
_CLOSEST_PX = 4.0
"""Distance below which two lights are one blob."""


@Parameter(name="*")
@dataclass(frozen=True)
class MockupOptions:
    """Part of the mock-up to simulate, and its settings.

    Parameters
    ----------
    part : str
        Frames of the camera, rendered and identified ("sky"), drives with delayed fixes ("fusion"), zeros of the
        accelerometer from short runs ("zeros"), or drives with fixes from rendered frames ("all").
    seeds : int, optional
        Number of runs; by default 6, 1 for "sky".
    seed : int
        Seed of the first run; the next runs take the next seeds.
    poses : int, optional
        sky: number of frames in a run, at random positions and headings; 120 by default.
    matcher : str, optional
        sky, all: star matcher: triangles as in the source paper ("paper"), triangles verified by all stars ("robust",
        the default), or pairs of stars weighted by odds ("odds").
    lost : float, optional
        sky, all: fraction of dark lights, 0 to 1; 0 by default.
    spurious : int, optional
        sky, all: number of lights in view that are not in the catalogue; 0 by default.
    hot_pixels : int, optional
        sky, all: number of pixels that are always white; 0 by default.
    noise_dn : float, optional
        sky, all: noise of a pixel, of 255; 4 by default.
    speed_m_s : float, optional
        sky: speed during the exposure of 1/30 s [m/s]; 0 by default.
    turn_deg_s : float, optional
        sky: turn rate during the exposure [°/s]; 0 by default.
    footprint_m : float, optional
        sky, all: width of the visible part of the ceiling [m]; 0.9 by default.
    k1 : float, optional
        sky, all: radial distortion of the lens at 320 px from its centre, such as -0.05; 0 by default.
    believed_k1 : float, optional
        sky, all: radial distortion in the calibration of the camera; 0 by default.
    stars : str, optional
        sky, all: detection of stars: pixels far above the background ("bright", the default), sums of pixels for faint
        and smeared lights ("faint"), or the level of the source paper, between the darkest and the brightest pixel
        ("level").
    sky : Path, optional
        sky, all: TOML file of the positions of the lights; by default 180 random ones.
    frames : Path, optional
        sky: PNG file, or a folder of PNG files, to identify instead of simulated frames; needs --sky.
    fusion : str, optional
        fusion, all: integration from the exposure of each fix ("paper"), the same with corrected velocity
        ("velocity-corrected"), the delayed error-state filter ("ekf", the default), fixes alone, delayed and held
        ("camera"), samples alone ("imu"), or all of these ("all").
    duration : float, optional
        fusion, zeros, all: duration [s]; 180 by default, 15 for "zeros". Runs of "zeros" up to 20 s have two firings.
    false_fixes : float, optional
        fusion: fraction of false fixes, at random positions; 0 by default.
    failed : float, optional
        fusion: fraction of frames without a fix; 0.12 by default.
    overtaken : float, optional
        fusion: fraction of fixes that arrive up to 1.8 s later than usual; 0 by default.
    repeated : float, optional
        fusion: fraction of fixes that arrive twice; 0 by default.
    delay_s : float, optional
        fusion, all: delay from the exposure to the fix [s]; 0.6 by default, for "all" the time that identification
        takes on this machine.
    outage : float, optional
        fusion, all: begin and end of a period without frames [s].
    samples : Path, optional
        fusion: CSV file of a recording, instead of simulated drives, with time_s, acceleration_x_m_s2,
        acceleration_y_m_s2 and rate_deg_s of every sample; needs --fixes.
    fixes : Path, optional
        fusion: CSV file of the fixes of a recording, with exposure_s, arrival_s, x_m, y_m and heading_deg; needs
        --samples.
    unknowns : str, optional
        zeros: unknowns of the fit: the zeros ("two"), also the start ("six", the default), or also the slopes of the
        zeros ("drift").
    start_fixes : int, optional
        zeros: number of fixes that determine the start of "two"; 4 by default, 2 in the source paper.
    """

    part: Part = "sky"
    seeds: Annotated[Count | None, Parameter(name=["--seeds", "--runs"])] = None
    seed: Seed = 0
    poses: Count | None = None
    matcher: MatcherName | None = None
    lost: float | None = None
    spurious: Number0 | None = None
    hot_pixels: Number0 | None = None
    noise_dn: float | None = None
    speed_m_s: float | None = None
    turn_deg_s: float | None = None
    footprint_m: float | None = None
    k1: float | None = None
    believed_k1: float | None = None
    stars: StarFinder | None = None
    sky: Path | None = None
    frames: Path | None = None
    fusion: FusionName | None = None
    duration: float | None = None
    false_fixes: float | None = None
    failed: float | None = None
    overtaken: float | None = None
    repeated: float | None = None
    delay_s: float | None = None
    outage: tuple[float, float] | None = None
    samples: Path | None = None
    fixes: Path | None = None
    unknowns: Unknowns | None = None
    start_fixes: Annotated[int | None, Parameter(converter=whole_number, validator=Number(gte=2))] = None

    def check(self) -> None:
        """Refuse options that contradict each other or are out of range."""
        belongs = {*_BELONGS[self.part], *_EVERYWHERE}
        for name in self.given():
            if name not in belongs:
                parts = " or ".join(f"--part {part}" for part, names in _BELONGS.items() if name in names)
                raise InputError(f"{option_name(name)}: found with --part {self.part}, expected with {parts}.")
        if self.frames is not None:
            self._check_frames()
        if self.samples is not None or self.fixes is not None:
            self._check_record()
        fractions = self._known("lost", "false_fixes", "failed", "overtaken", "repeated")
        refuse_outside(0.0, 1.0, "a fraction between 0 and 1", **fractions)
        refuse_outside(0.0, 1e6, "0 or more", **self._known("noise_dn", "speed_m_s", "turn_deg_s"))
        pixels = 640 * 480
        refuse_outside(0.0, pixels, f"0 to {pixels}, all pixels of the frame", hot_pixels=self.hot_pixels)
        refuse_outside(0.0, 10.0, "0 to 10 s, as long as samples are kept", delay_s=self.delay_s)
        refuse_outside(0.01, 100.0, "0.01 to 100 m", footprint_m=self.footprint_m)
        if self.start_fixes is not None and self.unknowns != "two":
            raise InputError("--start-fixes: found without --unknowns two, expected with it.")
        if self.outage is not None and not 0.0 <= self.outage[0] < self.outage[1]:
            raise InputError(
                f"--outage: found {self.outage[0]:g} to {self.outage[1]:g} s, expected a time and a later one."
            )

    def given(self) -> list[str]:
        """Return the names of the options that differ from their defaults."""
        return [field.name for field in fields(self) if getattr(self, field.name) != field.default]

    def _check_frames(self) -> None:
        if self.sky is None:
            raise InputError(f"--frames {self.frames}: found no --sky, expected the file of the lights' places.")
        self._refuse_given_but(_OF_FRAMES, "found with --frames, expected with simulated frames only.")

    def _check_record(self) -> None:
        for name, other in (("samples", "fixes"), ("fixes", "samples")):
            if getattr(self, name) is not None and getattr(self, other) is None:
                raise InputError(f"{option_name(name)}: found without --{other}, expected both.")
        self._refuse_given_but(_OF_RECORDS, "found with --samples, expected with simulated drives only.")
        if self.fusion == "all":
            raise InputError("--fusion: found all with a recording (--samples), expected one method.")

    def _refuse_given_but(self, names: Sequence[str], fault: str) -> None:
        for name in self.given():
            if name not in names:
                raise InputError(f"{option_name(name)}: {fault}")

    def runs(self, default: int) -> range:
        """Return the seeds of the runs."""
        return range(self.seed, self.seed + (default if self.seeds is None else self.seeds))

    def camera(self) -> Camera:
        """Return the camera as its user knows it."""
        from adcs.mockup.vision.camera import camera_of_footprint

        with naming("--believed-k1"):
            return camera_of_footprint(value_or(self.footprint_m, 0.9), value_or(self.believed_k1, 0.0))

    @cached_property
    def led_sky(self) -> LedSky:
        """Lights on the ceiling."""
        from adcs.mockup.vision.sky import led_sky, read_sky

        if self.sky is None:
            return led_sky()
        sky, camera = read_sky(self.sky), self.camera()
        least_m, most_m = _CLOSEST_PX * camera.m_per_px, math.hypot(*camera.footprint_m)
        if not least_m <= sky.spacing_m <= most_m:
            raise InputError(
                f"{self.sky}, key positions_m: found lights {sky.spacing_m:.3g} m apart, expected {least_m:.2g} to "
                f"{most_m:.2g} m in frames {camera.footprint_m[0]:g} m wide; the file's unit is the metre."
            )
        return sky

    @property
    def matcher_name(self) -> MatcherName:
        """Name of the star matcher."""
        return self.matcher or "robust"

    def sky_matcher(self) -> Matcher:
        """Return the star matcher."""
        from adcs.mockup.vision.odds_matcher import odds_matcher
        from adcs.mockup.vision.paper_matcher import PaperMatcher
        from adcs.mockup.vision.robust_matcher import RobustMatcher
        from adcs.mockup.vision.triangles import TriangleCatalogue

        catalogue, camera = TriangleCatalogue.of(self.led_sky.positions_m), self.camera()
        if self.matcher_name == "paper":
            return PaperMatcher(catalogue)
        if self.matcher_name == "odds":
            return odds_matcher(catalogue, camera)
        return RobustMatcher(catalogue, camera.m_per_px)

    def finder(self) -> Finder:
        """Return the function that finds the stars of an image."""
        from adcs.mockup.vision.centroids import find_faint_stars, find_stars, find_stars_between_extremes

        if self.stars == "faint":
            return find_faint_stars
        return find_stars_between_extremes if self.stars == "level" else find_stars

    def sky_setup(self) -> SkySetup:
        """Return the settings of simulated frames."""
        from sims.experiments.mockup_vision import SkySetup

        names = ("poses", "lost", "spurious", "hot_pixels", "speed_m_s", "footprint_m", "k1", "believed_k1")
        turn_rad_s = None if self.turn_deg_s is None else math.radians(self.turn_deg_s)
        setup = SkySetup(**self._known(*names, noise_DN=self.noise_dn, turn_rate_rad_s=turn_rad_s))
        for option, camera in (("--k1", "camera"), ("--believed-k1", "believed_camera")):
            with naming(option):
                getattr(setup, camera)
        return setup

    def table_camera(self) -> TableCamera:
        """Return the camera of a drive, which takes and locates the frames."""
        from sims.experiments.mockup_camera import TableCamera

        return TableCamera(self.led_sky, self.sky_setup(), self.sky_matcher(), self.finder(), self.delay_s)

    def _known(self, *names: str, **more: Any) -> dict[str, Any]:
        """Return options by their names, and `more`, without those that are not given."""
        values = {name: getattr(self, name) for name in names} | more
        return {name: value for name, value in values.items() if value is not None}

    def table_scenario(self) -> TableScenario:
        """Return the settings of simulated drives."""
        from sims.mockup.table_run import CameraErrors, TableScenario

        outages_s = None if self.outage is None else (self.outage,)
        names = ("delay_s", "failed", "overtaken", "repeated")
        camera = CameraErrors(**self._known(*names, false=self.false_fixes, outages_s=outages_s))
        return TableScenario(duration_s=self.duration_s, camera=camera)

    @property
    def duration_s(self) -> float:
        """Duration of a run [s]."""
        duration = value_or(self.duration, 15.0 if self.part == "zeros" else 180.0)
        if not SETTLED_S < duration <= 1e4:
            raise InputError(f"--duration: found {duration:g} s, expected more than {SETTLED_S:g} and up to 10000 s.")
        return duration


def option_name(name: str) -> str:
    """Return an option as users type it."""
    return f"--{name.replace('_', '-')}"


def value_or(value: Any, default: Any) -> Any:
    """Return the value, or the default if there is none."""
    return default if value is None else value
