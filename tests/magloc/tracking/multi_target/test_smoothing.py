"""Rows of a young joint track fitted together: against a general minimiser of all of their squares."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import least_squares

from magloc.tracking.multi_target.hypotheses import REFITS, Hypothesis
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.smoothing import MOST_ROWS, YoungTrack
from magloc.tracking.multi_target.state import N_SEEN, JointState
from magloc.tracking.multi_target.update import joint_update
from magloc.tracking.results import Row
from magloc.tracking.sensor_health import SensorHealth
from tests.magloc.tracking.multi_target.test_update import BOARD, MOTION, known, readings

DT_S = 0.05


def filtered(n_rows: int, n_sources: int, seed: int, share: float = 0.2) -> tuple[YoungTrack, list[JointState]]:
    """Rows of sources that rest, filtered from a prior that is drawn about them, and the predictions."""
    rng = np.random.default_rng(seed)
    prior = known(n_sources, share, rng)
    track, predictions = YoungTrack(prior), [prior]
    for i in range(n_rows):
        row = JointRow.of(BOARD, Row(DT_S * i, readings(rng, n_sources)))
        update = joint_update(predictions[-1], row)
        track = track.after(row, MOTION.numbers(DT_S if i else 0.0), update.state, update.cost + update.log_volume)
        predictions.append(MOTION.predicted(update.state, DT_S))
    return track, predictions


def difference(about: JointState, state: JointState) -> np.ndarray:
    """Error (n,) in the chart about one state that leads to another."""
    K = about.n_sources
    error = np.zeros(len(about.P))
    of_seen, of_motion = error[: N_SEEN * K].reshape(K, N_SEEN), error[N_SEEN * K + 3 :].reshape(K, N_SEEN)
    of_seen[:, :3] = state.position_m - about.position_m
    for k in range(K):
        m, other = about.moment_Am2[k], state.moment_Am2[k]
        u, w = m / np.linalg.norm(m), other / np.linalg.norm(other)
        across = w - (u @ w) * u
        size = float(np.linalg.norm(across))
        turn = across * (np.arctan2(size, u @ w) / size if size else 1.0)
        of_seen[k, 3:] = np.log(np.linalg.norm(other) / np.linalg.norm(m)) * u + turn
    error[N_SEEN * K : N_SEEN * K + 3] = state.common_T - about.common_T
    of_motion[:, :3], of_motion[:, 3:] = state.velocity_m_s - about.velocity_m_s, state.rate_rad_s - about.rate_rad_s
    return error


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("n_sources", "seed"), [(1, 0), (1, 1), (2, 0)])
def test_is_the_minimum_of_all_squares(n_sources: int, seed: int) -> None:
    """Prior, noise of the motion and readings of four rows: no general minimiser finds less, and it ends there too."""
    track, _ = filtered(4, n_sources, seed)
    found = track.smoothed()
    assert found is not None
    n, scales = len(track.prior.P), [np.sqrt(np.diagonal(state.P)) for state in track.states]

    def residual(x: np.ndarray) -> np.ndarray:
        errors = x.reshape(-1, n)
        states = [state.moved(scale * error) for state, scale, error in zip(track.states, scales, errors, strict=True)]
        parts = [np.linalg.solve(np.linalg.cholesky(track.prior.P), difference(track.prior, states[0]))]
        for before, after in pairwise(states):
            ahead = MOTION.predicted(replace(before, P=np.zeros((n, n))), DT_S)
            parts.append(np.linalg.solve(np.linalg.cholesky(ahead.P), difference(ahead, after)))
        parts += [row.z - row.predicted(state)[0] for (row, _), state in zip(track.rows, states, strict=True)]
        return np.concatenate(parts)

    best = least_squares(residual, np.zeros(4 * n), method="lm")
    expected = [
        state.moved(scale * error)
        for state, scale, error in zip(track.states, scales, best.x.reshape(-1, n), strict=True)
    ]
    for one, other in zip(found.states, expected, strict=True):
        assert np.abs(difference(other, one) / np.sqrt(np.diagonal(found.states[-1].P))).max() < 0.15
    cost = found.score - log_volume_of(track, found)
    assert cost == pytest.approx(2.0 * best.cost, abs=0.25)


def log_volume_of(track: YoungTrack, found: YoungTrack) -> float:
    """That of the rows, each linearised where the trajectory is, by the updates of a filter that knows it."""
    volume, prediction = 0.0, track.prior
    for j, ((row, _), state) in enumerate(zip(track.rows, found.states, strict=True)):
        prior = prediction.moved_with(difference(prediction, state), prediction.P)
        _, H = row.predicted(prior)
        H[:, :-3].reshape(len(H), -1, N_SEEN)[..., 3:] *= np.linalg.norm(prior.moment_Am2, axis=1)[:, None]
        d = prior.n_seen
        S = np.eye(len(H)) + H @ prior.P[:d, :d] @ H.T
        volume += float(np.linalg.slogdet(S)[1])
        gain = prior.P[:, :d] @ H.T @ np.linalg.inv(S)
        after = replace(state, P=prior.P - gain @ H @ prior.P[:d])
        if j + 1 < len(track.rows):
            prediction = MOTION.predicted(after, DT_S)
    return volume


def test_nees_of_the_last_row() -> None:
    """Ten rows of a source of which a third is unknown, 40 runs: six numbers a run.

    Of a right filter the mean of 240 numbers is above 1.45 once in a million. In some run a filter from such a prior
    ends on the wrong side of the board, which no iteration finds back from.
    """
    nees, truth = [], known(1, 1e-3)
    for seed in range(40):
        found = filtered(10, 1, seed, 0.3)[0].smoothed()
        if found is not None:
            error = difference(found.states[-1], truth)[:N_SEEN]
            nees.append(error @ np.linalg.solve(found.states[-1].P[:N_SEEN, :N_SEEN], error) / N_SEEN)
    assert len(nees) >= 38
    assert np.mean(nees) < 1.45


def test_a_hypothesis_is_fitted_anew_after_some_rows() -> None:
    """Its score changes by what all rows together are likelier, and its state is where they lead."""
    track, _ = filtered(REFITS[1], 2, 0, 0.05)
    health, state, row = SensorHealth.of(BOARD.n_sensors), track.states[-1], track.rows[-1][0]
    before = Hypothesis(state, (1, 2), health, score=7.0, young=track)
    after, found = before.refitted(row), track.smoothed()
    assert found is not None
    assert after.score == pytest.approx(7.0 + found.score - track.score)
    np.testing.assert_array_equal(after.state.position_m, found.states[-1].position_m)
    other = replace(before, young=replace(track, rows=track.rows[:-1], states=track.states[:-1]))
    assert other.refitted(row) is other


def test_a_source_that_joins_is_in_all_rows() -> None:
    """Rows of two sources, filtered with one: with the other's prior they lead where they do with both from the first.

    However the trajectory begins, all rows together have one optimum near.
    """
    both, _ = filtered(8, 2, 3, 0.05)
    prior = both.prior
    alone = YoungTrack(prior.without(1), both.rows, tuple(state.without(1) for state in both.states))
    joined = alone.joined(prior)
    np.testing.assert_array_equal(joined.states[-1].position_m[0], both.states[-1].position_m[0])
    np.testing.assert_array_equal(joined.states[-1].position_m[1], prior.position_m[1])
    found, expected = joined.smoothed(), both.smoothed()
    assert found is not None
    assert expected is not None
    error = difference(expected.states[-1], found.states[-1]) / np.sqrt(np.diagonal(expected.states[-1].P))
    assert np.abs(error).max() < 0.15
    assert found.score == pytest.approx(expected.score, abs=0.5)  # both stop within a tenth of a deviation
    fewer = alone.smoothed()
    assert fewer is None or fewer.score > found.score + 1000.0


def test_the_last_rows_are_kept() -> None:
    """Of more rows than are kept the older half goes, and what was known then is the prior of those that stay."""
    track, predictions = filtered(MOST_ROWS, 1, 4, 0.05)
    assert track.is_young
    row = track.rows[-1][0]
    later = track.after(row, MOTION.numbers(DT_S), track.states[-1], 0.0)
    first = MOST_ROWS // 2
    assert not later.is_young
    assert len(later.rows) == len(later.states) == MOST_ROWS - first + 1
    assert later.rows[0] is track.rows[first]
    np.testing.assert_allclose(later.prior.position_m, predictions[first].position_m, rtol=1e-12)
    np.testing.assert_allclose(later.prior.P, predictions[first].P, rtol=1e-9, atol=1e-18)
