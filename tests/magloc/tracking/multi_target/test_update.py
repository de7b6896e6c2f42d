"""One row put into a joint state: against a minimiser, and draws."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import arrays
from magloc.fields import dipole
from magloc.tracking.multi_target.measurement import Channels, JointRow
from magloc.tracking.multi_target.motion import FreeMotion, predict_state
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.multi_target.update import innovation_chi2, joint_update
from magloc.tracking.rows import Row

NOISE_T = 5e-7
BOARD = arrays.grid(5, 4, 0.02, noise_T=NOISE_T)
MOTION = FreeMotion()
PLACES = np.array([[0.02, 0.01, 0.05], [-0.03, -0.02, 0.06]])
MOMENTS = np.array([[0.03, 0.0, 0.05], [0.0, -0.04, 0.04]])
COMMON_T = np.array([2e-6, 1e-5, -4e-5])


def readings(rng: np.random.Generator, n_sources: int = 2) -> np.ndarray:
    sources = zip(PLACES[:n_sources], MOMENTS[:n_sources], strict=True)
    fields = COMMON_T + sum(dipole.field(BOARD.positions, p, m) for p, m in sources)
    return BOARD.readings_of(fields) + NOISE_T * rng.normal(size=BOARD.n_channels)


def known(n_sources: int, share: float, rng: np.random.Generator | None = None, dt_s: float = 0.01) -> JointState:
    """A state at the truth, or drawn around it, with some share of 30 mm, 1 rad and 100 % of uncertainty."""
    state = JointState.empty(COMMON_T, 1e-5 * share, BOARD.centroid, BOARD.circumradius)
    places, moments = PLACES[:n_sources], MOMENTS[:n_sources]
    state = state.with_sources(places, moments, MOTION.start(moments, np.full(n_sources, 0.03 * share), share, share))
    # Positions and velocities go together, or a row would say nothing of the latter.
    state = predict_state(state, MOTION.numbers(dt_s), JointRow.of(BOARD, Row(0.0, np.zeros(BOARD.n_channels))))
    if rng is None:
        return state
    return draw(state, rng)


def draw(state: JointState, rng: np.random.Generator) -> JointState:
    """A state of the same covariance whose mean is drawn from it."""
    return state.shift(state.S @ rng.normal(size=len(state.x)), state.S)


def predict_readings(row: JointRow, state: JointState) -> np.ndarray:
    """The readings that a state predicts, in units of their noise."""
    return row.linearise(state)[1]


def test_readings_and_their_derivatives():
    """Of a turned board: central differences of the readings, and these by the fields of the sources."""
    rng = np.random.default_rng(0)
    R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    row, state = JointRow.of(BOARD, Row(0.0, readings(rng), np.array([0.01, 0.0, 0.02]), R)), known(2, 0.1)
    at = row.positions_m
    fields = state.common_T + sum(dipole.field(at, x[:3], x[3:6]) for x in state.sources)
    np.testing.assert_allclose(predict_readings(row, state), BOARD.readings_of(fields @ R) / NOISE_T, rtol=1e-9)
    H = row.linearise(state)[0]
    for k in range(2):
        for i in range(6):
            step = np.zeros(len(state.x))
            step[12 * k + i] = 1e-6 * np.linalg.norm(state.sources[k, 3 * (i // 3) : 3 * (i // 3) + 3])
            ahead, behind = (predict_readings(row, replace(state, x=state.x + sign * step)) for sign in (1.0, -1.0))
            slope = (ahead - behind) / (2.0 * step.sum())
            np.testing.assert_allclose(H[k, :, i], slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())


@pytest.mark.usefixtures("instruction_set")
def test_linearisations_before_and_after():
    """I - QᵀQ is the inverse of the covariance I + J P Jᵀ of readings, and a residual of unit covariance its test."""
    rng = np.random.default_rng(1)
    state, row = known(2, 0.1, rng), JointRow.of(BOARD, Row(0.0, readings(rng)))
    found = joint_update(state, row)

    def information(state: JointState) -> np.ndarray:
        L = state.chart.jacobian(np.zeros((2, 12)))[:, :6]
        H = np.concatenate([*(row.linearise(state)[0] @ L), row.effect], axis=1)
        return np.linalg.inv(np.eye(len(H)) + H @ state.S @ state.S.T @ H.T)

    one = np.eye(len(row.z))
    np.testing.assert_allclose(found.innovation, row.z - predict_readings(row, state), atol=1e-7)
    np.testing.assert_allclose(one - found.projector_before.T @ found.projector_before, information(state), atol=1e-6)
    np.testing.assert_allclose(found.surprise, information(state) @ found.innovation, atol=1e-6)
    np.testing.assert_allclose(found.residual, row.z - predict_readings(row, found.state), atol=0.02)
    left = one - found.projector.T @ found.projector
    expected = [r @ np.linalg.solve(left[at, at] + 1e-3 * np.eye(3), r) for at, r in blocks(found.residual)]
    np.testing.assert_allclose(found.sensor_chi2, expected, rtol=0.02, atol=0.02)


def blocks(residual: np.ndarray) -> list[tuple[slice, np.ndarray]]:
    """Channels of each sensor, and their residuals."""
    return [(slice(c, c + 3), residual[c : c + 3]) for c in range(0, len(residual), 3)]


def test_cost_and_residuals_are_chi_squared():
    """100 rows from the model: means of J, of every sensor's residual and of an empty cell, within 5 σ."""
    rng = np.random.default_rng(2)
    truth = known(2, 0.02)
    rows = [JointRow.of(BOARD, Row(0.0, readings(rng))) for _ in range(100)]
    found = [joint_update(draw(truth, rng), row) for row in rows]
    n = BOARD.n_channels
    assert abs(np.mean([one.cost for one in found]) - n) < 5.0 * np.sqrt(2.0 * n / 100)
    chi2 = np.array([one.sensor_chi2 for one in found])
    assert np.abs(chi2.mean(axis=0) - 3.0).max() < 5.0 * np.sqrt(6.0 / 100)
    cells = Channels(BOARD).of(Row(0.0, readings(rng)))[1]
    energy = np.array([cells.energy(one.residual) for one in found])
    # What the sources may explain already is missing from it.
    assert energy.mean(axis=0).max() < 3.0 + 5.0 * np.sqrt(6.0 / 100)
    assert energy.max() < 45.0


class TestContradictions:
    def test_a_wrong_sensor_stands_out(self):
        rng = np.random.default_rng(3)
        values = readings(rng)
        values[3 * 7 : 3 * 8] += 20.0 * NOISE_T
        found = joint_update(known(2, 0.05), JointRow.of(BOARD, Row(0.0, values)))
        assert int(np.argmax(found.sensor_chi2)) == 7
        assert found.sensor_chi2[7] > 32.0
        without = found.row.without(np.arange(BOARD.n_sensors) == 7)
        again = joint_update(known(2, 0.05), without)
        assert again.sensor_chi2.max() < 32.0
        dead = innovation_chi2(again.state, found.row, np.arange(BOARD.n_sensors) == 7)
        assert dead[7] > 600.0
        assert np.isinf(np.delete(dead, 7)).all()

    def test_another_source_lies_in_a_cell_beside_it(self):
        rng = np.random.default_rng(4)
        found = joint_update(known(1, 0.05), JointRow.of(BOARD, Row(0.0, readings(rng))))
        cells = Channels(BOARD).of(Row(0.0, readings(rng)))[1]
        best = cells.best(cells.energy(found.residual), 4)
        assert np.linalg.norm(cells.position_m[best] - PLACES[1], axis=1).min() < 0.03

    def test_a_channel_without_a_reading_says_nothing(self):
        values = readings(np.random.default_rng(5))
        missing = values.copy()
        missing[4] = np.nan
        row = JointRow.of(BOARD, Row(0.0, missing))
        assert row.n_readings == BOARD.n_channels - 1
        found = joint_update(known(2, 0.05), row)
        assert found.residual[4] == 0.0
        assert np.isfinite(found.sensor_chi2).all()

    def test_a_source_on_a_sensor_is_no_fit(self):
        """So near that its readings' square is beyond double precision: no step gains what it should."""
        near = known(1, 0.05)
        near.sources[0, :3] = BOARD.positions[0] + np.array([0.0, 0.0, 1e-55])
        found = joint_update(near, JointRow.of(BOARD, Row(0.0, readings(np.random.default_rng(6)))))
        assert not found.converged
