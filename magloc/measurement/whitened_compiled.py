"""Compiled whitened model of one dipole.

The readable twin is :mod:`magloc.measurement.whitened`.

The source is (u, s) on the unit sphere of R⁴: position = centroid + radius · u / s. Infinity (s = 0) and the centroid
(u = 0) are ordinary points of it, and (u, s), (-u, -s) the same source. Arrays are transposed against the twin,
(component, channel), so that the inner loops run over contiguous channels.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, internal, own
from magloc.linalg_compiled import dot, orthonormalise

if TYPE_CHECKING:
    from magloc.measurement.whitened import ScaledSensors, WhitenedModel

# |s| stays above this: below it the differences lose their digits, and no array resolves a range of 10⁵ radii.
SMALLEST_S = 1e-5


class Units(NamedTuple):
    """Where radii begin (3,) [m], how long they are [m], and what a scaled moment at s = 1 is worth [A·m²]."""

    centroid: FloatArray
    radius: float
    moment: float


class ModelRow(NamedTuple):
    """Whitened channels of one row: their sensors, gains (c, 3), common field (q, c), shrinkage (q,)."""

    sensors: FloatArray
    channel_sensor: NDArray[np.intp]
    gain: FloatArray
    common: FloatArray
    shrinkage: FloatArray

    @classmethod
    def of(cls, scaled: ScaledSensors, gain: FloatArray, basis: FloatArray, shrinkage: FloatArray) -> ModelRow:
        """From a whitening's basis (c, q) in the order of the twin."""
        return cls(scaled.sensors, scaled.channel_sensor, *map(own, (gain, basis.T, shrinkage)))


class ModelRows(NamedTuple):
    """Whitened channels of many rows: b sets of gains (b, c, 3), common fields and shrinkages, and the set of a row."""

    sensors: FloatArray
    channel_sensor: NDArray[np.intp]
    gain: FloatArray
    common: FloatArray
    shrinkage: FloatArray
    set_of_row: NDArray[np.intp]

    @classmethod
    def of(cls, model: WhitenedModel) -> ModelRows:
        """All rows of a model; the common field is transposed, so that inner loops run over contiguous channels."""
        sets = slice(0, 1) if model.shares_whitening else slice(None)
        return cls(
            model.sensors,
            model.channel_sensor,
            own(model.gain[sets]),
            own(model.basis[sets].transpose(0, 2, 1)),
            own(model.shrinkage[sets]),
            np.zeros(len(model), dtype=np.intp) if model.shares_whitening else np.arange(len(model), dtype=np.intp),
        )


class LaneModel(NamedTuple):
    """Whitened channels of many rows in threes, those of a sensor, for kernels that fit many starts side by side.

    Sensors (s, 3); of every set gains (sets, s, 9) and, in threes too, orthonormal common fields (sets, t, s, 9); the
    set of a row. A channel that is not there is zero. A prior of the common field is readings of it, so that taking
    that out is a projection, whatever is known of it. It is unknown where there is none, and nothing else is taken out.
    """

    sensors: FloatArray
    gain: FloatArray
    common: FloatArray
    set_of_row: NDArray[np.intp]
    is_unknown: bool

    @classmethod
    def of(cls, model: WhitenedModel) -> LaneModel:
        """All rows of a model."""
        sets = slice(0, 1) if model.shares_whitening else slice(None)
        basis, shrinkage = model.basis[sets], model.shrinkage[sets]
        n_sets, n_channels, n_common = basis.shape
        place, known, n_sensors = model.threes
        n_triples = -(-n_common // 3)
        at: slice | NDArray[np.intp] = slice(n_channels) if n_channels == 3 * len(model.sensors) else place
        gain = np.zeros((n_sets, 3 * n_sensors, 3))
        gain[:, at] = model.gain[sets]
        projected = np.zeros((n_sets, n_channels, 3 * n_triples))
        np.multiply(basis, np.sqrt(shrinkage * (2.0 - shrinkage))[:, None], out=projected[..., :n_common])
        common = np.zeros((n_sets, n_triples, 3 * n_sensors, 3))
        by_channel = common.transpose(0, 2, 1, 3)
        by_channel[:, at] = projected.reshape(n_sets, n_channels, n_triples, 3)
        of_prior = 3 * len(model.sensors) + np.arange(known.size)
        by_channel[:, of_prior, known // 3, known % 3] = 1.0 - shrinkage[:, known]
        return cls(
            own(np.concatenate([model.sensors, np.tile(model.sensors[:1], (n_sensors - len(model.sensors), 1))])),
            gain.reshape(n_sets, n_sensors, 9),
            common.reshape(n_sets, n_triples, n_sensors, 9),
            np.zeros(len(model), dtype=np.intp) if n_sets == 1 else np.arange(len(model), dtype=np.intp),
            n_common == 3 and known.size == 0,
        )


def signals(model: WhitenedModel, y: FloatArray) -> FloatArray:
    """Whitened readings (b, C) as those of a :class:`LaneModel`: (b, s, 3)."""
    place, known, n_sensors = model.threes
    if y.shape[1] == 3 * n_sensors:
        return np.ascontiguousarray(y).reshape(len(y), n_sensors, 3)
    result = np.zeros((len(y), 3 * n_sensors))
    if not known.size:
        result[:, place] = y
        return result.reshape(len(y), n_sensors, 3)
    last = int(known[-1]) + 1
    of_known = slice(last - known.size, last) if last - known[0] == known.size else known
    basis, shrinkage = model.basis[..., of_known], model.shrinkage[:, of_known]
    along = (y[:, None] @ basis)[:, 0]
    result[:, place] = y - (basis @ (shrinkage * along)[..., None])[..., 0]
    result[:, 3 * len(model.sensors) + np.arange(known.size)] = -np.sqrt(shrinkage * (2.0 - shrinkage)) * along
    return result.reshape(len(y), n_sensors, 3)


@compiled
def row_at(rows: ModelRows, i: int) -> ModelRow:
    """Row i of many."""
    w = rows.set_of_row[i]
    return ModelRow(rows.sensors, rows.channel_sensor, rows.gain[w], rows.common[w], rows.shrinkage[w])


@internal
def project_common(rows: FloatArray, n_rows: int, row: ModelRow) -> None:
    """Remove the common field from whitened rows (k, c) in place."""
    common, shrinkage = row.common, row.shrinkage
    for j in range(n_rows):
        for k in range(shrinkage.size):
            t = shrinkage[k] * dot(common[k], rows[j])
            for c in range(rows.shape[1]):
                rows[j, c] -= t * common[k, c]


@compiled
def unit_basis(
    q: FloatArray,
    row: ModelRow,
    basis: FloatArray,
) -> None:
    """Whitened readings of the three unit moments at q, into basis (3, c)."""
    unit_readings(q, row, basis)
    project_common(basis, 3, row)


@internal
def unit_readings(
    q: FloatArray,
    row: ModelRow,
    basis: FloatArray,
) -> None:
    """:func:`unit_basis` before the common field is removed."""
    sensors, channel_sensor, gain = row.sensors, row.channel_sensor, row.gain
    last = -1
    n0 = n1 = n2 = r3 = 0.0
    for c in range(channel_sensor.size):
        i = channel_sensor[c]
        if i != last:
            v0 = q[3] * sensors[i, 0] - q[0]
            v1 = q[3] * sensors[i, 1] - q[1]
            v2 = q[3] * sensors[i, 2] - q[2]
            inverse = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            n0, n1, n2 = v0 * inverse, v1 * inverse, v2 * inverse
            r3 = inverse * inverse * inverse
            last = i
        g0, g1, g2 = gain[c, 0], gain[c, 1], gain[c, 2]
        t = 3.0 * (n0 * g0 + n1 * g1 + n2 * g2)
        basis[0, c] = (t * n0 - g0) * r3
        basis[1, c] = (t * n1 - g1) * r3
        basis[2, c] = (t * n2 - g2) * r3


@compiled
def homogeneous_jacobian(
    q: FloatArray,
    mu: FloatArray,
    row: ModelRow,
    jacobian: FloatArray,
) -> None:
    """Derivative of the readings of the scaled moment mu along (u, s), before the common field is removed: (4, c)."""
    sensors, channel_sensor, gain = row.sensors, row.channel_sensor, row.gain
    last = -1
    n0 = n1 = n2 = r4 = nm = 0.0
    for c in range(channel_sensor.size):
        i = channel_sensor[c]
        if i != last:
            v0 = q[3] * sensors[i, 0] - q[0]
            v1 = q[3] * sensors[i, 1] - q[1]
            v2 = q[3] * sensors[i, 2] - q[2]
            inverse = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            n0, n1, n2 = v0 * inverse, v1 * inverse, v2 * inverse
            r4 = 3.0 * inverse * inverse * inverse * inverse
            nm = n0 * mu[0] + n1 * mu[1] + n2 * mu[2]
            last = i
        g0, g1, g2 = gain[c, 0], gain[c, 1], gain[c, 2]
        ng = n0 * g0 + n1 * g1 + n2 * g2
        mg = mu[0] * g0 + mu[1] * g1 + mu[2] * g2
        along = mg - 5.0 * nm * ng
        w0 = (nm * g0 + along * n0 + ng * mu[0]) * r4
        w1 = (nm * g1 + along * n1 + ng * mu[1]) * r4
        w2 = (nm * g2 + along * n2 + ng * mu[2]) * r4
        jacobian[0, c] = -w0
        jacobian[1, c] = -w1
        jacobian[2, c] = -w2
        jacobian[3, c] = w0 * sensors[i, 0] + w1 * sensors[i, 1] + w2 * sensors[i, 2]


@compiled
def candidate_bases(
    begin: int,
    end: int,
    candidates: FloatArray,
    row: ModelRow,
    bases: FloatArray | NDArray[np.float32],
) -> None:
    """Orthonormal whitened bases (c, 3, n) of candidate positions q (n, 4), begin to end."""
    n_channels = row.channel_sensor.size
    triangle, basis = np.zeros((3, 3)), np.empty((3, n_channels))
    for i in range(begin, end):
        unit_basis(candidates[i], row, basis)
        orthonormalise(basis, triangle)
        for c in range(n_channels):
            for axis in range(3):
                bases[c, axis, i] = basis[axis, c]
