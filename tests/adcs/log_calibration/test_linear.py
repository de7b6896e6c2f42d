"""Normal equations of a log, against finite differences of its residuals."""

import numpy as np
import pytest

from adcs.log_calibration.arrow import Solution
from adcs.log_calibration.fit import fit_log
from adcs.log_calibration.linear import LinearModel
from adcs.log_calibration.parameters import FieldPrior
from sims.attitude.flights import FlightSettings, simulate_flight
from tests.adcs.log_calibration.flights import FIELD_T


@pytest.fixture(scope="module")
def estimate():
    flight = simulate_flight(3, FlightSettings(duration_s=40.0, inertial_Hz=50.0, magnetometer_Hz=20.0))
    return fit_log(flight.log, FieldPrior.of(FIELD_T, 150e-9)).estimate


def gradient_along(estimate, states, parameters):
    """Return half the slope of the cost along a step, by central differences."""
    solution = Solution(states, parameters, np.zeros(0), np.zeros(0), 0.0)
    back = Solution(-states, -parameters, np.zeros(0), np.zeros(0), 0.0)
    return -(estimate.retract(solution).cost - estimate.retract(back).cost) / 4.0


def test_gradient_of_each_parameter(estimate):
    """Beside the optimum; the system neglects products of errors of the gyro, some percent there."""
    rng = np.random.default_rng(5)
    sigma = np.sqrt(np.diagonal(LinearModel.of(estimate).system(estimate.problem.noise).solve().covariance))
    shift = Solution(np.zeros_like(estimate.states), 0.3 * sigma * rng.normal(size=len(sigma)), sigma, sigma, 0.0)
    beside = estimate.retract(shift)
    system = LinearModel.of(beside).system(beside.problem.noise)
    zero = np.zeros_like(beside.states)
    scale = np.sqrt(np.diagonal(system.corner))
    for i, unit in enumerate(scale):
        step = np.zeros(len(scale))
        step[i] = 1e-2 / unit
        expected = gradient_along(beside, zero, step)
        assert system.corner_gradient @ step == pytest.approx(expected, rel=0.05, abs=0.01), i


@pytest.mark.parametrize("which", range(12))
def test_gradient_of_the_states(estimate, which):
    rng = np.random.default_rng(6)
    states = np.zeros_like(estimate.states)
    size = 1e-4 if which < 3 else 1e-5 if which < 6 else 0.1
    first = states.copy()
    first[:, which] = size * rng.normal(size=len(states))
    beside = estimate.retract(Solution(first, np.zeros(len(estimate.parameters)), first, first, 0.0))
    system = LinearModel.of(beside).system(beside.problem.noise)
    expected = gradient_along(beside, 0.1 * first, np.zeros(len(estimate.parameters)))
    assert np.sum(0.1 * first * system.gradient) == pytest.approx(expected, rel=0.05)
