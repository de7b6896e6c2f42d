"""Tracks from their first row: truth drawn from the motion model, 8 m from a tetrahedron of 1.5 m.

Source and noise are drawn anew in every run: 250 A·m² in any direction, anywhere 8 m away, 0.2 nT, 2 Hz. Seeds are not
chosen.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import magloc
from arrays.array import SensorArray
from arrays.geometries import axial, tetrahedron
from arrays.typing import FloatArray
from magloc.measurement.differences import predicted_channels
from magloc.measurement.nuisances import without_lasting_errors
from magloc.tracking.consistency import nees_of
from magloc.tracking.files import json_entry
from magloc.tracking.motion import MotionModel
from magloc.tracking.results import track_column
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from tests.passing_source import ARRAY, followed
from tests.tracked_sources import VELOCITY, WALK, drawn


def judge(
    motion: MotionModel,
    n: int,
    seeds: range,
    array: SensorArray = ARRAY,
    offsets_T: Callable[[], FloatArray] = lambda: np.zeros(ARRAY.n_channels),
) -> FloatArray:
    """Squared error, its bound, NEES per dimension, and whether the range set holds the truth: (runs, n, 4)."""
    result = np.empty((len(seeds), n, 4))
    for k, seed in enumerate(seeds):
        truth, readings = drawn(motion, n, seed, without_lasting_errors(array))  # which are those of `offsets_T`
        of_run, tracker = offsets_T(), Tracker(array, motion)
        rows = [replace(row, readings_T=row.readings_T + of_run) for row in rows_of(readings)]
        bounds = posterior_bound(tracker, rows, truth[:, :3], truth[:, 3:6])
        for i, point in enumerate(followed(tracker, rows)):
            assert point.position_m is not None
            ((low, high),) = point.range_interval_m or ((0.0, None),)
            range_m = float(np.linalg.norm(truth[i, :3] - ARRAY.centroid))
            result[k, i] = (
                np.sum((point.position_m - truth[i, :3]) ** 2),
                bounds[i] ** 2,
                nees_of(point, truth[i, :6], tracker.measurements.of(rows[i]))[0] / 6.0,
                low <= range_m and (high is None or range_m <= high),
            )
    return result


def test_the_true_place_is_kept_beside_another() -> None:
    """A source at 8 m whose first rows fit one at 4.6 m, too: all rows together once led there for a minute."""
    _, readings = drawn(WALK, 60, 30027)
    tracker = Tracker(ARRAY, WALK)
    ranges = [np.linalg.norm(point.position_m - ARRAY.centroid) for point in tracker.run(rows_of(readings[:25]))]
    assert min(ranges[1:]) > 6.5


@pytest.mark.parametrize("seed", [2012, 2043])
def test_a_refit_of_many_rows_is_not_biased_towards_the_array(seed: int) -> None:
    """The mode of all states of 56 rows at 1 nT is 14 % nearer than the source, 5 σ; it replaced the filter's."""
    array = tetrahedron(1.5, "vector", 1e-9)
    truth, readings = drawn(WALK, 60, seed, without_lasting_errors(array))
    found_m = track_column(list(Tracker(array, WALK).run(rows_of(readings[:57]))), "position_m", 3)[-1]
    range_m, true_m = np.linalg.norm(np.stack([found_m, truth[56, :3]]) - array.centroid, axis=1)
    assert abs(np.log(range_m / true_m)) < 0.1


@pytest.mark.parametrize("motion", [WALK, VELOCITY], ids=["random walk", "constant velocity"])
class TestFromTheFirstRow:
    def test_every_row_has_an_answer_that_holds_the_truth(self, motion: MotionModel) -> None:
        """Six runs of 12 rows: 5 σ in the filter's coordinates, once in 600,000 of each row."""
        result = judge(motion, 12, range(6))
        assert (6.0 * result[..., 2] < 41.4).all()
        assert result[..., 3].mean() > 0.8

    @pytest.mark.slow
    def test_is_consistent_and_reaches_the_bound(self, motion: MotionModel) -> None:
        """100 runs of 40 rows. The least of 38 rows is below 88 % once in 100: σ of one row's coverage is 2.2 %.

        The ratio's standard error is 0.07 to 0.09, as a few runs near two optima carry most of it, and that of NEES
        0.06 where no such run is among them. docs/validation/tracks.md has 200 runs of other seeds.
        """
        result = judge(motion, 40, range(1000, 1100))
        ratio = np.sqrt(result[..., 0].mean(axis=0) / result[..., 1].mean(axis=0))
        inside = result[..., 3]
        assert ratio[2:].max() <= 1.4
        assert 0.93 <= inside.mean() <= 0.97
        assert inside[:, 2:].mean(axis=0).min() >= 0.88
        assert math.sqrt((result[..., 0] / result[..., 1]).mean()) <= 1.25


@pytest.mark.slow
@pytest.mark.parametrize("motion", [WALK, VELOCITY], ids=["random walk", "constant velocity"])
def test_weak_signals_are_consistent(motion: MotionModel) -> None:
    """1 nT, 60 runs of 60 rows, from row 30 on: σ of a row's NEES is 0.08 and of its coverage 2.8 %.

    Limits are 4 σ from 1 and 3 σ from 95 %, as a run's rows are alike: once in some hundred sets of seeds.
    """
    result = judge(motion, 60, range(2000, 2060), tetrahedron(1.5, "vector", 1e-9))[:, 29:]
    assert result[..., 2].mean(axis=0).min() > 0.68
    assert result[..., 2].mean(axis=0).max() < 1.32
    assert result[..., 3].mean(axis=0).min() > 0.86
    assert math.sqrt(result[..., 0].mean() / result[..., 1].mean()) < 1.3


@pytest.mark.slow
@pytest.mark.xfail(strict=True, reason="one run of these 30 follows a wrong range, unflagged: the mean is 1.59")
def test_unknown_offsets_are_consistent() -> None:
    """Offsets of 20 σ without a rest, 30 runs of 60 rows, from row 30 on.

    A run's NEES has a mean of 1 and scatters by about 1, as its rows are alike: 1.5 is 2.7 σ, once in some 300 sets of
    seeds. Straight nuisances have 5 to 12, and their sets hold the truth in 60 %.
    """
    sensors = tuple(replace(sensor, offset_uncertainty_T=20.0 * sensor.noise_T) for sensor in ARRAY.sensors)
    array, errors = replace(ARRAY, sensors=sensors), np.random.default_rng(76000)
    result = judge(WALK, 60, range(76000, 76030), array, lambda: 20.0 * ARRAY.channel_noise_T * errors.normal(size=12))[
        :, 29:
    ]
    assert result[..., 2].mean() < 1.5
    assert result[..., 3].mean() > 0.85


class TestRowsOfFewReadings:
    """Two vector sensors have three differences: a row that shows a source leaves three numbers of six open."""

    PAIR = axial(1.5, "vector", 2e-10)

    def test_each_is_answered_by_a_set_that_holds_the_truth(self) -> None:
        """30 sources 1 to 12 m away, log-range uniform, seen 100 σ strong: eight are missed once in 12,000."""
        inside = 0
        for seed in range(30):
            rng = np.random.default_rng(seed)
            direction, moment = rng.normal(size=(2, 3))
            range_m = float(np.exp(rng.uniform(0.0, math.log(12.0))))
            place = self.PAIR.centroid + range_m * direction / np.linalg.norm(direction)
            seen = np.diff(predicted_channels(self.PAIR, place, moment).reshape(2, 3), axis=0)
            readings = predicted_channels(self.PAIR, place, 2e-8 / float(np.linalg.norm(seen)) * moment)
            tracker = Tracker(self.PAIR, WALK)
            point = tracker.update(Row(0.0, readings + 2e-10 * rng.normal(size=6)))
            assert point.status == "undetermined"
            assert point.position_m is not None
            assert not any((point.covariance is None, point.range_observable, point.gaussian, tracker.is_tracking))
            ((low, high),) = point.range_interval_m or ((0.0, None),)
            inside += low <= range_m and (high is None or range_m <= high)
        assert inside > 22

    def test_they_are_no_track(self) -> None:
        """Of one that stands still: not in maps of the world, nor among the rows tracked, but answered in JSON."""
        rng = np.random.default_rng(1)
        readings = predicted_channels(self.PAIR, [3.0, 1.0, -2.0], [0.0, 200.0, 0.0])
        values = readings + 2e-10 * rng.normal(size=(4, 6))
        found = magloc.track(self.PAIR, values, motion=WALK)
        assert found.status == ["undetermined"] * 4
        assert not found.tracked.any()
        assert found.to_geojson((48.0, 11.0, 0.0))["features"] == []
        assert all(json_entry(point)["position_m"] is not None for point in found)
