"""Tests of adcs.kalman.bank: what leaves double precision is refused in one sentence, never returned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import adcs
from adcs.kalman.bank import EstimatorSettings, estimate_tracks
from adcs.kalman.names import FILTERS, Filter
from adcs.satellite.sensors import StarTracker
from arrays.io.errors import InputError
from sims.attitude.simulation import simulate
from sims.experiments.attitude import Part, outcome_of
from tests.adcs.filter_runs import start_of, tabletsat

SENSORS = "st+gyro+mag+sun"
SCENARIO = tabletsat(20.0)


class TestDivergence:
    """pytest makes an error of every warning that NumPy gives on the way."""

    @pytest.mark.parametrize("name", FILTERS)
    @pytest.mark.parametrize("rate_rad_s", [1e30, 1e100, 1e160])
    def test_rates_that_overflow(self, name: Filter, rate_rad_s: float) -> None:
        runs = simulate(SCENARIO, [0])
        runs.readings.gyro_rad_s[0, 5:] = rate_rad_s
        telemetry = adcs.Telemetry.of(runs, SCENARIO.satellite.start)
        if name in ("mekf", "smoother", "self-tuning"):
            # These have a gate, and go on without the gyro.
            track = adcs.estimate(telemetry, SCENARIO.satellite, sensors=SENSORS, filter=name)
            assert track.rejected["gyro"][5:].all()
            assert runs.error_deg(track)[-1] < 1.0
            return
        with pytest.raises(ValueError, match=r"that an attitude explains|no longer positive definite"):
            adcs.estimate(telemetry, SCENARIO.satellite, sensors=SENSORS, filter=name)

    def test_noise_whose_square_is_lost(self) -> None:
        runs = simulate(SCENARIO, [0])
        satellite = replace(SCENARIO.satellite, star_tracker=StarTracker(sigma_rad=1e-200))
        telemetry = adcs.Telemetry.of(runs, satellite.start)
        with pytest.raises(ValueError, match=r"that an attitude explains|no longer positive definite"):
            adcs.estimate(telemetry, satellite, sensors="st")

    def test_a_covariance_that_is_none_is_a_divergence(self) -> None:
        """However good the attitude."""
        runs = simulate(SCENARIO, [0, 1])
        chosen = EstimatorSettings.of(SENSORS)
        tracks = estimate_tracks(runs, chosen, start_of(runs))
        assert not outcome_of(Part(runs, tracks)).diverged.any()
        covariance = tracks.covariance.copy()
        covariance[1, -1, 4, 4] *= -1.0
        lost = replace(tracks, covariance=covariance)
        np.testing.assert_array_equal(lost.definite, [True, False])
        np.testing.assert_array_equal(outcome_of(Part(runs, lost)).diverged, [False, True])

    def test_what_linear_algebra_refuses_names_the_filter(self) -> None:
        def start(*_: object) -> None:
            raise np.linalg.LinAlgError("Eigenvalues did not converge")

        with pytest.raises(InputError, match="filter mekf: found a covariance that is no longer positive definite"):
            estimate_tracks(simulate(SCENARIO, [0]), EstimatorSettings.of(SENSORS), start)  # type: ignore[arg-type]


def test_directions_on_one_line_are_a_start() -> None:
    """What the log holds of Sun and field is the same direction: its turn is open, and nobody else has to say so."""
    runs = simulate(SCENARIO, [0])
    runs.readings.sun[0, 0] = runs.readings.field_T[0, 0] / np.linalg.norm(runs.readings.field_T[0, 0])
    telemetry = adcs.Telemetry.of(runs, SCENARIO.satellite.start)
    track = adcs.estimate(telemetry, SCENARIO.satellite, sensors="mag+sun+gyro")
    assert np.isfinite(track.q).all()
