"""Cramér-Rao bounds of the pose of a body over the limits of its motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import body_fields
from magloc.bodies.fit import linearise
from magloc.bodies.locator import with_offsets_as_noise
from magloc.bodies.optima import inverses
from magloc.bodies.plausibility import check_lengths
from magloc.bodies.search import spread_poses
from magloc.bodies.symmetry import body_symmetry
from magloc.levels import TYPICAL_AND_BAD
from magloc.measurement.rows import check_magnitudes, whitened_rows

N_POSES = 1000
"""Poses over which bounds are taken."""


@dataclass(frozen=True, eq=False)
class BodyBounds:
    """Bounds of the pose in a single row, over n poses that are spread over the limits of the body.

    Attributes
    ----------
    position_m : ndarray, shape (n, 3)
    R : ndarray, shape (n, 3, 3)
    covariance : ndarray, shape (n, 6, 6)
        Bound of the covariance of (δx [m], δθ [rad]), δθ in the body's frame; NaN where the pose is not determined.
    symmetry : str
        Sentence about the symmetry of the body; empty without one.
    """

    position_m: FloatArray
    R: FloatArray
    covariance: FloatArray
    symmetry: str

    @property
    def sigma_position_m(self) -> FloatArray:
        """Largest standard deviation of the position along any direction (n,); infinite if undetermined."""
        return _largest(self.covariance[:, :3, :3])

    @property
    def sigma_rotation_rad(self) -> FloatArray:
        """Largest standard deviation of the rotation about any axis (n,); infinite if undetermined."""
        return _largest(self.covariance[:, 3:, 3:])

    def json(self) -> dict[str, object]:
        """Return the medians, 95 % quantiles and the worst values for JSON."""
        result: dict[str, object] = {"poses": len(self.position_m)}
        result["determined_fraction"] = float(np.isfinite(self.sigma_position_m).mean())
        for name, values in (
            ("sigma_position_m", self.sigma_position_m),
            ("sigma_rotation_deg", np.degrees(self.sigma_rotation_rad)),
        ):
            median, bad = np.quantile(values, TYPICAL_AND_BAD, method="inverted_cdf").tolist()
            result[name] = {"median": median, "q95": bad, "worst_sampled": float(values.max())}
        return result | ({"symmetry": self.symmetry} if self.symmetry else {})

    def lines(self) -> list[str]:
        """Return the lines that ``magloc bounds --body`` prints."""
        lines = [f"{len(self.position_m)} poses within the limits of the body, largest standard deviation of a row"]
        for name, values, per in (
            ("position [mm]", self.sigma_position_m, 1e3),
            ("rotation [deg]", self.sigma_rotation_rad, 180.0 / np.pi),
        ):
            median, bad = (per * np.quantile(values, TYPICAL_AND_BAD, method="inverted_cdf")).tolist()
            lines.append(f"{name:15s} median {median:.4g}, 95 % of poses {bad:.4g}, worst {per * values.max():.4g}")
        return lines + ([self.symmetry] if self.symmetry else [])


def body_bounds(array: SensorArray, body: MagnetBody, n: int = N_POSES) -> BodyBounds:
    """Return the bounds of a body's pose over its limits; stated errors of the magnets count as noise.

    Parameters
    ----------
    array : SensorArray
        Sensors with their noise and stated errors.
    body : MagnetBody
        Magnets, their stated errors, and the limits of the pose.
    n : int
        Number of poses.

    Returns
    -------
    BodyBounds
        Poses in the array's frame, with the bound of each; infinite where the pose is not determined.

    Raises
    ------
    ValueError
        The array's noise, common field or ambient field is out of range.
    """
    check_magnitudes(array)
    check_lengths(array, body)
    used = with_offsets_as_noise(array)
    position_m, R = spread_poses(body, used, n)
    return BodyBounds(position_m, R, pose_covariances(used, body, position_m, R), body_symmetry(body).words)


def pose_covariances(array: SensorArray, body: MagnetBody, position_m: FloatArray, R: FloatArray) -> FloatArray:
    """Return the bounds (n, 6, 6) of :class:`BodyBounds` at poses; errors of the magnets count as noise."""
    readings = array.readings_of(array.ambient_fields + body_fields(body, array.positions, position_m, R))
    covariance = np.full((len(R), 6, 6), np.nan)
    outside = np.flatnonzero(np.isfinite(readings).all(axis=1))  # a sensor inside a magnet has no reading
    for rows in whitened_rows(array, readings[outside], None, len(R)):
        index = outside[rows.index]
        _, jacobian, errors = linearise(rows.model, body, position_m[index], R[index])
        if errors.shape[-1]:
            rows = rows.marginalise(errors)
            _, jacobian, _ = linearise(rows.model, body, position_m[index], R[index])
        covariance[index] = inverses(jacobian)
    return covariance


def _largest(covariance: FloatArray) -> FloatArray:
    """Return the root of the largest eigenvalue (n,) of covariances (n, 3, 3)."""
    valid = np.isfinite(covariance).all(axis=(1, 2))
    largest = np.full(len(covariance), np.inf)
    largest[valid] = np.sqrt(np.linalg.eigvalsh(covariance[valid])[:, -1])
    return largest
