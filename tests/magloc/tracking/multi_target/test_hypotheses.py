"""A state that is split where readings bend: its moments stay, and parts are narrow."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.fields import dipole
from magloc.tracking import row_filter
from magloc.tracking.multi_target.hypotheses import split
from magloc.tracking.multi_target.measurement import JointRow
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.multi_target.update import joint_update
from magloc.tracking.row_filter import LARGEST_BEND
from magloc.tracking.rows import Row
from tests.magloc.tracking.multi_target.test_update import BOARD, MOTION, known, readings

ROW = JointRow.of(BOARD, Row(0.0, readings(np.random.default_rng(0))))


def valley() -> JointState:
    """Two sources after their first row, which leaves a curved valley of both open."""
    places, moments = np.array([[0.0, 0.0, 0.08], [0.04, 0.0, 0.08]]), np.array([[0.0, 0.0, 0.05], [0.0, 0.05, 0.0]])
    fields = sum(dipole.field(BOARD.positions, *source) for source in zip(places, moments, strict=True))
    row = JointRow.of(BOARD, Row(0.0, BOARD.readings_of(fields)))
    empty = JointState.empty(np.zeros(3), 1e-6, BOARD.centroid, BOARD.circumradius)
    prior = empty.with_sources(places, moments, MOTION.start(moments, np.full(2, 0.05), 1.0, 1.0))
    return joint_update(prior, row).state


@pytest.mark.usefixtures("instruction_set")
def test_a_narrow_state_stays_whole():
    state = known(2, 1e-4, dt_s=1e-6)
    assert split(state, ROW) == [(1.0, state)]


def test_nothing_to_split_without_sources():
    state = known(0, 1.0)
    assert split(state, ROW) == [(1.0, state)]


def test_parts_keep_mean_and_covariance():
    """Of positions, to second order in what is not known."""
    state = valley()
    parts = split(state, ROW)
    share = np.array([one for one, _ in parts])
    assert share.tolist() == [0.5, 0.25, 0.25]
    for k in range(2):
        x = np.array([one.position_m[k] for _, one in parts])
        P = state.covariances[k, :3, :3]
        mean = share @ x
        assert (mean - state.position_m[k]) @ np.linalg.solve(P, mean - state.position_m[k]) < 0.05**2
        of_parts = sum(part * one.covariances[k, :3, :3] for part, (_, one) in zip(share, parts, strict=True))
        spread = (share[:, None] * (x - mean)).T @ (x - mean)
        scale = np.sqrt(np.diagonal(P))
        np.testing.assert_allclose((of_parts + spread) / np.outer(scale, scale), P / np.outer(scale, scale), atol=0.05)


@pytest.mark.usefixtures("instruction_set")
def test_the_parts_bend_less():
    """Along the axis that is divided, whose bend is beyond the limit."""
    state = valley()
    parts = [one for _, one in split(state, ROW)]
    bends = [row_filter.bends(one.gaussians, ROW.kernel_rows, 1.0)[0].max() for one in (state, parts[0])]
    assert bends[0] > LARGEST_BEND
    assert bends[1] < 0.8 * bends[0]
