"""Compiled loops of :mod:`adcs.complementary.heading`, in matrices; filterpy's filter and smoother hold them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magloc.compilation import compiled

Array = NDArray[np.float64]
SIZE = 14
"""Numbers of the state: heading, drift; gyro's scales, sensor's offset, room's slow and quick variation, 3 each."""


class Noise(NamedTuple):
    """What the filter believes, 1 σ: :class:`adcs.complementary.heading.HeadingModel` explains each."""

    reading_T: float
    walk_rad_rts: float
    drift_rad_s: float
    drift_s: float
    offset_T_rts: float
    room_T: float
    room_s: float
    local_T: float
    local_up_T: float
    local_s: float
    gap_rad_s: float


class Blocks(NamedTuple):
    """Means over short times (m of them), in the frame that is level and whose heading is the gyro's."""

    field_T: Array  # (m, 3)
    R_level: Array  # (m, 3, 3): level from body
    rate_rad_s: Array  # (m, 3): body axes
    dt_s: Array  # (m,)
    gap_s: Array  # (m,): of it without a gyro
    turns: Array  # (m,): 1 where the sensor turns, 0 where it lies still
    start_T: Array  # (3,): east, north, up: the field at the start


class Tests(NamedTuple):
    """When a reading is left out, and when an offset is taken to have changed."""

    gate: float
    mean_nis: float
    memory: float
    patience_s: float
    jump_T: float
    evidence: float
    trial_s: float


@compiled
def predict(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise) -> tuple[Array, Array, Array]:
    """State, covariance and Φ of block i from those of the block before."""
    h, turns = blocks.dt_s[i], blocks.turns[i]
    F, Q = np.eye(SIZE), np.zeros(SIZE)
    F[0, 1] = h * turns
    F[0, 2:5] = h * blocks.R_level[i, 2] * blocks.rate_rad_s[i]
    Q[0] = noise.walk_rad_rts**2 * h * turns + (noise.gap_rad_s * blocks.gap_s[i]) ** 2
    keeps = np.exp(-h * turns / noise.drift_s)
    F[1, 1], Q[1] = keeps, noise.drift_rad_s**2 * (1.0 - keeps**2)
    Q[5:8] = noise.offset_T_rts**2 * h
    keeps = np.exp(-h * turns / noise.room_s)
    for k in range(8, 11):
        F[k, k], Q[k] = keeps, noise.room_T**2 * (1.0 - keeps**2)
    keeps = np.exp(-h / noise.local_s)
    for k in range(11, 14):
        sigma = noise.local_up_T if k == 13 else noise.local_T
        F[k, k], Q[k] = keeps, sigma**2 * (1.0 - keeps**2)
    P = F @ P @ F.T
    for k in range(SIZE):
        P[k, k] += Q[k]
    return F @ x, P, F


@compiled
def innovation(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise) -> tuple[Array, Array, Array, float]:
    """Innovation (3,), its covariance, H, and its normalised square."""
    c, s = np.cos(x[0]), np.sin(x[0])
    room = blocks.start_T + x[8:11] + x[11:14]
    level = np.array([c * room[0] - s * room[1], s * room[0] + c * room[1], room[2]])
    R = blocks.R_level[i]
    H = np.zeros((3, SIZE))
    H[0, 0], H[1, 0] = -level[1], level[0]
    H[:, 5:8] = R
    for k in (8, 11):
        H[0, k], H[0, k + 1], H[1, k], H[1, k + 1], H[2, k + 2] = c, -s, s, c, 1.0
    nu = blocks.field_T[i] - level - R @ x[5:8].copy()
    S = H @ P @ H.T + noise.reading_T**2 * np.eye(3)
    return nu, S, H, nu @ np.linalg.solve(S, nu)


@compiled
def update(x: Array, P: Array, nu: Array, S: Array, H: Array) -> tuple[Array, Array]:
    """Kalman's update."""
    K = np.linalg.solve(S, H @ P).T
    P = P - K @ S @ K.T
    return x + K @ nu, 0.5 * (P + P.T)


@compiled
def tried(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise) -> tuple[Array, Array, float]:
    """State and covariance with reading i, whatever it is, and its logarithmic likelihood, not less than -50."""
    x, P, _ = predict(x, P, i, blocks, noise)
    nu, S, H, nis = innovation(x, P, i, blocks, noise)
    x, P = update(x, P, nu, S, H)
    return x, P, max(-0.5 * (nis + np.log(np.linalg.det(S * 1e12))), -50.0)


@compiled
def run(
    x: Array,
    P: Array,
    blocks: Blocks,
    noise: Noise,
    anywhere: Noise,
    tests: Tests,
    xs: Array,
    Ps: Array,
    used: NDArray[np.int64],
    known: NDArray[np.int64],
) -> None:
    """The filter over all blocks: states (m, 14), covariances, which readings were used, and which are in hindsight.

    A reading is left out where it, or the mean of the last ones, contradicts the state. When that goes on for a while,
    three others run beside the filter from there: one whose sensor's offset changed, one whose room's field did, and
    one in whose room it is another one everywhere. The first takes over when the readings speak for it against both
    others, which only turns can make them do; ``known`` is 2 where it began then. All end when the filter agrees with
    its readings again.
    """
    smoothed, wrong_s, right_s, trial_s, began = 0.0, 0.0, 0.0, -1.0, 0
    others, covariances, odds = np.empty((3, SIZE)), np.empty((3, SIZE, SIZE)), np.zeros(3)
    for i in range(len(xs)):
        h = blocks.dt_s[i]
        x_before, P_before = x, P
        x, P, _ = predict(x, P, i, blocks, noise)
        nu, S, H, nis = innovation(x, P, i, blocks, noise)
        smoothed = tests.memory * smoothed + (1.0 - tests.memory) * min(nis, 2.0 * tests.gate) / 3.0
        if nis <= tests.gate and smoothed <= tests.mean_nis:
            x, P = update(x, P, nu, S, H)
            used[i], known[i] = 1, 1
            right_s += h
            wrong_s = wrong_s if right_s < tests.patience_s else 0.0
        else:
            wrong_s, right_s = wrong_s + h, 0.0
        if trial_s < 0.0 and wrong_s > tests.patience_s and tests.evidence < np.inf:
            trial_s, began, odds[:] = 0.0, i, 0.0
            for other in range(3):
                others[other], covariances[other] = x_before, P_before
                for k in range(3):
                    changed = k + (5 if other == 0 else 8)
                    covariances[other, changed, changed] += tests.jump_T**2
        if trial_s >= 0.0:
            trial_s += h
            for other in range(3):
                with_noise = noise if other < 2 else anywhere
                others[other], covariances[other], likelihood = tried(
                    others[other].copy(), covariances[other].copy(), i, blocks, with_noise
                )
                odds[other] += likelihood
            against = odds[0] - max(odds[1], odds[2])
            if right_s > 3.0 * tests.patience_s:
                trial_s, wrong_s = -1.0, 0.0
            elif against > tests.evidence and trial_s > tests.patience_s:
                x, P = others[0].copy(), covariances[0].copy()
                known[began : i + 1] = 1
                known[began] = 2
                smoothed, trial_s, wrong_s = 0.0, -1.0, 0.0
            elif against < -abs(tests.evidence) or trial_s > tests.trial_s:
                trial_s = -1.0
        xs[i], Ps[i] = x, P


@compiled
def smooth(
    x: Array,
    P: Array,
    blocks: Blocks,
    noise: Noise,
    jump_T: float,
    known: NDArray[np.int64],
    xs: Array,
    Ps: Array,
) -> None:
    """Rauch-Tung-Striebel smoother, of the readings that are used in hindsight: states (m, 14) and covariances."""
    n = len(xs)
    before, P_before, Phi = np.empty_like(xs), np.empty_like(Ps), np.empty_like(Ps)
    for i in range(n):
        if known[i] == 2:
            P = P.copy()
            for k in range(5, 8):
                P[k, k] += jump_T**2
        x, P, Phi[i] = predict(x, P, i, blocks, noise)
        before[i], P_before[i] = x, P
        if known[i] > 0:
            nu, S, H, _ = innovation(x, P, i, blocks, noise)
            x, P = update(x, P, nu, S, H)
        xs[i], Ps[i] = x, P
    for i in range(n - 2, -1, -1):
        C = np.linalg.solve(P_before[i + 1], Phi[i + 1] @ Ps[i]).T
        xs[i] = xs[i] + C @ (xs[i + 1] - before[i + 1])
        P = Ps[i] + C @ (Ps[i + 1] - P_before[i + 1]) @ C.T
        Ps[i] = 0.5 * (P + P.T)
