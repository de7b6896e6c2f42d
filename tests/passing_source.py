"""A source that passes a tetrahedron, its readings, and what tests ask of a track."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays import geometries
from arrays.array import SensorArray
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.tracking.motion import RandomWalk
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row, rows_of
from magloc.tracking.track import Track
from magloc.tracking.tracker import Tracker
from sims.magnetics.simulation import Simulation

FloatArray = NDArray[np.float64]
EDGE_M, NOISE_T = 1.5, 2e-10
POSITION = np.array([3.0, 1.5, 0.8])
MOMENT = np.array([120.0, -150.0, 160.0])
ARRAY = geometries.tetrahedron(EDGE_M, "vector", NOISE_T)
SLOW = RandomWalk(0.1, math.radians(1.2))


def moving_source(n: int, dt_s: float = 0.5) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Times, and positions and moments (n, 3) of a source that passes at 0.08 m/s and turns by 1 degree a second."""
    t = dt_s * np.arange(n, dtype=np.float64)
    p = POSITION + np.outer(t, [-0.08, 0.02, 0.0])
    return t, p, Rotation.from_rotvec(np.outer(np.deg2rad(t), [0.0, 0.0, 1.0])).apply(MOMENT)


def readings_of(array: SensorArray, p: FloatArray, m: FloatArray, seed: int = 0) -> FloatArray:
    """Readings (n, C) of a source (n, 3) with white noise."""
    noise = np.random.default_rng(seed).normal(size=(len(p), array.n_channels))
    return predicted_channels(array, p, m) + array.channel_noise_T * noise


def rows_from(time_s: FloatArray, readings_T: FloatArray) -> list[Row]:
    return list(rows_of(Readings(readings_T, time_s=time_s)))


def statuses(points: list[TrackPoint]) -> list[str]:
    return [point.status for point in points]


class ReadableTracker(Tracker):
    """Takes the readable steps alone."""

    is_compiled = False


def followed(tracker: Tracker, rows: list[Row], progress: Callable[[int], None] | None = None) -> list[TrackPoint]:
    return list(tracker.run(rows, progress))


def positions(points: list[TrackPoint]) -> FloatArray:
    return np.array([np.full(3, np.nan) if point.position_m is None else point.position_m for point in points])


def nees(simulation: Simulation, track: Track) -> float:
    """Of the last row, six numbers."""
    truth = simulation.truth
    assert truth.moment_Am2 is not None
    true = np.concatenate([truth.position_m[-1], truth.moment_Am2[-1]])
    error = true - np.concatenate([track.position_m[-1], track.moment_Am2[-1]])
    return float(error @ np.linalg.solve(track.covariance[-1], error))
