"""Flights of a multirotor with known errors of its sensors, as its autopilot logs them.

The thrust is along the body's z axis and balances gravity, drag and acceleration, so that tilt and specific force agree
as in flight: the accelerometer shows thrust and drag, never the vertical alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from adcs.log_calibration.record import Series, VehicleLog
from arrays.typing import FloatArray, Rng
from sims.noise import lasting

_GRAVITY, _DRAG = 9.80665, 0.3
_FIELD_T = (0.0, 20.9e-6, -43.0e-6)
_HOVER_A = 15.0


@dataclass(frozen=True)
class FlightSettings:
    """Size of a flight, and errors and noise of its sensors.

    Attributes
    ----------
    duration_s, inertial_Hz, magnetometer_Hz : float
    tilt_deg : float
        Largest tilt.
    turns : bool
        Whether the vehicle yaws; else its heading is constant.
    magnetometers : int
    mounting : Rotation
        Rotation from the body's axes to the magnetometers', without their own error of about 1°.
    field_T : tuple of 3 floats
        Field of the Earth: east, north, up.
    offset_T, soft_iron, current_T_A, lag_s : float
        Standard deviations of hard iron and soft iron; length of the field of 1 A; lag of the readings.
    noise_T, slow_noise_T, slow_s : float
        White noise of a reading, and a slow one with its correlation time.
    gyro_noise_rad_s, gyro_bias_rad_s, gyro_walk_rad_s, gyro_scale : float
        White noise of a sample; standard deviations of the bias, of its slow change and of the scale.
    force_noise_m_s2, force_offset_m_s2 : float
        Noise and offset of the accelerometer.

    Examples
    --------
    >>> import sims
    >>> sims.FlightSettings(duration_s=60.0).tilt_deg
    25.0
    """

    duration_s: float = 600.0
    inertial_Hz: float = 100.0
    magnetometer_Hz: float = 50.0
    tilt_deg: float = 25.0
    turns: bool = True
    magnetometers: int = 1
    mounting: Rotation = field(default_factory=Rotation.identity)
    field_T: tuple[float, float, float] = _FIELD_T
    offset_T: float = 10e-6
    soft_iron: float = 0.03
    current_T_A: float = 50e-9
    lag_s: float = 0.03
    noise_T: float = 100e-9
    slow_noise_T: float = 30e-9
    slow_s: float = 20.0
    gyro_noise_rad_s: float = math.radians(0.07)
    gyro_bias_rad_s: float = math.radians(0.3)
    gyro_walk_rad_s: float = math.radians(0.01)
    gyro_scale: float = 0.003
    force_noise_m_s2: float = 0.2
    force_offset_m_s2: float = 0.1


@dataclass(frozen=True, eq=False)
class Flight:
    """A log with the errors of its sensors.

    Attributes
    ----------
    log : VehicleLog
    scale : ndarray, shape (M, 3, 3)
        Reading = scale · field in body axes + offset + current · field of 1 A.
    offset_T, current_T_A : ndarray, shape (M, 3)
    lag_s : ndarray, shape (M,)
    gyro_bias_rad_s, force_offset_m_s2 : ndarray, shape (3,)
    rotation : Rotation
        True attitudes at the inertial times: east, north, up from body.
    """

    log: VehicleLog
    scale: FloatArray
    offset_T: FloatArray
    current_T_A: FloatArray
    lag_s: FloatArray
    gyro_bias_rad_s: FloatArray
    force_offset_m_s2: FloatArray
    rotation: Rotation


class _Path:
    """Velocity, acceleration and heading of a vehicle as functions of time."""

    def __init__(self, rng: np.random.Generator, settings: FlightSettings) -> None:
        periods = np.stack([np.geomspace(6.0, 40.0, 7)] * 3) * rng.uniform(0.85, 1.15, (3, 7))
        self._rate = 2.0 * np.pi / periods
        self._phase = rng.uniform(0.0, 2.0 * np.pi, (3, 7))
        self._size = rng.uniform(0.5, 1.5, (3, 7)) / self._rate * np.array([[1.0], [1.0], [0.6]])
        self._settings = settings
        self._scale = 1.0
        self._turns: list[tuple[float, float, float]] = []
        times = np.arange(0.0, settings.duration_s, 0.1)
        for _ in range(20):
            tilt = self.rotation(times).apply([0.0, 0.0, 1.0])[:, 2].min()
            self._scale *= math.tan(math.radians(settings.tilt_deg)) / math.tan(math.acos(tilt))
        start = 0.0
        while settings.turns and start < settings.duration_s:
            start += rng.uniform(3.0, 15.0)
            angle = rng.choice([-1.0, 1.0]) * rng.choice([90.0, 90.0, 180.0, 270.0, 360.0])
            length = 1.5 * abs(angle) / rng.uniform(20.0, 60.0)
            self._turns.append((start, length, math.radians(angle)))
            start += length

    def forces(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return specific force and thrust per mass, world axes; drag is the difference."""
        angle = self._rate[:, :, None] * time_s + self._phase[:, :, None]
        size = self._size[:, :, None] * np.array([self._scale, self._scale, 1.0])[:, None, None]
        v = np.sum(size * np.sin(angle), axis=1).T
        a = np.sum(size * self._rate[:, :, None] * np.cos(angle), axis=1).T
        specific = a + np.array([0.0, 0.0, _GRAVITY])
        return specific, specific + _DRAG * v

    def rotation(self, time_s: FloatArray) -> Rotation:
        """Return attitudes, east, north, up from body."""
        up = self.forces(time_s)[1]
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        yaw = np.full(len(time_s), 0.4)
        for start, length, angle in self._turns:
            part = np.clip((time_s - start) / length, 0.0, 1.0)
            yaw += angle * part**2 * (3.0 - 2.0 * part)
        ahead = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
        left = np.cross(up, ahead)
        left /= np.linalg.norm(left, axis=1, keepdims=True)
        return Rotation.from_matrix(np.stack([np.cross(left, up), left, up], axis=2))


def simulate_flight(rng: Rng = None, settings: FlightSettings = FlightSettings()) -> Flight:
    """Simulate a flight.

    Parameters
    ----------
    rng : int or Generator, optional
        Seed or generator of the motion, the errors and the noise.
    settings : FlightSettings
        Size of the flight, errors and noise of its sensors.

    Returns
    -------
    Flight
        Log of the flight, with the true errors.

    Examples
    --------
    >>> import sims
    >>> flight = sims.simulate_flight(1, sims.FlightSettings(duration_s=5.0))
    >>> flight.log.gyro_rad_s.shape, flight.scale.shape
    ((500, 3), (1, 3, 3))
    """
    rng, s = np.random.default_rng(rng), settings
    path = _Path(rng, s)
    times = np.arange(0.0, s.duration_s, 1.0 / s.inertial_Hz)
    rotation = path.rotation(times)
    before = path.rotation(times - 1.0 / s.inertial_Hz)
    rate = (before.inv() * rotation).as_rotvec() * s.inertial_Hz
    bias, offset = rng.normal(0.0, s.gyro_bias_rad_s, 3), rng.normal(0.0, s.force_offset_m_s2, 3)
    gyro = rate * (1.0 + rng.normal(0.0, s.gyro_scale, 3)) + bias
    gyro += _slow(rng, times, s.gyro_walk_rad_s, 100.0) + rng.normal(0.0, s.gyro_noise_rad_s, gyro.shape)
    force = rotation.inv().apply(path.forces(times)[0]) + offset + rng.normal(0.0, s.force_noise_m_s2, gyro.shape)
    thrust = np.linalg.norm(path.forces(times)[1], axis=1) / _GRAVITY
    current = _HOVER_A * thrust**1.5 + _slow(rng, times, 1.0, 2.0)[:, 0]
    M = s.magnetometers
    turn = Rotation.from_rotvec(rng.normal(0.0, math.radians(1.0), (M, 3)))
    scale = (np.eye(3) + _symmetric(rng, M, s.soft_iron)) @ (turn * s.mounting).as_matrix()
    hard = rng.normal(0.0, s.offset_T, (M, 3))
    direction = rng.normal(0.0, 1.0, (M, 3))
    by_current = s.current_T_A * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    lag = np.full(M, s.lag_s)
    magnetometers = []
    for m in range(M):
        at = np.arange(0.3 / s.magnetometer_Hz, s.duration_s - 0.02, 1.0 / s.magnetometer_Hz)
        body = path.rotation(at - lag[m]).inv().apply(np.asarray(s.field_T))
        reading = body @ scale[m].T + hard[m] + np.interp(at - lag[m], times, current)[:, None] * by_current[m]
        reading += _slow(rng, at, s.slow_noise_T, s.slow_s) + rng.normal(0.0, s.noise_T, reading.shape)
        magnetometers.append(Series(f"mag{m}", at, reading))
    log = VehicleLog(times, gyro, force, tuple(magnetometers), (Series("battery_A", times, current),))
    return Flight(log, scale, hard, by_current, lag, bias, offset, rotation)


def _symmetric(rng: np.random.Generator, n: int, sigma: float) -> FloatArray:
    values = rng.normal(0.0, sigma, (n, 3, 3))
    return np.asarray((values + values.transpose(0, 2, 1)) / 2.0)


def _slow(rng: np.random.Generator, time_s: FloatArray, sigma: float, correlation_s: float) -> FloatArray:
    """Return three components of a stationary exponentially correlated process."""
    white = rng.standard_normal((len(time_s), 3))
    white[0] = rng.standard_normal(3)
    return sigma * lasting(white, correlation_s, 1.0 / float(np.median(np.diff(time_s))))
