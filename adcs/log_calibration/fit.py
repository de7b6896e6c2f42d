"""Joint fit of all sensors of a log, of its noise, and of the parts that fit no model."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from adcs.log_calibration.arrow import ArrowSystem, Solution
from adcs.log_calibration.linear import LinearModel
from adcs.log_calibration.parameters import GYRO_BIAS, INCLINATION, MODULUS, FieldPrior, Layout
from adcs.log_calibration.record import FEWEST_ROWS, InertialData, VehicleLog
from adcs.log_calibration.rotations import nearest_rotation, rotation_matrices
from adcs.log_calibration.start import find_start
from adcs.log_calibration.system import Estimate, Noise, Problem, slow_field
from arrays.typing import BoolArray, FloatArray
from magloc.least_squares import minimise

_ROUNDS, _DISTURBED_AT = 6, (1, 2, 3)
_STEP = 0.7  # of the logarithm of a noise
_PRIOR_WIDTHS, _SLOW_WIDTH = (1.0, 0.7, 1.0), 1.5  # of walk, drift and velocity; of slow fields
_TURN_RAD_RTS = (1e-5, 1e-2)
_SIGMA = ((1e-5, 1e-2), (0.05, 100.0), (3e-3, 10.0))  # of gyro drift [rad/s], velocity [m/s], slow fields [µT]
_TIME_S = ((100.0, 100.0), (1.0, 100.0), (2.0, 200.0))
_ITERATIONS = 4
_LAST_ITERATIONS = 40
_BLOCK_S = 0.5
_OUTLIER = 30.0  # χ² of three components of a reading
_MEDIAN_OF_THREE = 0.789  # median of χ² / dof with three degrees of freedom
_DISTURBED = 4.0  # typical χ² per dimension of an interval
_FAR = 5.0  # slow error over its usual size
_LEAST_uT = 1e-3
_FAR_MOUNTING_RAD = math.radians(30.0)


@dataclass(frozen=True, eq=False)
class _Iterate:
    estimate: Estimate

    @property
    def cost(self) -> float:
        return self.estimate.cost

    def step(self, damping: float) -> tuple[_Iterate, float]:
        solution = self.system.solve(damping)
        return _Iterate(self.estimate.retract(solution)), solution.decrease(self.system)

    @cached_property
    def system(self) -> ArrowSystem:
        return LinearModel.of(self.estimate).system(self.estimate.problem.noise)


@dataclass(frozen=True, eq=False)
class LogFit:
    """Joint fit of a log.

    Attributes
    ----------
    estimate : Estimate
    solution : Solution
        Covariances at the estimate.
    mountings : ndarray, shape (M, 3, 3)
        Rotation around which each magnetometer's matrix has its prior.
    disturbed : tuple of ndarray of bool, shape (K - 1,)
        Intervals of each magnetometer that are excluded.
    converged : bool
    """

    estimate: Estimate
    solution: Solution
    mountings: FloatArray
    disturbed: tuple[BoolArray, ...]
    converged: bool


def fit_log(log: VehicleLog, field: FieldPrior) -> LogFit:
    """Return the joint fit of all sensors of a log."""
    data = InertialData.of(log)
    fields = [replace(series, values=1e6 * series.values).finite() for series in log.magnetometers]
    magnetometers = tuple(fields)
    currents = tuple(series.finite() for series in log.currents)
    for one in magnetometers:
        if len(one.values) and not np.ptp(one.values, axis=0).any():
            raise ValueError(f"Input {one.name} must have readings that vary; instead all are equal. Exclude it.")
    start = find_start(data, magnetometers)
    layout = Layout(tuple(one.name for one in magnetometers), tuple(one.name for one in currents))
    ranges = np.array([one.span for one in currents])
    sigma = layout.prior_sigma(field, ranges)
    prior = np.zeros(layout.size)
    prior[INCLINATION] = field.inclination_rad
    for m, mounting in enumerate(start.mountings):
        prior[layout.matrix(m)] = mounting.ravel()
    parameters = prior.copy()
    parameters[GYRO_BIAS] = start.gyro_bias_rad_s
    found = float(np.linalg.norm(start.field_uT))
    if not field.is_known:
        parameters[INCLINATION] = math.asin(-start.field_uT[2] / found)
        parameters[MODULUS] = np.clip(found / field.modulus_uT, 0.5, 1.5) - 1.0
    for m, offset in enumerate(start.offsets_uT):
        parameters[layout.offset(m)] = offset
    M = len(magnetometers)
    used = tuple(np.ones(len(one.time_s), np.bool_) for one in magnetometers)
    q = start.q[data.knots]
    usual = replace(Noise.usual(M), turn_rad_rts=_gyro_noise(data))
    noise = replace(usual, white_uT=np.full(M, 3.0), turn_rad_rts=3e-3)
    problem = Problem(data, magnetometers, currents, used, layout, prior, sigma, field, q[0], noise)
    estimate = Estimate.at(problem, parameters, q, np.zeros((len(q), 9 + 3 * M)))
    disturbed = tuple(np.zeros(len(data.knots) - 1, np.bool_) for _ in magnetometers)
    for round_ in range(_ROUNDS):
        estimate = minimise(_Iterate(estimate), lambda _: 1.0, damping=1e-6, max_iterations=_ITERATIONS).point.estimate
        white = np.array([_white_noise(estimate, m) for m in range(M)])
        if round_ == 0:
            noise = replace(usual, white_uT=white)
        else:
            noise = most_likely_noise(LinearModel.of(estimate), replace(noise, white_uT=white), usual)
        if round_ in _DISTURBED_AT:
            new = _disturbed_intervals(estimate, noise)
            disturbed = tuple(old | more for old, more in zip(disturbed, new, strict=True))
        used = tuple(_used_rows(estimate, m, noise, disturbed[m]) for m in range(M))
        problem = replace(estimate.problem, noise=noise, used=used)
        estimate = Estimate.at(problem, estimate.parameters, estimate.knots_q, estimate.states)
    mountings = np.array([_mounting(estimate, m, start.mountings[m]) for m in range(M)])
    prior = prior.copy()
    for m, mounting in enumerate(mountings):
        prior[layout.matrix(m)] = mounting.ravel()
    problem = replace(estimate.problem, prior=prior)
    estimate = Estimate.at(problem, estimate.parameters, estimate.knots_q, estimate.states)
    last = minimise(_Iterate(estimate), lambda _: 1e-2, damping=1e-9, max_iterations=_LAST_ITERATIONS)
    estimate = last.point.estimate
    return LogFit(estimate, _Iterate(estimate).system.solve(), mountings, disturbed, last.converged)


def _mounting(at: Estimate, m: int, start: FloatArray) -> FloatArray:
    """Return the usual mounting that is nearest to a magnetometer's matrix, if that of the start is far from it."""
    matrix = at.parameters[at.problem.layout.matrix(m)].reshape(3, 3)
    if np.linalg.det(matrix) <= 0.0:
        raise ValueError(
            f"Input {at.problem.magnetometers[m].name} must have right-handed axes; instead received readings that fit"
            " with an axis reversed. Check the signs of x, y and z."
        )
    turn, _ = polar(matrix, side="left")
    if Rotation.from_matrix(turn @ start.T).magnitude() < _FAR_MOUNTING_RAD:
        return start
    return np.asarray(rotation_matrices()[nearest_rotation(turn.T)[0]].T)


def most_likely_noise(model: LinearModel, noise: Noise, usual: Noise) -> Noise:
    """Return a noise of larger evidence: one step of a search along the logarithm of each of its numbers.

    Their priors are log-normal around usual ones: a short log shows little of slow processes.
    """

    def cost_of(each: Noise) -> float:
        return model.minus_log_evidence(each) + float(np.sum((each.logarithms - usual.logarithms) ** 2 / widths**2))

    M = len(noise.white_uT)
    widths = np.concatenate([_PRIOR_WIDTHS, np.full(M, _SLOW_WIDTH), np.ones(2 + M)])
    best = cost_of(noise)
    for i in range(1 + 2 * (2 + M)):
        if i == 2:  # the time of the gyro's drift, which a log does not tell
            continue
        sides = [_changed(noise, i, sign * _STEP) for sign in (-1.0, 1.0)]
        costs = [cost_of(side) for side in sides]
        curvature = costs[0] + costs[1] - 2.0 * best
        vertex = 0.5 * (costs[0] - costs[1]) / curvature if curvature > 0.0 else math.copysign(1.0, costs[0] - costs[1])
        trial = _changed(noise, i, _STEP * float(np.clip(vertex, -2.0, 2.0)))
        cost = cost_of(trial)
        if cost < best:
            noise, best = trial, cost
    return noise


def _changed(noise: Noise, i: int, by: float) -> Noise:
    """Return a noise with one number times e to some power: the walk of the attitude, or those of slow processes."""
    factor = math.exp(by)
    if i == 0:
        return replace(noise, turn_rad_rts=float(np.clip(noise.turn_rad_rts * factor, *_TURN_RAD_RTS)))
    which = (i - 1) // 2
    name, limits = ("sigma", _SIGMA) if i % 2 else ("time_s", _TIME_S)
    values = getattr(noise, name).copy()
    values[which] = np.clip(values[which] * factor, *limits[min(which, 2)])
    return replace(noise, **{name: values})


def _gyro_noise(data: InertialData) -> float:
    """Return the random walk of the attitude by the gyro's noise from sample to sample [rad/√s]."""
    bends = np.diff(data.rate_rad_s, 2, axis=0)
    sample = math.sqrt(float(np.median(np.sum(bends**2, axis=1))) / (3.0 * 6.0 * _MEDIAN_OF_THREE))
    return float(np.clip(sample * math.sqrt(float(np.median(data.dt_s))), 3e-5, 3e-3))


def _white_noise(at: Estimate, m: int) -> float:
    """Return the white noise of a magnetometer with the density of its residuals at low frequencies [µT]."""
    rows, series = at.rows[m], at.problem.magnetometers[m]
    scatter = float(np.sqrt(np.median(np.sum(rows.residual**2, axis=1)) / (3.0 * _MEDIAN_OF_THREE)))
    block = np.floor(series.time_s[rows.which] / _BLOCK_S)
    begin = np.flatnonzero(np.diff(block, prepend=-np.inf))
    counts = np.diff(np.append(begin, len(block)))
    means = np.add.reduceat(rows.residual, begin, axis=0) / counts[:, None]
    density = float(np.sqrt(np.median(counts * np.sum(means**2, axis=1)) / (3.0 * _MEDIAN_OF_THREE)))
    return max(scatter, density, _LEAST_uT)


def _disturbed_intervals(at: Estimate, noise: Noise) -> tuple[BoolArray, ...]:
    """Return the intervals (K - 1,) of each magnetometer whose residuals or slow errors are far larger than usual."""
    data, found = at.problem.inertial, []
    K = len(data.knots)
    for m, rows in enumerate(at.rows):
        squares = np.sum(rows.residual**2, axis=1) / (3.0 * noise.white_uT[m] ** 2)
        counts = np.bincount(rows.interval, minlength=K - 1)
        # Medians of the intervals: single wild readings disturb none.
        middle = np.cumsum(counts) - counts + counts // 2
        ordered = squares[np.lexsort((squares, rows.interval))]
        typical = np.where(counts > 0, ordered[np.minimum(middle, len(ordered) - 1)], 0.0) / _MEDIAN_OF_THREE
        slow = np.linalg.norm(at.states[:, slow_field(m)], axis=1)
        usual = max(float(np.median(slow)), noise.white_uT[m] / math.sqrt(max(float(np.median(counts)), 1.0)))
        bad = (typical > _DISTURBED) | (np.maximum(slow[:-1], slow[1:]) > _FAR * usual)
        bad |= np.concatenate([bad[1:], [False]]) | np.concatenate([[False], bad[:-1]])
        found.append(bad if bad.mean() < 0.5 else np.zeros_like(bad))
    return tuple(found)


def _used_rows(at: Estimate, m: int, noise: Noise, disturbed: BoolArray) -> BoolArray:
    """Return the rows of a magnetometer that fit, outside its disturbed intervals."""
    rows = at.sensor_rows(m, all_rows=True)
    used = np.zeros(len(at.problem.magnetometers[m].time_s), np.bool_)
    fits = np.sum(rows.residual**2, axis=1) < _OUTLIER * noise.white_uT[m] ** 2
    used[rows.which] = fits & ~disturbed[rows.interval] & ~at.problem.inertial.in_gap[rows.interval]
    if used.sum() < FEWEST_ROWS:
        raise ValueError(
            f"Input magnetometers must have ten readings that fit, outside gaps of the gyro; instead received"
            f" {used.sum()} of {at.problem.magnetometers[m].name}."
        )
    return used
