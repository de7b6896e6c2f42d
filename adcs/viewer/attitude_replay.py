"""Data of a replay of an attitude: body axes, uncertainties, directions measured and expected."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from adcs import quaternion
from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Telemetry
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.truth import nearest_rows

ENLARGEMENTS = (1.0, 10.0, 100.0, 1e3, 1e4)
_LARGEST_DRAWN_DEG = 10.0  # most enlarged errors and cones are below it
_SAME_INSTANT = 1e-6
_LARGEST_RAD = math.radians(80.0)
SENSOR_WORDS = {"st": "star tracker", "gyro": "gyro", "mag": "magnetometer", "sun": "Sun sensor"}


@dataclass(frozen=True, eq=False)
class Direction:
    """Direction that a sensor measures.

    Attributes
    ----------
    name : str
    measured : ndarray, shape (n, 3)
        Unit vectors in body axes, NaN without a reading.
    expected : ndarray, shape (n, 3)
        Unit vectors in the frame of the attitude.
    """

    name: str
    measured: FloatArray
    expected: FloatArray


@dataclass(frozen=True, eq=False)
class AttitudeReplay:
    """Attitude at n instants, with its measurements.

    Attributes
    ----------
    title : str
    axes : tuple of 3 str
        Names of the frame's axes, the last one upwards.
    time_s : ndarray, shape (n,)
    q : ndarray, shape (n, 4)
        Estimated attitude, frame from body, scalar first.
    sigma_rad : ndarray, shape (n, 3)
        Standard deviation about each body axis [rad], NaN where unknown.
    q_true : ndarray, shape (n, 4)
        True attitude, NaN where unknown.
    directions : tuple of Direction
    seen, rejected : mapping of str to ndarray of bool, shape (n,)
        Rows in which each sensor has a reading, and rows in which it was not used.
    """

    title: str
    axes: tuple[str, str, str]
    time_s: FloatArray
    q: FloatArray
    sigma_rad: FloatArray
    q_true: FloatArray
    directions: tuple[Direction, ...]
    seen: Mapping[str, BoolArray]
    rejected: Mapping[str, BoolArray]

    @cached_property
    def known(self) -> BoolArray:
        """Whether the truth is known in each row, shape (n,)."""
        return np.asarray(np.isfinite(self.q_true).all(axis=1))

    @cached_property
    def errors_rad(self) -> FloatArray:
        """Rotation vectors (n, 3) from true to estimated body axes, in these; NaN where unknown."""
        errors = np.full((len(self.q), 3), np.nan)
        if self.known.any():
            turn = quaternion.to_rotation(self.q_true[self.known]).inv() * quaternion.to_rotation(self.q[self.known])
            errors[self.known] = turn.as_rotvec()
        return errors

    @cached_property
    def enlargement(self) -> float:
        """Largest of :data:`ENLARGEMENTS` that draws most errors and 3σ below 10°."""
        sizes = np.concatenate([np.abs(self.errors_rad), 3.0 * self.sigma_rad])
        sizes = sizes[np.isfinite(sizes)]
        usual = float(np.degrees(np.percentile(sizes, 90.0))) if sizes.size else math.inf
        return max((value for value in ENLARGEMENTS if value * usual <= _LARGEST_DRAWN_DEG), default=1.0)

    def enlarged_attitude(self, row: int, enlargement: float) -> Rotation:
        """Return the attitude (frame from body) with an enlarged error, if the truth is known."""
        if not self.known[row]:
            return quaternion.to_rotation(self.q[row])
        return quaternion.to_rotation(self.q_true[row]) * Rotation.from_rotvec(enlargement * self.errors_rad[row])

    def cones(self, row: int, enlargement: float) -> FloatArray:
        """Return the tangents (3, 2) of the half-angles of each body axis' 3σ cone.

        The two half-angles of an axis are along the next axis and along the one after it.
        """
        half = np.minimum(3.0 * enlargement * self.sigma_rad[row], _LARGEST_RAD)
        # A rotation about the third axis moves the first one along the second.
        return np.tan(np.stack([np.roll(half, -2), np.roll(half, -1)], axis=1))


def replay_of(
    track: AttitudeTrack,
    readings: Telemetry | InertialMagneticRecord | None,
    satellite: Satellite | None,
    truth: FloatArray | None,
    title: str,
) -> AttitudeReplay:
    """Return the replay of a track with its readings.

    ``truth`` (k, 4): true attitudes at the rows of the readings, or of the track without readings.
    """
    q = track.q if track.q_orbital is None else track.q_orbital
    n = len(track)
    own_s, axes = track.time_s, ("x", "y", "z")
    directions: list[Direction] = []
    if isinstance(readings, Telemetry):
        if satellite is None:
            raise ValueError("Input satellite must come with telemetry; instead received None.")
        record = readings.record(satellite)
        at = rows_at(track.time_s, readings.instants_s)
        around, read = record.environment, record.readings
        directions = [
            _direction("field", read.field_T[0], around.b_orbital_T[0], at),
            _direction("Sun", read.sun[0], around.sun_orbital[0], at),
        ]
        own_s, axes = readings.time_s, ("e1, ahead", "e2", "e3, up")
    elif readings is not None:
        at = rows_at(track.time_s, readings.time_s)
        shape, up = (len(readings), 3), [0.0, 0.0, 1.0]
        directions = [_direction("accelerometer", readings.acceleration_m_s2, np.broadcast_to(up, shape), at)]
        if readings.has_field:
            north = quaternion.to_rotation(q[:1]).apply(readings.field_T[np.isfinite(readings.field_T[:, 0])][0])
            directions.insert(0, _direction("field", readings.field_T, np.broadcast_to(north, shape), at))
        own_s, axes = readings.time_s, ("east", "north", "up")
    q_true = np.full((n, 4), np.nan)
    if truth is not None:
        if np.shape(truth) != (len(own_s), 4):
            raise ValueError(f"Input truth must have shape {(len(own_s), 4)}; instead received {np.shape(truth)}.")
        at = rows_at(track.time_s, own_s)
        q_true[at >= 0] = np.asarray(truth)[at[at >= 0]]
    sigma = track.sigma.get("attitude", np.full((n, 3), np.nan))
    return AttitudeReplay(
        title or track.title,
        axes,
        track.time_s,
        q,
        sigma,
        q_true,
        tuple(one for one in directions if np.isfinite(one.measured).any()),
        {SENSOR_WORDS.get(name, name): rows for name, rows in track.seen.items() if rows.any()},
        {SENSOR_WORDS.get(name, name): rows for name, rows in track.rejected.items() if rows.any()},
    )


def rows_at(wanted_s: FloatArray, time_s: FloatArray) -> IntArray:
    """Return the row of each wanted instant, −1 where there is none."""
    nearest = nearest_rows(wanted_s, time_s)
    same = np.abs(time_s[nearest] - wanted_s) <= _SAME_INSTANT * np.maximum(np.abs(wanted_s), 1.0)
    return np.where(same, nearest, -1)


def _direction(name: str, measured: FloatArray, expected: FloatArray, at: IntArray) -> Direction:
    def unit_vectors(values: FloatArray) -> FloatArray:
        vectors = np.where((at >= 0)[:, None], values[at], np.nan)
        return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))

    return Direction(name, unit_vectors(measured), unit_vectors(expected))
