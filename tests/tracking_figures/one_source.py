"""Scenarios of one source: those of ``magloc simulate``, and the tables of docs/validation/tracks.md in small."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

import magloc
import sims
from arrays.array import SensorArray
from arrays.geometries import axial, cube
from arrays.pose import PoseUncertainty
from arrays.typing import FloatArray
from magloc.chi_square import normalised_square
from magloc.readings import Readings
from magloc.tracking.motion import MotionModel
from magloc.truth import Truth
from sims.magnetics.scenario import MagneticScenario
from tests import passing_ship
from tests.magloc.tracking import test_ambient_uncertainty, test_carrier, test_known_motion
from tests.passing_source import ARRAY, EDGE_M, NOISE_T, SLOW
from tests.tracked_sources import (
    APPROACH,
    CORNER_HZ,
    DT_S,
    MODULUS_AM2,
    MODULUS_SIGMA_AM2,
    PASSING,
    PASSING_SLOWLY,
    REST,
    VELOCITY,
    WALK,
    WHITE,
    approach,
    drawn,
    lines,
    walk_from_5_m,
    walk_of_known_modulus,
    walks,
    with_fault,
)
from tests.tracking_figures.figures import Run
from tests.tracking_figures.judging import Clock, Expected, judge, run_of

# What docs/guide/tracking.md tells of the built-in scenarios.
AT_REST = magloc.RandomWalk(1e-6, math.radians(1e-5))
WANDERING = magloc.OrnsteinUhlenbeck(SLOW.speed_m_s, SLOW.turn_rad_s)
MOTIONS: dict[str, MotionModel] = {
    "paper": AT_REST,
    "weaving": SLOW,
    "hand-magnet": magloc.OrnsteinUhlenbeck(0.03, math.radians(20.0), correlation_s=0.5),
    "ship": magloc.OrnsteinUhlenbeck(1.5, math.radians(5.0), correlation_s=10.0),
    "diver": AT_REST,
    "drone": AT_REST,
}
WALKING_POSE = replace(WHITE, correlation_s=10.0)
MOUNTING = {"position_constant_m": 0.05, "attitude_constant_rad": math.radians(0.5)}
SMALL = PoseUncertainty(0.002, math.radians(0.03), 0.0, 0.0, 0.0, 0.0)
CUBE = cube(EDGE_M, "vector", NOISE_T)
N_FAULT, FAULT = 200, slice(80, 120)


def truth_of(readings: Readings, states: FloatArray) -> Truth:
    """Of true states (n, 6 or more)."""
    return Truth(readings.time_s, states[:, :3], states[:, 3:6])


def noisier(array: SensorArray, noise_T: float) -> SensorArray:
    return replace(array, sensors=tuple(replace(sensor, noise_T=noise_T) for sensor in array.sensors))


def built_in(name: str, seed: int, *, duration_s: float | None = None, **options: object) -> Run:
    """A scenario of ``magloc simulate`` with the motion that the guide tells."""
    scenario = sims.read_scenario(name)
    assert isinstance(scenario, MagneticScenario)
    if duration_s is not None:
        scenario = replace(scenario, duration_s=duration_s)
    simulation = sims.simulate(scenario, seed)
    given = {"motion": MOTIONS[name]} | options
    return run_of(seed, simulation.array, simulation.readings, simulation.truth, **given)  # type: ignore[arg-type]


def dataset(name: str, seed: int, *, motion: MotionModel) -> Run:
    """A recording that comes with the package; there is one, whatever the seed."""
    data = magloc.datasets.load(name)
    return run_of(seed, data.array, data.readings, data.truth, motion=motion)


def first_rows(motion: MotionModel, noise_T: float, n: int, seed: int) -> Run:
    """Drawn from the motion that is told, 8 m away at first."""
    array = noisier(ARRAY, noise_T)
    states, readings = drawn(motion, n, seed, array)
    return run_of(seed, array, readings, truth_of(readings, states), motion=motion)


def weak_approach(seed: int) -> Run:
    states, readings = approach(seed)
    return run_of(seed, ARRAY, readings, truth_of(readings, states), motion=APPROACH)


def faulty_sensor(array: SensorArray, fault: str, seed: int) -> Run:
    """Any one sensor is wrong for a while."""
    states, readings, rng = walk_from_5_m(array, N_FAULT, seed)
    sensor = int(rng.integers(array.n_sensors))
    wrong = with_fault(fault, readings.values_T, FAULT, slice(3 * sensor, 3 * sensor + 3), rng)
    expected = Expected(faulty=(array.ids[sensor],))
    return run_of(
        seed, array, replace(readings, values_T=wrong), truth_of(readings, states), expected=expected, motion=SLOW
    )


def gaps(seed: int) -> Run:
    """A walk of which one reading in twenty is missing, whole rows, and twenty rows together."""
    states, readings, rng = walk_from_5_m(ARRAY, N_FAULT, seed)
    values_T = np.where(rng.random(readings.values_T.shape) < 0.05, np.nan, readings.values_T)
    values_T[rng.random(N_FAULT) < 0.05] = values_T[100:120] = np.nan
    return run_of(seed, ARRAY, replace(readings, values_T=values_T), truth_of(readings, states), motion=SLOW)


def spikes(seed: int) -> Run:
    """A walk of which one row in thirty has one reading that is off by 2,500 σ: a sensor is left out of that row."""
    states, readings, rng = walk_from_5_m(ARRAY, N_FAULT, seed)
    values_T = readings.values_T.copy()
    rows = np.flatnonzero(rng.random(N_FAULT) < 1.0 / 30.0)
    channels = rng.integers(ARRAY.n_channels, size=len(rows))
    values_T[rows, channels] += 5e-7
    expected = Expected(faulty=tuple({ARRAY.ids[channel // 3] for channel in channels}))
    return run_of(
        seed, ARRAY, replace(readings, values_T=values_T), truth_of(readings, states), expected=expected, motion=SLOW
    )


def on_lines(seed: int) -> Run:
    """``--detrend``: every channel has a slope."""
    simulation = sims.simulate(PASSING_SLOWLY, seed)
    values_T = simulation.readings.values_T + lines(simulation.readings, seed)
    readings = replace(simulation.readings, values_T=values_T).detrended()
    return run_of(seed, simulation.array, readings, simulation.truth, motion=REST)


def on_walks(seed: int, *, smooth: bool = False) -> Run:
    """``--high-pass-hz``: every channel has an offset and a random walk."""
    simulation = sims.simulate(PASSING_SLOWLY, seed)
    values_T = simulation.readings.values_T + walks(simulation.readings, seed)
    readings = replace(simulation.readings, values_T=values_T).high_passed(CORNER_HZ)
    return run_of(seed, simulation.array, readings, simulation.truth, motion=REST, smooth=smooth)


def weaving_on_offsets(say: Callable[[Readings], Readings], seed: int) -> Run:
    simulation = sims.simulate(sims.read_scenario("weaving"), seed)  # type: ignore[arg-type]
    return run_of(seed, simulation.array, say(simulation.readings), simulation.truth, motion=WANDERING)


def posed(
    scenario: MagneticScenario, errs: PoseUncertainty, stated: PoseUncertainty | None, flagged: bool, seed: int
) -> Run:
    """An array whose pose errs passes a source at rest."""
    simulation = sims.simulate(replace(scenario, pose=errs), seed)
    array = replace(simulation.array, pose=stated)
    return run_of(seed, array, simulation.readings, simulation.truth, expected=Expected(flagged=flagged), motion=REST)


def ambient(constant_T: float, white_T: float, stated: bool, seed: int) -> Run:
    """Moduli in an ambient field that errs."""
    clock = Clock()
    with clock.measure():
        simulation, track = test_ambient_uncertainty.run(seed, constant_T, white_T, stated=stated)
    return judge(seed, track, simulation.truth, Expected(flagged=not stated), clock)


def carrier(scenario: MagneticScenario, seed: int) -> Run:
    """An array whose carrier the ambient field magnetises."""
    clock = Clock()
    with clock.measure():
        simulation, track = test_carrier.run(scenario, seed)
    return judge(seed, track, simulation.truth, Expected(), clock)


def known_modulus(range_m: float, seed: int) -> Run:
    states, readings = walk_of_known_modulus(seed, range_m, 30)
    prior = magloc.SourcePrior(known_moment_Am2=MODULUS_AM2, known_moment_sigma_Am2=MODULUS_SIGMA_AM2)
    motion = magloc.RandomWalk(0.1, 0.02)
    return run_of(seed, ARRAY, readings, truth_of(readings, states), motion=motion, prior=prior)


def known_components(seed: int) -> Run:
    """Three numbers of the moment are known, of a source at rest 8 m away."""
    states, readings = drawn(REST, 30, seed)
    wrong = states[0, 3:6] + 5.0 * np.random.default_rng(seed).normal(size=3)
    x, y, z = wrong.tolist()
    prior = magloc.SourcePrior(known_moment_Am2=(x, y, z), known_moment_sigma_Am2=5.0)
    return run_of(seed, ARRAY, readings, truth_of(readings, states), motion=REST, prior=prior)


def known_motion(seed: int) -> Run:
    """The array measures its own velocity and rates."""
    readings, p, m = test_known_motion.seen_from_a_moving_array(seed, 0.01, 0.003)
    return run_of(seed, ARRAY, readings, Truth(readings.time_s, p, m), motion=magloc.RandomWalk(1e-3, 1e-3))


def known_path(smooth: bool, seed: int) -> Run:
    """The moment of ``ship-headings`` on its path: ``magloc track --object-path``."""
    ship = sims.simulate(sims.read_scenario("ship-headings"), seed)  # type: ignore[arg-type]
    error = ship.scenario.sources[0].path_error
    clock = Clock()
    with clock.measure():
        track = magloc.track_moment(
            ship.array, ship.readings, ship.paths[0], turn_rad_s=math.radians(3.0), path_error=error, smooth=smooth
        )
    result = track.consistency(ship.truth)
    return Run(
        seed,
        tracked=int(track.tracked.sum()),
        nees=result.nees_per_dimension,
        nees_numbers=3 * result.rows,
        rms_m=result.moment_rms_Am2,
        bound_m=result.moment_bound_Am2,
        wrong=("flagged",) if track.misfit else (),
        cpu=clock.ratio,
    )


def signature(seed: int) -> Run:
    """The constant parts of the same ship's moment."""
    scenario = sims.read_scenario("ship-headings")
    assert isinstance(scenario, MagneticScenario)
    ship, source = sims.simulate(scenario, seed), scenario.sources[0]
    clock = Clock()
    with clock.measure():
        found = magloc.fit_signature(ship.array, ship.readings, ship.paths[0], path_error=source.path_error)
    induced = np.diag(source.polarisability_m3) * found.components.ambient_T / passing_ship.MU0
    error = found.parameters_Am2 - np.concatenate([source.moment_Am2, induced])
    return Run(
        seed,
        tracked=len(ship.readings),
        nees=float(normalised_square(error, found.covariance)) / error.size,
        nees_numbers=error.size,
        rms_m=float(np.linalg.norm(error)),
        wrong=("flagged",) if found.misfit else (),
        cpu=clock.ratio,
    )


def pair_of_sensors(seed: int) -> Run:
    """Two sensors have three differences a row: no row alone determines a source."""
    pair = replace(PASSING, array=axial(1.2, "vector"), models=PASSING.models[:2])
    simulation = sims.simulate(pair, seed)
    return run_of(seed, simulation.array, simulation.readings, simulation.truth, motion=REST)


def turning(seed: int) -> Run:
    """A source on a circle: a steady turn about the vertical."""
    t, rate = DT_S * np.arange(80), 0.05
    place = np.stack([6.0 + 2.0 * np.cos(rate * t), 2.0 * np.sin(rate * t), 1.0 + 0.0 * t], axis=1)
    moment = Rotation.from_rotvec(np.outer(rate * t, [0.0, 0.0, 1.0])).apply([120.0, -150.0, 160.0])
    values_T = ARRAY.readings_of(
        np.stack([magloc.dipole.field(ARRAY.positions, p, m) for p, m in zip(place, moment, strict=True)])
    )
    values_T = values_T + NOISE_T * np.random.default_rng(seed).normal(size=values_T.shape)
    readings = Readings(values_T, time_s=t)
    return run_of(seed, ARRAY, readings, Truth(t, place, moment), motion=magloc.CoordinatedTurn(0.02, 0.02))


RUNS: dict[str, tuple[Callable[[int], Run], range]] = {
    "paper": (partial(built_in, "paper"), range(100, 102)),
    "weaving": (partial(built_in, "weaving"), range(100, 102)),
    "weaving, wandering": (partial(built_in, "weaving", motion=WANDERING), range(100, 102)),
    "weaving, smoothed": (partial(built_in, "weaving", motion=WANDERING, smooth=True), range(100, 102)),
    "hand-magnet": (partial(built_in, "hand-magnet", duration_s=4.0), range(100, 102)),
    "ship": (partial(built_in, "ship"), range(100, 102)),
    "ship, smoothed": (partial(built_in, "ship", smooth=True), range(100, 101)),
    "diver": (partial(built_in, "diver"), range(100, 102)),
    "drone": (partial(built_in, "drone"), range(100, 102)),
    "ship-headings, moment": (partial(known_path, False), range(100, 102)),
    "ship-headings, moment smoothed": (partial(known_path, True), range(100, 102)),
    "ship-headings, signature": (signature, range(5000, 5006)),
    "recorded board": (partial(dataset, "board", motion=MOTIONS["hand-magnet"]), range(1)),
    "recorded diver": (partial(dataset, "diver", motion=AT_REST), range(1)),
    "recorded drone": (partial(dataset, "drone", motion=AT_REST), range(1)),
    "recorded ship": (partial(dataset, "ship", motion=MOTIONS["ship"]), range(1)),
    "first rows, walk": (partial(first_rows, WALK, 2e-10, 40), range(60000, 60024)),
    "first rows, walk, 1 nT": (partial(first_rows, WALK, 1e-9, 40), range(60000, 60024)),
    "first rows, velocity": (partial(first_rows, VELOCITY, 2e-10, 40), range(60000, 60024)),
    "first rows, velocity, 1 nT": (partial(first_rows, VELOCITY, 1e-9, 40), range(60000, 60024)),
    "weak approach": (weak_approach, range(21000, 21008)),
    "turning": (turning, range(100, 103)),
    **{
        f"sensor {fault}, four": (partial(faulty_sensor, ARRAY, fault), range(100, 103))
        for fault in ("stuck", "zero", "noisy")
    },
    "sensor noisy, eight": (partial(faulty_sensor, CUBE, "noisy"), range(100, 102)),
    "gaps": (gaps, range(100, 103)),
    "spikes": (spikes, range(100, 103)),
    "background, lines": (on_lines, range(4)),
    "background, walks": (on_walks, range(4)),
    "background, walks smoothed": (partial(on_walks, smooth=True), range(1)),
    "weaving on offsets, high-pass": (partial(weaving_on_offsets, lambda one: one.high_passed(0.01)), range(2)),
    "weaving on offsets, detrend": (partial(weaving_on_offsets, Readings.detrended), range(2)),
    "pose, white": (partial(posed, PASSING, WHITE, WHITE, False), range(1000, 1006)),
    "pose, walk": (partial(posed, PASSING, WALKING_POSE, WALKING_POSE, False), range(1000, 1006)),
    "pose, walk and mounting": (
        partial(posed, PASSING, replace(WALKING_POSE, **MOUNTING), replace(WALKING_POSE, **MOUNTING), False),
        range(1000, 1006),
    ),
    "pose, not stated": (partial(posed, PASSING, SMALL, None, True), range(1000, 1006)),
    "pose, walk stated as white": (partial(posed, PASSING, WALKING_POSE, WHITE, True), range(1000, 1006)),
    "diver, pose white": (
        partial(posed, sims.read_scenario("diver"), WHITE, WHITE, False),  # type: ignore[arg-type]
        range(3000, 3001),
    ),
    "moduli, ambient exact": (partial(ambient, 0.0, 0.0, True), range(1000, 1006)),
    "moduli, ambient 500 nT": (partial(ambient, 500e-9, 0.0, True), range(1000, 1006)),
    "moduli, ambient 50 nT in every row": (partial(ambient, 0.0, 50e-9, True), range(1000, 1006)),
    "moduli, ambient not stated": (partial(ambient, 500e-9, 0.0, False), range(1000, 1006)),
    "carrier, vectors": (partial(carrier, test_carrier.SCENARIO), range(2000, 2005)),
    "carrier, moduli": (partial(carrier, test_carrier.MODULI), range(2000, 2005)),
    "known modulus, 8 m": (partial(known_modulus, 8.0), range(100, 106)),
    "known modulus, 14 m": (partial(known_modulus, 14.0), range(100, 103)),
    "known components": (known_components, range(100, 103)),
    "known motion": (known_motion, range(100, 106)),
    "pair of sensors": (pair_of_sensors, range(100, 102)),
}
