"""Attitude, scale and distortion of a camera from identified stars."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from adcs.stars.camera import StarCamera
from arrays.typing import FloatArray


@dataclass(frozen=True)
class LensPrior:
    """Prior standard deviations of a camera's lens; 0 is exactly known."""

    scale: float = 0.0
    """Relative standard deviation of the scale."""
    bent: float = 0.0
    """Displacement of a corner by radial distortion, over its distance from the centre."""


UNKNOWN_LENS = LensPrior(scale=0.05, bent=0.02)
"""Prior of a star camera without a calibration."""


@dataclass(frozen=True, eq=False)
class CameraPose:
    """Attitude and lens of a camera, with their covariance.

    Attributes
    ----------
    R_catalogue_from_frame : ndarray, shape (3, 3)
        Rotation matrix, catalogue from camera frame.
    camera : StarCamera
        Camera with the fitted scale and distortion.
    covariance : ndarray, shape (5, 5)
        Covariance of small rotations about the frame's axes [rad], the logarithm of the scale, and the distortion.
    """

    R_catalogue_from_frame: FloatArray
    camera: StarCamera
    covariance: FloatArray


def fit_pose(
    points_px: FloatArray, there: FloatArray, pose: CameraPose, known: StarCamera, prior: LensPrior, noise_px: float
) -> CameraPose:
    """Refine a pose by one Gauss–Newton step, from stars (k, 2) and directions (k, 3) in the catalogue.

    A star at v = Rᵀd has the tangents t = (v₁, v₂) / −v₃. A rotation δθ about the frame's axes moves it by v × δθ.
    Without noise, the camera's place of t equals a x (1 + κ a²|x|²) of the star's point x. The covariance uses the
    scatter of the residuals.
    """
    v = there @ pose.R_catalogue_from_frame
    pinhole = replace(pose.camera, radial=0.0, projection="pinhole").tangents(points_px)
    squared = np.sum(pinhole**2, axis=1, keepdims=True)
    seen = pinhole * (1.0 + pose.camera.radial * squared)
    t = v[:, :2] / -v[:, 2:]
    dv = np.cross(v[:, None], np.eye(3))
    J = np.empty((len(v), 2, 5))
    dt = np.swapaxes(dv[..., :2] / -v[:, None, 2:] + dv[..., 2:] * (v[:, None, :2] / v[:, None, 2:] ** 2), 1, 2)
    J[..., :3] = pose.camera.place_changes(t, dt)
    J[..., 3] = -pinhole * (1.0 + 3.0 * pose.camera.radial * squared)
    J[..., 4] = -pinhole * squared
    J = J.reshape(-1, 5) / math.tan(pose.camera.rad_per_px)
    left = (seen - pose.camera.places(t)).ravel() / math.tan(pose.camera.rad_per_px)
    sigma = np.array([math.inf, math.inf, math.inf, prior.scale, prior.bent / known.corner**2])
    off = np.array([0.0, 0.0, 0.0, math.log(pose.camera.rad_per_px / known.rad_per_px), 0.0])
    off[4] = pose.camera.radial - known.radial
    free = sigma > 0.0
    J, sigma, off = J[:, free], sigma[free], off[free]
    information = J.T @ J / noise_px**2 + np.diag(sigma**-2)
    step = np.zeros(5)
    step[free] = np.linalg.solve(information, J.T @ left / noise_px**2 - off / sigma**2)
    after = left - J @ step[free]
    scatter = float(after @ after) / max(len(after) - len(sigma), 1)
    covariance = np.zeros((5, 5))
    covariance[np.ix_(free, free)] = np.linalg.inv(J.T @ J / scatter + np.diag(sigma**-2))
    R = pose.R_catalogue_from_frame @ Rotation.from_rotvec(step[:3]).as_matrix()
    rad_per_px = pose.camera.rad_per_px * math.exp(step[3])
    return CameraPose(R, replace(pose.camera, rad_per_px=rad_per_px, radial=pose.camera.radial + step[4]), covariance)
