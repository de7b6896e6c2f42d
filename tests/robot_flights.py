"""A flight with its readings, in the conventions of PX4 and ArduPilot, from its yaw, pitch and roll."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.typing import FloatArray
from tests.written_logs import dataflash, ulog

DECLINATION_RAD = np.radians(6.0)
FIELD_NED_T = 1e-6 * np.array([20.0, 0.0, 43.0])  # in magnetic north, east, down
GRAVITY_M_S2 = 9.81


@dataclass(frozen=True)
class Flight:
    """Readings of a flight that rests for 3 s, at 250 Hz; the magnetometer is late."""

    seed: int = 0
    duration_s: float = 40.0
    lag_s: float = 0.03
    swing_rad: float = 0.5
    noise_T: float = 50e-9
    offset_T: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def angles(self, time_s: FloatArray) -> FloatArray:
        """Return yaw, pitch, roll (n, 3) [rad] from magnetic north."""
        rng = np.random.default_rng(self.seed)
        phase, rate = rng.uniform(0.0, 6.0, (3, 3)), rng.uniform(0.3, 2.5, (3, 3))
        flown_s = np.clip(time_s - 3.0, 0.0, None)
        grows = self.swing_rad * np.clip(flown_s / 3.0, 0.0, 1.0) ** 2
        waves = np.sin(rate * flown_s[:, None, None] + phase).sum(axis=2) * [1.0, 0.5, 0.5]
        return grows[:, None] * waves + [0.7, 0.0, 0.0]

    def ned_from_body(self, time_s: FloatArray) -> Rotation:
        """Return attitudes, magnetic north, east, down from forward, right, down."""
        return Rotation.from_euler("ZYX", self.angles(time_s))

    @property
    def time_s(self) -> FloatArray:
        return np.arange(0.0, self.duration_s, 0.004)

    @property
    def field_s(self) -> FloatArray:
        return np.arange(0.05, self.duration_s, 0.02)

    def rate_rad_s(self, time_s: FloatArray) -> FloatArray:
        step_s = 1e-4
        before, after = self.ned_from_body(time_s - step_s / 2), self.ned_from_body(time_s + step_s / 2)
        noise = np.random.default_rng((1, self.seed)).normal(0.0, 1e-3, (len(time_s), 3))
        return (before.inv() * after).as_rotvec() / step_s + noise

    def acceleration_m_s2(self, time_s: FloatArray) -> FloatArray:
        """Return specific forces: upwards at rest, thus -9.81 along down."""
        noise = np.random.default_rng((2, self.seed)).normal(0.0, 0.05, (len(time_s), 3))
        return self.ned_from_body(time_s).inv().apply([0.0, 0.0, -GRAVITY_M_S2]) + noise

    def field_T(self, time_s: FloatArray) -> FloatArray:
        noise = np.random.default_rng((3, self.seed)).normal(0.0, self.noise_T, (len(time_s), 3))
        return self.ned_from_body(time_s - self.lag_s).inv().apply(FIELD_NED_T) + self.offset_T + noise

    def true_attitude(self, time_s: FloatArray) -> Rotation:
        """Return attitudes from true north, as an autopilot estimates them."""
        return Rotation.from_euler("Z", DECLINATION_RAD) * self.ned_from_body(time_s)

    def px4(self) -> bytes:
        """Return a ULog file."""
        imu_us, mag_us = (np.round(1e6 * (10.0 + t)).astype(np.uint64) for t in (self.time_s, self.field_s))
        q = np.roll(self.true_attitude(self.time_s).as_quat(), 1, axis=1)
        combined = {
            "timestamp": imu_us,
            "gyro_rad": self.rate_rad_s(self.time_s).astype(np.float32),
            "accelerometer_timestamp_relative": np.zeros(len(imu_us), np.int32),
            "accelerometer_m_s2": self.acceleration_m_s2(self.time_s).astype(np.float32),
        }
        field = {"timestamp": mag_us, "magnetometer_ga": (1e4 * self.field_T(self.field_s)).astype(np.float32)}
        attitude = {"timestamp": imu_us[::5], "q": q[::5].astype(np.float32)}
        return ulog(
            [("sensor_combined", 0, combined), ("vehicle_magnetometer", 0, field), ("vehicle_attitude", 0, attitude)]
        )

    def ardupilot(self) -> bytes:
        """Return a DataFlash log."""
        imu_us, mag_us = (np.round(1e6 * (10.0 + t)).astype(np.uint64) for t in (self.time_s, self.field_s))
        rate, force = self.rate_rad_s(self.time_s), self.acceleration_m_s2(self.time_s)
        imu = {"TimeUS": imu_us, "I": np.zeros(len(imu_us), np.uint8)}
        imu |= {
            f"{name}{axis}": of[:, i].astype(np.float32)
            for name, of in (("Gyr", rate), ("Acc", force))
            for i, axis in enumerate("XYZ")
        }
        field = np.round(1e7 * self.field_T(self.field_s)).astype(np.int16)  # mG
        mag = {
            "TimeUS": mag_us,
            "I": np.zeros(len(mag_us), np.uint8),
            **dict(zip(("MagX", "MagY", "MagZ"), field.T, strict=True)),
        }
        yaw, pitch, roll = self.true_attitude(self.time_s[::10]).as_euler("ZYX", degrees=True).T.astype(np.float32)
        att = {"TimeUS": imu_us[::10], "Roll": roll, "Pitch": pitch, "Yaw": yaw % 360.0}
        return dataflash(
            [("IMU", imu, "s#EEEooo", "F-000000"), ("MAG", mag, "s#GGG", "F-CCC"), ("ATT", att, "sddd", "F000")]
        )
