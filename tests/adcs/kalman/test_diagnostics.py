"""What a filter says of torques that it does not know, from the residuals of readings that each fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import adcs
import sims
from adcs.kalman.diagnostics import postfit_residuals, unseen_torque_Nm, warning_sentences
from adcs.kalman.error_state import AttitudeTracks
from adcs.kalman.mekf import run_filter, stacked_residuals
from sims.attitude.scenario import StartConditions
from sims.attitude.simulation import AttitudeRuns, simulate
from tests.adcs.filter_runs import ANY_START, believed_runs, settings, start_of, tabletsat

SETTINGS = settings("mag+sun+gyro", ["gyro-bias", "disturbance"])


def lasting(runs: AttitudeRuns, tracks: AttitudeTracks) -> list[bool]:
    """Which runs have the warning."""
    return [any(text.startswith("residuals last") for text in texts) for texts in warning_sentences(runs, tracks)]


def swinging(period_s: float, torque_Nm: float = 8e-7) -> tuple[AttitudeRuns, AttitudeTracks]:
    scenario = replace(
        tabletsat(2500.0), conditions=ANY_START, gyro_bias_rad_s=0.0, torque_Nm=torque_Nm, torque_period_s=period_s
    )
    runs = simulate(scenario, range(4))
    return runs, run_filter(runs, SETTINGS, start_of(runs))


class TestResidualsThatLast:
    @pytest.mark.parametrize("period_s", [300.0, 1000.0])
    def test_a_torque_that_swings_is_told(self, period_s: float) -> None:
        assert all(lasting(*swinging(period_s)))

    @pytest.mark.slow
    def test_a_truth_as_the_filter_believes_is_not(self) -> None:
        # False-alarm rate 1e-6 a run.
        runs = believed_runs(SETTINGS, 1000.0, range(40))
        assert not any(lasting(runs, run_filter(runs, SETTINGS, start_of(runs))))

    def test_they_are_those_of_the_filter(self) -> None:
        runs = believed_runs(SETTINGS, 60.0, range(2))
        tracks = run_filter(runs, SETTINGS, start_of(runs))
        after = postfit_residuals(runs, tracks, run=1)
        _, stacked = stacked_residuals(runs, 40, tracks.at(40), SETTINGS)
        sigma = [
            runs.satellite.gyro.sigma_rad_s,
            runs.satellite.magnetometer.sigma_T,
            runs.satellite.sun_sensor.sigma_rad,
        ]
        each = np.concatenate([after[sensor][40] / one for sensor, one in zip((1, 2, 3), sigma, strict=True)])
        np.testing.assert_allclose(each, stacked[1], rtol=1e-9, atol=1e-12)


class TestUnseenTorque:
    def test_of_a_star_tracker_alone(self) -> None:
        """0.7 of the angle's σ times (2π/T)² and the largest moment of inertia."""
        runs = believed_runs(settings("st"), 30.0, range(1))
        tracks = run_filter(runs, settings("st"), start_of(runs))
        J = np.linalg.eigvalsh(runs.satellite.body.inertia_kgm2)[-1]
        expected = 0.7 * 2.0 * runs.satellite.star_tracker.sigma_rad * (2.0 * np.pi / 300.0) ** 2 * J
        assert unseen_torque_Nm(runs, tracks, 0)[300.0] == pytest.approx(expected, rel=1e-12)

    def test_a_torque_below_is_not_seen(self) -> None:
        """Of a period of 100 s 8e-7 N·m are below; the warning, a rate of 1e-6 but for the torque, does not come."""
        runs, tracks = swinging(100.0)
        assert unseen_torque_Nm(runs, tracks, 0)[100.0] > 8e-7
        assert not any(lasting(runs, tracks))

    def test_a_gyro_helps_with_short_periods(self) -> None:
        runs, tracks = swinging(1000.0)
        without = settings("mag+sun", ["disturbance"])
        seen, alone = (unseen_torque_Nm(runs, one, 0) for one in (tracks, run_filter(runs, without, start_of(runs))))
        assert seen[100.0] < 0.7 * alone[100.0]
        assert seen[1000.0] == pytest.approx(alone[1000.0], rel=0.1)


class TestMissingReadings:
    """Gaps that neither Sun, Earth, shadow nor heads explain, in a log of every second second."""

    def warnings(self, lost: slice, sensors: str) -> str:
        runs = simulate(replace(tabletsat(400.0), conditions=StartConditions()), [3])
        log = adcs.Telemetry.of(runs, runs.satellite.start)
        every = slice(None, None, 2)
        star, sun = log.star[every].copy(), log.sun[every].copy()
        star[lost] = sun[lost] = np.nan
        thinned = adcs.Telemetry(
            log.time_s[every],
            star=star,
            gyro_rad_s=log.gyro_rad_s[every],
            field_T=log.field_T[every],
            sun=sun,
            wheels_Nms=log.wheels_Nms[every],
            step_s=1.0,
        )
        return " ".join(adcs.estimate(thinned, runs.satellite, sensors=sensors).warnings)

    def test_nothing_is_missing_between_rows(self) -> None:
        text = self.warnings(slice(0, 0), "st+gyro+mag+sun")
        assert "no reading" not in text
        assert "blinded" not in text
        assert "Sun" not in text

    def test_of_no_known_reason(self) -> None:
        """Twenty rows of two seconds."""
        text = self.warnings(slice(50, 70), "st+gyro+mag+sun")
        assert "no reading of the star tracker for 40 s: neither its rate nor Sun or Earth" in text
        assert "no reading of the Sun sensor for 40 s: neither eclipse nor its heads' fields" in text
        assert "blinded" not in text
        assert "outside of all heads" not in text

    def test_of_a_tracker_that_is_blinded(self) -> None:
        """By the Sun and the Earth of the simulation; then the same gaps of a tracker on another side."""
        runs = sims.simulate(sims.read_scenario("star-blinded"), [0])
        assert isinstance(runs, AttitudeRuns)
        turned = replace(runs.satellite.star_tracker, boresight_body=np.array([0.0, 1.0, 0.0]))
        found = []
        for satellite in (runs.satellite, replace(runs.satellite, star_tracker=turned)):
            record = replace(runs, satellite=satellite)
            tracks = run_filter(record, settings("st+gyro"), start_of(runs))
            found.append([text for text in warning_sentences(record, tracks)[0] if "rate" not in text.split(":")[0]])
        lost = np.isnan(runs.readings.star[0, :, 0]) & (np.linalg.norm(runs.w[0], axis=-1) <= np.radians(2.0))
        assert f"star tracker blinded by Sun or Earth for {lost.sum()} s" in found[0]
        assert not any("blinded" in text for text in found[1])
        assert any(f"no reading of the star tracker for {lost.sum()} s" in text for text in found[1])
