"""Fields of loads that switch, on a simulated satellite of three units that tumbles: truth and noise are known."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from adcs.kalman.error_state import FilterSettings, ProcessNoise, sensor_set, start_near
from adcs.kalman.mekf import run_filter
from adcs.satellite.own_fields import WINDOW_S, OwnFields, StateLag, _windows, find_own_fields
from sims.attitude.simulation import start_estimates
from sims.experiments import accuracy
from sims.experiments.loads import LOADS, NOISE_T, LoadsRun, switching_loads

Array = NDArray[np.float64]


def found(run: LoadsRun, readings_T: Array | None = None) -> OwnFields:
    values = run.readings_T if readings_T is None else readings_T
    return find_own_fields(run.array, values, run.time_s, run.gyro_rad_s, run.states)


@pytest.fixture(scope="module")
def flown() -> LoadsRun:
    return switching_loads(rng=0)


class TestFields:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("rate_deg_s", [0.4, 2.0, 8.0])
    def test_what_is_left_is_far_below_the_noise(self, rate_deg_s: float) -> None:
        """The figure asked for is 0.5 σ at the magnetometer of the attitude; NEES of all fields, 6 × 24 numbers."""
        left, nees = [], []
        for seed in range(6):
            run = switching_loads(seed, rate_deg_s=rate_deg_s)
            own = found(run)
            error = own.vectors_T - run.fields_T
            left.append(np.sqrt(np.mean(error[:, 0] ** 2)) / NOISE_T)
            nees.append(np.mean((error / own.sigma_T) ** 2))
        assert max(left) < 0.5
        assert 0.6 < np.mean(nees) < 1.4  # false-alarm rate 1e-3 of 144 independent numbers

    def test_subtracted_is_the_quiet_satellite(self, flown: LoadsRun) -> None:
        before = np.abs(flown.readings_T - flown.quiet_T).max()
        after = np.abs(found(flown).subtracted(flown.readings_T, flown.states) - flown.quiet_T).max()
        assert before > 20.0 * NOISE_T
        assert after < NOISE_T

    def test_nothing_is_found_where_nothing_is(self, flown: LoadsRun) -> None:
        own = found(flown, flown.quiet_T)
        assert np.abs(own.vectors_T / own.sigma_T).max() < 4.5  # false-alarm rate 2e-4

    def test_gain_and_axes_of_the_file_do_not_matter(self, flown: LoadsRun) -> None:
        """A sensor that is mounted otherwise, and reads so, has the same field in body axes."""
        turned = replace(flown.array.sensors[1], rotation_xyzw=(0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)))
        array = replace(flown.array, sensors=(flown.array.sensors[0], turned, *flown.array.sensors[2:]))
        readings = array.readings_of(flown.array.calibrated_field(flown.readings_T))
        other = find_own_fields(array, readings, flown.time_s, flown.gyro_rad_s, flown.states)
        np.testing.assert_allclose(other.vectors_T, found(flown).vectors_T, rtol=0, atol=1e-15)

    def test_missing_readings(self, flown: LoadsRun) -> None:
        readings = flown.readings_T.copy()
        readings[100:400, 5] = np.nan
        error = found(flown, readings).vectors_T - flown.fields_T
        assert np.abs(error).max() < 2.0 * NOISE_T


def early(run: LoadsRun, rows: int, also_one_more: float = 0.0) -> LoadsRun:
    """The run with its states some rows before the field, of a share of the switches one more."""
    rng, states = np.random.default_rng(4), {}
    for name, values in run.states.items():
        shifted = np.full(len(values), values[0])
        for switch in np.flatnonzero(np.diff(values)) + 1:
            shifted[max(switch - rows - int(rng.random() < also_one_more), 0) :] = values[switch]
        states[name] = shifted
    return replace(run, states=states)


class TestLag:
    @pytest.mark.parametrize("rows", [-9, -1, 1, 3, 20])
    def test_whole_rows(self, rows: int) -> None:
        """Fields within 4.5 σ (false-alarm rate 2e-4), with the lag and a word on it."""
        run = switching_loads(rng=20, duration_s=600.0, rate_deg_s=2.0)
        own = found(early(run, rows))
        assert (own.lag.least_rows, own.lag.most_rows, own.lag.seconds) == (rows, rows, float(rows))
        assert np.abs((own.vectors_T - run.fields_T) / own.sigma_T).max() < 4.5
        assert own.chi2_per_dof < 1.3
        assert ("later" if rows > 0 else "earlier") in own.warnings[0]
        rest = own.subtracted(run.readings_T, early(run, rows).states) - run.quiet_T
        assert np.nanmax(np.abs(rest)) < 3.0 * NOISE_T
        assert np.isnan(rest).any(axis=1).sum() == abs(rows)  # whose state was before the log, or comes after it

    @pytest.mark.parametrize(("rows", "share"), [(0, 0.4), (-3, 0.5), (2, 0.2)])
    def test_between_two_rows(self, rows: int, share: float) -> None:
        run = switching_loads(rng=21, duration_s=900.0)
        own = found(early(run, rows, share))
        assert (own.lag.least_rows, own.lag.most_rows) == (rows, rows + 1)
        assert np.abs((own.vectors_T - run.fields_T) / own.sigma_T).max() < 4.5

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("seeds", [range(30, 34), range(34, 42)])
    def test_none_is_claimed_of_one_clock(self, seeds: range) -> None:
        """False-alarm rate below 1e-5 a log."""
        for seed in seeds:
            own = found(switching_loads(seed, duration_s=200.0 + 50.0 * (seed % 5), rate_deg_s=(0.4, 8.0)[seed % 2]))
            assert own.lag.is_known
            assert own.lag.least_rows == own.lag.most_rows == 0
            assert own.warnings == ()

    def test_rows_are_missing(self) -> None:
        """A clock is off by seconds, not by rows."""
        run = early(switching_loads(rng=22, duration_s=900.0), -4)
        rows = np.flatnonzero(np.random.default_rng(1).random(len(run.time_s)) < 0.85)
        states = {name: values[rows] for name, values in run.states.items()}
        own = find_own_fields(run.array, run.readings_T[rows], run.time_s[rows], run.gyro_rad_s[rows], states)
        assert own.lag.seconds == -4.0
        assert np.abs((own.vectors_T - run.fields_T) / own.sigma_T).max() < 4.5

    def test_says_that_it_cannot_be_told(self, flown: LoadsRun) -> None:
        own = found(early(flown, 1), flown.quiet_T)
        assert not own.lag.is_known
        assert "do not tell" in own.warnings[0]

    def test_a_clock_of_one_load_is_a_misfit(self, flown: LoadsRun) -> None:
        states = dict(flown.states) | {"heater": early(flown, 3).states["heater"]}
        own = find_own_fields(flown.array, flown.readings_T, flown.time_s, flown.gyro_rad_s, states)
        assert "missing or late in the log" in own.warnings[-1]

    @given(st.integers(0, 10_000), st.integers(-5, 5), st.integers(0, 2))
    def test_states_within_the_bounds(self, seed: int, least: int, width: int) -> None:
        """As every row's window of states says, of equal steps."""
        rng = np.random.default_rng(seed)
        n, step_s = int(rng.integers(3, 40)), float(rng.choice([0.02, 0.3, 7.0]))
        s = np.cumsum(rng.random((n, 2)) < 0.1, axis=0) % 2.0
        delayed = StateLag(least, least + width, step_s, is_known=True).delay(step_s * np.arange(n), s)
        for row in range(n):
            window = s[max(row - least - width, 0) : max(row - least + 1, 0)]
            # Strictly between two rows there is none of its own, and both beside it count.
            whole = row - least - width >= 0 and row - least < n and (window == window[0]).all()
            np.testing.assert_array_equal(delayed[row], s[row - least] if whole else [np.nan, np.nan])


class TestPlaces:
    def test_loads_are_named_by_them(self) -> None:
        """Within 15 mm was asked for."""
        for seed in range(6):
            for name, fix in found(switching_loads(seed)).located().items():
                place, moment = LOADS[name]
                assert np.linalg.norm(fix.best.position_m - place) < 5e-3
                assert np.linalg.norm(fix.best.moment_Am2 - moment) < 0.1 * np.linalg.norm(moment)

    def test_two_magnetometers_are_not_enough(self, flown: LoadsRun) -> None:
        two = flown.array.subset(["m1", "m2"])
        own = find_own_fields(two, flown.readings_T[:, :6], flown.time_s, flown.gyro_rad_s, flown.states)
        np.testing.assert_allclose(own.vectors_T[:, 0], flown.fields_T[:, 0], atol=NOISE_T)
        with pytest.raises(ValueError, match="3 magnetometers"):
            own.located()


def attitude(run: LoadsRun, field_T: Array, dipole_Am2: Array) -> tuple[float, float]:
    """Rms [°] and NEES of the attitude per axis after ten minutes, with a field at the first magnetometer."""
    used = sensor_set("mag+sun+gyro", ["gyro-bias", "magnetometer"])
    settings = FilterSettings(
        used,
        ProcessNoise(1e-8, 3e-5),
        field_bias_sigma_T=100e-9,
        gyro_bias_sigma_rad_s=math.radians(0.02),
        field_gain_sigma=0.01,
        field_axes_sigma_rad=math.radians(0.5),
    )
    errors = math.radians(5.0), math.radians(0.1)
    readings = replace(run.run.readings, field_T=field_T[:, :3][None])
    runs = replace(run.run, readings=readings, torquers_Am2=dipole_Am2[None])
    tracks = run_filter(runs, settings, start_near(*start_estimates(runs.prepared, *errors), *errors))
    e, P = accuracy.errors(runs, tracks)[0, 600:, :3], tracks.covariance[0, 600:, :3, :3]
    nees = np.einsum("ni,nij,nj->n", e, np.linalg.inv(P), e).mean() / 3.0
    return float(np.sqrt(np.mean(accuracy.error_norm_deg(runs, tracks)[0, 600:] ** 2))), float(nees)


def moments(states: Mapping[str, Array], each: Mapping[str, Array]) -> Array:
    return np.asarray(sum(states[name][:, None] * moment for name, moment in each.items()))


@pytest.mark.slow
def test_the_attitude_is_that_of_the_quiet_satellite() -> None:
    """Fields subtracted, torques by the moments of the located dipoles: within 5 %, NEES at most 1.3."""
    quiet, cleaned, nees, as_read = [], [], [], []
    for seed in range(8):
        run = switching_loads(seed, duration_s=4800.0)
        own = found(run)
        true = moments(run.states, {name: np.array(moment) for name, (_, moment) in LOADS.items()})
        known = moments(run.states, {name: fix.best.moment_Am2 for name, fix in own.located().items()})
        quiet.append(attitude(run, run.quiet_T, true)[0])
        cleaned_deg, of_cleaned = attitude(run, own.subtracted(run.readings_T, run.states), known)
        cleaned.append(cleaned_deg)
        nees.append(of_cleaned)
        as_read.append(attitude(run, run.readings_T, true)[0])
    assert np.sqrt(np.mean(np.square(cleaned))) < 1.05 * np.sqrt(np.mean(np.square(quiet)))
    assert np.mean(nees) < 1.3
    assert min(as_read) > 3.0


@given(st.integers(0, 10_000))
def test_a_row_belongs_to_the_nearest_switch(seed: int) -> None:
    """As every distance compared with every other says, which a long log has no memory for."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(20, 200))
    times, used = np.cumsum(rng.choice([0.5, 1.0, 3.0], n)), rng.random(n) < 0.9
    states = np.cumsum(rng.random((n, 2)) < 0.05, axis=0) % 2.0
    changed = np.flatnonzero(np.diff(states, axis=0).any(axis=1))
    away = np.abs(times[:, None] - 0.5 * (times[changed] + times[changed + 1]))
    near = used & (away.min(axis=1, initial=math.inf) <= WINDOW_S)
    rows = [np.flatnonzero(near & (away.argmin(axis=1) == k)) for k in range(len(changed))]
    expected = [of_switch.tolist() for of_switch in rows if len(of_switch) >= 6]
    assert [of_switch.tolist() for of_switch in _windows(times, states, used, WINDOW_S)] == expected


class TestRefusals:
    def test_a_load_that_never_switches(self, flown: LoadsRun) -> None:
        states = dict(flown.states) | {"beacon": np.ones(len(flown.time_s))}
        with pytest.raises(ValueError, match="beacon, whose field"):
            find_own_fields(flown.array, flown.readings_T, flown.time_s, flown.gyro_rad_s, states)

    def test_two_that_always_switch_together(self, flown: LoadsRun) -> None:
        states = dict(flown.states) | {"fan": flown.states["radio"]}
        with pytest.raises(ValueError, match="apart from those of others"):
            find_own_fields(flown.array, flown.readings_T, flown.time_s, flown.gyro_rad_s, states)

    def test_no_switch(self, flown: LoadsRun) -> None:
        with pytest.raises(ValueError, match="must change where there are readings"):
            find_own_fields(
                flown.array, flown.readings_T, flown.time_s, flown.gyro_rad_s, {"fan": np.ones(len(flown.time_s))}
            )

    def test_a_dummy_of_a_state(self, flown: LoadsRun) -> None:
        states = dict(flown.states) | {"radio": np.where(flown.states["radio"] > 0.0, -1e15, 0.0)}
        with pytest.raises(ValueError, match=r"received radio with shape .* up to 1e"):
            find_own_fields(flown.array, flown.readings_T, flown.time_s, flown.gyro_rad_s, states)

    def test_shapes(self, flown: LoadsRun) -> None:
        with pytest.raises(ValueError, match="readings_T must have shape"):
            find_own_fields(flown.array, flown.readings_T[:5], flown.time_s, flown.gyro_rad_s, flown.states)
