"""Tests of attitude and rate from a magnetometer alone, by the equations of motion."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adcs import quaternion
from adcs.kalman.error_state import start_near
from adcs.kalman.initialisation import any_start, choose_start, vector_start
from adcs.kalman.mekf import run_filter
from adcs.satellite.dynamics import absolute_rate
from magloc.chi_square import normalised_square
from sims.attitude.simulation import AttitudeRuns, prepare, simulate
from sims.experiments.accuracy import error_norm_deg, normalised_error_squared
from tests.adcs.attitudes import random_attitudes
from tests.adcs.filter_runs import ANY_START, followed, settings, start_of, tabletsat

STATES = ("dipole",)
SCENARIO = replace(tabletsat(12_000.0), conditions=ANY_START, torque_Nm=0.0, dipole_Am2=(0.0, 0.05, 0.02))


class TestFromNothing:
    def check(self, runs: AttitudeRuns, share: float) -> None:
        """Within 1° after two orbits, and of those the second orbit's rms of an axis and NEES."""
        chosen = settings("mag", STATES)
        tracks = run_filter(runs, chosen, any_start(runs, chosen))
        there = error_norm_deg(runs, tracks)[:, -1] < 1.0
        assert there.mean() >= share
        error = quaternion.error_vector(tracks.q, runs.q)[there, 6000:]
        assert np.degrees(2.0 * np.sqrt(np.mean(error**2, axis=(0, 1)))).max() < 0.1
        assert 0.4 < normalised_square(error, tracks.covariance[there, 6000:, :3, :3]).mean() / 3.0 < 1.4
        rate_deg_s = np.degrees(np.sqrt(np.mean((tracks.w - runs.w)[there, 6000:] ** 2)))
        assert rate_deg_s < 1e-3

    def test_near_the_orbital_frame(self) -> None:
        self.check(simulate(SCENARIO, range(2)), 1.0)

    @pytest.mark.slow
    def test_any_attitude_and_rate(self) -> None:
        """Uniform attitudes and 0.2°/s an axis, which the wheels take out."""
        seeds, rng = range(100, 120), np.random.default_rng(6)
        prepared = prepare(SCENARIO, seeds)
        n = len(seeds)
        q = random_attitudes(n, rng)
        rate = math.radians(0.2) * rng.standard_normal((n, 3))
        w = absolute_rate(q, rate, prepared.environment.orbital_rate_rad_s[:, 0])
        self.check(followed(replace(prepared, q=q, w=w)), 0.95)


class TestUnknownTorque:
    """A torque of 8e-7 N·m and a dipole that nobody knows, which lead a filter astray within the first orbit."""

    STATES = ("disturbance", "dipole")

    def check(self, seeds: range) -> None:
        """Last minute of every run, and NEES of all states over the second orbits, which correlate over an orbit."""
        chosen = settings("mag", self.STATES)
        runs = simulate(replace(SCENARIO, torque_Nm=8e-7), seeds)
        given = start_of(runs)
        tracks = run_filter(runs, chosen, choose_start(runs, chosen, given))
        assert error_norm_deg(runs, tracks)[:, -60:].max() < 0.2
        assert 0.2 < np.mean(normalised_error_squared(runs, tracks)[:, 6000:] / chosen.sensors.size) < 1.6

    def test_one_run(self) -> None:
        self.check(range(772, 773))

    @pytest.mark.slow
    def test_ten_runs(self) -> None:
        self.check(range(900, 910))


class TestCheckedStart:
    def test_a_start_that_is_right_is_taken(self) -> None:
        runs = simulate(replace(SCENARIO, duration_s=1500.0), range(1))
        right = start_near(runs.q[:, 0], runs.w[:, 0], math.radians(0.01), math.radians(1e-4))
        taken = choose_start(runs, settings("mag", STATES), right)
        np.testing.assert_array_equal(taken.q, right.q)
        np.testing.assert_array_equal(taken.covariance[:, :6, :6], right.covariance)

    def test_other_sensors_start_where_they_are_told(self) -> None:
        runs = simulate(replace(SCENARIO, duration_s=5.0), range(1))
        given = start_of(runs)
        assert choose_start(runs, settings("mag+sun", STATES), given) is given


class TestStart:
    def test_of_one_run_does_not_depend_on_the_others(self) -> None:
        runs = simulate(replace(SCENARIO, duration_s=300.0), range(3))
        alone = simulate(replace(SCENARIO, duration_s=300.0), [1])
        chosen = settings("mag", STATES)
        np.testing.assert_array_equal(any_start(runs, chosen).q[1], any_start(alone, chosen).q[0])

    def test_says_what_one_reading_leaves_open(self) -> None:
        runs = simulate(replace(SCENARIO, duration_s=5.0), range(3))
        largest = np.linalg.eigvalsh(vector_start(runs, settings("mag", STATES)).covariance[:, :3, :3])[:, -1]
        np.testing.assert_allclose(2.0 * np.sqrt(largest), 2.0, rtol=1e-9)
