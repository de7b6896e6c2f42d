"""A joystick: three 3-axis Hall sensors on a circle under a knob with three magnets.

The device is simulated with its own formula, a sum of dipoles (the magnets are balls, whose field outside is exactly
that of dipoles), apart from the models that calibrate and track it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.sensor import Calibration, Sensor
from arrays.typing import FloatArray
from magloc.bodies.body import Magnet, MagnetBody, PoseLimits
from magloc.fields import dipole
from magloc.readings import Readings
from magloc.truth import Truth

RADIUS_M = 0.010
"""Radius of the sensors' circle."""
KNOB_RADIUS_M = 0.007
RATE_HZ = 1000.0
NOISE_T = 10e-6
"""Noise of a reading of a Hall sensor at 1 kHz."""
TOLERANCE_M, TOLERANCE_RAD, TOLERANCE_GAIN = 2e-4, math.radians(2.0), 0.03
"""1 sigma of placement, of rotation, and of gains and the strength of the magnets."""
OFFSET_T, AMBIENT_T = 1e-4, 1e-6
"""1 sigma of the sensors' offsets with the field at rest, and of the ambient field's change between rows."""
JIG_M, JIG_RAD = 1e-5, math.radians(0.05)
"""1 sigma of the poses of a jig."""
HEIGHT_M = 0.010
_TRAVEL_M, _ANGLE_RAD = 2e-3, math.radians(15.0)
_BALL_M, _REMANENCE_T = 0.005, 1.3
_DIRECTIONS = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, -1.0))
_HARMONICS = 4


def nominal_array() -> SensorArray:
    """Return the array as drawn, with its tolerances."""
    sensors = []
    for k, angle in enumerate(np.radians([90.0, 210.0, 330.0]), start=1):
        place = (RADIUS_M * math.cos(angle), RADIUS_M * math.sin(angle), 0.0)
        sensors.append(
            Sensor(
                f"s{k}",
                "vector",
                place,
                NOISE_T,
                misalignment_rad=TOLERANCE_RAD,
                gain_uncertainty=TOLERANCE_GAIN,
                offset_uncertainty_T=OFFSET_T,
            )
        )
    return SensorArray(tuple(sensors), name="joystick", common_field_T=AMBIENT_T)


def nominal_knob() -> MagnetBody:
    """Return the knob as drawn, with its tolerances."""
    strength_Am2 = _REMANENCE_T * _BALL_M**3 / 24e-7  # Br V / mu0
    magnets = []
    for k, (angle, axis) in enumerate(zip(np.radians([60.0, 180.0, 300.0]), _DIRECTIONS, strict=True), start=1):
        moment = strength_Am2 * np.array(axis) / np.linalg.norm(axis)
        magnets.append(
            Magnet(
                f"m{k}",
                (KNOB_RADIUS_M * math.cos(angle), KNOB_RADIUS_M * math.sin(angle), 0.0),
                tuple(moment.tolist()),
                moment_sigma_Am2=TOLERANCE_GAIN * strength_Am2,
                position_sigma_m=TOLERANCE_M,
                direction_sigma_rad=TOLERANCE_RAD,
            )
        )
    low, high = (-_TRAVEL_M, -_TRAVEL_M, HEIGHT_M - _TRAVEL_M), (_TRAVEL_M, _TRAVEL_M, HEIGHT_M + _TRAVEL_M)
    return MagnetBody(tuple(magnets), "knob", PoseLimits(low, high, _ANGLE_RAD))


@dataclass(frozen=True, eq=False)
class Joystick:
    """One device as built, with errors of placement, gains and strength.

    Attributes
    ----------
    position_m, response, offset_T : ndarray, shapes (3, 3), (3, 3, 3), (3, 3)
        Sensors: position, matrix from the field to the reading, offset.
    magnet_m, moment_Am2 : ndarray, shape (3, 3)
        Magnets in the knob's frame.
    """

    position_m: FloatArray
    response: FloatArray
    offset_T: FloatArray
    magnet_m: FloatArray
    moment_Am2: FloatArray

    def read(
        self, position_m: FloatArray, rotation: Rotation, rng: np.random.Generator, *, start_s: float = 0.0
    ) -> Readings:
        """Return noisy readings of the knob in poses, at 1 kHz.

        Parameters
        ----------
        position_m : ndarray, shape (n, 3)
            Position of the knob in the array's frame.
        rotation : Rotation
            Rotations (n,) from the knob's frame to the array's.
        rng : numpy.random.Generator
            Generator of the noise and of the ambient field's changes.
        start_s : float
            Time of the first row.

        Returns
        -------
        Readings
            Raw readings of the nine channels, with the device's errors.
        """
        R, n = rotation.as_matrix(), len(position_m)
        places = position_m[:, None] + self.magnet_m @ np.swapaxes(R, -1, -2)
        moments = self.moment_Am2 @ np.swapaxes(R, -1, -2)
        fields = dipole.field(self.position_m[None, :, None], places[:, None], moments[:, None]).sum(axis=2)
        fields += AMBIENT_T * rng.normal(size=(n, 1, 3))
        readings = np.einsum("iab,tib->tia", self.response, fields) + self.offset_T
        readings += NOISE_T * rng.normal(size=readings.shape)
        return Readings(readings.reshape(n, 9), time_s=start_s + np.arange(n) / RATE_HZ)

    @property
    def true_array(self) -> SensorArray:
        """Array with the true positions and responses."""
        sensors = [
            replace(sensor, position_m=tuple(p.tolist()), calibration=Calibration.of("vector", S, o))
            for sensor, p, S, o in zip(
                nominal_array().sensors, self.position_m, self.response, self.offset_T, strict=True
            )
        ]
        return replace(nominal_array(), sensors=tuple(sensors))

    @property
    def true_knob(self) -> MagnetBody:
        """Knob with the true magnets."""
        magnets = [
            replace(magnet, position_m=tuple(p.tolist()), moment_Am2=tuple(m.tolist()))
            for magnet, p, m in zip(nominal_knob().magnets, self.magnet_m, self.moment_Am2, strict=True)
        ]
        return replace(nominal_knob(), magnets=tuple(magnets))


def draw_joystick(rng: np.random.Generator) -> Joystick:
    """Return a device whose errors are drawn from its tolerances."""
    array, knob = nominal_array(), nominal_knob()
    turns = Rotation.from_rotvec(TOLERANCE_RAD * rng.normal(size=(3, 3))).as_matrix()
    gains = 1.0 + TOLERANCE_GAIN * rng.normal(size=(3, 3))
    turned = Rotation.from_rotvec(TOLERANCE_RAD * rng.normal(size=(3, 3))).apply(knob.moments_Am2)
    return Joystick(
        array.positions + TOLERANCE_M * rng.normal(size=(3, 3)),
        gains[:, :, None] * turns,
        OFFSET_T * rng.normal(size=(3, 3)),
        knob.positions_m + TOLERANCE_M * rng.normal(size=(3, 3)),
        turned * (1.0 + TOLERANCE_GAIN * rng.normal(size=(3, 1))),
    )


def random_poses(rng: np.random.Generator, n: int) -> tuple[FloatArray, Rotation]:
    """Return poses evenly over the knob's range."""
    limits = nominal_knob().limits
    axis = rng.normal(size=(n, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angle = limits.angle_rad * rng.uniform(size=(n, 1)) ** (1.0 / 3.0)
    return rng.uniform(limits.low_m, limits.high_m, (n, 3)), Rotation.from_rotvec(angle * axis)


def motion(rng: np.random.Generator, duration_s: float, slowest_s: float = 2.0) -> tuple[FloatArray, Rotation]:
    """Return a smooth motion within the knob's range at 1 kHz: sums of a few sines.

    Parameters
    ----------
    rng : numpy.random.Generator
        Generator of amplitudes and phases.
    duration_s : float
        Duration of the motion.
    slowest_s : float
        Longest period.

    Returns
    -------
    position_m : ndarray, shape (n, 3)
        Position of the knob in the array's frame.
    rotation : Rotation
        Rotations (n,) from the knob's frame to the array's.
    """
    time_s = np.arange(round(duration_s * RATE_HZ)) / RATE_HZ
    frequency = np.arange(1, _HARMONICS + 1) / slowest_s
    phase = 2.0 * math.pi * (rng.uniform(size=(6, _HARMONICS)) + time_s[:, None, None] * frequency)
    amplitude = rng.dirichlet(np.ones(_HARMONICS), 6)
    path = np.sum(amplitude * np.sin(phase), axis=-1)
    limits = nominal_knob().limits
    middle = 0.5 * (np.array(limits.low_m) + np.array(limits.high_m))
    half = 0.5 * (np.array(limits.high_m) - np.array(limits.low_m))
    return middle + half * path[:, :3], Rotation.from_rotvec(limits.angle_rad / math.sqrt(3.0) * path[:, 3:])


def jig_truth(readings: Readings, position_m: FloatArray, rotation: Rotation, rng: np.random.Generator) -> Truth:
    """Return the poses of a jig, with its errors, as its user knows them."""
    n = len(position_m)
    return Truth(
        readings.time_s,
        position_m + JIG_M * rng.normal(size=(n, 3)),
        sigma_m=np.full(n, JIG_M),
        rotation=rotation * Rotation.from_rotvec(JIG_RAD * rng.normal(size=(n, 3))),
        sigma_rad=np.full(n, JIG_RAD),
    )
