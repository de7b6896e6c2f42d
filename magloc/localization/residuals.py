"""What fixes leave of the readings, channel by channel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.localization.fit.results import Fix, JointFix, Solution, Source
from magloc.measurement.rows import checked_rows, rows_of_equal_mask, whitened_model, whitenings_of

_ROWS_AT_ONCE = 256


def fix_residuals(
    array: SensorArray, readings_T: ArrayLike, fixes: Sequence[Fix | JointFix], ambient_T: FloatArray | None = None
) -> FloatArray:
    """Residuals of the best solution of every row, in standard deviations of the noise.

    The field common to all sensors, of which nothing is known, is fitted and taken out. The sum of squares of a row is
    the χ² of its fix; a fitted channel's own variance is therefore a little below 1.

    Parameters
    ----------
    array : SensorArray
    readings_T : array_like, shape (n, C)
        Raw readings [T]; NaN where missing.
    fixes : sequence of Fix or JointFix
        Of every row, in the array's frame.
    ambient_T : ndarray, shape (n, 3), optional
        Ambient field of every row [T], in place of the array's.

    Returns
    -------
    ndarray, shape (n, C)
        NaN where there is no reading or no solution, and for sensors that the fix left out.

    Raises
    ------
    ValueError
        The readings have another shape.
    """
    readings = checked_rows(array, readings_T)
    solved = np.array([bool(fix.solutions) for fix in fixes], dtype=np.bool_)
    dropped = np.array([[name in fix.dropped for name in array.ids] for fix in fixes], dtype=np.bool_)
    used = np.isfinite(readings) & solved[:, None] & ~dropped.reshape(-1, array.n_sensors)[:, array.channel_sensor]
    result = np.full(readings.shape, np.nan)
    for mask, rows in rows_of_equal_mask(used):
        if not mask.any():
            continue
        for begin in range(0, rows.size, _ROWS_AT_ONCE):
            block = rows[begin : begin + _ROWS_AT_ONCE]
            ambient = None if ambient_T is None else ambient_T[block]
            whitened = whitenings_of(array, mask, readings[block])
            problem, raw = whitened_model(array, mask, readings[block], whitened, ambient)
            fields = np.stack([_fields(array, fixes[row]) for row in block])
            residual = problem.whitened(raw) - problem.predicted(fields)
            result[np.ix_(block, np.flatnonzero(mask))] = residual[:, mask]
    return result


def _fields(array: SensorArray, fix: Fix | JointFix) -> FloatArray:
    """Field of all sources of the best solution at the sensors (N, 3) [T]."""
    best = fix.solutions[0]
    sources: Sequence[Solution | Source] = (best,) if isinstance(best, Solution) else best.sources
    fields = [dipole.field(array.positions, source.position_m, source.moment_Am2) for source in sources]
    total: FloatArray = np.sum(fields, axis=0)
    return total
