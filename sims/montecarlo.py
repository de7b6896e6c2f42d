"""Many realisations of a scenario, and what an estimator makes of each."""

from __future__ import annotations

import os
import pickle
import signal
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from importlib.metadata import version
from multiprocessing import get_context
from typing import Any

import numpy as np
import xarray as xr

from arrays.typing import FloatArray
from sims.magnetics.scenario import Scenario
from sims.magnetics.simulation import Simulation, simulate

Result = Mapping[str, Any]
Estimator = Callable[[Simulation], Result]
_RESERVED = ("seed", "error")
_Outcome = dict[str, FloatArray] | str


def run(
    scenario: Scenario,
    estimator: Estimator,
    seeds: Sequence[int],
    *,
    processes: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """What an estimator makes of a scenario, seed by seed.

    An interruption (KeyboardInterrupt, or any exception of ``progress``) stops the other processes and is raised.

    Parameters
    ----------
    scenario : Scenario
    estimator : callable
        Takes a :class:`sims.magnetics.simulation.Simulation` and returns a mapping of names to numbers, or to arrays of
        numbers of the same shape for all seeds. With more than one process it must be a function of a module, or
        something else that can be pickled.
    seeds : sequence of int
        Each once.
    processes : int, optional
        By default as many as there are processors, but no more than seeds. The result does not depend on it. One runs
        in the calling process.
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
    """
    numbers = [int(seed) for seed in seeds]
    if not numbers or len(set(numbers)) < len(numbers):
        raise ValueError(f"Input seeds must be different numbers, one at least; instead received {numbers}.")
    if processes is None:
        processes = min(os.cpu_count() or 1, len(numbers))
    if processes < 1:
        raise ValueError(f"Input processes must be positive; instead received {processes}.")
    finished = _in_turn if processes == 1 else _in_parallel
    outcomes: dict[int, _Outcome] = {}
    with closing(finished(scenario, estimator, numbers, processes)) as pairs:
        for seed, outcome in pairs:
            outcomes[seed] = outcome
            if progress is not None:
                progress(1)
    return _dataset(scenario, numbers, outcomes)


def _in_turn(
    scenario: Scenario, estimator: Estimator, seeds: Sequence[int], processes: int
) -> Generator[tuple[int, _Outcome], None, None]:
    for seed in seeds:
        yield seed, _one(scenario, estimator, seed)


def _in_parallel(
    scenario: Scenario, estimator: Estimator, seeds: Sequence[int], processes: int
) -> Generator[tuple[int, _Outcome], None, None]:
    try:
        pickle.dumps(estimator)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ValueError(
            f"Input estimator must be one that can be pickled, for more than one process; instead received {error}."
        ) from None
    # New interpreters: a fork of a process with threads, such as those of compiled code, may never come back.
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_prepare)
    try:
        futures: dict[Future[_Outcome], int] = {pool.submit(_one, scenario, estimator, seed): seed for seed in seeds}
        for future in as_completed(futures):
            try:
                outcome = future.result()
            except BrokenProcessPool:
                outcome = "BrokenProcessPool: a process of the pool died"
            yield futures[future], outcome
    except BaseException:
        for process in list((pool._processes or {}).values()):  # what a pool has no public name for before 3.14
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    """Settings of a process: one thread, and an interruption is the business of the process that started it."""
    os.environ["NUMBA_NUM_THREADS"] = "1"  # compiled code is not loaded yet
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _one(scenario: Scenario, estimator: Estimator, seed: int) -> _Outcome:
    """Result of one seed, or why there is none."""
    try:
        result = estimator(simulate(scenario, seed))
        values = {str(name): np.asarray(value, dtype=np.float64) for name, value in result.items()}
        for name in _RESERVED:
            if name in values:
                raise ValueError(f"Input estimator must not return {name!r}, which names something else.")
    except Exception as error:  # whatever it is, the other seeds go on
        return f"{type(error).__name__}: {error}"
    return values


def _dataset(scenario: Scenario, seeds: Sequence[int], outcomes: Mapping[int, _Outcome]) -> xr.Dataset:
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
        "title": f"Monte-Carlo runs of the scenario {scenario.name}",
        "source": f"magloc {version('magloc')}",
        "scenario": scenario.name,
    }
    variables: dict[str, Any] = {"error": ("seed", np.array(errors, dtype=np.str_), {"long_name": "what went wrong"})}
    for name, shape in shapes.items():
        values = np.full((len(seeds), *shape), np.nan)
        for i, seed in enumerate(seeds):
            outcome = outcomes[seed]
            if not errors[i] and not isinstance(outcome, str):
                values[i] = outcome[name]
        variables[name] = (("seed", *(f"{name}_{axis}" for axis in range(len(shape)))), values)
    return xr.Dataset(variables, coords={"seed": list(seeds)}, attrs=attributes)
