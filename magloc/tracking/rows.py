"""Rows of readings for a tracker."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc import core
from magloc.ambient import in_world_field
from magloc.measurement.magnet import magnet_of
from magloc.measurement.pose import ArrayPose, rates_of
from magloc.readings import Readings, without_saturated


@dataclass(frozen=True, eq=False)
class Row:
    """Readings at one instant.

    Attributes
    ----------
    time_s : float
    readings_T : ndarray, shape (C,)
        Raw readings, NaN where missing.
    origin_m, R_world_from_array : ndarray, shapes (3,) and (3, 3)
        Pose of the array.
    ambient_T : ndarray, shape (3,), optional
        Ambient field in the array's frame, instead of the array's own.
    velocity_m_s, rate_rad_s : ndarray, shape (3,), optional
        Velocity of the array in the world and its rate about its own axes; by default from the row before.
    pose_sigma : ndarray, shape (2,), optional
        Standard deviations of position [m] and attitude [rad], instead of the array's own.
    """

    time_s: float
    readings_T: FloatArray
    origin_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    R_world_from_array: FloatArray = field(default_factory=lambda: np.eye(3))
    ambient_T: FloatArray | None = None
    velocity_m_s: FloatArray | None = None
    rate_rad_s: FloatArray | None = None
    pose_sigma: FloatArray | None = None

    @property
    def available(self) -> BoolArray:
        """Channels that have a reading (C,)."""
        return np.isfinite(self.readings_T)

    def pose(self, lever_arm_m: FloatArray) -> ArrayPose:
        """Return the array's pose; an array without a velocity or rate is at rest."""
        velocity, rate = (np.zeros(3) if value is None else value for value in (self.velocity_m_s, self.rate_rad_s))
        return ArrayPose(self.origin_m, self.R_world_from_array, velocity, rate, lever_arm_m)


class WhitenedRow(Protocol):
    """Differences z (k,) of one row, in units of their noise."""

    @property
    def row(self) -> Row:
        """Row with the pose of the array."""

    @property
    def z(self) -> FloatArray:
        """Measured differences (k,)."""

    @property
    def transform(self) -> FloatArray:
        """Matrix (k, C) from channels to differences."""

    @property
    def effect(self) -> FloatArray:
        """Effect (k, n) of nuisances on the differences."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of an array's readings.

    Attributes
    ----------
    array : SensorArray
    readings : ndarray, shape (n, k)
        Differences in units of their noise, padded by zeros.
    counts : ndarray of int, shape (n,)
        Number of differences of each row.
    transforms, transform_of_row : ndarray, shapes (m, k, n_channels) and (n,)
        Matrices from channels to differences, and for each row the index of its matrix.
    effects : ndarray, shape (n or 1, k, n_nuisances)
        Effects of nuisances on the readings.
    origins_m, rotations : ndarray, shapes (n, 3) and (n, 3, 3)
        Pose of the array.
    ambients_T : ndarray, shape (n or 1, n_sensors, 3)
        Field at the sensors without a source.
    pose_effects : ndarray, shape (n, 12, n_pose), optional
        Effects of errors of the pose and of the ambient field.
    lever_arm_m : tuple of 3 floats
        Vector from the pose's reference point to the array's origin, in the array's axes.
    """

    array: SensorArray
    readings: FloatArray
    counts: IntArray
    transforms: FloatArray
    transform_of_row: IntArray
    effects: FloatArray
    origins_m: FloatArray
    rotations: FloatArray
    ambients_T: FloatArray
    pose_effects: FloatArray | None = None
    lever_arm_m: tuple[float, ...] = (0.0, 0.0, 0.0)

    @classmethod
    def stack(cls, array: SensorArray, rows: Sequence[WhitenedRow], ambients_T: FloatArray) -> Rows:
        """Return rows with equally many differences, without errors of the pose."""
        distinct = {id(row.transform): row.transform for row in rows}
        index = {key: i for i, key in enumerate(distinct)}
        return cls(
            array,
            np.stack([row.z for row in rows]),
            np.array([row.z.size for row in rows]),
            np.stack(list(distinct.values())),
            np.array([index[id(row.transform)] for row in rows]),
            np.stack([row.effect for row in rows]),
            np.stack([row.row.origin_m for row in rows]),
            np.stack([row.row.R_world_from_array for row in rows]),
            ambients_T,
        )

    @property
    def n_pose(self) -> int:
        """Number of errors of the pose and of the ambient field."""
        return 0 if self.pose_effects is None else self.pose_effects.shape[2]

    @cached_property
    def problem(self) -> core.Problem:
        """Arguments of kernels."""
        array, order = self.array, np.arange(len(self.readings))
        magnet = magnet_of(array)
        shape, size = (0, (0.0, 0.0, 0.0)) if magnet is None else magnet.kernel_size
        return core.problem(
            "rows",
            n_sensors=array.n_sensors,
            n_channels=array.n_channels,
            n_readings=self.readings.shape[1],
            n_nuisances=self.effects.shape[2],
            n_pose=self.n_pose,
            sensors=array.positions,
            array_centroid=tuple(array.centroid),
            radius=array.circumradius,
            sensor=np.ascontiguousarray(array.channel_sensor, dtype=np.int64),
            gain=array.channel_gain,
            is_modulus=array.channel_is_scalar.astype(np.uint8),
            readings=np.ascontiguousarray(self.readings),
            counts=np.ascontiguousarray(self.counts, dtype=np.int64),
            transforms=np.ascontiguousarray(self.transforms),
            transform_of_row=np.ascontiguousarray(self.transform_of_row, dtype=np.int64),
            effects=np.ascontiguousarray(self.effects),
            effect_of_row=order if len(self.effects) > 1 else np.zeros_like(order),
            origins=np.ascontiguousarray(self.origins_m),
            rotations=np.ascontiguousarray(self.rotations),
            ambients=np.ascontiguousarray(self.ambients_T),
            ambient_of_row=order if len(self.ambients_T) > 1 else np.zeros_like(order),
            pose_effects=None if self.pose_effects is None else np.ascontiguousarray(self.pose_effects),
            lever_arm=self.lever_arm_m,
            shape=shape,
            size=size,
        )


def with_array_motion(row: Row, before: Row | None) -> Row:
    """Return a row with the array's velocity and rate, by differences if it has none."""
    if before is None or row.velocity_m_s is not None:
        return row
    time_s, origins_m = np.array([before.time_s, row.time_s]), np.stack([before.origin_m, row.origin_m])
    velocity, rate = rates_of(time_s, origins_m, np.stack([before.R_world_from_array, row.R_world_from_array]))
    return replace(row, velocity_m_s=velocity[1], rate_rad_s=rate[1])


def rows_of(readings: Readings) -> Iterator[Row]:
    """Yield the rows of readings for a tracker."""
    columns: dict[str, FloatArray] = {}
    if readings.ambient_T is not None:
        columns["ambient_T"] = readings.ambient_T
    if readings.pose_sigma is not None:
        columns["pose_sigma"] = readings.pose_sigma
    if readings.pose is not None:
        position_m, R = readings.pose[0], readings.pose[1].as_matrix()
        columns |= {"origin_m": position_m, "R_world_from_array": R}
        if len(readings) > 1:
            velocity_m_s, rate_rad_s = rates_of(readings.time_s, position_m, R)
            columns |= {"velocity_m_s": velocity_m_s, "rate_rad_s": rate_rad_s}
    for i, time in enumerate(readings.time_s.tolist()):
        yield Row(time, readings.values_T[i], **{name: column[i] for name, column in columns.items()})


def next_row(row: Row | Readings, array: SensorArray, after_s: float) -> Row:
    """Return the next row after a time; of readings, without saturated ones.

    Raises
    ------
    ValueError
        Time goes backwards, or the readings are not one row.
    """
    if isinstance(row, Readings):
        if len(row) != 1:
            raise ValueError(f"Input row must be readings of length one; instead received {len(row)} rows.")
        row = next(rows_of(in_world_field(without_saturated(row, array), array)))
    if not math.isfinite(row.time_s):
        raise ValueError(f"Input time_s must be finite; instead received {row.time_s}.")
    if row.time_s <= after_s:
        raise ValueError(f"Input time_s must increase; instead {row.time_s} s follows {after_s} s.")
    return row
