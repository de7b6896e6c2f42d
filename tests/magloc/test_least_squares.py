"""Tests of magloc.least_squares.

| what | who checks it |
|---|---|
| the optimum of a curved valley | SciPy's least_squares |
| a linear problem | one step without damping is the solution of NumPy's lstsq |
| what a step promises | the fall of a linear problem's cost, of any damping |
| no step lowers the cost | it says so |
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import pytest
import scipy.optimize

from arrays.typing import FloatArray
from magloc.least_squares import damped_step, minimise


@dataclass(frozen=True, eq=False)
class Valley:
    """Rosenbrock's, curved the more the larger the bend."""

    x: FloatArray
    bend: float = 10.0
    sign: float = 1.0

    @cached_property
    def residual(self) -> FloatArray:
        return valley(self.x, self.bend)

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)

    def step(self, damping: float) -> tuple[Valley, float]:
        J = np.array([[-2.0 * self.bend * self.x[0], self.bend], [-1.0, 0.0]])
        step, promised = damped_step(J.T @ J, self.sign * J.T @ self.residual, damping)
        return replace(self, x=self.x + step), promised


def valley(x: FloatArray, bend: float) -> FloatArray:
    return np.array([bend * (x[1] - x[0] ** 2), 0.5 - x[0]])


@pytest.mark.parametrize("bend", [1.0, 10.0, 300.0])
def test_a_curved_valley(bend: float) -> None:
    start = np.array([-1.2, 1.0])
    found = minimise(Valley(start, bend), lambda _: 1e-20, max_iterations=500)
    expected = scipy.optimize.least_squares(valley, start, args=(bend,), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert found.converged
    np.testing.assert_allclose(found.point.x, expected.x, atol=1e-8)


def test_a_step_down_the_wrong_way_does_not_converge() -> None:
    found = minimise(Valley(np.array([-1.2, 1.0]), sign=-1.0), lambda _: 1e-20)
    assert not found.converged
    assert found.iterations == 1
    np.testing.assert_array_equal(found.point.x, [-1.2, 1.0])


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
def test_a_linear_problem(damping: float) -> None:
    rng = np.random.default_rng(1)
    unit, of_size_one, r = np.geomspace(1e-6, 1e6, 6), rng.normal(size=(20, 6)), rng.normal(size=20)
    J = of_size_one * unit
    step, promised = damped_step(J.T @ J, J.T @ r, damping)
    fall = r @ r - np.sum((r + J @ step) ** 2)
    assert 0.0 < promised <= fall * (1.0 + 1e-9)
    if damping == 0.0:
        np.testing.assert_allclose(step, np.linalg.lstsq(of_size_one, -r, rcond=None)[0] / unit, rtol=1e-8)
        assert promised == pytest.approx(fall)
