"""Runs of one source or of several, judged by what a user sees: points, `consistency`, `innovations`."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

import magloc
from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.readings import Readings
from magloc.truth import Truth
from tests.moving_magnets import Magnets
from tests.moving_magnets import judged as judged_sources
from tests.tracking_figures.figures import FIRST_ROWS, N_STATES, Run

# Places that are the same of two ways through a record [m], and moments, relative, as of compiled steps and readable.
SAME_M, SAME_MOMENT = 1e-9, 1e-9


@dataclass
class Clock:
    """Processor time of what is timed, over that of a fixed computation."""

    cpu_s: float = 0.0

    @contextmanager
    def measure(self) -> Iterator[None]:
        begin = time.process_time()
        yield
        self.cpu_s += time.process_time() - begin

    @property
    def ratio(self) -> float:
        return self.cpu_s / reference_s()


@functools.cache
def reference_s() -> float:
    """Processor time of 20,000 solutions of six equations in NumPy, about a fifth of a second."""
    A = np.eye(N_STATES) + 0.1 * np.random.default_rng(0).normal(size=(N_STATES, N_STATES))
    x = np.ones(N_STATES)
    begin = time.process_time()
    for _ in range(20_000):
        x = np.linalg.solve(A, x / np.linalg.norm(x))
    return time.process_time() - begin


@dataclass(frozen=True)
class Expected:
    """Sensors that are wrong, and whether what is stated of the record is, so that the track is to be flagged."""

    faulty: tuple[str, ...] = ()
    flagged: bool = False


def run_of(
    seed: int,
    array: SensorArray,
    readings: Readings,
    truth: Truth,
    *,
    expected: Expected = Expected(),
    **options: Any,
) -> Run:
    """One record through :func:`magloc.track`."""
    clock = Clock()
    with clock.measure():
        track = magloc.track(array, readings, **options)
    return judge(seed, track, truth, expected, clock)


def judge(seed: int, track: magloc.Track, truth: Truth, expected: Expected, clock: Clock) -> Run:
    """A track against the truth."""
    result = track.consistency(truth)
    late = slice(len(track) // FIRST_ROWS, None)
    n_late = int(result.nees_dof[late].sum())
    answered = np.isfinite(track.position_m).all(axis=1) & np.isfinite(result.true_position_m).all(axis=1)
    answered[: late.start] = False
    errors = np.linalg.norm(track.position_m - result.true_position_m, axis=1)[answered]
    bounds = np.full(len(errors), np.nan) if result.bound_m is None else result.bound_m[answered]
    sets = [
        _holds(point, place)
        for point, place in zip(track, result.true_position_m, strict=True)
        if point.position_m is not None and np.isfinite(place).all()
    ]
    return Run(
        seed,
        tracked=int(track.tracked.sum()),
        nees=result.nees_per_dimension,
        nees_late=float(np.nansum(result.nees[late])) / n_late if n_late else math.nan,
        nees_numbers=int(result.nees_dof.sum()),
        held=sum(sets),
        sets=len(sets),
        rms_m=result.position_rms_m,
        bound_m=result.position_bound_m,
        late_m=root_mean_square(errors),
        late_bound_m=root_mean_square(bounds),
        counts={"unanswered": sum(point.position_m is None for point in track)},
        wrong=(*wrong_names(track.dropped_sensors, expected.faulty), *_wrong_flags(track, expected.flagged)),
        cpu=clock.ratio,
    )


def root_mean_square(values: FloatArray) -> float:
    return math.sqrt(float(np.mean(values**2))) if len(values) else math.nan


def _holds(point: magloc.TrackPoint, true_m: FloatArray) -> bool:
    """Whether a point's 95 % set of the range holds the true one."""
    range_m = float(np.linalg.norm(true_m - point.centroid_m))
    return any(low <= range_m and (high is None or range_m <= high) for low, high in point.range_interval_m or ())


def wrong_names(dropped: Iterable[Sequence[str]], faulty: Sequence[str]) -> list[str]:
    """Sensors that are named and are well, and those that are not and are never named."""
    named = {name for names in dropped for name in names}
    return [f"{name} is well" for name in sorted(named - set(faulty))] + [
        f"{name} is not named" for name in sorted(set(faulty) - named)
    ]


def _wrong_flags(track: magloc.Track, expected: bool) -> list[str]:
    if not track.tracked.any():
        return []
    flagged = track.innovations.flagged
    return [] if flagged == expected else ["flagged" if flagged else "not flagged"]


def differing_rows(some: Sequence[magloc.TrackPoint], others: Sequence[magloc.TrackPoint]) -> int:
    """Rows of which two ways through a record tell something else."""
    return sum(not _same(a, b) for a, b in zip(some, others, strict=True))


def _same(a: magloc.TrackPoint, b: magloc.TrackPoint) -> bool:
    if (a.time_s, a.status, a.dropped_sensors) != (b.time_s, b.status, b.dropped_sensors):
        return False
    if a.position_m is None or b.position_m is None or a.moment_Am2 is None or b.moment_Am2 is None:
        return a.position_m is None and b.position_m is None
    return bool(
        np.abs(a.position_m - b.position_m).max() <= SAME_M
        and np.abs(a.moment_Am2 - b.moment_Am2).max() <= SAME_MOMENT * np.linalg.norm(b.moment_Am2)
    )


def run_of_sources(
    seed: int,
    array: SensorArray,
    readings: Readings,
    truth: Magnets,
    *,
    faulty: tuple[str, ...] = (),
    **options: Any,
) -> Run:
    """Magnets over a board through :func:`magloc.track_sources`."""
    clock = Clock()
    with clock.measure():
        points = list(magloc.track_sources(array, readings, **options))
    there, first = truth.present.sum(axis=0), len(points) // FIRST_ROWS
    tracked = sum(min(len(point.tracks), int(n)) for point, n in zip(points, there, strict=True))
    untimed = np.zeros(len(points))
    run, late = judged_sources(points, truth, untimed), judged_sources(points[first:], truth.since(first), untimed)
    return Run(
        seed,
        tracked=tracked,
        nees=run.nees,
        nees_late=late.nees,
        nees_numbers=N_STATES * tracked,
        rms_m=run.rms_m,
        counts={"swaps": run.swaps, "rows with too many": run.false_births, "misfit rows": run.misfit_rows},
        wrong=tuple(wrong_names((point.dropped_sensors for point in points), faulty)),
        cpu=clock.ratio,
    )
