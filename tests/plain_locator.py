"""Sources that are drawn all around an array, and fixes with all sensors, whatever they read."""

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
from magloc.measurement.differences import predicted_channels


def plain_locator(array: SensorArray, **options: Any) -> Locator:
    """A locator that leaves out no sensor."""
    return Locator(array, exclude_faulty=False, **options)


def one_source(position_m: ArrayLike, moment_Am2: ArrayLike, covariance: FloatArray, **of_both: Any) -> Solution:
    """A solution with one source."""
    of_source = {name: of_both.pop(name) for name in ("range_interval_m", "gaussian") if name in of_both}
    source = Source(np.asarray(position_m), np.asarray(moment_Am2), covariance, **of_source)
    return Solution((source,), covariance, **of_both)


def random_sources(
    rng: np.random.Generator, n: int, nearest_m: float, farthest_m: float, moment_Am2: float = 300.0
) -> tuple[FloatArray, FloatArray]:
    """Positions about the origin and moments, each (n, 3), in any direction."""
    direction, moment = rng.normal(size=(2, n, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    moment *= moment_Am2 / np.linalg.norm(moment, axis=1, keepdims=True)
    return direction * rng.uniform(nearest_m, farthest_m, (n, 1)), moment


def noisy_readings(
    array: SensorArray, position_m: ArrayLike, moment_Am2: ArrayLike, rng: np.random.Generator
) -> FloatArray:
    """Readings of an uncalibrated array with the noise that it states."""
    clean = predicted_channels(array, position_m, moment_Am2) + array.channel_offset_T
    return np.asarray(clean + rng.normal(size=clean.shape) * array.channel_noise_T)


def columns_of(fixes: Sequence[Fix]) -> Fixes:
    """Fixes of rows, one a second."""
    n = len(fixes)
    return Fixes.unsolved(np.arange(float(n)), "").replaced(np.arange(n), fixes)
