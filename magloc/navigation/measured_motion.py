"""Measured velocities and rates of an array and of an object, and their columns.

``array_vx_m_s, array_vy_m_s, array_vz_m_s`` and ``array_wx_deg_s, …`` are those of the array in its own axes, as from a
velocity log and a gyroscope. ``object_vx_m_s, …`` and ``object_wx_deg_s, …`` are those of the object in the frame of
the results. Each group is complete or absent. ``array_v_sigma_m_s``, ``array_w_sigma_deg_s`` and so on are standard
deviations along or about each axis, of an error that is independent from row to row.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from arrays.io.csv import Table
from arrays.io.errors import InputError
from arrays.typing import BoolArray, FloatArray, IntArray

CARRIERS = ("array", "object")
# Letter and unit of the columns of velocities and rates, and the factor to SI.
_KINDS = (("v", "m_s", 1.0), ("w", "deg_s", np.pi / 180.0))


@dataclass(frozen=True, eq=False)
class MeasuredMotion:
    """Motion of array and object; unmeasured parts are zero, with zero standard deviation.

    Attributes
    ----------
    velocity_m_s, rate_rad_s : ndarray, shape (n, 2, 3)
        Velocities and rates of the array in its own axes, and of the object in the frame of the results.
    velocity_sigma_m_s, rate_sigma_rad_s : ndarray, shape (n, 2)
        Standard deviations along, and about, each axis.

    Raises
    ------
    ValueError
        The shapes do not fit.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> rate_rad_s = np.zeros((50, 2, 3))
    >>> rate_rad_s[:, 0, 2] = 0.1  # the array turns to the left
    >>> still, sigma = np.zeros((50, 2, 3)), np.zeros((50, 2))
    >>> motion = magloc.MeasuredMotion(still, rate_rad_s, sigma, sigma + 1e-3)
    >>> readings = magloc.Readings(np.zeros((50, 12)), motion=motion)
    """

    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    velocity_sigma_m_s: FloatArray
    rate_sigma_rad_s: FloatArray

    def __post_init__(self) -> None:
        n = len(self.velocity_m_s)
        for field, shape in zip(fields(self), [(n, 2, 3)] * 2 + [(n, 2)] * 2, strict=True):
            value = np.asarray(getattr(self, field.name), dtype=np.float64)
            if value.shape != shape:
                raise ValueError(f"Input {field.name} must have shape {shape}; instead received {value.shape}.")
            object.__setattr__(self, field.name, value)

    def __len__(self) -> int:
        return len(self.velocity_m_s)

    def of_rows(self, rows: slice | BoolArray | IntArray) -> MeasuredMotion:
        """Return some of the rows."""
        return MeasuredMotion(*(getattr(self, field.name)[rows] for field in fields(self)))

    def of_steps(self) -> MeasuredMotion:
        """Return the motion of the steps to the rows, as the mean of both ends; the first step is empty."""
        before = np.maximum(np.arange(len(self)) - 1, 0)
        values = [getattr(self, field.name) for field in fields(self)]
        means = [0.5 * (value[before] + value) for value in values[:2]]
        # Errors of the two ends are independent. The correlation of successive steps is neglected.
        sigmas = [np.sqrt(0.5 * (value[before] ** 2 + value**2)) for value in values[2:]]
        return MeasuredMotion(*means, *sigmas)


MOTION_GROUPS = tuple(
    (tuple(f"{who}_{letter}{axis}_{unit}" for axis in "xyz"), f"{who}_{letter}_sigma_{unit}", scale)
    for letter, unit, scale in _KINDS
    for who in CARRIERS
)
"""Columns of velocities and rates, the column of their σ, and the factor to SI."""
MOTION_COLUMNS = tuple(name for columns, sigma, _ in MOTION_GROUPS for name in (*columns, sigma))


def motion_of_table(table: Table, *, posed: bool) -> MeasuredMotion | None:
    """Return the measured motion of a table; with the array's pose only that of the object."""
    if not set(MOTION_COLUMNS) & set(table.header):
        return None
    n = len(table.values)
    values, sigmas = np.zeros((4, n, 3)), np.zeros((4, n))
    for i, (columns, sigma, scale) in enumerate(MOTION_GROUPS):
        if sigma in table.header and columns[0] not in table.header:
            raise InputError(f"{table.header_place(columns[0])}: found {sigma} without it, expected both.")
        if not table.has_group(columns):
            continue
        if posed and columns[0].startswith("array"):
            raise InputError(
                f"{table.header_place(columns[0])}: found together with the array's pose, expected one of them."
            )
        values[i] = scale * table.complete(columns)
        if sigma in table.header:
            sigmas[i] = scale * table.complete([sigma])[:, 0]
            table.refuse(sigmas[i][:, None] < 0.0, [sigma], "found a number below zero, expected a standard deviation")
    parts = (values[:2], values[2:], sigmas[:2], sigmas[2:])
    return MeasuredMotion(*(np.swapaxes(part, 0, 1) for part in parts))


def motion_columns(motion: MeasuredMotion) -> tuple[list[str], FloatArray]:
    """Return the names of all columns, and their numbers (n, 16)."""
    values = np.concatenate([motion.velocity_m_s, motion.rate_rad_s], axis=1)
    sigmas = np.concatenate([motion.velocity_sigma_m_s, motion.rate_sigma_rad_s], axis=1)
    numbers = [np.column_stack([values[:, i], sigmas[:, i]]) / scale for i, (_, _, scale) in enumerate(MOTION_GROUPS)]
    return list(MOTION_COLUMNS), np.hstack(numbers)
