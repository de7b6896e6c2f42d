"""One step of a Kalman filter over nine differences, against filterpy and Stone Soup."""

from __future__ import annotations

import datetime
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import count, islice

import numpy as np

from arrays.geometries import tetrahedron
from magloc.convergence.filters import IekfFilter
from magloc.convergence.over_starts import StartsScenario, simulate_measurement
from magloc.measurement.differences import DifferenceMeasurement
from magloc.readings import Readings
from magloc.state_space import IteratedExtendedKalmanFilter
from magloc.tracking.motion import RandomWalk
from magloc.tracking.rows import Row as TrackRow
from magloc.tracking.rows import rows_of
from magloc.tracking.tracker import Tracker
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import simulate
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, installed, interleaved

TITLE = "filter: one step (predict and update) of 6 states by 9 differences, 1 thread"
ITERATIONS = 5
DT_S = 0.5
SIGMA = np.repeat([0.5, 50.0], 3)
PROCESS_SIGMA = np.repeat([0.01, 1.0], 3)


def rows(size: Size) -> Iterator[Row]:
    """The same prior, readings, measurement function and Jacobian for all; ours and Stone Soup iterate equally often.

    The last rows compare an iteration of the compiled filter of the convergence map, over a map of starts.
    """
    scenario = StartsScenario(array=tetrahedron(1.5, noise_T=1e-9), noise_seed=5)
    _, measurement, z = simulate_measurement(scenario)
    x = np.array([*scenario.position_m, *scenario.moment_Am2]) + np.repeat([0.3, -20.0], 3)
    method = IekfFilter(tolerance_T=0.0, max_iterations=ITERATIONS)
    starts = np.tile(x, (size.grid**3, 1))
    contestants = {
        "iterated": Contestant(our_step(measurement, z, x, ITERATIONS)),
        "once": Contestant(our_step(measurement, z, x, 1)),
        "compiled": Contestant(lambda: method.run(measurement, z, starts), 1, len(starts) * ITERATIONS),
    }
    record, tracker = track_of_weaving(size)
    contestants["record"] = Contestant(lambda: list(tracker().run(record)), 1, len(record))
    some = size.timed(record)
    contestants["update"] = Contestant(settled_updates(tracker(), record, len(some)), 1, len(some))
    if installed("filterpy"):
        contestants["filterpy"] = Contestant(filterpy_step(measurement, z, x))
    if installed("stonesoup"):
        step = stonesoup_step(measurement, z, x)
        contestants["stonesoup"] = Contestant(step)
        contestants["stonesoup iteration"] = Contestant(step, 1, ITERATIONS)
    timings = interleaved(contestants, size.rounds)
    yield Row(f"a step, {ITERATIONS} iterations", timings["iterated"], "Stone Soup iterated", timings.get("stonesoup"))
    yield Row("a step, 1 iteration", timings["once"], "filterpy EKF", timings.get("filterpy"))
    compiled = "an iteration, compiled map kernel"
    yield Row(compiled, timings["compiled"], "Stone Soup iterated", timings.get("stonesoup iteration"))
    yield Row(compiled, timings["compiled"], "filterpy EKF", timings.get("filterpy"), "peer: one step")
    note = "ours: iterated to convergence, gates, estimability; of a record with its start"
    for what, name in (("a row of a track, of a record", "record"), ("a row of a track, Tracker.update", "update")):
        yield Row(what, timings[name], "Stone Soup iterated", timings.get("stonesoup"), note)
        yield Row(what, timings[name], "filterpy EKF", timings.get("filterpy"), "peer: one linearisation")


def settled_updates(tracker: Tracker, record: list[TrackRow], n: int) -> Callable[[], None]:
    """Return what follows n more rows one by one, again and again, behind a start."""
    endless = (replace(record[i % len(record)], time_s=DT_S * i) for i in count())

    def more(n: int = n) -> None:
        for row in islice(endless, n):
            tracker.update(row)

    more(len(record) // 2)
    return more


def track_of_weaving(size: Size) -> tuple[list[TrackRow], Callable[[], Tracker]]:
    """Rows of the built-in scenario, repeated in time there and back, and what makes a fresh tracker for them."""
    simulation = simulate(read_scenario("weaving"), seed=0)
    readings = simulation.readings.values_T[60:260]  # where the range is certain
    there_and_back = np.concatenate([readings, readings[::-1]])
    values = np.tile(there_and_back, (max(1, size.rows // len(there_and_back)), 1))
    record = list(rows_of(Readings(values, time_s=DT_S * np.arange(len(values)))))
    return record, lambda: Tracker(simulation.array, RandomWalk(0.1, np.radians(1.2)))


def functions(
    measurement: DifferenceMeasurement,
) -> tuple[Callable[[np.ndarray], np.ndarray], Callable[[np.ndarray], np.ndarray]]:
    """Predicted differences of a state, and their Jacobian."""
    return lambda x: measurement.predicted(x[:3], x[3:]), lambda x: measurement.jacobian(x[:3], x[3:])


def our_step(
    measurement: DifferenceMeasurement, z: np.ndarray, x: np.ndarray, iterations: int
) -> Callable[[], np.ndarray]:
    """A step that always takes the given number of iterations."""
    Hx, HJacobian = functions(measurement)
    kalman = IteratedExtendedKalmanFilter(6, z.size, tolerance=0.0, max_iterations=iterations)
    kalman.Q = np.diag(PROCESS_SIGMA**2)
    kalman.R = np.diag(measurement.variance)

    def step() -> np.ndarray:
        kalman.x, kalman.S = x, np.diag(SIGMA)
        kalman.predict()
        kalman.update(z, HJacobian, Hx)
        return kalman.x

    return step


def filterpy_step(measurement: DifferenceMeasurement, z: np.ndarray, x: np.ndarray) -> Callable[[], np.ndarray]:
    """A step of filterpy's extended Kalman filter: one linearisation."""
    from filterpy.kalman import ExtendedKalmanFilter

    Hx, HJacobian = functions(measurement)
    kalman = ExtendedKalmanFilter(6, z.size)
    kalman.Q = np.diag(PROCESS_SIGMA**2)
    kalman.R = np.diag(measurement.variance)

    def step() -> np.ndarray:
        kalman.x, kalman.P = x, np.diag(SIGMA**2)
        kalman.predict()
        kalman.update(z, HJacobian, Hx)
        return kalman.x

    return step


def stonesoup_step(measurement: DifferenceMeasurement, z: np.ndarray, x: np.ndarray) -> Callable[[], np.ndarray]:
    """A step of Stone Soup's iterated updater that always takes the same number of iterations as ours."""
    from stonesoup.models.transition.linear import LinearGaussianTimeInvariantTransitionModel
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.state import GaussianState

    # Its count starts after the first linearisation, and the last one is beyond the limit.
    update = stonesoup_update(measurement, z, tolerance=0.0, max_iterations=ITERATIONS - 2)
    predictor = KalmanPredictor(
        LinearGaussianTimeInvariantTransitionModel(
            transition_matrix=np.eye(6), covariance_matrix=np.diag(PROCESS_SIGMA**2)
        )
    )
    prior = GaussianState(x, np.diag(SIGMA**2), timestamp=TIME)
    return lambda: update(predictor.predict(prior, timestamp=TIME + datetime.timedelta(seconds=1)))


TIME = datetime.datetime(2026, 1, 1)


def stonesoup_update(
    measurement: DifferenceMeasurement, z: np.ndarray, tolerance: float, max_iterations: int
) -> Callable[[object], np.ndarray]:
    """State after Stone Soup's iterated update of a prediction; stops when the state changes by less than tolerance."""
    from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import StateVector
    from stonesoup.updater.kalman import IteratedKalmanUpdater

    Hx, HJacobian = functions(measurement)

    class Model(NonLinearGaussianMeasurement):
        """Our measurement in Stone Soup's shape."""

        ndim_meas = z.size

        def function(self, state, noise=False, **kwargs):
            return StateVector(Hx(np.asarray(state.state_vector, dtype=float).ravel()))

        def jacobian(self, state, **kwargs):
            return HJacobian(np.asarray(state.state_vector, dtype=float).ravel())

    model = Model(ndim_state=6, mapping=tuple(range(6)), noise_covar=np.diag(measurement.variance))
    detection = Detection(StateVector(z), timestamp=TIME, measurement_model=model)
    updater = IteratedKalmanUpdater(model, tolerance=tolerance, max_iterations=max_iterations)

    def update(prediction: object) -> np.ndarray:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Iterated Kalman update did not converge")
            posterior = updater.update(SingleHypothesis(prediction, detection))
        return np.asarray(posterior.mean, dtype=float).ravel()

    return update
