"""Dummy values: numbers instead of missing readings, such as -99999, 1e32, or 0 beside 48,000."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from arrays.typing import BoolArray, FloatArray

_NINES, _LARGE = (1e5, 1e8), 1e20  # powers of ten just above a row of nines
_BLANKS = (1.70141e38, 3.40282e38)  # largest numbers of single precision, as they are often written
_ROUNDING = 1e-8
_SQUARE_VANISHES = 1e-150
_FEWEST = 10  # other readings that say that zeros, or a number that is repeated, are none
_APART, _KNOWN_APART = 10.0, 3.0  # over the spread of the others, or over their size
_MOST = 0.9  # quantile for size and spread of the others
_ALONE, _MOST_NEAR = 0.5, 0.02  # share of other readings that are nearer than so much of the distance to the middle


@np.errstate(over="ignore", invalid="ignore")
def dummy_cells(readings: FloatArray, declared: Sequence[float] = (), units: Sequence[float] = (1.0,)) -> BoolArray:
    """Return a mask of the cells of one sensor's channels (n, k) that hold dummy values.

    Dummies are declared numbers; known ones (-99999 and other numbers of nines, powers of ten from 1e20 on), unless
    other readings are as large; and zeros and repeated numbers far from nearly all readings.

    Parameters
    ----------
    readings : ndarray, shape (n, k)
        Readings; NaN if missing.
    declared : sequence of float
        Declared dummies, in the unit of the readings.
    units : sequence of float
        Units in which a known number may be written, over the unit of the readings.
    """
    cells = np.isin(readings, declared) if len(declared) else np.zeros(readings.shape, np.bool_)
    for own, column in zip(cells.T, np.where(cells, np.nan, readings).T, strict=True):
        own |= np.isin(column, _dummy_values(column, units))
    moduli = np.linalg.norm(readings, axis=1)
    if len(_dummy_values(moduli, ())):
        cells |= (moduli == 0.0)[:, None]
    return cells


def may_be_dummies(
    readings: FloatArray, n_new: int, declared: Sequence[float] = (), units: Sequence[float] = (1.0,)
) -> BoolArray:
    """Return a mask of channels (k,) that may have dummies in the last rows; a quick bound.

    A channel without declared, known, zero and large repeated numbers in its new cells has none.
    """
    new, size = readings[-n_new:], np.abs(readings)
    found = np.isin(new, declared) | (size[-n_new:] < _SQUARE_VANISHES)
    for unit in units:
        found |= _is_known(size[-n_new:] / unit)
    least = np.min(size, axis=0, initial=np.inf, where=size > 0.0)
    large = size[-n_new:] / _APART > least
    for row, is_large in enumerate(large):
        found[row] |= is_large & ((readings == new[row]).sum(axis=0) > 1)
    return np.asarray(found.any(axis=0))


def _dummy_values(column: FloatArray, units: Sequence[float]) -> FloatArray:
    """Return the values of a column (n,) that are dummies."""
    column = column[np.isfinite(column)]
    if _is_free_of_dummies(np.abs(column), units):
        return column[:0]
    found, counts = np.unique(column, return_counts=True)
    known = np.zeros(len(found), np.bool_)
    for unit in units:
        known |= _is_known(np.abs(found) / unit)
    common = np.repeat(found, counts)[np.repeat(~known & (found != 0.0), counts)]
    if not len(common):
        return found[known]
    middle, size = float(np.median(common)), float(np.quantile(np.abs(common), _MOST))
    off = np.abs(found - middle)
    spread = float(np.quantile(np.abs(common - middle), _MOST))
    dummy = known & (off > _KNOWN_APART * spread)
    if len(common) >= _FEWEST:
        dummy |= (found == 0.0) & (off > _APART * spread)
        dummy |= (counts > 1) & (np.abs(found) > _APART * size)
    for k in np.flatnonzero(dummy):
        near = np.abs(common - found[k]) < _ALONE * off[k]
        dummy[k] = (near & (common != found[k])).mean() <= _MOST_NEAR
    return np.asarray(found[dummy])


def _is_free_of_dummies(size: FloatArray, units: Sequence[float]) -> bool:
    """Return whether magnitudes (n,) have no zero, none as large as a known dummy, and none far above most others."""
    if not len(size):
        return True
    largest, at = float(size.max()), int(_MOST * (len(size) - 1))
    is_known = any(largest / unit > 0.9 * _NINES[0] for unit in units)
    return not is_known and float(size.min()) > 0.0 and largest <= _APART * float(np.partition(size, at)[at])


@np.errstate(over="ignore", invalid="ignore")
def _is_known(size: FloatArray) -> BoolArray:
    """Return a mask of magnitudes (...) that are known dummies."""
    power = 10.0 ** np.round(np.log10(np.maximum(size, 1.0)))
    large = (size >= _LARGE) & (np.abs(size - power) <= 1e-6 * power)
    short = np.zeros(size.shape, np.bool_)
    for blank in _BLANKS:
        large |= np.abs(size - blank) <= 1e-4 * blank
    for below in (1.0, 0.1, 0.01):
        short |= np.abs(power - size - below) <= 1e-6 * below + _ROUNDING
    return np.asarray(large | (short & (power >= _NINES[0]) & (power <= _NINES[1])))
