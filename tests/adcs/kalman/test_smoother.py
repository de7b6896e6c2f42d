"""Tests of adcs.kalman.smoother: a least-squares solution of all rows at once, and what smoothing gains."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from adcs import quaternion
from adcs.kalman.error_state import FilterSettings, FilterStart, ProcessNoise
from adcs.kalman.mekf import initial_state, predict, run_filter, stacked_residuals
from adcs.kalman.smoother import smooth
from sims.attitude.simulation import AttitudeRuns, simulate
from sims.experiments.accuracy import errors, normalised_error_squared
from tests.adcs.filter_runs import runs_for, settings, start_of, tabletsat

Array = NDArray[np.float64]
CASES = [("st", ("disturbance",)), ("mag+sun", ("disturbance",)), ("mag+sun+gyro", ("gyro-bias", "disturbance"))]


def least_squares(runs: AttitudeRuns, chosen: FilterSettings, start: FilterStart) -> tuple[Array, Array]:
    """Errors of the best estimates against the truth, (n, N), and their covariance (n, N, N), of the first run.

    All rows at once, linearised at the truth: unknown is what an estimate is away from it. Without disturbances the
    truth follows the equations of motion exactly, so that Φ alone connects the rows.
    """
    n, size = runs.q.shape[1], chosen.sensors.size
    true = replace(initial_state(chosen, start), q=runs.q[:, 0], w=runs.w[:, 0])
    prior = initial_state(chosen, start)
    offset = np.zeros(size)
    # The estimate is the truth with the error -(truth - estimate) put in.
    offset[:3] = -quaternion.error_vector(start.q[0], runs.q[0, 0])
    offset[3:6] = start.w[0] - runs.w[0, 0]
    rows, values = [], []

    def add(blocks: dict[int, Array], value: Array, root: Array) -> None:
        row = np.zeros((len(value), n * size))
        for at, block in blocks.items():
            row[:, at * size : (at + 1) * size] = block
        rows.append(root @ row)
        values.append(root @ value)

    add({0: np.eye(size)}, offset, np.diag(1.0 / np.sqrt(np.diagonal(prior.P[0]))))
    for i in range(n):
        at = replace(true, q=runs.q[:, i], w=runs.w[:, i])
        H, residual = stacked_residuals(runs, i, at, chosen)
        add({i: H[0]}, residual[0], np.eye(len(residual[0])))
        if i < n - 1:
            _, Phi = predict(runs, i, at, chosen)
            root = np.diag(1.0 / np.sqrt(chosen.process_variance(runs.dt_s, runs.dt_s)))
            add({i: -Phi[0], i + 1: np.eye(size)}, np.zeros(size), root)
    A, b = np.concatenate(rows), np.concatenate(values)
    scale = 1.0 / np.linalg.norm(A, axis=0)
    inverse = np.linalg.pinv(A * scale)
    solution = (scale * (inverse @ b)).reshape(n, size)
    covariance = scale[:, None] * (inverse @ inverse.T) * scale
    blocks = covariance.reshape(n, size, n, size)[np.arange(n), :, np.arange(n)]
    return solution, blocks


class TestLeastSquares:
    @pytest.mark.parametrize(("sensors", "states"), CASES)
    def test_smoother_is_the_least_squares_solution(self, sensors: str, states: tuple[str, ...]) -> None:
        noise = ProcessNoise(1e-6, 1e-5, gyro_bias_rad_s=1e-5, disturbance_s2=1e-7)
        chosen = FilterSettings(settings(sensors, states).sensors, noise, gyro_bias_sigma_rad_s=1e-4)
        runs = simulate(replace(tabletsat(12.0), torque_Nm=0.0), [7])
        start = start_of(runs, math.radians(0.02), math.radians(0.01))
        estimates = smooth(runs, run_filter(runs, chosen, start))
        solution, covariance = least_squares(runs, chosen, start)
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
        # Errors of 0.02° are linear to 1e-7; the smoother's are against the estimate, hence the sign.
        np.testing.assert_allclose(-errors(runs, estimates)[0] / sigma, solution / sigma, rtol=0, atol=5e-3)
        np.testing.assert_allclose(estimates.sigma[0], sigma, rtol=1e-3)


class TestGain:
    @pytest.mark.parametrize(("sensors", "states"), CASES)
    def test_middle_of_a_record(self, sensors: str, states: tuple[str, ...]) -> None:
        """Twice as accurate as the filter in the middle of 300 s, and consistent; nothing changes at the end."""
        chosen = settings(sensors, states)
        runs, start = runs_for(chosen.sensors, 300.0)
        estimates = run_filter(runs, chosen, start)
        better = smooth(runs, estimates)
        middle = slice(120, 180)
        rms = [
            np.sqrt(np.mean(errors(runs, one)[:, middle, :3] ** 2, axis=1)).mean(axis=0).max()
            for one in (estimates, better)
        ]
        assert rms[1] < 0.5 * rms[0]
        nees = normalised_error_squared(runs, better)[:, middle].mean() / chosen.sensors.size
        assert 0.3 < nees < 1.6
        np.testing.assert_array_equal(better.q[:, -1], estimates.q[:, -1])
        assert (better.sigma <= estimates.sigma * (1.0 + 1e-9)).all()
