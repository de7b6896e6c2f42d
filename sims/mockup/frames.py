"""Simulated frames of the camera under the sky of LEDs, with blur, noise and faulty lights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adcs.mockup.navigation.strapdown import PlanarTrack
from adcs.mockup.vision.camera import Camera, Pose, image_from_table, in_frame, table_from_image
from adcs.mockup.vision.sky import LedSky
from arrays.io.errors import check_not_negative, check_positive
from arrays.typing import ByteArray, FloatArray

_PSF_REACH = 4.0  # a Gaussian is cut off where it is below 0.04 % of its peak
_STEP_PSF = 0.25  # along a smear: the sum of Gaussians this far apart is its integral to 0.05 DN
_MOST_STEPS = 2000


@dataclass(frozen=True)
class Motion:
    """Motion of the satellite during the exposure."""

    velocity_m_s: tuple[float, float] = (0.0, 0.0)  # (2,): in the table's frame
    turn_rate_rad_s: float = 0.0  # counter-clockwise seen from above


def pose_and_motion(track: PlanarTrack, at_s: float) -> tuple[Pose, Motion]:
    """Return pose and motion of a satellite at an instant of its track."""
    state = track.at([at_s]).state(0)
    turn_rate = np.interp(at_s, track.time_s, np.gradient(track.heading_rad, track.time_s))
    (x, y), (velocity_x, velocity_y) = state.position_m.tolist(), state.velocity_m_s.tolist()
    return Pose(x, y, state.heading_rad), Motion((velocity_x, velocity_y), float(turn_rate))


@dataclass(frozen=True)
class FrameQuality:
    """Quality of a frame of the camera.

    Attributes
    ----------
    psf_px : float
        Standard deviation of the Gaussian image of a light.
    peak_DN : float
        Peak of a light at rest, above the background; motion spreads the light over more pixels.
    noise_DN : float
        Standard deviation of a pixel.
    lost : float
        Probability that a light is dark.
    spurious : int
        Lights in view that are not in the catalogue, at random positions on the ceiling.
    hot_pixels : int
        Number of pixels at 255, at random positions.

    Raises
    ------
    ValueError
        A number is out of range.
    """

    psf_px: float = 1.5
    peak_DN: float = 180.0
    background_DN: float = 20.0
    noise_DN: float = 4.0
    lost: float = 0.0
    spurious: int = 0
    hot_pixels: int = 0

    def __post_init__(self) -> None:
        check_positive(psf_px=self.psf_px)
        names = ("peak_DN", "background_DN", "noise_DN", "spurious", "hot_pixels")
        check_not_negative(**{name: getattr(self, name) for name in names})
        if not 0.0 <= self.lost <= 1.0:
            raise ValueError(f"Input lost must be between 0 and 1; instead received {self.lost}.")


@dataclass(frozen=True, eq=False)
class Frame:
    """A rendered frame."""

    image: ByteArray  # (height_px, width_px)
    lights: NDArray[np.intp]  # (k,): lights of the sky that shine and are in the frame in the middle of the exposure
    lights_px: FloatArray  # (k, 2): column and row of them
    spurious_px: FloatArray  # (spurious, 2)


def rendered_frame(
    sky: LedSky,
    camera: Camera,
    pose: Pose,
    rng: np.random.Generator,
    motion: Motion = Motion(),
    quality: FrameQuality = FrameQuality(),
) -> Frame:
    """Render a frame of the camera.

    A light's image is a Gaussian, drawn out along the path that it takes during the exposure; the total light does not
    depend on the motion. Gaussian noise, then rounding to whole numbers from 0 to 255.

    Parameters
    ----------
    sky : LedSky
        Such as :func:`adcs.mockup.led_sky`.
    camera : Camera
        Camera with its lens, size of the frame and height below the lights.
    pose : Pose
        Pose in the middle of the exposure.
    rng : numpy.random.Generator
        Generator of noise, of lights that are dark, and of spurious ones.
    motion : Motion
        Velocity and turn rate meanwhile; at rest by default.
    quality : FrameQuality
        Noise, lights that are dark, spurious ones, hot pixels.

    Returns
    -------
    Frame
        Image with the places of its lights.

    Examples
    --------
    >>> import numpy as np
    >>> import sims
    >>> from adcs import mockup
    >>> camera, pose = mockup.camera_of_footprint(0.9), mockup.Pose(0.0, 0.0, 0.3)
    >>> frame = sims.rendered_frame(mockup.led_sky(), camera, pose, np.random.default_rng(0))
    >>> frame.image.shape
    (480, 640)
    """
    shining = np.flatnonzero(rng.random(len(sky)) >= quality.lost)
    size = np.array([camera.width_px, camera.height_px])
    spurious_px = rng.uniform(0.0, 1.0, (quality.spurious, 2)) * (size - 1.0)
    spurious_m = table_from_image(camera, pose, spurious_px)
    middle_px = image_from_table(camera, pose, sky.positions_m[shining])
    seen = in_frame(camera, middle_px)
    paths = _paths(camera, pose, motion, np.concatenate([sky.positions_m[shining], spurious_m]), quality.psf_px)
    image = rng.standard_normal((camera.height_px, camera.width_px), dtype=np.float32)
    image *= np.float32(quality.noise_DN)
    image += np.float32(quality.background_DN + 0.5)  # then cutting off decimals rounds
    for path in paths:
        _add_light(image, path, quality)
    np.clip(image, 0.0, 255.0, out=image)
    pixels = image.astype(np.uint8)
    if quality.hot_pixels:
        pixels.reshape(-1)[rng.choice(pixels.size, quality.hot_pixels, replace=False)] = 255
    return Frame(pixels, shining[seen], middle_px[seen], spurious_px)


def _paths(camera: Camera, pose: Pose, motion: Motion, points_m: FloatArray, psf_px: float) -> FloatArray:
    """Return the paths of lights near the frame during the exposure, (lights, steps, 2)."""
    path_px = camera.exposure_s / camera.m_per_px * math.hypot(*motion.velocity_m_s)
    path_px += camera.exposure_s * abs(motion.turn_rate_rad_s) * math.hypot(camera.width_px, camera.height_px)
    n_steps = min(max(math.ceil(path_px / (_STEP_PSF * psf_px)), 1), _MOST_STEPS)
    t = camera.exposure_s * ((np.arange(n_steps) + 0.5) / n_steps - 0.5)
    poses = Pose(
        pose.x_m + motion.velocity_m_s[0] * t,
        pose.y_m + motion.velocity_m_s[1] * t,
        pose.heading_rad + motion.turn_rate_rad_s * t,
    )
    reach = camera.m_per_px * (2.0 * math.hypot(camera.width_px, camera.height_px) + path_px)
    near = np.sum((points_m - pose.position_m) ** 2, axis=1) < reach**2
    paths = np.swapaxes(image_from_table(camera, poses, points_m[near]), 0, 1)
    in_reach = in_frame(camera, paths, -_PSF_REACH * psf_px).any(axis=1)
    return paths[in_reach]


def _add_light(image: NDArray[np.float32], path: FloatArray, quality: FrameQuality) -> None:
    """Add the light of a path (steps, 2); NaN steps are outside the lens."""
    shown = path[np.isfinite(path[:, 0])]
    reach = _PSF_REACH * quality.psf_px
    size = np.array(image.shape[::-1])
    begin = np.clip(np.floor(shown.min(axis=0) - reach), 0, size).astype(int)
    end = np.clip(np.ceil(shown.max(axis=0) + reach) + 1, 0, size).astype(int)
    across, down = (
        np.exp(-0.5 * ((np.arange(begin[axis], end[axis]) - shown[:, axis, None]) / quality.psf_px) ** 2)
        for axis in range(2)
    )
    patch = (quality.peak_DN / len(path)) * (down.T @ across)
    image[begin[1] : end[1], begin[0] : end[0]] += patch.astype(np.float32)
