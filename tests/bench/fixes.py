"""One fix without a start, against scipy.optimize.least_squares from several starts."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from arrays.array import SensorArray
from arrays.geometries import grid, tetrahedron
from arrays.sensor import Sensor
from magloc import core
from magloc.bodies.filter import BodyTracker
from magloc.bodies.locator import BodyLocator
from magloc.directions import fibonacci_directions
from magloc.fields.shapes import Shape, aligned_fields
from magloc.localization.search.candidates import candidate_positions
from magloc.localization.search.single_source import SingleSourceSearch
from magloc.localization.uncertainty.covariance import solutions_of
from magloc.measurement.differences import DifferenceMeasurement, predicted_channels
from magloc.measurement.rows import whitened_rows
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved
from tests.magloc.bodies.devices import hall_ring, knob, random_poses, readings_of
from tests.magloc.bodies.test_filter import record
from tests.plain_locator import plain_locator

TITLE = "fix: tetrahedron of 1.5 m, 1 nT, source of 300 A·m² at 2-8 m, no start given"
MOMENT_AM2 = 300.0
# χ² above the one found from the truth within which a fix has succeeded.
REACHED = 0.05


def rows(size: Size) -> Iterator[Row]:
    """Ours from its own search, the peer from random positions with the best moment at each, both with one thread.

    The peer has our measurement model and its analytic Jacobian, in NumPy, and MINPACK's Levenberg-Marquardt iteration.
    """
    measurement = DifferenceMeasurement.of(tetrahedron(1.5, noise_T=1e-9))
    locator = plain_locator(measurement.array)
    truths, readings = simulated(measurement, size.rows, np.random.default_rng(2))
    few = range(min(size.problems, size.rows))
    z = measurement.measured(readings)
    best = np.array([2.0 * best_fit(measurement, z[i], truths[i]).cost for i in few])
    starts = random_directions(np.random.default_rng(3), 20) * np.geomspace(1.0, 20.0, 20)[:, None]
    starts = np.random.default_rng(4).permutation(starts)

    def multi_starts(n_starts: int, problems: Sequence[int]) -> list[float]:
        return [2.0 * multi_start(measurement, z[i], starts[:n_starts]).cost for i in problems]

    def success(chi2: Sequence[float]) -> str:
        return f"{int(np.sum(np.asarray(chi2) < best + REACHED))}/{len(best)}"

    fixes = locator.fit_rows(readings[: len(best)])
    ours = success([fix.solutions[0].chi2 if fix.solutions else np.inf for fix in fixes])
    chi2_found = {n_starts: multi_starts(n_starts, few) for n_starts in (6, 20)}
    timed = size.timed(few)
    threads = core.threads()
    timings = interleaved(
        {
            "many": Contestant(lambda: locator.fit_rows(readings), 1, size.rows),
            "all threads": Contestant(lambda: locator.fit_rows(readings), threads, size.rows),
            "one": Contestant(lambda: [locator.fit(readings[i]) for i in few], 1, len(best)),
            6: Contestant(lambda: multi_starts(6, timed), 1, len(timed)),
            20: Contestant(lambda: multi_starts(20, timed), 1, len(timed)),
        },
        size.rounds,
    )
    for name, what in ((f"{size.rows:,} at once", "many"), ("one alone", "one")):
        for n_starts in (6, 20):
            yield Row(
                f"a fix, {name}, 1 thr.",
                timings[what],
                f"scipy, {n_starts} starts",
                timings[n_starts],
                f"optimum found: ours {ours}, peer {success(chi2_found[n_starts])}" if what == "many" else "",
            )
    yield Row(f"a fix, {size.rows:,} at once, {threads} thr.", timings["all threads"])
    yield from magnets(size)
    yield from bodies(size)
    yield from growth(size)


def magnets(size: Size) -> Iterator[Row]:
    """Magnets of known shape one to three lengths over twelve sensors, beside dipoles fitted to the same readings."""
    rng, array = np.random.default_rng(6), grid(4, 3, 0.01, noise_T=1e-6)
    position = array.centroid + rng.uniform([-0.015, -0.01, 0.015], [0.015, 0.01, 0.03], (size.rows, 3))
    moment = rng.normal(size=(size.rows, 3))
    for magnet in (Shape("cylinder", (0.01, 0.005)), Shape("cuboid", (0.01, 0.01, 0.005))):
        field = aligned_fields(magnet, array.positions, position[:, None], moment[:, None], 0.3)[0]
        readings = field.reshape(size.rows, -1) + 1e-6 * rng.normal(size=(size.rows, array.n_channels))
        ours, dipoles = plain_locator(array, magnet=magnet), plain_locator(array, body_length_m=0.0)
        few = readings[: size.problems]
        contestants = {
            "magnet": Contestant(lambda locator=ours, z=readings: locator.fit_rows(z), 1, size.rows),
            "dipole": Contestant(lambda locator=dipoles, z=readings: locator.fit_rows(z), 1, size.rows),
            "magnet alone": Contestant(lambda locator=ours, z=few: [locator.fit(row) for row in z], 1, len(few)),
            "dipole alone": Contestant(lambda locator=dipoles, z=few: [locator.fit(row) for row in z], 1, len(few)),
        }
        timings = interleaved(contestants, size.rounds)
        for what, alone in ((f"{size.rows:,} at once", ""), ("one alone", " alone")):
            ours_s, dipole_s = timings[f"magnet{alone}"], timings[f"dipole{alone}"]
            yield Row(f"a {magnet.kind} near, {what}, 1 thr.", ours_s, "a dipole", dipole_s)


def bodies(size: Size) -> Iterator[Row]:
    """A body of three magnets over three sensors, beside a dipole at the same sensors."""
    rng, array, body = np.random.default_rng(7), hall_ring(), knob()
    few = range(min(size.problems, size.rows))
    position, R = random_poses(body, size.rows, rng)
    readings = readings_of(array, body, position, R, rng)
    moment = 0.05 * random_directions(rng, size.rows)
    of_dipoles = predicted_channels(array, position, moment)
    of_dipoles += array.channel_noise_T * rng.normal(size=of_dipoles.shape)
    moving = record(array, body, size.rows, 7)[0]
    locator, dipoles = BodyLocator(array, body), plain_locator(array, body_length_m=0.0)
    sensors = [replace(sensor, offset_uncertainty_T=2e-5, gain_uncertainty=0.03) for sensor in array.sensors]
    exact, uncertain = BodyTracker(array, body), BodyTracker(replace(array, sensors=tuple(sensors)), body)

    def track(tracker: BodyTracker) -> None:
        tracker.restart()
        tracker.follow(moving.values_T, moving.time_s)

    timings = interleaved(
        {
            "body alone": Contestant(lambda: [locator.fit_rows(readings[i : i + 1]) for i in few], 1, len(few)),
            "dipole alone": Contestant(lambda: [dipoles.fit(of_dipoles[i]) for i in few], 1, len(few)),
            "body": Contestant(lambda: locator.fit_rows(readings), 1, size.rows),
            "dipole": Contestant(lambda: dipoles.fit_rows(of_dipoles), 1, size.rows),
            "track": Contestant(lambda: track(exact), 1, size.rows),
            "track with errors": Contestant(lambda: track(uncertain), 1, size.rows),
        },
        size.rounds,
    )
    found = int(locator.fit_rows(readings).solved.sum())
    for what, ours, peer in (
        ("a body of three magnets, one alone", "body alone", "dipole alone"),
        (f"a body, {size.rows:,} at once", "body", "dipole"),
        (f"a body, {size.rows:,} rows tracked", "track", "dipole"),
        ("the same, 18 lasting errors of the sensors", "track with errors", "dipole"),
    ):
        yield Row(f"{what}, 1 thr.", timings[ours], f"fix of {peer}", timings[peer], f"poses {found}/{size.rows}")


def growth(size: Size) -> Iterator[Row]:
    """How the time that a row takes in every stage of a fix grows with the rows at once, the sensors and the grid.

    The slope is that of the logarithms: 0 where a row costs the same, 1 where it grows in proportion.
    """
    rng = np.random.default_rng(5)
    of_sensors, numbers = (
        {n: on_a_sphere(n) for n in (4, 8, 16, 32, 64)},
        sorted({min(n, size.rows) for n in (1, 10, 100, 1000)}),
    )
    four = of_sensors[4]
    several, few = simulated(four, size.rows, rng)[1], max(1, size.rows // 10)
    yield from _grown("rows at once", {n: stages(four.array, several[:n]) for n in numbers}, size.rounds)
    yield from _grown(
        "sensors",
        {n: stages(of_n.array, simulated(of_n, few, rng)[1]) for n, of_n in of_sensors.items()},
        size.rounds,
    )
    grids = [candidate_positions(four.array, n_directions=n) for n in (50, 150, 450, 1350)]
    yield from _grown("candidates", {len(c): stages(four.array, several[:few], c) for c in grids}, size.rounds)


def on_a_sphere(n: int) -> DifferenceMeasurement:
    """Sensors whose noise grows with the field, so that every row has a whitening of its own."""
    places = 1.5 * fibonacci_directions(n)
    sensors = [Sensor(id=f"s{i}", kind="vector", position_m=p, noise_T=1e-9) for i, p in enumerate(places)]
    return DifferenceMeasurement.of(SensorArray(tuple(sensors), noise_fraction=1e-4))


def stages(array: SensorArray, readings: np.ndarray, candidates: np.ndarray | None = None) -> dict[str, Contestant]:
    """What makes fixes of readings (n, C), alone and all together, with other candidates (k, 3) if they are given."""
    locator = plain_locator(array, body_length_m=0.0)
    search = locator._search = SingleSourceSearch(array)
    if candidates is not None:
        search._candidates = candidates
    (rows,) = whitened_rows(array, readings, None, len(readings))
    (optima,) = search.optima(rows)
    starts, n = search.starts(rows), len(readings)
    return {
        "whitening": Contestant(lambda: list(whitened_rows(array, readings, None, n)), 1, n),
        "choice of starts": Contestant(lambda: search.starts(rows), 1, n),
        "refinement": Contestant(lambda: search.refine_starts(rows, np.arange(n), starts, math.inf), 1, n),
        "uncertainty": Contestant(lambda: solutions_of(optima, np.ones(n, dtype=bool)), 1, n),
        "a fix": Contestant(lambda: locator.fit_rows(readings), 1, n),
    }


def _grown(what: str, runs: Mapping[int, Mapping[str, Contestant]], rounds: int) -> Iterator[Row]:
    """A row for every stage: its time at the largest number of something, and those at all numbers with the slope."""
    timings = interleaved({f"{n} {stage}": run for n, of_n in runs.items() for stage, run in of_n.items()}, rounds)
    for stage in next(iter(runs.values())):
        of_stage = [timings[f"{n} {stage}"] for n in runs]
        best = [timing.best for timing in of_stage]
        slope = float(np.polyfit(np.log(list(runs)), np.log(best), 1)[0])
        note = ", ".join(f"{n}: {1e6 * t:.3g} µs" for n, t in zip(runs, best, strict=True))
        yield Row(f"{stage}, {max(runs):,} {what}", of_stage[-1], note=f"slope {slope:.2f} ({note})")


def simulated(measurement: DifferenceMeasurement, n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """States (n, 6) of sources all around the array, and noisy readings (n, C) [T]."""
    array = measurement.array
    positions = random_directions(rng, n) * rng.uniform(2.0, 8.0, (n, 1))
    moments = random_directions(rng, n) * MOMENT_AM2
    noise = rng.normal(scale=array.channel_noise_T, size=(n, array.n_channels))
    readings = predicted_channels(array, positions, moments) + array.channel_offset_T + noise
    return np.concatenate([positions, moments], axis=1), readings


def random_directions(rng: np.random.Generator, n: int) -> np.ndarray:
    """Unit vectors, shape (n, 3)."""
    vectors = rng.normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def best_fit(
    measurement: DifferenceMeasurement, z: np.ndarray, start: np.ndarray, prior_sigma: np.ndarray | None = None
) -> OptimizeResult:
    """scipy's optimum of the likelihood of z (k,), or with the start as the mean of a prior, of the posterior."""
    sigma = np.sqrt(measurement.variance)

    def residual(x: np.ndarray) -> np.ndarray:
        whitened = (measurement.predicted(x[:3], x[3:]) - z) / sigma
        return whitened if prior_sigma is None else np.concatenate([whitened, (x - start) / prior_sigma])

    def jacobian(x: np.ndarray) -> np.ndarray:
        whitened = measurement.jacobian(x[:3], x[3:]) / sigma[:, None]
        return whitened if prior_sigma is None else np.concatenate([whitened, np.diag(1.0 / prior_sigma)])

    return least_squares(residual, start, jacobian, method="lm", x_scale="jac")


def multi_start(measurement: DifferenceMeasurement, z: np.ndarray, positions: np.ndarray) -> OptimizeResult:
    """Best of scipy's optima from several positions, each with the moment that fits it best."""
    fits = []
    for position in positions:
        by_moment = measurement.jacobian(position, np.zeros(3))[:, 3:]
        sigma = np.sqrt(measurement.variance)
        moment = np.linalg.lstsq(by_moment / sigma[:, None], z / sigma)[0]
        fits.append(best_fit(measurement, z, np.concatenate([position, moment])))
    return min(fits, key=lambda fit: fit.cost)
