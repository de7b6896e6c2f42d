"""Poses of rows: unit quaternions of a table, and interpolation between the rows of a record."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.typing import FloatArray

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_UNIT_QUATERNION_ATOL = 1e-3  # a log that keeps four decimals passes; the quaternion is normalised afterwards


def unit_rotation(table: Table, columns: Sequence[str]) -> Rotation:
    """Return the rotations of a table's columns of unit quaternions, scalar last."""
    from scipy.spatial.transform import Rotation

    quaternion = table.complete(columns)
    norm = np.linalg.norm(quaternion, axis=1)
    wrong = np.abs(norm - 1.0) > _UNIT_QUATERNION_ATOL
    if wrong.any():
        row = int(wrong.argmax())
        raise InputError(
            f"{table.row_place(row)}, columns {columns[0]} to {columns[-1]}: "
            f"found a quaternion of norm {norm[row]:.6g}, expected norm 1."
        )
    return Rotation.from_quat(quaternion / norm[:, None])


def vectors_at(wanted_s: FloatArray, time_s: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return vectors (n, 3) at some instants, interpolated in a record (k, 3) and constant beyond its ends."""
    order = np.argsort(time_s, kind="stable")
    return np.stack([np.interp(wanted_s, time_s[order], column[order]) for column in vectors.T], axis=1)


def rotations_at(wanted_s: FloatArray, time_s: FloatArray, rotations: Rotation) -> Rotation:
    """Return rotations at some instants, interpolated in a record of k and constant beyond its ends."""
    from scipy.spatial.transform import Slerp

    order = np.argsort(time_s, kind="stable")
    if len(order) == 1:
        return rotations[np.zeros(len(wanted_s), dtype=np.int64)]
    return Slerp(time_s[order], rotations[order])(np.clip(wanted_s, time_s[order[0]], time_s[order[-1]]))
