"""Durations of several functions in one run, in turn, so that a machine that drifts slows all of them alike."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from importlib.util import find_spec
from typing import Any

import numpy as np
from threadpoolctl import ThreadpoolController

from magloc import core

# A sample is the shortest of the calls that begin within this time [s]: what else runs disturbs few of them.
SAMPLE_S = 0.05


@dataclass(frozen=True)
class Size:
    """How large the problems are, and how often each is timed."""

    points: int
    """Field points; ten times as many in the largest case."""
    rows: int
    """Fixes at once, and rows of the recording at most."""
    problems: int
    """Fixes that the slow peers take."""
    grid: int
    """Starts of a map along every axis."""
    sample: int
    """Starts of a map that the slow peers take."""
    rounds: int
    """Samples of every duration."""

    def timed(self, problems: Sequence[Any]) -> Sequence[Any]:
        """The first fifth, for what takes many seconds for all of them: it is timed in every round by these alone."""
        return problems[: max(1, len(problems) // 5)]


FULL = Size(points=100_000, rows=5000, problems=20, grid=21, sample=40, rounds=5)
QUICK = Size(points=100_000, rows=500, problems=4, grid=21, sample=10, rounds=3)


@dataclass(frozen=True)
class Contestant:
    """A function to be timed with a number of threads; a call does `count` units of work."""

    run: Callable[[], object]
    threads: int = 1
    count: float = 1.0


@dataclass(frozen=True)
class Timing:
    """Durations of one unit of work [s], one per round."""

    seconds: tuple[float, ...]

    @property
    def best(self) -> float:
        """The shortest."""
        return min(self.seconds)

    @property
    def spread(self) -> float:
        """How far the median lies above the shortest, as a fraction of it."""
        return float(np.median(self.seconds)) / self.best - 1.0


def interleaved(contestants: Mapping[str, Contestant], rounds: int) -> dict[str, Timing]:
    """Timing of every contestant: A B C, A B C, …, after a call of each that compiles and is not counted."""
    for contestant in contestants.values():
        with _threads(contestant.threads):
            contestant.run()
    seconds: dict[str, list[float]] = {name: [] for name in contestants}
    for _ in range(rounds):
        for name, contestant in contestants.items():
            with _threads(contestant.threads):
                seconds[name].append(_shortest(contestant.run) / contestant.count)
    return {name: Timing(tuple(values)) for name, values in seconds.items()}


def _shortest(run: Callable[[], object]) -> float:
    """Duration [s] of the shortest call in a sample."""
    shortest = np.inf
    began = now = time.perf_counter()
    while now < began + SAMPLE_S:
        begin = time.perf_counter()
        run()
        now = time.perf_counter()
        shortest = min(shortest, now - begin)
    return shortest


@contextmanager
def _threads(n: int) -> Iterator[None]:
    """Limit the threads of compiled code, and those of the BLAS libraries that are loaded by now."""
    before, numba = core.threads(), sys.modules.get("numba")  # peers load it
    all_of_numba = numba.get_num_threads() if numba else 0
    core.set_threads(n)
    if numba:
        numba.set_num_threads(min(n, all_of_numba))
    try:
        with ThreadpoolController().limit(limits=n, user_api="blas"):
            yield
    finally:
        core.set_threads(before)
        if numba:
            numba.set_num_threads(all_of_numba)


def installed(package: str) -> bool:
    """Whether a peer is there to be timed."""
    return find_spec(package) is not None


def version_of(package: str) -> str:
    """Version of a peer, or that it is not there."""
    return version(package) if installed(package) else "not installed"
