"""Recognition of readings from which a background was subtracted before."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.array_file import BACKGROUND_CHANGE_T
from arrays.typing import FloatArray
from magloc.localization.locator import Locator

# Rows that are fixed again, and the fewest for a statement.
_MOST_ROWS, _FEWEST_ROWS = 30, 10
# χ² per prior of the common field, relative to χ²/dof, below which the prior holds; the Earth's field gives 10⁴.
_HOLDS = 3.0
# χ²/dof above which the model is too wrong to say.
_MISFIT = 20.0
# Ratio of standard deviations below which the prior is worth stating.
_BETTER = 0.9


def background_is_subtracted(array: SensorArray, readings_T: FloatArray) -> bool:
    """Return whether readings (n, C) of one source agree with a small common field, and fixes gain by it.

    Some rows are fixed with and without the prior of ``background = "subtracted"``. Only a small common field agrees
    with it. It is worth stating if standard deviations of the position shrink.
    """
    n = len(readings_T)
    if array.common_field_T is not None or array.channel_is_scalar.any() or n < _FEWEST_ROWS:
        return False
    some = readings_T[np.linspace(0, n - 1, min(n, _MOST_ROWS)).astype(np.intp)]
    arrays = (array, replace(array, common_field_T=BACKGROUND_CHANGE_T))
    pair = [Locator(each, exclude_faulty=False).fit_rows(some) for each in arrays]
    both = pair[0].solved & pair[1].solved
    if np.count_nonzero(both) < _FEWEST_ROWS:
        return False
    before, after = (fixes.solutions.select(fixes.best[both]) for fixes in pair)
    scale = np.maximum(1.0, before.chi2 / np.maximum(before.dof, 1))
    if np.median(scale) > _MISFIT:
        return False
    rise = (after.chi2 - before.chi2) / (3.0 * scale)
    variance = [np.trace(each.covariance[:, :3, :3], axis1=1, axis2=2) for each in (before, after)]
    return bool(np.mean(rise) < _HOLDS and np.median(variance[1] / variance[0]) < _BETTER**2)
