"""Tests of the state dipole: a magnetic dipole in the satellite that nobody told the filter.

The oracles: runs of a compiled simulation whose truth has the dipole, its angular momentum, and χ².
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from adcs import quaternion
from adcs.kalman.error_state import AttitudeTracks
from adcs.kalman.mekf import run_filter
from magloc.chi_square import normalised_square
from sims.attitude.simulation import AttitudeRuns, simulate
from sims.experiments.accuracy import error_norm_deg
from tests.adcs.filter_runs import ANY_START, settings, start_of, tabletsat

DIPOLE_AM2 = (0.0, 0.05, 0.02)
STATES = ("disturbance", "dipole")


def two_orbits(dipole_Am2: tuple[float, float, float], seeds: range, torque_Nm: float = 8e-7) -> AttitudeRuns:
    scenario = replace(tabletsat(12_000.0), conditions=ANY_START)
    return simulate(replace(scenario, dipole_Am2=dipole_Am2, torque_Nm=torque_Nm), seeds)


def estimated(runs: AttitudeRuns, sensors: str, states: tuple[str, ...]) -> AttitudeTracks:
    return run_filter(runs, settings(sensors, states), start_of(runs))


def rms_deg(runs: AttitudeRuns, tracks: AttitudeTracks) -> float:
    """Of the angle in the second orbit."""
    return float(np.sqrt(np.mean(error_norm_deg(runs, tracks)[:, 6000:] ** 2)))


class TestTorque:
    def test_is_what_turns_the_satellite(self) -> None:
        """Its angular momentum, wheels included, gains the integral of m×B, against inertial axes."""
        runs = simulate(replace(tabletsat(100.0), torque_Nm=0.0, dipole_Am2=DIPOLE_AM2), range(2))
        plain = simulate(replace(tabletsat(100.0), torque_Nm=0.0), range(2))
        J = runs.satellite.body.inertia_kgm2
        gained = []
        for one in (runs, plain):
            momentum = quaternion.rotate(one.q, one.w @ J + one.momentum_Nms)
            gained.append(momentum[:, -1] - momentum[:, 0])
        b_body = quaternion.rotate_back(runs.q, runs.environment.b_orbital_T)
        torque = quaternion.rotate(runs.q, np.cross(DIPOLE_AM2, b_body))[:, :-1].sum(axis=1)
        # The orbital frame turns by 6° in 100 s, and the two motions differ a little.
        np.testing.assert_allclose(gained[0] - gained[1], torque, rtol=0, atol=0.06 * np.abs(torque).max())


class TestAccuracy:
    def test_two_orbits(self) -> None:
        """Field and Sun alone, with eclipses: 0.08° and 1e-4 A·m² (rms of an axis)."""
        runs = two_orbits(DIPOLE_AM2, range(6))
        tracks = estimated(runs, "mag+sun", STATES)
        assert rms_deg(runs, tracks) <= 0.08
        wrong = runs.prepared.dipole_Am2[:, -1] - tracks.optional["dipole"][:, -1]
        assert np.sqrt(np.mean(wrong**2)) < 1e-4
        error = quaternion.error_vector(tracks.q, runs.q)[:, 6000:]
        assert 0.7 < normalised_square(error, tracks.covariance[:, 6000:, :3, :3]).mean() / 3.0 < 1.4
        without = estimated(runs, "mag+sun", ("disturbance",))
        assert rms_deg(runs, without) > 3.0 * rms_deg(runs, tracks)

    @pytest.mark.parametrize("torque_Nm", [0.0, 1e-8])
    def test_no_other_torque(self, torque_Nm: float) -> None:
        """Without the state disturbance: dynamics that are trusted to 1e-8 N·m."""
        runs = two_orbits(DIPOLE_AM2, range(4), torque_Nm)
        tracks = estimated(runs, "mag+sun", ("dipole",))
        assert rms_deg(runs, tracks) < 0.13
        error = quaternion.error_vector(tracks.q, runs.q)[:, 6000:]
        assert 0.5 < normalised_square(error, tracks.covariance[:, 6000:, :3, :3]).mean() / 3.0 < 1.4

    def test_little_is_lost_without_a_dipole(self) -> None:
        """Against a filter that knows that there is none: three more numbers; nothing against one for any torque."""
        runs = two_orbits((0.0, 0.0, 0.0), range(4))
        with_state, usual = settings("mag+sun", STATES), settings("mag+sun", STATES[:1])
        knows = replace(usual, noise=with_state.noise)
        of_state, of_usual, of_knows = (
            rms_deg(runs, run_filter(runs, chosen, start_of(runs))) for chosen in (with_state, usual, knows)
        )
        assert of_state < of_usual
        assert of_state < 1.35 * of_knows

    def test_beside_the_residual_one_that_is_known(self) -> None:
        """What is known of the dipole is not estimated again."""
        scenario = replace(tabletsat(3000.0), conditions=ANY_START, dipole_Am2=(0.03, 0.0, 0.0))
        known = replace(scenario.satellite, residual_dipole_Am2=(0.0, 0.5, 0.0))
        runs = simulate(replace(scenario, satellite=known), range(2))
        tracks = estimated(runs, "st+gyro", STATES)
        np.testing.assert_allclose(tracks.optional["dipole"][:, -1], [[0.03, 0.0, 0.0]] * 2, rtol=0, atol=2e-3)
