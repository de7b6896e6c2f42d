"""The start-free search finds the maximum of the likelihood, whatever the array and wherever the source.

A fix fails if its best χ² is more than 0.05 above that of the optimum searched from the truth. `make test` runs a
thousand random problems of each kind, `make test-full` twenty thousand. The acceptance figure is 0.05 % of failures;
sensors in one line, whose readings tell least about the source, are allowed 0.1 %.
"""

from __future__ import annotations

import numpy as np
import pytest

from arrays.array import SensorArray
from arrays.geometries import square, tetrahedron
from arrays.sensor import Sensor
from arrays.whitening import whitening
from magloc.localization.fit import variable_projection_compiled
from magloc.measurement.whitened import WhitenedModel
from tests.magloc.localization.search.test_single_source import noisy_readings, refined
from tests.plain_locator import plain_locator


def seven_irregular_sensors():
    """Seven rotated sensors of unequal noise within about a metre."""
    rng = np.random.default_rng(7)
    sensors = []
    for i in range(7):
        q = rng.normal(size=4)
        sensors.append(
            Sensor(
                id=f"s{i + 1}",
                kind="vector",
                position_m=rng.uniform(-1.0, 1.0, 3),
                noise_T=1e-9 * rng.uniform(0.3, 3.0),
                rotation_xyzw=q / np.linalg.norm(q),
            )
        )
    return SensorArray(tuple(sensors))


def line_of_five():
    return SensorArray(
        tuple(Sensor(id=f"s{i}", kind="vector", position_m=(0.5 * i, 0.0, 0.0), noise_T=1e-9) for i in range(5))
    )


def board_of_thirty():
    positions = [(0.016 * i, 0.016 * j, 0.0) for i in range(5) for j in range(6)]
    return SensorArray(
        tuple(Sensor(id=f"s{i}", kind="vector", position_m=p, noise_T=1e-6) for i, p in enumerate(positions))
    )


CASES = {
    # array, nearest and farthest source [m], smallest and largest moment [A·m²]
    "tetrahedron 1.5 m": (tetrahedron(1.5, noise_T=1e-9), 2.0, 10.0, 50.0, 3000.0),
    "tetrahedron 0.5 m": (tetrahedron(0.5, noise_T=5e-11), 1.0, 4.0, 50.0, 3000.0),
    "seven irregular": (seven_irregular_sensors(), 2.0, 10.0, 50.0, 3000.0),
    "square 1 m": (square(1.0, noise_T=1e-9), 2.0, 10.0, 50.0, 3000.0),
    "line": (line_of_five(), 2.0, 10.0, 50.0, 3000.0),
    "board of thirty": (board_of_thirty(), 0.05, 0.2, 0.05, 5.0),
}


def random_problems(case, n, rng):
    array, nearest, farthest, weakest, strongest = CASES[case]
    u, m = rng.normal(size=(2, n, 3))
    p = array.centroid + rng.uniform(nearest, farthest, (n, 1)) * u / np.linalg.norm(u, axis=1, keepdims=True)
    m *= np.exp(rng.uniform(np.log(weakest), np.log(strongest), (n, 1))) / np.linalg.norm(m, axis=1, keepdims=True)
    return array, p, m


def failures(case, n, seed):
    rng = np.random.default_rng(seed)
    array, p, m = random_problems(case, n, rng)
    readings = noisy_readings(array, p, m, rng)
    problem = WhitenedModel.of(array, [whitening(array)], array.ambient_fields[None])
    failed = []
    for i, fix in enumerate(plain_locator(array).fit_rows(readings)):
        y = whitening(array).apply(readings[i])
        chi2, _, end = refined(problem, problem.homogeneous(p[i]), y, np.empty(3), 300)
        if end == variable_projection_compiled.CONVERGED and not (
            fix.solutions and fix.solutions[0].chi2 <= chi2 + 0.05
        ):
            failed.append(i)
    return failed


@pytest.mark.parametrize("case", CASES)
def test_a_thousand_problems(case):
    """False alarms at the acceptance figures: 0.2 % (more than three of a thousand at 0.05 %)."""
    assert len(failures(case, 1000, seed=1)) <= (5 if case == "line" else 3)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_twenty_thousand_problems(case):
    assert len(failures(case, 20_000, seed=2)) <= (20 if case == "line" else 10)
