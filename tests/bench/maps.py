"""Convergence maps: time per start, against Python loops over the readable twins and the peers' filters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np

from arrays.geometries import tetrahedron
from magloc import core
from magloc.convergence.ends import FilterEnds
from magloc.convergence.filters import IekfFilter, RepeatedFilter
from magloc.convergence.over_starts import StartsScenario, simulate_measurement
from magloc.measurement.differences import DifferenceMeasurement
from tests.bench.filters import TIME, functions, stonesoup_update
from tests.bench.fixes import best_fit
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, installed, interleaved
from tests.magloc.convergence.readable_filters import run_one, s_0, s_q
from tests.plain_locator import plain_locator

TITLE = (
    "map: one start of a cube of 40 m around a tetrahedron, source at 5 m; peers on a sample; iekf is chaotic far away"
)
Loop = Callable[[np.ndarray], tuple[np.ndarray, bool]]
"""State and whether the iteration stopped, of one start."""


def rows(size: Size) -> Iterator[Row]:
    """A whole map of ours, and a sample of its starts one by one, with one thread each.

    Far from the source the iterations of `iekf` are chaotic: a start moved by rounding alone may end elsewhere, whoever
    iterates. So the numbers of starts that reach the source differ there.
    """
    yield from rows_of(RepeatedFilter(), size, {"filterpy EKF": ("filterpy", filterpy_loop)})
    yield from rows_of(IekfFilter(), size, {"Stone Soup iterated": ("stonesoup", stonesoup_loop)})


def rows_of(
    method: RepeatedFilter | IekfFilter, size: Size, peers: dict[str, tuple[str, Callable[..., Loop]]]
) -> Iterator[Row]:
    """One filter, against its twin, its peers (package and loop by name) and scipy."""
    scenario = StartsScenario(array=tetrahedron(1.5, noise_T=1e-9))
    readings, measurement, z = simulate_measurement(scenario)
    optimum = plain_locator(scenario.array).fit(readings).solutions[0]
    starts = starts_of(scenario, size.grid)
    sampled = np.random.default_rng(6).permutation(len(starts))[: size.sample]
    threads = core.threads()
    candidates = {"magloc run_one": ("magloc", our_loop), **peers, "scipy": ("scipy", scipy_loop)}
    loops = {name: make(measurement, z, method) for name, (package, make) in candidates.items() if installed(package)}
    found: dict[str, list[tuple[np.ndarray, bool]]] = {}

    def run_all() -> FilterEnds:
        return method.run(measurement, z, starts)

    def run_sample(name: str) -> None:
        found[name] = [loops[name](starts[i]) for i in sampled]

    def reached(ends: FilterEnds) -> np.ndarray:
        return method.reached(ends, optimum.chi2, optimum.position_m)

    ends = run_all()
    timings = interleaved(
        {
            "ours": Contestant(run_all, 1, len(starts)),
            "all threads": Contestant(run_all, threads, len(starts)),
            **{name: Contestant(partial(run_sample, name), 1, len(sampled)) for name in loops},
        },
        size.rounds,
    )
    note = (
        f"{reached(ends).mean():.0%} reach the source; {ends.iterations.mean():.0f} iterations on average, "
        f"{ends.iterations[sampled].mean():.0f} in the sample"
    )
    yield Row(f"{method.name}, {size.grid}³ starts, {threads} thr.", timings["all threads"], note=note)
    for name in candidates:
        note = ""
        if name in loops:
            peer_reached = reached(ends_of(measurement, z, found[name])).sum()
            note = (
                f"reached: ours {reached(ends)[sampled].sum()}, peer {peer_reached} of {len(sampled)}; "
                f"peer's whole map {timings[name].best * len(starts):.0f} s (extrapolated)"
            )
        yield Row(f"{method.name}, 1 thr.", timings["ours"], name, timings.get(name), note)


def starts_of(scenario: StartsScenario, grid: int) -> np.ndarray:
    """The map's cube of starts, shape (grid³, 6)."""
    axis = np.linspace(-scenario.half_width_m, scenario.half_width_m, grid)
    positions = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.concatenate([positions, np.zeros_like(positions)], axis=1)


def ends_of(measurement: DifferenceMeasurement, z: np.ndarray, found: list[tuple[np.ndarray, bool]]) -> FilterEnds:
    """What the loops return, as the map's own ends."""
    states = np.array([state for state, _ in found])
    residual = (z - measurement.predicted(states[:, :3], states[:, 3:])) / np.sqrt(measurement.variance)
    return FilterEnds(
        states=states,
        chi2=np.einsum("ij,ij->i", residual, residual),
        iterations=np.zeros(len(found), dtype=np.int64),
        stopped=np.array([stopped for _, stopped in found]),
    )


def our_loop(measurement: DifferenceMeasurement, z: np.ndarray, method: RepeatedFilter | IekfFilter) -> Loop:
    """The readable twin."""

    def loop(start: np.ndarray) -> tuple[np.ndarray, bool]:
        update = run_one(method, measurement, z, start)
        return update.x, update.converged

    return loop


def filterpy_loop(measurement: DifferenceMeasurement, z: np.ndarray, method: RepeatedFilter) -> Loop:
    """filterpy's filter repeated over the same readings, with our stop rule."""
    from filterpy.kalman import ExtendedKalmanFilter

    Hx, HJacobian = functions(measurement)

    def loop(start: np.ndarray) -> tuple[np.ndarray, bool]:
        kalman = ExtendedKalmanFilter(6, z.size)
        kalman.x, kalman.P, kalman.Q = start, np.diag(s_q(method) ** 2), np.diag(s_q(method) ** 2)
        kalman.R = np.diag(measurement.variance)
        predicted = Hx(start)
        for _ in range(method.max_iterations):
            kalman.predict()
            before = predicted
            kalman.update(z, HJacobian, lambda x, predicted=predicted: predicted)
            predicted = Hx(kalman.x)
            change = np.linalg.norm(predicted - before)
            if change < method.tolerance_T:
                return kalman.x, True
            if not np.isfinite(change):
                break
        return kalman.x, False

    return loop


def stonesoup_loop(measurement: DifferenceMeasurement, z: np.ndarray, method: IekfFilter) -> Loop:
    """Stone Soup's iterated updater, with its own stop rule: how far the state moves."""
    from stonesoup.types.prediction import GaussianStatePrediction

    tolerance = 1e-3  # m and A·m² alike; 1 mA·m² at 5 m is about our 1e-12 T
    update = stonesoup_update(measurement, z, tolerance, method.max_iterations - 2)

    def loop(start: np.ndarray) -> tuple[np.ndarray, bool]:
        state = update(GaussianStatePrediction(start, np.diag(s_0(method) ** 2), timestamp=TIME))
        return state, True

    return loop


def scipy_loop(measurement: DifferenceMeasurement, z: np.ndarray, method: RepeatedFilter | IekfFilter) -> Loop:
    """scipy.optimize.least_squares on the cost that the filter minimises where it stops."""
    prior_sigma = s_0(method) if isinstance(method, IekfFilter) else None

    def loop(start: np.ndarray) -> tuple[np.ndarray, bool]:
        fit = best_fit(measurement, z, start, prior_sigma)
        return fit.x, fit.success

    return loop
