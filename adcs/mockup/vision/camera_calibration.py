"""Calibration of the camera: scale, distortion and optical centre from frames with known poses.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from adcs.mockup.vision.camera import REFERENCE_RADIUS_PX, Camera, Pose, centred_from_table, distort
from adcs.mockup.vision.sky import LedSky
from arrays.typing import FloatArray

PARAMETERS = ("m_per_px", "k1", "centre_x_px", "centre_y_px")
# Largest distances of true pairs of star and light, from an unknown lens to a known one.
_GATES_PX = (30.0, 10.0, 3.0)
_STEPS_PER_GATE = 2
_FEWEST_PAIRS = 8
_FEWEST_OF_FRAME = 2  # a shift explains one light
_RANK_RTOL = 1e-6
_UNKNOWN_POSE = np.full(3, 1e9)  # standard deviations [m, rad] so large that a pose is free
_LEAST_NOISE_PX = 1e-7  # for simulated centroids without noise


_Rows = tuple[FloatArray, FloatArray, FloatArray]
"""Residuals (2k,) of a frame, and their derivatives by camera (2k, 4) and pose (2k, 3)."""


@dataclass(frozen=True, eq=False)
class KnownFrame:
    """Detected lights of a frame with a known pose.

    Attributes
    ----------
    pose : Pose
        Pose in the middle of the exposure.
    positions_px : ndarray, shape (n, 2)
        Column and row of each light.

    Examples
    --------
    >>> import numpy as np
    >>> import sims
    >>> from adcs import mockup
    >>> sky, camera, pose = mockup.led_sky(), mockup.Camera(), mockup.Pose(0.1, 0.2, 0.3)
    >>> frame = sims.rendered_frame(sky, camera, pose, np.random.default_rng(0))
    >>> stars = mockup.find_stars(frame.image)
    >>> known = mockup.KnownFrame(pose, stars.positions_px)
    """

    pose: Pose
    positions_px: FloatArray


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Calibrated camera.

    Attributes
    ----------
    camera : Camera
        Camera with the fitted scale, distortion and centre.
    covariance : ndarray, shape (4, 4)
        Covariance of :data:`PARAMETERS`, in m/px, 1 and px.
    noise_px : float
        Standard deviation of a centroid's coordinate, from the residuals.
    residual_rms_px : float
        Root mean square of the coordinates' residuals, which include the errors of the poses.
    n_pairs : int
        Number of lights in use.
    """

    camera: Camera
    covariance: FloatArray
    noise_px: float
    residual_rms_px: float
    n_pairs: int

    @property
    def values(self) -> FloatArray:
        """Values of :data:`PARAMETERS`, shape (4,)."""
        return np.array([self.camera.m_per_px, self.camera.k1, *self.camera.centre])

    @property
    def std(self) -> FloatArray:
        """Standard deviations of :data:`PARAMETERS`, shape (4,)."""
        return np.sqrt(np.diagonal(self.covariance))


def calibrated_camera(
    sky: LedSky,
    frames: Sequence[KnownFrame],
    camera: Camera = Camera(),  # noqa: B008 - frozen
    position_sigma_m: float = 0.0,
    heading_sigma_rad: float = 0.0,
) -> CameraCalibration:
    """Calibrate a camera by the lights of frames with known poses.

    Parameters
    ----------
    sky : LedSky
        Lights on the ceiling.
    frames : sequence of KnownFrame
        Frames with at least eight lights in total.
    camera : Camera
        Initial camera: the scale is within some percent, k1 within some hundredths.
    position_sigma_m, heading_sigma_rad : float
        Standard deviations of X, Y and heading of the poses, independent between frames.

    Returns
    -------
    CameraCalibration
        Camera, and covariance of its scale, distortion and centre.

    Raises
    ------
    ValueError
        A standard deviation is negative, too few lights are near their predicted places, or they do not determine the
        camera.

    Examples
    --------
    >>> import numpy as np
    >>> import sims
    >>> from adcs import mockup
    >>> sky, camera, pose = mockup.led_sky(), mockup.Camera(), mockup.Pose(0.1, 0.2, 0.3)
    >>> frame = sims.rendered_frame(sky, camera, pose, np.random.default_rng(0))
    >>> stars = mockup.find_stars(frame.image)
    >>> known = mockup.KnownFrame(pose, stars.positions_px)
    >>> found = mockup.calibrated_camera(sky, [known], mockup.camera_of_footprint(0.91))
    >>> round(float(found.camera.footprint_m[0]), 2)
    0.9
    """
    sigmas = np.array([position_sigma_m, position_sigma_m, heading_sigma_rad])
    if not ((sigmas >= 0.0) & np.isfinite(sigmas)).all():
        raise ValueError(f"Input sigmas must be finite and not negative; instead received {sigmas[1:].tolist()}.")
    # Errors of the poses displace lights for any camera.
    slack_px = 3.0 * math.hypot(position_sigma_m / camera.m_per_px, heading_sigma_rad * REFERENCE_RADIUS_PX)
    pairs = [_pair_lights(sky, camera, frame, _GATES_PX[0] + slack_px) for frame in frames]
    for gate in _GATES_PX:
        for _ in range(_STEPS_PER_GATE):
            camera = _refine(camera, pairs, sigmas).camera
        pairs = [_pair_lights(sky, camera, frame, gate + slack_px) for frame in frames]
    return _refine(camera, pairs, sigmas)


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Paired lights of one frame: positions on the ceiling and in the image, shapes (k, 2)."""

    pose: Pose
    points_m: FloatArray
    image_px: FloatArray


def _pair_lights(sky: LedSky, camera: Camera, frame: KnownFrame, gate_px: float) -> _Pairs:
    """Pair lights of the sky and of the frame that are each other's nearest, within a gate."""
    stars = np.asarray(frame.positions_px, dtype=np.float64).reshape(-1, 2)
    predicted = distort(camera, centred_from_table(camera, frame.pose, sky.positions_m))
    shown = np.flatnonzero(np.isfinite(predicted).all(axis=1))
    distance = np.linalg.norm(predicted[shown, None] - stars, axis=-1)
    if distance.size == 0:
        return _Pairs(frame.pose, np.empty((0, 2)), np.empty((0, 2)))
    light, star = distance.argmin(axis=0), np.arange(len(stars))
    kept = (distance.argmin(axis=1)[light] == star) & (distance[light, star] <= gate_px)
    return _Pairs(frame.pose, sky.positions_m[shown[light[kept]]], stars[kept])


def _refine(camera: Camera, frames: Sequence[_Pairs], sigmas: FloatArray) -> CameraCalibration:
    """Return the calibration after one Gauss-Newton step."""
    usable = [pairs for pairs in frames if len(pairs.points_m) >= _FEWEST_OF_FRAME]
    n_pairs = sum(len(pairs.points_m) for pairs in usable)
    if n_pairs < _FEWEST_PAIRS:
        raise ValueError(
            f"Input frames must show {_FEWEST_PAIRS} lights near their predicted places; instead received {n_pairs}."
        )
    rows = [_rows(camera, pairs) for pairs in usable]
    noise_px = _noise(rows)
    step, covariance, rank, _ = _fit_camera(rows, sigmas, noise_px)
    if rank < len(PARAMETERS):
        raise ValueError("Input frames must determine the camera; instead received lights too few or too close.")
    centre = camera.centre + step[2:]
    refined = replace(
        camera, m_per_px=camera.m_per_px + step[0], k1=camera.k1 + step[1], centre_px=(centre[0], centre[1])
    )
    left = np.concatenate([residual - by_camera @ step for residual, by_camera, _ in rows])
    return CameraCalibration(refined, covariance, noise_px, float(np.sqrt(np.mean(left**2))), n_pairs)


def _fit_camera(
    rows: Sequence[_Rows], sigmas: FloatArray, noise_px: float
) -> tuple[FloatArray, FloatArray, int, FloatArray]:
    """Return the step (4,) of the camera, its covariance, its rank, and whitened residuals after it.

    ``sigmas`` (3,): standard deviations of each pose. A parameter that the rows do not determine keeps its value.
    """
    parts = [
        _whiten(np.column_stack([residual, by_camera]), by_pose * sigmas, noise_px)
        for residual, by_camera, by_pose in rows
    ]
    white = np.concatenate(parts)
    r, J = white[:, 0], white[:, 1:]
    scale = np.maximum(np.linalg.norm(J, axis=0), np.finfo(np.float64).tiny)
    left, size, right = np.linalg.svd(J / scale, full_matrices=False)
    rank = int(np.count_nonzero(size > _RANK_RTOL * size[0]))
    inverse = (right[:rank].T / size[:rank]) @ left[:, :rank].T / scale[:, None]
    step = inverse @ r
    return step, inverse @ inverse.T, rank, r - J @ step


def _whiten(columns: FloatArray, E: FloatArray, noise_px: float) -> FloatArray:
    """Multiply columns (2k, n) by the inverse square root of noise² I + E Eᵀ."""
    basis, size, _ = np.linalg.svd(E, full_matrices=False)
    share = 1.0 - noise_px / np.hypot(noise_px, size)
    return (columns - basis @ (share[:, None] * (basis.T @ columns))) / noise_px


def _rows(camera: Camera, pairs: _Pairs) -> _Rows:
    """Return the residuals of a frame in the image, and their derivatives by camera and pose."""
    ideal = centred_from_table(camera, pairs.pose, pairs.points_m)
    residual = pairs.image_px - distort(camera, ideal)
    rho2 = np.sum(ideal**2, axis=1) / REFERENCE_RADIUS_PX**2
    flip = np.array([1.0, -1.0])  # rows count downwards
    outer = ideal[:, :, None] * ideal[:, None, :] / REFERENCE_RADIUS_PX**2
    by_ideal = flip[:, None] * ((1.0 + camera.k1 * rho2)[:, None, None] * np.eye(2) + 2.0 * camera.k1 * outer)
    by_camera = np.empty((len(ideal), 2, 4))
    by_camera[..., 0] = -(by_ideal @ ideal[..., None])[..., 0] / camera.m_per_px
    by_camera[..., 1] = flip * rho2[:, None] * ideal
    by_camera[..., 2:] = np.eye(2)
    # Ideal pixels are right = (cos dX + sin dY)/s and up = (sin dX - cos dY)/s of the offset d from the satellite.
    cos, sin = np.cos(pairs.pose.heading_rad), np.sin(pairs.pose.heading_rad)
    by_place = np.array([[-cos, -sin], [-sin, cos]]) / camera.m_per_px
    by_turn = np.stack([-ideal[:, 1], ideal[:, 0]], axis=1)
    by_pose = by_ideal @ np.concatenate([np.broadcast_to(by_place, (len(ideal), 2, 2)), by_turn[..., None]], axis=2)
    return residual.reshape(-1), by_camera.reshape(-1, 4), by_pose.reshape(-1, 3)


def _noise(rows: Sequence[_Rows]) -> float:
    """Return the standard deviation of a coordinate, with the camera and each frame's pose free."""
    _, _, rank, left = _fit_camera(rows, _UNKNOWN_POSE, 1.0)
    freedom = left.size - len(_UNKNOWN_POSE) * len(rows) - rank
    return max(math.sqrt(float(left @ left) / max(freedom, 1)), _LEAST_NOISE_PX)
