"""Simulated calibration flights with known coefficients of the platform.

A cloverleaf: four headings with pitch, roll and yaw manoeuvres on each, and banked turns between them. The field is
that of a formula of its own: the moduli of ambient field and platform, not the linear columns of the product.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

import arrays
from arrays.typing import FloatArray
from magloc.readings import Readings

WORLD_T = np.array([1500.0, 19500.0, -44000.0]) * 1e-9  # east, north, up
GRADIENT_T_m = np.array([4e-12, -3e-12, 15e-12])
SPEED_M_S = 40.0


@dataclass(frozen=True)
class Platform:
    """Permanent field [T], induced and eddy-current matrices, and fields per ampere [T] at one sensor."""

    permanent: FloatArray
    induced: FloatArray
    eddy: FloatArray
    current: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator, sensor: arrays.Sensor, current_T: float = 2e-8) -> Platform:
        """Draw a platform from the prior of a sensor."""
        return cls(
            sensor.offset_uncertainty_T * rng.standard_normal(3),
            sensor.induced_uncertainty * rng.standard_normal((3, 3)),
            sensor.eddy_uncertainty_s * rng.standard_normal((3, 3)),
            current_T * rng.standard_normal(3),
        )

    def field(self, b: FloatArray, rate: FloatArray, current: FloatArray) -> FloatArray:
        return self.permanent + b @ self.induced.T + rate @ self.eddy.T + current[:, None] * self.current


def array_of(scalar_nT: float = 0.02, vector_nT: float = 0.5) -> arrays.SensorArray:
    """Return an array of a scalar sensor and a vector sensor with stated priors."""
    of = {"offset_uncertainty_T": 200e-9, "induced_uncertainty": 2e-3, "eddy_uncertainty_s": 2e-3}
    mag = arrays.Sensor("mag", "scalar", (0.0, 0.0, 0.0), noise_T=scalar_nT * 1e-9, **of)
    flux = arrays.Sensor("flux", "vector", (0.5, 0.0, 0.0), noise_T=vector_nT * 1e-9, **of)
    return arrays.SensorArray((mag, flux))


@dataclass(frozen=True)
class Flight:
    """Truth of a flight: times, attitude (world from array), places, current."""

    time_s: FloatArray
    rotation: Rotation
    place_m: FloatArray
    current_A: FloatArray

    @classmethod
    def cloverleaf(cls, rng: np.random.Generator, rate_Hz: float = 10.0, straight: bool = False) -> Flight:
        """Return four legs of 60 s with three manoeuvres each, joined by banked turns of 20 s."""
        leg_s, turn_s = 60.0, 20.0
        t = np.arange(0.0, 4 * leg_s + 3 * turn_s, 1.0 / rate_Hz)
        k = np.minimum(t // (leg_s + turn_s), 3)
        into = t - k * (leg_s + turn_s)
        part = np.clip((into - leg_s) / turn_s, 0.0, 1.0)
        smooth = part - np.sin(2 * np.pi * part) / (2 * np.pi)
        heading = np.deg2rad(rng.uniform(0, 360)) + (k + smooth) * np.pi / 2
        angles = np.deg2rad(0.5) * np.stack([_wander(rng, t) for _ in range(3)])
        bank = np.deg2rad(25.0) * np.sin(np.pi * part) ** 2
        if straight:
            heading, bank = np.full_like(t, heading[0]), 0.0 * bank
            angles *= 0.0
        else:
            for axis, (begin, size_deg) in enumerate(((3.0, 10.0), (22.0, 6.0), (41.0, 6.0))):
                inside = np.clip((into - begin) / 16.0, 0.0, 1.0)
                angles[axis] += np.deg2rad(size_deg) * np.sin(np.pi * inside) ** 2 * np.sin(2 * np.pi * into / 5.0)
        roll, pitch, yaw = angles
        turned = Rotation.from_euler("ZYX", np.stack([np.pi / 2 - heading + yaw, pitch, roll - bank], axis=1))
        velocity = SPEED_M_S * np.stack([np.sin(heading), np.cos(heading), 0.0 * t], axis=1)
        current = 5.0 + 2.0 * np.sign(np.sin(2 * np.pi * t / 37.0)) + 0.3 * _wander(rng, t)
        return cls(t, turned, np.cumsum(velocity, axis=0) / rate_Hz + [0.0, 0.0, 300.0], current)

    def ambient(self, time_s: FloatArray | None = None) -> FloatArray:
        """Return the ambient field (n, 3) in the axes of the array."""
        modulus = np.linalg.norm(WORLD_T)
        scale = (modulus + self.place_m @ GRADIENT_T_m) / modulus
        return self.rotation.inv().apply(WORLD_T * scale[:, None])

    def readings(
        self,
        array: arrays.SensorArray,
        platforms: dict[str, Platform],
        rng: np.random.Generator,
        *,
        posed: bool = True,
        lag_s: float = 0.0,
    ) -> Readings:
        """Return the readings of all sensors; those of vector sensors lag by a time."""
        columns = []
        b = self.ambient()
        rate = np.gradient(b, self.time_s, axis=0, edge_order=2)
        from scipy.interpolate import CubicSpline

        rate = CubicSpline(self.time_s, b)(self.time_s, 1)
        for sensor in array.sensors:
            h = platforms[sensor.id].field(b, rate, self.current_A)
            total = b + h
            noise = sensor.noise_T * rng.standard_normal((len(b), 3))
            if sensor.kind == "scalar":
                columns.append((np.linalg.norm(total, axis=1) + noise[:, 0])[:, None])
            else:
                columns.append(CubicSpline(self.time_s, total)(self.time_s - lag_s) + noise)
        pose = {"array_position_m": self.place_m, "array_rotation": self.rotation} if posed else {}
        return Readings(np.hstack(columns), time_s=self.time_s, **pose)  # type: ignore[arg-type]


def _wander(rng: np.random.Generator, t: FloatArray) -> FloatArray:
    """Return a smooth random function of unit variance, faster than 4 s nowhere."""
    frequency = rng.uniform(0.02, 0.25, 12)
    phase = rng.uniform(0, 2 * np.pi, 12)
    return np.sqrt(2.0 / 12) * np.cos(2 * np.pi * frequency[:, None] * t + phase[:, None]).sum(axis=0)
