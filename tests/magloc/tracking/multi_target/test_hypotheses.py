"""A state that is split where readings bend: its moments stay, and parts are narrow."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.tracking.multi_target.hypotheses import LARGEST_BEND, split
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.results import Row
from tests.magloc.tracking.multi_target.test_update import BOARD, known, readings

ROW = JointRow.of(BOARD, Row(0.0, readings(np.random.default_rng(0))))


@pytest.mark.usefixtures("instruction_set")
def test_a_narrow_state_stays_whole():
    """Along every axis: which of equally long ones are looked along is rounding."""
    state = known(2, 1e-4, dt_s=1e-6)
    assert split(state, ROW) == [(1.0, state)]


def test_nothing_to_split_without_sources():
    state = known(0, 1.0)
    assert split(state, ROW) == [(1.0, state)]


def test_parts_keep_mean_and_covariance():
    """Of positions exactly; of moments, whose charts differ, to the order of the split."""
    state = known(2, 0.05)
    parts = split(state, ROW)
    share = np.array([one for one, _ in parts])
    assert share.tolist() == [0.5, 0.25, 0.25]
    for k in range(2):
        at = state.of_source[k, :3]
        x = np.array([one.position_m[k] for _, one in parts])
        np.testing.assert_allclose(share @ x, state.position_m[k], atol=1e-12)
        P = sum(part * one.P[np.ix_(at, at)] for part, (_, one) in zip(share, parts, strict=True))
        spread = (share[:, None] * (x - state.position_m[k])).T @ (x - state.position_m[k])
        np.testing.assert_allclose(P + spread, state.P[np.ix_(at, at)], rtol=1e-6, atol=1e-12)


@pytest.mark.usefixtures("instruction_set")
def test_the_axis_is_the_one_along_which_readings_bend_most():
    """Half a second difference of the readings along the step that was taken, against all other axes."""
    state = known(1, 0.05)
    _, (_, ahead), (_, behind) = split(state, ROW)
    d = state.n_seen

    def bend(one, other) -> float:
        h = [ROW.predicted(at)[0] for at in (one, other, state)]
        return float(np.linalg.norm(0.5 * (h[0] + h[1]) - h[2]))

    largest = bend(ahead, behind)
    assert largest > LARGEST_BEND
    sigma = np.sqrt(np.diagonal(state.P)[:d])
    variance, axes = np.linalg.eigh(state.P[:d, :d] / np.outer(sigma, sigma))
    others = [sigma * axis * np.sqrt(size) for size, axis in zip(variance, axes.T, strict=True)]
    assert max(bend(state.moved(step), state.moved(-step)) for step in others[-6:]) <= largest * (1.0 + 1e-9)
