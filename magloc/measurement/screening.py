"""Wild readings: jumps that no source causes, because neighbouring rows show no flanks of a peak.

The rows are cut into pieces where neighbours differ by far more than usual. The result keeps the largest set of pieces
that agree. Pieces agree if a Gaussian process, with the covariance of sources below a depth, predicts each from the
others; the size of the process is estimated from the kept rows. So several wild readings do not mask each other, and
good readings between them are kept. If a peak is sampled so coarsely that it may be a source, nothing is wild.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.ndimage import percentile_filter

from arrays.typing import BoolArray, FloatArray, IntArray

_LIMIT, _COARSE = 11.0, 30.0  # lose 0 of 101,280 rows of clean surveys at 2 to 100 Hz (with 20: 1)
_NUGGET, _GRADIENT = 1e-3, 3.0  # relative variances of the process: of a row, and by an error of its place over depth
_FREE = 30.0  # prior variance of a level and of a slope, relative to that of the process
_ZONE, _HALO = 50, 25  # rows that are judged, and further rows on either side for the prediction
_CUT, _STEP = 8.0, 3.0  # in units of the usual step
_QUARTILE = 3.1  # standard deviation of normal numbers over the lower quartile of their absolute values
_SUPPORTS, _NEAR = 3, 0.25  # rows of a piece that supports itself; largest variance of a well predicted row
_JOINED = 3  # largest distance between neighbours, in rows of the record
_STARTS, _SWEEPS = 3, 4
_FEWEST = 20


def wild_readings(values: FloatArray, place_m: FloatArray, depth_m: float, noise: float, jitter_m: float) -> BoolArray:
    """Return which readings of a sensor (n,) are wild; NaN is not.

    Parameters
    ----------
    values : ndarray, shape (n,)
        Moduli of the field; NaN if missing.
    place_m : ndarray, shape (n, 3)
        Places of the readings [m].
    depth_m : float
        Least distance from the sensor to sources [m].
    noise : float
        Stated standard deviation, in the unit of the values.
    jitter_m : float
        Error of the place from row to row [m].
    """
    wild = np.zeros(len(values), np.bool_)
    nugget = _NUGGET + _GRADIENT * min(jitter_m / depth_m, 1.0) ** 2
    for _ in range(_SWEEPS):  # a long run of wild readings shrinks from both ends
        index = np.flatnonzero(np.isfinite(values) & ~wild)
        n = len(index)
        if n < _FEWEST:
            break
        read = values[index]
        cuts = _cuts(read, noise)
        more = np.zeros(n, np.bool_)
        for first in range(0, n, _ZONE):
            low, high = max(first - _HALO, 0), min(first + _ZONE + _HALO, n)
            if cuts[low + 1 : high].any():
                scene = _Scene(index[low:high], read[low:high], place_m[index[low:high]] / depth_m, nugget, noise)
                judged = slice(first, min(first + _ZONE, n))
                more[judged] = scene.wild(np.flatnonzero(cuts[low + 1 : high]) + 1)[first - low : judged.stop - low]
        if not more.any():
            break
        wild[index[more]] = True
    return wild


def _cuts(values: FloatArray, noise: float) -> BoolArray:
    """Return rows (n,) with an unusual step, compared with lines through the rows on either side."""
    leap = np.zeros(len(values))
    step = np.diff(values, prepend=values[0])
    leap[1], leap[-1] = step[1], step[-1]
    leap[2:-1] = 0.5 * (step[1:-2] + step[3:]) - 2.0 * step[2:-1]
    usual = _QUARTILE * percentile_filter(np.abs(leap), 25, 2 * _HALO + 1, mode="nearest") + 2.0 * noise
    return np.asarray((np.abs(leap) > _CUT * usual) & (np.abs(step) > _STEP * usual))


class _Scene:
    """Successive rows, and the covariance of the fields of sources there, scaled to unit variance.

    Parameters
    ----------
    index, values : ndarray, shape (n,)
        Rows of the record, and their readings.
    place : ndarray, shape (n, 3)
        Places in units of the depth.
    nugget, noise : float
        Variance of a row relative to the process, and noise as in :func:`wild_readings`.
    """

    def __init__(self, index: IntArray, values: FloatArray, place: FloatArray, nugget: float, noise: float) -> None:
        self._joined = np.concatenate([[False], np.diff(index) <= _JOINED, [False]])
        self._values, self._nugget = values - np.median(values), nugget
        self._least = noise**2 / nugget
        apart2 = ((place[:, None] - place) ** 2).sum(axis=-1)
        way = np.linspace(-1.0, 1.0, len(values))
        # The spectrum of sources below a plane decays as exp(-2 k depth), and so does that of this covariance.
        smooth = (1.0 + apart2 / 4.0) ** -2.5 + _FREE * (1.0 + np.outer(way, way))
        self._covariance = smooth + nugget * np.eye(len(values))

    def wild(self, cuts: IntArray) -> BoolArray:
        """Return rows (n,) that disagree with the largest consistent set of pieces.

        Pieces begin at the cuts.
        """
        n = len(self._values)
        pieces = np.split(np.arange(n), cuts)
        kept = np.zeros(0, np.intp)
        for start in sorted(pieces, key=len, reverse=True)[:_STARTS]:
            grown = self._grow(start, [piece for piece in pieces if piece is not start])
            kept = grown if len(grown) > len(kept) else kept
            if len(kept) > n // 2:
                break
        kept = self._drop_outliers(kept)
        kept = self._grow(kept, [np.array([row]) for row in np.setdiff1d(np.arange(n), kept)])
        wild = np.ones(n, np.bool_)
        wild[kept] = False
        for piece in pieces:
            if len(piece) > _HALO and wild[piece].mean() > 0.5:
                wild[piece] = self._comes_back(piece, kept)
        return wild

    def _comes_back(self, piece: IntArray, kept: IntArray) -> bool:
        """Return whether many smooth rows are a jump that returns; otherwise they are another level."""
        before, after = kept[kept < piece[0]], kept[kept > piece[-1]]
        if not (len(before) and len(after)):
            return False
        values = self._values
        away, back = values[piece[0]] - values[before[-1]], values[piece[-1]] - values[after[0]]
        return bool(away * back > 0.5 * max(away**2, back**2))

    def _grow(self, kept: IntArray, others: Sequence[IntArray]) -> IntArray:
        """Return the kept rows with all pieces that agree, best predicted first."""
        while others:
            rest = np.concatenate(others)
            weights, size = self._inverse(kept), self._size(kept)
            across = self._covariance[np.ix_(rest, kept)]
            errors = self._values[rest] - across @ (weights @ self._values[kept])
            covariance = self._covariance[np.ix_(rest, rest)] - across @ weights @ across.T
            unknown = covariance.diagonal() - self._nugget
            is_kept = np.zeros(len(self._values) + 2, np.bool_)
            is_kept[kept + 1] = True
            beside = (is_kept[:-2] & self._joined[:-1]) | (is_kept[2:] & self._joined[1:])
            told = beside[rest] | (unknown < _NEAR)
            agree, end = [], 0
            for k, piece in enumerate(others):
                own = slice(end, end := end + len(piece))
                if len(piece) < _SUPPORTS and not told[own].any():
                    continue
                largest = max(size, self._size(piece)) if len(piece) >= _SUPPORTS else size
                score = self._scores(errors[own], covariance[own, own]) / largest
                if score <= 1.0:
                    agree.append((float(unknown[own].min()), score, k))
            if not agree:
                break
            best, _, first = min(agree)
            more = {first} | {k for least, score, k in agree if score < 0.5 and least < max(0.1, 1.2 * best)}
            kept = np.sort(np.concatenate([kept, *(others[k] for k in more)]))
            others = [piece for k, piece in enumerate(others) if k not in more]
        return kept

    def _drop_outliers(self, kept: IntArray) -> IntArray:
        """Return the kept rows after dropping those that the others do not predict, worst first."""
        while len(kept) > _SUPPORTS:
            weights, values = self._inverse(kept), self._values[kept]
            variance = 1.0 / weights.diagonal()
            errors = (weights @ values) * variance
            squares = np.maximum(values @ weights @ values - errors**2 / variance, 0.0) / len(kept)
            sizes = np.sqrt(np.maximum(squares, self._least))
            scores = np.abs(errors) / np.sqrt(variance) / (_limits(variance - self._nugget) * sizes)
            worst = int(scores.argmax())
            if scores[worst] <= 1.0:
                break
            kept = np.delete(kept, worst)
        return kept

    def _inverse(self, rows: IntArray) -> FloatArray:
        return np.asarray(np.linalg.inv(self._covariance[np.ix_(rows, rows)]))

    def _size(self, rows: IntArray) -> float:
        """Return the standard deviation of the process in some rows, not below the noise."""
        values = self._values[rows] - np.median(self._values[rows])
        return math.sqrt(max(float(values @ self._inverse(rows) @ values) / len(rows), self._least))

    def _scores(self, errors: FloatArray, covariance: FloatArray) -> float:
        """Return the largest prediction error divided by its limit, for a process of unit size.

        Errors are along the axes of their covariance.
        """
        variances, axes = np.linalg.eigh(covariance)
        along = np.abs(axes.T @ errors) / np.sqrt(np.maximum(variances, self._nugget))
        return float((along / _limits(variances - self._nugget)).max())


def _limits(unknown: FloatArray) -> FloatArray:
    """Return the largest plausible prediction error in standard deviations.

    `unknown` is the variance of the prediction, for a process of unit variance. Sources are few, so their peaks are
    higher than those of a normal process, most of all if rows are coarse.
    """
    part = np.clip(unknown, 0.0, 1.0 - 1e-9)
    return np.asarray(_LIMIT * (1.0 + _COARSE * part) / (1.0 - part))
