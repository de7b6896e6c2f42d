"""Scenarios of several sources over a board: those of tests/moving_magnets.py, shorter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np

import magloc
import sims
from arrays.array import SensorArray
from magloc.readings import Readings
from magloc.truth import truth_of_rows
from sims.magnetics.scenario import MagneticScenario
from tests.moving_magnets import RATE_HZ, Magnets, Within, board, with_fault
from tests.tracking_figures.figures import Run
from tests.tracking_figures.judging import run_of_sources

GAP_M = 0.02
ONE_BY_ONE = Within(one_by_one=True)


def read(array: SensorArray, truth: Magnets, rng: np.random.Generator) -> Readings:
    """Readings of the board."""
    values_T = truth.readings_T(array, rng)
    return Readings(values_T, time_s=np.arange(len(values_T)) / RATE_HZ)


def magnets(
    k: int,
    seconds: float,
    sources: int | Literal["auto"],
    seed: int,
    *,
    come_and_go: bool = False,
    slide_m: float = 0.0,
) -> Run:
    """Magnets that keep a gap; the last one may come and go, or slide in."""
    rng, array = np.random.default_rng(seed), board()
    truth = Magnets.drawn(k, int(seconds * RATE_HZ), GAP_M, rng, come_and_go=come_and_go, within=ONE_BY_ONE)
    if slide_m:
        truth = truth.sliding(slide_m, rng)
    return run_of_sources(seed, array, read(array, truth, rng), truth, sources=sources)


def crossing(seconds: float, seed: int) -> Run:
    """Two magnets pass each other, to and fro."""
    rng, array = np.random.default_rng(seed), board()
    truth = Magnets.crossing(int(seconds * RATE_HZ), GAP_M, rng)
    return run_of_sources(seed, array, read(array, truth, rng), truth)


def faulty_sensor(kind: str, seconds: float, seed: int) -> Run:
    """A sensor fails in the middle, with two magnets."""
    rng, array = np.random.default_rng(seed), board()
    truth = Magnets.drawn(2, int(seconds * RATE_HZ), GAP_M, rng, within=ONE_BY_ONE)
    readings = read(array, truth, rng)
    sensor = int(rng.integers(array.n_sensors))
    wrong = with_fault(readings.values_T, kind, sensor, len(readings) // 2)
    return run_of_sources(seed, array, replace(readings, values_T=wrong), truth, faulty=(array.ids[sensor],))


def three_magnets(seed: int) -> Run:
    """The built-in scenario; its third magnet comes later and goes earlier."""
    scenario = sims.read_scenario("three-magnets")
    assert isinstance(scenario, MagneticScenario)
    simulation = sims.simulate(scenario, seed)
    truths = [truth_of_rows(simulation.readings, truth) for truth in simulation.truths]
    places, moments = (np.stack([getattr(true, name) for true in truths]) for name in ("position_m", "moment_Am2"))
    present = np.isfinite(places).all(axis=2)
    # A magnet that is not there is far from every track.
    truth = Magnets(np.where(present[..., None], places, 1e3), np.nan_to_num(moments), present)
    return run_of_sources(seed, simulation.array, simulation.readings, truth)


def recorded_board(seed: int) -> Run:
    """One magnet, by the filter of several: the recording that comes with the package, whatever the seed."""
    data = magloc.datasets.load("board")
    true = truth_of_rows(data.readings, data.truth)
    assert true.moment_Am2 is not None
    truth = Magnets(true.position_m[None], true.moment_Am2[None], np.ones((1, len(data.readings)), dtype=bool))
    return run_of_sources(seed, data.array, data.readings, truth, sources=1)


RUNS: dict[str, tuple[Callable[[int], Run], range]] = {
    "one magnet, auto": (partial(magnets, 1, 2.0, "auto"), range(1000, 1003)),
    "two magnets, first seconds": (partial(magnets, 2, 2.0, "auto"), range(20010, 20014)),
    "two magnets, told": (partial(magnets, 2, 4.0, 2), range(20000, 20006)),
    "two magnets, auto": (partial(magnets, 2, 6.0, "auto"), range(20000, 20008)),
    "three magnets, told": (partial(magnets, 3, 4.0, 3), range(20000, 20006)),
    "three magnets, auto": (partial(magnets, 3, 6.0, "auto"), range(20000, 20010)),
    "a magnet comes and goes": (partial(magnets, 2, 4.0, "auto", come_and_go=True), range(2100, 2106)),
    "a magnet slides in": (partial(magnets, 3, 7.0, "auto", slide_m=0.3), range(4000, 4006)),
    "magnets pass each other": (partial(crossing, 4.0), range(6000, 6006)),
    **{
        f"two magnets, sensor {kind}": (partial(faulty_sensor, kind, 3.0), range(3100, 3104))
        for kind in ("zero", "stuck", "noisy", "drift")
    },
    "three-magnets": (three_magnets, range(100, 102)),
    "recorded board, several": (recorded_board, range(1)),
}
