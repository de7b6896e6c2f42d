"""Compiled filters of the convergence map, many starts at once; :mod:`magloc.convergence.filters` has the twins.

A start is a lane, 32 of them a block: ``w[ROW + i]`` for lane i, in information form and units of the prior. How, and
what that costs in digits: docs/theory/lanes.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import get_num_threads, prange
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, compiled_parallel, inlined, internal
from magloc.convergence.linearisation_compiled import Model, linearise_contrasts, linearise_rows
from magloc.convergence.workspace_compiled import (
    ACCEPT,
    BEST,
    CHANGE,
    CHI2,
    COST,
    DAMPING,
    DIAGONAL,
    DONE,
    INFORMATION,
    ITERATIONS,
    KEPT_DAMPING,
    LANES,
    LINEARISATION,
    NORMAL,
    PRIOR,
    RIGHT,
    SENSOR_ROWS,
    START,
    STATE,
    STOPPED,
    WORKSPACE,
    add_identity,
    aligned,
    lanes_of,
    swept,
    swept_once,
    triangle,
    vector,
)

IEKF, REPEATED, DAMPED = 0, 1, 2
# A pivot of Gauss's elimination that is smaller than this part of its diagonal element consists of rounding alone.
LOST_PIVOT = 1e-15
# Damping of the normal matrix's diagonal: a step that lowers the cost divides it, one that does not multiplies it.
DAMPING_DECREASE = 5.0
DAMPING_INCREASE = 4.0


class Ends(NamedTuple):
    """Ends of many starts.

    Attributes
    ----------
    states : ndarray, shape (n, 6)
        (position [m], moment [A·m²]).
    chi2 : ndarray, shape (n,)
    iterations : ndarray of int, shape (n,)
        Passes over the readings.
    stopped : ndarray of bool, shape (n,)
        Whether the stop rule was met.
    """

    states: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    stopped: NDArray[np.bool_]


class Rules(NamedTuple):
    """First damping, square of the tolerance in the model's unit of fields, most iterations."""

    first_damping: float
    tolerance2: float
    max_iterations: float


def ends(
    method: int,
    model: Model,
    starts: FloatArray,
    tolerance_T: float,
    max_iterations: int,
    first_damping: float = 0.0,
    device: str = "cpu",
) -> Ends:
    """End of every start (n, 6), the mean of its prior, by IEKF, REPEATED or DAMPED; a step has the prior's units."""
    unit = np.repeat([model.length, model.moment], 3)
    tolerance = tolerance_T / (model.moment / model.length**3)
    rules = Rules(float(first_damping), tolerance**2, float(max_iterations))
    in_units = np.ascontiguousarray(starts / unit)
    if device == "cpu":
        found = _run(method, in_units, rules, min(get_num_threads(), -(-len(starts) // LANES)), model)
    else:
        from magloc.convergence.filters_cuda import run_on_device

        found = run_on_device(method, in_units, rules, model)
    states, chi2, iterations, stopped = found
    return Ends(states * unit, chi2, iterations, stopped)


class Workspace(NamedTuple):
    """What the lanes of a block have in memory: LANES numbers a row."""

    rows: FloatArray  # :mod:`magloc.convergence.workspace_compiled` has their order
    fields: FloatArray  # SENSOR_ROWS a sensor, for the matrix form
    before: FloatArray  # residuals of two passes
    residuals: FloatArray


@compiled
def n_rows(model: Model) -> tuple[int, int, int]:
    """Rows of the workspace's first three parts."""
    if model.blend.size:
        return WORKSPACE // LANES, 0, 3 * model.blend.size
    return WORKSPACE // LANES, SENSOR_ROWS * (model.sensors.size // 3), model.measured.size


@compiled_parallel
def _run(
    method: int, starts: FloatArray, rules: Rules, n_blocks: int, model: Model
) -> tuple[FloatArray, FloatArray, NDArray[np.int64], NDArray[np.bool_]]:
    n = starts.shape[0]
    states, chi2 = np.empty((n, 6)), np.empty(n)
    iterations, stopped = np.empty(n, np.int64), np.empty(n, np.bool_)
    for block in prange(n_blocks):
        n_w, n_fields, n_residuals = n_rows(model)
        w, fields = aligned(n_w * LANES), aligned(n_fields * LANES)
        space = Workspace(w, fields, aligned(n_residuals * LANES), aligned(n_residuals * LANES))
        out = Ends(states, chi2, iterations, stopped)
        run_every(method, starts, np.int64(block), n_blocks, rules, model, space, out, None)
    return states, chi2, iterations, stopped


@compiled
def run_every(
    method: int,
    starts: FloatArray,
    first: int | np.int64,
    every: int,
    rules: Rules,
    model: Model,
    space: Workspace,
    out: Ends,
    lane: int | None,
) -> None:
    """Starts first, first + every, … from first to last, in one lane of the workspace, or in all of them."""
    n = starts.shape[0]
    w, before, residuals = space.rows, space.before, space.residuals
    in_rows = model.blend.size == 0
    for i in lanes_of(lane):
        w[DONE + i] = 1.0
    next_start, active = first, 0
    while True:
        for i in lanes_of(lane):
            if w[DONE + i] == 0.0:
                continue
            w[DONE + i] = 0.0
            start = next_start if next_start < n else n - 1  # an idle lane computes something, too
            for r in range(6):
                w[STATE + r * LANES + i] = starts[start, r]
                w[PRIOR + r * LANES + i] = starts[start, r]
            w[DAMPING + i] = w[KEPT_DAMPING + i] = rules.first_damping
            if method == REPEATED:
                _begin_information(w, i)
            w[ITERATIONS + i] = 0.0 if next_start < n else -math.inf
            w[START + i] = next_start
            active += next_start < n
            next_start += every
        if active == 0:
            return
        for r in range(LINEARISATION - 6):
            for i in lanes_of(lane):
                w[NORMAL + r * LANES + i] = 0.0
        for r in range(3):
            for i in lanes_of(lane):
                w[CHANGE + r * LANES + i] = 0.0
        if in_rows:
            linearise_rows(w, space.fields, before, residuals, model, lane)
        else:
            linearise_contrasts(w, before, residuals, model, lane)
        if method == DAMPED:
            _judge(lane, w, before, residuals, rules)
        else:
            _see_ends(lane, w, rules)
        before, residuals = residuals, before
        for i in lanes_of(lane):
            if w[DONE + i] != 0.0:
                k = int(w[START + i])
                for r in range(6):
                    out.states[k, r] = w[STATE + r * LANES + i]
                out.chi2[k] = w[CHI2 + i]
                out.iterations[k] = int(w[ITERATIONS + i])
                out.stopped[k] = w[STOPPED + i] != 0.0
                active -= 1
        if method == REPEATED:
            _step_and_grow(lane, w)
        else:
            _step_from_prior(lane, w)


@internal
def _begin_information(w: FloatArray, i: int) -> None:
    """Information of the first prediction, whose covariance is twice S_q S_qᵀ."""
    for row in range(21):
        w[INFORMATION + row * LANES + i] = 0.0
    for row in DIAGONAL:
        w[INFORMATION + row * LANES + i] = 0.5


@internal
def _see_ends(lane: int | None, w: FloatArray, rules: Rules) -> None:
    """Rows DONE and STOPPED."""
    tolerance2, max_iterations = rules.tolerance2, rules.max_iterations
    for i in lanes_of(lane):
        n, change = w[ITERATIONS + i], w[CHANGE + i] + w[CHANGE + LANES + i] + w[CHANGE + 2 * LANES + i]
        stopped = change < tolerance2
        done = (n > 0.0) & (stopped | (n >= max_iterations) | (not (change < math.inf)))
        w[STOPPED + i] = 1.0 if stopped else 0.0
        w[DONE + i] = 1.0 if done else 0.0


@internal
def _judge(lane: int | None, w: FloatArray, before: FloatArray, residuals: FloatArray, rules: Rules) -> None:
    """Accept the trial state if it lowers the cost, adapt the damping, and see which starts end."""
    tolerance2, max_iterations = rules.tolerance2, rules.max_iterations
    for i in lanes_of(lane):
        x0, x1, x2, x3, x4, x5 = vector(w, STATE, i)
        p0, p1, p2, p3, p4, p5 = vector(w, PRIOR, i)
        d0, d1, d2, d3, d4, d5 = x0 - p0, x1 - p1, x2 - p2, x3 - p3, x4 - p4, x5 - p5
        cost = w[CHI2 + i] + (d0 * d0 + d1 * d1 + d2 * d2 + d3 * d3 + d4 * d4 + d5 * d5)
        n, change = w[ITERATIONS + i], w[CHANGE + i] + w[CHANGE + LANES + i] + w[CHANGE + 2 * LANES + i]
        first = n == 0.0
        accept = first | (cost < w[COST + i])
        best = cost if accept else w[COST + i]
        kept = w[KEPT_DAMPING + i]
        adapted = kept / DAMPING_DECREASE if accept else kept * DAMPING_INCREASE
        adapted = kept if first else adapted
        # Damping alone can make a step small: the stop rule is left to the step without it.
        small = change < tolerance2
        stopped = small & (w[DAMPING + i] == 0.0)
        done = (n > 0.0) & (stopped | (n >= max_iterations) | (not (best < math.inf)))
        w[COST + i] = best
        w[KEPT_DAMPING + i] = adapted
        w[DAMPING + i] = 0.0 if small & (n > 0.0) else adapted
        w[ACCEPT + i] = 1.0 if accept else 0.0
        w[STOPPED + i] = 1.0 if stopped else 0.0
        w[DONE + i] = 1.0 if done else 0.0
    _keep_best(lane, w, w[:BEST], w[BEST : BEST + LINEARISATION * LANES])
    _keep_best(lane, w, residuals, before)


@internal
def _keep_best(lane: int | None, w: FloatArray, trial: FloatArray, best: FloatArray) -> None:
    """All rows of both become the trial's in the lanes where it was accepted, and those of the best elsewhere."""
    for r in range(trial.size // LANES):
        for i in lanes_of(lane):
            new, old = trial[r * LANES + i], best[r * LANES + i]
            value = new if w[ACCEPT + i] != 0.0 else old
            trial[r * LANES + i] = value
            best[r * LANES + i] = value


@internal
def _step_from_prior(lane: int | None, w: FloatArray) -> None:
    """Gauss-Newton step on χ² and prior, with the normal matrix's diagonal damped."""
    for r in range(6):
        for i in lanes_of(lane):
            w[RIGHT + r * LANES + i] -= w[STATE + r * LANES + i] - w[PRIOR + r * LANES + i]
    for i in lanes_of(lane):
        add_identity(w, NORMAL, i, 1.0 + w[DAMPING + i])
        _move(w, i)


@internal
def _step_and_grow(lane: int | None, w: FloatArray) -> None:
    """Update of the predicted state, and the information A of the next prediction.

    With Y = JᵀJ + A the information after the update, ``(Y⁻¹ + I)⁻¹ = I - (Y + I)⁻¹``. The covariance grows by I a pass
    at most, so A stays above 1 / (passes + 1) and the subtraction is harmless.
    """
    for r in range(21):
        for i in lanes_of(lane):
            w[NORMAL + r * LANES + i] += w[INFORMATION + r * LANES + i]
    for i in lanes_of(lane):
        _move(w, i)
        add_identity(w, NORMAL, i, 1.0)
        t = swept((*triangle(w, NORMAL, i), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        (
            w[INFORMATION + i], w[INFORMATION + LANES + i], w[INFORMATION + 2 * LANES + i],
            w[INFORMATION + 3 * LANES + i], w[INFORMATION + 4 * LANES + i], w[INFORMATION + 5 * LANES + i],
            w[INFORMATION + 6 * LANES + i], w[INFORMATION + 7 * LANES + i], w[INFORMATION + 8 * LANES + i],
            w[INFORMATION + 9 * LANES + i], w[INFORMATION + 10 * LANES + i], w[INFORMATION + 11 * LANES + i],
            w[INFORMATION + 12 * LANES + i], w[INFORMATION + 13 * LANES + i], w[INFORMATION + 14 * LANES + i],
            w[INFORMATION + 15 * LANES + i], w[INFORMATION + 16 * LANES + i], w[INFORMATION + 17 * LANES + i],
            w[INFORMATION + 18 * LANES + i], w[INFORMATION + 19 * LANES + i], w[INFORMATION + 20 * LANES + i],
        ) = t[:21]  # fmt: skip
        add_identity(w, INFORMATION, i, 1.0)


@inlined
def _move(w: FloatArray, i: int) -> None:
    """Move the state by NORMAL⁻¹ RIGHT; to NaN where NORMAL is not positive definite to working precision."""
    t0 = (*triangle(w, NORMAL, i), *vector(w, RIGHT, i))
    t1 = swept_once(t0)
    t2 = swept_once(t1)
    t3 = swept_once(t2)
    t4 = swept_once(t3)
    t5 = swept_once(t4)
    t6 = swept_once(t5)
    definite = (
        (t0[0] > 0.0)
        & (t1[0] > LOST_PIVOT * t0[6])
        & (t2[0] > LOST_PIVOT * t0[11])
        & (t3[0] > LOST_PIVOT * t0[15])
        & (t4[0] > LOST_PIVOT * t0[18])
        & (t5[0] > LOST_PIVOT * t0[20])
    )
    one = 1.0 if definite else math.nan
    w[STATE + i] += one * t6[21]
    w[STATE + LANES + i] += one * t6[22]
    w[STATE + 2 * LANES + i] += one * t6[23]
    w[STATE + 3 * LANES + i] += one * t6[24]
    w[STATE + 4 * LANES + i] += one * t6[25]
    w[STATE + 5 * LANES + i] += one * t6[26]
    w[ITERATIONS + i] += 1.0
