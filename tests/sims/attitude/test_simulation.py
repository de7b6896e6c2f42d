"""Tests of sims.attitude: one class per property."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from adcs import quaternion
from adcs.satellite.magnetic_control import HysteresisRods
from adcs.satellite.sensors import Gyro, Magnetometer, StarTracker
from magloc import core
from sims.attitude import simulation
from sims.attitude.scenario import AttitudeScenario, StartConditions
from sims.attitude.simulation import (
    AttitudeRuns,
    PreparedRuns,
    _field_error,
    prepare,
    sense,
    simulate,
    simulate_motion,
    start_estimates,
)
from tests.adcs.filter_runs import ANY_START, followed, tabletsat
from tests.calls import calls_of

Array = NDArray[np.float64]
SEEDS = range(12)


@pytest.fixture(scope="module")
def scenario() -> AttitudeScenario:
    return replace(tabletsat(), gyro_bias_rad_s=np.radians(0.027), field_bias_T=500e-9)


@pytest.fixture(scope="module")
def runs(scenario: AttitudeScenario) -> AttitudeRuns:
    return simulate(scenario, SEEDS)


class TestTruth:
    def test_shapes(self, runs: AttitudeRuns) -> None:
        assert runs.time_s.shape == (201,)
        assert runs.q.shape == runs.readings.star.shape == (12, 201, 4)
        for values in (runs.w, runs.momentum_Nms, runs.wheel_torque_Nm, runs.readings.sun, runs.states["disturbance"]):
            assert values.shape == (12, 201, 3)

    def test_holds_the_orbital_frame(self, runs: AttitudeRuns) -> None:
        angle = quaternion.angle_between(runs.q, quaternion.IDENTITY)
        assert np.degrees(angle[:, 0]).max() > 0.5
        assert np.degrees(angle[:, 150:]).max() < 0.5

    def test_disturbance(self, runs: AttitudeRuns) -> None:
        np.testing.assert_allclose(np.linalg.norm(runs.prepared.torque_Nm, axis=-1), 8e-7, rtol=1e-12)
        d = runs.states["disturbance"][3, 0]
        np.testing.assert_allclose(runs.satellite.body.inertia_kgm2 @ d, runs.prepared.torque_Nm[3, 0], rtol=1e-12)
        slow = prepare(replace(runs.scenario, torque_period_s=400.0), [3]).torque_Nm[0]
        np.testing.assert_allclose(slow[200], -slow[0], rtol=1e-12)
        np.testing.assert_allclose(slow[100], 0.0, rtol=0, atol=1e-20)

    def test_over_rate_start_is_damped(self) -> None:
        fast = replace(tabletsat(), start_rate_rad_s=np.radians(2.5))
        tumbling = simulate(fast, SEEDS)
        has_star = tumbling.readings.seen["st"]
        above = np.linalg.norm(tumbling.w, axis=-1) > fast.satellite.star_tracker.rate_limit_rad_s
        assert above[:, 0].any()
        assert not (has_star & above).any()
        assert has_star[:, -1].all()

    @pytest.mark.parametrize("torque_Nm", [1e30, 1e250])
    def test_motion_beyond_double_precision_is_refused(self, torque_Nm: float) -> None:
        with pytest.raises(ValueError, match="motion beyond double precision"):
            simulate(replace(tabletsat(), torque_Nm=torque_Nm), [0])


class TestKernel:
    """Against adcs.satellite.dynamics, with a dipole and wheels that come to their limits."""

    @staticmethod
    def prepared(n_runs: int, rods: HysteresisRods | None = None) -> PreparedRuns:
        scenario = replace(tabletsat(100.0), conditions=ANY_START, start_rate_rad_s=0.02, rods=rods)
        satellite = replace(scenario.satellite, residual_dipole_Am2=(0.3, -0.2, 0.5))
        control = replace(satellite.control, torque_limit_Nm=2e-4, momentum_limit_Nms=3e-3)
        prepared = prepare(replace(scenario, satellite=replace(satellite, control=control)), range(n_runs))
        rng = np.random.default_rng(n_runs)
        prepared.dipole_Am2[:] = 0.1 * rng.standard_normal((n_runs, 101, 3))
        prepared.torque_Nm[:] = 1e-5 * rng.standard_normal((n_runs, 101, 3))
        return prepared

    @pytest.mark.parametrize("n_runs", [1, 2, 4, 5, 9])
    def test_agrees_with_the_readable_steps(self, n_runs: int, instruction_sets: Iterator[str]) -> None:
        prepared = self.prepared(n_runs)
        expected = followed(prepared)
        for _ in instruction_sets:
            found = simulate_motion(prepared)
            np.testing.assert_allclose(found.wheel_torque_Nm, expected.wheel_torque_Nm, rtol=0, atol=1e-15)
            for name in ("q", "w", "momentum_Nms"):
                np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0, atol=1e-13)
            assert (np.abs(np.abs(found.wheel_torque_Nm) - 2e-4) < 1e-12).any()
            assert (np.abs(np.abs(found.momentum_Nms) - 3e-3) < 1e-12).any()

    def test_neither_calls_nor_threads_change_it(self, monkeypatch: pytest.MonkeyPatch) -> None:
        prepared = self.prepared(20, HysteresisRods())
        whole, threads = simulate_motion(prepared), core.threads()
        monkeypatch.setattr(simulation, "_INSTANTS_A_CALL", 7)
        try:
            for n_threads in (1, 3):
                core.set_threads(n_threads)
                found = simulate_motion(prepared)
                for name in ("q", "w", "momentum_Nms", "wheel_torque_Nm"):
                    np.testing.assert_array_equal(getattr(found, name), getattr(whole, name))
        finally:
            core.set_threads(threads)


class TestReadings:
    def test_are_the_truth_with_noise_of_the_given_size(self, runs: AttitudeRuns) -> None:
        readings, around, prepared = runs.readings, runs.environment, runs.prepared
        # 7236 numbers each: five standard deviations of their rms are 4 %.
        star = quaternion.error_vector(runs.q, readings.star) / runs.satellite.star_tracker.sigma_rad
        gyro = (readings.gyro_rad_s - runs.w - prepared.gyro_bias_rad_s) / runs.satellite.gyro.sigma_rad_s
        b_body = quaternion.rotate_back(runs.q, around.b_orbital_T)
        field = (readings.field_T - b_body - prepared.field_bias_T) / runs.satellite.magnetometer.sigma_T
        for residual in (star, gyro, field):
            assert np.sqrt(np.mean(residual**2)) == pytest.approx(1.0, abs=0.042)
        # Two of three components are noise.
        sun = readings.sun - quaternion.rotate_back(runs.q, around.sun_orbital)
        assert np.sqrt(np.mean(np.sum(sun**2, axis=-1)) / 2.0) == pytest.approx(np.radians(0.1), rel=0.05)

    def test_biases(self, runs: AttitudeRuns) -> None:
        np.testing.assert_allclose(
            np.linalg.norm(runs.prepared.gyro_bias_rad_s, axis=-1), np.radians(0.027), rtol=1e-12
        )
        np.testing.assert_allclose(np.linalg.norm(runs.prepared.field_bias_T, axis=-1), 500e-9, rtol=1e-12)

    def test_nothing_is_missing_in_the_sunlight(self, runs: AttitudeRuns) -> None:
        r = runs.readings
        assert r.seen["st"].all()
        assert r.seen["gyro"].all()
        assert r.seen["mag"].all()
        assert r.seen["sun"].all()

    def test_instant_by_instant(self, runs: AttitudeRuns) -> None:
        row = slice(57, 58)
        one = sense(runs.prepared, runs.q[:, row], runs.w[:, row], row)
        for name in ("star", "gyro_rad_s", "field_T", "sun"):
            np.testing.assert_array_equal(getattr(one, name), getattr(runs.readings, name)[:, row])

    def test_error_of_the_field_model(self, scenario: AttitudeScenario) -> None:
        wrong = prepare(replace(scenario, field_error_T=400e-9), SEEDS)
        difference = wrong.true_field_orbital_T - wrong.environment.b_orbital_T
        np.testing.assert_allclose(np.linalg.norm(difference, axis=-1), 400e-9, rtol=1e-6)
        np.testing.assert_array_equal(wrong.environment.b_orbital_T, prepare(scenario, SEEDS).environment.b_orbital_T)

    def test_an_error_of_the_field_model_that_wanders_is_forgotten(self, scenario: AttitudeScenario) -> None:
        """Correlation 1/e after its time, and the same size: 900 components, within 4 σ, a false alarm in 8,000."""
        wanders = replace(scenario, field_error_T=400e-9, field_error_correlation_s=50.0 * scenario.dt_s)
        error = _field_error(wanders, list(range(300))) / 400e-9
        before, after = error[:, 0], error[:, 50]
        assert np.mean(before * after) == pytest.approx(np.exp(-1.0), abs=4.0 * np.sqrt((1.0 + np.exp(-2.0)) / 900))
        assert np.mean(after**2) == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / 900))


class TestStarts:
    def test_conditions_hold_throughout(self, runs: AttitudeRuns) -> None:
        around = runs.environment
        assert around.sunlit.all()
        assert np.degrees(around.separation_rad).min() >= 45.0 - 0.7  # the field turns by 0.07° a second at most
        assert np.linalg.norm(around.b_orbital_T, axis=-1).min() >= 24.9e-6

    def test_differ_between_seeds(self, runs: AttitudeRuns) -> None:
        assert len(set(runs.environment.utc[:, 0].tolist())) == len(SEEDS)

    def test_eclipse_begins_when_told(self) -> None:
        night = StartConditions(sunlit=False, least_separation_rad=0.0, least_field_T=0.0, eclipse_after_s=300.0)
        dark = simulate(replace(tabletsat(2500.0), conditions=night), range(4))
        lit = dark.environment.sunlit
        assert lit[:, :290].all()
        assert not lit[:, 301:2000].any()
        assert lit[:, -200:].all()
        assert not (dark.readings.seen["sun"] & ~lit).any()

    def test_collinear(self) -> None:
        line = replace(ANY_START, sunlit=True, most_separation_rad=np.radians(12.0))
        around = prepare(replace(tabletsat(local_time_h=13.0), conditions=line), range(4)).environment
        assert np.degrees(around.separation_rad.min(axis=-1)).max() <= 12.0

    def test_afternoon_orbit_is_never_collinear(self) -> None:
        line = replace(ANY_START, sunlit=True, most_separation_rad=np.radians(30.0))
        with pytest.raises(ValueError, match=r"Input conditions must hold"):
            prepare(replace(tabletsat(), conditions=line), [0])

    def test_none(self) -> None:
        never = replace(tabletsat(), conditions=StartConditions(least_field_T=1.0))
        with pytest.raises(
            ValueError, match=r"Input conditions must hold for 200 s somewhere in the 24 hours from 2014"
        ):
            simulate(never, [0])

    def test_start_estimates(self, scenario: AttitudeScenario) -> None:
        prepared = prepare(scenario, range(300))
        q, w = start_estimates(prepared, 0.02, 0.001)
        # 900 numbers: five standard deviations of their rms are 12 %.
        assert np.sqrt(np.mean((2 * quaternion.error_vector(q, prepared.q)) ** 2)) == pytest.approx(0.02, rel=0.12)
        assert np.sqrt(np.mean((w - prepared.w) ** 2)) == pytest.approx(0.001, rel=0.12)

    def test_errors_of_start_estimates_are_in_body_axes(self, scenario: AttitudeScenario) -> None:
        """The same, seed by seed, whatever the true attitude."""
        prepared = prepare(scenario, SEEDS)
        turned = replace(prepared, q=quaternion.multiply(np.array([0.5, 0.5, 0.5, 0.5]), prepared.q))
        errors = [
            quaternion.multiply(quaternion.conjugate(one.q), start_estimates(one, 0.02, 0.001)[0])
            for one in (prepared, turned)
        ]
        np.testing.assert_allclose(*errors, atol=1e-14)


class TestSeeds:
    def test_a_run_depends_on_its_seed_alone(self, scenario: AttitudeScenario, runs: AttitudeRuns) -> None:
        alone = simulate(scenario, [7])
        np.testing.assert_array_equal(alone.q[0], runs.q[7])
        np.testing.assert_array_equal(alone.readings.field_T[0], runs.readings.field_T[7])

    def test_a_longer_run_begins_alike(self, scenario: AttitudeScenario) -> None:
        # Both starts allow any instant, so that the draw is the same.
        short, long = (
            prepare(replace(scenario, conditions=ANY_START, duration_s=duration), [1]) for duration in (100.0, 200.0)
        )
        np.testing.assert_array_equal(short.environment.utc[0], long.environment.utc[0, :101])
        np.testing.assert_array_equal(short.noise["gyro"][0], long.noise["gyro"][0, :101])

    def test_sensors_have_their_own_streams(self, scenario: AttitudeScenario, runs: AttitudeRuns) -> None:
        worse = replace(scenario.satellite, gyro=Gyro(sigma_rad_s=1.0), star_tracker=StarTracker(sigma_rad=0.1))
        other = replace(scenario, satellite=worse)
        np.testing.assert_array_equal(simulate(other, SEEDS).readings.sun, runs.readings.sun)

    def test_walks(self, scenario: AttitudeScenario) -> None:
        wandering = {"gyro": Gyro(bias_walk_rad_s=1e-5), "magnetometer": Magnetometer(bias_walk_T=1e-9)}
        walking = replace(scenario, satellite=replace(scenario.satellite, **wandering), dt_s=2.0, duration_s=400.0)
        prepared = prepare(walking, range(100))
        for walk, walks in ((1e-5, prepared.gyro_bias_rad_s), (1e-9, prepared.field_bias_T)):
            grown = walks[:, 200] - walks[:, 0]
            # 300 numbers: five standard deviations of their rms are 20 %.
            assert np.sqrt(np.mean(grown**2)) == pytest.approx(walk * np.sqrt(400.0), rel=0.2)
        np.testing.assert_array_equal(walks[:, 0], prepare(scenario, range(100)).field_bias_T[:, 0])

    def test_no_seeds(self, scenario: AttitudeScenario) -> None:
        with pytest.raises(ValueError, match=r"Input seeds must hold one seed at least; instead received none\."):
            simulate(scenario, [])


class TestScenario:
    @pytest.mark.parametrize(
        "bad", [{"dt_s": 0.0}, {"duration_s": 0.5}, {"torque_Nm": -1.0}, {"field_error_T": np.inf}]
    )
    def test_bad_numbers(self, bad: dict[str, float]) -> None:
        with pytest.raises(ValueError, match=rf"Input {next(iter(bad))} must be .*; instead received"):
            replace(tabletsat(), **bad)

    def test_dates_outside_of_the_field_model(self) -> None:
        late = replace(tabletsat(), satellite=replace(tabletsat().satellite, start=np.datetime64("2035-01-01", "us")))
        with pytest.raises(ValueError, match=r"Input date must lie within the validity of IGRF-14"):
            simulate(late, [0])


class TestSpeed:
    def test_steps_are_compiled(self) -> None:
        """9,900 more steps make fewer than a hundred more interpreted calls: none of them is one of a step."""
        day = replace(tabletsat(), conditions=ANY_START)
        short, long = (calls_of(lambda s=s: simulate(replace(day, duration_s=s), [0])) for s in (100.0, 10_000.0))
        assert long < short + 100
