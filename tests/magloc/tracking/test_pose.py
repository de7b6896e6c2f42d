"""Tracks of arrays whose pose errs: what they claim against the truth, and what is said where errors are not stated.

A tetrahedron of 1.2 m with white noise alone passes a source at rest, at 3 m; its pose errs by 2 cm, 0.3° and 20 ms.
The seeds are not chosen.
"""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations_with_replacement, pairwise

import numpy as np
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation

import magloc
from arrays.pose import PoseUncertainty
from magloc.ambient import in_world_field
from magloc.tracking.chart.start import prior_root
from magloc.tracking.consistency import THRESHOLD, innovation_test
from magloc.tracking.measurement import step_of_errors
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import rows_of
from magloc.tracking.track import Track
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from sims.magnetics.paths import Steered
from sims.magnetics.scenario import MagneticScenario
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import Simulation, simulate
from tests.passing_source import nees
from tests.tracked_sources import PASSING as SCENARIO
from tests.tracked_sources import REST, WHITE

ALL = replace(WHITE, correlation_s=10.0, position_constant_m=0.05, attitude_constant_rad=math.radians(0.5))


def run(
    pose: PoseUncertainty, seed: int, stated: PoseUncertainty | None = None, scenario: MagneticScenario = SCENARIO
) -> tuple[Simulation, Track]:
    simulation = simulate(replace(scenario, pose=pose), seed)
    array = simulation.array if stated is None else replace(simulation.array, pose=stated)
    return simulation, magloc.track(array, simulation.readings, motion=REST)


@pytest.mark.slow
class TestConsistency:
    """Of the last rows of 20 tracks: χ² of 120 numbers, which a right filter leaves with the probability 1e-3."""

    @pytest.mark.parametrize(
        "pose",
        [WHITE, replace(WHITE, correlation_s=0.3), replace(WHITE, correlation_s=10.0), ALL],
        ids=["white", "short walk", "walk", "all"],
    )
    def test_stated_errors_are_claimed(self, pose: PoseUncertainty) -> None:
        squares = [nees(*run(pose, seed)) for seed in range(20)]
        low, high = stats.chi2.ppf([5e-4, 1.0 - 5e-4], 6 * len(squares))
        assert low < sum(squares) < high

    def test_a_pose_that_counts_as_exact_is_not(self) -> None:
        """The same tracks, or none, where nothing is stated: far beyond, and flagged."""
        exact = replace(WHITE, position_m=0.0, attitude_rad=0.0, time_s=0.0)
        small = replace(WHITE, position_m=0.002, attitude_rad=math.radians(0.03), time_s=0.0)
        tracks = [run(small, seed, exact) for seed in range(20)]
        assert all(track.innovations.flagged for _, track in tracks if track.tracked.any())
        assert np.mean([nees(*found) for found in tracks if found[1].tracked[-1]]) > 5.0 * 6


@pytest.mark.slow
class TestExactMounting:
    """A mounting that counts as exact: a right one is beyond 3.3 σ with 5e-4."""

    def test_one_that_is_raises_no_alarm(self) -> None:
        scores = [run(WHITE, seed, WHITE)[1].innovations.z_constants for seed in range(20)]
        assert max(scores) < THRESHOLD
        assert stats.kstest(scores, "norm").pvalue > 1e-3

    @pytest.mark.parametrize(("slower", "least"), [(1.0, 9), (3.0, 16)])
    def test_one_that_is_not_is_seen(self, slower: float, least: int) -> None:
        """Of 20 draws of 0.5° and 5 cm this test sees 0.69 and 0.94, any at all 0.71 and 0.94; fewer: 1 in 100."""
        path = Steered((-2.5, 0.5, 2.0), speed_m_s=0.5 / slower)
        scenario = replace(SCENARIO, duration_s=10.0 * slower, carrier=replace(SCENARIO.carrier, path=path))
        wrong = replace(ALL, correlation_s=0.0)
        tests = [run(wrong, seed, WHITE, scenario)[1].innovations for seed in range(20)]
        seen = [test for test in tests if test.z_constants > THRESHOLD]
        assert len(seen) >= least
        assert all("another mounting or lever arm" in test.reason for test in seen)

    def test_first_rows_that_do_not_know_the_range_do_not_count(self) -> None:
        """A diver, whose first answers are metres off: with these nothing settled, and nothing was said."""
        diver = read_scenario("diver")
        right, wrong = (run(pose, 0, WHITE, diver)[1].innovations for pose in (WHITE, replace(ALL, correlation_s=0.0)))
        assert right.z_constants < THRESHOLD < wrong.z_constants

    def test_right_ones_on_a_background(self) -> None:
        """Whose states stand beside them."""
        scores = []
        for seed in range(20):
            simulation = simulate(replace(SCENARIO, pose=WHITE), seed)
            array = replace(simulation.array, pose=WHITE)
            track = magloc.track(array, simulation.readings.high_passed(0.01), motion=REST)
            scores.append(track.innovations.z_constants)
        assert max(scores) < THRESHOLD
        assert stats.kstest(scores, "norm").pvalue > 1e-3


class TestTrack:
    def test_errors_of_the_pose_are_claimed(self) -> None:
        """One track: within 5 σ, and a claim of some centimetres, where without errors it is of some millimetres."""
        simulation, track = run(ALL, 1)
        sigma = float(np.sqrt(np.trace(track.covariance[-1, :3, :3])))
        assert 0.01 < sigma < 0.15
        assert nees(simulation, track) < stats.chi2.ppf(1.0 - 1e-6, 6)
        assert not track.innovations.flagged
        assert math.isnan(track.innovations.z_constants)  # they are states already
        assert track.table().count("\n") == len(track) + bool(track.innovations.caution)

    def test_a_mounting_that_counts_as_exact_is_seen_on_a_background(self) -> None:
        """That is not: by 0.5° and 5 cm."""
        simulation = simulate(replace(SCENARIO, pose=replace(ALL, correlation_s=0.0)), 0)
        track = magloc.track(replace(simulation.array, pose=WHITE), simulation.readings.high_passed(0.01), motion=REST)
        assert track.innovations.z_constants > THRESHOLD

    @pytest.mark.slow
    def test_a_stream_of_rows_knows_its_motion_from_the_rows_before(self) -> None:
        """Velocities by the row before in place of both neighbours: another track, as right within 5 σ."""
        simulation, track = run(WHITE, 3)
        tracker = Tracker(simulation.array, REST)
        points = [tracker.update(row) for row in simulation.readings]
        assert [point.status for point in points] == track.status
        assert nees(simulation, replace(track, points=tuple(points))) < stats.chi2.ppf(1.0 - 1e-6, 6)
        assert np.abs(points[-1].position_m - track.position_m[-1]).max() > 1e-6

    @pytest.mark.slow
    def test_rows_may_state_their_own(self) -> None:
        """The same σ in columns, and none that is constant: the same track as from the array."""
        simulation, track = run(replace(WHITE, time_s=0.0), 4)
        array = replace(simulation.array, pose=PoseUncertainty(position_constant_m=0.0, attitude_constant_rad=0.0))
        sigma = np.broadcast_to([0.02, math.radians(0.3)], (len(track), 2))
        by_rows = magloc.track(array, replace(simulation.readings, pose_sigma=sigma), motion=REST)
        np.testing.assert_array_equal(by_rows.tracked, track.tracked)
        np.testing.assert_allclose(by_rows.position_m[-1], track.position_m[-1], atol=1e-9)

    def test_a_fix_of_a_row_claims_them_too(self) -> None:
        """P + J Σ Jᵀ: σ of the place is at least that of position and lever arm together."""
        simulation = simulate(replace(SCENARIO, pose=ALL), 0)
        exact = magloc.locate(replace(simulation.array, pose=None), simulation.readings[20:22])
        fixes = magloc.locate(simulation.array, simulation.readings[20:22])
        np.testing.assert_array_equal(fixes.position_m, exact.position_m)
        sigma = np.sqrt(np.diagonal(fixes.covariance, axis1=1, axis2=2))
        assert np.all(sigma[:, :3] > math.hypot(0.02, 0.05))
        assert np.all(sigma > np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2)))


class TestBound:
    def test_is_that_of_all_rows_at_once(self) -> None:
        """Derivatives by central differences, the covariance of all errors between all rows: a drone's moduli."""
        scenario = replace(read_scenario("drone"), pose=ALL, duration_s=4.0)
        simulation = simulate(scenario, 1)
        tracker, truth = Tracker(simulation.array, magloc.RandomWalk(1e-9, 1e-9)), simulation.truth
        complete = np.flatnonzero(np.isfinite(simulation.readings.values_T).all(axis=1))
        rows = list(rows_of(in_world_field(simulation.readings, simulation.array)))
        rows = [rows[i] for i in complete.tolist()]
        assert truth.moment_Am2 is not None
        bound = posterior_bound(tracker, rows, truth.position_m[complete], truth.moment_Am2[complete])
        rows = rows[int(np.isfinite(bound).argmax()) :]
        state = np.concatenate([truth.position_m[0], truth.moment_Am2[0], np.zeros(tracker.n_errors)])
        steps = np.concatenate([np.full(6, 1e-3), 0.1 * np.maximum(tracker.error_sigma, 1e-15)])
        by_state = []
        for measurement in map(tracker.measurements.of, rows):
            moved = [state + side * step for step in np.diag(steps) for side in (0.5, -0.5)]
            h = np.array([measurement.predict(x) for x in moved]).reshape(len(steps), 2, -1)
            by_state.append(((h[:, 0] - h[:, 1]) / steps[:, None]).T)
        variance, of = [tracker.error_sigma**2], (tracker.pose_errors, tracker.errors)
        kept, added = zip(*(step_of_errors(*of, b.time_s - a.time_s) for a, b in pairwise(rows)), strict=True)
        for share, noise in zip(kept, added, strict=True):
            variance.append(share**2 * variance[-1] + noise**2)
        n, k = len(rows), len(by_state[0])
        C = np.eye(n * k).reshape(n, k, n, k)
        for i, j in combinations_with_replacement(range(n), 2):
            left = variance[i] * np.prod(np.array(kept)[i:j], axis=0)
            between = by_state[i][:, 6:] @ (left[:, None] * by_state[j][:, 6:].T)
            C[i, :, j] += between
            C[j, :, i] += between.T if i != j else 0.0
        J = np.concatenate(by_state)[:, :6]
        root = prior_root(tracker.measurements.of(rows[0]).chart(state[:6]))
        information = J.T @ np.linalg.solve(C.reshape(n * k, n * k), J) + np.linalg.inv(root @ root.T)
        dense_m = math.sqrt(float(np.trace(np.linalg.inv(information)[:3, :3])))
        assert bound[-1] == pytest.approx(dense_m, rel=5e-3)


class TestInnovationTest:
    """Of whitened innovations that are white: z is standard normal; 3.3 is left in 1 of 2,000."""

    def points(self, innovations: np.ndarray) -> list[TrackPoint]:  # type: ignore[type-arg]
        lag1 = [math.nan, *np.sum(innovations[1:] * innovations[:-1], axis=1)]
        return [
            TrackPoint(float(i), nis=float(of_row @ of_row), nis_dof=of_row.size, lag1=float(lag1[i]))
            for i, of_row in enumerate(innovations)
        ]

    def test_right_ones_are_not_flagged(self) -> None:
        rng = np.random.default_rng(0)
        z = [innovation_test(self.points(rng.normal(size=(100, 9)))) for _ in range(200)]
        for values in ([test.z_chi2 for test in z], [test.z_lag1 for test in z]):
            assert stats.kstest(values, "norm").pvalue > 1e-4
        assert sum(test.flagged for test in z) <= 3

    def test_larger_ones_are_flagged(self) -> None:
        test = innovation_test(self.points(1.2 * np.random.default_rng(1).normal(size=(100, 9))))
        assert test.z_chi2 > THRESHOLD
        assert "larger than is stated" in test.reason

    def test_coloured_ones_are_flagged(self) -> None:
        white = np.random.default_rng(2).normal(size=(101, 9))
        test = innovation_test(self.points(math.sqrt(0.5) * (white[1:] + white[:-1])))
        assert abs(test.z_chi2) < THRESHOLD < test.z_lag1
        assert "alike" in test.reason

    def test_excess_is_what_the_variance_of_predictions_lacks(self) -> None:
        """A filter of a scalar random walk with wrong noises; sums of 20,000 rows, each within 5 σ: 6e-7."""
        rng, n, q, r = np.random.default_rng(4), 20_001, 1.0, 1.0
        P = 0.5 * (q + math.sqrt(q * q + 4.0 * q * r))  # of predictions, as claimed
        K, S = P / (P + r), P + r
        for true_q, true_r in ((1.0, 1.0), (0.05, 1.0), (4.0, 1.0), (1.0, 3.0), (0.2, 3.0)):
            P_true = (K**2 * true_r + true_q) / (1.0 - (1.0 - K) ** 2)
            x = np.cumsum(math.sqrt(true_q) * rng.normal(size=n))
            z, expected, points, before = x + math.sqrt(true_r) * rng.normal(size=n), 0.0, [], math.nan
            for i in range(n):
                nu = (z[i] - expected) / math.sqrt(S)
                expected += K * (z[i] - expected)
                points.append(
                    TrackPoint(float(i), nis=nu**2, nis_dof=1, lag1=nu * before, correction=K * (nu**2 - 1.0))
                )
                before = nu
            summands = np.array([point.lag1 + point.correction for point in points[1:]])
            sigma = summands.reshape(-1, 100).sum(axis=1).std() * math.sqrt(200)
            assert abs(innovation_test(points).excess - (n - 1) * (P_true - P) / S) < 5.0 * sigma

    def test_one_wild_row_flags_nothing(self) -> None:
        innovations = np.random.default_rng(3).normal(size=(100, 9))
        innovations[50] = 1e6
        points = self.points(innovations)
        points[50], points[51] = (replace(point, lag1=math.nan) for point in points[50:52])
        assert not innovation_test(points).flagged

    def test_nothing_is_known_without_rows(self) -> None:
        assert innovation_test([]).reason == ""


class TestSimulatedPose:
    """The stated pose and the true one, told apart by the field at the true places: see the docstring of the module."""

    def test_errors_have_their_rms(self) -> None:
        """Of 2,001 rows: mean squares within 4.5 σ, which a right simulation leaves with 1e-5."""
        long = replace(SCENARIO, duration_s=400.0, pose=replace(WHITE, time_s=0.0))
        erring, exact = simulate(long, 5).readings, simulate(replace(long, pose=None), 5).readings
        np.testing.assert_array_equal(erring.values_T, exact.values_T)
        assert erring.pose is not None
        assert exact.pose is not None
        shift = exact.pose[0] - erring.pose[0]
        turn = (erring.pose[1].inv() * exact.pose[1]).as_rotvec()
        for errors, sigma in ((shift, 0.02), (turn, math.radians(0.3))):
            assert np.mean(errors**2) == pytest.approx(sigma**2, rel=4.5 * math.sqrt(2.0 / errors.size))

    def test_a_late_clock_states_the_pose_of_another_time(self) -> None:
        late = replace(SCENARIO, pose=replace(WHITE, position_m=0.0, attitude_rad=0.0, time_s=0.0, time_constant_s=0.2))
        found, exact = simulate(late, 6).readings, simulate(replace(late, pose=None), 6).readings
        assert found.pose is not None
        assert exact.pose is not None
        steps = (found.pose[0] - exact.pose[0])[:, 0] / 0.5
        np.testing.assert_allclose(steps, steps[0], rtol=1e-9)
        assert 0.0 < abs(steps[0]) < 1.0

    def test_constants_are_constant(self) -> None:
        constant = replace(ALL, position_m=0.0, attitude_rad=0.0, time_s=0.0, lever_arm_m=(0.2, 0.0, 0.0))
        found = simulate(replace(SCENARIO, pose=constant), 7).readings
        exact = simulate(replace(SCENARIO, pose=None), 7).readings
        assert found.pose is not None
        assert exact.pose is not None
        turn = (found.pose[1].inv() * exact.pose[1]).as_rotvec()
        np.testing.assert_allclose(turn, np.broadcast_to(turn[0], turn.shape), atol=1e-12)
        arm = np.array([0.2, 0.0, 0.0])
        reference = found.pose[0] - found.pose[1].apply(arm)
        true_arm = exact.pose[1].inv().apply(exact.pose[0] - reference)
        np.testing.assert_allclose(true_arm, np.broadcast_to(true_arm[0], true_arm.shape), atol=1e-12)
        assert 1e-3 < np.linalg.norm(true_arm[0] - arm) < 0.3
        assert isinstance(exact.pose[1], Rotation)
        assert len(list(rows_of(found))) == len(found)
