"""The compiled steps against the readable ones: the same points, and the same steps."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import sims
from arrays import geometries
from arrays.array import SensorArray
from magloc.readings import Readings
from magloc.tracking import settled
from magloc.tracking.consistency import innovation_test
from magloc.tracking.motion import CoordinatedTurn, MotionModel, OrnsteinUhlenbeck, RandomWalk
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.smoother import smooth_points
from tests.oracles import magpylib_field
from tests.passing_source import (
    ARRAY,
    NOISE_T,
    SLOW,
    ReadableTracker,
    followed,
    moving_source,
    positions,
    readings_of,
    rows_from,
    statuses,
)

FloatArray = NDArray[np.float64]
all_instruction_sets = pytest.mark.usefixtures("instruction_set")


@dataclass(frozen=True)
class WanderingVelocity:
    """State (p, m, v): the velocity is a random walk, and moment and position have noise of their own."""

    speed_m_s: float = 0.1
    turn_rad_s: float = 0.02
    n_states: int = 9

    def start(self, source: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        root = np.diag(np.repeat([0.0, self.speed_m_s], [6, 3]))
        root[:6, :6] = S
        return self.state_of(source, np.zeros(3), np.zeros(3)), root

    def state_of(self, source: FloatArray, velocity_m_s: FloatArray, rate_rad_s: FloatArray) -> FloatArray:
        return np.concatenate([source, velocity_m_s])

    def linear_step(self, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        F, A, B = np.eye(9), np.zeros((9, 9)), np.zeros((9, 9))
        F[:3, 6:] = dt_s * np.eye(3)
        A[:3, :3], A[6:, 6:] = 0.01 * dt_s * np.eye(3), 0.02 * np.sqrt(dt_s) * np.eye(3)
        B[3:6, 3:6] = self.turn_rad_s * dt_s * np.eye(3)
        return F, A, B

    def step(self, x: FloatArray, dt_s: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        F, A, B = self.linear_step(dt_s)
        return F @ x, F, A + float(np.linalg.norm(x[3:6])) * B


def assert_same_points(some: list[TrackPoint], others: list[TrackPoint]) -> None:
    """To 1e-9 m and 1e-9 of the moment; and what is not a number is the same."""
    assert statuses(some) == statuses(others)
    for a, b in zip(some, others, strict=True):
        assert (a.time_s, a.nis_dof) == (b.time_s, b.nis_dof)
        np.testing.assert_allclose(a.nis, b.nis, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(a.correction, b.correction, rtol=0.0, atol=1e-4)
        # Each of two innovations may be off by what the last step of an iteration would change.
        np.testing.assert_allclose(a.lag1, b.lag1, rtol=0.0, atol=1e-4 * max(1.0, a.nis_dof))
        assert (a.position_m is None) == (b.position_m is None)
        if a.position_m is None or b.position_m is None or a.moment_Am2 is None or b.moment_Am2 is None:
            continue
        np.testing.assert_allclose(a.position_m, b.position_m, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(
            a.moment_Am2, b.moment_Am2, rtol=0.0, atol=1e-9 * float(np.linalg.norm(b.moment_Am2))
        )
        assert a.covariance is not None
        assert b.covariance is not None
        assert a.estimability is not None
        assert b.estimability is not None
        scale = np.sqrt(np.diagonal(b.covariance))
        np.testing.assert_allclose(
            a.covariance / np.outer(scale, scale), b.covariance / np.outer(scale, scale), atol=1e-7
        )
        np.testing.assert_allclose(a.estimability, b.estimability, atol=1e-7)


@pytest.fixture
def readable_rows(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Times of rows that take the readable steps."""
    times: list[float] = []
    advanced = Tracker._step_row

    def counted(tracker: Tracker, row: Row) -> TrackPoint:
        times.append(row.time_s)
        return advanced(tracker, row)

    monkeypatch.setattr(Tracker, "_step_row", counted)
    return times


class TestCompiledRecord:
    """The compiled steps and the readable ones: the same points to 1e-9, and the same steps."""

    def both(
        self, array: SensorArray, motion: MotionModel, rows: list[Row], sets: Iterable[str] = ("best",)
    ) -> list[TrackPoint]:
        readable = ReadableTracker(array, motion, keep_steps=True)
        expected = followed(readable, rows)
        smoothed = smooth_points(expected, readable.steps)
        for _ in sets:
            compiled = Tracker(array, motion, keep_steps=True)
            points = followed(compiled, rows)
            assert_same_points(points, expected)
            assert [step.row for step in compiled.steps] == [step.row for step in readable.steps]
            assert innovation_test(points).flagged == innovation_test(expected).flagged
            for a, b in zip(smooth_points(points, compiled.steps), smoothed, strict=True):
                if a.position_m is not None and b.position_m is not None:
                    np.testing.assert_allclose(a.position_m, b.position_m, rtol=0.0, atol=1e-8)
        return points

    def test_rows_that_come_piece_by_piece(self) -> None:
        time_s, p, m = moving_source(60)
        rows = rows_from(time_s, readings_of(ARRAY, p, m))
        whole, pieces = Tracker(ARRAY, SLOW), Tracker(ARRAY, SLOW)
        expected, points = followed(whole, rows), list[TrackPoint]()
        for first, last in pairwise([0, 3, 4, 5, 20, 47, 60]):
            points += followed(pieces, rows[first:last])
        assert_same_points(points, expected)
        assert statuses(points).count("tracked") > 50

    def test_rows_one_by_one(self) -> None:
        """As with :meth:`Tracker.update`, which takes the same call."""
        time_s, p, m = moving_source(60)
        rows = rows_from(time_s, readings_of(ARRAY, p, m))
        tracker = Tracker(ARRAY, SLOW)
        assert_same_points([tracker.update(row) for row in rows], followed(Tracker(ARRAY, SLOW), rows))

    def test_few_rows_take_the_readable_steps(self, readable_rows: list[float]) -> None:
        time_s, p, m = moving_source(60)
        points = followed(Tracker(ARRAY, SLOW), rows_from(time_s, readings_of(ARRAY, p, m)))
        assert (len(points), len(readable_rows) <= 6) == (60, True)

    def test_rows_that_bend_take_the_readable_steps(
        self, monkeypatch: pytest.MonkeyPatch, readable_rows: list[float]
    ) -> None:
        time_s, p, m = moving_source(20)
        rows = rows_from(time_s, readings_of(ARRAY, p, m))
        expected = followed(Tracker(ARRAY, SLOW), rows)
        readable_rows.clear()
        monkeypatch.setattr(settled, "LARGEST_BEND", 0.0)
        assert_same_points(followed(Tracker(ARRAY, SLOW), rows), expected)
        assert len(readable_rows) == 20

    def test_a_row_that_is_not_later_than_the_piece_before(self) -> None:
        time_s, p, m = moving_source(30)
        rows = rows_from(time_s, readings_of(ARRAY, p, m))
        tracker = Tracker(ARRAY, SLOW)
        assert followed(tracker, rows)[-1].status == "tracked"
        with pytest.raises(ValueError, match="must increase"):
            followed(tracker, rows[-1:])

    def test_gaps_missing_channels_and_spikes(self, instruction_sets: Iterator[str]) -> None:
        n = 120
        rng = np.random.default_rng(8)
        time_s, p, m = moving_source(n)
        time_s = time_s + rng.uniform(0.0, 0.4, n)
        p[90:] += [-5.0, 0.0, 0.0]
        readings = readings_of(ARRAY, p, m)
        readings[rng.random(readings.shape) < 0.05] = np.nan
        readings[30:36] = np.nan
        readings[[20, 50, 51], [3, 7, 1]] += 1e-6
        points = self.both(ARRAY, SLOW, rows_from(time_s, readings), instruction_sets)
        assert {"acquired", "tracked", "predicted", "outlier"} <= set(statuses(points))
        assert statuses(points).count("acquired") >= 2

    def test_scalar_sensors_in_an_ambient_field_of_every_row(self, instruction_sets: Iterator[str]) -> None:
        n = 60
        array = geometries.cube(1.5, "scalar", NOISE_T)
        time_s, p, m = moving_source(n)
        ambient = np.array([1e-5, -2e-5, 4.5e-5]) + 1e-6 * np.random.default_rng(2).normal(size=(n, 3))
        noise = NOISE_T * np.random.default_rng(0).normal(size=(n, 8))
        fields = np.stack([magpylib_field(array.positions, *source) for source in zip(p, m, strict=True)])
        readings = np.linalg.norm(fields + ambient[:, None], axis=-1) + noise
        rows = list(rows_of(Readings(readings, time_s=time_s, ambient_T=ambient)))
        points = self.both(array, SLOW, rows, instruction_sets)
        assert statuses(points).count("tracked") > 50
        assert np.nanmax(np.linalg.norm(positions(points) - p, axis=1)) < 0.3

    def test_a_moving_array(self, instruction_sets: Iterator[str]) -> None:
        n = 60
        time_s, p, m = moving_source(n)
        origin = np.outer(time_s, [-0.05, 0.05, 0.0]) + np.array([10.0, -4.0, 2.0])
        rotation = Rotation.from_rotvec(np.outer(time_s, [0.02, 0.01, -0.05]))
        world_p = p + np.array([10.0, -4.0, 2.0])
        in_array = rotation.inv().apply(world_p - origin)
        readings = readings_of(ARRAY, in_array, rotation.inv().apply(m))
        rows = list(rows_of(Readings(readings, time_s=time_s, array_position_m=origin, array_rotation=rotation)))
        points = self.both(ARRAY, SLOW, rows, instruction_sets)
        assert statuses(points) == ["acquired"] + ["tracked"] * (n - 1)
        assert np.linalg.norm(positions(points) - world_p, axis=1).max() < 0.2

    def test_noise_that_depends_on_the_reading(self, instruction_sets: Iterator[str]) -> None:
        time_s, p, m = moving_source(40)
        array = replace(ARRAY, noise_fraction=1e-3)
        points = self.both(array, SLOW, rows_from(time_s, readings_of(array, p, m)), instruction_sets)
        assert statuses(points).count("tracked") > 30

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("seed", range(3))
    def test_a_source_at_rest_that_is_known_along_a_curve(self, seed: int, instruction_sets: Iterator[str]) -> None:
        """The paper's scenario, where a prior that bends changes the track by several σ: see test_row_measurement."""
        readings = sims.simulate(sims.read_scenario("paper"), seed).readings
        array = geometries.tetrahedron(1.5, "vector", 1e-9)
        points = self.both(
            array, RandomWalk(1e-6, 1e-6), rows_from(readings.time_s, readings.values_T), instruction_sets
        )
        assert statuses(points).count("tracked") >= 50

    def test_a_velocity(self, instruction_sets: Iterator[str]) -> None:
        time_s, p, m = moving_source(50)
        readings = readings_of(ARRAY, p, m)
        readings[25:28] = np.nan
        points = self.both(ARRAY, WanderingVelocity(), rows_from(time_s, readings), instruction_sets)
        assert statuses(points) == ["acquired", *["tracked"] * 24, *["predicted"] * 3, *["tracked"] * 22]

    def test_blocks_of_rows_do_not_matter(self, monkeypatch: pytest.MonkeyPatch) -> None:
        time_s, p, m = moving_source(60)
        readings = readings_of(ARRAY, p, m)
        readings[40, 3] += 1e-6
        rows = rows_from(time_s, readings)
        expected = followed(Tracker(ARRAY, SLOW), rows)
        monkeypatch.setattr(settled, "_TERMS_A_CALL", 20_000)
        points = followed(Tracker(ARRAY, SLOW), rows)
        assert statuses(points) == statuses(expected)
        assert [point.nis for point in points] == [point.nis for point in expected]
        np.testing.assert_array_equal(positions(points), positions(expected))

    def test_rows_that_have_no_coordinates_of_their_own(self, instruction_sets: Iterator[str]) -> None:
        """Five differences: the prediction is taken as Gaussian in position and moment there."""
        time_s, p, m = moving_source(40)
        readings = readings_of(ARRAY, p, m)
        readings[10:30:2, 3:7] = np.nan
        points = self.both(ARRAY, SLOW, rows_from(time_s, readings), instruction_sets)
        assert [point.nis_dof for point in points[10:14]] == [5, 9, 5, 9]
        assert set(statuses(points[1:])) == {"tracked"}

    def test_steps_that_swing(self, instruction_sets: Iterator[str]) -> None:
        """A source that is weak and far: the iterations that shrink do so in both, and their number is the same."""
        array = geometries.tetrahedron(1.5, "vector", 1e-9)
        rng = np.random.default_rng(9)
        n = 40
        p, m = np.tile([5.0, 0.0, 0.306], (n, 1)), np.tile([100.0, 0.0, 0.0], (n, 1))
        rows = rows_from(np.arange(float(n)), readings_of(array, p, m, seed=int(rng.integers(1000))))
        motion = RandomWalk(0.1, 0.05)
        readable = followed(ReadableTracker(array, motion), rows)
        for _ in instruction_sets:
            compiled = followed(Tracker(array, motion), rows)
            assert_same_points(compiled, readable)
            assert [point.iterations for point in compiled] == [point.iterations for point in readable]
        assert max(point.iterations for point in readable) > 5

    def test_sensors_with_other_lasting_errors_take_the_readable_steps(self) -> None:
        time_s, p, m = moving_source(20)
        sensors = tuple(replace(sensor, offset_uncertainty_T=1e-9, gain_uncertainty=1e-3) for sensor in ARRAY.sensors)
        array = replace(ARRAY, sensors=sensors)
        assert not Tracker(array, SLOW).is_compiled
        points = self.both(array, SLOW, rows_from(time_s, readings_of(ARRAY, p, m)))
        assert statuses(points).count("tracked") == 19

    @all_instruction_sets
    @pytest.mark.parametrize("noisy", [{}, {"drift_T_rth": 3e-9, "flicker_T": 1e-10}])
    def test_offsets(self, noisy: dict[str, float], readable_rows: list[float]) -> None:
        time_s, p, m = moving_source(80)
        sensors = tuple(replace(sensor, offset_uncertainty_T=1e-9, **noisy) for sensor in ARRAY.sensors)
        array = replace(ARRAY, sensors=sensors)
        readings = readings_of(ARRAY, p, m) + 1e-9 * np.random.default_rng(5).normal(size=ARRAY.n_channels)
        readings[50, 3:6], readings[60:63], readings[70, 2] = np.nan, np.nan, 1e-6
        rows = rows_from(time_s, readings)
        expected = followed(ReadableTracker(array, SLOW), rows)
        readable_rows.clear()
        points = followed(Tracker(array, SLOW), rows)
        assert_same_points(points, expected)
        assert len(readable_rows) < 60

    def test_a_lasting_rate_of_turn(self, instruction_sets: Iterator[str]) -> None:
        time_s, p, m = moving_source(60)
        points = self.both(
            ARRAY, OrnsteinUhlenbeck(0.1, 0.02), rows_from(time_s, readings_of(ARRAY, p, m)), instruction_sets
        )
        assert statuses(points).count("tracked") == 59

    def test_other_motions_take_the_readable_path(self) -> None:
        time_s, p, m = moving_source(20)
        points = self.both(ARRAY, CoordinatedTurn(0.1, 0.1), rows_from(time_s, readings_of(ARRAY, p, m)))
        assert statuses(points).count("tracked") == 19

    def test_no_rows(self) -> None:
        assert followed(Tracker(ARRAY, SLOW), []) == []

    def test_progress_counts_every_row_once(self) -> None:
        time_s, p, m = moving_source(25)
        finished: list[int] = []
        followed(Tracker(ARRAY, SLOW), rows_from(time_s, readings_of(ARRAY, p, m)), finished.append)
        assert sum(finished) == 25
