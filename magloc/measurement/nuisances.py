r"""Lasting errors of sensors, as states that are estimated together with a source.

Rotated axes, gains, the platform's fields, 1/f noise and drift do not average out as noise does. Each error is a
first-order Markov process :math:`\dot e = -e/τ + w`: a constant for calibration errors, a random walk for drift, and
one process per decade of frequency for 1/f noise. See docs/theory/sensor-errors.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from arrays.array import SensorArray
from arrays.noise import calibration_errors, mean_of_finite
from arrays.sensor import FLICKER_DECADES
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.conditioning import Background
from magloc.measurement.platform_field import matrix_effects

# Corner frequencies of the processes that make up 1/f noise [Hz].
_FLICKER_HZ = tuple(10.0**-decade for decade in range(FLICKER_DECADES))
FASTEST_FLICKER_HZ = math.sqrt(10.0) * _FLICKER_HZ[0]
"""Upper end of the decades of these processes [Hz]. 1/f noise above it counts as white noise."""
_SECONDS_PER_HOUR = 3600.0
_UNKNOWN = 1e5
"""Standard deviation of an unknown background, in units of a reading's noise."""

# First index of each kind of error: rotation, gain, fixed field, field induced by the ambient field, and by its rate.
_TURN, _GAIN, _FIELD, _INDUCED, _EDDY = 0, 3, 6, 9, 18


@dataclass(frozen=True)
class BackgroundDrift:
    """Background of every channel that is not signal, in units of the noise.

    Attributes
    ----------
    offset, walk_rts : float
        Standard deviation of an offset, and of a random walk per root of a second.
    slope_Hz, about_s : float
        Standard deviation of the slope [1/s] of a line, and the time [s] at which the line is zero.
    """

    offset: float = 0.0
    walk_rts: float = 0.0
    slope_Hz: float = 0.0
    about_s: float = 0.0

    @classmethod
    def of(cls, background: Background, time_s: FloatArray) -> BackgroundDrift | None:
        r"""Return the drift that a background leaves over rows at these times.

        A random walk that adds :math:`2π f_c Δt` of the noise in every row acts, in its steady state, like a high-pass
        filter of first order with the corner :math:`f_c`.
        """
        if not background or len(time_s) < 2:
            return None
        drift = cls()
        if background.corner_Hz is not None:
            interval_s = float(np.median(np.diff(time_s)))
            drift = replace(drift, offset=_UNKNOWN, walk_rts=2.0 * math.pi * background.corner_Hz * interval_s**0.5)
        if background.trend_about_s is not None:
            slope_Hz = _UNKNOWN / float(np.ptp(time_s))
            drift = replace(drift, slope_Hz=slope_Hz, about_s=background.trend_about_s)
        return drift


@dataclass(frozen=True, eq=False)
class SensorErrors:
    """Lasting errors of the sensors of an array.

    Attributes
    ----------
    sigma : ndarray, shape (n,)
        Prior standard deviations.
    decay_Hz : ndarray, shape (n,)
        Decay rates 1/τ [1/s].
    walk : ndarray, shape (n,)
        Standard deviation of a random walk per root of a second.
    of_sensor : ndarray, shape (a, 2)
        Sensor and kind of error of the first a states. Kinds are rotations about the sensor's three axes, gains of
        the axes, a field fixed to the array, and 3×3 components each of induced fields and of eddy currents.
    of_channel : ndarray, shape (n - a,)
        Channel of the other states, which are drift and 1/f noise.
    is_slope : ndarray of bool, shape (n - a,)
        True if a state is multiplied by the time since `about_s`.
    """

    array: SensorArray
    sigma: FloatArray
    decay_Hz: FloatArray
    walk: FloatArray
    of_sensor: IntArray
    of_channel: IntArray
    is_slope: BoolArray
    about_s: float = 0.0

    @classmethod
    def of(cls, array: SensorArray, background: BackgroundDrift | None = None) -> SensorErrors:
        """Return all lasting errors that an array states, and a background that drifts."""
        background = background or BackgroundDrift()
        of_sensor: list[tuple[int, int]] = []
        sigma: list[float] = []
        for i, sensor in enumerate(array.sensors):
            for first, value, n_axes in (
                (_TURN, sensor.misalignment_rad, 3),
                (_GAIN, sensor.gain_uncertainty, sensor.n_channels),
                (_FIELD, sensor.offset_uncertainty_T, 3),
                (_INDUCED, sensor.induced_uncertainty, 9),
                (_EDDY, sensor.eddy_uncertainty_s, 9),
            ):
                if value:
                    of_sensor += [(i, first + axis) for axis in range(n_axes)]
                    sigma += [value] * n_axes
        decay, walk = [0.0] * len(sigma), [0.0] * len(sigma)
        of_channel: list[int] = []
        for channel, i in enumerate(array.channel_sensor.tolist()):
            drift, flicker = array.sensors[i].drift_T_rth / math.sqrt(_SECONDS_PER_HOUR), array.sensors[i].flicker_T
            processes = [(0.0, 0.0, drift)] if drift else []
            processes += [(flicker, 2.0 * math.pi * corner_Hz, 0.0) for corner_Hz in _FLICKER_HZ] if flicker else []
            noise_T = array.sensors[i].noise_T
            if background.offset:
                processes.append((background.offset * noise_T, 0.0, background.walk_rts * noise_T))
            for at_first, rate, noise in processes:
                of_channel.append(channel)
                sigma.append(at_first)
                decay.append(rate)
                walk.append(noise)
        slopes = (background.slope_Hz * array.channel_noise_T) if background.slope_Hz else np.zeros(0)
        flat = np.zeros(slopes.size)
        return cls(
            array,
            np.concatenate([sigma, slopes]),
            np.concatenate([decay, flat]),
            np.concatenate([walk, flat]),
            np.array(of_sensor, dtype=np.intp).reshape(-1, 2),
            np.array([*of_channel, *range(slopes.size)], dtype=np.intp),
            np.repeat([False, True], [len(of_channel), slopes.size]),
            background.about_s,
        )

    @property
    def n_states(self) -> int:
        """Number of error states."""
        return self.sigma.size

    @property
    def is_constant(self) -> bool:
        """True if the effect is the same in every row, as for offsets."""
        fields = (self.of_sensor[:, 1] >= _FIELD) & (self.of_sensor[:, 1] < _INDUCED)
        return bool(fields.all() and not self.is_slope.any() and not self.array.channel_is_scalar.any())

    @property
    def has_induced(self) -> bool:
        """True if an error belongs to an induced field or to eddy currents."""
        return bool((self.of_sensor[:, 1] >= _INDUCED).any())

    @property
    def depends_on_field(self) -> bool:
        """True if an effect is proportional to the field at the sensor, as for gains and rotations."""
        return bool((self.of_sensor[:, 1] < _FIELD).any())

    def step(self, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """Return decay factors and added standard deviations, (n,) each, over a time step."""
        kept = np.exp(-self.decay_Hz * dt_s)
        stationary = self.sigma * np.sqrt(-np.expm1(-2.0 * self.decay_Hz * dt_s))
        return kept, np.hypot(stationary, self.walk * math.sqrt(dt_s))

    def effect(
        self, array: SensorArray, readings_T: FloatArray, time_s: float = 0.0, rate_rad_s: FloatArray | None = None
    ) -> FloatArray:
        """Return the derivative (..., C, n) of readings (..., C) [T] by the errors.

        It is finite for missing readings too. Induced fields take one row at a time. The array rotates at a rate (3,)
        about its own axes.
        """
        effect = np.zeros((*readings_T.shape[:-1], array.n_channels, self.n_states))
        n = len(self.of_sensor)
        if n:
            sensor, column = self.of_sensor.T
            known = (column >= _FIELD).all()
            of_rows = (*readings_T.shape[:-1], array.n_sensors, 3)
            of_axes = np.zeros((*of_rows, _FIELD)) if known else calibration_errors(array, readings_T)
            of_field = _field_jacobian(array)
            of_axes = np.concatenate([of_axes, np.broadcast_to(of_field, (*of_rows, 3))], axis=-1)
            if self.has_induced:
                ambient_T = ambient_in_array(array, readings_T)
                change_T_s = np.zeros(3) if rate_rad_s is None else np.cross(ambient_T, rate_rad_s)
                induced = [matrix_effects(of_field, field) for field in (ambient_T, change_T_s)]
                of_axes = np.concatenate([of_axes, *induced], axis=-1)
            channel = array.sensor_channels[sensor]
            state, axis = np.nonzero(channel >= 0)
            effect[..., channel[state, axis], state] = of_axes[..., sensor[state], axis, column[state]]
        effect[..., self.of_channel, n + np.arange(self.of_channel.size)] = np.where(
            self.is_slope, time_s - self.about_s, 1.0
        )
        return effect


def ambient_in_array(array: SensorArray, readings_T: FloatArray, ambient_T: FloatArray | None = None) -> FloatArray:
    """Return the ambient field (..., 3) at the middle of the sensors for rows (..., C).

    It is the known field, otherwise the mean reading of the vector sensors. `ambient_T` (..., 3) of each row replaces
    the array's own.
    """
    known_T = array.ambient_fields.mean(axis=0) if ambient_T is None else ambient_T
    if np.any(known_T):
        return np.asarray(np.broadcast_to(known_T, (*readings_T.shape[:-1], 3)))
    return mean_of_finite(array.calibrated_field(readings_T), axis=-2)[..., 0, :]


def with_eddies_as_offsets(array: SensorArray, ambient_T: FloatArray, rate_rad_s: FloatArray) -> SensorArray:
    """Return the array with eddy currents as offset errors of the same rms.

    Ambient fields and rates of rotation (n, 3) have one row for each row of readings.
    """
    change_T_s = math.sqrt(np.mean(np.sum(np.cross(ambient_T, rate_rad_s) ** 2, axis=-1)))
    sensors = tuple(
        replace(
            sensor,
            offset_uncertainty_T=math.hypot(sensor.offset_uncertainty_T, sensor.eddy_uncertainty_s * change_T_s),
            eddy_uncertainty_s=0.0,
        )
        for sensor in array.sensors
    )
    return replace(array, sensors=sensors)


def _field_jacobian(array: SensorArray) -> FloatArray:
    """Return the derivative (N, 3, 3) of readings by a field in the array's frame.

    A modulus reads the component along the ambient field.
    """
    rows = np.nan_to_num(array.linear_gain(array.ambient_fields))
    return np.where(array.sensor_channels[..., None] >= 0, rows[array.sensor_channels], 0.0)


def without_lasting_errors(array: SensorArray) -> SensorArray:
    """Return the array with only the noise that is independent from row to row."""
    sensors = tuple(
        replace(
            sensor,
            misalignment_rad=0.0,
            gain_uncertainty=0.0,
            offset_uncertainty_T=0.0,
            flicker_T=0.0,
            drift_T_rth=0.0,
            induced_uncertainty=0.0,
            eddy_uncertainty_s=0.0,
        )
        for sensor in array.sensors
    )
    return replace(array, sensors=sensors)
