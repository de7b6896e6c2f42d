"""Attitude, scale and distortion of a camera from identified stars."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from adcs.stars.camera import DISTORTION_DEGREES, StarCamera, distortion_terms
from arrays.typing import FloatArray


@dataclass(frozen=True)
class LensPrior:
    """Prior standard deviations of a camera's lens; 0 is exactly known."""

    scale: float = 0.0
    """Relative standard deviation of the scale."""
    bent: float = 0.0
    """Displacement of a corner by radial distortion, over its distance from the centre."""
    bent2: float = 0.0
    """The same by the second radial distortion."""
    tangential: float = 0.0
    """The same by each tangential distortion; an equidistant lens has none."""

    def sigmas(self, camera: StarCamera) -> FloatArray:
        """Return the standard deviations (5,) of the logarithm of the scale, k₁, k₂, p₁ and p₂."""
        corner = camera.corner
        tangential = self.tangential / corner if camera.projection == "pinhole" else 0.0
        return np.array([self.scale, self.bent / corner**2, self.bent2 / corner**4, tangential, tangential])


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
    covariance : ndarray, shape (8, 8)
        Covariance of small rotations about the frame's axes [rad], the logarithm of the scale, and the distortions
        k₁, k₂, p₁ and p₂; 0 for one that was not fitted.
    """

    R_catalogue_from_frame: FloatArray
    camera: StarCamera
    covariance: FloatArray

    @property
    def corner_sigma(self) -> float:
        """Standard deviation of a corner's displacement by radial distortion, over its distance from the centre."""
        powers = self.camera.corner ** np.array([2.0, 4.0])
        return math.sqrt(powers @ self.covariance[4:6, 4:6] @ powers)


def fit_pose(
    points_px: FloatArray, there: FloatArray, pose: CameraPose, known: StarCamera, prior: LensPrior, noise_px: float
) -> CameraPose:
    """Refine a pose by one Gauss–Newton step, from stars (k, 2) and directions (k, 3) in the catalogue.

    A star at v = Rᵀd has the tangents t = (v₁, v₂) / −v₃. A rotation δθ about the frame's axes moves it by v × δθ.
    Without noise, the camera's place of t equals the corrected place of the star's point. The covariance uses the
    scatter of the residuals.
    """
    v = there @ pose.R_catalogue_from_frame
    s = pose.camera.image_places(points_px)
    terms = distortion_terms(s)
    t = v[:, :2] / -v[:, 2:]
    dv = np.cross(v[:, None], np.eye(3))
    J = np.empty((len(v), 2, 8))
    dt = np.swapaxes(dv[..., :2] / -v[:, None, 2:] + dv[..., 2:] * (v[:, None, :2] / v[:, None, 2:] ** 2), 1, 2)
    J[..., :3] = pose.camera.place_changes(t, dt)
    J[..., 3] = -s - terms @ (DISTORTION_DEGREES * pose.camera.distortion)
    J[..., 4:] = -terms
    J = J.reshape(-1, 8) / math.tan(pose.camera.rad_per_px)
    left = (pose.camera.corrected(s) - pose.camera.places(t)).ravel() / math.tan(pose.camera.rad_per_px)
    sigma = np.concatenate([np.full(3, math.inf), prior.sigmas(known)])
    scale = math.log(pose.camera.rad_per_px / known.rad_per_px)
    off = np.concatenate([np.zeros(3), [scale], pose.camera.distortion - known.distortion])
    free = sigma > 0.0
    J, sigma, off = J[:, free], sigma[free], off[free]
    information = J.T @ J / noise_px**2 + np.diag(sigma**-2)
    step = np.zeros(8)
    step[free] = np.linalg.solve(information, J.T @ left / noise_px**2 - off / sigma**2)
    after = left - J @ step[free]
    scatter = float(after @ after) / max(len(after) - len(sigma), 1)
    covariance = np.zeros((8, 8))
    covariance[np.ix_(free, free)] = np.linalg.inv(J.T @ J / scatter + np.diag(sigma**-2))
    R = pose.R_catalogue_from_frame @ Rotation.from_rotvec(step[:3]).as_matrix()
    k1, k2, p1, p2 = map(float, pose.camera.distortion + step[4:])
    camera = replace(
        pose.camera,
        rad_per_px=pose.camera.rad_per_px * math.exp(step[3]),
        radial=k1,
        radial2=k2,
        tangential=(p1, p2),
    )
    return CameraPose(R, camera, covariance)
