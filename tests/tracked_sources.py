"""Truths and readings of tracked sources, that tests and figures of tracks share; of the tracker its motions alone.

Seeds are not chosen.
"""

from __future__ import annotations

import math

import numpy as np

import magloc
from arrays.array import SensorArray
from arrays.geometries import tetrahedron
from arrays.pose import PoseUncertainty
from arrays.typing import FloatArray
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.tracking.motion import MotionModel
from sims.magnetics.paths import Attitude, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Source
from sims.magnetics.sensors import SensorModel
from tests.passing_source import ARRAY, NOISE_T, SLOW

DT_S, RANGE_M, MOMENT_AM2 = 0.5, 8.0, 250.0
WALK, VELOCITY = SLOW, magloc.OrnsteinUhlenbeck(0.1, SLOW.turn_rad_s, correlation_s=math.inf)
# A weak source comes from far away, so many standard deviations strong in the first row, in so many rows.
FAR_M, NEAR_M, N_APPROACH = 20.0, 5.0, 60
SNR = (4.0, 6.0)
APPROACH_M_S = math.sqrt(FAR_M**2 - NEAR_M**2) / (DT_S * (N_APPROACH - 1))
APPROACH = magloc.OrnsteinUhlenbeck(APPROACH_M_S / math.sqrt(3.0), math.radians(1.2), correlation_s=math.inf)
# Known moment: its modulus and σ.
MODULUS_AM2, MODULUS_SIGMA_AM2 = MOMENT_AM2, 5.0

REST = magloc.RandomWalk(1e-5, 1e-5)
WHITE = PoseUncertainty(0.02, math.radians(0.3), 0.02, 0.0, 0.0, 0.0)
_SWAYING = Attitude(True, wobble_rad=(0.1, 0.08, 0.1), wobble_period_s=(5.3, 4.1, 7.7))
_AT_REST = (Source(Carrier(Steered((0.0, 0.0, -1.0))), moment_Am2=(40.0, -20.0, 30.0)),)
# An array that passes a source at rest, in 10 s; and slowly, in a minute, for a background.
PASSING = MagneticScenario(
    tetrahedron(1.2),
    (SensorModel("vector", noise_T_rtHz=1e-10 / math.sqrt(2.5)),) * 4,
    duration_s=10.0,
    rate_Hz=5.0,
    carrier=Carrier(Steered((-2.5, 0.5, 2.0), speed_m_s=0.5), _SWAYING),
    sources=_AT_REST,
)
BACKGROUND_NOISE_T, CORNER_HZ = 1e-10, 0.01
_SLOW_RATE_HZ = 2.5
PASSING_SLOWLY = MagneticScenario(
    tetrahedron(1.2),
    (SensorModel("vector", noise_T_rtHz=BACKGROUND_NOISE_T / math.sqrt(0.5 * _SLOW_RATE_HZ)),) * 4,
    duration_s=60.0,
    rate_Hz=_SLOW_RATE_HZ,
    carrier=Carrier(Steered((-3.0, 0.5, 2.0), speed_m_s=0.1), _SWAYING),
    sources=_AT_REST,
)


def _readings(array: SensorArray, truth: FloatArray, rng: np.random.Generator, dt_s: float = DT_S) -> Readings:
    """Readings of sources (n, 6 or more) with white noise."""
    values_T = predicted_channels(array, truth[:, :3], truth[:, 3:6])
    values_T += array.channel_noise_T * rng.normal(size=values_T.shape)
    return Readings(values_T, time_s=dt_s * np.arange(len(truth)))


def drawn(motion: MotionModel, n: int, seed: int, array: SensorArray = ARRAY) -> tuple[FloatArray, Readings]:
    """True states (n, n_states), drawn from the motion model, from 8 m on, and readings of them."""
    rng = np.random.default_rng(seed)
    direction, moment = rng.normal(size=(2, 3))
    place = array.centroid + RANGE_M * direction / np.linalg.norm(direction)
    source = np.concatenate([place, MOMENT_AM2 * moment / np.linalg.norm(moment)])
    x, S = motion.start(source, np.zeros((6, 6)))
    truth = _moved(motion, x + S @ rng.normal(size=len(x)), n, rng)
    return truth, _readings(array, truth, rng)


def approach(seed: int) -> tuple[FloatArray, Readings]:
    """True positions and moments (n, 6) of a weak source that comes nearer, and readings of them."""
    rng = np.random.default_rng(seed)
    toward, moment = rng.normal(size=(2, 3))
    toward /= np.linalg.norm(toward)
    aside = np.cross(toward, rng.normal(size=3))
    aside /= np.linalg.norm(aside)
    first = ARRAY.centroid + NEAR_M * toward + APPROACH_M_S * DT_S * (N_APPROACH - 1) * aside
    seen = predicted_channels(ARRAY, first, moment).reshape(-1, 3)
    strength = rng.uniform(*SNR) * NOISE_T / float(np.linalg.norm(seen - seen.mean(axis=0)))
    x, _ = APPROACH.start(np.concatenate([first, strength * moment]), np.zeros((6, 6)))
    x[6:9], x[9:] = -APPROACH_M_S * aside, APPROACH.turn_rad_s * rng.normal(size=3)
    truth = _moved(APPROACH, x, N_APPROACH, rng)[:, :6]
    return truth, _readings(ARRAY, truth, rng)


def walk_from_5_m(array: SensorArray, n: int, seed: int) -> tuple[FloatArray, Readings, np.random.Generator]:
    """A slow walk (n, 6) from 5 m on, readings of it, and the generator for what is wrong with them."""
    rng = np.random.default_rng(seed)
    direction, moment = rng.normal(size=(2, 3))
    place = array.centroid + 5.0 * direction / np.linalg.norm(direction)
    x, _ = SLOW.start(np.concatenate([place, MOMENT_AM2 * moment / np.linalg.norm(moment)]), np.zeros((6, 6)))
    truth = _moved(SLOW, x, n, rng)
    return truth, _readings(array, truth, rng), rng


def _moved(motion: MotionModel, x: FloatArray, n: int, rng: np.random.Generator) -> FloatArray:
    """States (n, n_states) drawn from a motion model, from x on."""
    states = [x]
    while len(states) < n:
        mean, _, S_q = motion.step(states[-1], DT_S)
        states.append(mean + S_q @ rng.normal(size=S_q.shape[1]))
    return np.array(states)


def with_fault(fault: str, good: FloatArray, rows: slice, channels: slice, rng: np.random.Generator) -> FloatArray:
    """Readings of which a sensor is stuck at its last good one, zero, or 20 times as noisy in some rows."""
    wrong, right = good.copy(), good[rows, channels]
    noisy = right + 20.0 * NOISE_T * rng.normal(size=right.shape)
    wrong[rows, channels] = {"stuck": good[rows.start - 1, channels], "zero": 0.0, "noisy": noisy}[fault]
    return wrong


def of_known_modulus(seed: int, range_m: float) -> FloatArray:
    """A place in any direction, and a moment in any whose modulus errs as is stated (6,)."""
    rng = np.random.default_rng(seed)
    direction, moment = rng.normal(size=(2, 3))
    strength = MODULUS_AM2 + MODULUS_SIGMA_AM2 * rng.normal()
    place = ARRAY.centroid + range_m * direction / np.linalg.norm(direction)
    return np.concatenate([place, strength * moment / np.linalg.norm(moment)])


def walk_of_known_modulus(seed: int, range_m: float, n_rows: int) -> tuple[FloatArray, Readings]:
    """True positions and moments (n, 6): it walks and turns, and is as strong throughout; and readings of them."""
    rng, x, truth, values_T = np.random.default_rng(1000 + seed), of_known_modulus(seed, range_m), [], []
    for _ in range(n_rows):
        truth.append(x.copy())
        values_T.append(predicted_channels(ARRAY, x[:3], x[3:]) + NOISE_T * rng.normal(size=12))
        turn = 0.02 * DT_S * np.cross(rng.normal(size=3), x[3:])
        x[:3] += 0.1 * DT_S * rng.normal(size=3)
        x[3:] = (x[3:] + turn) * np.linalg.norm(x[3:]) / np.linalg.norm(x[3:] + turn)
    return np.array(truth), Readings(np.array(values_T), time_s=DT_S * np.arange(n_rows))


def no_drift(readings: Readings, seed: int) -> FloatArray:
    return np.zeros_like(readings.values_T)


def lines(readings: Readings, seed: int) -> FloatArray:
    """Slopes of 20 σ of a reading over the record."""
    t = readings.time_s - readings.time_s.mean()
    slopes = np.random.default_rng(10_000 + seed).normal(size=readings.values_T.shape[1])
    return np.outer(t, slopes * 20.0 * BACKGROUND_NOISE_T / np.ptp(t))


def walks(readings: Readings, seed: int) -> FloatArray:
    """Offsets of 20 σ, and a random walk as the corner says."""
    rng, shape = np.random.default_rng(20_000 + seed), readings.values_T.shape
    step_T = BACKGROUND_NOISE_T * 2.0 * math.pi * CORNER_HZ / _SLOW_RATE_HZ
    return 20.0 * BACKGROUND_NOISE_T * rng.normal(size=shape[1]) + np.cumsum(step_T * rng.normal(size=shape), axis=0)
