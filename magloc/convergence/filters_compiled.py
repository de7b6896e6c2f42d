r"""Compiled filters of the convergence map, many starts at once.

The readable twins are in :mod:`magloc.convergence.over_starts`.

A start is a lane. 32 lanes make a block, and every quantity is one row of the block's workspace: ``w[ROW + i]`` for
lane i. All rows lie in one flat array at offsets known to the compiler, which can then see that they do not overlap,
and turns each loop over the lanes into vector instructions. A lane whose start has ended takes the next start at once,
so a block never waits for its slowest lane. No lane ever reads another one: the end of a start depends neither on its
neighbours nor on the number of threads, to the last bit.

Three ideas keep an iteration short:

* *Information form.* With the whitened Jacobian J and residuals r, one update by all differences in turn is one step
  :math:`(J^T J + A)^{-1} (J^T r + \ldots)`, where A is the information of the prediction.
* *Recursive contrasts.* For sensors whose noise is the same along their axes the decorrelated differences need no
  matrix: the common field is estimated sensor by sensor, and what each sensor adds to the estimate is independent of
  what came before it. That is O(N) where the matrix form is O(N²); any other noise takes the matrix form.
* *Units of the prior.* Position and moment are counted in standard deviations of the prior, or in steps of S_q, and
  fields in a unit that leaves no further constant: then the prior's information is the unit matrix.

The information form squares the condition number. Where nothing is left of a pivot but rounding, the lane's state
becomes NaN: the start ends as not stopped, with a χ² that is not finite, and a damped one tries a shorter step. It
takes a start within some millimetres of a sensor of 1 nT.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numba import get_num_threads, njit, prange
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, compiled_parallel
from magloc.fields.dipole_compiled import field_matrix_components, gradient_components

Function = TypeVar("Function", bound=Callable[..., Any])
LANES = 32
# Rows, as offsets into the workspace. The first four groups are the linearisation at the state of its first six rows.
STATE = 0
NORMAL = 6 * LANES  # JᵀJ, upper triangle by rows
RIGHT = 27 * LANES  # Jᵀr
CHI2 = 33 * LANES
LINEARISATION = 34  # rows of the groups above
BEST = 34 * LANES  # damped: the same at the best state so far
PRIOR = 68 * LANES  # mean of the prior, which is the start
INFORMATION = 74 * LANES  # repeated: information of the predicted state, upper triangle by rows
DAMPING = 95 * LANES  # of the step; zero for all but damped
KEPT_DAMPING = 96 * LANES  # damped: of the next step that has one
COST = 97 * LANES  # damped: χ² and prior at the best state so far
ACCEPT = 98 * LANES  # damped: whether the last step led there
ITERATIONS = 99 * LANES
CHANGE = 100 * LANES  # parts of ‖ΔG‖² (3)
DONE = 103 * LANES
STOPPED = 104 * LANES
SENSOR = 105 * LANES  # one sensor: residual (3), gradient tensor (xx, xy, xz, yy, yz), ∂B/∂m (xx, xy, xz, yy, yz)
COMMON = 118 * LANES  # their weighted means over the sensors so far
BASE = 131 * LANES  # residual at the base sensor (3)
ROW = 134 * LANES  # one difference: residual, Jacobian (6)
WORKSPACE = 141 * LANES
SENSOR_ROWS = 13
DIAGONAL = (0, 6, 11, 15, 18, 20)  # rows of an upper triangle
IEKF, REPEATED, DAMPED = 0, 1, 2
# A pivot of Gauss's elimination that is smaller than this part of its diagonal element consists of rounding alone.
LOST_PIVOT = 1e-15
# Damping of the normal matrix's diagonal: a step that lowers the cost divides it, one that does not multiplies it.
DAMPING_DECREASE = 5.0
DAMPING_INCREASE = 4.0


def _inlined(function: Function) -> Function:
    """Compile a piece of a loop over the lanes: a call that remained one would keep the loop from being vectorised."""
    return cast(Function, njit(cache=True, error_model="numpy", fastmath={"contract"}, forceinline=True)(function))


class Ended(NamedTuple):
    """States (n, 6) in SI, χ², iterations, whether the stop rule was met."""

    states: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]
    stopped: NDArray[np.bool_]


def iekf_map(
    starts: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    sensors: FloatArray,
    weights: FloatArray,
    position_sigma_m: float,
    moment_sigma_Am2: float,
    tolerance_T: float,
    max_iterations: int,
) -> Ended:
    """Iterated update from every start (n, 6) as prior mean, with the prior's standard deviations.

    Difference j of the readings, z[j] of the given variance, is ``Σ_i weights[j, i] · B_i`` with weights (k, N, 3) and
    the sensors (N, 3) in the array's frame.
    """
    model = _Model.of(z, variance, sensors, weights, position_sigma_m, moment_sigma_Am2)
    return model.run(IEKF, starts, 0.0, tolerance_T, max_iterations)


def repeated_map(
    starts: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    sensors: FloatArray,
    weights: FloatArray,
    inflation: float,
    position_step_m: float,
    moment_step_Am2: float,
    tolerance_T: float,
    max_iterations: int,
) -> Ended:
    """Repeated-measurement filter from every start, one linearisation a pass; the first arguments as :func:`iekf_map`.

    The variances are multiplied by `inflation` inside the filter; the diagonal of S_q is the two steps.
    """
    model = _Model.of(z, inflation * variance, sensors, weights, position_step_m, moment_step_Am2)
    ended = model.run(REPEATED, starts, 0.0, tolerance_T, max_iterations)
    return ended._replace(chi2=inflation * ended.chi2)


def damped_map(
    starts: FloatArray,
    z: FloatArray,
    variance: FloatArray,
    sensors: FloatArray,
    weights: FloatArray,
    position_sigma_m: float,
    moment_sigma_Am2: float,
    first_damping: float,
    tolerance_T: float,
    max_iterations: int,
) -> Ended:
    """Levenberg-Marquardt iteration on the cost that :func:`iekf_map` minimises, with the same arguments."""
    model = _Model.of(z, variance, sensors, weights, position_sigma_m, moment_sigma_Am2)
    return model.run(DAMPED, starts, first_damping, tolerance_T, max_iterations)


class _Model(NamedTuple):
    """Differences of an array; lengths in `length`, moments in `moment`, fields in moment / length³.

    The arrays of one of the two forms of the differences are empty.
    """

    length: float  # [m]
    moment: float  # [A·m²]
    sensors: FloatArray  # (N, 3)
    # Recursive contrasts, for noise that is the same along the axes of each sensor; the base sensor comes first.
    readings: FloatArray = np.zeros((0, 3))  # (N, 3), up to a field common to all
    blend: FloatArray = np.zeros(0)  # (N,), share of a sensor in the mean over the sensors so far
    whiten: FloatArray = np.zeros(0)  # (N,), 1/σ of a sensor minus the mean over those before it
    # The matrix form, for any noise.
    rows: FloatArray = np.zeros((0, 0, 3))  # (k, N, 3), weights of the fields in the differences, over the latter's σ
    measured: FloatArray = np.zeros(0)  # (k,), differences over their σ
    variance: FloatArray = np.zeros(0)  # (k,)

    @classmethod
    def of(
        cls,
        z: FloatArray,
        variance: FloatArray,
        sensors: FloatArray,
        weights: FloatArray,
        length: float,
        moment: float,
    ) -> _Model:
        """From SI."""
        field = moment / length**3
        z, variance, sensors = z / field, variance / field**2, sensors / length
        base, noise = _base_and_noise(weights, variance)
        if noise is None:
            sigma = np.sqrt(variance)
            rows = weights / sigma[:, None, None]
            return cls(length, moment, sensors, rows=rows, measured=z / sigma, variance=variance)
        order = np.argsort(np.arange(len(sensors)) != base, kind="stable")
        noise = noise[order]
        total = np.cumsum(1.0 / noise)  # inverse variance of the mean
        readings = np.asarray(np.linalg.lstsq(weights.reshape(z.size, -1), z, rcond=None)[0], dtype=np.float64)
        return cls(
            length,
            moment,
            sensors[order],
            readings=readings.reshape(-1, 3)[order],
            blend=1.0 / (noise * total),
            whiten=np.concatenate([[0.0], 1.0 / np.sqrt(noise[1:] + 1.0 / total[:-1])]),
        )

    def run(
        self, method: int, starts: FloatArray, first_damping: float, tolerance_T: float, max_iterations: int
    ) -> Ended:
        """End of every start (n, 6) in SI."""
        unit = np.repeat([self.length, self.moment], 3)
        states, chi2, iterations, stopped = _run(
            method,
            np.ascontiguousarray(starts / unit),
            float(first_damping),
            (tolerance_T / (self.moment / self.length**3)) ** 2,
            float(max_iterations),
            min(get_num_threads(), -(-len(starts) // LANES)),
            self.sensors.ravel(),
            self.readings.ravel(),
            self.blend,
            self.whiten,
            self.rows,
            self.measured,
            self.variance,
        )
        return Ended(states * unit, chi2, iterations, stopped)


def _base_and_noise(weights: FloatArray, variance: FloatArray) -> tuple[int, FloatArray | None]:
    """Base sensor of the differences and the sensors' variances (N,), or None unless both are of the recursive form.

    The information of the differences about the sensors' fields must be ``(diag(c) - c cᵀ / Σc) ⊗ I₃`` with c the
    inverse variances, and the plain sum of their squares that of the differences against the base sensor.
    """
    n = weights.shape[1]
    information = np.einsum("jsa,jtb,j->satb", weights, weights, 1.0 / variance)
    squares = np.einsum("jsa,jtb->satb", weights, weights)
    base = int(np.argmax(squares[:, 0, :, 0].diagonal()))
    contrasts = np.delete(np.eye(n), base, axis=0)
    contrasts[:, base] = -1.0
    p = information[:, 0, :, 0]
    if n == 2:
        certainty = np.full(2, 2.0 * p[0, 0])
    else:
        # The off-diagonal elements are -v_i v_j with v = c / √Σc.
        i, j, k = np.arange(n), np.roll(np.arange(n), 1), np.roll(np.arange(n), 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            certainty = p[i, i] - p[i, j] * p[i, k] / p[j, k]
    if not np.all(certainty > 0.0):
        return base, None
    expected = np.diag(certainty) - np.outer(certainty, certainty) / np.sum(certainty)
    scale = np.sqrt(np.outer(certainty, certainty))[:, None, :, None]
    same = np.eye(3)[:, None, :]
    recursive = (
        np.max(np.abs(information - expected[:, None, :, None] * same) / scale) < 1e-12
        and np.max(np.abs(squares - (contrasts.T @ contrasts)[:, None, :, None] * same)) < 1e-12 * n
    )
    return base, 1.0 / certainty if recursive else None


@compiled_parallel
def _run(
    method: int,
    starts: FloatArray,
    first_damping: float,
    tolerance2: float,
    max_iterations: float,
    n_blocks: int,
    sensors: FloatArray,
    readings: FloatArray,
    blend: FloatArray,
    whiten: FloatArray,
    rows: FloatArray,
    measured: FloatArray,
    variance: FloatArray,
) -> tuple[FloatArray, FloatArray, NDArray[np.int64], NDArray[np.bool_]]:
    n = starts.shape[0]
    states, chi2 = np.empty((n, 6)), np.empty(n)
    iterations, stopped = np.empty(n, np.int64), np.empty(n, np.bool_)
    for block in prange(n_blocks):
        _run_block(
            method, starts, block, n_blocks, first_damping, tolerance2, max_iterations,
            sensors, readings, blend, whiten, rows, measured, variance, states, chi2, iterations, stopped,
        )  # fmt: skip
    return states, chi2, iterations, stopped


@compiled
def _run_block(
    method: int,
    starts: FloatArray,
    block: int,
    n_blocks: int,
    first_damping: float,
    tolerance2: float,
    max_iterations: float,
    sensors: FloatArray,
    readings: FloatArray,
    blend: FloatArray,
    whiten: FloatArray,
    rows: FloatArray,
    measured: FloatArray,
    variance: FloatArray,
    states: FloatArray,
    chi2: FloatArray,
    iterations: NDArray[np.int64],
    stopped: NDArray[np.bool_],
) -> None:
    """Starts block, block + n_blocks, … from first to last."""
    n, first = starts.shape[0], np.int64(block)  # prange counts in unsigned numbers
    w = _aligned(WORKSPACE)
    n_residuals = measured.size if blend.size == 0 else 3 * blend.size
    fields = _aligned(SENSOR_ROWS * LANES * (sensors.size // 3) if blend.size == 0 else 0)
    before, residuals = _aligned(n_residuals * LANES), _aligned(n_residuals * LANES)
    start_of_lane = np.full(LANES, -1)
    w[DONE : DONE + LANES] = 1.0
    next_start, active = first, 0
    while True:
        for i in range(LANES):
            if w[DONE + i] == 0.0:
                continue
            w[DONE + i] = 0.0
            start = min(next_start, n - 1)  # an idle lane computes something, too
            for r in range(6):
                w[STATE + r * LANES + i] = starts[start, r]
                w[PRIOR + r * LANES + i] = starts[start, r]
            w[DAMPING + i] = w[KEPT_DAMPING + i] = first_damping
            if method == REPEATED:
                _begin_information(w, i)
            w[ITERATIONS + i] = 0.0 if next_start < n else -math.inf
            start_of_lane[i] = next_start
            active += next_start < n
            next_start += n_blocks
        if active == 0:
            return
        w[NORMAL : CHI2 + LANES] = 0.0
        w[CHANGE : CHANGE + 3 * LANES] = 0.0
        if blend.size == 0:
            _linearise_rows(w, fields, before, residuals, sensors, rows, measured, variance)
        else:
            _linearise_contrasts(w, before, residuals, sensors, readings, blend, whiten)
        if method == DAMPED:
            _judge(w, before, residuals, tolerance2, max_iterations)
        else:
            _see_ends(w, tolerance2, max_iterations)
        before, residuals = residuals, before
        for i in range(LANES):
            if w[DONE + i] != 0.0:
                k = start_of_lane[i]
                for r in range(6):
                    states[k, r] = w[STATE + r * LANES + i]
                chi2[k] = w[CHI2 + i]
                iterations[k] = int(w[ITERATIONS + i])
                stopped[k] = w[STOPPED + i] != 0.0
                active -= 1
        if method == REPEATED:
            _step_and_grow(w)
        else:
            _step_from_prior(w)


@compiled
def _aligned(size: int) -> FloatArray:
    """Zeros that begin on a cache line, where a vector register never reaches into the next."""
    zeros = np.zeros(size + 8)
    first = (-(zeros.ctypes.data // 8)) % 8
    return zeros[first : first + size]


@compiled
def _begin_information(w: FloatArray, i: int) -> None:
    """Information of the first prediction, whose covariance is twice S_q S_qᵀ."""
    for row in range(21):
        w[INFORMATION + row * LANES + i] = 0.0
    for row in DIAGONAL:
        w[INFORMATION + row * LANES + i] = 0.5


@_inlined
def _sensor_fields(w: FloatArray, sx: float, sy: float, sz: float, yx: float, yy: float, yz: float) -> None:
    """Rows SENSOR: reading minus field of the states at one sensor, and the field's derivatives."""
    for i in range(LANES):
        dx, dy, dz = sx - w[STATE + i], sy - w[STATE + LANES + i], sz - w[STATE + 2 * LANES + i]
        mx, my, mz = w[STATE + 3 * LANES + i], w[STATE + 4 * LANES + i], w[STATE + 5 * LANES + i]
        axx, axy, axz, ayy, ayz, azz = field_matrix_components(dx, dy, dz)
        gxx, gxy, gxz, gyy, gyz, _ = gradient_components(dx, dy, dz, mx, my, mz)
        w[SENSOR + i] = yx - (axx * mx + axy * my + axz * mz)
        w[SENSOR + LANES + i] = yy - (axy * mx + ayy * my + ayz * mz)
        w[SENSOR + 2 * LANES + i] = yz - (axz * mx + ayz * my + azz * mz)
        w[SENSOR + 3 * LANES + i] = gxx
        w[SENSOR + 4 * LANES + i] = gxy
        w[SENSOR + 5 * LANES + i] = gxz
        w[SENSOR + 6 * LANES + i] = gyy
        w[SENSOR + 7 * LANES + i] = gyz
        w[SENSOR + 8 * LANES + i] = axx
        w[SENSOR + 9 * LANES + i] = axy
        w[SENSOR + 10 * LANES + i] = axz
        w[SENSOR + 11 * LANES + i] = ayy
        w[SENSOR + 12 * LANES + i] = ayz


@compiled
def _linearise_contrasts(
    w: FloatArray,
    before: FloatArray,
    residuals: FloatArray,
    sensors: FloatArray,
    readings: FloatArray,
    blend: FloatArray,
    whiten: FloatArray,
) -> None:
    """Add all sensors to NORMAL, RIGHT and CHI2 by recursive contrasts; CHANGE, and the residuals that it compares."""
    for s in range(blend.size):
        _sensor_fields(
            w, sensors[3 * s], sensors[3 * s + 1], sensors[3 * s + 2],
            readings[3 * s], readings[3 * s + 1], readings[3 * s + 2],
        )  # fmt: skip
        if s == 0:
            for i in range(SENSOR_ROWS * LANES):
                w[COMMON + i] = w[SENSOR + i]
            for i in range(3 * LANES):
                w[BASE + i] = w[SENSOR + i]
        # An orthonormal transform of the differences leaves the sum of their squares alone: no need to transform them.
        for i in range(3 * LANES):
            residual = w[SENSOR + i] - w[BASE + i]
            change = residual - before[3 * LANES * s + i]
            residuals[3 * LANES * s + i] = residual
            w[CHANGE + i] += change * change
        if s == 0:
            continue
        a, b = blend[s], whiten[s]
        for i in range(LANES):
            ex, ey, ez = _contrast(w, 0, i, a, b), _contrast(w, 1, i, a, b), _contrast(w, 2, i, a, b)
            gxx, gxy, gxz = _contrast(w, 3, i, a, b), _contrast(w, 4, i, a, b), _contrast(w, 5, i, a, b)
            gyy, gyz = _contrast(w, 6, i, a, b), _contrast(w, 7, i, a, b)
            axx, axy, axz = _contrast(w, 8, i, a, b), _contrast(w, 9, i, a, b), _contrast(w, 10, i, a, b)
            ayy, ayz = _contrast(w, 11, i, a, b), _contrast(w, 12, i, a, b)
            # Both tensors are symmetric and traceless, and ∂B/∂p = -G.
            _add_difference(w, i, ex, -gxx, -gxy, -gxz, axx, axy, axz)
            _add_difference(w, i, ey, -gxy, -gyy, -gyz, axy, ayy, ayz)
            _add_difference(w, i, ez, -gxz, -gyz, gxx + gyy, axz, ayz, -(axx + ayy))


@_inlined
def _contrast(w: FloatArray, quantity: int, i: int, blend: float, whiten: float) -> float:
    """One quantity at the sensor minus its mean so far, divided by the standard deviation; the mean moves on."""
    difference = w[SENSOR + quantity * LANES + i] - w[COMMON + quantity * LANES + i]
    w[COMMON + quantity * LANES + i] += blend * difference
    return whiten * difference


@compiled
def _linearise_rows(
    w: FloatArray,
    fields: FloatArray,
    before: FloatArray,
    residuals: FloatArray,
    sensors: FloatArray,
    rows: FloatArray,
    measured: FloatArray,
    variance: FloatArray,
) -> None:
    """:func:`_linearise_contrasts` for any weights of the fields in the differences, row by row."""
    for s in range(rows.shape[1]):
        _sensor_fields(w, sensors[3 * s], sensors[3 * s + 1], sensors[3 * s + 2], 0.0, 0.0, 0.0)
        fields[SENSOR_ROWS * LANES * s : SENSOR_ROWS * LANES * (s + 1)] = w[SENSOR : SENSOR + SENSOR_ROWS * LANES]
    for j in range(measured.size):
        w[ROW : ROW + LANES] = measured[j]
        w[ROW + LANES : ROW + 7 * LANES] = 0.0
        for s in range(rows.shape[1]):
            if rows[j, s, 0] != 0.0 or rows[j, s, 1] != 0.0 or rows[j, s, 2] != 0.0:
                of_sensor = slice(SENSOR_ROWS * LANES * s, SENSOR_ROWS * LANES * (s + 1))
                _add_to_row(w, fields[of_sensor], rows[j, s, 0], rows[j, s, 1], rows[j, s, 2])
        _add_row(w, before[j * LANES : (j + 1) * LANES], residuals[j * LANES : (j + 1) * LANES], variance[j])


@compiled
def _add_to_row(w: FloatArray, f: FloatArray, x: float, y: float, z: float) -> None:
    """Add one sensor, whose rows SENSOR are f, to a difference with the weights x, y, z of its field."""
    for i in range(LANES):
        gxx, gxy, gxz, gyy = f[3 * LANES + i], f[4 * LANES + i], f[5 * LANES + i], f[6 * LANES + i]
        gyz = f[7 * LANES + i]
        axx, axy, axz, ayy = f[8 * LANES + i], f[9 * LANES + i], f[10 * LANES + i], f[11 * LANES + i]
        ayz = f[12 * LANES + i]
        w[ROW + i] += x * f[i] + y * f[LANES + i] + z * f[2 * LANES + i]
        w[ROW + LANES + i] -= x * gxx + y * gxy + z * gxz
        w[ROW + 2 * LANES + i] -= x * gxy + y * gyy + z * gyz
        w[ROW + 3 * LANES + i] -= x * gxz + y * gyz - z * (gxx + gyy)
        w[ROW + 4 * LANES + i] += x * axx + y * axy + z * axz
        w[ROW + 5 * LANES + i] += x * axy + y * ayy + z * ayz
        w[ROW + 6 * LANES + i] += x * axz + y * ayz - z * (axx + ayy)


@compiled
def _add_row(w: FloatArray, before: FloatArray, residuals: FloatArray, variance: float) -> None:
    """Add a difference to NORMAL, RIGHT and CHI2, and its part of ‖ΔG‖² to CHANGE."""
    for i in range(LANES):
        r = w[ROW + i]
        change = r - before[i]
        w[CHANGE + i] += variance * (change * change)
        residuals[i] = r
        _add_difference(
            w, i, r, w[ROW + LANES + i], w[ROW + 2 * LANES + i], w[ROW + 3 * LANES + i],
            w[ROW + 4 * LANES + i], w[ROW + 5 * LANES + i], w[ROW + 6 * LANES + i],
        )  # fmt: skip


@_inlined
def _add_difference(
    w: FloatArray, i: int, r: float, h0: float, h1: float, h2: float, h3: float, h4: float, h5: float
) -> None:
    """Add one whitened difference with residual r and Jacobian h to JᵀJ, Jᵀr and χ²."""
    w[NORMAL + i] += h0 * h0
    w[NORMAL + LANES + i] += h0 * h1
    w[NORMAL + 2 * LANES + i] += h0 * h2
    w[NORMAL + 3 * LANES + i] += h0 * h3
    w[NORMAL + 4 * LANES + i] += h0 * h4
    w[NORMAL + 5 * LANES + i] += h0 * h5
    w[NORMAL + 6 * LANES + i] += h1 * h1
    w[NORMAL + 7 * LANES + i] += h1 * h2
    w[NORMAL + 8 * LANES + i] += h1 * h3
    w[NORMAL + 9 * LANES + i] += h1 * h4
    w[NORMAL + 10 * LANES + i] += h1 * h5
    w[NORMAL + 11 * LANES + i] += h2 * h2
    w[NORMAL + 12 * LANES + i] += h2 * h3
    w[NORMAL + 13 * LANES + i] += h2 * h4
    w[NORMAL + 14 * LANES + i] += h2 * h5
    w[NORMAL + 15 * LANES + i] += h3 * h3
    w[NORMAL + 16 * LANES + i] += h3 * h4
    w[NORMAL + 17 * LANES + i] += h3 * h5
    w[NORMAL + 18 * LANES + i] += h4 * h4
    w[NORMAL + 19 * LANES + i] += h4 * h5
    w[NORMAL + 20 * LANES + i] += h5 * h5
    w[RIGHT + i] += h0 * r
    w[RIGHT + LANES + i] += h1 * r
    w[RIGHT + 2 * LANES + i] += h2 * r
    w[RIGHT + 3 * LANES + i] += h3 * r
    w[RIGHT + 4 * LANES + i] += h4 * r
    w[RIGHT + 5 * LANES + i] += h5 * r
    w[CHI2 + i] += r * r


@compiled
def _see_ends(w: FloatArray, tolerance2: float, max_iterations: float) -> None:
    """Rows DONE and STOPPED."""
    for i in range(LANES):
        n, change = w[ITERATIONS + i], w[CHANGE + i] + w[CHANGE + LANES + i] + w[CHANGE + 2 * LANES + i]
        stopped = change < tolerance2
        done = (n > 0.0) & (stopped | (n >= max_iterations) | (not (change < math.inf)))
        w[STOPPED + i] = 1.0 if stopped else 0.0
        w[DONE + i] = 1.0 if done else 0.0


@compiled
def _judge(w: FloatArray, before: FloatArray, residuals: FloatArray, tolerance2: float, max_iterations: float) -> None:
    """Accept the trial state if it lowers the cost, adapt the damping, and see which starts end."""
    for i in range(LANES):
        x0, x1, x2, x3, x4, x5 = _vector(w, STATE, i)
        p0, p1, p2, p3, p4, p5 = _vector(w, PRIOR, i)
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
    _keep_best(w, w[:BEST], w[BEST : BEST + LINEARISATION * LANES])
    _keep_best(w, residuals, before)


@compiled
def _keep_best(w: FloatArray, trial: FloatArray, best: FloatArray) -> None:
    """All rows of both become the trial's in the lanes where it was accepted, and those of the best elsewhere."""
    for r in range(trial.size // LANES):
        for i in range(LANES):
            new, old = trial[r * LANES + i], best[r * LANES + i]
            value = new if w[ACCEPT + i] != 0.0 else old
            trial[r * LANES + i] = value
            best[r * LANES + i] = value


@compiled
def _step_from_prior(w: FloatArray) -> None:
    """Gauss-Newton step on χ² and prior, with the normal matrix's diagonal damped."""
    for i in range(6 * LANES):
        w[RIGHT + i] -= w[STATE + i] - w[PRIOR + i]
    for i in range(LANES):
        _add_identity(w, NORMAL, i, 1.0 + w[DAMPING + i])
        _move(w, i)


@compiled
def _step_and_grow(w: FloatArray) -> None:
    """Update of the predicted state, and the information A of the next prediction.

    With Y = JᵀJ + A the information after the update, ``(Y⁻¹ + I)⁻¹ = I - (Y + I)⁻¹``. The covariance grows by I a pass
    at most, so A stays above 1 / (passes + 1) and the subtraction is harmless.
    """
    for i in range(21 * LANES):
        w[NORMAL + i] += w[INFORMATION + i]
    for i in range(LANES):
        _move(w, i)
        _add_identity(w, NORMAL, i, 1.0)
        t = _swept((*_triangle(w, NORMAL, i), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        (
            w[INFORMATION + i], w[INFORMATION + LANES + i], w[INFORMATION + 2 * LANES + i],
            w[INFORMATION + 3 * LANES + i], w[INFORMATION + 4 * LANES + i], w[INFORMATION + 5 * LANES + i],
            w[INFORMATION + 6 * LANES + i], w[INFORMATION + 7 * LANES + i], w[INFORMATION + 8 * LANES + i],
            w[INFORMATION + 9 * LANES + i], w[INFORMATION + 10 * LANES + i], w[INFORMATION + 11 * LANES + i],
            w[INFORMATION + 12 * LANES + i], w[INFORMATION + 13 * LANES + i], w[INFORMATION + 14 * LANES + i],
            w[INFORMATION + 15 * LANES + i], w[INFORMATION + 16 * LANES + i], w[INFORMATION + 17 * LANES + i],
            w[INFORMATION + 18 * LANES + i], w[INFORMATION + 19 * LANES + i], w[INFORMATION + 20 * LANES + i],
        ) = t[:21]  # fmt: skip
        _add_identity(w, INFORMATION, i, 1.0)


@_inlined
def _move(w: FloatArray, i: int) -> None:
    """Move the state by NORMAL⁻¹ RIGHT; to NaN where NORMAL is not positive definite to working precision."""
    t0 = (*_triangle(w, NORMAL, i), *_vector(w, RIGHT, i))
    t1 = _swept_once(t0)
    t2 = _swept_once(t1)
    t3 = _swept_once(t2)
    t4 = _swept_once(t3)
    t5 = _swept_once(t4)
    t6 = _swept_once(t5)
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


@_inlined
def _add_identity(w: FloatArray, at: int, i: int, factor: float) -> None:
    """Add 1 to the diagonal of a triangle, and multiply the sum."""
    w[at + i] = factor * (w[at + i] + 1.0)
    w[at + 6 * LANES + i] = factor * (w[at + 6 * LANES + i] + 1.0)
    w[at + 11 * LANES + i] = factor * (w[at + 11 * LANES + i] + 1.0)
    w[at + 15 * LANES + i] = factor * (w[at + 15 * LANES + i] + 1.0)
    w[at + 18 * LANES + i] = factor * (w[at + 18 * LANES + i] + 1.0)
    w[at + 20 * LANES + i] = factor * (w[at + 20 * LANES + i] + 1.0)


@_inlined
def _triangle(w: FloatArray, at: int, i: int) -> tuple[float, ...]:
    """Lane i of the 21 rows that begin at an offset."""
    return (
        w[at + i], w[at + LANES + i], w[at + 2 * LANES + i], w[at + 3 * LANES + i], w[at + 4 * LANES + i],
        w[at + 5 * LANES + i], w[at + 6 * LANES + i], w[at + 7 * LANES + i], w[at + 8 * LANES + i],
        w[at + 9 * LANES + i], w[at + 10 * LANES + i], w[at + 11 * LANES + i], w[at + 12 * LANES + i],
        w[at + 13 * LANES + i], w[at + 14 * LANES + i], w[at + 15 * LANES + i], w[at + 16 * LANES + i],
        w[at + 17 * LANES + i], w[at + 18 * LANES + i], w[at + 19 * LANES + i], w[at + 20 * LANES + i],
    )  # fmt: skip


@_inlined
def _vector(w: FloatArray, at: int, i: int) -> tuple[float, float, float, float, float, float]:
    """Lane i of the 6 rows that begin at an offset."""
    return (
        w[at + i], w[at + LANES + i], w[at + 2 * LANES + i],
        w[at + 3 * LANES + i], w[at + 4 * LANES + i], w[at + 5 * LANES + i],
    )  # fmt: skip


@_inlined
def _swept(t: tuple[float, ...]) -> tuple[float, ...]:
    """Upper triangle of -A⁻¹ by rows and A⁻¹ b, from those of A and b: the sweep operator on every variable."""
    return _swept_once(_swept_once(_swept_once(_swept_once(_swept_once(_swept_once(t))))))


@_inlined
def _swept_once(t: tuple[float, ...]) -> tuple[float, ...]:
    """Gauss-Jordan step of a symmetric (A, b) with the first variable, which becomes the last.

    After six all are in their place again. What the caller leaves unused the compiler leaves uncomputed.
    """
    (a00, a01, a02, a03, a04, a05, a11, a12, a13, a14, a15, a22, a23, a24, a25, a33, a34, a35, a44, a45, a55,
     b0, b1, b2, b3, b4, b5) = t  # fmt: skip
    d = 1.0 / a00
    c1, c2, c3, c4, c5 = d * a01, d * a02, d * a03, d * a04, d * a05
    return (
        a11 - c1 * a01, a12 - c1 * a02, a13 - c1 * a03, a14 - c1 * a04, a15 - c1 * a05, c1,
        a22 - c2 * a02, a23 - c2 * a03, a24 - c2 * a04, a25 - c2 * a05, c2,
        a33 - c3 * a03, a34 - c3 * a04, a35 - c3 * a05, c3,
        a44 - c4 * a04, a45 - c4 * a05, c4,
        a55 - c5 * a05, c5,
        -d,
        b1 - c1 * b0, b2 - c2 * b0, b3 - c3 * b0, b4 - c4 * b0, b5 - c5 * b0, d * b0,
    )  # fmt: skip
