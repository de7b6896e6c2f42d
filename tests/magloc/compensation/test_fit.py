"""The fit of a platform: derivatives by finite differences, evidence and posterior by dense matrices."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray
from magloc.compensation.attitude import Attitude, AttitudeErrors, attitude_effects, platform_moduli
from magloc.compensation.fit import Background, LinearProblem
from magloc.compensation.log import PlatformLog
from magloc.compensation.signals import Signal
from magloc.compensation.terms import PlatformTerms
from tests.magloc.compensation.flights import Flight, Platform, array_of

ARRAY = array_of()


def flight(seed: int) -> tuple[FloatArray, FloatArray, PlatformTerms, FloatArray]:
    """Ambient fields and rates of a flight, terms, and coefficients in units of their priors."""
    rng = np.random.default_rng(seed)
    made = Flight.cloverleaf(rng)
    b = made.ambient()
    terms = PlatformTerms.of(ARRAY.sensors[0], (), 0.0)
    return b, CubicSpline(made.time_s, b)(made.time_s, 1), terms, rng.standard_normal(21)


def test_derivatives_by_the_coefficients() -> None:
    """Central differences of |b + h| - |b|; the gain is a convention of its own."""
    b, rate, terms, c = flight(11)
    none = np.zeros((len(b), 0))
    columns = platform_moduli(terms, c, b, rate, none)[1]
    for k in np.setdiff1d(np.arange(21), [terms.gain]):
        step = 1e-3 * np.eye(21)[k]
        sides = [platform_moduli(terms, c + sign * step, b, rate, none)[0] for sign in (-1.0, 1.0)]
        numeric = (sides[1] - sides[0]) / 2e-3
        np.testing.assert_allclose(columns[:, k], numeric, atol=1e-6 * np.abs(columns).max())


def test_derivatives_of_the_sensor_that_tells_the_attitude() -> None:
    """Its ambient field is what is left of its reading; solved for anew, and differences taken."""
    b, rate, terms, c = flight(12)
    time_s = 0.1 * np.arange(len(b))
    none = np.zeros((len(b), 0))
    reading = b + terms.fields(b, rate, none) @ c

    def ambient(coefficients: FloatArray) -> FloatArray:
        found = b
        for _ in range(6):
            turning = CubicSpline(time_s, found)(time_s, 1)
            found = reading - terms.fields(found, turning, none) @ coefficients
        return found

    columns = platform_moduli(terms, c, b, rate, none, time_s)[1]
    for k in (1, 5, 9, 10, 11, 14, 20):
        step = 1e-2 * np.eye(21)[k]
        sides = [np.linalg.norm(ambient(c + sign * step), axis=1) for sign in (-1.0, 1.0)]
        numeric = (sides[0] - sides[1]) / 2e-2
        size = np.abs(numeric).max()
        # Rates by another rule, and fields of the platform's field once more.
        np.testing.assert_allclose(columns[5:-5, k], numeric[5:-5], atol=0.02 * size + 1e-3 * np.abs(columns).max())


def test_effects_of_a_turned_attitude() -> None:
    """Against the model at an ambient field that is turned by a small angle."""
    b, rate, terms, c = flight(14)
    time_s, none, turn = 0.1 * np.arange(len(b)), np.zeros((len(b), 0)), 1e-4
    attitude = Attitude(Signal.of(time_s, b), np.eye(3), np.zeros(3), AttitudeErrors.of_turn(turn))
    columns = attitude_effects(attitude, time_s, terms, c, b, rate, none)
    assert columns.shape == (len(b), 3)
    numeric = []
    for axis in np.eye(3):
        turned = [Rotation.from_rotvec(sign * turn * axis) for sign in (-0.5, 0.5)]
        sides = [platform_moduli(terms, c, of.apply(b), of.apply(rate), none)[0] for of in turned]
        numeric.append(sides[1] - sides[0])
    for column, expected in zip(columns.T, numeric, strict=True):  # signs of the turns are free
        error = min(np.abs(column - sign * expected).max() for sign in (-1.0, 1.0))
        assert error < 0.01 * np.abs(expected).max()


class TestPosterior:
    """Against the whole covariance matrix of the readings."""

    def problem(self) -> tuple[LinearProblem, Background, FloatArray]:
        rng = np.random.default_rng(13)
        made = Flight.cloverleaf(rng)
        platforms = {sensor.id: Platform.draw(rng, sensor, 0.0) for sensor in ARRAY.sensors}
        rows = made.readings(ARRAY, platforms, rng)[:900]
        log = PlatformLog.of(ARRAY, rows, np.zeros((900, 0)))
        of = log.rows_of(ARRAY.sensors[0], log.attitude_of(ARRAY.sensors[1]))
        terms = PlatformTerms.of(ARRAY.sensors[0], (), 0.0)
        point = LinearProblem.at(of, terms, np.zeros(21), 0.0)
        background = Background(0.05, 0.02, 0.01)
        time, n = point.rows.time_s, len(point.rows.time_s)
        dt = np.diff(time, prepend=time[0])
        F = np.eye(3)
        P = np.diag([0.0, 1e8, 1e4])
        states, maps = [], []
        for step in dt:
            F = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, step], [0.0, 0.0, 1.0]])
            Q = np.diag([0.02**2 * step, 0.01**2 * step**3 / 3.0, 0.01**2 * step])
            P = F @ P @ F.T + Q
            states.append(P)
            maps.append(F)
        H = np.array([1.0, 1.0, 0.0])
        V = 0.05**2 * np.eye(n)
        for i in range(n):
            cross = states[i]
            for j in range(i, n):
                if j > i:
                    cross = maps[j] @ cross
                V[i, j] += H @ cross @ H
                V[j, i] = V[i, j]
        return point, background, V

    def test_mean_covariance_and_evidence(self) -> None:
        point, background, V = self.problem()
        A, y = point.columns_nT, point.samples_nT
        solved = point.solve(background)
        information = A.T @ np.linalg.solve(V, A) + np.eye(A.shape[1])
        covariance = np.linalg.inv(information)
        np.testing.assert_allclose(np.diagonal(solved.covariance), np.diagonal(covariance), rtol=2e-3)
        mean = covariance @ (A.T @ np.linalg.solve(V, y))
        assert (np.abs(solved.mean - mean) < 0.02 * np.sqrt(np.diagonal(covariance)) + 1e-6).all()
        whole = V + A @ A.T
        dense = np.linalg.slogdet(whole)[1] + y @ np.linalg.solve(whole, y)
        assert solved.minus_log_evidence == pytest.approx(dense, abs=0.5)  # of 900: the matrix loses eleven digits


def test_posterior_of_columns_that_are_nearly_equal() -> None:
    """Columns 1e9 times the noise and alike to rounding: their sum is known, their difference is the prior's."""
    time_s = 0.1 * np.arange(200.0)
    column = 1e9 * np.sin(time_s)
    rows = SimpleNamespace(time_s=time_s)
    empty = np.zeros(0)
    problem = LinearProblem(rows, column, np.column_stack([column, column]), empty, empty, 0, np.zeros(2))  # type: ignore[arg-type]
    found = problem.solve(Background.usual(1e-9))
    assert found.mean.sum() == pytest.approx(1.0)
    difference = np.array([1.0, -1.0])
    assert difference @ found.covariance @ difference == pytest.approx(2.0, rel=1e-6)
