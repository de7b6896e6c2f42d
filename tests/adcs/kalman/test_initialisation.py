"""Tests of adcs.kalman.initialisation: any true attitude, any estimate, readings that miss or leave a turn open."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from adcs import quaternion
from adcs.kalman.error_state import concatenate_starts, start_near
from adcs.kalman.initialisation import AGAIN, KNOWN_RAD, any_start, largest_deviation_rad, vector_start
from adcs.kalman.mekf import run_filter
from adcs.satellite.telemetry import part
from sims.attitude.scenario import StartConditions
from sims.attitude.simulation import AttitudeRuns, simulate, start_estimates
from sims.experiments.accuracy import error_norm_deg, normalised_error_squared
from tests.adcs.filter_runs import START_RAD_S, believed_runs, runs_for, settings, tabletsat, tumbled

ORBIT_S = 5801.0


class TestVectorStart:
    @pytest.mark.parametrize("sensors", ["mag+sun", "mag+sun+gyro", "st", "st+mag+sun"])
    def test_errors_are_those_of_the_covariance(self, sensors: str) -> None:
        """Sum of squares over 60 runs: a χ² of 180 numbers, two-sided, false alarm 1e-3 for every set; fixed seeds.

        The covariance is wider by the factor that lets the filter take the same readings again.
        """
        chosen = settings(sensors)
        runs, _ = runs_for(chosen.sensors, 5.0, range(60))
        start = vector_start(runs, chosen)
        error = quaternion.error_vector(start.q, runs.q[:, 0])
        covariance = start.covariance[:, :3, :3] / AGAIN**2
        total = np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0])
        low, high = chi2.ppf([0.0005, 0.9995], 180)
        assert low < total < high

    @pytest.mark.parametrize("sensors", ["mag+sun", "mag+sun+gyro", "st"])
    def test_filter_is_consistent_from_its_first_row(self, sensors: str) -> None:
        """NEES of 100 runs from their first readings on, at four instants: two-sided χ², false alarm 1e-3 for each."""
        chosen = settings(sensors)
        runs = believed_runs(chosen, 60.0, range(300, 400))
        estimates = run_filter(runs, chosen, vector_start(runs, chosen))
        low, high = chi2.ppf([0.0005, 0.9995], 600)
        total = normalised_error_squared(runs, estimates).sum(axis=0)
        # Without a gyro the rate of the start is not random: rest in the orbital frame is right within 0.01°/s.
        rows = [0, 5, 20, 60] if chosen.sensors.gyro else [60]
        assert (total[rows] > low).all()
        assert (total[rows] < high).all()

    def test_gyro_gives_the_rate(self) -> None:
        runs, _ = runs_for(settings("mag+sun+gyro").sensors, 5.0, range(8))
        start = vector_start(runs, settings("mag+sun+gyro"))
        np.testing.assert_array_equal(start.w, runs.readings.gyro_rad_s[:, 0])
        assert np.sqrt(start.covariance[:, 3, 3]) == pytest.approx(np.full(8, AGAIN * math.radians(0.005)))

    def test_rest_in_the_orbital_frame_without_gyro(self) -> None:
        runs, _ = runs_for(settings("mag+sun").sensors, 5.0, range(8))
        start = vector_start(runs, settings("mag+sun"))
        assert np.abs(np.degrees(start.w - runs.w[:, 0])).max() < 0.1

    def test_says_what_is_open(self) -> None:
        runs, _ = runs_for(settings("mag+sun+gyro").sensors, 5.0, range(4))
        assert (largest_deviation_rad(vector_start(runs, settings("mag+sun+gyro"))) < KNOWN_RAD).all()
        assert (largest_deviation_rad(vector_start(runs, settings("mag+gyro"))) > 1.0).all()
        runs.readings.sun[2, 0] = np.nan
        deviation = largest_deviation_rad(vector_start(runs, settings("mag+sun+gyro")))
        assert (deviation > KNOWN_RAD).tolist() == [False, False, True, False]


@pytest.fixture(scope="module")
def tumbling() -> AttitudeRuns:
    """100 runs whose true attitudes are uniform over all rotations at first."""
    return tumbled(600.0, range(100))


class TestAnyStart:
    @pytest.mark.parametrize("sensors", ["mag+sun", "mag+sun+gyro", "st+gyro"])
    def test_uniform_true_attitudes(self, sensors: str, tumbling: AttitudeRuns) -> None:
        """At some of them no head sees the Sun at first, or the Earth blinds the star tracker."""
        runs, chosen = tumbling, settings(sensors)
        seen = runs.readings.seen["st"] if chosen.sensors.star else runs.readings.seen["sun"]
        assert not seen[:, 0].all()
        estimates = run_filter(runs, chosen, any_start(runs, chosen))
        converged = error_norm_deg(runs, estimates)[:, -60:].max(axis=-1) < 1.0
        assert converged.mean() >= 0.99

    @pytest.mark.slow
    def test_anywhere_within_one_orbit(self) -> None:
        """The same with starts anywhere on the orbit: in eclipse, and with Sun and field on one line, too."""
        conditions = StartConditions(False, 0.0, math.radians(90.0), 0.0)
        runs = tumbled(ORBIT_S, range(100), conditions)
        for sensors in ("mag+sun", "mag+sun+gyro"):
            chosen = settings(sensors)
            norm = error_norm_deg(runs, run_filter(runs, chosen, any_start(runs, chosen)))
            # A filter without gyro loses degrees in eclipse: it counts where the Sun has been seen for five minutes.
            lit = np.lib.stride_tricks.sliding_window_view(runs.readings.seen["sun"], 300, axis=1).all(axis=-1)
            last = [299 + np.flatnonzero(one)[-1] for one in lit]
            assert np.mean(norm[np.arange(100), last] < 1.0) >= 0.99

    def test_one_direction(self, tumbling: AttitudeRuns) -> None:
        runs, chosen = tumbling, settings("mag+gyro")
        # A few runs at once: 36 hypotheses of each, with all their covariances, are large.
        few = np.array_split(np.arange(100), 10)
        starts = [any_start(part(runs, some), chosen) for some in few]
        estimates = run_filter(runs, chosen, concatenate_starts(starts))
        assert np.mean(error_norm_deg(runs, estimates)[:, -60:].max(axis=-1) < 1.5) >= 0.95

    def test_plain_start_fails_where_this_one_works(self) -> None:
        """Negative for a filter without a gate: from 100° an axis off it finds back in less than half of the runs."""
        chosen = settings("mag+sun+gyro")
        runs = simulate(tabletsat(300.0), range(40))
        q, w = start_estimates(runs.prepared, math.radians(100.0), START_RAD_S)
        starts = (start_near(q, w, math.radians(100.0), START_RAD_S), any_start(runs, chosen))
        plain, any_ = (
            np.mean(
                error_norm_deg(runs, run_filter(runs, replace(chosen, gate=0.0), start))[:, -60:].max(axis=-1) < 1.0
            )
            for start in starts
        )
        # A gate finds the attitude anew, by the second hypothesis that the readings begin.
        assert (error_norm_deg(runs, run_filter(runs, chosen, starts[0]))[:, -60:] < 1.0).all()
        assert plain < 0.6
        assert any_ == 1.0

    def test_no_direction_at_all(self) -> None:
        runs, _ = runs_for(settings("mag+sun").sensors, 5.0, range(2))
        runs.readings.field_T[1, 0], runs.readings.sun[1, 0] = np.nan, np.nan
        with pytest.raises(ValueError, match="must have a direction at the first instant of every run"):
            any_start(runs, settings("mag+sun"))

    def test_known_starts_are_not_touched(self) -> None:
        chosen = settings("mag+sun")
        runs, _ = runs_for(chosen.sensors, 60.0, range(4))
        runs.readings.sun[2, 0] = np.nan
        alone, known = any_start(runs, chosen), vector_start(runs, chosen)
        for run in (0, 1, 3):
            np.testing.assert_array_equal(alone.q[run], known.q[run])
        assert largest_deviation_rad(alone)[2] < math.radians(11.0) < largest_deviation_rad(known)[2]
