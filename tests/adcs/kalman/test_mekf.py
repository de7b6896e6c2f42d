"""Tests of adcs.kalman.mekf, its kernel, sims.experiments.accuracy and adcs.kalman.diagnostics.

One class per property.

The oracles: central differences of the full equations, the update that adds information, the acceptance figures that
a prototype of its own reached, and χ² for runs whose truth does exactly what the filter believes.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm
from scipy.stats import chi2

from adcs import quaternion
from adcs.kalman.diagnostics import find_problems, warning_sentences
from adcs.kalman.error_state import (
    SIZES,
    AttitudeState,
    AttitudeTracks,
    FilterSettings,
    FilterStart,
    ProcessNoise,
    sensor_set,
)
from adcs.kalman.mekf import (
    apply_error,
    collect_tracks,
    complete_start,
    initial_state,
    joseph_update,
    known_torque_jacobian,
    predict,
    propagate,
    residuals,
    run_filter,
    update_state,
)
from adcs.kalman.process_noise import paper_noise
from adcs.kalman.smoother import error_between
from adcs.satellite.sensors import StarTracker
from magloc import core
from magloc.chi_square import normalised_square
from sims.attitude.scenario import AttitudeScenario, StartConditions
from sims.attitude.simulation import AttitudeRuns, advance, prepare, sense, simulate
from sims.experiments.accuracy import error_norm_deg, errors, last_rows, normalised_error_squared
from tests.adcs.attitudes import commanded_torque, random_attitudes
from tests.adcs.filter_runs import (
    ANY_START,
    GYRO_BIAS_RAD_S,
    SEEDS,
    assert_as_readable,
    believed_runs,
    evaluate,
    followed,
    runs_for,
    settings,
    start_of,
    tabletsat,
    unlike_stars,
)
from tests.adcs.kalman.test_error_state import TABLE_3
from tests.calls import calls_of

Array = NDArray[np.float64]
ALL = ("st+gyro+mag+sun", ("field-bias", "gyro-bias", "disturbance"))
EVERYTHING = (ALL[0], (*ALL[1], "field-model", "dipole", "field-gain"))
SIZE = settings(*EVERYTHING).sensors.size


def filtered(sensors: str, states: tuple[str, ...], duration_s: float) -> tuple[AttitudeRuns, AttitudeTracks]:
    chosen = settings(sensors, states)
    runs, start = runs_for(chosen.sensors, duration_s)
    return runs, run_filter(runs, chosen, start)


def with_star_tracker(scenario: AttitudeScenario, **changes: float) -> AttitudeScenario:
    return replace(scenario, satellite=replace(scenario.satellite, star_tracker=StarTracker(**changes)))


@pytest.fixture(scope="module")
def runs() -> AttitudeRuns:
    return runs_for(settings(*ALL).sensors, 10.0, range(6))[0]


@pytest.fixture(scope="module")
def state(runs: AttitudeRuns) -> AttitudeState:
    rng = np.random.default_rng(2)
    first = initial_state(settings(*EVERYTHING), start_of(runs))
    sizes = {"disturbance": 1e-6, "dipole": 0.05, "field-model": 2e-7, "field-gain": 0.03}
    optional = {state: size * rng.standard_normal((6, SIZES[state])) for state, size in sizes.items()}
    return replace(
        first, q=random_attitudes(6, rng), w=0.02 * rng.standard_normal((6, 3)), optional={**first.optional, **optional}
    )


class TestJacobians:
    """Central differences at a random state, step 1e-4."""

    STEP = 1e-4
    CHOSEN = settings(*EVERYTHING)

    def perturbed(self, state: AttitudeState, column: int, sign: float, size: float) -> AttitudeState:
        dx = np.zeros((6, SIZE))
        dx[:, column] = sign * size
        return apply_error(state, dx, self.CHOSEN.sensors)

    def test_measurements(self, runs: AttitudeRuns, state: AttitudeState) -> None:
        # Where a star tracker reads no error: its residual is the error itself, not linear in a small change of it.
        star = np.repeat(state.q[:, None], runs.q.shape[1], axis=1)
        runs = replace(runs, readings=replace(runs.readings, star=star))
        # Angles and rates in steps of 1e-4, the field's bias in steps of 1e-9 T.
        for sensor, _, H in residuals(runs, 3, state, self.CHOSEN.sensors):
            for column in range(SIZE):
                size = 1e-9 if 6 <= column < 9 or 15 <= column < 18 else self.STEP
                at = [
                    residuals(runs, 3, self.perturbed(state, column, sign, size), self.CHOSEN.sensors)
                    for sign in (1.0, -1.0)
                ]
                above, below = (next(part[1] for part in parts if part[0] == sensor) for parts in at)
                scale = np.abs(H).max()
                np.testing.assert_allclose(-(above - below) / (2.0 * size), H[..., column], rtol=0, atol=1e-7 * scale)

    def test_star_tracker_reads_the_error(self, runs: AttitudeRuns, state: AttitudeState) -> None:
        # Exactly, for any size: it is why one reading corrects any attitude.
        error = np.array([0.5, -0.3, 0.4])
        readings = replace(runs.readings, star=np.repeat(runs.readings.star[:, :1], 11, axis=1))
        readings.star[:, 3] = quaternion.multiply(state.q, quaternion.from_error_vector(error))
        _, residual, _ = residuals(replace(runs, readings=readings), 3, state, self.CHOSEN.sensors)[0]
        np.testing.assert_allclose(residual, np.tile(error, (6, 1)), rtol=0, atol=1e-14)

    def test_transition(self, runs: AttitudeRuns, state: AttitudeState) -> None:
        """Against differences of whole steps.

        The mean of F over a step leaves 1/12 of the commutator of F at its ends (Magnus' series), and Φ ends with the
        third power: its difference to scipy's exponential is less than the fourth.
        """
        ahead, Phi = predict(runs, 3, state, self.CHOSEN)
        ends = np.zeros((2, 6, SIZE, SIZE))
        ends[:, :, 15:18, 15:18] = -np.eye(3) / self.CHOSEN.field_correlation_s
        for end, row, at in ((0, 3, state), (1, 4, ahead)):
            ends[end, :, :6, :6] = known_torque_jacobian(runs, row, at)
            b_body = quaternion.rotate_back(at.q, runs.environment.b_orbital_T[:, row])
            # Column by column: the acceleration by a dipole of 1 A·m² along an axis.
            for column, axis in enumerate(np.eye(3)):
                acceleration = np.cross(axis, b_body) @ runs.satellite.body.inverse
                ends[end, :, 3:6, 18 + column] = acceleration
        ends[:, :, 3:6, 12:15] = np.eye(3)
        mean = 0.5 * (ends[0] + ends[1])
        fourth = np.linalg.matrix_power(np.abs(mean), 4).max() / 24.0
        np.testing.assert_allclose(Phi, expm(mean), rtol=0, atol=1.1 * fourth)
        exact = expm(mean + (ends[1] @ ends[0] - ends[0] @ ends[1]) / 12.0)
        for column in range(SIZE):
            one, other = (self.after(runs, self.perturbed(state, column, sign, self.STEP)) for sign in (1.0, -1.0))
            measured = (self.error(ahead, one) - self.error(ahead, other)) / (2.0 * self.STEP)
            np.testing.assert_allclose(measured, exact[..., column], rtol=0, atol=3e-6)

    def after(self, runs: AttitudeRuns, state: AttitudeState) -> AttitudeState:
        q, w = propagate(runs, 3, state)
        model = {
            "field-model": self.CHOSEN.decay(runs.dt_s)[self.CHOSEN.sensors.slice_of("field-model")]
            * state.optional_state("field-model")
        }
        return replace(state, q=q, w=w, optional={**state.optional, **model})

    def error(self, state: AttitudeState, other: AttitudeState) -> Array:
        return error_between(other, state, self.CHOSEN.sensors)


def information_update(P: Array, H: Array, residual: Array) -> tuple[Array, Array]:
    """Update by adding information, P⁻¹ + HᵀH: it loses digits where P is nearly singular."""
    updated = np.asarray(np.linalg.inv(np.linalg.inv(P) + H.mT @ H), dtype=np.float64)
    return (updated @ H.mT @ residual[..., None])[..., 0], updated


class TestUpdates:
    def problem(self) -> tuple[Array, Array, Array]:
        rng = np.random.default_rng(4)
        root = rng.standard_normal((8, 9, 9))
        return root @ root.mT, rng.standard_normal((8, 5, 9)), rng.standard_normal((8, 5))

    def test_forms_agree(self) -> None:
        P, H, residual = self.problem()
        for one, two in zip(joseph_update(P, H, residual), information_update(P, H, residual), strict=True):
            np.testing.assert_allclose(one, two, rtol=0, atol=1e-9)

    def test_no_reading_teaches_nothing(self) -> None:
        chosen = settings("mag+sun+gyro")
        runs, start = runs_for(chosen.sensors, 5.0, range(2))
        nothing = {
            name: np.full_like(getattr(runs.readings, name), np.nan) for name in ("gyro_rad_s", "field_T", "sun")
        }
        blind = replace(runs, readings=replace(runs.readings, **nothing))
        before = initial_state(chosen, start)
        after, nis = update_state(blind, 0, before, chosen)
        np.testing.assert_array_equal(after.P, before.P)
        np.testing.assert_allclose(after.q, before.q, rtol=0, atol=1e-15)
        assert np.isnan(nis).all()
        assert (np.diff(run_filter(blind, chosen, start).sigma, axis=1) > 0.0)[..., :3].all()


class TestCompiledTwin:
    @pytest.mark.parametrize(("sensors", "states"), [*TABLE_3, ALL, EVERYTHING])
    def test_agrees(self, sensors: str, states: tuple[str, ...]) -> None:
        chosen = settings(sensors, states)
        runs, start = runs_for(chosen.sensors, 40.0, range(2))
        # Gaps of every sensor.
        for i, name in enumerate(("star", "gyro_rad_s", "field_T", "sun")):
            getattr(runs.readings, name)[:, 10 + i : 40 : 7] = np.nan
        assert_as_readable(runs, chosen, start)

    def test_agrees_where_the_disturbance_has_a_time_constant(self) -> None:
        chosen = replace(settings("mag+sun", ["disturbance", "field-model"]), disturbance_correlation_s=30.0)
        runs, start = runs_for(chosen.sensors, 40.0, range(2))
        assert_as_readable(runs, chosen, start)

    def test_agrees_where_a_star_camera_tells_one_turn_worse(self) -> None:
        chosen = settings("st+gyro+sun", ["gyro-bias"])
        runs, start = runs_for(chosen.sensors, 40.0, range(2))
        assert_as_readable(unlike_stars(runs), chosen, start)

    def test_agrees_from_a_start_of_all_states(self) -> None:
        chosen = settings("mag+sun", ["disturbance", "dipole"])
        runs, start = runs_for(chosen.sensors, 40.0, range(2))
        rng = np.random.default_rng(8)
        own = {name: size * rng.standard_normal((2, 3)) for name, size in (("disturbance", 1e-6), ("dipole", 0.05))}
        whole = complete_start(chosen, start)
        whole = replace(whole, covariance=0.1 * whole.covariance, optional=own)
        fast = assert_as_readable(runs, chosen, whole)
        for name in own:
            # One instant tells almost nothing of them.
            np.testing.assert_allclose(fast.optional[name][:, 0], own[name], rtol=0.05, atol=1e-9)

    def test_runs_do_not_depend_on_each_other(self) -> None:
        chosen = settings("mag+sun+gyro", ["gyro-bias"])
        runs, start = runs_for(chosen.sensors, 30.0, range(5))
        alone, start_alone = runs_for(chosen.sensors, 30.0, [3])
        np.testing.assert_array_equal(run_filter(runs, chosen, start).q[3], run_filter(alone, chosen, start_alone).q[0])

    @pytest.mark.usefixtures("instruction_set")
    def test_every_instruction_set_agrees(self) -> None:
        chosen = settings(*EVERYTHING)
        runs, start = runs_for(chosen.sensors, 20.0, range(2))
        fast = assert_as_readable(runs, chosen, start)
        np.testing.assert_array_equal(fast.covariance, fast.covariance.mT)

    def test_bad_start(self) -> None:
        chosen = settings("st")
        runs, start = runs_for(chosen.sensors, 5.0, range(2))
        for bad in (
            FilterStart(start.q[:1], start.w, start.covariance),
            FilterStart(start.q * np.nan, start.w, start.covariance),
        ):
            with pytest.raises(ValueError, match=r"Input start\.q must be finite with shape \(2, 4\)"):
                run_filter(runs, chosen, bad)

    def test_bad_settings(self) -> None:
        with pytest.raises(ValueError, match="Input field_error_T must be 0 or more"):
            replace(settings("st+mag"), field_error_T=-1.0)
        with pytest.raises(ValueError, match="Input gyro_bias_sigma_rad_s must be positive"):
            replace(settings("st+gyro"), gyro_bias_sigma_rad_s=0.0)


class TestClosedLoop:
    @pytest.mark.slow
    def test_wheels_that_follow_the_estimate(self) -> None:
        """The loop is closed by the estimate itself, and the filter is told the torque: it is as accurate as ever."""
        chosen = settings("mag+sun+gyro")
        prepared = prepare(tabletsat(300.0), SEEDS)
        scenario, around = prepared.scenario, prepared.environment
        runs = followed(prepared)
        for values in (runs.q, runs.w, runs.momentum_Nms, runs.wheel_torque_Nm):
            values[:, 1:] = np.nan
        start = start_of(runs)
        state = initial_state(chosen, start)
        states = []
        for row in range(301):
            now = sense(prepared, runs.q[:, row : row + 1], runs.w[:, row : row + 1], slice(row, row + 1))
            for name in ("star", "gyro_rad_s", "field_T", "sun"):
                getattr(runs.readings, name)[:, row] = getattr(now, name)[:, 0]
            if row:
                state, _ = predict(runs, row - 1, state, chosen)
            state, _ = update_state(runs, row, state, chosen)
            states.append(state)
            runs.wheel_torque_Nm[:, row] = commanded_torque(
                runs.satellite.body,
                runs.satellite.control,
                state.q,
                state.w,
                runs.momentum_Nms[:, row],
                quaternion.IDENTITY,
                around.orbital_rate_rad_s[:, row],
                scenario.dt_s,
            )
            if row < 300:
                true = (runs.q[:, row], runs.w[:, row], runs.momentum_Nms[:, row])
                after = advance(prepared, true, runs.wheel_torque_Nm[:, row], row)
                runs.q[:, row + 1], runs.w[:, row + 1], runs.momentum_Nms[:, row + 1] = after
        estimates = collect_tracks(chosen, states, np.full((10, 301, 4), np.nan))
        reached = evaluate(runs, estimates)
        assert (reached["angle_rms_deg"] or 9.0) <= 4e-2
        assert 0.3 <= (reached["nees_per_dimension"] or 9.0) <= 1.3
        # The satellite holds the orbital frame within the error of the estimate and what the torque pushes it off.
        assert np.degrees(quaternion.angle_between(runs.q[:, -60:], quaternion.IDENTITY)).max() < 0.3
        np.testing.assert_allclose(run_filter(runs, chosen, start).q, estimates.q, rtol=0, atol=1e-13)


class TestSpeed:
    """Steps and runs are compiled: on one thread, more of them make hardly more calls."""

    @pytest.fixture(autouse=True)
    def one_thread(self) -> Iterator[None]:
        before = core.threads()
        core.set_threads(1)
        yield
        core.set_threads(before)

    def test_single_record(self) -> None:
        chosen = settings("mag+sun+gyro")
        short, long = (simulate(replace(tabletsat(s), conditions=ANY_START), [0]) for s in (100.0, 10_000.0))
        assert self.calls(long, chosen) == self.calls(short, chosen)

    def test_monte_carlo(self) -> None:
        few, many = (simulate(tabletsat(), range(n)) for n in (10, 100))
        chosen = settings("mag+sun+gyro")
        assert self.calls(many, chosen) < 1.1 * self.calls(few, chosen)  # a kernel is called once a block

    @staticmethod
    def calls(runs: AttitudeRuns, chosen: FilterSettings) -> int:
        start = start_of(runs)
        return calls_of(lambda: run_filter(runs, chosen, start))


class TestAcceptance:
    """The table of acceptance: 10 seeds, worst axis, both of the mean of the runs' rms and of the rms over all runs."""

    CASES = (
        # sensors, states, duration, angle °, rate °/s, bounds of NEES, other
        ("st", (), 200.0, 9e-4, 3e-4, (0.5, 1.6), {}),
        ("st+gyro", (), 200.0, 9e-4, 3e-4, (0.5, 1.6), {}),
        ("st+gyro", ("gyro-bias",), 200.0, 9e-4, 3e-4, (0.0, 9.9), {"gyro_bias_rms_deg_s": 6e-4}),
        ("st+mag", ("field-bias",), 200.0, 9e-4, 3e-4, (0.0, 9.9), {"field_bias_rms_nT": 30.0}),
        ("mag+sun+gyro", (), 200.0, 4e-2, 2e-3, (0.3, 1.3), {}),
        ("mag+sun", (), 200.0, 0.14, 3.2e-3, (0.3, 1.3), {}),
        ("mag+gyro", (), 200.0, 0.55, 2e-3, (0.4, 1.6), {}),
        ("st", ("disturbance",), 200.0, 7e-4, 8e-5, (0.0, 9.9), {"disturbance_rms_s2": 8e-8}),
        ("mag+sun", ("disturbance",), 600.0, 6e-2, 6e-4, (0.0, 9.9), {"disturbance_rms_s2": 8e-8}),
        (
            "mag+sun+gyro",
            ("gyro-bias", "disturbance"),
            600.0,
            4e-2,
            4e-4,
            (0.0, 9.9),
            {"gyro_bias_rms_deg_s": 5e-4, "disturbance_rms_s2": 8e-8},
        ),
    )

    @pytest.mark.parametrize(("sensors", "states", "duration_s", "angle", "rate", "nees", "other"), CASES)
    def test_table(
        self,
        sensors: str,
        states: tuple[str, ...],
        duration_s: float,
        angle: float,
        rate: float,
        nees: tuple[float, float],
        other: dict[str, float],
    ) -> None:
        runs, estimates = filtered(sensors, states, duration_s)
        reached = evaluate(runs, estimates)
        pooled = np.degrees(np.sqrt(np.mean(errors(runs, estimates)[:, last_rows(runs)] ** 2, axis=(0, 1))))
        assert max(reached["angle_rms_deg"] or 0.0, 2.0 * pooled[:3].max()) <= angle
        assert max(reached["rate_rms_deg_s"] or 0.0, pooled[3:6].max()) <= rate
        assert nees[0] <= (reached["nees_per_dimension"] or 0.0) <= nees[1]
        assert {name: (reached[name] or np.inf) <= bound for name, bound in other.items()} == dict.fromkeys(other, True)
        assert reached["diverged_runs"] == 0
        assert reached["runs"] == 10
        absent = {"gyro_bias_rms_deg_s", "field_bias_rms_nT", "disturbance_rms_s2"} - {
            {"gyro-bias": "gyro_bias_rms_deg_s", "field-bias": "field_bias_rms_nT"}.get(state, "disturbance_rms_s2")
            for state in states
        }
        assert all(reached[name] is None for name in absent)

    def test_noise_and_process_noise_of_the_source(self) -> None:
        used = sensor_set("st")
        # 0.001° as the noise of the quaternion's components, which the source's tables need.
        runs = simulate(with_star_tracker(tabletsat(), sigma_rad=math.radians(0.001)), SEEDS)
        reached = evaluate(runs, run_filter(runs, FilterSettings(used, paper_noise(used)), start_of(runs)))
        assert (reached["angle_rms_deg"] or 9.0) <= 1.9e-3
        assert (reached["rate_rms_deg_s"] or 9.0) <= 1.1e-3

    def test_field_bias_with_the_source_s_process_noise(self) -> None:
        chosen = settings("st+mag", ["field-bias"])
        noisy = replace(chosen, noise=replace(chosen.noise, field_bias_T=40e-9))
        runs, start = runs_for(chosen.sensors, 200.0)
        assert (evaluate(runs, run_filter(runs, noisy, start))["field_bias_rms_nT"] or 999.0) <= 100.0

    def test_star_tracker_is_right_from_its_first_reading(self) -> None:
        runs, estimates = filtered("st", (), 60.0)
        assert error_norm_deg(runs, estimates).max() < 0.01

    def test_unmodelled_gyro_bias_with_one_direction(self) -> None:
        """Negative: nothing observes the turn about the field, and the error grows."""
        chosen = settings("mag+gyro")
        runs = simulate(replace(tabletsat(300.0), gyro_bias_rad_s=GYRO_BIAS_RAD_S), SEEDS)
        estimates = run_filter(runs, chosen, start_of(runs))
        assert (evaluate(runs, estimates)["angle_rms_deg"] or 0.0) > 5.0
        assert all("a bias of the gyro is not in the state" in one[0] for one in warning_sentences(runs, estimates))

    @pytest.mark.slow
    def test_closed_loop_jacobian_is_overconfident(self) -> None:
        """Negative: the F of the source, which takes the torque for a feedback of the truth."""
        chosen = settings("mag+sun")
        runs, start = runs_for(chosen.sensors, 200.0)
        right = evaluate(runs, run_filter(runs, chosen, start))
        wrong = evaluate(runs, run_filter(runs, chosen, start, closed_loop_F=True))
        assert (wrong["angle_rms_deg"] or 0.0) > 1.5 * (right["angle_rms_deg"] or 9.0)
        assert (wrong["nees_per_dimension"] or 0.0) > 3.0


class TestConsistency:
    """NEES of runs whose truth has the filter's own process noise; start errors of 1°, where it is linear.

    The sum over the runs at the last instant is a χ² of runs times N numbers: two-sided bounds that a right filter
    leaves once in a thousand times per case. Seeds are fixed.
    """

    CASES = (
        *TABLE_3,
        ("st", ("disturbance",)),
        ("mag+sun", ("disturbance",)),
        ("mag+sun+gyro", ("gyro-bias", "disturbance")),
        ("mag+sun", ("disturbance", "dipole")),
        ("mag+sun+gyro", ("field-bias", "field-gain")),
    )

    def check(self, sensors: str, states: tuple[str, ...], seeds: range) -> None:
        chosen = settings(sensors, states)
        if "disturbance" in states:
            # The true d of a record holds all accelerations: leave none to the noise of the rate.
            chosen = replace(chosen, noise=ProcessNoise(1e-8, 1e-9))
        # Gains of 5 % times what an attitude is off are not linear any more.
        chosen = replace(chosen, gyro_bias_sigma_rad_s=5e-4, field_gain_sigma=0.01, field_axes_sigma_rad=0.003)
        runs = believed_runs(chosen, 200.0, seeds)
        estimates = run_filter(runs, chosen, start_of(runs, math.radians(1.0)))
        total = normalised_error_squared(runs, estimates)[:, -1].sum()
        low, high = chi2.ppf([0.0005, 0.9995], len(seeds) * chosen.sensors.size)
        assert low < total < high

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(("sensors", "states"), CASES)
    def test_hundred_runs(self, sensors: str, states: tuple[str, ...]) -> None:
        self.check(sensors, states, range(100))


class TestFieldModel:
    """An error of the field model that lasts: a state, not noise."""

    STATES = ("gyro-bias", "disturbance", "field-model")

    def runs(self, field_error_T: float) -> AttitudeRuns:
        scenario = replace(tabletsat(4000.0), conditions=ANY_START, gyro_bias_rad_s=GYRO_BIAS_RAD_S)
        return simulate(replace(scenario, field_error_T=field_error_T, field_error_correlation_s=132.0), SEEDS)

    def attitude_nees(self, runs: AttitudeRuns, chosen: FilterSettings) -> float:
        estimates = run_filter(runs, chosen, start_of(runs))
        covariance = estimates.covariance[:, 1000:, :3, :3]
        error = quaternion.error_vector(estimates.q, runs.q)[:, 1000:]
        return float(normalised_square(error, covariance).mean() / 3.0)

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("field_error_T", [150e-9, 400e-9])
    def test_sigma_is_honest(self, field_error_T: float) -> None:
        """Even where its size or its time constant is half or twice what the filter believes."""
        runs = self.runs(field_error_T)
        right = replace(settings("mag+sun+gyro", self.STATES), field_error_T=field_error_T)
        assert 0.7 < self.attitude_nees(runs, right) < 1.4
        for factor in (0.5, 2.0):
            assert 0.6 < self.attitude_nees(runs, replace(right, field_correlation_s=132.0 * factor)) < 1.6
        ignored = settings("mag+sun+gyro", self.STATES[:2])
        for wrong in (ignored, replace(ignored, field_error_T=field_error_T)):
            assert self.attitude_nees(runs, wrong) > 4.0

    def test_nothing_is_lost_where_there_is_none(self) -> None:
        runs = self.runs(0.0)
        chosen = replace(settings("mag+sun+gyro", self.STATES), field_error_T=1e-12)
        assert 0.7 < self.attitude_nees(runs, chosen) < 1.4

    def test_transition(self, runs: AttitudeRuns) -> None:
        """The variance stays what it is, and the state decays."""
        chosen = replace(settings("mag+sun", ["field-model"]), field_error_T=2e-7, field_correlation_s=50.0)
        state = replace(initial_state(chosen, start_of(runs)), optional={"field-model": np.full((6, 3), 1e-7)})
        after, Phi = predict(runs, 0, state, chosen)
        np.testing.assert_allclose(after.optional["field-model"], 1e-7 * math.exp(-1.0 / 50.0))
        np.testing.assert_allclose(np.diagonal(after.P[:, 6:, 6:], axis1=1, axis2=2), 4e-14)
        np.testing.assert_allclose(Phi[:, 6:, 6:], np.tile(math.exp(-1.0 / 50.0) * np.eye(3), (6, 1, 1)))


class TestProblems:
    def test_nothing_is_wrong(self) -> None:
        for sensors in ("st+gyro", "mag+sun+gyro", "mag+sun"):
            runs, estimates = filtered(sensors, (), 200.0)
            assert warning_sentences(runs, estimates) == ((),) * 10

    def test_eclipse(self) -> None:
        """What an eclipse of half an hour costs, and that it is named.

        The figures hold for a constant torque after 50 minutes in the Sun: the gyro's bias is known as well as that.
        """
        conditions = StartConditions(False, 0.0, math.radians(90.0), 0.0, eclipse_after_s=3000.0)
        chosen = settings("mag+sun+gyro", ["gyro-bias", "disturbance"])
        chosen = replace(chosen, noise=replace(chosen.noise, disturbance_s2=1e-9))
        scenario = replace(tabletsat(5300.0), conditions=conditions, gyro_bias_rad_s=GYRO_BIAS_RAD_S)
        runs = simulate(scenario, SEEDS)
        estimates = run_filter(runs, chosen, start_of(runs))
        norm, dark = error_norm_deg(runs, estimates), ~runs.environment.sunlit
        assert np.mean([norm[run, dark[run]].max() for run in range(10)]) < 0.25
        for run in range(10):
            after = np.flatnonzero(dark[run])[-1] + 1
            assert norm[run, after : after + 240].min() < 0.06
        sentences = warning_sentences(runs, estimates)[0]
        assert any(sentence.startswith("eclipse: no Sun for 18") for sentence in sentences)
        assert any("known by the gyro only, 1σ grows from" in sentence for sentence in sentences)

    def test_one_direction_where_nothing_accumulates(self) -> None:
        """Along two orbits the field turns: the bias is found, and there is nothing to warn of."""
        conditions = StartConditions(False, 0.0, math.radians(90.0), 0.0)
        runs = simulate(replace(tabletsat(12_000.0), conditions=conditions, gyro_bias_rad_s=GYRO_BIAS_RAD_S), range(2))
        estimates = run_filter(runs, settings("mag+gyro", ["gyro-bias", "disturbance"]), start_of(runs))
        assert error_norm_deg(runs, estimates)[:, -60:].max() < 1.0
        assert not any("one direction" in text for of_run in warning_sentences(runs, estimates) for text in of_run)

    def test_rows_of_a_problem(self) -> None:
        """Where it is: the shadow, neither more nor less."""
        conditions = StartConditions(False, 0.0, math.radians(90.0), 0.0, eclipse_after_s=100.0)
        runs = simulate(replace(tabletsat(300.0), conditions=conditions), range(2))
        estimates = run_filter(runs, settings("mag+sun+gyro"), start_of(runs))
        for run, (first, *_) in enumerate(find_problems(runs, estimates)):
            assert first.text.startswith("eclipse")
            assert 0 < first.rows.sum() < first.rows.size
            assert (first.rows == ~runs.environment.sunlit[run]).all()

    def test_collinear(self) -> None:
        conditions = StartConditions(True, 0.0, math.radians(10.0), 0.0)
        runs = simulate(replace(tabletsat(600.0, local_time_h=13.0), conditions=conditions), SEEDS)
        separation = np.degrees(runs.environment.separation_rad)[:, 120:]
        reached = {}
        for sensors in ("mag+sun", "mag+sun+gyro"):
            estimates = run_filter(runs, settings(sensors), start_of(runs))
            norm = error_norm_deg(runs, estimates)[:, 120:]
            reached[sensors] = [np.sqrt(np.mean(norm[near] ** 2)) for near in (separation < 12.0, separation > 25.0)]
            assert all("Sun and field on one line" in sentences[0] for sentences in warning_sentences(runs, estimates))
        assert reached["mag+sun"][0] > 2.0 * reached["mag+sun"][1]
        assert reached["mag+sun+gyro"][0] < 0.5 * reached["mag+sun"][0]

    def test_field_model(self) -> None:
        """400 nT: worse by far than its covariance, and named in nearly every run; never without an error."""
        scenario = replace(tabletsat(), field_error_T=400e-9)
        runs, chosen = simulate(scenario, range(40)), settings("mag+sun+gyro")
        estimates = run_filter(runs, chosen, start_of(runs))
        reached = evaluate(runs, estimates)
        assert (reached["nees_per_dimension"] or 0.0) > 5.0
        named = [
            "field differs from its model" in " ".join(sentences) for sentences in warning_sentences(runs, estimates)
        ]
        assert np.mean(named) > 0.9
        inflated = run_filter(runs, replace(chosen, field_error_T=400e-9), start_of(runs))
        assert (evaluate(runs, inflated)["nees_per_dimension"] or 9e9) < 0.5 * (reached["nees_per_dimension"] or 0.0)
        sentence = "an error of the field's model of 400 nT is taken for noise"
        assert all(any(sentence in one for one in of_run) for of_run in warning_sentences(runs, inflated))
        assert not any(sentence in one for of_run in warning_sentences(runs, estimates) for one in of_run)

    def test_star_tracker_over_rate_and_blinded(self) -> None:
        fast = replace(tabletsat(100.0), start_rate_rad_s=math.radians(2.5))
        runs = simulate(with_star_tracker(fast, sun_exclusion_rad=math.radians(70.0)), range(20))
        estimates = run_filter(runs, settings("st+gyro"), start_of(runs))
        sentences = warning_sentences(runs, estimates)
        assert any("star tracker over-rate: above 2°/s" in " ".join(one) for one in sentences)
        assert any("star tracker blinded" in " ".join(one) for one in sentences)
        missing = ~runs.readings.seen["st"].all(axis=-1)
        assert [any("star tracker" in sentence for sentence in one) for one in sentences] == missing.tolist()

    def test_wrong_torque(self) -> None:
        """Innovations tell of a model that is wrong: a torque of 1e-4 N·m that no state can take."""
        runs = simulate(replace(tabletsat(), torque_Nm=1e-4), SEEDS)
        estimates = run_filter(runs, settings("st"), start_of(runs))
        assert all("the model is wrong" in " ".join(one) for one in warning_sentences(runs, estimates))


class TestAccuracy:
    def test_errors_that_are_put_in(self) -> None:
        chosen = settings("st+gyro", ["gyro-bias"])
        runs, _ = runs_for(chosen.sensors, 100.0, range(3))
        error = np.array([1e-3, -2e-3, 3e-3])
        q = quaternion.multiply(runs.q, quaternion.conjugate(quaternion.from_error_vector(error)))
        covariance = np.tile(np.diag(np.repeat([1e-6, 1e-8, 1e-8], 3)), (3, 101, 1, 1))
        estimates = AttitudeTracks(
            chosen,
            q,
            runs.w - 1e-4,
            {"gyro-bias": runs.prepared.gyro_bias_rad_s},
            covariance,
            np.zeros((3, 101, 4)),
            np.zeros((3, 101, 4), dtype=np.bool_),
            np.zeros((3, 101, 4)),
        )
        reached = evaluate(runs, estimates)
        assert reached["angle_rms_deg"] == pytest.approx(np.degrees(6e-3), rel=1e-9)
        assert reached["rate_rms_deg_s"] == pytest.approx(np.degrees(1e-4), rel=1e-9)
        assert reached["gyro_bias_rms_deg_s"] == 0.0
        assert reached["nees_per_dimension"] == pytest.approx((14.0 + 3.0) / 9.0, rel=1e-9)
        assert last_rows(runs) == slice(-60, None)

    def test_diverged(self) -> None:
        chosen = settings("st")
        runs, start = runs_for(chosen.sensors, 100.0, range(4))
        estimates = run_filter(runs, chosen, start)
        far = estimates.q.copy()
        far[1, 60] = quaternion.multiply(far[1, 60], quaternion.exp(np.radians([0.0, 11.0, 0.0])))
        far[2, 30] = quaternion.multiply(far[2, 30], quaternion.exp(np.radians([0.0, 11.0, 0.0])))
        far[3, 100] = np.nan
        assert evaluate(runs, replace(estimates, q=far))["diverged_runs"] == 2
