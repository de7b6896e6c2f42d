"""Cross-validation of a calibration on a known path: rows held out are located with the calibration of the others.

Blocks of successive rows are held out, because neighbouring rows are nearly one pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from arrays.array import SensorArray
from arrays.array_file import BACKGROUND_CHANGE_T
from arrays.typing import FloatArray
from magloc.calibration.array import CalibrationPrior
from magloc.calibration.calibrate import calibrate_by_source
from magloc.localization.locator import Locator
from magloc.readings import Readings
from magloc.truth import Truth, rows_of_same_time

FOLDS = 5
# Rows for all folds together; more take long and say no more.
_MOST_ROWS = 300
_FEWEST_ROWS = 4 * FOLDS
# Ratio of errors below which a prior of the common field is worth stating.
_BETTER = 0.9


@dataclass(frozen=True, eq=False)
class CrossValidation:
    """Errors of rows that were held out of a calibration.

    Attributes
    ----------
    error_m : ndarray, shape (n,)
        Distances between fixes and the true positions [m]; NaN for rows without a fix.
    """

    error_m: FloatArray

    @property
    def mean_m(self) -> float:
        """Mean error of all rows, where a row without a fix counts as the worst of the others; infinite without any."""
        solved = np.isfinite(self.error_m)
        if not solved.any():
            return math.inf
        return float(np.where(solved, self.error_m, self.error_m[solved].max()).mean())

    @property
    def json(self) -> dict[str, Any]:
        """Entries of ``magloc calibrate --json``."""
        solved = self.error_m[np.isfinite(self.error_m)]
        median, p90, worst = np.quantile(solved, (0.5, 0.9, 1.0)).tolist() if len(solved) else (None,) * 3
        return {"folds": FOLDS, "rows": len(solved), "median_m": median, "p90_m": p90, "worst_m": worst}


def leave_poses_out(
    array: SensorArray,
    readings: Readings,
    truth: Truth,
    *,
    moment: Literal["constant", "free"] | None = None,
    prior: CalibrationPrior = CalibrationPrior(),
) -> CrossValidation | None:
    """Return the errors of rows located with a calibration on the other rows.

    For the parameters see :func:`magloc.calibrate`. None if rows are too few, or a calibration without some rows
    fails.
    """
    in_readings, in_truth = rows_of_same_time(readings, truth)
    n = len(in_readings)
    if n < _FEWEST_ROWS:
        return None
    chosen = np.linspace(0, n - 1, min(n, _MOST_ROWS)).astype(np.intp)
    rows, path_m = readings[in_readings[chosen]], truth.position_m[in_truth[chosen]]
    fold = np.arange(len(rows)) * FOLDS // len(rows)
    error_m = np.full(len(rows), np.nan)
    for k in range(FOLDS):
        left_out = rows[fold == k]
        try:
            result = calibrate_by_source(array, rows[fold != k], truth, moment, prior)
            fixes = Locator(result.array, body_length_m=0.0, exclude_faulty=False).fit_rows(left_out.values_T)
        except (ValueError, np.linalg.LinAlgError):
            return None
        if left_out.pose is not None:
            fixes = fixes.moved(*left_out.pose, frame="world")
        known = np.where(np.isfinite(path_m[fold == k]), fixes.position_m - path_m[fold == k], 0.0)
        error_m[fold == k] = np.linalg.norm(known, axis=1)
    return CrossValidation(error_m)


def choose_common_field(
    array: SensorArray,
    readings: Readings,
    truth: Truth,
    *,
    moment: Literal["constant", "free"] | None = None,
    prior: CalibrationPrior = CalibrationPrior(),
) -> tuple[SensorArray, CrossValidation | None]:
    """Return the array with the prior of the common field that locates held-out rows better, and their errors.

    The offsets of an array at rest contain the background. The rest of the common field is then small, as after a
    background was subtracted. This is decided where the array states no common field and offsets are estimated.
    """
    plain = leave_poses_out(array, readings, truth, moment=moment, prior=prior)
    if (
        plain is None
        or array.common_field_T is not None
        or readings.pose is not None
        or "offsets" not in prior.estimate
    ):
        return array, plain
    stated = replace(array, common_field_T=BACKGROUND_CHANGE_T)
    other = leave_poses_out(stated, readings, truth, moment=moment, prior=prior)
    is_better = other is not None and other.mean_m < _BETTER * plain.mean_m
    return (stated, other) if is_better else (array, plain)
