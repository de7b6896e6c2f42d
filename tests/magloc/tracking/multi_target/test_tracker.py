"""The joint filter over whole runs: who is there, who is who, and what is said where the readings contradict it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
import magloc
from magloc.tracking.multi_target.explanations import far_sources
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.multi_target.tracker import ROWS_TO_REPORT
from magloc.tracking.sensor_health import ROWS_TO_RETURN
from tests.moving_magnets import FAULTS, NOISE_T, RATE_HZ, Magnets, Within, board, followed, judged, with_fault

BOARD = board()


def run_of(seed: int, k: int, n_rows: int = 150, *, come_and_go: bool = False) -> tuple[Magnets, np.ndarray]:
    rng = np.random.default_rng(seed)
    truth = Magnets.drawn(k, n_rows, 0.03, rng, come_and_go=come_and_go)
    return truth, truth.readings_T(BOARD, rng)


def unit_vectors(rng: np.random.Generator, n: int) -> np.ndarray:
    directions = rng.normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


class TestTracks:
    def test_two_magnets_keep_their_names(self):
        """NEES of 300 points of 6 numbers that depend on each other: as in the figures' runs."""
        truth, readings = run_of(1, 2)
        points, took = followed(BOARD, readings)
        found = judged(points, truth, took)
        assert [track.id for track in points[0].tracks] == [1, 2]
        assert all(len(point.tracks) == 2 and point.status == "tracked" for point in points)
        assert found.swaps == 0
        assert 0.5 < found.nees < 2.0

    def test_one_comes_and_goes(self):
        """Told after ten rows, lost within three; the other is there all the time."""
        truth, readings = run_of(2, 2, come_and_go=True)
        points, took = followed(BOARD, readings)
        found = judged(points, truth, took)
        assert found.swaps == found.false_births - found.late_loss_rows == 0
        assert ROWS_TO_REPORT - 1 <= found.late_birth_rows <= ROWS_TO_REPORT + 3
        assert 0 <= found.late_loss_rows <= 3

    def test_a_single_source_is_as_good_as_any(self):
        truth, readings = run_of(3, 1)
        points, took = followed(BOARD, readings, sources=1)
        assert judged(points, truth, took).nees < 2.0
        assert {track.id for point in points for track in point.tracks} == {1}

    def test_many_are_there_from_the_first_row(self):
        """More than five are searched for at once. NEES of 72 points of 6 numbers that depend on each other."""
        rng, n_rows = np.random.default_rng(6), 12
        x, y = np.meshgrid([-0.045, 0.0, 0.045], [-0.025, 0.025], indexing="ij")
        p = np.stack([x.ravel(), y.ravel(), np.full(6, 0.03)], axis=-1)[:, None].repeat(n_rows, 1)
        p[..., 0] += 5e-4 * np.sin(np.arange(n_rows) / 4.0)
        m = 0.05 * unit_vectors(rng, 6)[:, None].repeat(n_rows, 1)
        truth = Magnets(p, m, np.ones((6, n_rows), dtype=bool))
        points, took = followed(BOARD, truth.readings_T(BOARD, rng), sources=6)
        assert [[track.id for track in point.tracks] for point in points] == [[1, 2, 3, 4, 5, 6]] * n_rows
        found = judged(points, truth, took)
        assert found.swaps == 0
        assert found.nees < 2.0

    def test_noise_is_no_source(self):
        """100 rows: a false birth in any has a probability below 1e-3."""
        rng = np.random.default_rng(4)
        nothing = Magnets(np.zeros((0, 100, 3)), np.zeros((0, 100, 3)), np.zeros((0, 100), dtype=bool))
        points, _ = followed(BOARD, nothing.readings_T(BOARD, rng))
        assert {point.status for point in points} == {"no source"}
        assert not any(point.tracks for point in points)

    def test_a_known_strength_is_a_prior(self):
        truth, readings = run_of(5, 1, 3)
        strength = float(np.linalg.norm(truth.moment_Am2[0, 0]))
        errors, sigmas = [], []
        for prior in (magloc.SourcePrior(), magloc.SourcePrior(known_moment_Am2=strength, known_moment_sigma_Am2=1e-6)):
            track = followed(BOARD, readings, prior=prior)[0][0].tracks[0]
            modulus = float(np.linalg.norm(track.moment_Am2))
            errors.append(abs(modulus - strength))
            sigmas.append(np.sqrt(track.moment_Am2 @ track.covariance[3:, 3:] @ track.moment_Am2) / modulus)
        assert errors[1] < 5e-6 < errors[0]
        # Of a moment's Cartesian components there remains what its direction leaves.
        assert sigmas[1] < 0.5 * sigmas[0]

    def test_two_that_are_not_told_apart_are_merged(self):
        state = magloc.SourcesTracker(BOARD)
        _, readings = run_of(6, 2, 2)
        point = state.update(magloc.Readings(readings[:1], time_s=[0.0]))
        assert not any(track.merged for track in point.tracks)
        # After a second without readings nothing is known of their gap.
        point = state.update(magloc.Readings(np.full((1, 90), np.nan), time_s=[1.0]))
        assert point.status == "no readings"
        assert all(track.merged and track.status == "predicted" for track in point.tracks)

    def test_in_the_world(self):
        """A board that stands elsewhere, turned: the same tracks in the world's axes."""
        _, readings = run_of(7, 2, 20)
        here = followed(BOARD, readings)[0][-1]
        turn, origin = Rotation.from_euler("zyx", [50, 20, -30], degrees=True), np.array([1.0, -2.0, 0.5])
        posed = magloc.Readings(
            readings,
            time_s=np.arange(20) / RATE_HZ,
            array_position_m=np.tile(origin, (20, 1)),
            array_rotation=Rotation.concatenate([turn] * 20),
        )
        there = magloc.track_sources(BOARD, posed)[-1]
        for one, other in zip(here.tracks, there.tracks, strict=True):
            sigma = np.sqrt(np.diagonal(one.covariance)[:3]).max()
            np.testing.assert_allclose(turn.apply(one.position_m) + origin, other.position_m, atol=0.1 * sigma)
            np.testing.assert_allclose(np.array(other.range_interval_m), np.array(one.range_interval_m), rtol=0.01)


class TestFirstRow:
    @pytest.mark.slow
    def test_three_are_told_where_two_hold(self):
        """Two in other places pass every test of this row; three are likelier by far."""
        rng = np.random.default_rng(3)
        truth = Magnets.drawn(3, 1000, 0.02, rng)
        points, took = followed(BOARD, truth.readings_T(BOARD, rng)[:1])
        (told,) = points
        assert len(told.tracks) == 3
        assert judged(points, truth.first(1), took).nees < 5.0

    @pytest.mark.slow
    def test_what_the_row_leaves_open_is_told(self):
        """Two in wrong places are a little likelier than the three that are there: the next row decides."""
        rng = np.random.default_rng(7)
        truth = Magnets.drawn(3, 1000, 0.02, rng)
        points, took = followed(BOARD, truth.readings_T(BOARD, rng)[:4])
        assert [len(point.tracks) for point in points] == [2, 3, 3, 3]
        assert judged(points, truth.first(4), took).nees < 5.0


class TestSlidesIn:
    def test_what_is_far_is_a_gradient(self):
        """A source a hundred times as strong as another, or none: the others stay."""
        strengths = np.array([0.05, 4.9, 5.1])
        empty = JointState.empty(np.zeros(3), 1e-6, BOARD.centroid, BOARD.circumradius)
        state = empty.with_sources(np.eye(3), strengths[:, None] * np.eye(3), np.stack([np.eye(12)] * 3))
        assert far_sources(state) == [2]
        assert far_sources(state.without(2)) == far_sources(state.without_sources) == []

    @pytest.mark.slow
    def test_the_other_is_consistent_or_flagged(self):
        """A magnet comes from 300 mm away, and biases the other until it is found; no sensor is blamed.

        χ² of three degrees of freedom is above 60 once in 10¹² rows. Rows 376 to 420 are flagged.
        """
        rng = np.random.default_rng(12)
        truth = Magnets.drawn(2, 420, 0.02, rng, within=Within(one_by_one=True)).sliding(0.3, rng)
        points, took = followed(BOARD, truth.readings_T(BOARD, rng))
        for point, place_m in zip(points, truth.position_m[0], strict=True):
            offset = point.tracks[0].position_m - place_m
            square = offset @ np.linalg.solve(point.tracks[0].covariance[:3, :3], offset)
            assert square < 60.0 or point.status == "doubtful"
        assert sum(point.status == "doubtful" for point in points) < 80
        assert not judged(points, truth, took).named
        assert len(points[-1].tracks) > 1


class TestFaults:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("kind", FAULTS)
    def test_a_sensor_that_dies_is_named(self, kind):
        """And no other one: within five rows of a wrong reading, which a stuck sensor has somewhat later."""
        truth, readings = run_of(8, 2, 120)
        bad = with_fault(readings, kind, 13, 60, drift_T_s=2e-5)
        points, took = followed(BOARD, bad)
        found = judged(points, truth, took)
        assert set(found.named) == {"s14"}
        wrong = np.abs(bad - readings)[60:, 39:42].max(axis=1) > 6.0 * NOISE_T
        assert found.named["s14"] - 60 <= (5 + int(np.argmax(wrong)) if kind != "drift" else 25)
        assert found.swaps == found.lost_rows == found.false_births == 0
        assert found.rms_m < 1.05 * judged(*_told(truth, readings, 13, 60)).rms_m

    def test_it_comes_back_when_it_is_well(self):
        _, readings = run_of(9, 1, 160)
        bad = readings.copy()
        bad[40:70, 30:33] = 0.0
        points, _ = followed(BOARD, bad)
        out = [row for row, point in enumerate(points) if point.dropped_sensors]
        assert {name for point in points for name in point.dropped_sensors} == {"s11"}
        assert 70 + ROWS_TO_RETURN - 2 <= out[-1] <= 70 + ROWS_TO_RETURN + 20
        assert not points[-1].dropped_sensors

    def test_a_spike_names_nobody(self):
        truth, readings = run_of(10, 2, 60)
        bad = readings.copy()
        bad[40, 30:33] += 1e-4
        points, took = followed(BOARD, bad)
        assert not any(point.dropped_sensors for point in points)
        assert judged(points, truth, took).nees < 2.0

    @pytest.mark.slow
    def test_what_nothing_explains_is_a_misfit(self):
        _, readings = run_of(11, 2, 40)
        bad = readings.copy()
        bad[30] += 1e-4 * np.random.default_rng(0).normal(size=90)
        points, _ = followed(BOARD, bad)
        assert points[30].status == "misfit"
        assert all(track.status == "predicted" for track in points[30].tracks)
        assert points[31].status == "tracked"


def _told(truth: Magnets, readings: np.ndarray, sensor: int, first: int):
    """The run of a filter that was told which sensor fails, and when."""
    missing = readings.copy()
    missing[first:, 3 * sensor : 3 * sensor + 3] = np.nan
    points, took = followed(BOARD, missing)
    return points, truth, took


class TestRefusals:
    def test_scalar_sensors(self):
        array = arrays.tetrahedron(1.0, noise_T=1e-10, kind="scalar")
        with pytest.raises(ValueError, match="Input array must have vector sensors alone"):
            magloc.SourcesTracker(array)

    def test_more_sources_than_an_array_can_tell(self):
        array = arrays.tetrahedron(1.0, noise_T=1e-10)
        with pytest.raises(ValueError, match="Input sources must be between 1 and 1 for an array of 12 readings"):
            magloc.SourcesTracker(array, sources=2)

    def test_time_that_goes_back(self):
        tracker = magloc.SourcesTracker(BOARD)
        row = magloc.Readings(np.zeros((1, 90)), time_s=[1.0])
        tracker.update(row)
        with pytest.raises(ValueError, match="Input time_s must increase"):
            tracker.update(row)
        with pytest.raises(ValueError, match="Input row must be readings of length one"):
            tracker.update(magloc.Readings(np.zeros((2, 90)), time_s=[2.0, 3.0]))

    def test_a_background(self):
        readings = magloc.Readings(np.zeros((3, 90)), time_s=[0.0, 1.0, 2.0])
        with pytest.raises(ValueError, match="neither a background nor measured velocities"):
            magloc.track_sources(BOARD, readings.detrended())


class TestColumns:
    def test_of_one_source(self):
        _, readings = run_of(12, 2, 40, come_and_go=True)
        done: list[int] = []
        track = magloc.track_sources(
            BOARD, replace(magloc.Readings(readings), time_s=np.arange(40) / RATE_HZ), progress=done.append
        )
        assert sum(done) == len(track) == 40
        assert track.ids == (1, 2)
        assert track.dropped_sensors == ()
        second = track.of(2)
        np.testing.assert_array_equal(second.tracked, [len(point.tracks) == 2 for point in track])
        assert np.isnan(second.position_m[0]).all()
        assert second.to_xarray().sizes["row"] == 40
        with pytest.raises(KeyError, match="Input id must be one of"):
            track.of(3)
        lines = track.table().splitlines()
        assert len(lines) == 1 + sum(len(point.tracks) for point in track)
        assert len(repr(track).splitlines()) < 25
        assert "<pre>" in track._repr_html_()
        assert track[:2] == track.points[:2]
        np.testing.assert_array_equal(track.time_s, np.arange(40) / RATE_HZ)
