"""Scalar sensors, and two sources at once, against scipy.optimize.least_squares from several starts."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from scipy.optimize import least_squares

from arrays.array import SensorArray
from arrays.sensor import Sensor
from magloc.localization.locator import Locator
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels
from tests.bench.fixes import REACHED, best_fit, multi_start, random_directions
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved
from tests.plain_locator import plain_locator

TITLE = "several sources and scalar sensors, no start given, 1 thread"


def rows(size: Size) -> Iterator[Row]:
    """Ours from its own search, the peer from random positions with the best moments at each.

    The peer has our measurement model and its analytic Jacobian, in NumPy, and MINPACK's Levenberg-Marquardt iteration.
    """
    yield scalar_sensors(size)
    yield two_sources(size)


def scalar_sensors(size: Size) -> Row:
    """Twelve scalar sensors in 50 µT, 0.01 nT, a source of 300 A·m² at 2.8 to 5 m."""
    rng = np.random.default_rng(5)
    places = rng.uniform(-1.5, 1.5, (12, 3))
    array = SensorArray(
        tuple(Sensor(f"s{i}", "scalar", tuple(place), 1e-11) for i, place in enumerate(places)),
        ambient_T=(2e-5, 0.0, 4.5e-5),
    )
    measurement = DifferenceMeasurement.of(array)
    n = size.problems
    truths = random_directions(rng, n) * rng.uniform(2.8, 5.0, (n, 1))
    moments = random_directions(rng, n) * 300.0
    readings = predicted_channels(array, truths, moments) + rng.normal(scale=1e-11, size=(n, 12))
    z = measurement.measured(readings)
    best = [2.0 * best_fit(measurement, z[i], np.concatenate([truths[i], moments[i]])).cost for i in range(n)]
    starts = random_directions(rng, 6) * rng.uniform(1.0, 8.0, (6, 1))

    def peer(problems: np.ndarray) -> list[float]:
        return [2.0 * multi_start(measurement, row, starts).cost for row in problems]

    what = f"a fix by 12 scalar sensors, {n} at once"
    return compared(what, "scipy, 6 starts", size, plain_locator(array), readings, peer, z, best)


def two_sources(size: Size) -> Row:
    """Sixteen vector sensors on a plate of 2 m, 0.5 nT, two sources of 5 to 20 A·m² at 0.8 to 1.8 m."""
    rng = np.random.default_rng(6)
    line = np.linspace(-1.0, 1.0, 4)
    places = np.stack(np.meshgrid(line, line, [0.0]), axis=-1).reshape(-1, 3)
    array = SensorArray(tuple(Sensor(f"v{i}", "vector", tuple(place), 5e-10) for i, place in enumerate(places)))
    measurement = DifferenceMeasurement.of(array)
    n = size.problems
    positions = np.concatenate([rng.uniform(-1.0, 1.0, (n, 2, 2)), -rng.uniform(0.8, 1.8, (n, 2, 1))], axis=-1)
    moments = random_directions(rng, 2 * n).reshape(n, 2, 3) * rng.uniform(5.0, 20.0, (n, 2, 1))
    readings = sum(predicted_channels(array, positions[:, k], moments[:, k]) for k in range(2))
    readings = readings + rng.normal(scale=5e-10, size=(n, 48))
    sigma = np.sqrt(measurement.variance)
    z = measurement.measured(readings) / sigma

    def fit(row: np.ndarray, start: np.ndarray) -> float:
        def residual(x: np.ndarray) -> np.ndarray:
            return sum(measurement.predicted(x[i : i + 3], x[i + 3 : i + 6]) for i in (0, 6)) / sigma - row

        def jacobian(x: np.ndarray) -> np.ndarray:
            blocks = [measurement.jacobian(x[i : i + 3], x[i + 3 : i + 6]) for i in (0, 6)]
            return np.concatenate(blocks, axis=1) / sigma[:, None]

        return 2.0 * float(least_squares(residual, start, jacobian, method="lm", x_scale="jac").cost)

    def start_at(row: np.ndarray, pair: np.ndarray) -> np.ndarray:
        by_moment = np.concatenate([measurement.jacobian(p, np.zeros(3))[:, 3:] for p in pair], axis=1) / sigma[:, None]
        moment = np.linalg.lstsq(by_moment, row)[0]
        return np.concatenate([pair[0], moment[:3], pair[1], moment[3:]])

    best = [
        fit(z[i], np.concatenate([positions[i, 0], moments[i, 0], positions[i, 1], moments[i, 1]])) for i in range(n)
    ]
    pairs = np.concatenate([rng.uniform(-1.0, 1.0, (20, 2, 2)), -rng.uniform(0.5, 2.0, (20, 2, 1))], axis=-1)

    def peer(problems: np.ndarray) -> list[float]:
        return [min(fit(row, start_at(row, pair)) for pair in pairs) for row in problems]

    what = f"two sources by 16 vector sensors, {n} at once"
    return compared(what, "scipy, 20 starts", size, plain_locator(array, sources=2), readings, peer, z, best)


def compared(
    what: str,
    of_peer: str,
    size: Size,
    locator: Locator,
    readings: np.ndarray,
    peer: Callable[[np.ndarray], list[float]],
    z: np.ndarray,
    best: list[float],
) -> Row:
    """Our fixes of readings against the peer's of their differences, and how many of both are the optimum."""
    ours = [fix.solutions[0].chi2 if fix.solutions else np.inf for fix in locator.fit_rows(readings)]
    timed = size.timed(z)
    timings = interleaved(
        {
            "ours": Contestant(lambda: locator.fit_rows(readings), 1, len(readings)),
            "scipy": Contestant(lambda: peer(timed), 1, len(timed)),
        },
        size.rounds,
    )
    found = f"optimum found: ours {reached(ours, best)}, peer {reached(peer(z), best)}"
    return Row(what, timings["ours"], of_peer, timings["scipy"], found)


def reached(chi2: list[float], best: list[float]) -> str:
    """How many fits reach the optimum found from the truth, or a better one."""
    return f"{int(np.sum(np.asarray(chi2) < np.asarray(best) + REACHED))}/{len(best)}"
