"""Tests of the state field-gain: gains and axes of a magnetometer that nobody calibrated, found in flight."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from adcs import quaternion
from adcs.kalman.error_state import FilterSettings
from adcs.kalman.initialisation import largest_deviation_rad, vector_start
from adcs.kalman.mekf import run_filter
from magloc.chi_square import normalised_square
from sims.attitude.simulation import AttitudeRuns, simulate
from sims.experiments.accuracy import error_norm_deg, errors
from tests.adcs.filter_runs import ANY_START, settings, start_of, tabletsat

STATES = ("field-bias", "field-gain")


def uncalibrated(duration_s: float, seeds: range) -> AttitudeRuns:
    """5 %, 1° and 1.8 µT."""
    size = {"field_gain": 0.05, "field_axes_rad": math.radians(1.0), "field_bias_T": 1.8e-6}
    return simulate(replace(tabletsat(duration_s), conditions=ANY_START, **size), seeds)


def chosen(states: tuple[str, ...] = STATES) -> FilterSettings:
    return replace(settings("mag+sun+gyro", states), field_bias_sigma_T=2e-6)


class TestReadings:
    def test_of_gains_and_axes(self) -> None:
        """Readings are those of a good magnetometer, times E + D, besides bias and noise."""
        runs = uncalibrated(20.0, range(40))
        good = replace(runs.prepared, field_gain=np.zeros((40, 3, 3)))
        b = quaternion.rotate_back(runs.q, runs.prepared.true_field_orbital_T)
        without = AttitudeRuns.of(good, runs.q, runs.w, runs.momentum_Nms, runs.wheel_torque_Nm).readings.field_T
        expected = np.einsum("rij,rnj->rni", runs.prepared.field_gain, b)
        np.testing.assert_allclose(runs.readings.field_T - without, expected, rtol=0, atol=1e-18)
        D = runs.prepared.field_gain
        off = D[:, ~np.eye(3, dtype=bool)]
        # Standard deviations of 120 and 240 numbers: within four of their own.
        assert np.std(np.diagonal(D, axis1=1, axis2=2)) == pytest.approx(0.05, rel=4.0 / math.sqrt(240))
        assert np.std(off) == pytest.approx(math.radians(1.0), rel=4.0 / math.sqrt(480))


class TestAccuracy:
    def test_two_orbits(self) -> None:
        """At most 0.2°, where a filter that believes its magnetometer is degrees off."""
        runs = uncalibrated(12_000.0, range(6))
        tracks, without = (run_filter(runs, one, start_of(runs)) for one in (chosen(), chosen(())))
        late = slice(6000, None)
        rms = [np.sqrt(np.mean(error_norm_deg(runs, one)[:, late] ** 2)) for one in (tracks, without)]
        assert rms[0] < 0.2
        assert rms[1] > 1.5
        error = errors(runs, tracks)[:, late, :3]
        assert 0.7 < normalised_square(error, tracks.covariance[:, late, :3, :3]).mean() / 3.0 < 1.4
        wrong = (runs.states["field-gain"] - tracks.optional["field-gain"])[:, -1]
        assert np.sqrt(np.mean(wrong**2)) < 0.005
        assert not tracks.rejected.any()

    def test_nothing_is_lost_with_a_good_magnetometer(self) -> None:
        """But for what the calibration costs until it is known: against its own claim."""
        runs = simulate(replace(tabletsat(6000.0), conditions=ANY_START), range(4))
        tracks = run_filter(runs, chosen(), start_of(runs))
        error = errors(runs, tracks)[:, 1000:, :3]
        assert normalised_square(error, tracks.covariance[:, 1000:, :3, :3]).mean() / 3.0 < 1.4


class TestStart:
    def test_is_as_wide_as_the_calibration_is_unknown(self) -> None:
        runs = uncalibrated(10.0, range(30))
        start = vector_start(runs, chosen())
        error = quaternion.error_vector(start.q, runs.q[:, 0])
        nees = normalised_square(error, start.covariance[:, :3, :3]) / 3.0
        assert nees.max() < 5.0
        assert largest_deviation_rad(start).min() > largest_deviation_rad(vector_start(runs, chosen(()))).min()
