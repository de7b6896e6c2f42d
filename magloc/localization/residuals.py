"""Residuals of fixes, channel by channel."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.results import Fix
from magloc.measurement.rows import check_rows, whitened_rows

_ROWS_AT_ONCE = 256


def fix_residuals(
    array: SensorArray, readings_T: ArrayLike, fixes: Fixes, ambient_T: FloatArray | None = None
) -> FloatArray:
    """Return residuals (n, C) of the best solution of every row, divided by the noise σ.

    The unknown field common to all sensors is fitted and removed. The sum of squares of a row is the χ² of its
    solution, so the variance of a fitted channel is slightly below 1. NaN without a reading or a solution, and for
    sensors that the fix excludes.
    """
    readings = check_rows(array, readings_T)
    used = np.where(fixes.solved[:, None], fixes.used_readings(array, readings), np.nan)
    result = np.full(readings.shape, np.nan)
    for rows in whitened_rows(array, used, ambient_T, _ROWS_AT_ONCE):
        if rows.mask.any():
            fields = np.stack([_fields(array, fixes[row]) for row in rows.index])
            residual = rows.y - rows.model.predict(fields)
            result[np.ix_(rows.index, np.flatnonzero(rows.mask))] = residual[:, rows.mask]
    return result


def _fields(array: SensorArray, fix: Fix) -> FloatArray:
    """Return the field (N, 3) [T] of all sources of the best solution at the sensors."""
    sources = fix.best.sources
    moments = np.stack([source.moment_Am2 for source in sources])
    return dipole.total_field(array.positions, np.stack([source.position_m for source in sources]), moments)
