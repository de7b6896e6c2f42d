"""Simulated runs of the table-top satellite: the drives, and the errors that were asked for.

Statistical tests have fixed seeds, not chosen, and state the probability with which a right program fails them.
"""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from adcs.mockup.navigation.strapdown import rotate, strapdown, wrapped
from sims.mockup.table_run import THRUST_M_S2, CameraErrors, ImuErrors, TableScenario, perimeter_drive, table_run
from sims.noise import stream

FALSE_ALARM = 1e-4

NO_IMU_ERRORS = ImuErrors(0.0, 0.0, 0.0, 0.0, 0.0, drift_m_s2=(0.0, 0.0), warming_K=1.0, zero_rad_s=0.0)
NO_CAMERA_ERRORS = CameraErrors(position_m=0.0, heading_rad=0.0, failed=0.0)


def ideal(drive="perimeter", duration_s=60.0, imu=NO_IMU_ERRORS, camera=NO_CAMERA_ERRORS):
    return TableScenario(drive, duration_s, imu=imu, camera=camera)


@functools.cache
def default_run(seed):
    return table_run(TableScenario(), seed)


class TestPerimeterDrive:
    @pytest.fixture(params=range(3))
    def run(self, request):
        return default_run(request.param)

    def test_it_stays_on_the_table_within_its_speeds(self, run) -> None:
        speed = np.linalg.norm(run.truth.velocity_m_s, axis=1)
        assert np.all(np.abs(run.truth.position_m) < [1.25, 1.0])
        assert 0.10 < speed.max() < 0.12
        assert np.median(speed) == pytest.approx(0.085, abs=0.015)
        rate = np.degrees(np.diff(run.truth.heading_rad) / 0.01)
        assert 35.0 < np.abs(rate).max() <= 40.0

    def test_it_goes_round_the_table(self, run) -> None:
        angle = np.unwrap(np.arctan2(run.truth.position_m[:, 1], run.truth.position_m[:, 0]))
        assert abs(angle[-1] - angle[0]) > 2.0 * 2.0 * math.pi

    def test_valves_are_open_or_closed(self) -> None:
        polled, _ = perimeter_drive(60_000, np.random.default_rng(1))
        assert set(np.unique(polled.acceleration_m_s2)) == {-THRUST_M_S2, 0.0, THRUST_M_S2}
        fired = (polled.acceleration_m_s2 != 0.0).any(axis=1)
        assert 0.1 < fired.mean() < 0.6
        # For a tenth of a second at least.
        assert np.all(np.diff(np.flatnonzero(np.diff(polled.acceleration_m_s2[:, 0]))) % 100 == 0)

    def test_seeds_differ(self) -> None:
        starts = {tuple(run.truth.position_m[0]) for run in map(default_run, range(3))}
        assert len(starts) == 3


class TestTwoFirings:
    RUN = table_run(ideal("two-firings", 15.0), 0)

    def test_it_is_that_of_the_source_s_figures(self) -> None:
        truth = self.RUN.truth
        rate = np.degrees(np.diff(truth.heading_rad) / 0.01)
        assert -20.0 < rate.min() < 0.0
        assert 100.0 < rate.max() < 120.0
        assert 380.0 < np.degrees(truth.heading_rad[-1] - truth.heading_rad[0]) < 420.0
        assert 0.15 < np.linalg.norm(truth.velocity_m_s, axis=1).max() < 0.3
        assert np.all((truth.position_m > -0.4) & (truth.position_m < 0.6))

    def test_the_first_2_s_are_without_thrust(self) -> None:
        assert not self.RUN.imu.acceleration_m_s2[:200].any()

    def test_nothing_of_it_is_random(self) -> None:
        np.testing.assert_array_equal(
            table_run(ideal("two-firings", 15.0), 5).truth.position_m, self.RUN.truth.position_m
        )


class TestSamples:
    @pytest.mark.parametrize("drive", ["perimeter", "two-firings"])
    def test_without_errors_their_integral_is_the_truth(self, drive) -> None:
        # The truth has polls of 1 ms, and a sample one heading for all of its polls: of second order in its length.
        apart = []
        for sample_s in (0.01, 0.02):
            run = table_run(replace(ideal(drive, 20.0), sample_s=sample_s), 1)
            track = strapdown(run.imu, run.true_start)
            np.testing.assert_allclose(track.heading_rad, run.truth.heading_rad, atol=1e-10)
            apart.append(np.abs(track.position_m[-1] - run.truth.position_m[-1]).max())
        assert apart[0] < 1e-4
        assert apart[1] / apart[0] == pytest.approx(4.0, rel=0.1)

    def test_noise_and_zeros_are_the_stated_ones(self) -> None:
        errors = ImuErrors(calibration_m_s2=0.0, spikes_Hz=0.0, zero_m_s2=(0.005, -0.004), drift_m_s2=(0.002, -0.0015))
        bad, good = (table_run(ideal(duration_s=60.0, imu=imu), 2) for imu in (errors, NO_IMU_ERRORS))
        t = bad.imu.time_s / 60.0
        np.testing.assert_allclose(bad.zero_m_s2, np.array([0.005, -0.004]) + np.outer(t, [0.002, -0.0015]), atol=1e-12)
        np.testing.assert_allclose(bad.temperature_C, 20.0 + 20.0 / 3.0 * t)
        noise = bad.imu.acceleration_m_s2 - good.imu.acceleration_m_s2 - bad.zero_m_s2
        rate_noise = bad.imu.rate_rad_s - good.imu.rate_rad_s - bad.zero_rad_s
        for values, sigma in ((noise, 0.002), (rate_noise, math.radians(0.1))):
            low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], values.size)
            assert low < np.sum((values / sigma) ** 2) < high
            assert abs(values.mean()) < stats.norm.isf(FALSE_ALARM / 2) * sigma / math.sqrt(values.size)

    def test_spikes_come_about_once_in_a_second(self) -> None:
        spiky = replace(NO_IMU_ERRORS, spikes_Hz=1.0, spike_m_s2=0.07)
        bad, good = (table_run(ideal(duration_s=180.0, imu=imu), 3) for imu in (spiky, NO_IMU_ERRORS))
        spikes = bad.imu.acceleration_m_s2 - good.imu.acceleration_m_s2
        count = int(np.count_nonzero(spikes))
        low, high = stats.binom.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 36_000, 0.01)
        assert low <= count <= high
        assert 0.06 < np.abs(spikes).max() <= 0.07

    def test_calibration_leaves_what_is_stated(self) -> None:
        left = np.array([table_run(TableScenario(duration_s=0.1), seed).zero_m_s2[0] for seed in range(200)])
        left = left - np.array([0.002, -0.0015]) * 0.1  # the first of ten samples has a tenth of the drift
        low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 400)
        assert low < np.sum((left / 0.001) ** 2) < high


class TestFixes:
    def errors(self, run):
        k = np.searchsorted(run.truth.time_s, run.exposure_s)
        k = np.minimum(k, len(run.truth) - 1)
        before = np.maximum(k - 1, 0)
        weight = (run.exposure_s - run.truth.time_s[before]) / 0.01
        position = run.truth.position_m[before] + weight[:, None] * (
            run.truth.position_m[k] - run.truth.position_m[before]
        )
        heading = run.truth.heading_rad[before] + weight * (run.truth.heading_rad[k] - run.truth.heading_rad[before])
        return run.fixes.position_m - position, wrapped(run.fixes.heading_rad - heading)

    def test_noise_is_the_stated_one(self) -> None:
        position, heading = self.errors(table_run(TableScenario(), 4))
        for values, sigma in ((position[1:], 1e-3), (heading[1:], math.radians(0.05))):
            low, high = stats.chi2.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], values.size)
            assert low < np.sum((values / sigma) ** 2) < high

    def test_they_are_a_period_late_and_some_fail(self) -> None:
        run = table_run(TableScenario(), 5)
        np.testing.assert_allclose(run.fixes.arrival_s - run.exposure_s, 0.6)
        steps = np.diff(run.exposure_s) / 0.6
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)
        low, high = stats.binom.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], 300, 0.88)
        assert low - 1 <= len(run.fixes) <= high

    def test_false_ones_are_anywhere(self) -> None:
        run = table_run(TableScenario(camera=CameraErrors(false=0.2)), 6)
        position, _ = self.errors(run)
        low, high = stats.binom.ppf([FALSE_ALARM / 2, 1 - FALSE_ALARM / 2], len(run.fixes), 0.2)
        assert low <= run.false.sum() <= high
        assert np.median(np.linalg.norm(position[run.false], axis=1)) > 0.3
        assert np.abs(position[~run.false][1:]).max() < 0.006
        assert np.all(np.abs(run.fixes.position_m) <= [1.5, 1.2])

    def test_some_overtake_others_and_come_twice(self) -> None:
        run = table_run(TableScenario(camera=CameraErrors(overtaken=0.3, repeated=0.2)), 7)
        assert np.all(np.diff(run.fixes.arrival_s) >= 0.0)
        assert np.any(np.diff(run.exposure_s) < -0.5)
        assert len(np.unique(run.exposure_s)) < len(run.exposure_s)

    def test_outages(self) -> None:
        run = table_run(TableScenario(camera=CameraErrors(outages_s=((20.0, 50.0), (100.0, 101.0)))), 8)
        assert not np.any((run.exposure_s >= 20.0) & (run.exposure_s < 50.0))
        assert np.any((run.exposure_s >= 50.0) & (run.exposure_s < 55.0))

    def test_a_latency_is_in_the_time_stamps_only(self) -> None:
        late = table_run(TableScenario(camera=CameraErrors(latency_s=0.4)), 9)
        on_time = table_run(TableScenario(), 9)
        np.testing.assert_array_equal(late.fixes.position_m, on_time.fixes.position_m)
        np.testing.assert_allclose(late.fixes.time_s, on_time.fixes.time_s + 0.4)


class TestStreams:
    def test_a_run_is_the_same_again(self) -> None:
        one, two = (table_run(TableScenario(duration_s=5.0), 10) for _ in range(2))
        np.testing.assert_array_equal(one.imu.acceleration_m_s2, two.imu.acceleration_m_s2)
        np.testing.assert_array_equal(one.fixes.position_m, two.fixes.position_m)

    def test_leaving_out_a_feature_changes_no_other(self) -> None:
        one = table_run(TableScenario(duration_s=20.0), 11)
        two = table_run(
            TableScenario(duration_s=20.0, imu=ImuErrors(spikes_Hz=0.0), camera=CameraErrors(false=0.1)), 11
        )
        np.testing.assert_array_equal(one.truth.position_m, two.truth.position_m)
        np.testing.assert_array_equal(one.imu.rate_rad_s, two.imu.rate_rad_s)
        np.testing.assert_array_equal(one.fixes.position_m[~two.false], two.fixes.position_m[~two.false])

    def test_the_start_is_known_as_well_as_from_a_fix(self) -> None:
        run = table_run(TableScenario(duration_s=1.0), 12)
        known = stream(12, "start").standard_normal(3)
        np.testing.assert_allclose(run.start.position_m - run.true_start.position_m, 1e-3 * known[:2])
        np.testing.assert_array_equal(run.start.velocity_m_s, run.true_start.velocity_m_s)


class TestRefusals:
    @pytest.mark.parametrize(
        ("changes", "text"),
        [
            ({"drive": "moon"}, "drive must be one of"),
            ({"duration_s": 0.0}, "duration_s must be finite and not shorter than sample_s"),
            ({"duration_s": math.inf}, "duration_s must be finite"),
            ({"sample_s": 0.0105}, "sample_s must be a multiple of 0.001"),
        ],
    )
    def test_scenarios(self, changes, text: str) -> None:
        with pytest.raises(ValueError, match=text):
            TableScenario(**changes)

    def test_turning_is_the_shared_convention(self) -> None:
        # Thrust along body x of a satellite that is headed along +Y moves it along +Y.
        np.testing.assert_allclose(rotate(math.pi / 2, [1.0, 0.0]), [0.0, 1.0], atol=1e-16)
