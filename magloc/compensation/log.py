"""Log of a moving platform: readings without outliers, as signals."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import maximum_filter1d

from arrays.array import SensorArray
from arrays.io.values import numbers
from arrays.sensor import Sensor
from arrays.typing import FloatArray
from magloc.compensation.attitude import Attitude, AttitudeErrors, currents_at
from magloc.compensation.fit import FEWEST_ROWS, CalibrationRows
from magloc.compensation.signals import Signal, white_noise
from magloc.measurement.plausibility import finite_median
from magloc.measurement.rows import check_magnitudes, check_order
from magloc.measurement.screening import wild_readings
from magloc.navigation.poses import rotations_at
from magloc.readings import Readings, without_saturated
from magloc.surveying.preparation import stuck_readings

_STEP_DEPTHS = 0.4  # usual step of the rows, relative to the depth of sources, for the search for outliers
_SAME_UNIT = 1.25  # largest ratio of a vector sensor's modulus to that of the scalar sensors
_FEWEST_SHARE = 0.3  # least share of rows in which a vector sensor that states the attitude reads
_TURN_RAD = 0.02  # prior of the turn between a pose and the sensors, if the array file states none
_JUMP, _BESIDE_JUMP = 8.0, 3  # in usual steps; rows beside it
_FLOWN_M = 10.0


@dataclass(frozen=True, eq=False)
class PlatformLog:
    """Log of a moving platform.

    Attributes
    ----------
    array : SensorArray
    readings : Readings
        Readings without saturated, stuck and wild values.
    signals : dict of str to Signal
        Calibrated field of each vector sensor, in the array's axes and the scalar sensors' unit, and modulus of each
        scalar sensor.
    factors : dict of str to float
        Modulus of each vector sensor over that of the scalar sensors where units differ, else 1.
    currents : Signal, optional
    jumps : ndarray, shape (n, K)
        Currents minus the signal, which has no jumps.
    left_out : dict of str to tuple of int
        Numbers of stuck and of wild readings of each sensor.
    """

    array: SensorArray
    readings: Readings
    signals: Mapping[str, Signal]
    factors: Mapping[str, float]
    currents: Signal | None
    jumps: FloatArray
    left_out: Mapping[str, tuple[int, int]]

    @classmethod
    def of(cls, array: SensorArray, readings: Readings, currents: FloatArray) -> PlatformLog:
        """Return the log of readings in order of time, and of currents (n, K) relative to a mean."""
        check_magnitudes(array)
        if len(readings) < FEWEST_ROWS:
            raise ValueError(f"Input readings must have {FEWEST_ROWS} rows or more; instead received {len(readings)}.")
        check_order(readings)
        values, left_out = _clean(array, without_saturated(readings, array), currents)
        readings = replace(readings, values_T=values)
        fields, moduli = array.calibrated_field(values), {}
        for i, sensor in enumerate(array.sensors):
            if sensor.kind == "scalar":
                channel = int(array.sensor_channels[i, 0])
                moduli[sensor.id] = (values[:, channel] - array.channel_offset_T[channel]) / array.channel_gain[
                    channel, 0
                ]
        usual = finite_median(np.stack(list(moduli.values()))) if moduli else np.nan
        signals, factors = {}, {}
        for i, sensor in enumerate(array.sensors):
            if sensor.kind == "scalar":
                signals[sensor.id] = Signal.of(readings.time_s, moduli[sensor.id][:, None])
                continue
            ratio = finite_median(np.linalg.norm(fields[:, i], axis=1)) / usual
            factors[sensor.id] = 1.0 if np.isnan(ratio) or 1.0 / _SAME_UNIT < ratio < _SAME_UNIT else ratio
            signals[sensor.id] = Signal.of(readings.time_s, fields[:, i] / factors[sensor.id])
        flowing = None if not currents.shape[1] else Signal.of(readings.time_s, currents)
        jumps = np.nan_to_num(currents - currents_at(flowing, readings.time_s))
        return cls(array, readings, signals, factors, flowing, jumps, left_out)

    def noise_T(self, sensor: Sensor) -> float:
        """Return the noise of a sensor in the scalar sensors' unit: stated, or that of the readings if larger."""
        own = self.readings.values_T[:, self.array.channel_sensor == self.array.ids.index(sensor.id)]
        read = float(white_noise(self.readings.time_s, own).max(initial=0.0))
        return max(sensor.noise_T, read) / self.factors.get(sensor.id, 1.0)

    @property
    def compass(self) -> Sensor | None:
        """Vector sensor that gives the attitude: the one with the least noise of those that read in most rows."""
        read = np.isfinite(self.readings.values_T).mean(axis=0)
        usable = [
            sensor
            for i, sensor in enumerate(self.array.sensors)
            if sensor.kind == "vector"
            and self.signals[sensor.id].stretches
            and read[self.array.channel_sensor == i].min() > _FEWEST_SHARE
        ]
        return min(usable, key=lambda sensor: sensor.noise_T, default=None)

    def attitude_of(self, sensor: Sensor) -> Attitude:
        """Return the direction of the ambient field as a vector sensor reads it."""
        signal = self.signals[sensor.id]
        if not signal.stretches:
            raise ValueError(
                f"Input readings must have a stretch of readings of sensor {sensor.id} without gaps; instead"
                " received none."
            )
        values = signal.samples()[1]
        return Attitude.of(signal, self.noise_T(sensor) / float(np.median(np.linalg.norm(values, axis=1))))

    def attitude_of_pose(self) -> Attitude:
        """Return the direction of the ambient field from the pose of the array."""
        readings = self.readings
        if readings.ambient_T is None:
            raise ValueError(
                "Input readings must state the attitude of the platform by a vector sensor, or by a pose with the"
                " ambient field; instead received neither."
            )
        pose = self.array.pose
        signal = Signal.of(readings.time_s, readings.ambient_T)
        if not signal.stretches:
            raise ValueError("Input readings must have a stretch of rows without gaps; instead received none.")
        attitude = Attitude.of(signal, 0.0 if pose is None or pose.correlation_s else pose.attitude_rad)
        return replace(
            attitude, errors=AttitudeErrors.of_turn(_TURN_RAD if pose is None else pose.attitude_constant_rad)
        )

    def turning_at(self, time_s: FloatArray) -> FloatArray | None:
        """Return rates of the array about its axes (n, 3) [rad/s] between some times; None without a pose."""
        if self.readings.array_rotation is None:
            return None
        turned = rotations_at(time_s, self.readings.time_s, self.readings.array_rotation)
        steps = (turned[:-1].inv() * turned[1:]).as_rotvec() / np.diff(time_s)[:, None]
        return np.concatenate([steps, steps[-1:]])

    def rows_of(self, sensor: Sensor, attitude: Attitude) -> CalibrationRows:
        """Return the samples of a sensor that its platform is fitted to."""
        signal = self.signals[sensor.id]
        time_s, values = signal.samples()
        if len(time_s) < FEWEST_ROWS:
            raise ValueError(
                f"Input readings must have {FEWEST_ROWS} samples of sensor {sensor.id} in stretches without gaps;"
                f" instead received {len(time_s)}."
            )
        place, readings = None, self.readings
        if readings.array_position_m is not None and np.ptp(readings.array_position_m, axis=0).max() > _FLOWN_M:
            place = np.stack([np.interp(time_s, readings.time_s, x) for x in readings.array_position_m.T], axis=1)
        is_own = sensor.kind == "vector"
        noise = sensor.noise_T / self.factors.get(sensor.id, 1.0) * np.sqrt(signal.noise_share())
        return CalibrationRows(
            time_s, np.linalg.norm(values, axis=1), attitude, is_own, self.currents, place, float(noise)
        )


def columns_of(currents: Mapping[str, ArrayLike] | None, names: tuple[str, ...], n: int) -> FloatArray:
    """Return currents (n, K) of some names; refuse others, and columns of another length."""
    given = {} if currents is None else dict(currents)
    if tuple(given) != names:
        raise ValueError(f"Inputs currents of log and calibration must have the same names; instead received {names}.")
    columns = [numbers(given[name]) for name in names]
    for name, column in zip(names, columns, strict=True):
        if column.shape != (n,):
            raise ValueError(f"Input currents must have shape ({n},); instead received {column.shape} for {name}.")
        if not np.isfinite(column).any():
            raise ValueError(f"Input currents must have a reading of each current; instead received none of {name}.")
    return np.stack(columns, axis=1) if names else np.zeros((n, 0))


def _clean(
    array: SensorArray, readings: Readings, currents: FloatArray
) -> tuple[FloatArray, dict[str, tuple[int, int]]]:
    """Return readings (n, C) without stuck and wild values of sensors, and the numbers of both by sensor.

    Near the jump of a current no reading counts as wild.
    """
    values, time_s = readings.values_T.copy(), readings.time_s
    stuck = stuck_readings(array, values)
    place = np.zeros((len(time_s), 3))
    place[:, 0] = time_s * (_STEP_DEPTHS / float(np.median(np.diff(time_s))))
    steps = np.abs(np.diff(currents, axis=0, prepend=currents[:1]))
    jumps = (
        (steps > _JUMP * np.median(np.nan_to_num(steps), axis=0)).any(axis=1)
        if currents.size
        else np.zeros(len(values), bool)
    )
    jumps = maximum_filter1d(jumps, 1 + 2 * _BESIDE_JUMP)
    left_out = {}
    for i, sensor in enumerate(array.sensors):
        own = np.flatnonzero(array.channel_sensor == i)
        values[np.ix_(stuck[:, i], own)] = np.nan
        wild = np.any([wild_readings(values[:, c], place, 1.0, sensor.noise_T, 0.0) for c in own], axis=0)
        wild &= ~jumps
        values[np.ix_(wild, own)] = np.nan
        left_out[sensor.id] = int(stuck[:, i].sum()), int(wild.sum())
    return values, left_out
