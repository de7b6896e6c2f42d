"""Compiled loops of :mod:`adcs.complementary.heading`, in matrices; filterpy's filter and smoother hold them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from magloc.compilation import compiled, internal

Array = NDArray[np.float64]
SIZE = 14
"""Numbers of the state: heading, drift; gyro's scales, sensor's offset, room's slow and quick variation, 3 each."""
TOLD = (0, 5, 6, 7)
"""Those that are told: heading and offset."""
LOST_RAD = 0.5
"""Beyond this deviation of the heading the field tells it alone: it is too far for a linear update."""


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


class Blocks(NamedTuple):
    """Means over short times (m of them), in the frame that is level and whose heading is the gyro's."""

    field_T: Array  # (m, 3)
    R_level: Array  # (m, 3, 3): level from body
    rate_rad_s: Array  # (m, 3): body axes
    dt_s: Array  # (m,)
    gap_rad2: Array  # (m,): variance of the turn that a gap of the gyro hides within it
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


class Step(NamedTuple):
    """What one block makes of the state, written anew for each."""

    turn: Array  # (14,): what each state adds to the heading,
    keeps: Array  # (14,): and what is left of it: Φ has zeros elsewhere
    H: Array  # (3, 14)
    HP: Array  # (3, 14)
    gain: Array  # (3, 14): Kalman's, transposed
    nu: Array  # (3,): innovation
    S: Array  # (3, 3): its covariance
    S_inverse: Array  # (3, 3)
    jump: Array  # (1,): by which a lost heading was turned to the field


@internal
def new_step() -> Step:
    """Room for one."""
    wide, small = np.zeros((3, 3, SIZE)), np.zeros((2, 3, 3))
    return Step(np.zeros(SIZE), np.ones(SIZE), wide[0], wide[1], wide[2], np.zeros(3), small[0], small[1], np.zeros(1))


@internal
def predict(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise, step: Step) -> None:
    """State and covariance of block i, in place of those of the block before."""
    h, turns, turn, keeps = blocks.dt_s[i], blocks.turns[i], step.turn, step.keeps
    turn[1] = h * turns
    for k in range(3):
        turn[2 + k] = h * blocks.R_level[i, 2, k] * blocks.rate_rad_s[i, k]
    keeps[1] = np.exp(-h * turns / noise.drift_s)
    keeps[8:11] = np.exp(-h * turns / noise.room_s)
    keeps[11:14] = np.exp(-h / noise.local_s)
    for k in range(1, 5):
        x[0] += turn[k] * x[k]
        P[0, 0] += turn[k] * P[0, k]
    for k in range(1, 5):
        for j in range(1, SIZE):
            P[0, j] += turn[k] * P[k, j]
    for k in range(1, 5):
        P[0, 0] += turn[k] * P[0, k]
    P[1:, 0] = P[0, 1:]
    for j in range(SIZE):
        x[j] *= keeps[j]
        for k in range(SIZE):
            P[j, k] *= keeps[j] * keeps[k]
    P[0, 0] += noise.walk_rad_rts**2 * h * turns + blocks.gap_rad2[i]
    P[1, 1] += noise.drift_rad_s**2 * (1.0 - keeps[1] ** 2)
    for k in range(3):
        local_T = noise.local_up_T if k == 2 else noise.local_T
        P[5 + k, 5 + k] += noise.offset_T_rts**2 * h
        P[8 + k, 8 + k] += noise.room_T**2 * (1.0 - keeps[8] ** 2)
        P[11 + k, 11 + k] += local_T**2 * (1.0 - keeps[11] ** 2)


@internal
def innovation(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise, step: Step) -> float:
    """Normalised square of a block's innovation; a heading that is lost is first turned to the field."""
    H, HP, nu, S, R = step.H, step.HP, step.nu, step.S, blocks.R_level[i]
    east, north = blocks.start_T[0] + x[8] + x[11], blocks.start_T[1] + x[9] + x[12]
    step.jump[0] = 0.0
    if P[0, 0] > LOST_RAD**2:
        seen = blocks.field_T[i] - R @ x[5:8]
        step.jump[0] = np.arctan2(seen[1], seen[0]) - np.arctan2(north, east) - x[0]
        x[0] += step.jump[0]
    c, s = np.cos(x[0]), np.sin(x[0])
    level = (c * east - s * north, s * east + c * north, blocks.start_T[2] + x[10] + x[13])
    H[0, 0], H[1, 0] = -level[1], level[0]
    H[:, 5:8] = R
    for k in (8, 11):
        H[0, k], H[0, k + 1], H[1, k], H[1, k + 1], H[2, k + 2] = c, -s, s, c, 1.0
    HP[:] = 0.0
    for a in range(3):
        nu[a] = blocks.field_T[i, a] - level[a] - R[a, 0] * x[5] - R[a, 1] * x[6] - R[a, 2] * x[7]
        for k in range(SIZE):
            if H[a, k] != 0.0:
                for j in range(SIZE):
                    HP[a, j] += H[a, k] * P[k, j]
        for b in range(3):
            S[a, b] = noise.reading_T**2 if a == b else 0.0
            for j in range(SIZE):
                S[a, b] += HP[a, j] * H[b, j]
    determinant = _determinant(S)
    nis = 0.0
    for a in range(3):
        b, d = (a + 1) % 3, (a + 2) % 3
        for k in range(3):
            m, n = (k + 1) % 3, (k + 2) % 3
            step.S_inverse[a, k] = (S[b, m] * S[d, n] - S[b, n] * S[d, m]) / determinant
            nis += nu[a] * step.S_inverse[a, k] * nu[k]
    return nis


@internal
def _determinant(S: Array) -> float:
    return (
        S[0, 0] * (S[1, 1] * S[2, 2] - S[1, 2] * S[2, 1])
        + S[0, 1] * (S[1, 2] * S[2, 0] - S[1, 0] * S[2, 2])
        + S[0, 2] * (S[1, 0] * S[2, 1] - S[1, 1] * S[2, 0])
    )


@internal
def update(x: Array, P: Array, step: Step) -> None:
    """Kalman's update, in place."""
    gain, HP, nu, inverse = step.gain, step.HP, step.nu, step.S_inverse
    for j in range(SIZE):
        for a in range(3):
            gain[a, j] = inverse[a, 0] * HP[0, j] + inverse[a, 1] * HP[1, j] + inverse[a, 2] * HP[2, j]
        x[j] += gain[0, j] * nu[0] + gain[1, j] * nu[1] + gain[2, j] * nu[2]
    for j in range(SIZE):
        for k in range(j, SIZE):
            P[j, k] -= HP[0, j] * gain[0, k] + HP[1, j] * gain[1, k] + HP[2, j] * gain[2, k]
            P[k, j] = P[j, k]


@internal
def tried(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise, step: Step) -> float:
    """Go on with reading i, whatever it is; its logarithmic likelihood, not less than -50."""
    predict(x, P, i, blocks, noise, step)
    nis = innovation(x, P, i, blocks, noise, step)
    update(x, P, step)
    return max(-0.5 * (nis + np.log(1e36 * _determinant(step.S))), -50.0)


@compiled
def run(
    x: Array,
    P: Array,
    blocks: Blocks,
    noise: Noise,
    anywhere: Noise,
    tests: Tests,
    told: Array,
    variances: Array,
    used: NDArray[np.int64],
    known: NDArray[np.int64],
) -> None:
    """The filter over all blocks: states (m, 4), variances, which readings were used, and which are in hindsight.

    A reading is left out where it, or the mean of the last ones, contradicts the state. When that goes on for a while,
    three others run beside the filter from there: one whose sensor's offset changed, one whose room's field did, and
    one in whose room it is another one everywhere. The first takes over when the readings speak for it against both
    others, which only turns can make them do; ``known`` is 2 where it began then. All end when the filter agrees with
    its readings again.
    """
    step = new_step()
    smoothed, wrong_s, right_s, trial_s, began = 0.0, 0.0, 0.0, -1.0, 0
    others, covariances, odds = np.empty((3, SIZE)), np.empty((3, SIZE, SIZE)), np.zeros(3)
    x_before, P_before = x.copy(), P.copy()
    for i in range(len(told)):
        h = blocks.dt_s[i]
        x_before[:], P_before[:] = x, P
        predict(x, P, i, blocks, noise, step)
        nis = innovation(x, P, i, blocks, noise, step)
        smoothed = tests.memory * smoothed + (1.0 - tests.memory) * min(nis, 2.0 * tests.gate) / 3.0
        # A heading that was turned to the field agrees with any direction: length and dip have to be right.
        gate = tests.gate if P[0, 0] <= LOST_RAD**2 else min(tests.gate, 3.0 * tests.mean_nis)
        if nis <= gate and smoothed <= tests.mean_nis:
            update(x, P, step)
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
                odds[other] += tried(others[other], covariances[other], i, blocks, with_noise, step)
            against = odds[0] - max(odds[1], odds[2])
            if right_s > 3.0 * tests.patience_s:
                trial_s, wrong_s = -1.0, 0.0
            elif against > tests.evidence and trial_s > tests.patience_s:
                x[:], P[:] = others[0], covariances[0]
                known[began : i + 1] = 1
                known[began] = 2
                smoothed, trial_s, wrong_s = 0.0, -1.0, 0.0
            elif against < -abs(tests.evidence) or trial_s > tests.trial_s:
                trial_s = -1.0
        for k in range(4):
            told[i, k], variances[i, k] = x[TOLD[k]], P[TOLD[k], TOLD[k]]


@internal
def _forward(x: Array, P: Array, i: int, blocks: Blocks, noise: Noise, jump_T: float, known: int, step: Step) -> None:
    """Predict and update, of what is known of a reading in hindsight."""
    if known == 2:
        for k in range(5, 8):
            P[k, k] += jump_T**2
    predict(x, P, i, blocks, noise, step)
    if known > 0:
        innovation(x, P, i, blocks, noise, step)
        update(x, P, step)


@internal
def _back(score: Array, information: Array, known: int, step: Step) -> None:
    """Take what later readings say of a block to the one before, with what its own reading says."""
    H, gain, turn, keeps = step.H, step.gain, step.turn, step.keeps
    if known > 0:
        # (I - KH)ᵀ Λ (I - KH) + HᵀS⁻¹H = Λ + HᵀM + MᵀH
        M, of_reading = step.HP, np.zeros(3)
        M[:] = 0.0
        for a in range(3):
            for k in range(SIZE):
                of_reading[a] += gain[a, k] * score[k]
                for j in range(SIZE):
                    M[a, j] -= gain[a, k] * information[k, j]
            for b in range(3):
                of_reading[a] += step.S_inverse[a, b] * step.nu[b]
        halves = 0.5 * step.S_inverse
        for a in range(3):
            for b in range(3):
                for k in range(SIZE):
                    halves[a, b] -= 0.5 * M[a, k] * gain[b, k]
        for a in range(3):
            for b in range(3):
                for k in range(SIZE):
                    M[a, k] += halves[a, b] * H[b, k]
        for j in range(SIZE):
            for a in range(3):
                score[j] -= H[a, j] * of_reading[a]
                for k in range(SIZE):
                    information[j, k] += H[a, j] * M[a, k] + M[a, j] * H[a, k]
    for k in range(1, SIZE):
        score[k] = keeps[k] * score[k] + turn[k] * score[0]
        for j in range(SIZE):
            information[k, j] = keeps[k] * information[k, j] + turn[k] * information[0, j]
    for j in range(SIZE):
        for k in range(1, SIZE):
            information[j, k] = keeps[k] * information[j, k] + turn[k] * information[j, 0]


@compiled
def smooth(
    x: Array,
    P: Array,
    blocks: Blocks,
    noise: Noise,
    jump_T: float,
    known: NDArray[np.int64],
    told: Array,
    variances: Array,
) -> None:
    """Smoother of the readings that are used in hindsight: states (m, 4) and variances.

    After Bryson and Frazier, in Bierman's form: what later readings say of a state is a score (14,) and an information
    (14, 14) that are carried backwards, so that nothing larger than an innovation's covariance is inverted.
    """
    step, n = new_step(), len(told)
    xs, Ps = np.empty((n, SIZE)), np.empty((n, SIZE, SIZE))
    for i in range(n):
        _forward(x, P, i, blocks, noise, jump_T, known[i], step)
        xs[i], Ps[i] = x, P
        k = i - 1
        while known[i] > 0 and step.jump[0] != 0.0 and k >= 0 and Ps[k, 0, 0] > LOST_RAD**2:
            xs[k, 0] += step.jump[0]
            k -= 1
    score, information = np.zeros(SIZE), np.zeros((SIZE, SIZE))
    for i in range(n - 1, -1, -1):
        for k in range(4):
            row = Ps[i, TOLD[k]]
            told[i, k], variances[i, k] = xs[i, TOLD[k]], row[TOLD[k]]
            for a in range(SIZE):
                told[i, k] -= row[a] * score[a]
                for b in range(SIZE):
                    variances[i, k] -= row[a] * information[a, b] * row[b]
        if i > 0:
            x[:], P[:] = xs[i - 1], Ps[i - 1]
            _forward(x, P, i, blocks, noise, jump_T, known[i], step)
            _back(score, information, known[i], step)
