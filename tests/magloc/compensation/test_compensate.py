"""Compensation of simulated flights with known coefficients, and of flights with faults.

Seeds are those of nothing else; no constant was chosen by these flights.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from scipy.stats import chi2

import magloc
from arrays.typing import BoolArray, FloatArray
from magloc.readings import Readings
from tests.magloc.compensation.flights import WORLD_T, Flight, Platform, array_of, nees

ARRAY = array_of()
FALSE_ALARM = 1e-6
NOISE_T = 0.02e-9


@dataclass(frozen=True)
class Flown:
    """A flight, its platforms, and its readings."""

    flight: Flight
    platforms: dict[str, Platform]
    readings: Readings

    @property
    def truth_T(self) -> FloatArray:
        """Modulus of the ambient field (n,)."""
        return np.asarray(np.linalg.norm(self.flight.ambient(), axis=1))


def fly(seed: int, current_T: float = 2e-8, lag_s: float = 0.0, straight: bool = False) -> Flown:
    rng = np.random.default_rng([560, seed])
    platforms = {sensor.id: Platform.draw(rng, sensor, current_T) for sensor in ARRAY.sensors}
    flight = Flight.cloverleaf(rng, straight=straight)
    return Flown(flight, platforms, flight.readings(ARRAY, platforms, rng, lag_s=lag_s))


@cache
def calm() -> Flown:
    """A flight without a fault and without currents."""
    return fly(100, current_T=0.0)


@cache
def calibrated() -> magloc.Compensation:
    return magloc.compensate(ARRAY, calm().readings)


def errors_T(found: magloc.Compensation, truth_T: FloatArray) -> FloatArray:
    """Return errors of the scalar sensor's corrected readings; a constant is free, because none is determined."""
    error = found.values_T[:, 0] - truth_T
    return np.asarray(error[np.isfinite(error)] - np.nanmean(error))


def flagged(found: magloc.Compensation, word: str) -> bool:
    return any(flag.startswith(f"{word}:") for flag in found.flags)


def changed(values_T: FloatArray) -> Readings:
    return replace(calm().readings, values_T=values_T)


def coefficients_are_honest(seeds: range) -> None:
    """Figure of merit, NEES and flags of flights with coefficients and currents from the priors."""
    found: dict[str, list[float]] = {"mag": [], "flux": []}
    for seed in seeds:
        flown = fly(seed)
        current = flown.flight.current_A
        got = magloc.compensate(ARRAY, flown.readings, currents={"motor_A": current}, current_sigma_T=2e-8)
        assert got.figure_of_merit_before_T > 10.0 * got.figure_of_merit_after_T
        stated_T = np.sqrt(np.nanmean(got.sigma_T[:, 0] ** 2) + NOISE_T**2)
        assert errors_T(got, flown.truth_T).std() < 2.0 * stated_T
        assert not any(flagged(got, word) for word in ("unit", "axes", "lag", "change", "stuck", "gap", "attitude"))
        for of in got.sensors:
            found[of.sensor].append(nees(of, flown.platforms[of.sensor].coefficients(float(current.mean()))))
    for each in found.values():
        dof = 24 * len(seeds)
        low, high = chi2.ppf([FALSE_ALARM / 2.0, 1.0 - FALSE_ALARM / 2.0], dof) / dof
        # The project's bounds, widened for few flights to those of chance.
        assert min(low, 0.7) < np.mean(each) < max(high, 1.3)


def test_coefficients_of_a_flight() -> None:
    coefficients_are_honest(range(1))


@pytest.mark.slow
def test_coefficients_of_many_flights() -> None:
    coefficients_are_honest(range(1, 53))


class TestResult:
    def test_gains_and_turns_are_named_as_not_determined(self) -> None:
        """A modulus does not show the trace and the antisymmetric part of the induced field."""
        for of in calibrated().sensors:
            for index in (of.fit.terms.gain, *of.fit.terms.turns):
                assert f"{of.sensor} {of.fit.terms.names[index]}" in calibrated().undetermined
                assert of.fit.sigma[index] == pytest.approx(of.fit.terms.sigma[index], rel=0.1)

    def test_report(self) -> None:
        report = calibrated().report()
        assert set(report["coefficients"][0]) == {"name", "value", "sigma", "determined", "unit"}
        assert len(report["coefficients"]) == 42
        assert report["figure_of_merit_before_nT"] > 10.0 * report["figure_of_merit_after_nT"]
        truth = calm().platforms["mag"].permanent[0] * 1e9
        entry = report["coefficients"][0]
        assert entry["name"] == "mag permanent x"
        assert entry["value"] == pytest.approx(truth, abs=5.0 * entry["sigma"])

    def test_table(self) -> None:
        table = calibrated().table()
        assert "mag induced trace" in table
        assert "over 12 of 12 manoeuvres" in table

    def test_the_vector_sensor_is_corrected_too(self) -> None:
        """Its modulus follows that of the Earth; its noise is 0.5 nT."""
        modulus = np.linalg.norm(calibrated().values_T[:, 1:], axis=1)
        assert np.std(modulus - calm().truth_T) < 1e-9
        assert np.std(np.linalg.norm(calm().readings.values_T[:, 1:], axis=1) - calm().truth_T) > 20e-9

    def test_sigma_covers_the_error_of_the_correction(self) -> None:
        """Coefficients of a short piece are poor; the error of the correction elsewhere is within 5 σ of its own."""
        piece = calm().readings[:700]
        found = magloc.compensate(ARRAY, calm().readings, calibration=piece)
        error = errors_T(found, calm().truth_T)
        sigma = np.hypot(found.sigma_T[:, 0], NOISE_T)
        assert (np.abs(error) < 5.0 * sigma + 5.0 * NOISE_T).mean() > 0.99
        assert np.max(sigma) > 10.0 * NOISE_T

    def test_figure(self) -> None:
        assert len(calibrated().plot().axes) == 2


class TestCalibration:
    def test_another_flight_calibrates(self) -> None:
        rng = np.random.default_rng([561, 1])
        other = Flight.cloverleaf(rng)
        rows = other.readings(ARRAY, calm().platforms, rng)
        found = magloc.compensate(ARRAY, rows, calibration=calm().readings)
        truth = np.linalg.norm(other.ambient(), axis=1)
        assert errors_T(found, truth).std() < 2.0 * NOISE_T
        assert not flagged(found, "mismatch")

    def test_currents_count_from_the_mean_of_the_calibration(self) -> None:
        flown = fly(101)
        given = {"motor_A": flown.flight.current_A}
        whole = magloc.compensate(ARRAY, flown.readings, currents=given, current_sigma_T=2e-8)
        part = flown.readings[:1500]
        found = magloc.compensate(
            ARRAY,
            part,
            calibration=flown.readings,
            currents={"motor_A": flown.flight.current_A[:1500]},
            calibration_currents=given,
            current_sigma_T=2e-8,
        )
        inside = slice(20, 1480)
        np.testing.assert_allclose(found.values_T[inside, 0], whole.values_T[inside, 0], atol=0.1e-9)

    @pytest.mark.slow
    def test_axes_that_are_mirrored_after_the_calibration_are_flagged(self) -> None:
        rows = calm().readings
        mirrored = Readings(rows.values_T * [1.0, 1.0, -1.0, 1.0], time_s=rows.time_s)
        assert flagged(magloc.compensate(ARRAY, mirrored, calibration=rows), "mismatch")

    def test_a_log_that_does_not_follow_its_correction_is_flagged(self) -> None:
        """Half the field of the platform: a slope of a half."""
        rows, truth = calm().readings, calm().truth_T[:, None]
        values = rows.values_T.copy()
        values[:, :1] = truth + 0.5 * (values[:, :1] - truth)
        found = magloc.compensate(ARRAY, changed(values), calibration=rows)
        assert any(flag.startswith("mismatch: fast changes of mag in the log are 0.5 ") for flag in found.flags)

    def test_attitude_of_the_pose(self) -> None:
        """A scalar sensor alone, with the pose and the ambient field of a model: as good as with the vector sensor."""
        flown = calm()
        ambient = flown.flight.rotation.inv().apply(np.tile(WORLD_T, (len(flown.readings), 1)))
        rows = replace(flown.readings, values_T=flown.readings.values_T[:, :1], ambient_T=ambient)
        found = magloc.compensate(replace(ARRAY, sensors=ARRAY.sensors[:1]), rows)
        assert errors_T(found, flown.truth_T).std() < 2.0 * NOISE_T

    def test_vector_sensor_alone(self) -> None:
        rows = replace(calm().readings, values_T=calm().readings.values_T[:, 1:])
        found = magloc.compensate(replace(ARRAY, sensors=ARRAY.sensors[1:]), rows)
        assert found.figure_of_merit_before_T > 10.0 * found.figure_of_merit_after_T


class TestUndetermined:
    def test_a_straight_flight_determines_nothing(self) -> None:
        """Every σ is that of its prior, and the correction says that it is worth nothing on four headings."""
        straight = fly(102, current_T=0.0, straight=True)
        found = magloc.compensate(ARRAY, straight.readings)
        assert len(found.undetermined) == 42
        for of in found.sensors:
            np.testing.assert_allclose(of.fit.sigma, of.fit.terms.sigma, rtol=0.05)
        assert flagged(found, "manoeuvres")
        assert flagged(magloc.compensate(ARRAY, calm().readings, calibration=straight.readings), "attitude")

    def test_a_constant_current_is_not_determined_and_harms_nothing(self) -> None:
        found = magloc.compensate(ARRAY, calm().readings, currents={"lamp_A": np.full(3000, 2.0)})
        of = found.sensors[0]
        np.testing.assert_allclose(of.fit.sigma[-3:], of.fit.terms.sigma[-3:])
        assert {f"mag lamp_A {axis}" for axis in "xyz"} <= set(found.undetermined)
        np.testing.assert_allclose(found.values_T, calibrated().values_T, atol=0.02e-9)


class TestFaults:
    """Readings with a fault: the result is the same as without, or has a flag."""

    def test_vector_sensor_in_another_unit(self) -> None:
        values = calm().readings.values_T.copy()
        values[:, 1:] *= 1e-3
        found = magloc.compensate(ARRAY, changed(values))
        assert flagged(found, "unit")
        np.testing.assert_allclose(found.values_T[:, 0], calibrated().values_T[:, 0], atol=0.1e-9)

    @pytest.mark.parametrize("posed", [True, False])
    def test_axes_swapped(self, posed: bool) -> None:
        """The model is the same in any axes, also in left-handed ones; only the pose contradicts."""
        rows = changed(calm().readings.values_T[:, [0, 2, 1, 3]])
        if not posed:
            rows = replace(rows, array_position_m=None, array_rotation=None)
        found = magloc.compensate(ARRAY, rows)
        assert flagged(found, "axes") == posed
        assert errors_T(found, calm().truth_T).std() < (2.0 if posed else 5.0) * NOISE_T

    def test_gap(self) -> None:
        time_s = calm().readings.time_s
        kept: BoolArray = (time_s < 100.0) | (time_s > 130.0)
        found = magloc.compensate(ARRAY, calm().readings[kept])
        assert errors_T(found, calm().truth_T[kept]).std() < 2.0 * NOISE_T

    def test_dropouts(self) -> None:
        rng = np.random.default_rng(562)
        values = calm().readings.values_T.copy()
        values[rng.random(values.shape) < 0.02] = np.nan
        values[500:560, 1:] = np.nan
        found = magloc.compensate(ARRAY, changed(values))
        assert flagged(found, "gap")
        assert np.isnan(found.values_T[510:550, 0]).all()
        assert errors_T(found, calm().truth_T).std() < 3.0 * NOISE_T

    def test_wild_and_stuck_readings(self) -> None:
        values = calm().readings.values_T.copy()
        values[[300, 1200, 2000], 0] += 300e-9
        values[1500:1600, 1:] = values[1500, 1:]
        found = magloc.compensate(ARRAY, changed(values))
        assert flagged(found, "wild")
        assert flagged(found, "stuck")
        assert errors_T(found, calm().truth_T).std() < 3.0 * NOISE_T

    def test_magnet_switched_on_halfway(self) -> None:
        """A field of 80 nT from 160 s on: the flag has the time to 8 s, and the size to 30 %."""
        b, more = calm().flight.ambient(), np.array([60e-9, -30e-9, 40e-9])
        values = calm().readings.values_T.copy()
        on = calm().readings.time_s > 160.0
        values[on, 0] += (np.linalg.norm(b + more, axis=1) - np.linalg.norm(b, axis=1))[on]
        found = magloc.compensate(ARRAY, changed(values))
        flag = next(flag for flag in found.flags if flag.startswith("change: the permanent field at mag"))
        size_nT, time_s = float(flag.split("about ")[1].split()[0]), float(flag.split("near ")[1].split()[0])
        assert time_s == pytest.approx(160.0, abs=8.0)
        assert size_nT == pytest.approx(78.0, rel=0.3)

    def test_jumps_of_a_current_beside_a_strong_platform(self) -> None:
        """Errors beside the jumps of a current are as small as elsewhere; 5 σ of 80 rows are 40 %."""
        flown = fly(207)
        current, truth_T = flown.flight.current_A, flown.truth_T
        found = magloc.compensate(ARRAY, flown.readings, currents={"motor_A": current}, current_sigma_T=2e-8)
        error = found.values_T[:, 0] - truth_T
        jumps = np.abs(np.diff(current, prepend=current[0])) > 1.0
        beside = np.convolve(jumps, np.ones(6), mode="same") > 0.0
        assert 70 < beside.sum() < 110
        rest = np.nanmean(error[~beside])
        ratio = np.nanmean((error[beside] - rest) ** 2) / np.nanmean((error[~beside] - rest) ** 2)
        assert np.sqrt(ratio) < 1.4

    def test_correlated_residuals_are_no_change(self) -> None:
        """Errors of the vector sensor's attitude, which the platform's field at the scalar sensor amplifies."""
        flown = fly(14)
        found = magloc.compensate(ARRAY, flown.readings, currents={"motor_A": flown.flight.current_A})
        assert not flagged(found, "change")

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("lag_s", [0.3, -0.15])
    def test_lag(self, lag_s: float) -> None:
        flown = fly(103, current_T=0.0, lag_s=lag_s)
        found = magloc.compensate(ARRAY, flown.readings)
        assert flagged(found, "lag")
        assert found.sensors[0].fit.lag_s == pytest.approx(lag_s, abs=5e-3)
        assert errors_T(found, flown.truth_T).std() < 2.0 * NOISE_T


class TestRefusals:
    def test_no_attitude(self) -> None:
        rows = Readings(np.full((200, 1), 5e-5), time_s=0.1 * np.arange(200))
        with pytest.raises(ValueError, match="must state the attitude of the platform"):
            magloc.compensate(replace(ARRAY, sensors=ARRAY.sensors[:1]), rows)

    def test_few_rows_and_rows_without_order(self) -> None:
        with pytest.raises(ValueError, match="60 rows or more; instead received 40"):
            magloc.compensate(ARRAY, calm().readings[:40])
        with pytest.raises(ValueError, match="in order of time"):
            magloc.compensate(ARRAY, calm().readings[np.arange(200)[::-1]])

    @pytest.mark.parametrize("value", [48e-6, np.nan])
    def test_a_sensor_without_readings(self, value: float) -> None:
        values = calm().readings.values_T.copy()
        values[:, 0] = value
        with pytest.raises(ValueError, match="60 samples of sensor mag"):
            magloc.compensate(ARRAY, changed(values))

    def test_currents_of_another_flight(self) -> None:
        with pytest.raises(ValueError, match="none of i"):
            magloc.compensate(ARRAY, calm().readings, currents={"i": np.full(3000, np.nan)})
        with pytest.raises(ValueError, match="shape"):
            magloc.compensate(ARRAY, calm().readings, currents={"i": np.zeros(7)})
        with pytest.raises(ValueError, match="same names"):
            magloc.compensate(ARRAY, calm().readings, calibration=calm().readings, currents={"i": np.zeros(3000)})
