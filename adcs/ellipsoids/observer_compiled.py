"""Compiled prediction and correction of many guaranteed ellipsoids.

:mod:`adcs.ellipsoids.observer` is the readable twin, on :mod:`adcs.ellipsoids.ellipsoid` and
:mod:`adcs.ellipsoids.strip`, which have the formulas. All arrays are changed in place; each row is one run, and is
written by one thread.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adcs.ellipsoids.ellipsoid import EPS, UNSEEN_RTOL, Outcome
from adcs.ellipsoids.strip import LARGEST_STEP, SMALLEST_GROWTH, SMALLEST_TIGHTENED_DELTA, STEP_RULES
from arrays.typing import FloatArray
from magloc.compilation import compiled, internal, over_rows

IntArray = NDArray[np.int64]
LEMMA = STEP_RULES.index("lemma")
TIGHTENED = STEP_RULES.index("tightened")
_REDUCED, _UNINFORMATIVE, _INCONSISTENT = int(Outcome.REDUCED), int(Outcome.UNINFORMATIVE), int(Outcome.INCONSISTENT)
# A step of a run takes a microsecond; starting threads takes hundreds.
_RUNS_WORTH_THREADS = 4000


def over_runs(kernel: Callable[..., None], n_runs: int, *arguments: Any) -> None:
    """Run a kernel on all rows, by threads where there are enough of them; see :func:`magloc.compilation.over_rows`."""
    if n_runs < _RUNS_WORTH_THREADS:
        kernel(0, n_runs, *arguments)
    else:
        over_rows(kernel, n_runs, *arguments)


@compiled
def predict(
    begin: int, end: int, centres: FloatArray, shapes: FloatArray, A: FloatArray, Q: FloatArray, inputs: FloatArray
) -> None:
    """Map rows begin to end of centres (R, n) and shapes (R, n, n) by A, add inputs (R, n) and the ellipsoid Q."""
    n = A.shape[0]
    x, size, M, reach = np.empty(n), np.empty(n), np.empty((n, n)), np.empty(n)
    for run in range(begin, end):
        for i in range(n):
            x[i] = inputs[run, i]
            size[i] = abs(inputs[run, i])
            for j in range(n):
                x[i] += A[i, j] * centres[run, j]
                size[i] += abs(A[i, j] * centres[run, j])
        H = shapes[run]
        for i in range(n):
            centres[run, i] = x[i]
            reach[i] = 0.0
            for j in range(n):
                reach[i] += abs(A[i, j]) * np.sqrt(H[j, j])
                M[i, j] = 0.0
                for k in range(n):
                    M[i, j] += A[i, k] * H[k, j]
        for i in range(n):
            for j in range(i + 1):
                value = 0.0
                for k in range(n):
                    value += M[i, k] * A[j, k]
                if i == j:
                    value += 4.0 * n * EPS * reach[i] * reach[i]
                H[i, j] = value
                H[j, i] = value
        _cover(H, size)
        _add(H, Q)


@compiled
def correct(
    begin: int,
    end: int,
    centres: FloatArray,
    shapes: FloatArray,
    bounds: FloatArray,
    resets: IntArray,
    directions: FloatArray,
    readings: FloatArray,
    rule: int,
    inflation: float,
    reinflation: FloatArray,
) -> None:
    """Correct rows begin to end by readings (R, m), NaN where missing; bounds (R, m) grow where they contradict."""
    n = directions.shape[1]
    Hh = np.empty(n)
    for run in range(begin, end):
        x, H = centres[run], shapes[run]
        for channel in range(directions.shape[0]):
            h, y = directions[channel], readings[run, channel]
            if np.isnan(y):
                continue
            if _intersect(x, H, h, y, bounds[run, channel], rule, Hh) == _INCONSISTENT:
                _add(H, reinflation)
                nu = y
                for i in range(n):
                    nu -= h[i] * x[i]
                bounds[run, channel] = max(abs(nu), inflation * bounds[run, channel])
                resets[run] += 1
                _intersect(x, H, h, y, bounds[run, channel], rule, Hh)


@internal
def _add(H: FloatArray, Q: FloatArray) -> None:
    n = H.shape[0]
    trace_H = trace_Q = 0.0
    for i in range(n):
        trace_H += H[i, i]
        trace_Q += Q[i, i]
    if trace_Q == 0.0:
        return
    if trace_H == 0.0:
        H[:] = Q
        return
    k = np.sqrt(trace_Q) / np.sqrt(trace_H)
    for i in range(n):
        for j in range(n):
            H[i, j] = (1.0 + 1.0 / k) * Q[i, j] + (1.0 + k) * H[i, j]


@internal
def _cover(H: FloatArray, size: FloatArray) -> None:
    """Add the box of the centre's rounding, see _around_rounded of the twin."""
    n = H.shape[0]
    trace_H = trace_Q = 0.0
    for i in range(n):
        trace_H += H[i, i]
        trace_Q += n * (4.0 * EPS * size[i]) ** 2
    if trace_Q == 0.0:
        return
    k = np.sqrt(trace_Q) / np.sqrt(trace_H) if trace_H > 0.0 else 0.0
    for i in range(n):
        for j in range(n):
            H[i, j] *= 1.0 + k
        H[i, i] += (1.0 + 1.0 / k if k > 0.0 else 1.0) * n * (4.0 * EPS * size[i]) ** 2


@internal
def _intersect(x: FloatArray, H: FloatArray, h: FloatArray, y: float, c: float, rule: int, Hh: FloatArray) -> int:
    n = x.size
    e2 = trace = h2 = squared = size = reach = 0.0
    nu = y
    for i in range(n):
        Hh[i] = 0.0
        for j in range(n):
            Hh[i] += H[i, j] * h[j]
        e2 += h[i] * Hh[i]
        squared += Hh[i] * Hh[i]
        trace += H[i, i]
        h2 += h[i] * h[i]
        nu -= h[i] * x[i]
        size += abs(h[i] * x[i])
        reach += abs(h[i]) * np.sqrt(H[i, i])
    e = np.sqrt(max(e2, 0.0))
    c += 4.0 * EPS * (abs(y) + size)
    rounding = 4.0 * n * EPS * reach * reach
    if abs(nu) > c + np.sqrt(max(e2, 0.0) + rounding):
        return _INCONSISTENT
    if e2 <= UNSEEN_RTOL * trace * h2:
        return _UNINFORMATIVE
    mu, delta = nu / e, c / e
    if n == 1:
        if abs(mu) + 1.0 <= delta:
            return _UNINFORMATIVE
        mu, delta = _tightened(mu, delta)
        Hh[0] *= mu / e
        size = abs(x[0]) + np.sqrt(H[0, 0])
        H[0, 0] *= delta * delta
        _cover(H, np.array([size]))
        x[0] += Hh[0]
        return _REDUCED
    g = min(squared / (e2 * trace), 1.0)
    if rule == TIGHTENED:
        mu, delta = _tightened(mu, delta)
    if mu * mu + g <= delta * delta:
        return _UNINFORMATIVE
    margin = rounding / e2
    step = min(1.0 - delta * delta / (g + mu * mu), LARGEST_STEP) if rule == LEMMA else _optimal(mu, delta, g)
    step = min(step, 1.0 / (1.0 + 2.0 * margin))
    beta2 = max(1.0 + step * (delta * delta / (1.0 - step * (1.0 + margin)) - mu * mu) + margin, SMALLEST_GROWTH)
    if beta2 * (1.0 - step * g + margin) >= 1.0 or not np.isfinite(beta2):
        return _UNINFORMATIVE
    for i in range(n):
        for j in range(i + 1):
            value = H[i, j] * (1.0 + margin) if i == j else H[i, j]
            value = beta2 * (value - step / e2 * Hh[i] * Hh[j])
            H[i, j] = value
            H[j, i] = value
    _cover(H, np.abs(x))
    for i in range(n):
        x[i] += step * (mu / e) * Hh[i]
    return _REDUCED


@internal
def _tightened(mu: float, delta: float) -> tuple[float, float]:
    low, high = max(-1.0, mu - delta), min(1.0, mu + delta)
    return 0.5 * (low + high), max(0.5 * (high - low), SMALLEST_TIGHTENED_DELTA)


@compiled
def _optimal(mu: float, delta: float, g: float) -> float:
    """Root of the cubic by Newton's method, in a bracket that is halved wherever Newton's step would leave it."""
    mu2, delta2 = mu * mu, delta * delta
    a, b, c = 2.0 * g * mu2, g * (1.0 - delta2) + mu2 * (1.0 - 2.0 * g), delta2 * (1.0 - g)
    low, high = 1.0 - LARGEST_STEP, 1.0
    if low * low * (b + a * low) - c >= 0.0:
        return LARGEST_STEP
    s = 0.5
    for _ in range(200):
        value = s * s * (b + a * s) - c
        if value < 0.0:
            low = s
        else:
            high = s
        slope = s * (2.0 * b + 3.0 * a * s)
        previous = s
        s = s - value / slope
        if not low < s < high:
            s = 0.5 * (low + high)
        if abs(s - previous) <= 1e-15 * s:
            break
    return 1.0 - s
