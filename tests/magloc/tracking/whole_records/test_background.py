"""Tracks of readings with a background that drifts: what they claim against the truth.

A tetrahedron of 1.2 m with white noise alone passes a source at rest, at 3 m, in a minute; its motion is known. The
drift is as the options say: lines, or offsets and a random walk of every channel. The seeds are not chosen.

====================================  ==================================================================================
what                                  who checks it
====================================  ==================================================================================
a track on a background               NEES over many draws; itself with another background of the same kind
a moment on a background              numpy's least squares with a column for every slope
====================================  ==================================================================================
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

import magloc
import sims
from arrays.differences import decorrelated_differences
from arrays.geometries import tetrahedron
from arrays.typing import FloatArray
from magloc.measurement.nuisances import BackgroundDrift
from magloc.readings import Readings
from magloc.tracking.consistency import THRESHOLD
from magloc.tracking.rows import rows_of
from magloc.tracking.track import Track
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.background import iterate_steps
from tests.tracked_sources import BACKGROUND_NOISE_T as NOISE_T
from tests.tracked_sources import CORNER_HZ, REST, lines, no_drift, walks
from tests.tracked_sources import PASSING_SLOWLY as SCENARIO


def high_passed(readings: Readings) -> Readings:
    return readings.high_passed(CORNER_HZ)


def run(
    drift: Callable[[Readings, int], FloatArray],
    say: Callable[[Readings], Readings],
    seed: int,
    *,
    smooth: bool = False,
) -> tuple[sims.Simulation, Track]:
    simulation = sims.simulate(SCENARIO, seed)
    readings = replace(simulation.readings, values_T=simulation.readings.values_T + drift(simulation.readings, seed))
    return simulation, magloc.track(simulation.array, say(readings), motion=REST, smooth=smooth)


@pytest.mark.slow
class TestConsistency:
    """Mean NEES per dimension of ten tracks; one track's mean is spread by 0.3, as its rows are alike."""

    @pytest.mark.parametrize(
        ("drift", "say", "least"),
        [
            (lines, Readings.detrended, 0.7),
            (no_drift, Readings.detrended, 0.5),
            (walks, high_passed, 0.7),
            (no_drift, high_passed, 0.5),
        ],
        ids=["lines", "no lines", "walks", "no walks"],
    )
    def test_what_is_said_is_claimed(
        self, drift: Callable[[Readings, int], FloatArray], say: Callable[[Readings], Readings], least: float
    ) -> None:
        found = []
        for seed in range(10):
            simulation, track = run(drift, say, seed)
            judged = track.consistency(simulation.truth)
            assert judged.tracked_rows > 140
            found.append(judged.nees_per_dimension)
        assert least < np.mean(found) < 1.4

    def test_a_target_that_weaves_on_unknown_offsets(self, caplog: pytest.LogCaptureFixture) -> None:
        """With a motion that keeps its speed, as it does; a random walk claims too much, is flagged and warned of."""
        weaving = sims.read_scenario("weaving")
        motion = magloc.OrnsteinUhlenbeck(0.1, math.radians(1.2))
        found = []
        for seed in range(2):
            simulation = sims.simulate(weaving, seed)
            track = magloc.track(simulation.array, high_passed(simulation.readings), motion=motion)
            found.append(track.consistency(simulation.truth).nees_per_dimension)
        assert np.mean(found) < 2.0
        caplog.clear()
        with caplog.at_level(logging.WARNING, logger="magloc"):
            walk = magloc.RandomWalk(motion.speed_m_s, motion.turn_rad_s)
            track = magloc.track(simulation.array, high_passed(simulation.readings), motion=walk)
        assert track.innovations.z_lag1 > THRESHOLD
        assert "the motion alone determines the position" in caplog.text


class TestTrack:
    @pytest.mark.slow
    def test_lines_of_any_slope_are_one(self, caplog: pytest.LogCaptureFixture) -> None:
        """The slopes are unknown: the same track with other ones, within what the prior of 10⁵ σ leaves."""
        with caplog.at_level(logging.WARNING, logger="magloc"):
            _, flat = run(no_drift, Readings.detrended, 1)
        assert "how the source moves" not in caplog.text  # it is at rest
        _, steep = run(lines, Readings.detrended, 1)
        np.testing.assert_array_equal(steep.tracked, flat.tracked)
        np.testing.assert_allclose(steep.position_m[-1], flat.position_m[-1], atol=1e-4)
        np.testing.assert_allclose(steep.covariance[-1], flat.covariance[-1], rtol=2e-2)

    @pytest.mark.slow
    def test_a_smoother_knows_more(self) -> None:
        simulation, track = run(walks, high_passed, 2, smooth=True)
        judged = track.consistency(simulation.truth)
        assert judged.position_rms_m < 3.0 * judged.position_bound_m
        assert track.is_smoothed

    def test_a_corner_that_takes_the_source_is_warned_of(self, caplog: pytest.LogCaptureFixture) -> None:
        with caplog.at_level(logging.WARNING, logger="magloc"):
            _, track = run(no_drift, lambda readings: readings.high_passed(0.1), 0)
        assert "the background looks like the source: positions are" in caplog.text
        assert track.tracked.any()

    def test_passes_that_lead_nowhere_are_none(self) -> None:
        """From sources beyond double precision; without an error."""
        readings = high_passed(sims.simulate(SCENARIO, 0).readings[:20])
        tracker = Tracker(
            SCENARIO.nominal_array, REST, background=BackgroundDrift.of(readings.background, readings.time_s)
        )
        rows = list(rows_of(readings))
        nowhere = np.concatenate([[1.0, 0.0, 0.0], [0.0, 0.0, 1e200], np.zeros(tracker.n_errors)])
        assert iterate_steps(tracker, rows, [nowhere] * len(rows)) is None

    def test_without_a_source_there_is_none(self) -> None:
        readings = sims.simulate(SCENARIO, 3).readings
        noise_T = NOISE_T * np.random.default_rng(0).normal(size=readings.values_T.shape)
        track = magloc.track(SCENARIO.nominal_array, replace(readings, values_T=noise_T).high_passed(0.05), motion=REST)
        assert not track.tracked.any()
        assert set(track.status) == {"not acquired: no dipole on this background fits the rows"}

    def test_a_fix_of_a_row_is_told_of_filters(self, caplog: pytest.LogCaptureFixture) -> None:
        simulation = sims.simulate(SCENARIO, 0)
        said = simulation.readings[70:74].detrended()
        filtered = magloc.Readings(said.background.taken_out(said.time_s, said.values_T), time_s=said.time_s)
        with caplog.at_level(logging.WARNING, logger="magloc"):
            fixes = magloc.locate(simulation.array, magloc.Readings(said.values_T, time_s=said.time_s).detrended())
        assert "fits of single rows do not model a background" in caplog.text
        np.testing.assert_array_equal(fixes.position_m, magloc.locate(simulation.array, filtered).position_m)


class TestMoments:
    def test_with_lines_are_least_squares(self) -> None:
        """Of all rows, with a column for the slope of every channel; within what the filter's priors leave."""
        array, place = tetrahedron(1.2, noise_T=NOISE_T), np.array([2.0, 0.5, 0.3])
        t = np.arange(12.0)
        rng = np.random.default_rng(5)
        B = np.stack([magloc.dipole.field(array.positions, place, axis).ravel() for axis in np.eye(3)], axis=1)
        values_T = (
            B @ [2.0, -1.0, 3.0] + NOISE_T * rng.normal(size=(12, 12)) + np.outer(t - 5.5, 1e-9 * rng.normal(size=12))
        )
        track = magloc.track_moment(array, Readings(values_T, time_s=t).detrended(), place, turn_rad_s=1e-12)
        W = decorrelated_differences(array).transform / np.sqrt(decorrelated_differences(array).variance)[:, None]
        A = np.concatenate([np.hstack([W @ B, (s - 5.5) * W]) for s in t])
        found = np.linalg.lstsq(A, np.concatenate([W @ row for row in values_T]), rcond=None)[0][:3]
        np.testing.assert_allclose(track.moment_Am2[-1], found, rtol=1e-4)


class TestDrift:
    def test_a_corner_is_that_of_a_first_order_filter(self) -> None:
        """In its steady state a filter of the walk leaves half the power at the corner."""
        drift = BackgroundDrift.of(
            Readings(np.zeros((50, 3)), time_s=0.1 * np.arange(50)).high_passed(0.05).background, 0.1 * np.arange(50)
        )
        assert drift is not None
        q = drift.walk_rts**2 * 0.1
        P = 0.5 * q + math.sqrt(0.25 * q**2 + q)  # of the prediction, by Riccati's equation for noise of one
        gain, w = P / (P + 1.0), 2.0 * math.pi * 0.05 * 0.1
        left = abs((1.0 - np.exp(-1j * w)) / (1.0 - (1.0 - gain) * np.exp(-1j * w))) ** 2
        assert left == pytest.approx(0.5, abs=0.03)

    def test_nothing_said_is_none(self) -> None:
        assert BackgroundDrift.of(Readings(np.zeros((5, 3))).background, np.arange(5.0)) is None
