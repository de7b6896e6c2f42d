"""Normal equations of a log at an estimate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.log_calibration.arrow import ArrowSystem
from adcs.log_calibration.parameters import FORCE, GRAVITY, GYRO_BIAS, GYRO_MATRIX, INCLINATION, MODULUS, THRUST
from adcs.log_calibration.system import HEADING_RAD, Estimate, Noise, slow_field
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

_CHUNK = 50  # intervals whose derivatives are in memory at a time


@dataclass(frozen=True, eq=False)
class LinearModel:
    """Linearised model at an estimate, for any noise.

    Attributes
    ----------
    at : Estimate
    magnetometers : tuple of ArrowSystem
        Normal equations of the rows of each magnetometer for a noise of 1 µT.
    turns : ndarray, shape (K - 1, 3, 9)
        Rotations of the intervals by errors of the gyro, of :meth:`Estimate.gyro_turns`.
    """

    at: Estimate
    magnetometers: tuple[ArrowSystem, ...]
    turns: FloatArray

    @classmethod
    def of(cls, at: Estimate) -> LinearModel:
        """Return the linearised model at an estimate."""
        whole, within = at.gyro_turns()
        return cls(at, tuple(_magnetometer_system(at, m, within) for m in range(len(at.rows))), whole)

    def system(self, noise: Noise) -> ArrowSystem:
        """Return the normal equations of a step."""
        K, n = self.at.states.shape
        system = ArrowSystem.empty(K, n, len(self.at.parameters))
        for one, white in zip(self.magnetometers, noise.white_uT, strict=True):
            system.add(one, white**-2.0)
        _add_gyro(system, self.at, self.turns, noise)
        _add_force(system, self.at)
        _add_priors(system, self.at, noise)
        return system

    def minus_log_evidence(self, noise: Noise) -> float:
        """Return -2 log of the likelihood of a noise with all unknowns integrated out, without a constant."""
        system = self.system(noise)
        solution = system.solve()
        data = self.at.problem.inertial
        step_weights = noise.slow_transitions(data)[1]
        weights = 3.0 * np.log(noise.turn_weights(data)).sum() + np.log(step_weights).sum()
        weights -= 3.0 * np.log(noise.sigma).sum()
        return self.at.cost_for(noise) - solution.decrease(system) + solution.log_determinant - 2.0 * float(weights)


def _magnetometer_system(at: Estimate, m: int, within: FloatArray) -> ArrowSystem:
    """Return the normal equations of the rows of a magnetometer for a noise of 1 µT."""
    K, n = at.states.shape
    system = ArrowSystem.empty(K, n, len(at.parameters))
    layout, rows = at.problem.layout, at.rows[m]
    here = np.concatenate([np.arange(6), np.arange(n)[slow_field(m)]])
    begin = layout.matrix(m).start
    gyro = np.arange(layout.size)[GYRO_BIAS.start : GYRO_MATRIX.stop]
    columns = np.concatenate([[MODULUS, INCLINATION], gyro, np.arange(begin, begin + layout.per_sensor)])
    bounds = np.searchsorted(rows.interval, np.arange(K))
    for first in range(0, K - 1, _CHUNK):
        last = min(first + _CHUNK, K - 1)
        J = magnetometer_jacobian(at, m, slice(bounds[first], bounds[last]), within)
        for k in range(first, last):
            a, b = bounds[k], bounds[k + 1]
            if a == b:
                continue
            flat = J[a - bounds[first] : b - bounds[first]].reshape(3 * (b - a), -1)
            products = flat.T @ np.column_stack([flat, rows.residual[a:b].ravel()])
            states, shared = products[:18, :18], products[18:, 18:-1]
            border, right = products[:18, 18:-1], products[:, -1]
            for side in (0, 1):
                own = slice(9 * side, 9 * side + 9)
                system.diagonal[k + side][np.ix_(here, here)] += states[own, own]
                system.border[k + side][np.ix_(here, columns)] += border[own]
                system.gradient[k + side][here] += right[own]
            system.next[k][np.ix_(here, here)] += states[:9, 9:]
            system.corner[np.ix_(columns, columns)] += shared
            system.corner_gradient[columns] += right[18:]
    return system


def magnetometer_jacobian(at: Estimate, m: int, which: slice, within: FloatArray) -> FloatArray:
    """Return derivatives (n, 3, 29 + …) of the model of some rows of a magnetometer.

    The columns are θ, gyro drift and slow error of the knot before, those of the knot after, modulus and inclination of
    the field, bias and matrix of the gyro, and the parameters of the magnetometer. The rotations within intervals are
    those of :meth:`Estimate.gyro_turns`.
    """
    layout, rows = at.problem.layout, at.rows[m]
    A = at.parameters[layout.matrix(m)].reshape(3, 3)
    b, by_inclination = at.field_uT
    body, part = rows.body[which], rows.part[which, None, None]
    R = quaternion.matrix(rows.q[which])
    turned = A @ R.transpose(0, 2, 1)
    by_theta = turned @ cross_matrix(b)
    by_gyro = -by_theta @ within[rows.before[which]]
    n, unit = len(body), np.broadcast_to(np.eye(3), (len(body), 3, 3))
    by_matrix = np.einsum("ij,nk->nijk", np.eye(3), body).reshape(n, 3, 9)
    by_current = [one[:, None, None] * np.eye(3) for one in rows.current[which].T]
    return np.concatenate(
        [
            (1.0 - part) * by_theta,
            0.5 * by_gyro[:, :, :3],
            (1.0 - part) * unit,
            part * by_theta,
            0.5 * by_gyro[:, :, :3],
            part * unit,
            (body @ A.T / (1.0 + at.parameters[MODULUS]))[:, :, None],
            (turned @ by_inclination)[:, :, None],
            by_gyro,
            by_matrix,
            unit,
            -rows.rate[which][:, :, None],
            *by_current,
        ],
        axis=2,
    )


def _add_gyro(system: ArrowSystem, at: Estimate, sums: FloatArray, noise: Noise) -> None:
    """Add the rotations of the intervals that the gyro does not show, which are noise."""
    weight = noise.turn_weights(at.problem.inertial)[:, None, None]
    K, n, p = system.border.shape
    J, JP = np.zeros((K - 1, 3, 2 * n)), np.zeros((K - 1, 3, p))
    J[:, :, :3], J[:, :, n : n + 3] = -np.eye(3), np.eye(3)
    J[:, :, 3:6] = J[:, :, n + 3 : n + 6] = 0.5 * sums[:, :, :3]
    JP[:, :, GYRO_BIAS], JP[:, :, GYRO_MATRIX] = sums[:, :, :3], sums[:, :, 3:]
    system.add_pairs(weight * J, weight * JP, -weight[:, :, 0] * at.excess)


def _add_force(system: ArrowSystem, at: Estimate) -> None:
    """Add the mean specific force of the intervals."""
    data = at.problem.inertial
    K, n, p = system.border.shape
    residual, weight = at.force_residuals()
    force, force_part, R = at.mean_force
    J, JP = np.zeros((K - 1, 3, 2 * n)), np.zeros((K - 1, 3, p))
    # Residual = force - prediction; J is the derivative of the prediction minus the force.
    J[:, :, :3], J[:, :, n : n + 3] = cross_matrix(force - force_part), cross_matrix(force_part)
    per_s = np.eye(3) / data.span_s[:, None, None]
    J[:, :, 6:9], J[:, :, n + 6 : n + 9] = -per_s, per_s
    JP[:, 2, GRAVITY] = 1.0
    JP[:, :, FORCE] = R
    w = weight[:, None, None]
    system.add_pairs(w * J, w * JP, weight[:, None] * residual)


def _add_priors(system: ArrowSystem, at: Estimate, noise: Noise) -> None:
    """Add the slow processes, the first attitude and the priors of the parameters."""
    K, n, p = system.border.shape
    factor, weight = noise.slow_transitions(at.problem.inertial)
    slow = at.states[:, 3:]
    J = np.zeros((K - 1, n - 3, 2 * n))
    rows = np.arange(n - 3)
    J[:, rows, 3 + rows], J[:, rows, n + 3 + rows] = -factor * weight, weight
    speed = (at.thrust_speed(noise)[:, None] * weight[:, 3:5])[:, :, None]
    by_turn = 0.5 * at.parameters[THRUST] * speed * cross_matrix(at.thrust)[:, :2]
    J[:, 3:5, :3], J[:, 3:5, n : n + 3] = by_turn, by_turn
    JP = np.zeros((K - 1, n - 3, p))
    JP[:, 3:5, THRUST] = -speed[:, :, 0] * at.thrust[:, :2]
    system.add_pairs(J, JP, -at.slow_steps(noise) * weight)
    first = np.repeat(noise.sigma, 3) ** -2.0
    system.diagonal[0][3 + rows, 3 + rows] += first
    system.gradient[0][3:] -= first * slow[0]
    system.diagonal[0][:3, :3] += np.eye(3) / HEADING_RAD**2
    system.gradient[0][:3] -= at.start_turn() / HEADING_RAD**2
    information = at.problem.prior_sigma**-2.0
    system.corner[np.diag_indices(p)] += information
    system.corner_gradient[:] += information * (at.problem.prior - at.parameters)
