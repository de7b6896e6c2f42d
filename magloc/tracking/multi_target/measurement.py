"""Measurement model of one row for several sources and the common field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.fields import dipole
from magloc.localization.search.candidates import candidate_positions
from magloc.measurement.rows import ambient_fields, channels_above_ambient, whitenings_of
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.rows import Row, Rows

# Size of the cache of whitenings by available channels.
_MOST_MASKS = 16


@dataclass(frozen=True, eq=False)
class JointRow:
    """One row of vector sensors, in units of its noise; channels without a reading are zero.

    Attributes
    ----------
    array : SensorArray
    row : Row
        The row, with the array's pose.
    z : ndarray, shape (C,)
        Whitened readings minus those of the known ambient field.
    transform : ndarray, shape (C, C)
        Matrix from channels to whitened readings.
    used : ndarray of bool, shape (C,)
    """

    array: SensorArray
    row: Row
    z: FloatArray
    transform: FloatArray
    used: BoolArray

    @classmethod
    def of(cls, array: SensorArray, row: Row, root: FloatArray | None = None) -> JointRow:
        """Return a row with all of its readings; `root` (C, C) is their whitening, if already known."""
        used = row.available
        root = whitenings_of(array, used, row.readings_T).root if root is None else root
        ambient = ambient_fields(array, 1, None if row.ambient_T is None else row.ambient_T[None])
        above = channels_above_ambient(array, used, row.readings_T[None], ambient)[0]
        return cls(array, row, root @ above, root, used)

    @property
    def n_readings(self) -> int:
        """Number of channels that are used."""
        return int(np.count_nonzero(self.used))

    @cached_property
    def effect(self) -> FloatArray:
        """Effect (C, 3) of the common field in the world frame [1/T]."""
        return np.asarray(self.transform @ self.array.channel_gain @ self.row.R_world_from_array.T)

    @cached_property
    def positions_m(self) -> FloatArray:
        """Positions (N, 3) of the sensors in the world."""
        return np.asarray(self.row.origin_m + self.array.positions @ self.row.R_world_from_array.T)

    @cached_property
    def centroid_m(self) -> FloatArray:
        """Centroid (3,) of the sensors in the world."""
        return np.asarray(self.row.origin_m + self.row.R_world_from_array @ self.array.centroid)

    @cached_property
    def kernel_rows(self) -> Rows:
        """The row as an argument of kernels."""
        return stack_joint_rows([self])

    def without(self, out: BoolArray) -> JointRow:
        """Return the row without some of the sensors (N,)."""
        if not out.any():
            return self
        used = self.used & ~out[self.array.channel_sensor]
        z, transform = np.where(used, self.z, 0.0), np.where(used[:, None], self.transform, 0.0)
        return replace(self, z=z, transform=transform, used=used)

    def linearise(self, state: JointState) -> tuple[FloatArray, FloatArray]:
        """Return derivatives (K, C, 6) by each source, and the predicted readings (C,)."""
        by_source = dipole.field_jacobian(self.positions_m, state.position_m[:, None], state.moment_Am2[:, None])
        sensor, gain = self.array.channel_sensor, self.array.channel_gain @ self.row.R_world_from_array.T
        H = self.transform @ (gain[None, :, None] @ by_source[:, sensor])[:, :, 0]
        h = np.sum(H[..., 3:] @ state.moment_Am2[:, :, None], axis=0)[:, 0]
        return H, h + self.effect @ state.common_T

    def energy_of(self, position_m: FloatArray, moment_Am2: FloatArray) -> FloatArray:
        """Return the energy (N,) of a source's readings in each sensor."""
        fields = dipole.field(self.positions_m, position_m, moment_Am2)[self.array.channel_sensor]
        channel_energy = np.vecdot(self.effect, fields) ** 2
        energy: FloatArray = np.bincount(self.array.channel_sensor, channel_energy).astype(np.float64)
        return energy


def stack_joint_rows(rows: Sequence[JointRow]) -> Rows:
    """Return rows of one array as an argument of kernels."""
    array = rows[0].array
    return Rows.stack(array, rows, np.zeros((1, array.n_sensors, 3)))


@dataclass(frozen=True, eq=False)
class Cells:
    """Grid of places for a further source, with the readings of a dipole at each.

    Attributes
    ----------
    position_m : ndarray, shape (n, 3)
        Positions in the array's frame.
    columns : ndarray, shape (n, C, 3)
        Readings of unit moments at each cell.
    bases : ndarray, shape (C, 3 n)
        Orthonormal bases of `columns` with the common field projected out, ordered by axis, then by cell.
    near : ndarray of bool, shape (n, n)
        Cells nearer to each than half its distance from the array's centre.
    """

    position_m: FloatArray
    columns: FloatArray
    bases: FloatArray
    near: BoolArray

    @classmethod
    def of(cls, array: SensorArray, root: FloatArray) -> Cells:
        """Return the cells of rows whose channels are whitened by a root (C, C)."""
        positions = candidate_positions(
            array, n_directions=60, ranges=np.geomspace(0.6, 60.0, 10), n_near_directions=4, n_inner_directions=0
        )
        gain = root @ array.channel_gain
        common, size, _ = np.linalg.svd(gain, full_matrices=False)
        common = common[:, size > 1e-10 * size.max(initial=0.0)]
        fields = dipole.field_matrix(array.positions, positions[:, None])[:, array.channel_sensor]
        columns = (gain[None, :, None] @ fields)[:, :, 0]
        bases, _ = np.linalg.qr(columns - common @ (common.T @ columns))
        from_centre = positions - positions.mean(axis=0)
        square = np.vecdot(from_centre, from_centre)
        near = square[:, None] + square - 2.0 * from_centre @ from_centre.T < 0.25 * square[:, None]
        return cls(positions, columns, bases.transpose(1, 2, 0).reshape(len(gain), -1).astype(np.float32), near)

    def energy(self, residual: FloatArray) -> FloatArray:
        """Return the energy (n,) of residuals (C,) explained by each cell, χ² of 3 dimensions."""
        components = (residual.astype(np.float32) @ self.bases).reshape(3, -1)
        energy: FloatArray = np.sum(np.square(components), axis=0, dtype=np.float64)
        return energy

    def moment(self, cell: int, innovation: FloatArray, projector: FloatArray, used: BoolArray) -> FloatArray:
        """Return the best moment (3,) of a source in a cell, in the array's frame.

        The inverse of the innovation's covariance is I - Qᵀ Q, with Q = `projector` (d, C).
        """
        A = self.columns[cell] * used[:, None]
        A = np.concatenate([A, innovation[:, None]], axis=1)
        of_errors = projector @ A
        left = A[:, :3].T @ A - of_errors[:, :3].T @ of_errors
        found: FloatArray = np.linalg.lstsq(left[:, :3], left[:, 3], rcond=None)[0]
        return found

    def best(self, energy: FloatArray, n: int) -> IntArray:
        """Return the `n` cells of most energy that are not near to each other."""
        left, chosen = energy.copy(), []
        for _ in range(n):
            chosen.append(int(np.argmax(left)))
            left[self.near[chosen[-1]]] = -1.0
        return np.array(chosen, dtype=np.intp)


class Channels:
    """Cache of whitenings and cells of an array's rows, by available channels."""

    def __init__(self, array: SensorArray) -> None:
        self.array = array
        self._known: dict[bytes, tuple[FloatArray, Cells]] = {}
        if not array.noise_depends_on_reading:  # so that the first row is not delayed
            self.of(Row(0.0, np.zeros(array.n_channels)))

    def of(self, row: Row) -> tuple[FloatArray, Cells]:
        """Return whitening (C, C) and cells of a row.

        If the noise depends on the readings, they are taken from the first row with the same channels.
        """
        key = row.available.tobytes()
        if key not in self._known:
            if len(self._known) == _MOST_MASKS:
                self._known.clear()
            root = whitenings_of(self.array, row.available, row.readings_T).root
            self._known[key] = root, Cells.of(self.array, root)
        return self._known[key]

    def joint_row(self, row: Row) -> JointRow:
        """Return the measurement model of a row with all of its readings."""
        return JointRow.of(self.array, row, None if self.array.noise_depends_on_reading else self.of(row)[0])
