"""The complementary filters and the adaptive one, instant by instant in NumPy: the oracle of the compiled ones.

See docs/theory/complementary-filters.md for the formulas.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTuning
from adcs.complementary.explicit import BEST_GAINS, Gains, complementary_track, correction_times_s, first_attitude
from adcs.complementary.outage import NO_SUBSTITUTE, Substitution, delay_steps
from adcs.satellite.vector_record import VectorRecord
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

MU = 1e-6
"""Added to the diagonal of the normal equations."""
Pair = tuple[FloatArray, FloatArray]
gauss_newton_track = partial(complementary_track, method="gauss-newton")


def explicit_error(
    q: FloatArray, vectors: list[tuple[FloatArray, FloatArray]], weights: tuple[float, ...] = (1.0, 1.0)
) -> FloatArray:
    """Error angle e = Σ weight · v × A(q̂) v_reference.

    ``q`` (4,): estimate, reference from body. ``vectors``: unit vectors (3,), NaN where missing. Returns (3,): body
    axes [rad]: for two unit vectors Σ (E - vvᵀ) δθ of a small error δθ.
    """
    e = np.zeros(3)
    for (body, reference), weight in zip(vectors, weights, strict=True):
        if np.isfinite(body).all():
            e = e + weight * np.cross(body, quaternion.rotate_back(q, reference))
    return e


def homogeneous_rotation(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """R(q)v, |q|² times the rotated vector: shapes (4,), (3,) -> (3,)."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    scalar, p = q[0], q[1:]
    return (scalar**2 - p @ p) * v + 2.0 * p * (p @ v) + 2.0 * scalar * np.cross(p, v)


def rotation_derivative(q: ArrayLike, v: ArrayLike) -> FloatArray:
    """Derivative of :func:`homogeneous_rotation` by q. Shapes (4,), (3,) -> (3, 4)."""
    q, v = np.asarray(q, dtype=np.float64), np.asarray(v, dtype=np.float64)
    scalar, p = q[0], q[1:]
    by_scalar = 2.0 * scalar * v + 2.0 * np.cross(p, v)
    by_vector = (
        -2.0 * np.outer(v, p) + 2.0 * (p @ v) * np.eye(3) + 2.0 * np.outer(p, v) - 2.0 * scalar * cross_matrix(v)
    )
    return np.column_stack([by_scalar, by_vector])


def gauss_newton_step(q: FloatArray, vectors: list[tuple[FloatArray, FloatArray]], mu: float = MU) -> FloatArray:
    """One step q - (AᵀA + μE)⁻¹Aᵀε, normalised.

    ``q`` (4,): unit quaternion, reference from body. ``vectors``: unit vectors (3,); those with NaN are ignored. With
    one vector the turn around it stays as it is. Returns shape (4,).
    """
    present = [(body, reference) for body, reference in vectors if np.isfinite(body).all()]
    if not present:
        return q
    A = -np.concatenate([rotation_derivative(q, body) for body, _ in present])
    residual = np.concatenate([reference - homogeneous_rotation(q, body) for body, reference in present])
    step = np.linalg.solve(A.T @ A + mu * np.eye(4), A.T @ residual)
    return quaternion.normalised(q - step)


class MeasuredQuaternion:
    """Error angle to the measured quaternion, e = 2 vec(q̂*∘q_measured); a correction of :func:`steps`.

    ``q`` (4,): the last measured quaternion. The next one starts from it where both vectors are there, from the
    estimate else.
    """

    def __init__(self, mu: float = MU) -> None:
        self._mu = mu
        self.q: FloatArray | None = None

    def __call__(self, q: FloatArray, vectors: list[tuple[FloatArray, FloatArray]]) -> FloatArray:
        """Error angle (3,) of an estimate."""
        both = all(np.isfinite(body).all() for body, _ in vectors)
        start = q if self.q is None or not both else self.q
        self.q = gauss_newton_step(start, vectors, self._mu)
        return 2.0 * quaternion.error_vector(q, self.q)


class Substitute:
    """The delay line of one run: measured first vectors, never one that was put in place of another.

    ``n_steps``: M.
    """

    def __init__(self, substitution: Substitution, n_steps: int) -> None:
        self._rule = substitution.rule
        self._line: deque[tuple[Pair, FloatArray, FloatArray]] = deque(maxlen=max(n_steps, 1))
        self._p = self._c = quaternion.IDENTITY

    def vector(self, first: Pair) -> Pair:
        """(body, reference) in place of the second vector now; NaN where there is none.

        ``first``: of this instant, the shapes of the answer.
        """
        missing = np.full_like(first[0], np.nan)
        if self._rule == "magnetometer-only" or len(self._line) < (self._line.maxlen or 0):
            return missing, missing
        (body, reference), p_then, c_then = self._line[0]
        if self._rule == "raw":
            return body, reference
        return (
            quaternion.rotate_back(quaternion.multiply(quaternion.conjugate(p_then), self._p), body),
            quaternion.rotate_back(quaternion.multiply(quaternion.conjugate(c_then), self._c), reference),
        )

    def store(self, first: Pair) -> None:
        """Store this instant's first vector."""
        self._line.append((first, self._p, self._c))

    def turn(self, body_rad: FloatArray, frame_rad: FloatArray) -> None:
        """Go on to the next instant by the rotations of body and frame [rad]."""
        self._p = quaternion.normalised(quaternion.multiply(self._p, quaternion.exp(body_rad)))
        self._c = quaternion.normalised(quaternion.multiply(self._c, quaternion.exp(frame_rad)))


Correction = Callable[[FloatArray, list[tuple[FloatArray, FloatArray]]], FloatArray]


def steps(
    record: VectorRecord,
    correction: Correction,
    gains: Gains = BEST_GAINS,
    *,
    q_start: ArrayLike = quaternion.IDENTITY,
    substitution: Substitution = NO_SUBSTITUTE,
    run: int = 0,
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Readable reference of the compiled filters: (q̂, I) of one run at every instant.

    ``correction``: error angle e of an estimate and the instant's two unit vectors, such as :func:`explicit_error` or
    :class:`MeasuredQuaternion`. ``gains``, ``q_start``, ``substitution``: as
    :func:`adcs.complementary.explicit.complementary_track`. Yields ``q`` (4,), ``integral`` (3,).
    """
    shared = 0 if record.first_reference.shape[0] == 1 else run
    q, integral, smooth = first_attitude(q_start), np.zeros(3), np.zeros(3)
    line = Substitute(substitution, delay_steps(substitution, record.usual_dt_s))
    counted = correction_times_s(record, gains)
    for i in range(len(record)):
        if i > 0:
            body_rad = (record.rate_rad_s[run, i] + integral) * record.dt_s[i]
            frame_rad = record.frame_rate_rad_s[shared, i] * record.dt_s[i]
            line.turn(body_rad, frame_rad)
            q = turned(q, body_rad, frame_rad)
        first = _unit(record.first_body[run, i]), _unit(record.first_reference[shared, i])
        second = _unit(record.second_body[run, i]), _unit(record.second_reference[shared, i])
        outage = bool(np.isnan(second[0]).any())
        e = correction(q, [first, line.vector(first) if outage else second])
        kp, ki = gains.during(outage)
        smooth = gains.boost_memory * smooth + (1.0 - gains.boost_memory) * e
        if np.linalg.norm(smooth) > gains.boost_level_rad:
            ki *= gains.boost
        integral = integral + ki * counted[i] * e
        line.store(first)
        q = quaternion.normalised(quaternion.multiply(q, quaternion.exp(kp * counted[i] * e)))
        yield q, integral


def turned(q: FloatArray, body_rad: FloatArray, frame_rad: FloatArray) -> FloatArray:
    """Attitude after a turn of the body and one of the reference frame, both against inertial space, rotation vectors.

    Shapes (4,), (3,), (3,) -> (4,).
    """
    of_frame = quaternion.multiply(quaternion.exp(-frame_rad), q)
    return quaternion.normalised(quaternion.multiply(of_frame, quaternion.exp(body_rad)))


def _unit(v: FloatArray) -> FloatArray:
    return v / np.linalg.norm(v)


def adaptive_steps(
    record: VectorRecord,
    tuning: AdaptiveTuning = AdaptiveTuning(),  # noqa: B008 - frozen
    *,
    q_start: ArrayLike = quaternion.IDENTITY,
    run: int = 0,
) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
    """Readable reference of the adaptive filter: attitude, bias and covariance of one run at every instant.

    Yields ``q`` (4,), ``bias`` (3,), ``covariance`` (6, 6).
    """
    shared = 0 if record.first_reference.shape[0] == 1 else run
    q, bias, P, smoothed, growth = first_attitude(q_start), np.zeros(3), tuning.start_covariance, 1.0, 0.0
    for i in range(len(record)):
        if i > 0:
            h = float(record.dt_s[i])
            w = record.rate_rad_s[run, i] - bias
            Phi = np.eye(6)
            Phi[:3, :3] = quaternion.matrix(quaternion.exp(w * h)).T
            Phi[:3, 3:] = -h * np.eye(3)
            noise = np.repeat([tuning.attitude_noise_rad**2, tuning.bias_noise_rad_s**2 + growth**2], 3)
            P = Phi @ P @ Phi.T + np.diag(noise) * h / record.usual_dt_s
            q = turned(q, w * h, record.frame_rate_rad_s[shared, i] * h)
        rows, residuals, variances = [], [], []
        first, second = record.first_body[run, i], record.second_body[run, i]
        for measured, reference, sigma in (
            (first, record.first_reference[shared, i], tuning.first_sigma / np.linalg.norm(first)),
            (second, record.second_reference[shared, i], tuning.second_sigma_rad),
        ):
            if np.isnan(measured).any():
                continue
            predicted = quaternion.rotate_back(q, reference / np.linalg.norm(reference))
            # Two axes across the predicted vector.
            across = np.linalg.svd(predicted[None])[2][1:]
            rows.append(across @ cross_matrix(predicted))
            residuals.append(across @ (measured / np.linalg.norm(measured)))
            variances.append(np.full(2, sigma**2))
        if rows:
            H = np.column_stack([np.concatenate(rows), np.zeros((2 * len(rows), 3))])
            nu = np.concatenate(residuals)
            S = H @ P @ H.T + np.diag(np.concatenate(variances))
            K = np.linalg.solve(S, H @ P).T
            x = K @ nu
            P = P - K @ S @ K.T
            q = quaternion.normalised(quaternion.multiply(q, quaternion.exp(x[:3])))
            bias = bias + x[3:]
            nis = float(nu @ np.linalg.solve(S, nu)) / len(nu)
            smoothed = tuning.memory * smoothed + (1.0 - tuning.memory) * nis
        # Only readings show that the bias changes.
        growth = tuning.growth_rad_s if rows and smoothed > tuning.threshold else 0.0
        yield q, bias, P
