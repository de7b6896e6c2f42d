"""Rows together as one: twins are the rows one by one, and readings whose errors `magloc simulate` draws."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

import magloc
from arrays.array import SensorArray
from arrays.geometries import axial, square
from arrays.pose import PoseUncertainty
from magloc.tracking.chart.stack import Stack, displacement
from magloc.tracking.motion import MotionModel
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.tracker import Tracker
from sims.magnetics.paths import Attitude, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Source
from sims.magnetics.sensors import SensorModel
from sims.magnetics.simulation import simulate

AMBIENT_T = (2e-5, 1e-6, -4.3e-5)
SQUARE = replace(square(1.5, "scalar", 1e-11), ambient_world_T=AMBIENT_T)
PAIR = axial(1.5, "vector", 2e-10)
REST = magloc.RandomWalk(0.0, 0.0)
TRUTH = np.array([0.5, 3.0, -1.0, 30.0, -20.0, 10.0])


def stack_of(array: SensorArray, rows: Sequence[Row], motion: MotionModel = REST) -> Stack:
    tracker = Tracker(array, motion)
    measured = [tracker.measurements.of(row) for row in rows]
    return Stack(tuple(measured), tracker.errors, tracker.pose_errors, motion)


def passing(array: SensorArray, n_rows: int) -> list[Row]:
    """Rows without noise of an array that passes the source and turns."""
    from scipy.spatial.transform import Rotation

    rows = []
    for i in range(n_rows):
        origin, R = (
            np.array([-2.0 + 4.0 * i / n_rows, 0.1, 0.0]),
            Rotation.from_rotvec([0.0, 0.05 * i, 0.3]).as_matrix(),
        )
        in_array = (TRUTH[:3] - origin) @ R
        fields = magloc.dipole.field(array.positions, in_array, TRUTH[3:] @ R)
        ambient_T = np.array(AMBIENT_T) @ R
        rows.append(Row(0.1 * i, array.readings_of(fields + ambient_T), origin, R, ambient_T))
    return rows


def states(n: int) -> NDArray[np.float64]:
    """Sources about the true one."""
    return TRUTH * (1.0 + 0.1 * np.random.default_rng(0).normal(size=(n, 6)))


@pytest.mark.parametrize("array", [SQUARE, PAIR], ids=["moduli", "vectors"])
class TestPredictions:
    def test_of_few_rows_are_those_of_the_rows(self, array: SensorArray) -> None:
        stack, x = stack_of(array, passing(array, 12)), states(5)
        L = np.broadcast_to(np.eye(6), (5, 6, 6))
        of_rows = [row.predict_source(x) for row in stack.rows]
        by_rows = [row.directional_derivative(x, L) for row in stack.rows]
        np.testing.assert_allclose(stack.predict_source(x), np.concatenate(of_rows, axis=1), rtol=1e-9)
        np.testing.assert_allclose(
            stack.directional_derivative(x, L), np.concatenate(by_rows, axis=1), rtol=1e-6, atol=1e-9
        )
        predicted, by_moment = stack.linearise_in_moment(x)
        np.testing.assert_allclose(predicted, stack.predict_source(x), rtol=1e-9)
        np.testing.assert_allclose(by_moment, stack.directional_derivative(x, L)[..., 3:], rtol=1e-6, atol=1e-9)
        weak = x * np.array([1.0, 1.0, 1.0, 1e-12, 1e-12, 1e-12])
        columns, expected = stack.moment_columns(x[:, :3]), stack.directional_derivative(weak, L)[..., 3:]
        np.testing.assert_allclose(columns, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())

    def test_of_many_are_means_of_unit_noise(self, array: SensorArray) -> None:
        """What the truth predicts is what is measured without noise, and noise of one σ has a variance of one."""
        rows = passing(array, 70)
        stack, rng = stack_of(array, rows), np.random.default_rng(1)
        assert len(rows) / 4 * 3 <= stack.z.size < len(rows)
        np.testing.assert_allclose(stack.predict_source(TRUTH), stack.z, rtol=1e-6)
        noise_T = array.channel_noise_T
        noisy = [replace(row, readings_T=row.readings_T + noise_T * rng.normal(size=noise_T.size)) for row in rows]
        left = stack_of(array, noisy).z - stack.z
        assert stats.chi2.sf(left @ left, left.size) > 1e-4
        assert stats.chi2.cdf(left @ left, left.size) > 1e-4


class TestCovariance:
    """Of rows that pass at 2.5 m: χ² of all numbers within 4.5 σ, which 1e-5 exceed."""

    ALL = PoseUncertainty(0.02, math.radians(0.3), 0.02, 0.0, 0.05, math.radians(0.5))

    @pytest.mark.parametrize("pose", [None, ALL, replace(ALL, correlation_s=1.0)], ids=["exact", "white", "walk"])
    @pytest.mark.parametrize(("n_rows", "n_runs"), [(15, 20), pytest.param(40, 60, marks=pytest.mark.slow)])
    def test_is_that_of_simulated_errors(self, pose: PoseUncertainty | None, n_rows: int, n_runs: int) -> None:
        scenario = MagneticScenario(
            PAIR,
            (SensorModel("vector", noise_T_rtHz=2e-10, offset_error_T=1e-8),) * 2,
            duration_s=0.1 * (n_rows - 1),
            rate_Hz=10.0,
            carrier=Carrier(Steered((-1.5, 0.0, 2.0), speed_m_s=2.0), Attitude(True, wobble_rad=(0.1, 0.08, 0.1))),
            sources=(Source(Carrier(Steered((0.0, 0.5, -0.5))), moment_Am2=(1.0, -0.5, 0.8)),),
            pose=pose,
        )
        square_sum = n = 0.0
        for seed in range(n_runs):
            simulation = simulate(scenario, seed)
            stack = stack_of(simulation.array, list(rows_of(simulation.readings)))
            assert simulation.truth.moment_Am2 is not None
            truth = np.concatenate([simulation.truth.position_m[0], simulation.truth.moment_Am2[0]])[None]
            left = (stack.z - stack.predict_source(truth))[0]
            square_sum += float(left @ np.linalg.solve(stack.covariance(truth)[0], left))
            n += left.size
        # A constant of a simulation is one draw for all its rows: the spread is that of far fewer numbers.
        assert square_sum / n == pytest.approx(1.0, abs=4.5 * math.sqrt(2.0 / n))

    @pytest.mark.parametrize("n_rows", [12, 40])
    def test_has_what_the_source_may_have_moved(self, n_rows: int) -> None:
        """A random walk backwards from the last row: V Δt a row."""
        rows, walk = passing(PAIR, n_rows), magloc.RandomWalk(0.5, 0.1)
        stack, still = stack_of(PAIR, rows, walk), stack_of(PAIR, rows)
        x = TRUTH[None]
        added = stack.covariance(x)[0] - still.covariance(x)[0]
        J = np.concatenate([row.directional_derivative(x, np.eye(6)[None]) for row in still.rows], axis=1)[0]
        later = np.minimum.outer(np.arange(n_rows)[::-1], np.arange(n_rows)[::-1])
        Q = np.diag(np.repeat([0.05**2, (0.01 * np.linalg.norm(TRUTH[3:])) ** 2], 3))
        of_rows = np.einsum("iax,xy,jby,ij->iajb", J.reshape(n_rows, 3, 6), Q, J.reshape(n_rows, 3, 6), later)
        begin = np.unique(np.linspace(0, n_rows, len(stack.z) // 3, endpoint=False).astype(int))
        size = np.sqrt(np.diff(np.append(begin, n_rows)))
        means = np.add.reduceat(np.add.reduceat(of_rows, begin, axis=0), begin, axis=2)
        means /= size[:, None, None, None] * size[:, None]
        # Rows of a mean are linearised at the middle one.
        expected, scale = means.reshape(added.shape), np.sqrt(np.diagonal(means.reshape(added.shape)))
        assert np.abs(added - expected).max() < (1e-9 if n_rows == 12 else 0.3) * scale.max() ** 2

    def test_steps_are_those_of_the_motion(self) -> None:
        assert displacement(magloc.RandomWalk(0.5, 0.1), 2.0) == pytest.approx((1.0, 0.2))
        place, _ = displacement(magloc.OrnsteinUhlenbeck(0.5, 0.1, correlation_s=1e3), 2.0)
        assert place == pytest.approx(1.0, rel=1e-2)  # a velocity that lasts
