"""Tests of the gate of the error-state filter: what contradicts the filter is rejected, and what was wrong is found.

The oracle of a rejected reading is the same record without it. Seeds were not chosen.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

import adcs
from adcs import quaternion
from adcs.kalman import mekf
from adcs.kalman.error_state import FilterSettings
from adcs.kalman.initialisation import any_start
from adcs.kalman.mekf import run_filter
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import is_read, part
from magloc import core
from sims.attitude.scenario import StartConditions
from sims.attitude.simulation import AttitudeRuns, simulate
from sims.experiments.accuracy import error_norm_deg
from tests.adcs.attitudes import random_attitudes
from tests.adcs.filter_runs import GYRO_BIAS_RAD_S, SEEDS, settings, start_of, tabletsat
from tests.adcs.kalman import readable as gate
from tests.adcs.kalman.readable import run_readable

Array = NDArray[np.float64]
NAMES = ("star", "gyro_rad_s", "field_T", "sun")
CONDITIONS = StartConditions(True, math.radians(30.0), math.radians(90.0), 0.0)
FIRST, LAST = 200, 300
"""Instants of the lies."""


def simulated(duration_s: float = 600.0, seeds: range = SEEDS, share: float = 0.0) -> AttitudeRuns:
    scenario = replace(tabletsat(duration_s), gyro_bias_rad_s=GYRO_BIAS_RAD_S, conditions=CONDITIONS)
    return simulate(replace(scenario, wild_share=share), seeds)


def chosen_for(sensors: str) -> FilterSettings:
    return settings(sensors, ["gyro-bias", "disturbance"] if "gyro" in sensors else ["disturbance"])


def with_readings(runs: AttitudeRuns, **values: Array) -> AttitudeRuns:
    return replace(runs, readings=replace(runs.readings, **values))


def lied(
    runs: AttitudeRuns, degrees: float, first: int = FIRST, last: int = LAST, drift_deg_s: float = 0.0
) -> AttitudeRuns:
    """A star tracker that is off by an angle about an axis of its own, in every run."""
    axes = np.random.default_rng(1).standard_normal((len(runs.q), 1, 3))
    angles = degrees + drift_deg_s * np.arange(last - first)
    turn = quaternion.exp(np.radians(angles)[:, None] * axes / np.linalg.norm(axes, axis=-1, keepdims=True))
    star = runs.readings.star.copy()
    star[:, first:last] = quaternion.multiply(turn, star[:, first:last])
    return with_readings(runs, star=star)


def rms_deg(runs: AttitudeRuns, chosen: FilterSettings) -> float:
    return float(np.sqrt(np.mean(error_norm_deg(runs, run_filter(runs, chosen, start_of(runs)))[:, 100:] ** 2)))


def eventful() -> AttitudeRuns:
    """Wild readings, a run of lies, a gap, a jump of the gyro's bias, a wild first fix; the start may be wide."""
    runs = lied(simulated(120.0, range(4), share=0.1), 2.0, 30, 60)
    readings = runs.readings
    readings.star[:, 80:100] = np.nan
    readings.star[1, 0], readings.star[2, 101:] = [0.5, 0.5, -0.5, 0.5], [0.5, 0.5, 0.5, 0.5]
    readings.gyro_rad_s[:, 70:] += 0.01
    readings.field_T[3, 40:60] *= -1.0
    readings.sun[3, 70:90] = readings.sun[3, 70:90, ::-1]
    return runs


class TestTwins:
    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("sensors", "states"),
        [
            ("mag+sun", ["disturbance"]),
            ("st+gyro+mag+sun", ["field-bias", "gyro-bias", "disturbance"]),
            pytest.param("st", [], marks=pytest.mark.slow),
            pytest.param("st+gyro", ["gyro-bias", "disturbance"], marks=pytest.mark.slow),
            pytest.param("mag+gyro", [], marks=pytest.mark.slow),
        ],
    )
    def test_agree_whatever_happens(self, sensors: str, states: list[str]) -> None:
        runs, chosen = eventful(), settings(sensors, states)
        start = start_of(runs, math.radians(40.0))
        fast, slow = run_filter(runs, chosen, start), run_readable(runs, chosen, start)
        np.testing.assert_array_equal(fast.rejected, slow.rejected)
        assert fast.rejected.any(axis=(1, 2)).all()
        np.testing.assert_allclose(fast.q, slow.q, rtol=0, atol=1e-9)
        np.testing.assert_allclose(fast.nis, slow.nis, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(fast.sigma, slow.sigma, rtol=1e-6)

    def test_neither_calls_nor_threads_change_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A second hypothesis lives on from one call of the kernel to the next."""
        runs, chosen = eventful(), settings("st+gyro+mag+sun", ["gyro-bias", "disturbance"])
        start, threads = start_of(runs, math.radians(40.0)), core.threads()
        whole = run_filter(runs, chosen, start)
        monkeypatch.setattr(mekf, "_COVARIANCES_A_CALL", 7 * chosen.sensors.size**2)
        try:
            for n_threads in (1, 3):
                core.set_threads(n_threads)
                found = run_filter(runs, chosen, start)
                for name in ("q", "w", "covariance", "nis", "rejected", "log_det"):
                    np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
        finally:
            core.set_threads(threads)

    def test_no_instant(self) -> None:
        runs = eventful()
        none = part(runs, np.arange(4), slice(0))
        assert run_filter(none, settings("gyro+mag"), start_of(runs)).q.shape == (4, 0, 4)

    def test_turns(self) -> None:
        rng = np.random.default_rng(0)
        vectors = rng.standard_normal((40, 4, 3))
        vectors[0, 1] = -3.0 * quaternion.rotate_back(quaternion.IDENTITY, vectors[0, 0])
        turns = random_attitudes(40, rng)
        turns[0] = quaternion.IDENTITY
        for q, (one, one_there, two, two_there) in zip(turns, vectors, strict=True):
            axis = one / np.linalg.norm(one)
            onto = quaternion.turned_onto(q[None], one[None], one_there[None])
            about = gate.turned_about(onto, axis[None], two[None], two_there[None])[0]
            # Wahba's problem with the first direction infinitely weighted.
            expected, _ = Rotation.align_vectors([one_there, two_there], [one, two], weights=[np.inf, 1.0])
            assert quaternion.angle_between(about, quaternion.from_rotation(expected)) < 1e-6


class TestWildReadings:
    @pytest.mark.parametrize("share", [0.01, 0.1])
    @pytest.mark.parametrize("sensors", ["st+gyro", "mag+sun+gyro", "mag+sun", "mag+gyro"])
    def test_as_if_they_were_missing(self, sensors: str, share: float) -> None:
        chosen, runs = chosen_for(sensors), simulated(share=share)
        wild = np.stack(list(runs.prepared.wild.values()), axis=-1)
        missing = with_readings(
            runs,
            **{name: np.where(wild[..., [i]], np.nan, getattr(runs.readings, name)) for i, name in enumerate(NAMES)},
        )
        tracks = run_filter(runs, chosen, start_of(runs))
        assert rms_deg(runs, chosen) < 1.005 * rms_deg(missing, chosen)
        used = [SENSORS.index(name) for name in sensors.split("+")]
        good = np.isfinite(tracks.nis) & ~wild
        assert good.sum() > 10_000
        # 1e-6 of each is allowed to the gate: none in 18,000, but with a probability of 2 %.
        assert (tracks.rejected & good).sum() <= 1
        assert (tracks.rejected | ~wild)[..., used].mean() > 0.9999

    def test_cost(self) -> None:
        """1 % cost less than 2 % of rms, 10 % less than 8 %: of the star tracker, which nothing replaces."""
        chosen, runs = chosen_for("st+gyro"), simulated()
        clean = rms_deg(runs, chosen)
        for share, most in ((0.01, 1.02), (0.1, 1.08)):
            assert rms_deg(simulated(share=share), chosen) < most * clean

    def test_good_readings_are_used(self) -> None:
        for sensors in ("st+gyro", "mag+sun+gyro", "st+gyro+mag+sun"):
            runs = simulated(seeds=range(20))
            assert not run_filter(runs, chosen_for(sensors), start_of(runs)).rejected.any()

    def test_without_a_gate_they_throw_the_attitude(self) -> None:
        runs = simulated(share=0.01, seeds=range(3))
        chosen = replace(chosen_for("st+gyro"), gate=0.0)
        assert not run_filter(runs, chosen, start_of(runs)).rejected.any()
        assert rms_deg(runs, chosen) > 1.0


class TestLies:
    @pytest.mark.parametrize("degrees", [0.1, 0.3, 1.0, 5.0, 30.0])
    def test_a_hundred_seconds(self, degrees: float) -> None:
        """As good as coasting through a gap, and no good fix is lost after."""
        chosen, runs = chosen_for("st+gyro"), simulated()
        gap = runs.readings.star.copy()
        gap[:, FIRST:LAST] = np.nan
        coasting = with_readings(runs, star=gap)
        lies = lied(runs, degrees)
        tracks = run_filter(lies, chosen, start_of(runs))
        assert tracks.rejected[:, FIRST:LAST, 0].all()
        assert tracks.rejected.sum() == len(runs.q) * (LAST - FIRST)
        for rows in (slice(FIRST, LAST), slice(LAST, None)):
            one, other = (
                np.sqrt(np.mean(error_norm_deg(each, run_filter(each, chosen, start_of(runs)))[:, rows] ** 2))
                for each in (lies, coasting)
            )
            assert one < 1.001 * other

    def test_what_lasts_is_the_truth(self) -> None:
        """Negative: after 300 s with nothing else to tell, the fixes that agree are believed."""
        runs = lied(simulated(), 1.0, FIRST, 601)
        tracks = run_filter(runs, chosen_for("st+gyro"), start_of(runs))
        assert tracks.rejected[:, FIRST : FIRST + 295, 0].all()
        assert not tracks.rejected[:, FIRST + 305 :, 0].any()

    def test_a_second_sensor_tells(self) -> None:
        """Magnetometer and Sun sensor tell a lie of 5° for as long as it lasts."""
        runs = lied(simulated(), 5.0, FIRST, 600)
        tracks = run_filter(runs, chosen_for("st+gyro+mag+sun"), start_of(runs))
        assert tracks.rejected[:, FIRST:600, 0].all()
        assert error_norm_deg(runs, tracks)[:, FIRST:].max() < 1.0

    def test_a_lie_that_drifts_is_not_told(self) -> None:
        """Negative: one that begins at nothing and drifts by 0.0005°/s takes the filter along."""
        runs = lied(simulated(seeds=range(3)), 0.0, drift_deg_s=0.0005)
        tracks = run_filter(runs, chosen_for("st+gyro"), start_of(runs))
        assert error_norm_deg(runs, tracks)[:, LAST - 1].min() > 0.04


class TestWrongEstimates:
    @pytest.mark.parametrize("sensors", ["st", "st+gyro", "st+gyro+mag+sun"])
    def test_a_wild_first_fix(self, sensors: str) -> None:
        runs, chosen = simulated(60.0), chosen_for(sensors)
        runs.readings.star[:, 0] = random_attitudes(10, np.random.default_rng(3))
        tracks = run_filter(runs, chosen, any_start(runs, chosen))
        assert error_norm_deg(runs, tracks)[:, 4:].max() < 0.02

    @pytest.mark.parametrize("degrees_s", [0.05, 0.5, 3.0])
    def test_a_jump_of_the_bias(self, degrees_s: float) -> None:
        runs, chosen = simulated(), chosen_for("st+gyro")
        gyro = runs.readings.gyro_rad_s.copy()
        gyro[:, 300:] += np.radians(degrees_s)
        jumped = with_readings(runs, gyro_rad_s=gyro)
        tracks = run_filter(jumped, chosen, start_of(runs))
        assert tracks.rejected[..., 1].sum() <= 10 * len(runs.q)
        assert not tracks.rejected[..., 0].any()
        true = runs.prepared.gyro_bias_rad_s[:, -1] + np.radians(degrees_s)
        assert np.degrees(np.abs(tracks.optional["gyro-bias"][:, -1] - true).max()) < 2e-3
        assert error_norm_deg(jumped, tracks)[:, 300:].max() < 0.01

    def test_a_gap_after_which_the_estimate_is_wrong(self) -> None:
        """A torque that the filter does not know, through 60 s without stars: fixes that agree are believed at once."""
        runs, chosen = simulated(300.0), settings("st")
        runs.readings.star[:, 100:160] = np.nan
        error = error_norm_deg(runs, run_filter(runs, chosen, start_of(runs)))
        assert error[:, 100:160].max() > 0.05
        assert error[:, 165:].max() < 0.02

    def test_a_model_that_is_wrong(self) -> None:
        """A torque of 1e-4 N·m that no state can take: after twenty readings the gate is open, and it is as without."""
        runs, chosen = simulate(replace(tabletsat(), torque_Nm=1e-4), SEEDS), settings("st")
        tracks = run_filter(runs, chosen, start_of(runs))
        without = run_filter(runs, replace(chosen, gate=0.0), start_of(runs))
        assert (tracks.rejected.sum(axis=(1, 2)) <= 40).all()
        assert error_norm_deg(runs, tracks)[:, 60:].max() < 1.01 * error_norm_deg(runs, without)[:, 60:].max()

    def test_noise_that_is_understated(self) -> None:
        """A magnetometer four times as noisy as the filter believes: rms is at most half as large again."""
        runs, chosen = simulated(), chosen_for("mag+sun+gyro")
        noisy = runs.readings.field_T + 1e-6 * np.random.default_rng(0).standard_normal(runs.readings.field_T.shape)
        bad = with_readings(runs, field_T=noisy)
        gated, without = (rms_deg(bad, replace(chosen, gate=one)) for one in (chosen.gate, 0.0))
        assert gated < 1.5 * without

    def test_vectors_from_any_start(self) -> None:
        """From 100° an axis off, where a filter without a gate is lost more often than not."""
        runs, chosen = simulated(300.0, range(20)), chosen_for("mag+sun+gyro")
        tracks = run_filter(runs, chosen, start_of(runs, math.radians(100.0)))
        assert error_norm_deg(runs, tracks)[:, -60:].max() < 1.0


class TestSettings:
    def test_limits(self) -> None:
        assert settings("st").gate_limit == pytest.approx(chi2.isf(1e-6, 3), rel=1e-9)
        assert replace(settings("st"), gate=0.0).gate_limit == math.inf

    @pytest.mark.parametrize("bad", [-0.1, 1.0, math.nan])
    def test_no_probability(self, bad: float) -> None:
        with pytest.raises(ValueError, match="Input gate must be a probability below 1"):
            replace(settings("st"), gate=bad)

    def test_a_track_names_what_was_rejected(self) -> None:
        runs = simulated(60.0, range(1))
        runs.readings.star[0, 30] = [0.0, 0.0, 1.0, 0.0]
        satellite = runs.scenario.satellite
        log = adcs.Telemetry.of(runs, satellite.start)
        track = adcs.estimate(log, satellite, sensors="st+gyro", states=["gyro-bias"])
        assert np.flatnonzero(track.rejected["st"]).tolist() == [30]
        assert not track.rejected["gyro"].any()
        assert track.rejected["sun"][is_read(runs.readings.sun[0])].all()
        assert "1 of 61 readings of the star tracker contradict the rest and are not used" in track.warnings
        assert "1 rejected" in repr(track)
