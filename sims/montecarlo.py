"""Monte-Carlo runs: many realisations of a scenario, and an estimator for each."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from functools import partial
from importlib.metadata import version
from typing import Any

import numpy as np
import xarray as xr

from adcs.satellite.telemetry import Telemetry
from arrays.typing import FloatArray
from magloc.grids.pool import process_pool
from sims.attitude.scenario import AttitudeScenario
from sims.attitude.simulation import AttitudeRuns
from sims.magnetics.scenario import MagneticScenario
from sims.magnetics.simulation import Simulation
from sims.scenarios import simulate

Estimator = Callable[[Any, Any], Any]
"""Function of an array and its readings, or of a log and its satellite."""
Judge = Callable[[Any, Any], Mapping[str, Any]]
"""Function of a simulation and the result of the estimator."""
_RESERVED = ("seed", "error")
_Outcome = dict[str, FloatArray] | str
_Work = Callable[[int], _Outcome]


def run_many(
    scenario: MagneticScenario | AttitudeScenario,
    estimator: Estimator,
    *,
    seeds: Sequence[int],
    judge: Judge | None = None,
    processes: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Run an estimator on many realisations of a scenario.

    An interruption (KeyboardInterrupt, or any exception of ``progress``) stops the other processes and is raised.

    Parameters
    ----------
    scenario : MagneticScenario or AttitudeScenario
        Scenario from :func:`sims.read_scenario`, or made in Python.
    estimator : callable
        Takes an array and its readings, or a :class:`adcs.Telemetry` and its :class:`adcs.Satellite`. ``judge`` selects
        what is kept of its result.
    seeds : sequence of int
        Seeds, each once.
    judge : callable, optional
        Takes the simulation and what the estimator returned, and gives a mapping of names to numbers, or to arrays of
        numbers of the same shape for all seeds. By default: a mapping itself; the angle between an
        attitude and the truth (``error_deg``); for other results the numbers of ``result.consistency(truth)``.
    processes : int, optional
        Number of processes; by default that of the processors, at most that of the seeds, and 1 for an estimator that
        cannot be pickled, such as a lambda. The result does not depend on it. 1 runs in the calling process.
    progress : callable, optional
        Called with 1 after every seed.

    Returns
    -------
    xarray.Dataset
        One variable (seed, …) for every name, NaN where a seed failed, and ``error`` (seed): type and text of what the
        estimator raised, empty where it did not. The axes of an array variable ``x`` are ``x_0``, ``x_1``, ….

    Raises
    ------
    ValueError
        There are no seeds or one comes twice, ``processes`` is not positive, or the estimator cannot be pickled.

    Examples
    --------
    >>> import magloc
    >>> import sims
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("weaving"), duration_s=5.0)
    >>> def solved(array, readings):
    ...     return {"solved": magloc.locate(array, readings).solved.sum()}
    >>> runs = sims.run_many(scenario, solved, seeds=range(2), processes=1)
    >>> runs.solved.values
    array([11., 11.])
    """
    numbers = [int(seed) for seed in seeds]
    work = partial(_one, scenario, estimator, judge or against_truth)
    if not numbers or len(set(numbers)) < len(numbers):
        raise ValueError(f"Input seeds must be different numbers, one at least; instead received {numbers}.")
    if processes is None:
        processes = min(os.cpu_count() or 1, len(numbers)) if _refusal_to_pickle(work) is None else 1
    if processes < 1:
        raise ValueError(f"Input processes must be positive; instead received {processes}.")
    finished = _in_turn if processes == 1 else _in_parallel
    outcomes: dict[int, _Outcome] = {}
    with closing(finished(work, numbers, processes)) as pairs:
        for seed, outcome in pairs:
            outcomes[seed] = outcome
            if progress is not None:
                progress(1)
    return _dataset(getattr(scenario, "name", "of a satellite"), numbers, outcomes)


def _refusal_to_pickle(work: _Work) -> str | None:
    try:
        pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        return str(error)
    return None


def _in_turn(work: _Work, seeds: Sequence[int], processes: int) -> Generator[tuple[int, _Outcome], None, None]:
    for seed in seeds:
        yield seed, work(seed)


def _in_parallel(work: _Work, seeds: Sequence[int], processes: int) -> Generator[tuple[int, _Outcome], None, None]:
    refusal = _refusal_to_pickle(work)
    if refusal is not None:
        raise ValueError(
            f"Input estimator must be one that can be pickled, for more than one process; instead received {refusal}."
        )
    with process_pool(processes) as pool:
        futures: dict[Future[_Outcome], int] = {pool.submit(work, seed): seed for seed in seeds}
        for future in as_completed(futures):
            try:
                outcome = future.result()
            except BrokenProcessPool:
                outcome = "BrokenProcessPool: a process of the pool died"
            yield futures[future], outcome


def against_truth(simulation: Simulation | AttitudeRuns, result: Any) -> Mapping[str, Any]:
    """Return the default numbers of a result."""
    if isinstance(result, Mapping):
        return result
    if isinstance(simulation, AttitudeRuns):
        return {"error_deg": simulation.error_deg(result)}
    found = result.consistency(simulation.truth)
    names = [name for name in dir(found) if not name.startswith("_")]
    values = {name: getattr(found, name) for name in names}
    return {name: value for name, value in values.items() if isinstance(value, int | float | tuple | np.ndarray)}


def _one(scenario: MagneticScenario | AttitudeScenario, estimator: Estimator, judge: Judge, seed: int) -> _Outcome:
    """Return the result of one seed, or the error as text."""
    try:
        simulation = simulate(scenario, seed)
        if isinstance(simulation, AttitudeRuns):
            satellite = simulation.scenario.satellite
            estimated = estimator(Telemetry.of(simulation, satellite.start), satellite)
        else:
            estimated = estimator(simulation.array, simulation.readings)
        result = judge(simulation, estimated)
        values = {str(name): np.asarray(value, dtype=np.float64) for name, value in result.items()}
        for name in _RESERVED:
            if name in values:
                raise ValueError(f"Input estimator must not return {name!r}, which names something else.")
    except Exception as error:  # whatever it is, the other seeds go on
        return f"{type(error).__name__}: {error}"
    return values


def _dataset(name: str, seeds: Sequence[int], outcomes: Mapping[int, _Outcome]) -> xr.Dataset:
    shapes: dict[str, tuple[int, ...]] = {}
    errors = []
    for seed in seeds:
        outcome = outcomes[seed]
        if isinstance(outcome, str):
            errors.append(outcome)
            continue
        found = {name: value.shape for name, value in outcome.items()}
        shapes = shapes or found
        errors.append("" if found == shapes else f"ValueError: expected results of shapes {shapes}, found {found}")
    attributes = {
        "Conventions": "CF-1.10",
        "title": f"Monte-Carlo runs of the scenario {name}",
        "source": f"magloc {version('magloc')}",
        "scenario": name,
    }
    variables: dict[str, Any] = {"error": ("seed", np.array(errors, dtype=np.str_), {"long_name": "what went wrong"})}
    for variable, shape in shapes.items():
        values = np.full((len(seeds), *shape), np.nan)
        for i, seed in enumerate(seeds):
            outcome = outcomes[seed]
            if not errors[i] and not isinstance(outcome, str):
                values[i] = outcome[variable]
        variables[variable] = (("seed", *(f"{variable}_{axis}" for axis in range(len(shape)))), values)
    return xr.Dataset(variables, coords={"seed": list(seeds)}, attrs=attributes)
