r"""State of several sources that one filter follows together, and the chart in which its errors are Gaussian.

Of every source it has position p, moment m, velocity v and rate of turn ω, and of all together the common field b. The
moment's error is a vector c, :math:`δ\ln|m|` along :math:`u = m/|m|` and a turn of u at right angles to it:
:math:`m^+ = |m| e^{u·c} \exp_u(c - (u·c) u)` with the exponential map of the sphere. In Cartesian coordinates the
filter believes itself too much, because |m| is known better than its direction.

The covariance's order is (p, c) of every source, b, then (v, ω) of every source: what a row sees comes first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc import core

N_SEEN = 6
"""Numbers of a source that a row sees: position and moment."""
N_OF_SOURCE = 12
N_COMMON = 3


@dataclass(frozen=True, eq=False)
class JointState:
    """K sources and the common field, with the covariance of their errors.

    Attributes
    ----------
    position_m, moment_Am2, velocity_m_s, rate_rad_s : ndarray, shape (..., K, 3)
        Leading axes: of the rows of a trajectory.
    common_T : ndarray, shape (..., 3)
    P : ndarray, shape (12 K + 3, 12 K + 3)
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    common_T: FloatArray
    P: FloatArray

    @classmethod
    def empty(cls, common_T: FloatArray, sigma_T: float) -> JointState:
        """No source yet."""
        none = np.zeros((0, 3))
        return cls(none, none, none, none, common_T, sigma_T**2 * np.eye(N_COMMON))

    @classmethod
    def unfilled(cls, n_sources: int) -> JointState:
        """Return a state whose arrays a kernel fills."""
        n = N_OF_SOURCE * n_sources + N_COMMON
        position_m, moment_Am2, velocity_m_s, rate_rad_s = np.empty((4, n_sources, 3))
        return cls(position_m, moment_Am2, velocity_m_s, rate_rad_s, np.empty(N_COMMON), np.empty((n, n)))

    @property
    def n_sources(self) -> int:
        """K."""
        return self.position_m.shape[-2]

    @cached_property
    def problem(self) -> core.Problem:
        """Struct that describes the state to the kernels."""
        return core.problem(
            "joint_state",
            n_sources=self.n_sources,
            position=np.ascontiguousarray(self.position_m),
            moment=np.ascontiguousarray(self.moment_Am2),
            velocity=np.ascontiguousarray(self.velocity_m_s),
            rate=np.ascontiguousarray(self.rate_rad_s),
            common=np.ascontiguousarray(self.common_T),
            covariance=np.ascontiguousarray(self.P),
        )

    @property
    def n_seen(self) -> int:
        """Leading numbers of the error that a row sees."""
        return N_SEEN * self.n_sources + N_COMMON

    @property
    def of_source(self) -> IntArray:
        """Places (K, 12) of every source's errors (p, c, v, ω) in the covariance."""
        return places_of(self.n_sources)

    def moved(self, error: FloatArray) -> JointState:
        """The state that an error (..., n), or what a row sees of it, leads to; the covariance stays as it is."""
        c = error[..., : N_SEEN * self.n_sources].reshape(*error.shape[:-1], self.n_sources, N_SEEN)[..., 3:]
        return self.moved_to(error, moved_moment(self.moment_Am2, c), self.P)

    def moved_to(self, error: FloatArray, moment_Am2: FloatArray, P: FloatArray) -> JointState:
        """The same, with the moments (..., K, 3) that the error leads to, and the covariance there."""
        end, seen, each = N_SEEN * self.n_sources, self.n_seen, (*error.shape[:-1], -1, N_SEEN)
        of_seen, of_motion = error[..., :end].reshape(each), error[..., seen:].reshape(each)
        velocity_m_s, rate_rad_s = self.velocity_m_s, self.rate_rad_s
        if of_motion.size:
            velocity_m_s, rate_rad_s = velocity_m_s + of_motion[..., :3], rate_rad_s + of_motion[..., 3:]
        position_m, common_T = self.position_m + of_seen[..., :3], self.common_T + error[..., end:seen]
        return JointState(position_m, moment_Am2, velocity_m_s, rate_rad_s, common_T, P)

    def moved_with(self, error: FloatArray, P: FloatArray) -> JointState:
        """The same with a covariance P of errors in this state's chart, brought into the chart there."""
        k, moved, P = self.n_sources, self.moved(error), P.copy()
        c = error[: N_SEEN * k].reshape(k, N_SEEN)[:, 3:]
        length = np.linalg.norm(moved.moment_Am2, axis=1)[:, None, None]
        turned, of_c = moment_derivative(self.moment_Am2, c) / length, self.of_source[:, 3:N_SEEN]
        for one in (P, P.T):
            one[of_c] = turned @ one[of_c]
        return replace(moved, P=P)

    @cached_property
    def covariances(self) -> FloatArray:
        """Second moments (K, 6, 6) of the Cartesian errors of the sources' positions and moments.

        Where |m| is known better than its direction, what turns leave of a moment's length is more than the error of
        |m| itself: 1 - cos δ ≈ δ²/2, whose mean square is (tr² Σ + 2 tr Σ²)/4 for turns of covariance Σ.
        """
        m, d = self.moment_Am2, N_SEEN * self.n_sources
        square = np.vecdot(m, m)[:, None, None]
        own = np.arange(self.n_sources)
        P = self.P[:d, :d].reshape(self.n_sources, N_SEEN, self.n_sources, N_SEEN)[own, :, own]
        across = np.eye(3) - m[:, :, None] * m[:, None] / square
        turns = across @ P[:, 3:, 3:] @ across
        trace = np.trace(turns, axis1=1, axis2=2)
        shorter = 0.25 * trace**2 + 0.5 * np.sum(turns * turns, axis=(1, 2))
        scale = np.ones((self.n_sources, N_SEEN))
        scale[:, 3:] = np.sqrt(square[:, 0])
        covariances: FloatArray = P * scale[:, :, None] * scale[:, None]
        covariances[:, 3:, 3:] += shorter[:, None, None] * m[:, :, None] * m[:, None]
        return covariances

    def log_strength_sigma(self, source: int) -> float:
        """Standard deviation of ln |m| of a source."""
        at, moment = self.of_source[source, 3:N_SEEN], self.moment_Am2[source]
        return float(np.sqrt(np.maximum(moment @ self.P[np.ix_(at, at)] @ moment, 0.0)) / np.linalg.norm(moment))

    def gap(self, first: int, second: int) -> tuple[float, float]:
        """Distance between two sources, and its standard deviation [m]."""
        offset = self.position_m[first] - self.position_m[second]
        distance = float(np.linalg.norm(offset))
        direction = offset / distance if distance else np.array([1.0, 0.0, 0.0])
        along = np.zeros(len(self.P))
        along[self.of_source[first, :3]], along[self.of_source[second, :3]] = direction, -direction
        return distance, float(np.sqrt(np.maximum(along @ self.P @ along, 0.0)))

    @property
    def common_alone(self) -> JointState:
        """What is known of the common field, and no source."""
        at = slice(self.n_seen - N_COMMON, self.n_seen)
        return replace(JointState.empty(self.common_T, 0.0), P=self.P[at, at].copy())

    def without(self, source: int) -> JointState:
        """The state of the others."""
        P = np.delete(np.delete(self.P, self.of_source[source], 0), self.of_source[source], 1)
        others = np.arange(self.n_sources) != source
        return JointState(
            self.position_m[others],
            self.moment_Am2[others],
            self.velocity_m_s[others],
            self.rate_rad_s[others],
            self.common_T,
            P,
        )

    def with_sources(self, position_m: FloatArray, moment_Am2: FloatArray, covariance: FloatArray) -> JointState:
        """The state with other sources (j, 3), last, at rest: covariances (j, 12, 12) of their (p, c, v, ω)."""
        # What a row sees of them stands before the common field, their motion behind all others.
        known, n = self.n_sources, self.n_sources + len(position_m)
        places, rest = places_of(n), np.zeros((len(position_m), 3))
        seen, behind = np.arange(N_SEEN * known), N_SEEN * n + np.arange(N_COMMON)
        old = np.concatenate([seen, behind, N_SEEN * n + N_COMMON + seen])
        P, new = np.zeros((N_OF_SOURCE * n + N_COMMON,) * 2), places[known:]
        P[old[:, None], old] = self.P
        P[new[:, :, None], new[:, None]] = covariance
        return JointState(
            np.concatenate([self.position_m, position_m]),
            np.concatenate([self.moment_Am2, moment_Am2]),
            np.concatenate([self.velocity_m_s, rest]),
            np.concatenate([self.rate_rad_s, rest]),
            self.common_T,
            P,
        )


def places_of(n_sources: int) -> IntArray:
    """Places (K, 12) of (p, c, v, ω) of every source in the covariance of K sources."""
    seen = np.arange(N_SEEN * n_sources).reshape(n_sources, N_SEEN)
    return np.concatenate([seen, seen + N_SEEN * n_sources + N_COMMON], axis=1)


def moved_moment(moment_Am2: FloatArray, c: FloatArray) -> FloatArray:
    """Moments (..., 3) that errors c (..., 3) lead to."""
    length, u, along, turn, angle = _parts(moment_Am2, c)
    with np.errstate(over="ignore", invalid="ignore"):  # a moment beyond all numbers explains nothing
        moved: FloatArray = length * np.exp(along) * (np.cos(angle) * u + np.sinc(angle / np.pi) * turn)
    return moved


def moment_derivative(moment_Am2: FloatArray, c: FloatArray) -> FloatArray:
    """Derivative (..., 3, 3) of :func:`moved_moment` with respect to c; |m| times the identity at c = 0."""
    length, u, along, turn, angle = _parts(moment_Am2, c)
    sinc, cosine = np.sinc(angle / np.pi), np.cos(angle)
    # (cos a - sin a / a) / a², by series where it cancels.
    small = angle < 1e-2
    square = np.where(small, 1.0, angle) ** 2
    bend = np.where(small, angle**2 / 30.0 - 1.0 / 3.0, (cosine - sinc) / square)
    by_turn = (sinc * np.eye(3).ravel()).reshape(*c.shape, 3)
    by_turn = by_turn - (sinc * u)[..., :, None] * turn[..., None, :]
    by_turn = by_turn + (bend * turn)[..., :, None] * turn[..., None, :]
    by_turn = by_turn - (by_turn @ u[..., None]) * u[..., None, :]
    direction = cosine * u + sinc * turn
    derivative: FloatArray = (length * np.exp(along))[..., None] * (direction[..., :, None] * u[..., None, :] + by_turn)
    return derivative


def _parts(moment_Am2: FloatArray, c: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Modulus, direction, and of the error its part along it, the turn and the angle; the scalars (..., 1)."""
    length = np.sqrt(np.vecdot(moment_Am2, moment_Am2))[..., None]
    u = moment_Am2 / length
    along = np.vecdot(u, c)[..., None]
    turn = c - along * u
    return length, u, along, turn, np.sqrt(np.vecdot(turn, turn))[..., None]
