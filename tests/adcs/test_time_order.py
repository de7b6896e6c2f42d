"""A result at an instant has used all that was read up to it.

A body that turns, exact readings, no start error: what is left is the step's own error, which falls with its square. An
estimate that is late by a sample, or by half of one, has an error that falls with the step itself.
"""

import math
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import adcs
from adcs import quaternion
from adcs.complementary.adaptive import AdaptiveTuning
from adcs.complementary.explicit import Gains
from adcs.satellite.vector_record import GYRO_SAMPLES, step_rates, steps_s

UP, FIELD_T = np.array([0.0, 0.0, 9.81]), np.array([0.0, 18e-6, -45e-6])
STEPS_S = (0.04, 0.02, 0.01)
LAST_S = 8.0


def angle(t):
    """Integral of the body's rate: at rest until 2 s, then about three axes at once."""
    moving = np.clip(np.asarray(t, dtype=np.float64) - 2.0, 0.0, None)[..., None]
    amplitude, frequency = np.array([0.5, 0.4, 0.6]), np.array([1.3, 1.7, 0.9])
    return amplitude * (1.0 - np.cos(frequency * moving)) / frequency


def rate(t):
    """Of the body, its own axes."""
    moving = np.clip(np.asarray(t, dtype=np.float64) - 2.0, 0.0, None)[..., None]
    return np.array([0.5, 0.4, 0.6]) * np.sin(np.array([1.3, 1.7, 0.9]) * moving)


@cache
def motion():
    """Reference from body at any time, by SciPy's integrator."""

    def slope(t, q):
        return quaternion.derivative(q, rate(t))

    options = {"rtol": 1e-12, "atol": 1e-12, "max_step": 0.2, "dense_output": True}
    return solve_ivp(slope, (0.0, LAST_S + 1.0), quaternion.IDENTITY, "DOP853", **options).sol


def attitudes(time_s):
    """Reference from body."""
    return quaternion.normalised(motion()(time_s).T)


def gyro(time_s, samples):
    """What it reads."""
    if samples == "point":
        return rate(time_s)
    means = np.diff(angle(time_s), axis=0) / np.diff(time_s)[:, None]
    return np.concatenate([means[:1], means])


def times(step_s, jitter):
    """From 0 on; with jitter by up to a third of a step, the same parts of it whatever the step."""
    time_s = step_s * np.arange(round(LAST_S / step_s) + 1)
    return time_s + jitter * step_s * np.sin(7.0 * np.arange(len(time_s))) / 3.0


def assert_second_order(errors):
    """Halved steps make a quarter of it, or a third at least, not half."""
    assert errors[-1] < math.radians(0.05)
    for longer, shorter in pairwise(errors):
        assert longer / shorter > 3.0


@pytest.mark.parametrize("jitter", [0.0, 1.0])
@pytest.mark.parametrize("samples", GYRO_SAMPLES)
class TestComplementary:
    @pytest.mark.parametrize(
        ("method", "settings"),
        [
            ("explicit", Gains(0.05, 0.0)),
            ("gauss-newton", Gains(0.05, 0.0)),
            ("adaptive", AdaptiveTuning(first_sigma=1.0, second_sigma_rad=0.3)),
        ],
    )
    def test_vectors_and_gyro(self, method, settings, samples, jitter):
        errors = []
        for step_s in STEPS_S:
            time_s = times(step_s, jitter)
            q = attitudes(time_s)
            vectors = [quaternion.rotate_back(q, v) for v in (UP, FIELD_T)]
            track = adcs.complementary_filter(
                time_s,
                gyro(time_s, samples),
                vectors,
                [UP, FIELD_T],
                method=method,
                settings=settings,
                gyro_samples=samples,
            )
            errors.append(quaternion.angle_between(track.q, q).max())
        assert_second_order(errors)

    def test_inertial_unit(self, samples, jitter):
        errors = []
        for step_s in STEPS_S:
            time_s = times(step_s, jitter)
            q = attitudes(time_s)
            track = adcs.inertial_magnetic_filter(
                time_s,
                gyro(time_s, samples),
                quaternion.rotate_back(q, UP),
                quaternion.rotate_back(q, FIELD_T),
                magnet="kept",
                gyro_samples=samples,
            )
            errors.append(quaternion.angle_between(track.q, q).max())
        assert_second_order(errors)

    def test_what_it_would_notice(self, samples, jitter):
        """Samples of the one kind taken for the other are half a step wrong: an error that falls with the step."""
        other = next(kind for kind in GYRO_SAMPLES if kind != samples)
        errors = []
        for step_s in STEPS_S:
            time_s = times(step_s, jitter)
            q = attitudes(time_s)
            vectors = [quaternion.rotate_back(q, v) for v in (UP, FIELD_T)]
            readings = time_s, gyro(time_s, samples), vectors, [UP, FIELD_T]
            track = adcs.complementary_filter(*readings, settings=Gains(0.05, 0.0), gyro_samples=other)
            errors.append(quaternion.angle_between(track.q, q).max())
        with pytest.raises(AssertionError):
            assert_second_order(errors)


class TestGyroDriven:
    def test_coasts_on_the_gyro(self):
        """The star tracker has the first readings only."""
        satellite = adcs.datasets.load("satellite").satellite
        errors = []
        for step_s in (0.2, 0.1, 0.05):
            time_s = times(step_s, 0.0)
            q = attitudes(time_s)
            star = np.where(time_s[:, None] < 1.9, q, np.nan)[:, [1, 2, 3, 0]]
            telemetry = adcs.Telemetry(time_s, star=star, gyro_rad_s=rate(time_s))
            track = adcs.estimate(telemetry, satellite, sensors="st+gyro", filter="reduced")
            errors.append(quaternion.angle_between(track.q, q).max())
        assert_second_order(errors)


class TestStepRates:
    """Of a gyro with gaps and of several rates."""

    def test_no_turn_is_lost(self):
        rng = np.random.default_rng(0)
        dt_s = steps_s(np.cumsum(rng.uniform(0.05, 0.15, 200)))
        every = np.arange(200) % 3 == 0
        rates = np.where(every[:, None], rng.standard_normal((200, 3)), np.nan)
        turned = np.cumsum(step_rates(rates, dt_s) * dt_s[:, None], axis=0)
        rows = np.flatnonzero(every)
        expected = np.cumsum(rates[rows[1:]] * np.diff(np.cumsum(dt_s)[rows])[:, None], axis=0)
        np.testing.assert_allclose(turned[rows[1:]] - turned[0], expected, atol=1e-12)

    def test_nothing_is_used_before_it_is_read(self):
        rates = np.where(np.arange(9)[:, None] % 3 == 0, np.arange(9.0)[:, None], np.nan) * np.ones(3)
        changed = rates.copy()
        changed[6:] += 1.0
        dt_s = steps_s(np.arange(9.0))
        np.testing.assert_array_equal(step_rates(rates, dt_s)[:6], step_rates(changed, dt_s)[:6])

    def test_across_a_gap(self):
        """A sample says nothing of what was long before it."""
        time_s = np.array([0.0, 1.0, 2.0, 3.0, 13.0, 14.0])
        rates = np.outer([1.0, 1.0, 1.0, 1.0, 3.0, 3.0], np.ones(3))
        np.testing.assert_allclose(step_rates(rates, steps_s(time_s))[:, 0], [1.0, 1.0, 1.0, 1.0, 2.0, 3.0])

    def test_refusals(self):
        with pytest.raises(ValueError, match="samples must be one of mean, point; instead received 'means'"):
            step_rates(np.zeros((3, 3)), np.ones(3), "means")
        with pytest.raises(ValueError, match="gyro_rad_s must have a reading at the first instant"):
            step_rates(np.full((3, 3), np.nan), np.ones(3))
