"""One row put into a joint state: against a plain extended Kalman filter, a minimiser, and draws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import least_squares

import arrays
from magloc.fields import dipole
from magloc.tracking.multi_target.measurement import Channels, JointRow
from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.state import N_SEEN, JointState, moment_derivative
from magloc.tracking.multi_target.update import JointUpdate, innovation_chi2, joint_update
from magloc.tracking.results import Row
from tests.oracles import derivative

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
    state = JointState.empty(COMMON_T, 1e-5 * share)
    for place, moment in zip(PLACES[:n_sources], MOMENTS[:n_sources], strict=True):
        u = moment / np.linalg.norm(moment)
        state = state.with_sources(place[None], moment[None], MOTION.start(u, 0.03 * share, share, share))
    # Positions and velocities go together, or a row would say nothing of the latter.
    state = MOTION.predicted(state, dt_s)
    if rng is None:
        return state
    return state.moved(np.linalg.cholesky(state.P) @ rng.normal(size=len(state.P)))


def test_derivatives_of_the_readings():
    rng = np.random.default_rng(0)
    turned = Row(0.0, readings(rng), np.array([0.01, 0.0, 0.02]), np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]) * 1.0)
    row, state = JointRow.of(BOARD, turned), known(2, 0.1)

    def predicted(x: np.ndarray) -> np.ndarray:
        def of(x: np.ndarray) -> np.ndarray:
            sources = x[:12].reshape(2, 6)
            moved = replace(state, position_m=sources[:, :3], moment_Am2=sources[:, 3:], common_T=1e-5 * x[12:])
            return row.predicted(moved)[0]

        return np.apply_along_axis(of, -1, x)

    x = np.concatenate([np.hstack([state.position_m, state.moment_Am2]).ravel(), 1e5 * state.common_T])
    H = derivative(predicted, x, 1e-3, atol=1e-4)
    H[:, 12:] *= 1e5
    found = row.predicted(state)[1]
    scale = np.abs(H).max(axis=0)
    np.testing.assert_allclose(found / scale, H / scale, atol=1e-6)


def test_is_a_plain_filter_where_little_is_unknown():
    """One source, known so well that the readings are linear in what is not: x + K (z - h), P - K H P."""
    rng = np.random.default_rng(1)
    state, row = known(1, 1e-3, rng, 1e-4), JointRow.of(BOARD, Row(0.0, readings(rng, 1)))

    def predicted(e: np.ndarray) -> np.ndarray:
        return np.apply_along_axis(lambda e: row.predicted(state.moved(e))[0], -1, e)

    scale = np.sqrt(np.diagonal(state.P))
    H = derivative(lambda e: predicted(e * scale), np.zeros(15), 1e-2, atol=1e-6) / scale
    K = state.P @ H.T @ np.linalg.inv(H @ state.P @ H.T + np.eye(len(row.z)))
    innovation = row.z - row.predicted(state)[0]
    expected, P = state.moved(K @ innovation), state.P - K @ H @ state.P
    found = joint_update(state, row)
    assert found.cost == pytest.approx(
        innovation @ np.linalg.solve(H @ state.P @ H.T + np.eye(len(row.z)), innovation), rel=1e-3
    )
    assert found.log_volume == pytest.approx(np.linalg.slogdet(H @ state.P @ H.T + np.eye(len(row.z)))[1], rel=5e-3)
    sigma = np.sqrt(np.diagonal(P))
    at = state.of_source[0]
    for name, where in (("position_m", at[:3]), ("velocity_m_s", at[6:9]), ("rate_rad_s", at[9:])):
        error = getattr(found.state, name) - getattr(expected, name)
        np.testing.assert_allclose(error[0] / sigma[where], 0.0, atol=3e-3)
    error = (found.state.moment_Am2 - expected.moment_Am2)[0] / np.linalg.norm(MOMENTS[0])
    np.testing.assert_allclose(error / sigma[at[3:6]], 0.0, atol=3e-3)
    np.testing.assert_allclose(found.state.P / np.outer(sigma, sigma), P / np.outer(sigma, sigma), atol=3e-3)


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("n_sources", [0, 1, 2])
def test_iteration_is_the_readable_one(n_sources):
    """And so are its linearisations at the prediction and at the end; on a sensor both give up."""
    rng = np.random.default_rng(n_sources)
    values = readings(rng)
    values[4] = np.nan
    state, row = known(n_sources, 0.2, rng), JointRow.of(BOARD, Row(0.0, values))
    found, expected = joint_update(state, row), iterated(state, row)
    assert found.converged == expected["converged"]
    for name in ("residual", "innovation", "linear", "cost"):
        np.testing.assert_allclose(getattr(found, name), expected[name], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.state.position_m, expected["state"].position_m, rtol=1e-6, atol=1e-9)
    after = posterior_of(found)
    for name in vars(after):
        np.testing.assert_allclose(getattr(found.state, name), getattr(after, name), rtol=1e-6, atol=1e-11)
    np.testing.assert_allclose(found.standardised, standardised(found), rtol=1e-6, atol=1e-9)
    on_sensor = replace(state, position_m=BOARD.positions[:n_sources])
    assert joint_update(on_sensor, row).converged == iterated(on_sensor, row)["converged"] == (n_sources == 0)


@pytest.mark.usefixtures("instruction_set")
def test_posterior_of_large_errors():
    """Moments turn by several revolutions and change by powers of ten; beyond all numbers they are infinite."""
    rng = np.random.default_rng(7)
    update = joint_update(known(2, 0.2, rng), JointRow.of(BOARD, Row(0.0, readings(rng))))
    for size in (0.1, 3.0, 30.0):
        y = np.linalg.solve(update.L, size * np.r_[rng.normal(size=12), np.zeros(3)])
        found, expected = replace(update, y=y).state, posterior_of(replace(update, y=y))
        for name in ("position_m", "moment_Am2", "velocity_m_s", "rate_rad_s", "P"):
            actual, value = getattr(found, name), getattr(expected, name)
            np.testing.assert_allclose(actual, value, rtol=1e-7, atol=1e-9 * np.abs(value).max())
    u = update.prior.moment_Am2[0] / np.linalg.norm(update.prior.moment_Am2[0])
    beyond = np.linalg.solve(update.L, 800.0 * np.r_[0.0, 0.0, 0.0, u, np.zeros(9)])
    assert np.isinf(np.abs(replace(update, y=beyond).state.moment_Am2[0])).any()


def posterior_of(update: JointUpdate) -> JointState:
    """The reference of the posterior: P (I + Hᵀ H P)⁻¹ of the whole state, in the chart where it ends."""
    prior, d = update.prior, update.prior.n_seen
    H = np.zeros((len(update.HL), len(prior.P)))
    H[:, :d] = update.HL @ np.linalg.inv(update.L)
    error = prior.P[:, :d] @ np.linalg.solve(prior.P[:d, :d], update.L @ update.y)
    P = prior.P - prior.P @ H.T @ np.linalg.solve(np.eye(len(H)) + H @ prior.P @ H.T, H @ prior.P)
    return prior.moved_with(error, P)


def standardised(update: JointUpdate) -> np.ndarray:
    """The reference of residuals with unit covariance, by the inverse of I + Lᵀ N L."""
    seen = update.HL @ np.linalg.inv(update.R).T
    covariance = np.eye(len(seen)) - seen @ seen.T
    blocks = [slice(3 * s, 3 * s + 3) for s in range(len(seen) // 3)]
    roots = [np.linalg.cholesky(covariance[at, at] + 1e-3 * np.eye(3)) for at in blocks]
    return np.array([np.linalg.solve(root, update.residual[at]) for root, at in zip(roots, blocks, strict=True)])


def iterated(prior: JointState, row: JointRow) -> dict[str, Any]:
    """The reference of the iteration: damped Gauss-Newton, its steps in units of the prediction's root."""
    d, k = prior.n_seen, prior.n_sources
    L = np.linalg.cholesky(prior.P[:d, :d])
    y, best_y, best, residual, converged = np.zeros(d), np.zeros(d), np.inf, row.z, False
    HL, at_prediction = np.zeros((len(row.z), d)), None
    for _ in range(60):
        error = L @ y
        h, H = row.predicted(prior.moved(error))
        r = row.z - h
        cost = float(r @ r + y @ y)
        if not cost < best:
            if best == np.inf:
                break
            step = y - best_y
            if cost <= best + 0.02 or float(np.sum((HL @ step) ** 2)) < 0.02:
                converged = True
                break
            y = best_y + 0.4 * step
            continue
        best, best_y, residual = cost, y, r
        of_sources = H[:, :-3].reshape(len(H), k, N_SEEN)
        c = error[: N_SEEN * k].reshape(k, N_SEEN)[:, 3:]
        of_sources[:, :, 3:] = (of_sources[:, :, None, 3:] @ moment_derivative(prior.moment_Am2, c))[:, :, 0]
        HL = H @ L
        at_prediction = (r, HL) if at_prediction is None else at_prediction
        new = np.linalg.solve(np.eye(d) + HL.T @ HL, HL.T @ (r + HL @ y))
        along = HL @ (new - y)
        if float(along @ along) < 0.02:
            best_y, residual, converged = new, r - along, True
            best = float(residual @ residual + new @ new)
            break
        y = new
    innovation, linear = at_prediction or (row.z, HL)
    state = prior.moved(L @ best_y)
    return {
        "state": state,
        "residual": residual,
        "innovation": innovation,
        "linear": linear,
        "cost": best,
        "converged": converged,
    }


@pytest.mark.parametrize("seed", range(4))
def test_ends_in_the_minimum(seed):
    """Two sources of which much is unknown: no general minimiser finds less, and both end in the same place."""
    rng = np.random.default_rng(seed)
    state, row = known(2, 0.2, rng), JointRow.of(BOARD, Row(0.0, readings(rng)))
    d = state.n_seen
    L = np.linalg.cholesky(state.P[:d, :d])
    found = joint_update(state, row)
    assert found.converged

    def residual(y: np.ndarray) -> np.ndarray:
        return np.concatenate([row.z - row.predicted(state.moved(L @ y))[0], y])

    best = least_squares(residual, np.zeros(d), x_scale="jac", method="lm")
    assert found.cost == pytest.approx(2.0 * best.cost, abs=0.05)
    expected = state.moved(L @ best.x)
    sigma = np.sqrt(np.diagonal(found.state.P))[found.state.of_source[:, :3]]
    assert (np.abs(found.state.position_m - expected.position_m) < 0.2 * sigma).all()


def test_cost_and_residuals_are_chi_squared():
    """100 rows from the model: means of J, of every sensor's residual and of an empty cell, within 5 σ."""
    rng = np.random.default_rng(2)
    truth = known(2, 0.02)
    rows = [JointRow.of(BOARD, Row(0.0, readings(rng))) for _ in range(100)]
    root = np.linalg.cholesky(truth.P)
    found = [joint_update(truth.moved(root @ rng.normal(size=len(root))), row) for row in rows]
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
        assert found.state.P.shape == (2 * 2 * N_SEEN + 3,) * 2

    def test_a_source_on_a_sensor_costs_without_end(self):
        """So near that its readings' square is beyond double precision."""
        state = known(1, 0.05)
        near = replace(state, position_m=BOARD.positions[:1] + np.array([0.0, 0.0, 1e-55]))
        found = joint_update(near, JointRow.of(BOARD, Row(0.0, readings(np.random.default_rng(6)))))
        assert np.isinf(found.cost)
        assert not found.converged
        np.testing.assert_array_equal(found.state.position_m, near.position_m)
