r"""Whitened model: readings of dipoles in homogeneous coordinates, with unit noise.

Positions are :math:`q = (u, s)` on the unit sphere of :math:`R^4`, :math:`p = c + \rho_0 \, u / s` with the sensors'
centroid c and circumradius :math:`\rho_0`. Moments are :math:`\mu = k |s|^3 m / \rho_0^3`. So infinity (s = 0) is a
regular point: docs/theory/homogeneous-coordinates.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray
from arrays.whitening import Whitening
from magloc import core
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.measurement.channels import channels_of, signal_matrix_of
from magloc.measurement.known_moment import KnownMoment

# Largest squares, relative to noise, with negligible rounding errors; relative size of a column that counts as zero.
_MOST_SQUARES, _UNSEEN = 1e8, 1e-7


@dataclass(frozen=True, eq=False)
class ScaledSensors:
    """Sensors in units of the array's size, and their homogeneous coordinates.

    Attributes
    ----------
    centroid : ndarray, shape (3,)
        Centroid of the sensors in the array's frame [m].
    radius : float
        Largest distance of a sensor from the centroid [m].
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
        """Return homogeneous coordinates (..., 4), with unit norm and s > 0, of positions [m]."""
        rho = (np.asarray(position_m, dtype=np.float64) - self.centroid) / self.radius
        q = np.concatenate([rho, np.ones_like(rho[..., :1])], axis=-1)
        return q / np.linalg.norm(q, axis=-1, keepdims=True)

    def position(self, q: FloatArray) -> FloatArray:
        """Return positions (..., 3) [m] of coordinates q (..., 4); not finite at s = 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            position: FloatArray = self.centroid + self.radius * q[..., :3] / q[..., 3:]
        return position

    def moment(self, q: FloatArray, mu: FloatArray) -> FloatArray:
        """Return moments (..., 3) [A·m²] of scaled moments μ (..., 3) [T]; not finite at s = 0."""
        with np.errstate(divide="ignore", invalid="ignore"):
            moment: FloatArray = mu * (self.radius**3 / MU0_OVER_4PI) / np.abs(q[..., 3:]) ** 3
        return moment

    def state_unit(self, n_sources: int = 1) -> FloatArray:
        """Return the radius [m] and the unit of moments [A·m²] for (p₁, m₁, p₂, …), shape (6 K,)."""
        return np.tile(np.repeat([self.radius, self.radius**3 / MU0_OVER_4PI], 3), n_sources)

    def scaled_moment(self, q: FloatArray, moment_Am2: ArrayLike) -> FloatArray:
        """Return scaled moments (..., 3) [T], the inverse of :meth:`moment`."""
        return np.asarray(moment_Am2) * (MU0_OVER_4PI / self.radius**3) * np.abs(q[..., 3:]) ** 3


@dataclass(frozen=True, eq=False)
class WhitenedModel(ScaledSensors):
    """Geometry and whitening of b sets of readings of one array, scaled by the array's size.

    Attributes
    ----------
    channel_is_scalar : ndarray of bool, shape (C,)
    gain : ndarray, shape (b, C, 3)
        Channel gains divided by the noise; a scalar channel uses only the first number.
    ambient : ndarray, shape (b, N, 3)
        Ambient field at the sensors [T]; only scalar channels use it.
    basis : ndarray, shape (b, C, c)
        Orthonormal common field of the whitening.
    shrinkage : ndarray, shape (b, c)
    known : KnownMoment, optional
        Prior of every source's moment: additional measurements with unit variance.
    """

    channel_is_scalar: NDArray[np.bool_]
    gain: FloatArray
    ambient: FloatArray
    basis: FloatArray
    shrinkage: FloatArray
    known: KnownMoment | None = None

    @classmethod
    def of(cls, array: SensorArray, whitening: Whitening, ambient_T: FloatArray) -> WhitenedModel:
        """Return the model of b rows with ambient fields (b, N, 3).

        The whitening is one for all rows or one for each.
        """
        radius = array.circumradius or 1.0  # any length serves for a single sensor

        def of_rows(values: FloatArray, n_axes: int) -> FloatArray:
            return np.broadcast_to(values, (len(ambient_T), *values.shape[-n_axes:]))

        return cls(
            centroid=array.centroid,
            radius=radius,
            sensors=(array.positions - array.centroid) / radius,
            channel_sensor=array.channel_sensor.astype(np.intp),
            channel_is_scalar=array.channel_is_scalar,
            gain=of_rows(whitening.gain, 2),
            ambient=np.asarray(ambient_T, dtype=np.float64),
            basis=of_rows(whitening.basis, 2),
            shrinkage=of_rows(whitening.shrinkage, 1),
        )

    def __len__(self) -> int:
        return len(self.gain)

    @cached_property
    def sees_moduli(self) -> bool:
        """True if there are scalar channels."""
        return bool(self.channel_is_scalar.any())

    @property
    def shares_whitening(self) -> bool:
        """True if all rows share one whitening, which is stored once."""
        return len(self) == 1 or self.gain.strides[0] == self.basis.strides[0] == 0

    @property
    def shares_ambient(self) -> bool:
        """True if all rows share one ambient field, which is stored once."""
        return len(self) == 1 or self.ambient.strides[0] == 0

    @cached_property
    def ambient_signals(self) -> FloatArray:
        """Whitened readings without a source (b, C), or (1, C) if equal in all rows."""
        alone = self.rows(np.arange(min(1, len(self)))) if self.shares_whitening and self.shares_ambient else self
        return alone.predict(np.zeros(alone.ambient.shape))

    @cached_property
    def signal_matrix(self) -> FloatArray | None:
        """Matrix from whitened readings to the signals of kernels, if all rows share one; None if it is the unit."""
        return signal_matrix_of(self)

    @cached_property
    def channels(self) -> core.Problem:
        """Channels for the kernels of fits."""
        return channels_of(self)

    def rows(self, index: NDArray[np.intp]) -> WhitenedModel:
        """Return the model of some rows, which may be repeated."""

        def select(values: FloatArray) -> FloatArray:
            if values.strides[0] == 0:
                return np.broadcast_to(values[:1], (len(index), *values.shape[1:]))
            return values[index]

        return replace(
            self,
            gain=select(self.gain),
            ambient=select(self.ambient),
            basis=select(self.basis),
            shrinkage=select(self.shrinkage),
        )

    @property
    def has_kernels(self) -> bool:
        """True if the sources are dipoles, which kernels fit."""
        return True

    @property
    def is_even(self) -> bool:
        """True if moments m and -m give the same readings, as for moduli alone without an ambient field."""
        return bool(self.channel_is_scalar.all()) and not np.any(self.ambient)

    def without_ambient(self) -> WhitenedModel:
        """Return the model without an ambient field."""
        return replace(self, ambient=np.zeros_like(self.ambient))

    def whiten(self, channels: FloatArray) -> FloatArray:
        """Remove the common field from channels (b, C) or columns (b, C, n) of unit noise."""
        if channels.ndim == 2 and len(channels) and self.shares_whitening:
            basis = self.basis[0]
            return channels - (self.shrinkage[0] * (channels @ basis)) @ basis.T
        columns = channels if channels.ndim == 3 else channels[..., None]
        common = self.shrinkage[..., None] * (self.basis.transpose(0, 2, 1) @ columns)
        free: FloatArray = columns - self.basis @ common
        return free if channels.ndim == 3 else free[..., 0]

    def marginalise(self, columns: FloatArray) -> WhitenedModel:
        """Return the model with errors along columns (b, C, n) counted as noise.

        The errors have unit variance, the columns are in units of the noise.
        """
        flat, unknown = self.shrinkage >= 1.0, self.basis
        bounded = ~flat.all(axis=0)
        if bounded.any():
            # Columns that no row uses cost time, so they are omitted.
            with np.errstate(divide="ignore"):
                variance = np.where(flat, 0.0, 1.0 / (1.0 - self.shrinkage) ** 2 - 1.0)
            known = (unknown * np.sqrt(variance)[:, None])[..., bounded]
            unknown = (unknown * flat[:, None])[..., flat.any(axis=0)]
            flat = flat[:, flat.any(axis=0)]
        free = columns - unknown @ (unknown.transpose(0, 2, 1) @ columns)
        if bounded.any():
            free = np.concatenate([known, free], axis=2)
        basis, singular = _left_singular(free)
        shrinkage = 1.0 - 1.0 / np.sqrt(1.0 + singular**2)
        return replace(
            self,
            basis=np.concatenate([unknown, basis], axis=2),
            shrinkage=np.concatenate([flat.astype(np.float64), shrinkage], axis=1),
        )

    def source_fields(self, q: FloatArray, mu: FloatArray) -> FloatArray:
        """Return the summed field of all sources (b, K, ...) at the sensors, (b, N, 3) [T]."""
        n, inverse3 = self._directions(q)
        along = np.sum(n * mu[:, :, None], axis=-1, keepdims=True)
        return np.sum((3.0 * along * n - mu[:, :, None]) * inverse3, axis=1)

    def _directions(self, q: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return unit vectors from sources to sensors (b, K, N, 3), and inverse cubed distances."""
        v = q[:, :, None, 3:] * self.sensors - q[:, :, None, :3]
        r = np.sqrt(np.sum(v * v, axis=-1, keepdims=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            return v / r, 1.0 / r**3

    def predict(self, source_fields: FloatArray) -> FloatArray:
        """Return whitened predictions (b, C) for fields of the sources at the sensors (b, N, 3)."""
        channels = np.ascontiguousarray(np.sum(source_fields[:, self.channel_sensor] * self.gain, axis=-1))
        scalar = self.channel_is_scalar
        if scalar.any():
            owner = self.channel_sensor[scalar]
            total = source_fields[:, owner] + self.ambient[:, owner]
            channels[:, scalar] = self.gain[:, scalar, 0] * np.sqrt(np.sum(total * total, axis=-1))
        return self.whiten(channels)

    def residual(self, y: FloatArray, q: FloatArray, mu: FloatArray, source_fields: FloatArray) -> FloatArray:
        """Return residuals of whitened readings (b, C), followed by those of known moments."""
        of_readings = y - self.predict(source_fields)
        if self.known is None:
            return of_readings
        return np.concatenate([of_readings, self.known.residual(self.moment(q, mu))], axis=1)

    def known_jacobian(self, q: FloatArray, mu: FloatArray, tangent: FloatArray | None = None) -> FloatArray:
        """Return the derivative (b, K k, 3 K) of known moments by μ, or along tangents of q.

        Tangents are (b, K, 4, 3).
        """
        if self.known is None:
            return np.empty((len(q), 0, 3 * q.shape[1]))
        moment = self.moment(q, mu)
        of_moment = self.known.jacobian(moment)
        if tangent is None:
            columns = of_moment * self.moment(q, np.ones_like(mu))[..., None, :]
        else:
            along = np.sum(of_moment * moment[..., None, :], axis=-1, keepdims=True)
            columns = along * (-3.0 / q[..., 3:] * tangent[..., 3, :])[..., None, :]
        n_fits, n_sources, n_known, _ = columns.shape
        every = np.zeros((n_fits, n_sources, n_known, n_sources, 3))
        own = np.arange(n_sources)
        every[:, own, :, own] = columns.transpose(1, 0, 2, 3)
        return every.reshape(n_fits, n_sources * n_known, 3 * n_sources)

    def linear_gain(self, source_fields: FloatArray) -> FloatArray:
        """Return the gain (b, C, 3) of every channel for a small change of the field.

        A modulus has the direction of the total field.
        """
        scalar = self.channel_is_scalar
        if not scalar.any():
            return self.gain
        owner = self.channel_sensor[scalar]
        total = source_fields[:, owner] + self.ambient[:, owner]
        modulus = np.sqrt(np.sum(total * total, axis=-1, keepdims=True))
        gain = self.gain.copy()
        with np.errstate(divide="ignore", invalid="ignore"):
            gain[:, scalar] = self.gain[:, scalar, :1] * np.where(modulus > 0.0, total / modulus, 0.0)
        return gain

    def moment_jacobian(self, q: FloatArray, gain: FloatArray, mu: FloatArray | None = None) -> FloatArray:
        """Return the derivative (b, C, 3 K) of the predictions by μ, on which it does not depend for dipoles."""
        n, inverse3 = (x[:, :, self.channel_sensor] for x in self._directions(q))
        along = np.sum(n * gain[:, None], axis=-1, keepdims=True)
        columns = (3.0 * along * n - gain[:, None]) * inverse3
        return self.whiten(columns.transpose(0, 2, 1, 3).reshape(len(q), gain.shape[1], -1))

    def position_jacobian(self, q: FloatArray, mu: FloatArray, gain: FloatArray, tangent: FloatArray) -> FloatArray:
        """Return the derivative (b, C, 3 K) of the predictions along tangents (b, K, 4, 3) of q."""
        n, inverse3 = (x[:, :, self.channel_sensor] for x in self._directions(q))
        g, m = gain[:, None], mu[:, :, None]
        n_m, n_g = np.sum(n * m, axis=-1, keepdims=True), np.sum(n * g, axis=-1, keepdims=True)
        g_m = np.sum(g * m, axis=-1, keepdims=True)
        # g · dB/dv, and v = s x - u.
        with np.errstate(invalid="ignore"):
            slope = (3.0 * np.cbrt(inverse3) * inverse3) * (n_m * g + n_g * m + (g_m - 5.0 * n_m * n_g) * n)
        along_s = np.sum(slope * self.sensors[self.channel_sensor], axis=-1, keepdims=True)
        columns = np.concatenate([-slope, along_s], axis=-1) @ tangent
        return self.whiten(columns.transpose(0, 2, 1, 3).reshape(len(q), gain.shape[1], -1))


def _left_singular(columns: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return left singular vectors (b, C, k) and values (b, k) of columns (b, C, n).

    k is n or C. For a few columns that are not large, the squares of the columns are used; singular values that are
    rounding errors are then zero.
    """
    n = columns.shape[2]
    square = columns.transpose(0, 2, 1) @ columns if 2 * n < columns.shape[1] else np.array(np.inf)
    if not square.max(initial=0.0) < _MOST_SQUARES:
        basis, singular, _ = np.linalg.svd(columns, full_matrices=False)
        return basis, singular
    basis = columns @ np.linalg.eigh(square)[1]
    singular = np.sqrt(np.einsum("bcn,bcn->bn", basis, basis))
    singular = np.where(singular > _UNSEEN * singular.max(axis=1, keepdims=True, initial=0.0), singular, 0.0)
    basis *= np.where(singular > 0.0, 1.0 / np.where(singular > 0.0, singular, 1.0), 0.0)[:, None]
    return basis, singular
