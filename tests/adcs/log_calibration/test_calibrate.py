"""Calibration from simulated flights with known errors of the sensors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

import adcs
from adcs.log_calibration.fit import fit_log
from adcs.log_calibration.terms import term_values
from sims.attitude.flights import FlightSettings, simulate_flight
from tests.adcs.log_calibration.flights import FIELD_T, calibrated, parameter_errors

SHORT = FlightSettings(duration_s=80.0, inertial_Hz=50.0, magnetometer_Hz=25.0)


def sigma_of(found, name):
    return next(entry["sigma"] for entry in found.entries if entry["name"] == name)


def manoeuvre_of(found, name):
    return next(entry["manoeuvre"] for entry in found.entries if entry["name"] == name)


class TestErrorsAndTheirCovariance:
    def test_few_flights(self):
        """χ² of all parameters of four flights; 1 of 1,000 correct programs fails."""
        total, dof = 0.0, 0
        for seed in range(820, 824):
            error, covariance = parameter_errors(*calibrated(seed, SHORT))
            total += error @ np.linalg.solve(covariance, error)
            dof += len(error)
        assert chi2.ppf(5e-4, dof) < total < chi2.ppf(1.0 - 5e-4, dof)

    @pytest.mark.slow
    def test_fifty_flights_of_ten_minutes(self):
        """NEES 0.7 to 1.3; median errors of at most 60 nT, 0.3 %, 3 % of 50 nT/A and 3 ms."""
        squares, offsets, irons, currents, lags = [], [], [], [], []
        for seed in range(1000, 1050):
            flight, found = calibrated(seed, FlightSettings())
            error, covariance = parameter_errors(flight, found)
            squares.append(error @ np.linalg.solve(covariance, error) / len(error))
            offsets.append(found.offset_T(0) - flight.offset_T[0])
            currents.append(found.current_T(0)[0] - flight.current_T_A[0])
            lags.append(error[-4])
            truth, matrix = flight.scale[0], found.matrix(0)
            irons.append(3.0 * (matrix / np.trace(matrix) - truth / np.trace(truth)))
        assert 0.7 < np.mean(squares) < 1.3
        assert np.median(np.abs(offsets)) < 60e-9
        assert np.median(np.abs(irons)) < 0.003
        assert np.median(np.abs(currents)) < 0.03 * 50e-9
        assert np.median(np.abs(lags)) < 0.003


class TestCorrectedReadings:
    def test_field_in_true_body_axes(self):
        """Turned into the world by the true attitude at their own times, the readings are the Earth's field."""
        flight, found = calibrated(7, SHORT)
        series = found.corrected(0)
        attitude = Slerp(flight.log.time_s, flight.rotation)(series.time_s)
        error_T = attitude.apply(series.values) - FIELD_T
        assert np.sqrt(np.mean(error_T**2)) < 3.0 * FlightSettings().noise_T


class TestUndetermined:
    def test_constant_heading_and_small_tilt(self):
        """Nearly constant attitude: no offset is known better than the soft iron's prior of a tenth allows."""
        flight, found = calibrated(5, replace(SHORT, turns=False, tilt_deg=3.0))
        for axis in "xyz":
            assert f"mag0 offset {axis}" in found.undetermined
            assert sigma_of(found, f"mag0 offset {axis}") > 1000.0
        assert "mag0 soft iron zz" in found.undetermined
        assert "turn" in manoeuvre_of(found, "mag0 offset z")
        error, covariance = parameter_errors(flight, found)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(1.0 - 1e-3, len(error))

    def test_rest(self):
        """A vehicle that stands: the field in its sensor is one vector, so that no term of it is determined."""
        flight = simulate_flight(3, replace(SHORT, turns=False, tilt_deg=0.01, current_T_A=0.0))
        log = replace(flight.log, currents=())
        found = adcs.calibrate_log(log, field_T=FIELD_T)
        names = [name for name in found.undetermined if name.startswith("mag0 ")]
        assert {"mag0 offset x", "mag0 offset y", "mag0 offset z", "mag0 lag", "mag0 axes about z"} <= set(names)
        assert not found.is_determined("mag0", "soft iron")

    def test_the_named_manoeuvre_determines_the_term(self):
        """On a constant heading a turn about the yaw axis is named; the same flight with turns determines the term."""
        settings = replace(SHORT, turns=False, tilt_deg=3.0)
        _, found = calibrated(5, settings)
        assert manoeuvre_of(found, "mag0 soft iron zz") == "turn once about the yaw axis, level"
        _, better = calibrated(5, replace(settings, turns=True))
        assert "mag0 soft iron zz" not in better.undetermined

    def test_scale_without_a_place(self):
        flight = simulate_flight(10, replace(SHORT, magnetometers=2))
        found = adcs.calibrate_log(flight.log)
        assert {"mag0 scale", "mag1 scale"} <= set(found.undetermined)
        assert "--place" in manoeuvre_of(found, "mag1 scale")
        # Two magnetometers of one log have the same unknown modulus: their ratio is known.
        layout = found.fit.estimate.problem.layout
        matrices = [found.matrix(m) for m in (0, 1)]
        ratio = np.trace(matrices[0]) / np.trace(matrices[1])
        assert ratio == pytest.approx(np.trace(flight.scale[0]) / np.trace(flight.scale[1]), abs=0.005)
        assert layout.magnetometers == ("mag0", "mag1")

    def test_current_that_is_constant(self):
        flight = simulate_flight(4, SHORT)
        steady = replace(flight.log.currents[0], values=np.full(len(flight.log.time_s), 15.0))
        found = adcs.calibrate_log(replace(flight.log, currents=(steady,)), field_T=FIELD_T)
        assert {f"mag0 battery_A {axis}" for axis in "xyz"} <= set(found.undetermined)
        assert "change battery_A by 10" in manoeuvre_of(found, "mag0 battery_A x")


class TestMounting:
    @pytest.mark.slow_after(2)
    @pytest.mark.parametrize(
        ("angles", "word"),
        [
            ((0, 0, 90), "ROTATION_YAW_90"),
            ((180, 0, 45), "ROTATION_ROLL_180_YAW_45"),
            ((0, 90, 0), "ROTATION_PITCH_90"),
        ],
    )
    def test_wrong_rotation_is_named_and_calibrated(self, angles, word):
        sensor_from_body = Rotation.from_euler("xyz", angles, degrees=True).inv()
        flight, found = calibrated(6, replace(SHORT, mounting=sensor_from_body))
        assert any(f"turned against the gyro by {word}:" in flag for flag in found.flags)
        np.testing.assert_allclose(found.matrix(0), flight.scale[0], atol=0.03)

    def test_right_rotation_is_not_named(self):
        assert calibrated(7, SHORT)[1].flags == ()


class TestFaults:
    def test_magnet_nearby_wild_readings_and_missing_ones(self):
        """A magnet passes within 20 s, one reading of a hundred is wild, six seconds are missing."""
        flight, mag = simulate_flight(8, replace(SHORT, duration_s=180.0)), None
        mag, rng = flight.log.magnetometers[0], np.random.default_rng(0)
        values, near = mag.values.copy(), (mag.time_s > 60.0) & (mag.time_s < 80.0)
        values[near] += np.sin(np.pi * (mag.time_s[near, None] - 60.0) / 20.0) * [3e-6, -5e-6, 8e-6]
        wild = rng.random(len(values)) < 0.01
        values[wild] += rng.normal(0.0, 50e-6, (wild.sum(), 3))
        values[3000:3300] = np.nan
        log = replace(flight.log, magnetometers=(replace(mag, values=values),))
        found = adcs.calibrate_log(log, field_T=FIELD_T)
        assert len(found.flags) == 2
        assert "no readings from 120.0 to 132.0 s" in found.flags[0]
        assert "as by a magnet nearby" in found.flags[1]
        error, covariance = parameter_errors(flight, found)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(1.0 - 1e-3, len(error))

    def test_gap_of_the_gyro(self):
        flight = simulate_flight(9, SHORT)
        kept = np.r_[0:1500, 1575:3000, 3005 : len(flight.log.time_s)]
        log = replace(
            flight.log,
            time_s=flight.log.time_s[kept],
            gyro_rad_s=flight.log.gyro_rad_s[kept],
            acceleration_m_s2=flight.log.acceleration_m_s2[kept],
        )
        found = adcs.calibrate_log(log, field_T=FIELD_T)
        assert any("gaps" in flag for flag in found.flags)
        error, covariance = parameter_errors(flight, found)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(1.0 - 1e-3, len(error))

    def test_accelerometer_that_points_down_at_rest(self):
        """Tilt and inclination contradict each other: the noise takes all of it, and a flag states it."""
        log = simulate_flight(1, replace(SHORT, duration_s=30.0)).log
        found = adcs.calibrate_log(replace(log, acceleration_m_s2=-log.acceleration_m_s2), field_T=FIELD_T)
        assert any("contradicts gyro and accelerometer" in flag for flag in found.flags)

    @pytest.mark.parametrize("axis", range(3))
    def test_reversed_axis(self, axis):
        """The fit finds a left-handed matrix, or a rotation that contradicts the gyro: no advice on the mounting."""
        log = simulate_flight(1, replace(SHORT, duration_s=30.0)).log
        mag = log.magnetometers[0]
        values = mag.values * np.where(np.arange(3) == axis, -1.0, 1.0)
        try:
            words = adcs.calibrate_log(
                replace(log, magnetometers=(replace(mag, values=values),)), field_T=FIELD_T
            ).flags
        except ValueError as error:
            words = (str(error),)
        assert any("fit with an axis reversed" in word or "check signs, axes" in word for word in words)
        assert not any("ROT" in word for word in words)

    def test_equal_readings(self):
        log = simulate_flight(1, replace(SHORT, duration_s=30.0)).log
        mag = log.magnetometers[0]
        with pytest.raises(ValueError, match="readings that vary"):
            adcs.calibrate_log(
                replace(log, magnetometers=(replace(mag, values=np.full_like(mag.values, 1e-5)),)), field_T=FIELD_T
            )

    @pytest.mark.parametrize("value_T", [0.0, 2e-5, np.nan])
    def test_magnetometer_that_stops(self, value_T):
        """A sensor that stands at one value, at zero or reads nothing is ignored from then on, and named."""
        flight = simulate_flight(9, replace(SHORT, magnetometers=2))
        log, (good, bad) = flight.log, flight.log.magnetometers
        values = np.where(bad.time_s[:, None] > 30.0, value_T, bad.values)
        found = adcs.calibrate_log(replace(log, magnetometers=(good, replace(bad, values=values))), field_T=FIELD_T)
        words = "mag1 has no readings from 30.0" if np.isnan(value_T) else "mag1 keeps one value from 30.0"
        assert any(words in flag for flag in found.flags)
        error, covariance = parameter_errors(flight, found)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(1.0 - 1e-3, len(error))

    @pytest.mark.parametrize("axis", range(3))
    def test_axis_that_stands(self, axis):
        """One axis of a sensor stands while the others move: the sensor is ignored from then on, and named."""
        flight = simulate_flight(9, SHORT)
        mag = flight.log.magnetometers[0]
        values = mag.values.copy()
        values[mag.time_s > 40.0, axis] = values[mag.time_s <= 40.0, axis][-1]
        found = adcs.calibrate_log(replace(flight.log, magnetometers=(replace(mag, values=values),)), field_T=FIELD_T)
        assert any("mag0 keeps one value from 40.0" in flag for flag in found.flags)
        error, covariance = parameter_errors(flight, found)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(1.0 - 1e-3, len(error))

    def test_log_without_currents(self):
        flight = simulate_flight(1, replace(SHORT, duration_s=30.0))
        found = adcs.calibrate_log(replace(flight.log, currents=()), field_T=FIELD_T)
        assert any("no current or throttle" in flag for flag in found.flags)

    def test_fit_that_does_not_converge(self, monkeypatch):
        """No term counts as determined."""
        monkeypatch.setattr(
            "adcs.log_calibration.calibrate.fit_log", lambda *of: replace(fit_log(*of), converged=False)
        )
        found = adcs.calibrate_log(simulate_flight(1, replace(SHORT, duration_s=30.0)).log, field_T=FIELD_T)
        assert len(found.undetermined) == len(found.terms.names)
        assert "did not converge" in found.flags[0]

    def test_clock_that_jumps_by_months(self):
        """All readings of the magnetometer are before the jump or in the gap."""
        log = simulate_flight(1, replace(SHORT, duration_s=30.0)).log
        later = np.where(log.time_s > 20.0, log.time_s + 1e7, log.time_s)
        with pytest.raises(ValueError, match="outside gaps of the gyro"):
            adcs.calibrate_log(replace(log, time_s=later), field_T=FIELD_T)

    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"magnetometers": ()}, "must name one magnetometer"),
            ({"gyro_rad_s": np.zeros((3, 3))}, "gyro_rad_s must have shape"),
            ({"time_s": np.linspace(0.0, 1.0, 1000)}, "must span 2 s"),
            ({"acceleration_m_s2": np.zeros((1000, 3))}, "median length of 1 to 100 m/s"),
            ({"gyro_rad_s": np.full((1000, 3), 500.0)}, "Check its unit"),
        ],
    )
    def test_refusals(self, change, words):
        log = simulate_flight(1, replace(SHORT, duration_s=20.0)).log
        with pytest.raises(ValueError, match=words):
            replace(log, **change)

    def test_magnetometer_outside_the_inertial_readings(self):
        log = simulate_flight(1, replace(SHORT, duration_s=20.0)).log
        late = replace(log.magnetometers[0], time_s=log.magnetometers[0].time_s + 1e4)
        with pytest.raises(ValueError, match="ten readings during"):
            adcs.calibrate_log(replace(log, magnetometers=(late,)))


def test_soft_iron_is_the_symmetric_factor_of_the_matrix():
    """Its trace is 3; the oracle is SciPy's root of the matrix times its transpose."""
    _, found = calibrated(7, SHORT)
    root = sqrtm(found.matrix(0) @ found.matrix(0).T)
    values = {entry["name"]: entry["value"] for entry in found.entries}
    for i, one in enumerate("xyz"):
        for j, other in enumerate("xyz"[i:], i):
            expected = 3.0 * root[i, j] / np.trace(root)
            assert values[f"mag0 soft iron {one}{other}"] == pytest.approx(expected, abs=1e-9)


def test_sigma_of_terms_is_that_of_drawn_parameters():
    """Terms are functions of the parameters; σ by their slope against that of 4,000 draws, whose own error is 1 %."""
    _, found = calibrated(11, replace(SHORT, duration_s=60.0))
    problem, fit = found.fit.estimate.problem, found.fit
    rng = np.random.default_rng(2)
    draws = rng.multivariate_normal(fit.estimate.parameters, fit.solution.covariance, 4000)
    values = [term_values(problem.layout, draw, fit.mountings) for draw in draws]
    np.testing.assert_allclose(np.std(values, axis=0), found.terms.sigma, rtol=0.06)
