"""Rows that come one by one against a whole record: the same points, to 1e-9 m and 1e-9 of the moment.

What stands in `counts` is the number of rows that differ, which must stay none.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

import magloc
import sims
from arrays.array import SensorArray
from arrays.geometries import axial
from magloc.readings import Readings
from magloc.tracking.motion import MotionModel
from sims.magnetics.scenario import MagneticScenario
from tests.moving_magnets import RATE_HZ, Magnets, board
from tests.passing_source import ARRAY, SLOW
from tests.tracked_sources import PASSING, REST, WALK, WHITE, drawn, walk_from_5_m, with_fault
from tests.tracking_figures.figures import Run
from tests.tracking_figures.judging import Clock, differing_rows
from tests.tracking_figures.one_source import FAULT, MOTIONS, N_FAULT, WANDERING


def compare_streams(seed: int, array: SensorArray, readings: Readings, motion: MotionModel) -> Run:
    """Points of :func:`magloc.track` against those of :class:`magloc.Tracker`, row by row."""
    whole = magloc.track(array, readings, motion=motion)
    tracker, clock = magloc.Tracker(array, motion), Clock()
    with clock.measure():
        points = [tracker.update(row) for row in rows_of(readings)]
    return Run(
        seed,
        tracked=sum(point.is_on_track for point in points),
        counts={"rows that differ": differing_rows(points, whole)},
        cpu=clock.ratio,
    )


def rows_of(readings: Readings) -> list[Readings]:
    return [readings[i : i + 1] for i in range(len(readings))]


def built_in(name: str, duration_s: float, seed: int, *, motion: MotionModel | None = None) -> Run:
    scenario = sims.read_scenario(name)
    assert isinstance(scenario, MagneticScenario)
    simulation = sims.simulate(replace(scenario, duration_s=duration_s), seed)
    return compare_streams(seed, simulation.array, simulation.readings, motion or MOTIONS[name])


def first_rows(seed: int) -> Run:
    return compare_streams(seed, ARRAY, drawn(WALK, 40, seed)[1], WALK)


def faulty(seed: int) -> Run:
    """A sensor is stuck for a while, and rows are missing."""
    _, readings, rng = walk_from_5_m(ARRAY, N_FAULT, seed)
    values_T = with_fault("stuck", readings.values_T, FAULT, slice(3, 6), rng)
    values_T[150:155] = np.nan
    return compare_streams(seed, ARRAY, replace(readings, values_T=values_T), SLOW)


def pair_of_sensors(seed: int) -> Run:
    pair = replace(PASSING, array=axial(1.2, "vector"), models=PASSING.models[:2])
    simulation = sims.simulate(pair, seed)
    return compare_streams(seed, simulation.array, simulation.readings, REST)


def posed(seed: int) -> Run:
    """Without errors of the clock: how fast the array moves, a stream knows from the rows before alone."""
    simulation = sims.simulate(replace(PASSING, pose=replace(WHITE, time_s=0.0)), seed)
    return compare_streams(seed, simulation.array, simulation.readings, REST)


def two_magnets(seed: int) -> Run:
    """The same of several sources."""
    rng, array = np.random.default_rng(seed), board()
    values_T = Magnets.drawn(2, 200, 0.02, rng, come_and_go=True).readings_T(array, rng)
    readings = Readings(values_T, time_s=np.arange(len(values_T)) / RATE_HZ)
    whole, tracker, clock = magloc.track_sources(array, readings), magloc.SourcesTracker(array), Clock()
    with clock.measure():
        points = [tracker.update(row) for row in rows_of(readings)]
    same = [
        (a.status, a.dropped_sensors, [track.id for track in a.tracks])
        == (b.status, b.dropped_sensors, [track.id for track in b.tracks])
        and not differing_rows(a.tracks, b.tracks)
        for a, b in zip(points, whole, strict=True)
    ]
    return Run(
        seed,
        tracked=sum(len(point.tracks) for point in points),
        counts={"rows that differ": same.count(False)},
        cpu=clock.ratio,
    )


RUNS: dict[str, tuple[Callable[[int], Run], range]] = {
    "stream, weaving": (partial(built_in, "weaving", 80.0), range(100, 101)),
    "stream, weaving wandering": (partial(built_in, "weaving", 80.0, motion=WANDERING), range(100, 101)),
    "stream, ship": (partial(built_in, "ship", 15.0), range(100, 101)),
    "stream, diver": (partial(built_in, "diver", 12.0), range(100, 101)),
    "stream, drone": (partial(built_in, "drone", 12.0), range(100, 101)),
    "stream, hand-magnet": (partial(built_in, "hand-magnet", 2.0), range(100, 101)),
    "stream, first rows": (first_rows, range(60000, 60004)),
    "stream, faulty sensor": (faulty, range(100, 102)),
    "stream, pair of sensors": (pair_of_sensors, range(100, 101)),
    "stream, pose": (posed, range(1000, 1002)),
    "stream, two magnets": (two_magnets, range(100, 102)),
}
