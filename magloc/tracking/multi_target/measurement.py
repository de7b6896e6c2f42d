"""What one row of readings says of several sources and the common field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.fields import dipole
from magloc.localization.search.candidates import candidate_positions
from magloc.measurement.rows import ambient_fields, channels_above_ambient, whitenings_of
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN, JointState
from magloc.tracking.results import Row

# Sets of channels that are kept: rows miss the same ones more often than not.
_MOST_MASKS = 16


@dataclass(frozen=True, eq=False)
class JointRow:
    """One row of vector sensors, in units of its noise; channels without a reading are zero.

    Attributes
    ----------
    z : ndarray, shape (C,)
        Readings above the known ambient field.
    gain : ndarray, shape (C, 3)
        Of the field in the world frame [1/T].
    positions_m : ndarray, shape (N, 3)
        Of the sensors in the world.
    channel_sensor : ndarray of int, shape (C,)
    used : ndarray of bool, shape (C,)
    """

    z: FloatArray
    gain: FloatArray
    positions_m: FloatArray
    channel_sensor: IntArray
    used: BoolArray

    @classmethod
    def of(cls, array: SensorArray, row: Row, root: FloatArray | None = None) -> JointRow:
        """A row with all of its readings; `root` (C, C) is their whitening, where that is known already."""
        used = row.available
        root = whitenings_of(array, used, row.readings_T).root if root is None else root
        ambient = ambient_fields(array, 1, None if row.ambient_T is None else row.ambient_T[None])
        above = channels_above_ambient(array, used, row.readings_T[None], ambient)[0]
        R = row.R_world_from_array
        gain = root @ array.channel_gain @ R.T
        return cls(root @ above, gain, row.origin_m + array.positions @ R.T, array.channel_sensor, used)

    @property
    def n_readings(self) -> int:
        """Channels that are used."""
        return int(np.count_nonzero(self.used))

    @cached_property
    def problem(self) -> core.Problem:
        """Struct that describes the row to the kernels."""
        return rows_problem(self.z, self.gain, self.positions_m, self.channel_sensor)

    def without(self, out: BoolArray) -> JointRow:
        """The row without some of the sensors (N,)."""
        if not out.any():
            return self
        used = self.used & ~out[self.channel_sensor]
        return replace(self, z=np.where(used, self.z, 0.0), gain=np.where(used[:, None], self.gain, 0.0), used=used)

    def predicted(self, state: JointState) -> tuple[FloatArray, FloatArray]:
        """Predicted channels (C,), and their derivatives (C, 6 K + 3) by (p, m) of every source and the common field.

        The moments' derivatives are Cartesian.
        """
        k = state.n_sources
        by_source = dipole.field_jacobian(self.positions_m, state.position_m[:, None], state.moment_Am2[:, None])
        fields = state.common_T + np.sum(by_source[..., 3:] @ state.moment_Am2[:, None, :, None], axis=0)[..., 0]
        H = np.empty((len(self.z), N_SEEN * k + N_COMMON))
        of_sources = self.gain[None, :, None] @ by_source[:, self.channel_sensor]
        H[:, :-N_COMMON] = of_sources[:, :, 0].transpose(1, 0, 2).reshape(len(self.z), N_SEEN * k)
        H[:, -N_COMMON:] = self.gain
        return np.vecdot(self.gain, fields[self.channel_sensor]), H

    def energy_of(self, position_m: FloatArray, moment_Am2: FloatArray) -> FloatArray:
        """Energy (N,) of a source in each sensor."""
        fields = dipole.field(self.positions_m, position_m, moment_Am2)[self.channel_sensor]
        energy: FloatArray = np.bincount(self.channel_sensor, np.vecdot(self.gain, fields) ** 2).astype(np.float64)
        return energy


def rows_problem(z: FloatArray, gain: FloatArray, positions_m: FloatArray, channel_sensor: IntArray) -> core.Problem:
    """Describe rows to the kernels; z (C,) is one row, z (n, C) are several."""
    return core.problem(
        "joint_rows",
        n_rows=len(z) if z.ndim > 1 else 1,
        n_sensors=positions_m.shape[-2],
        n_channels=z.shape[-1],
        readings=np.ascontiguousarray(z),
        gain=np.ascontiguousarray(gain),
        sensors=np.ascontiguousarray(positions_m),
        sensor=np.ascontiguousarray(channel_sensor, dtype=np.int64),
    )


@dataclass(frozen=True, eq=False)
class Cells:
    """Places where another source may be, and what it could explain there.

    Attributes
    ----------
    position_m : ndarray, shape (n, 3)
        In the array's frame.
    columns : ndarray, shape (n, C, 3)
        Readings of unit moments at each of them.
    bases : ndarray, shape (C, 3 n)
        Orthonormal ones, the common field projected out: by axis, then by cell.
    near : ndarray of bool, shape (n, n)
        Which cells are nearer to one than half its distance from the array's centre.
    """

    position_m: FloatArray
    columns: FloatArray
    bases: FloatArray
    near: BoolArray

    @classmethod
    def of(cls, array: SensorArray, root: FloatArray) -> Cells:
        """Cells of rows whose channels are whitened by a root (C, C)."""
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
        """Energy (n,) of residuals (C,) that a source at each cell explains: χ² with three degrees of freedom."""
        components = (residual.astype(np.float32) @ self.bases).reshape(3, -1)
        energy: FloatArray = np.sum(np.square(components), axis=0, dtype=np.float64)
        return energy

    def moment(self, cell: int, innovation: FloatArray, linear: FloatArray, used: BoolArray) -> FloatArray:
        """The moment (3,) in the array's frame of a source in a cell that explains most of an innovation (C,).

        Beside it the innovation has errors of unit variance along the columns of `linear` (C, d).
        """
        A = self.columns[cell] * used[:, None]
        A = np.concatenate([A, innovation[:, None]], axis=1)
        # What the errors may explain of it counts for as much less: (I + J Jᵀ)⁻¹ = I - J (I + JᵀJ)⁻¹ Jᵀ.
        of_errors = linear.T @ A
        N = linear.T @ linear
        N[np.diag_indices(len(N))] += 1.0
        left = A[:, :3].T @ A - of_errors[:, :3].T @ np.linalg.solve(N, of_errors)
        found: FloatArray = np.linalg.lstsq(left[:, :3], left[:, 3], rcond=None)[0]
        return found

    def best(self, energy: FloatArray, n: int) -> IntArray:
        """The `n` best cells, half their distance from the array's centre apart from each other."""
        left, chosen = energy.copy(), []
        for _ in range(n):
            chosen.append(int(np.argmax(left)))
            left[self.near[chosen[-1]]] = -1.0
        return np.array(chosen, dtype=np.intp)


class Channels:
    """Whitening and cells of an array's rows, made once for all that have the same channels."""

    def __init__(self, array: SensorArray) -> None:
        self.array = array
        self._known: dict[bytes, tuple[FloatArray, Cells]] = {}
        if not array.noise_depends_on_reading:  # before the first row comes
            self.of(Row(0.0, np.zeros(array.n_channels)))

    def of(self, row: Row) -> tuple[FloatArray, Cells]:
        """Whitening (C, C) and cells of a row; where the noise depends on the readings, those of the first such row."""
        key = row.available.tobytes()
        if key not in self._known:
            if len(self._known) == _MOST_MASKS:
                self._known.clear()
            root = whitenings_of(self.array, row.available, row.readings_T).root
            self._known[key] = root, Cells.of(self.array, root)
        return self._known[key]

    def measured(self, row: Row) -> JointRow:
        """A row with all of its readings."""
        return JointRow.of(self.array, row, None if self.array.noise_depends_on_reading else self.of(row)[0])
