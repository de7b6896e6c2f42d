r"""One dipole as a separable least-squares problem: the search is over the position alone.

For a source at p the field is linear in the moment, so the best moment of every p is a 3-column least-squares problem
and what remains is a function of three unknowns (variable projection). They are written as homogeneous coordinates
:math:`q = (u, s)` on the unit sphere of :math:`R^4`,

.. math:: p = c + \rho_0 \, u / s,

with the sensors' centroid c and circumradius :math:`\rho_0`. With the sensors scaled to :math:`x_i = (s_i - c)/\rho_0`,
:math:`v_i = s x_i - u`, the field of the moment m at sensor i is :math:`a(v_i) \mu`, where
:math:`a(v) = (3 n n^T - I)/|v|^3` and :math:`\mu = k |s|^3 m / \rho_0^3`. Infinity (s = 0) is an ordinary point, passed
smoothly, where (p, m) turns into (-p, -m): the two fit alike to first order, and only the finite size of the array
tells them apart.

This module is the readable form, and the reference that tests hold :mod:`magloc.kernels.separable` against.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.differences import Whitening
from arrays.sensor import SensorArray
from magloc.dipole import MU0_OVER_4PI

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ScaledSensors:
    """Sensors in units of their array's size, and what homogeneous coordinates mean there.

    Attributes
    ----------
    centroid : ndarray, shape (3,)
        Sensors' centroid [m], array frame.
    radius : float
        Largest distance of a sensor from it [m].
    sensors : ndarray, shape (N, 3)
        Sensors relative to the centroid, in radii.
    channel_sensor : ndarray of int, shape (C,)
        Sensor of every channel.
    """

    centroid: FloatArray
    radius: float
    sensors: FloatArray
    channel_sensor: NDArray[np.intp]

    def homogeneous(self, position_m: ArrayLike) -> FloatArray:
        """Homogeneous coordinates (..., 4), of unit norm and s > 0, of positions (..., 3) [m]."""
        rho = (np.asarray(position_m, dtype=np.float64) - self.centroid) / self.radius
        q = np.concatenate([rho, np.ones_like(rho[..., :1])], axis=-1)
        unit: FloatArray = q / np.linalg.norm(q, axis=-1, keepdims=True)
        return unit

    def position(self, q: FloatArray) -> FloatArray:
        """Positions (..., 3) [m] of homogeneous coordinates (..., 4); not finite at s = 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            position: FloatArray = self.centroid + self.radius * q[..., :3] / q[..., 3:]
        return position

    def moment(self, q: FloatArray, mu: FloatArray) -> FloatArray:
        """Moments (..., 3) [A·m²] of scaled moments μ (..., 3) [T] at q (..., 4); not finite at s = 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            moment: FloatArray = mu * (self.radius**3 / MU0_OVER_4PI) / np.abs(q[..., 3:]) ** 3
        return moment

    def scaled_moment(self, q: FloatArray, moment_Am2: ArrayLike) -> FloatArray:
        """The inverse of :meth:`moment`."""
        mu: FloatArray = np.asarray(moment_Am2) * (MU0_OVER_4PI / self.radius**3) * np.abs(q[..., 3:]) ** 3
        return mu


@dataclass(frozen=True, eq=False)
class SeparableProblem(ScaledSensors):
    """Geometry and noise of one set of channels, scaled for the search.

    Attributes
    ----------
    whitening : Whitening
    gain : ndarray, shape (C, 3)
        Channel gains in channels of unit noise; zero rows where readings are missing.
    """

    whitening: Whitening
    gain: FloatArray

    @classmethod
    def of(cls, array: SensorArray, whitening: Whitening) -> SeparableProblem:
        """Problem of an array of vector sensors under a whitening of its channels."""
        return cls(
            centroid=array.centroid,
            radius=array.circumradius,
            sensors=(array.positions - array.centroid) / array.circumradius,
            channel_sensor=array.channel_sensor.astype(np.intp),
            whitening=whitening,
            gain=whitening.root @ array.channel_gain,
        )

    def unit_basis(self, q: FloatArray) -> FloatArray:
        """Whitened readings of the three unit scaled moments at q (..., 4): shape (..., C, 3)."""
        v = q[..., None, 3:] * self.sensors - q[..., None, :3]
        r = np.linalg.norm(v, axis=-1, keepdims=True)
        n = (v / r)[..., self.channel_sensor, :]
        along = np.sum(n * self.gain, axis=-1, keepdims=True)
        rows = (3.0 * along * n - self.gain) / r[..., self.channel_sensor, :] ** 3
        return self._free_of_common_field(rows)

    def _free_of_common_field(self, rows: FloatArray) -> FloatArray:
        common = self.whitening.basis
        free: FloatArray = rows - (common * self.whitening.shrinkage) @ (common.T @ rows)
        return free

    def projected_chi2(self, q: FloatArray, y: FloatArray) -> FloatArray:
        """χ² of whitened readings y (..., C) with the best moment at q (..., 4)."""
        orthonormal = np.linalg.qr(self.unit_basis(q)).Q
        residual: FloatArray = y - np.einsum("...cj,...c,...dj->...d", orthonormal, y, orthonormal)
        chi2: FloatArray = np.einsum("...c,...c->...", residual, residual)
        return chi2

    def best_moment(self, q: FloatArray, y: FloatArray) -> FloatArray:
        """Scaled moment (3,) that fits whitened readings y (C,) best at q (4,)."""
        mu: FloatArray = np.asarray(np.linalg.lstsq(self.unit_basis(q), y, rcond=None)[0], dtype=np.float64)
        return mu


def fibonacci_directions(n: int) -> FloatArray:
    """Nearly uniform unit vectors, shape (n, 3), on a Fibonacci spiral."""
    i = np.arange(n) + 0.5
    z = 1.0 - 2.0 * i / n
    azimuth = np.pi * (1.0 + np.sqrt(5.0)) * i
    in_plane = np.sqrt(1.0 - z * z)
    return np.stack([in_plane * np.cos(azimuth), in_plane * np.sin(azimuth), z], axis=-1)


def candidate_positions(
    array: SensorArray,
    *,
    n_directions: int = 200,
    n_ranges: int = 10,
    n_near_directions: int = 12,
) -> FloatArray:
    """Positions that a search scores before it refines the best of them.

    Directions times geometric ranges of 0.6 to 60 circumradii around the centroid, and shells of 0.35, 0.7 and 1.4
    times the distance of the next sensor around every sensor, for sources close to a large array.

    Parameters
    ----------
    array : SensorArray
    n_directions, n_ranges : int
        Size of the outer grid.
    n_near_directions : int
        Directions of the shells around the sensors.

    Returns
    -------
    ndarray, shape (n, 3)
        Positions in the array's frame [m].
    """
    ranges = array.circumradius * np.geomspace(0.6, 60.0, n_ranges)
    outer = array.centroid + (ranges[:, None, None] * fibonacci_directions(n_directions)).reshape(-1, 3)
    distances = np.linalg.norm(array.positions[:, None] - array.positions, axis=-1)
    np.fill_diagonal(distances, np.inf)
    shells = distances.min(axis=1)[:, None] * np.array([0.35, 0.7, 1.4])
    offsets = shells[:, :, None, None] * fibonacci_directions(n_near_directions)
    near = (array.positions[:, None, None] + offsets).reshape(-1, 3)
    return np.concatenate([outer, near])
