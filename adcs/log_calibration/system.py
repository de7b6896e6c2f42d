r"""Linearised model of a log: knots of the attitude and slow errors, and the parameters that all rows share.

At each knot the states are a rotation error θ in the world frame, a slow change of the gyro's bias, the velocity, and
the slow field error of each magnetometer. Between knots θ and the slow errors are linear in time. With the attitude R
(world from body) that the gyro gives between the knots,

.. math::
    y(t + τ) &= A R^T b + o + Σ_k c_k I_k(t) + d(t) + ν \\
    \bar{R (f - a)} &= (v_{k+1} - v_k) / Δt + g

The velocity is a Markov process that the tilt may drive, as that of a multirotor: with the horizontal part u of the
direction of the mean specific force, dv/dt = κ g u - v/τ + ν. The factor κ is a parameter. Without it, accelerations
that follow the tilt would seem to say that there is no tilt.

The field b has no component along x, which defines the heading.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from adcs import quaternion
from adcs.complementary.inertial.integration import gyro_attitudes
from adcs.log_calibration.arrow import Solution
from adcs.log_calibration.parameters import (
    FORCE,
    GRAVITY,
    GYRO_BIAS,
    GYRO_MATRIX,
    INCLINATION,
    MODULUS,
    SYMMETRIC,
    THRUST,
    FieldPrior,
    Layout,
    field_enu_uT,
)
from adcs.log_calibration.record import InertialData, Series
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.navigation.poses import vectors_at

STANDARD_GRAVITY_M_S2 = 9.80665
_FORCE_NOISE_M_S2 = 0.03
_GAP_RAD = 2.0
HEADING_RAD = 1.0
THETA, DRIFT, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
N_STATES = 9


def slow_field(m: int) -> slice:
    """Return the states of a magnetometer's slow error."""
    return slice(N_STATES + 3 * m, N_STATES + 3 * m + 3)


@dataclass(frozen=True, eq=False)
class Noise:
    """Noise of a log.

    Attributes
    ----------
    turn_rad_rts : float
        Random walk of the attitude [rad/√s].
    white_uT : ndarray, shape (M,)
        White noise of a reading; for coloured noise, white noise with the same density at low frequencies.
    sigma, time_s : ndarray, shape (2 + M,)
        Standard deviation and correlation time of the slow processes: gyro drift [rad/s], velocity [m/s] and slow field
        errors [µT].
    """

    turn_rad_rts: float
    white_uT: FloatArray
    sigma: FloatArray
    time_s: FloatArray

    @classmethod
    def usual(cls, n_magnetometers: int) -> Noise:
        """Return the noise of usual sensors."""
        M = n_magnetometers
        return cls(3e-4, np.full(M, 0.5), np.array([2e-4, 8.0, *[0.05] * M]), np.array([100.0, 8.0, *[20.0] * M]))

    @property
    def logarithms(self) -> FloatArray:
        """Logarithms of the walk of the attitude, and of the σ and the times of the slow processes."""
        return np.log(np.concatenate([[self.turn_rad_rts], self.sigma, self.time_s]))

    def turn_weights(self, data: InertialData) -> FloatArray:
        """Return the inverse standard deviations (K - 1,) of the rotations that the gyro does not show."""
        return 1.0 / np.sqrt(self.turn_rad_rts**2 * data.span_s + np.where(data.in_gap, _GAP_RAD**2, 0.0))

    def slow_transitions(self, data: InertialData) -> tuple[FloatArray, FloatArray]:
        """Return the factors φ (K - 1, n - 3) of the slow states, and the inverse σ of their steps."""
        sigma, time_s = (np.repeat(each, 3) for each in (self.sigma, self.time_s))
        factor = np.exp(-data.span_s[:, None] / time_s)
        return factor, 1.0 / (sigma * np.sqrt(1.0 - factor**2))


@dataclass(frozen=True, eq=False)
class Problem:
    """Readings, priors and noise of a log.

    Attributes
    ----------
    inertial : InertialData
    magnetometers, currents : tuple of Series
        Fields [µT] and currents.
    used : tuple of ndarray of bool
        Rows of each magnetometer that are used.
    layout : Layout
    prior, prior_sigma : ndarray, shape (p,)
        Prior of the parameters. The modulus of the field is relative to that of `field`.
    field : FieldPrior
    start_q : ndarray, shape (4,)
        First attitude of the iteration.
    noise : Noise
    """

    inertial: InertialData
    magnetometers: tuple[Series, ...]
    currents: tuple[Series, ...]
    used: tuple[BoolArray, ...]
    layout: Layout
    prior: FloatArray
    prior_sigma: FloatArray
    field: FieldPrior
    start_q: FloatArray
    noise: Noise


@dataclass(frozen=True, eq=False)
class SensorRows:
    """Rows of a magnetometer at an estimate.

    Attributes
    ----------
    which : ndarray of int, shape (n,)
        Rows that are used.
    before : ndarray of int, shape (n,)
        Last inertial instant before.
    interval : ndarray of int, shape (n,)
        Interval between knots.
    part : ndarray, shape (n,)
        Elapsed part of the interval.
    q : ndarray, shape (n, 4)
        Attitude, world from body.
    body : ndarray, shape (n, 3)
        Field of the Earth in body axes [µT].
    rate : ndarray, shape (n, 3)
        Rate of change of the model without lag [µT/s].
    current : ndarray, shape (n, J)
    residual : ndarray, shape (n, 3)
        Reading minus model [µT].
    """

    which: IntArray
    before: IntArray
    interval: IntArray
    part: FloatArray
    q: FloatArray
    body: FloatArray
    rate: FloatArray
    current: FloatArray
    residual: FloatArray


@dataclass(frozen=True, eq=False)
class Estimate:
    """Values of all unknowns, with the residuals that they leave.

    Attributes
    ----------
    problem : Problem
    parameters : ndarray, shape (p,)
    knots_q : ndarray, shape (K, 4)
        Attitudes, world from body.
    states : ndarray, shape (K, n)
        Slow states; the errors of rotation are zero.
    rate : ndarray, shape (n, 3)
        Rates of the gyro without its errors.
    excess : ndarray, shape (K - 1, 3)
        Rotations of the intervals that the gyro does not show, world frame.
    q : ndarray, shape (n, 4)
        Attitudes at the inertial times.
    rows : tuple of SensorRows
    cost : float
    """

    problem: Problem
    parameters: FloatArray
    knots_q: FloatArray
    states: FloatArray
    rate: FloatArray
    excess: FloatArray
    q: FloatArray
    rows: tuple[SensorRows, ...]
    cost: float

    @classmethod
    def at(cls, problem: Problem, parameters: FloatArray, knots_q: FloatArray, states: FloatArray) -> Estimate:
        """Return the estimate with some values of the unknowns."""
        data = problem.inertial
        interval, knots = data.interval, data.knots
        matrix = np.zeros((3, 3))
        i, j = SYMMETRIC.T
        matrix[i, j] = matrix[j, i] = parameters[GYRO_MATRIX]
        drift = vectors_at(data.time_s, data.time_s[knots], states[:, DRIFT])
        rate = (data.rate_rad_s - parameters[GYRO_BIAS] - drift) @ (np.eye(3) - matrix).T
        q_gyro = gyro_attitudes(rate, data.dt_s)
        from_gyro = quaternion.multiply(knots_q, quaternion.conjugate(q_gyro[knots]))
        ends = quaternion.multiply(from_gyro[:-1], q_gyro[knots[1:]])
        excess = quaternion.log(quaternion.multiply(knots_q[1:], quaternion.conjugate(ends)))
        part = data.part(data.time_s, interval)
        q = quaternion.multiply(from_gyro[interval], q_gyro)
        q = quaternion.multiply(quaternion.exp(part[:, None] * excess[interval]), q)
        bare = cls(problem, parameters, knots_q, states, rate, excess, q, (), np.inf)
        rows = tuple(bare.sensor_rows(m) for m in range(len(problem.magnetometers)))
        whole = replace(bare, rows=rows)
        return replace(whole, cost=whole.cost_for(problem.noise))

    def sensor_rows(self, m: int, *, all_rows: bool = False) -> SensorRows:
        """Return the used rows of a magnetometer, or all of them, between the first and the last inertial reading."""
        problem, data = self.problem, self.problem.inertial
        layout, series = problem.layout, problem.magnetometers[m]
        at = series.time_s - self.parameters[layout.lag(m)]
        inside = (at >= data.time_s[0]) & (at < data.time_s[-1])
        which = np.flatnonzero(inside if all_rows else inside & problem.used[m])
        at = at[which]
        before = np.searchsorted(data.time_s, at, "right") - 1
        interval = np.searchsorted(data.knots, before, "right") - 1
        rate = self.rate[before + 1]
        part = data.part(at, interval)
        more = (part - data.part(data.time_s[before], interval))[:, None] * self.excess[interval]
        q = quaternion.multiply(self.q[before], quaternion.exp(rate * (at - data.time_s[before])[:, None]))
        q = quaternion.multiply(quaternion.exp(more), q)
        b = self.field_uT[0]
        body = quaternion.rotate_back(q, b)
        A = self.parameters[layout.matrix(m)].reshape(3, 3)
        c = self.parameters[layout.current(m)].reshape(-1, 3)
        current, slope = np.zeros((len(at), len(c))), np.zeros((len(at), len(c)))
        for k, one in enumerate(problem.currents):
            current[:, k] = np.interp(at, one.time_s, one.values)
            slope[:, k] = np.interp(at, one.time_s, np.gradient(one.values, one.time_s))
        slow = self.states[:, slow_field(m)]
        d = slow[interval] + part[:, None] * (slow[interval + 1] - slow[interval])
        model = body @ A.T + self.parameters[layout.offset(m)] + current @ c + d
        moving = np.cross(body, rate) @ A.T + slope @ c
        return SensorRows(which, before, interval, part, q, body, moving, current, series.values[which] - model)

    @property
    def field_uT(self) -> tuple[FloatArray, FloatArray]:
        """Field of the Earth in the world frame, and its derivative by the inclination [µT]."""
        modulus = self.problem.field.modulus_uT * (1.0 + self.parameters[MODULUS])
        return field_enu_uT(modulus, float(self.parameters[INCLINATION]))

    @cached_property
    def mean_force(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return the means over intervals (K - 1, …) of force and attitude, and the mean elapsed part of the force."""
        data = self.problem.inertial
        R, part = quaternion.matrix(self.q), data.part(data.time_s, data.interval)
        force = np.einsum("nij,nj->ni", R, data.acceleration_m_s2 - self.parameters[FORCE])
        begin, counts = data.knots[:-1], np.diff(data.knots)
        sums = np.add.reduceat(np.column_stack([force, part[:, None] * force, R.reshape(-1, 9)]), begin, axis=0)
        # The last instant belongs to the last interval.
        counts = counts + (np.arange(len(counts)) == len(counts) - 1)
        means = sums / counts[:, None]
        return means[:, :3], means[:, 3:6], means[:, 6:].reshape(-1, 3, 3)

    def gyro_turns(self) -> tuple[FloatArray, FloatArray]:
        """Return rotations by unit errors of the gyro's bias and of its matrix, world frame.

        The first ones (K - 1, 3, 9) belong to whole intervals. The second ones (n, 3, 9) are the parts at each instant
        that are not linear within its interval.
        """
        data = self.problem.inertial
        turn = quaternion.matrix(self.q) * data.dt_s[:, None, None]
        by_matrix = []
        for i, j in SYMMETRIC:
            E = np.zeros((3, 3))
            E[i, j] = E[j, i] = 1.0
            by_matrix.append(np.einsum("nij,nj->ni", turn, self.rate @ E.T))
        sums = np.cumsum(np.concatenate([turn, np.stack(by_matrix, axis=2)], axis=2), axis=0)
        whole, interval = np.diff(sums[data.knots], axis=0), data.interval
        part = data.part(data.time_s, interval)[:, None, None]
        return whole, sums - sums[data.knots[interval]] - part * whole[interval]

    def force_residuals(self) -> tuple[FloatArray, FloatArray]:
        """Return residuals (K - 1, 3) of the mean force, and their inverse standard deviations (K - 1,)."""
        data = self.problem.inertial
        v = self.states[:, VELOCITY]
        predicted = np.diff(v, axis=0) / data.span_s[:, None]
        predicted[:, 2] += STANDARD_GRAVITY_M_S2 + self.parameters[GRAVITY]
        return self.mean_force[0] - predicted, np.where(data.in_gap, 0.0, 1.0 / _FORCE_NOISE_M_S2)

    @cached_property
    def thrust(self) -> FloatArray:
        """Direction (K - 1, 3) of the thrust in the world frame: the direction of the mean specific force."""
        mean = self.problem.inertial.acceleration_m_s2.mean(axis=0)
        return np.asarray(self.mean_force[2] @ (mean / np.linalg.norm(mean)))

    def thrust_speed(self, noise: Noise) -> FloatArray:
        """Return the speed (K - 1,) that a unit of :attr:`thrust` gives within an interval, where κ is 1 [m/s]."""
        time_s = noise.time_s[1]
        return np.asarray(STANDARD_GRAVITY_M_S2 * time_s * -np.expm1(-self.problem.inertial.span_s / time_s))

    def slow_steps(self, noise: Noise) -> FloatArray:
        """Return the unexplained steps (K - 1, n - 3) of the slow states."""
        slow = self.states[:, 3:]
        steps = slow[1:] - noise.slow_transitions(self.problem.inertial)[0] * slow[:-1]
        steps[:, 3:5] -= self.parameters[THRUST] * self.thrust_speed(noise)[:, None] * self.thrust[:, :2]
        return np.asarray(steps)

    def whitened_residuals(self, noise: Noise) -> list[FloatArray]:
        """Return all residuals over their standard deviations."""
        force, weight = self.force_residuals()
        return [
            *(rows.residual / white for rows, white in zip(self.rows, noise.white_uT, strict=True)),
            self.excess * noise.turn_weights(self.problem.inertial)[:, None],
            force * weight[:, None],
            self.slow_steps(noise) * noise.slow_transitions(self.problem.inertial)[1],
            self.states[0, 3:] / np.repeat(noise.sigma, 3),
            self.start_turn() / HEADING_RAD,
            (self.parameters - self.problem.prior) / self.problem.prior_sigma,
        ]

    def cost_for(self, noise: Noise) -> float:
        """Return the sum of squares of all residuals over their standard deviations."""
        return sum(float(np.sum(each**2)) for each in self.whitened_residuals(noise))

    def start_turn(self) -> FloatArray:
        """Return the rotation of the first attitude from that of the start."""
        conjugate = quaternion.conjugate(self.problem.start_q)
        return quaternion.log(quaternion.multiply(self.knots_q[0], conjugate))

    def retract(self, solution: Solution) -> Estimate:
        """Return the estimate after a step."""
        knots_q = quaternion.multiply(quaternion.exp(solution.states[:, THETA]), self.knots_q)
        states = self.states + solution.states
        states[:, THETA] = 0.0
        return Estimate.at(self.problem, self.parameters + solution.parameters, quaternion.normalised(knots_q), states)
