"""Compiled variable projection: the moment is linear and eliminated, so a fit is a search over the position.

A start is a lane, 16 of them side by side: docs/theory/lanes.md. The readable twin is ``tests/variable_projection.py``.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled, inlined, internal, own
from magloc.localization.fit.linearisation_compiled import (
    CHI2,
    DAMPING,
    END,
    GAIN,
    ITERATIONS,
    LANES,
    LEFT,
    MOMENT,
    NORMAL,
    PROMISED,
    SENSOR_ROWS,
    SIGNAL,
    STATE,
    TOO_HIGH,
    TRIAL,
    linearise,
    tangents,
)
from magloc.localization.fit.normal_equations_compiled import (
    NARROW_ROWS,
    SPACE,
    fill_normal_equations,
    has_digits,
    load,
)
from magloc.measurement.whitened import WhitenedModel
from magloc.measurement.whitened_compiled import SMALLEST_S, LaneModel, signals

# How a refinement ends.
RUNNING, CONVERGED, FAILED = 0.0, 1.0, 2.0
# A start is given up where this many times the Gauss-Newton gain in χ² would leave it too high to count.
MOST_GAINED = 10.0
# Gauss-Newton gain in χ² at which an optimum is one: the position is then within 1e-5 σ of it.
OPTIMUM_TOLERANCE = 1e-10
# Two ends are one optimum 0.01 rad apart on the sphere of homogeneous coordinates, at the same χ².
SAME_COS, SAME_CHI2 = 0.99995, 0.01


class Rules(NamedTuple):
    """How refinements end: where a Gauss-Newton step would gain less than the tolerance, or after most iterations.

    They also end, and count as converged, where they will not come below a χ² (n,) above which none is of use. Ahead,
    what is put out is where the last step leads, unseen, with the χ² that it promises. Few digits do for readings of
    which :func:`easy_first` says so.
    """

    tolerance: float
    max_iterations: float
    too_high: FloatArray
    ahead: bool
    few_digits: bool


class Refined(NamedTuple):
    """Outputs of refinements (n, …): q, scaled moment, χ², linearisations, and whether they converged."""

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: IntArray
    converged: NDArray[np.bool_]

    @classmethod
    def empty(cls, n: int) -> Refined:
        """For a kernel to fill."""
        return cls(np.empty((n, 4)), np.empty((n, 3)), np.empty(n), np.empty(n, np.intp), np.empty(n, np.bool_))


@internal
def part(refined: Refined, first: int, last: int) -> Refined:
    """Some of them."""
    return Refined(
        refined.q[first:last],
        refined.mu[first:last],
        refined.chi2[first:last],
        refined.iterations[first:last],
        refined.converged[first:last],
    )


def refined(
    model: WhitenedModel,
    y: FloatArray,
    starts: FloatArray,
    max_iterations: int = 100,
    free_range: float = 1.0,
    tolerance: float = OPTIMUM_TOLERANCE,
) -> Refined:
    """:func:`refine` of one start (b, 4) of every row of whitened readings (b, C)."""
    out = Refined.empty(len(starts))
    refine_starts(
        signals(model, y),
        np.arange(len(starts)),
        own(starts),
        model.lanes,
        free_range,
        Rules(tolerance, float(max_iterations), np.full(len(starts), math.inf), False, False),
        out,
    )
    return out


@compiled
def same_optimum(q: FloatArray, chi2: float, other_q: FloatArray, other_chi2: float) -> bool:
    """Whether two ends are one optimum."""
    t = q[0] * other_q[0] + q[1] * other_q[1] + q[2] * other_q[2] + q[3] * other_q[3]
    return abs(t) > SAME_COS and abs(chi2 - other_chi2) < SAME_CHI2


@internal
def refine(
    signal: FloatArray,
    reading: IntArray,
    starts: FloatArray,
    model: LaneModel,
    free_range: float,
    rules: Rules,
    out: Refined,
) -> None:
    """Damped Gauss-Newton on the projected cost from starts q (n, 4) of the signals (rows, sensors, 3) of a row each.

    It moves on the sphere of homogeneous coordinates, or, where `free_range` is 0 instead of 1, at one range. Every
    accepted step decreases χ². A lane whose start has ended takes the next one.
    """
    n, n_sensors, n_triples = len(starts), len(model.sensors), model.common.shape[1]
    if n == 0:  # idle lanes compute the last start
        return
    w, rows = np.zeros(SPACE), np.zeros((n_sensors, NARROW_ROWS if rules.few_digits else SENSOR_ROWS))
    common, dots = np.zeros((n_sensors, n_triples, 9 * LANES)), np.empty((n_triples, 9 * LANES))
    start_of_lane, loaded, set_of_lane = np.full(LANES, -1), np.full(LANES, -1), np.full(LANES, -1)
    w[END : END + LANES] = FAILED
    next_start: int = np.int64(0)  # type: ignore[assignment]  # no literal: it would be compiled for itself
    while True:
        next_start, n_running = fill_lanes(next_start, start_of_lane, starts, w, rules, out)
        if n_running == 0:
            return
        if rules.few_digits:
            for i in range(LANES):
                k = start_of_lane[i] if start_of_lane[i] >= 0 else n - 1
                if k != loaded[i]:
                    loaded[i] = k
                    load(i, signal[reading[k]], model.gain[model.set_of_row[reading[k]]], w, rows)
            fill_normal_equations(model.sensors, w, rows, free_range)
        else:
            load_lanes(start_of_lane, loaded, set_of_lane, signal, reading, model, rows, common)
            linearise(model.sensors, w, rows, common, dots, free_range)
        judge(w, rules)
        step(w, free_range)


@compiled
def refine_starts(
    signal: FloatArray,
    reading: IntArray,
    starts: FloatArray,
    model: LaneModel,
    free_range: float,
    rules: Rules,
    out: Refined,
) -> None:
    """The same for Python."""
    refine(signal, reading, starts, model, free_range, rules, out)


@internal
def easy_first(signal: FloatArray, reading: IntArray, model: LaneModel, order: IntArray) -> int:
    """Order of readings, first those for which few digits do; how many these are."""
    n, n_easy = len(reading), 0
    for i in range(n):
        if has_digits(signal[reading[i]], model.gain[model.set_of_row[reading[i]]], model):
            order[n_easy] = i
            n_easy += 1
        else:
            order[n - 1 - (i - n_easy)] = i
    return n_easy


@inlined
def fill_lanes(
    next_start: int, start_of_lane: IntArray, starts: FloatArray, w: FloatArray, rules: Rules, out: Refined
) -> tuple[int, int]:
    """Put out the starts that have ended, and begin others in their lanes: the start that comes next, how many run."""
    n, n_running = len(starts), 0
    for i in range(LANES):
        if w[END + i] == RUNNING:
            n_running += start_of_lane[i] >= 0
            continue
        k = start_of_lane[i]
        if k >= 0:
            at = TRIAL if rules.ahead else STATE
            for d in range(4):
                out.q[k, d] = w[at + d * LANES + i]
            for d in range(3):
                out.mu[k, d] = w[STATE + MOMENT + d * LANES + i]
            out.chi2[k] = w[CHI2 + i] - w[PROMISED + i] if rules.ahead else w[CHI2 + i]
            out.iterations[k] = int(w[ITERATIONS + i])
            out.converged[k] = w[END + i] == CONVERGED
        start_of_lane[i] = next_start if next_start < n else -1
        n_running += next_start < n
        k = min(next_start, n - 1)  # an idle lane computes something, too
        next_start += 1
        _begin(i, starts[k], rules.too_high[k], w)
    return next_start, n_running


@internal
def _begin(i: int, start: FloatArray, too_high: float, w: FloatArray) -> None:
    """Begin a start in lane i: a place, where moduli count with a moment behind it."""
    for d in range(len(start)):
        w[TRIAL + d * LANES + i] = start[d]
    for d in range(9):
        w[NORMAL + d * LANES + i] = 0.0
    w[CHI2 + i], w[DAMPING + i], w[PROMISED + i] = math.inf, 1e-3, 0.0
    w[ITERATIONS + i], w[END + i], w[TOO_HIGH + i] = 0.0, RUNNING, too_high


@inlined
def load_lanes(
    start_of_lane: IntArray,
    loaded: IntArray,
    set_of_lane: IntArray,
    signal: FloatArray,
    reading: IntArray,
    model: LaneModel,
    rows: FloatArray,
    common: FloatArray,
) -> None:
    """Readings and sensors of the lanes whose starts are not loaded so far."""
    for i in range(LANES):
        k = start_of_lane[i] if start_of_lane[i] >= 0 else len(reading) - 1
        if k == loaded[i]:
            continue
        loaded[i], of_row = k, model.set_of_row[reading[k]]
        of_start = signal[reading[k]]
        for s in range(len(of_start)):
            for a in range(3):
                rows[s, SIGNAL + a * LANES + i] = of_start[s, a]
        if set_of_lane[i] != of_row:
            set_of_lane[i] = of_row
            _load_model(i, model.gain[of_row], model.common[of_row], rows, common)


@internal
def _load_model(i: int, gain: FloatArray, of_row: FloatArray, rows: FloatArray, common: FloatArray) -> None:
    for s in range(len(gain)):
        for a in range(9):
            rows[s, GAIN + a * LANES + i] = gain[s, a]
        for k in range(len(of_row)):
            for a in range(9):
                common[s, k, a * LANES + i] = of_row[k, s, a]


@inlined
def _normal(w: FloatArray, i: int) -> tuple[float, ...]:
    return (
        w[NORMAL + i], w[NORMAL + LANES + i], w[NORMAL + 2 * LANES + i], w[NORMAL + 3 * LANES + i],
        w[NORMAL + 4 * LANES + i], w[NORMAL + 5 * LANES + i], w[NORMAL + 6 * LANES + i], w[NORMAL + 7 * LANES + i],
        w[NORMAL + 8 * LANES + i],
    )  # fmt: skip


@inlined
def _solved(n: tuple[float, ...], damping: float) -> tuple[float, float, float]:
    """Step (A + damping · diag A)⁻¹ b ; columns without information do not move."""
    a00, a01, a02, a11, a12, a22, b0, b1, b2 = n
    larger = a00 if a00 > a11 else a11
    tiny = 1e-14 * (larger if larger > a22 else a22)
    grown = 1.0 + damping
    d0 = grown * a00 + tiny
    i0 = 1.0 / d0 if d0 > 0.0 else 0.0
    l1, l2 = a01 * i0, a02 * i0
    d1 = grown * a11 + tiny - l1 * a01
    i1 = 1.0 / d1 if d1 > 0.0 else 0.0
    t = a12 - l1 * a02
    l3 = t * i1
    d2 = grown * a22 + tiny - l2 * a02 - l3 * t
    i2 = 1.0 / d2 if d2 > 0.0 else 0.0
    y1 = b1 - l1 * b0
    x2 = (b2 - l2 * b0 - l3 * y1) * i2
    x1 = y1 * i1 - l3 * x2
    return b0 * i0 - l1 * x1 - l2 * x2, x1, x2


@inlined
def _take(w: FloatArray, at: int, i: int, taken: bool) -> None:
    w[at + i] = w[TRIAL + at + i] if taken else w[at + i]


@internal
def judge(w: FloatArray, rules: Rules) -> None:
    """Take the trial state where its χ² is lower, adapt the damping, and see which lanes have ended."""
    tolerance, max_iterations = rules.tolerance, rules.max_iterations
    for i in range(LANES):
        before, promised, damping = w[CHI2 + i], w[PROMISED + i], w[DAMPING + i]
        gained = before - w[TRIAL + CHI2 + i]
        taken = gained > 0.0
        # χ² falls by twice the step's product with the gradient, less its curvature: a ratio of gains of one is a model
        # that holds, a low one a step that went too far.
        less = 0.1 * damping if gained > 0.75 * promised else damping
        more = 3.0 * (damping if damping > 0.1 else 0.1)
        after = more if gained < 0.5 * promised else less
        refused = 5.0 * (damping if damping > 1e-4 else 1e-4)
        after = after if taken else refused
        w[DAMPING + i] = damping if before == math.inf else after
        w[ITERATIONS + i] += 1.0 if taken else 0.0
        w[END + i] = 1.0 if taken else 0.0
    for i in range(LANES):
        taken = w[END + i] > 0.0
        _take(w, STATE, i, taken)
        _take(w, STATE + LANES, i, taken)
        _take(w, STATE + 2 * LANES, i, taken)
        _take(w, STATE + 3 * LANES, i, taken)
        _take(w, MOMENT, i, taken)
        _take(w, MOMENT + LANES, i, taken)
        _take(w, MOMENT + 2 * LANES, i, taken)
        _take(w, CHI2, i, taken)
        _take(w, NORMAL, i, taken)
        _take(w, NORMAL + LANES, i, taken)
        _take(w, NORMAL + 2 * LANES, i, taken)
        _take(w, NORMAL + 3 * LANES, i, taken)
        _take(w, NORMAL + 4 * LANES, i, taken)
        _take(w, NORMAL + 5 * LANES, i, taken)
        _take(w, NORMAL + 6 * LANES, i, taken)
        _take(w, NORMAL + 7 * LANES, i, taken)
        _take(w, NORMAL + 8 * LANES, i, taken)
        _take(w, LEFT, i, taken)
    for i in range(LANES):
        n = _normal(w, i)
        x0, x1, x2 = _solved(n, 0.0)
        decrement = n[6] * x0 + n[7] * x1 + n[8] * x2 + w[LEFT + i]
        chi2 = w[CHI2 + i]
        # No representable step decreases χ²: an optimum to rounding if the model promised next to nothing.
        stuck = w[DAMPING + i] > 1e12
        limit = tolerance + 1e-14 * chi2
        small = 1e-6 * (1.0 + chi2) if stuck else limit
        lost = FAILED if stuck or w[ITERATIONS + i] >= max_iterations else RUNNING
        useless = chi2 - MOST_GAINED * decrement > w[TOO_HIGH + i]
        end = CONVERGED if decrement < small or useless else lost
        w[END + i] = end if decrement < math.inf and chi2 < math.inf else FAILED


@internal
def step(w: FloatArray, free_range: float) -> None:
    """A damped step of every lane, half a radian at most."""
    for i in range(LANES):
        a00, a01, a02, a11, a12, a22, b0, b1, b2 = _normal(w, i)
        x0, x1, x2 = _solved((a00, a01, a02, a11, a12, a22, b0, b1, b2), w[DAMPING + i])
        length = math.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
        share = 0.5 / length if length > 0.5 else 1.0
        x0, x1, x2 = share * x0, share * x1, share * x2
        w[PROMISED + i] = (
            x0 * (2.0 * b0 - a00 * x0 - a01 * x1 - a02 * x2)
            + x1 * (2.0 * b1 - a01 * x0 - a11 * x1 - a12 * x2)
            + x2 * (2.0 * b2 - a02 * x0 - a12 * x1 - a22 * x2)
            + w[LEFT + i]
        )
        t00, t01, t02, t10, t11, t12, t20, t21, t22, t23 = tangents(w, STATE, i)
        x2 *= free_range
        u0 = w[STATE + i] + x0 * t00 + x1 * t10 + x2 * t20
        u1 = w[STATE + LANES + i] + x0 * t01 + x1 * t11 + x2 * t21
        u2 = w[STATE + 2 * LANES + i] + x0 * t02 + x1 * t12 + x2 * t22
        s = w[STATE + 3 * LANES + i] + x2 * t23
        square = u0 * u0 + u1 * u1 + u2 * u2
        # On the sphere again: all of q, or at one range u alone.
        norm2 = square / (1.0 - s * s) if free_range == 0.0 else square + s * s
        scale = 1.0 / math.sqrt(norm2)
        s = s if free_range == 0.0 else s * scale
        least = SMALLEST_S if s >= 0.0 else -SMALLEST_S
        w[TRIAL + i], w[TRIAL + LANES + i], w[TRIAL + 2 * LANES + i] = scale * u0, scale * u1, scale * u2
        w[TRIAL + 3 * LANES + i] = s if abs(s) >= SMALLEST_S else least
