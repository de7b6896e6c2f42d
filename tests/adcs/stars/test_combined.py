"""Fixes of several star cameras, averaged, and in the filter."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import adcs
from adcs.kalman.mekf import run_filter
from adcs.stars.camera import StarCamera
from adcs.stars.combined import combined_star_fixes
from adcs.stars.identification import NoFix, StarFix
from adcs.stars.pose import CameraPose
from sims.experiments.accuracy import normalised_error_squared
from tests.adcs.filter_runs import runs_for, settings, unlike_stars

CAMERA = StarCamera(1024, 1024, 1e-4)
SIGMA_RAD = np.array([2e-5, 2e-5, 4e-4])


def fix_of(R: Rotation) -> StarFix:
    """Fix of an attitude, catalogue from frame."""
    covariance = np.diag([*SIGMA_RAD**2, 0.0, 0.0])
    return StarFix(np.zeros((0, 2), dtype=np.intp), 0.0, -20.0, CameraPose(R.as_matrix(), CAMERA, covariance))


class TestCombined:
    def test_is_the_attitude_that_fits_all_best(self) -> None:
        """1,000 bodies of three cameras: errors whitened by the covariance have squares of mean 1 (σ of it 0.026)."""
        rng, total = np.random.default_rng(0), 0.0
        mounted = [Rotation.random(random_state=i) for i in range(3)]
        for body in Rotation.random(1000, random_state=5):
            seen = [fix_of(body * R * Rotation.from_rotvec(SIGMA_RAD * rng.standard_normal(3))) for R in mounted]
            found = combined_star_fixes([1.0] * 3, seen, mounted)
            error = (body.inv() * found.rotation[0]).as_rotvec()
            total += error @ np.linalg.solve(found.covariance_rad2[0], error) / 3.0
        assert total / 1000.0 == pytest.approx(1.0, abs=4.0 * 0.026)
        assert np.sqrt(np.linalg.eigvalsh(found.covariance_rad2[0])[-1]) < 2.0 * SIGMA_RAD[0]

    def test_instants_ascend_and_what_is_no_fix_is_left_out(self) -> None:
        body = Rotation.random(3, random_state=1)
        fixes = [fix_of(body[0]), NoFix("clouds"), fix_of(body[1]), fix_of(body[2])]
        found = combined_star_fixes([3.0, 0.0, 2.0, 1.0], fixes, Rotation.identity())
        np.testing.assert_array_equal(found.time_s, [1.0, 2.0, 3.0])
        assert (found.rotation * body[[2, 1, 0]].inv()).magnitude().max() < 1e-12
        with pytest.raises(ValueError, match="must have a fix"):
            combined_star_fixes([0.0], [NoFix("clouds")], Rotation.identity())
        with pytest.raises(ValueError, match="one for each of the 1 fixes; instead received 2 and 1"):
            combined_star_fixes([0.0, 1.0], fixes[:1], Rotation.identity())


class TestFilter:
    def test_covariance_of_each_reading_keeps_the_filters_own_true(self) -> None:
        """Ten seeds; NEES of attitude and rate; a filter that takes all turns for alike is wrong and claims more."""
        chosen = settings("st")
        runs, start = runs_for(chosen.sensors, 200.0)
        unlike = unlike_stars(runs)
        alike = replace(unlike, readings=replace(unlike.readings, star_whitening=runs.readings.star_whitening))
        nees = [
            normalised_error_squared(given, run_filter(given, chosen, start))[:, 60:].mean() / 6.0
            for given in (unlike, alike)
        ]
        assert 0.7 < nees[0] < 1.4
        assert nees[1] > 5.0

    def test_telemetry_takes_the_covariance(self) -> None:
        """Two cameras that look across each other: all three turns as good as the better ones."""
        log = adcs.datasets.load("satellite")
        telemetry, rng = log.telemetry, np.random.default_rng(3)
        mounted = [Rotation.identity(), Rotation.from_euler("y", 90.0, degrees=True)]
        time_s, fixes, cameras = [], [], []
        for i in range(len(telemetry.time_s)):
            for R in mounted:
                noise = Rotation.from_rotvec(SIGMA_RAD * rng.standard_normal(3))
                time_s.append(telemetry.time_s[i])
                fixes.append(fix_of(log.truth[i] * R * noise))
                cameras.append(R)
        both = combined_star_fixes(time_s, fixes, cameras)
        one = combined_star_fixes(time_s[::2], fixes[::2], mounted[0])
        worst = []
        for found in (both, one):
            seen = adcs.Telemetry(
                found.time_s,
                star=found.rotation,
                star_covariance_rad2=found.covariance_rad2,
                gyro_rad_s=telemetry.gyro_rad_s,
                wheels_Nms=telemetry.wheels_Nms,
            )
            attitude = adcs.estimate(seen, log.satellite, sensors="st+gyro", states=["gyro-bias"])
            error = (attitude.rotation[attitude.rows] * log.truth.inv()).magnitude()
            worst.append(math.sqrt(np.mean(error[len(error) // 2 :] ** 2)))
        assert worst[0] < 2.0 * SIGMA_RAD[0]
        assert worst[1] > 2.0 * worst[0]

    def test_refusals(self) -> None:
        with pytest.raises(ValueError, match=r"star_covariance_rad2 must have shape \(2, 3, 3\)"):
            adcs.Telemetry([0.0, 1.0], star_covariance_rad2=np.eye(3))
        with pytest.raises(ValueError, match="must be positive definite"):
            adcs.Telemetry([0.0, 1.0], star_covariance_rad2=np.tile(-np.eye(3), (2, 1, 1)))

    def test_whitening_is_that_of_half_a_turn(self) -> None:
        log = adcs.datasets.load("satellite")
        covariance = np.diag([1e-8, 4e-8, 9e-8])
        telemetry = adcs.Telemetry([0.0], star=log.truth[:1], star_covariance_rad2=covariance[None])
        W = telemetry.record(log.satellite).readings.star_whitening[0, 0]
        scaled = W @ (0.25 * covariance) @ W.T
        np.testing.assert_allclose(scaled, np.eye(3) * log.satellite.star_tracker.sigma_rad**2, rtol=1e-12, atol=0.0)
