"""What the filters of attitude are given: readings, wheels and surroundings of some runs at once.

These are protocols: :class:`sims.attitude.simulation.AttitudeRuns` is a :class:`TrueRecord`, and a log of telemetry is
a :class:`Record` without the truth. The leading axis of all arrays is the run, the second the instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from adcs.environment.environment import Environment
from adcs.satellite.dynamics import RigidBody, WheelControl
from adcs.satellite.sensors import Gyro, Magnetometer, StarTracker, SunSensor
from arrays.typing import BoolArray, FloatArray


class Readings(Protocol):
    """What the sensors report, in body axes; NaN where there is no reading."""

    @property
    def star(self) -> FloatArray:
        """Attitude, orbital from body, shape (runs, n, 4)."""
        ...

    @property
    def gyro_rad_s(self) -> FloatArray:
        """Rate against inertial space, shape (runs, n, 3)."""
        ...

    @property
    def field_T(self) -> FloatArray:
        """Field, shape (runs, n, 3)."""
        ...

    @property
    def sun(self) -> FloatArray:
        """Unit vector to the Sun, shape (runs, n, 3)."""
        ...


class Satellite(Protocol):
    """The satellite and its sensors, as its user believes them to be, and the time between its instants."""

    @property
    def body(self) -> RigidBody:
        """Inertia and residual dipole."""
        ...

    @property
    def control(self) -> WheelControl:
        """Wheel control, which only the F of the source paper needs."""
        ...

    @property
    def dt_s(self) -> float:
        """Time between instants."""
        ...

    @property
    def star_tracker(self) -> StarTracker:
        """Its noise and rate limit."""
        ...

    @property
    def gyro(self) -> Gyro:
        """Its noise."""
        ...

    @property
    def magnetometer(self) -> Magnetometer:
        """Its noise."""
        ...

    @property
    def sun_sensor(self) -> SunSensor:
        """Its noise."""
        ...


class Record(Protocol):
    """Everything that a filter may know.

    There are readings at every instant; the torque of the wheels acts from an instant to the next.
    """

    @property
    def scenario(self) -> Satellite:
        """Satellite and sensors."""
        ...

    @property
    def environment(self) -> Environment:
        """Surroundings, leading axis runs."""
        ...

    @property
    def readings(self) -> Readings:
        """Of all sensors."""
        ...

    @property
    def momentum_Nms(self) -> FloatArray:
        """Of the wheels, shape (runs, n, 3)."""
        ...

    @property
    def wheel_torque_Nm(self) -> FloatArray:
        """Rate of change of the wheels' momentum from each instant to the next, shape (runs, n, 3)."""
        ...


class TrueBiases(Protocol):
    """Biases that a simulation has given to its sensors, shape (runs, n, 3)."""

    @property
    def gyro_bias_rad_s(self) -> FloatArray:
        """Of the gyro."""
        ...

    @property
    def field_bias_T(self) -> FloatArray:
        """Of the magnetometer."""
        ...


class TrueRecord(Record, Protocol):
    """A record with the truth, of a simulation."""

    @property
    def q(self) -> FloatArray:
        """Attitude, orbital from body, shape (runs, n, 4)."""
        ...

    @property
    def w(self) -> FloatArray:
        """Rate against inertial space, shape (runs, n, 3)."""
        ...

    @property
    def acceleration_s2(self) -> FloatArray:
        """Disturbance, shape (runs, n, 3)."""
        ...

    @property
    def prepared(self) -> TrueBiases:
        """Biases."""
        ...


def is_read(values: FloatArray) -> BoolArray:
    """Whether there is a reading, (..., k) -> (...)."""
    return ~np.isnan(values[..., 0])


@dataclass(frozen=True, eq=False)
class PartReadings:
    """Readings of a part of a record, see :class:`Readings`."""

    star: FloatArray
    gyro_rad_s: FloatArray
    field_T: FloatArray
    sun: FloatArray


@dataclass(frozen=True, eq=False)
class Part:
    """Some runs and instants of a record, see :class:`Record`."""

    scenario: Satellite
    environment: Environment
    readings: PartReadings
    momentum_Nms: FloatArray
    wheel_torque_Nm: FloatArray


def part(record: Record, runs: NDArray[np.intp], rows: slice = slice(None)) -> Part:
    """Some runs of a record, each as often as its index comes, and instants that follow one another.

    Parameters
    ----------
    record : Record
    runs : ndarray of int, shape (m,)
    rows : slice
        All instants, unless given.

    Returns
    -------
    Part
        Of m runs.
    """
    around, readings = record.environment, record.readings
    of_runs = {
        name: getattr(around, name)[runs, rows]
        for name in (
            "utc",
            "position_eci_m",
            "velocity_eci_m_s",
            "b_orbital_T",
            "sun_orbital",
            "illuminated",
            "orbital_rate_rad_s",
            "gravity_s2",
        )
    }
    return Part(
        record.scenario,
        Environment(time_s=around.time_s[rows], **of_runs),
        PartReadings(*(getattr(readings, name)[runs, rows] for name in ("star", "gyro_rad_s", "field_T", "sun"))),
        record.momentum_Nms[runs, rows],
        record.wheel_torque_Nm[runs, rows],
    )
