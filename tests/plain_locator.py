"""Fixes with all sensors, whatever they read."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.results import Fix, Solution, Source
from magloc.localization.locator import Locator


def plain_locator(array: SensorArray, **options: Any) -> Locator:
    """A locator that leaves out no sensor."""
    return Locator(array, exclude_faulty=False, **options)


def one_source(position_m: ArrayLike, moment_Am2: ArrayLike, covariance: FloatArray, **of_both: Any) -> Solution:
    """A solution with one source."""
    of_source = {name: of_both.pop(name) for name in ("range_interval_m", "gaussian") if name in of_both}
    source = Source(np.asarray(position_m), np.asarray(moment_Am2), covariance, **of_source)
    return Solution((source,), covariance, **of_both)


def columns_of(fixes: Sequence[Fix]) -> Fixes:
    """Fixes of rows, one a second."""
    n = len(fixes)
    return Fixes.unsolved(np.arange(float(n)), "").replaced(np.arange(n), fixes)
