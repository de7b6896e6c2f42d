"""Tests of what stands in for the Sun sensor."""

import math

import numpy as np
import pytest

from adcs import quaternion
from adcs.complementary.explicit import Gains, complementary_track
from adcs.complementary.names import RULES
from adcs.complementary.outage import Substitution, delay_steps
from sims.attitude.complementary import ORBIT, SatelliteScenario, satellite_runs
from tests.adcs.complementary.readable import Substitute, gauss_newton_track


def outage_runs(seeds, amplitude_deg=5.0, duration_orbits=4.0):
    """Bias step at 0.3 orbit, outage from 1.5 orbits."""
    scenario = SatelliteScenario(
        amplitude_rad=math.radians(amplitude_deg),
        step_orbits=0.3,
        outage_orbits=1.5,
        duration_s=duration_orbits * ORBIT.period_s,
    )
    return satellite_runs(scenario, seeds)


def largest_deg(track, runs):
    """Largest errors (R, 3) from 2 orbits on."""
    errors = np.degrees(np.abs(2.0 * quaternion.error_vector(track.q, runs.q)))
    return errors[:, runs.scenario.orbits >= 2.0].max(axis=1)


def gains(kp, **others):
    return Gains(kp, max(kp * kp / 4.0, 2e-6), **others)


@pytest.fixture(scope="module")
def eight():
    return outage_runs(range(8))


class TestSubstitute:
    def test_delay_in_steps(self):
        assert delay_steps(Substitution("raw", 500.0), 2.0) == 250
        assert delay_steps(Substitution("raw", 0.1), 2.0) == 1

    def test_delay(self):
        """The vector of M samples ago, and none before there is one."""
        line = Substitute(Substitution("raw"), 3)
        first = [(np.full(3, float(i)), np.full(3, -float(i))) for i in range(6)]
        for i, vectors in enumerate(first):
            body, reference = line.vector(vectors)
            if i < 3:
                assert np.isnan(body).all()
            else:
                assert (body[0], reference[0]) == (i - 3.0, 3.0 - i)
            line.store(vectors)
            line.turn(np.zeros(3), np.zeros(3))

    def test_transported_is_exact(self):
        """A field that stands in inertial space, a body and a frame that turn: it is what both show now."""
        rng = np.random.default_rng(0)
        field = np.array([0.6, 0.0, 0.8])
        body = frame = quaternion.IDENTITY
        line = Substitute(Substitution("transported"), 5)
        for i in range(20):
            first = quaternion.rotate_back(body, field), quaternion.rotate_back(frame, field)
            if i >= 5:
                np.testing.assert_allclose(line.vector(first), first, atol=1e-12)
            body_turn, frame_turn = 0.2 * rng.standard_normal((2, 3))
            line.store(first)
            line.turn(body_turn, frame_turn)
            body = quaternion.multiply(body, quaternion.exp(body_turn))
            frame = quaternion.multiply(frame, quaternion.exp(frame_turn))

    @pytest.mark.parametrize(
        ("arguments", "sentence"), [(("old",), "rule must be one of"), (("raw", 0.0), "delay_s must be positive")]
    )
    def test_bad_input(self, arguments, sentence):
        with pytest.raises(ValueError, match=sentence):
            Substitution(*arguments)


class TestFigures:
    """Section 10 of the specification, seeds 0 to 7."""

    def test_raw_delay_shows_its_defect(self, eight):
        """Median over the seeds: the error is what the body turns in 500 s, which depends on its phases."""
        largest = largest_deg(complementary_track(eight.record, gains(0.01), substitution=Substitution("raw")), eight)
        assert (np.median(largest, axis=0) <= [4.0, 3.0, 5.5]).all()
        assert (np.median(largest, axis=0) >= 1.0).all()

    @pytest.mark.slow
    def test_forty_seeds(self):
        runs = outage_runs(range(40))
        for rule in ("transported", "magnetometer-only"):
            found = largest_deg(complementary_track(runs.record, gains(0.005), substitution=Substitution(rule)), runs)
            assert found.max() <= 1.0
            assert np.mean(found.max(axis=1) <= 0.8) >= 0.95

    def test_raw_delay_of_larger_angles(self):
        runs = outage_runs(range(8), 10.0)
        yaw = largest_deg(complementary_track(runs.record, gains(0.01), substitution=Substitution("raw")), runs)[:, 2]
        assert 4.0 <= np.median(yaw) <= 14.0
        assert np.sort(yaw)[-2] <= 14.0
        assert yaw.max() <= 16.0

    @pytest.mark.parametrize("rule", ["transported", "magnetometer-only"])
    @pytest.mark.parametrize("track", [complementary_track, gauss_newton_track])
    def test_without_the_defect(self, eight, track, rule):
        assert largest_deg(track(eight.record, gains(0.005), substitution=Substitution(rule)), eight).max() <= 0.8

    def test_integral_that_is_not_frozen(self, eight):
        """√K_I is close to the rate at which the field turns: the filter takes one for the other."""
        kept = gains(0.01, outage_ki_per_s2=0.01**2 / 4.0)
        assert largest_deg(complementary_track(eight.record, kept), eight).max(axis=1).min() > 20.0

    def test_gain_scheduling(self, eight):
        """0.02 with the Sun, 0.003 without: better than 0.02 throughout."""
        scheduled = largest_deg(complementary_track(eight.record, gains(0.02, outage_kp_per_s=0.003)), eight)
        throughout = largest_deg(complementary_track(eight.record, gains(0.02)), eight)
        assert np.median(scheduled) < 0.7 * np.median(throughout)


class TestHandOver:
    @pytest.mark.parametrize("rule", RULES)
    @pytest.mark.parametrize("track", [complementary_track, gauss_newton_track])
    def test_no_jump(self, track, rule):
        """Between two instants the error of the estimate changes by noise and the correction, at both ends."""
        scenario = SatelliteScenario(
            step_orbits=9.0, outage_orbits=0.5, outage_end_orbits=1.0, duration_s=1.2 * ORBIT.period_s
        )
        runs = satellite_runs(scenario, range(4))
        found = track(runs.record, gains(0.005), substitution=Substitution(rule))
        error = 2.0 * quaternion.error_vector(found.q, runs.q)
        changes = np.degrees(np.linalg.norm(np.diff(error, axis=1), axis=-1))
        orbits = scenario.orbits[1:]
        largest = np.degrees(np.linalg.norm(error, axis=-1))[:, scenario.orbits > 0.3].max()
        for edge in (0.5, 1.0):
            near = np.abs(orbits - edge) < 0.01
            # What one step corrects: K_P times twice the error, and noise of 6 σ of 2.5° a reading.
            assert changes[:, near].max() <= 0.005 * (2.0 * largest + 15.0)

    def test_ends_where_it_would_have_been(self):
        """A fifth of an orbit after the Sun is back, nothing is left of the outage."""
        settings = {"step_orbits": 9.0, "duration_s": 1.2 * ORBIT.period_s}
        with_outage = satellite_runs(SatelliteScenario(outage_orbits=0.5, outage_end_orbits=0.9, **settings), [0])
        without = satellite_runs(SatelliteScenario(**settings), [0])
        q = [complementary_track(runs.record, Gains(0.02)).q[0, -1] for runs in (with_outage, without)]
        assert math.degrees(quaternion.angle_between(*q)) < 0.05
