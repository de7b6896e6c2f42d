"""Readings of a vehicle: inertial unit, magnetometers and currents, each with its own clock rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from adcs.complementary.inertial.gaps import sensor_gaps
from adcs.satellite.vector_record import GyroSamples, step_rates, steps_s
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.navigation.poses import vectors_at

SHORTEST_S, FEWEST_ROWS = 2.0, 10
_KNOT_S, _MOST_KNOTS = 2.0, 1500
_LONGEST_GAP_S = 0.25
_STUCK_S, _STUCK_ROWS = 5.0, 20
_MOVED = 0.05  # of the field: change of the other axes that noise or coarse steps do not make
_SILENT_S = 5.0


@dataclass(frozen=True, eq=False)
class Series:
    """Samples of one channel.

    Attributes
    ----------
    name : str
    time_s : ndarray, shape (n,)
        Ascending times, on the clock of the inertial unit.
    values : ndarray, shape (n,) or (n, 3)
        A current or throttle, or the field of a magnetometer [T].
    device_id : int
        Identifier of the sensor in the autopilot; 0 if unknown.
    """

    name: str
    time_s: FloatArray
    values: FloatArray
    device_id: int = 0

    @property
    def span(self) -> float:
        """Difference of the largest and the smallest value, at least 1e-6."""
        return max(float(np.ptp(self.values)), 1e-6)

    def stuck_parts(self) -> list[tuple[float, float]]:
        """Return the times in which readings (n, 3), or one axis while the others move, are equal for too long."""
        least = _MOVED * float(np.median(np.linalg.norm(self.values, axis=1)))
        runs = self._equal_runs(self.values)
        for axis in range(3):
            others = np.delete(self.values, axis, axis=1)
            moved = (
                run for run in self._equal_runs(self.values[:, [axis]]) if np.ptp(others[run], axis=0).max() > least
            )
            runs += moved
        return [(float(self.time_s[run.start]), float(self.time_s[run.stop - 1])) for run in runs]

    def _equal_runs(self, values: FloatArray) -> list[slice]:
        """Return the rows of equal values (n, k) that last longer than a sensor's noise allows."""
        new = np.concatenate([[True], (np.diff(values, axis=0) != 0.0).any(axis=1)])
        begin = np.flatnonzero(new)
        end = np.append(begin[1:], len(new)) - 1
        long = (end - begin >= _STUCK_ROWS) & (self.time_s[end] - self.time_s[begin] > _STUCK_S)
        return [slice(int(first), int(last) + 1) for first, last in zip(begin[long], end[long], strict=True)]

    def silent_parts(self, first_s: float, last_s: float) -> list[tuple[float, float]]:
        """Return the times between two instants in which there are no readings for long."""
        times = np.concatenate([[first_s], self.time_s, [last_s]])
        return [(float(times[k]), float(times[k + 1])) for k in np.flatnonzero(np.diff(times) > _SILENT_S)]

    def outside(self, parts: list[tuple[float, float]]) -> Series:
        """Return the series without some parts."""
        kept = np.ones(len(self.time_s), np.bool_)
        for begin, end in parts:
            kept &= (self.time_s < begin) | (self.time_s > end)
        return Series(self.name, self.time_s[kept], self.values[kept], self.device_id)

    def finite(self) -> Series:
        """Return the series without missing samples and without samples that are not later than the one before."""
        read = np.isfinite(self.values.reshape(len(self.values), -1)).all(axis=1) & np.isfinite(self.time_s)
        times, values = self.time_s[read], self.values[read]
        later = np.concatenate([[True], times[1:] > np.maximum.accumulate(times)[:-1]]) if len(times) else read[:0]
        return Series(self.name, times[later], values[later], self.device_id)


@dataclass(frozen=True, eq=False)
class VehicleLog:
    """Readings of a vehicle, SI units and body axes, NaN where missing.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Ascending times of the inertial unit.
    gyro_rad_s, acceleration_m_s2 : ndarray, shape (n, 3)
        Rates and specific force; at rest the acceleration points upwards.
    magnetometers : tuple of Series
        Fields [T] of one magnetometer or more.
    currents : tuple of Series
        Currents or throttles whose fields are estimated.
    gyro_samples : str
        Kind of the gyro's samples, as in :func:`adcs.complementary_filter`.

    Raises
    ------
    ValueError
        The shapes do not agree, times do not ascend, gyro or accelerometer have fewer than ten readings, a magnetometer
        is missing, a unit is wrong, or the log is shorter than 2 s.

    Examples
    --------
    >>> import sims
    >>> log = sims.simulate_flight(1, sims.FlightSettings(duration_s=5.0, magnetometers=2)).log
    >>> [magnetometer.name for magnetometer in log.magnetometers]
    ['mag0', 'mag1']
    """

    time_s: FloatArray
    gyro_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    magnetometers: tuple[Series, ...]
    currents: tuple[Series, ...] = ()
    gyro_samples: GyroSamples = "mean"

    def __post_init__(self) -> None:
        """Check the readings."""
        n = len(self.time_s)
        for name, values in (("gyro_rad_s", self.gyro_rad_s), ("acceleration_m_s2", self.acceleration_m_s2)):
            if values.shape != (n, 3):
                raise ValueError(f"Input {name} must have shape ({n}, 3); instead received {values.shape}.")
            if (read := np.isfinite(values).all(axis=1).sum()) < FEWEST_ROWS:
                raise ValueError(f"Input {name} must have {FEWEST_ROWS} readings at least; instead received {read}.")
        steps_s(self.time_s)
        if np.ptp(self.time_s) < SHORTEST_S:
            raise ValueError(
                f"Input time_s must span {SHORTEST_S:g} s at least; instead received {np.ptp(self.time_s):.3g} s."
            )
        if not self.magnetometers:
            raise ValueError("Input magnetometers must name one magnetometer at least; instead received none.")
        _check_size("gyro_rad_s", self.gyro_rad_s, 0.0, 50.0, "rad/s")
        _check_size("acceleration_m_s2", self.acceleration_m_s2, 1.0, 100.0, "m/s²")
        for one in self.magnetometers:
            _check_size(f"{one.name}", one.values, 1e-7, 1e-2, "T")
        for one in self.currents:
            if np.isfinite(one.values).sum() < 2:
                raise ValueError(f"Input {one.name} must have two values at least; instead received fewer.")


def _check_size(name: str, values: FloatArray, least: float, most: float, unit: str) -> None:
    """Refuse vectors (n, 3) whose typical length no sensor has."""
    known = values[np.isfinite(values).all(axis=1)]
    lengths = np.linalg.norm(known, axis=1)
    lengths = lengths[lengths > 0.0] if lengths.any() else lengths  # a sensor that stops may go on with zeros
    size = float(np.median(lengths)) if len(lengths) else least
    if not least <= size <= most:
        raise ValueError(
            f"Input {name} must have a median length of {least:g} to {most:g} {unit}; instead received {size:.3g}"
            f" {unit}. Check its unit."
        )


@dataclass(frozen=True, eq=False)
class InertialData:
    """Inertial readings between knots, as the estimator uses them.

    Attributes
    ----------
    time_s, dt_s : ndarray, shape (n,)
    rate_rad_s : ndarray, shape (n, 3)
        Mean rate over the step that ends at each instant.
    acceleration_m_s2 : ndarray, shape (n, 3)
        Specific force, without missing samples.
    knots : ndarray of int, shape (K,)
        Instants of the knots; the first and the last instant are knots.
    in_gap : ndarray of bool, shape (K - 1,)
        Intervals in which the gyro has a gap.
    """

    time_s: FloatArray
    dt_s: FloatArray
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    knots: IntArray
    in_gap: BoolArray

    @classmethod
    def of(cls, log: VehicleLog) -> InertialData:
        """Return the inertial readings of a log from the gyro's first reading to its last."""
        read = np.asarray(np.isfinite(log.gyro_rad_s).all(axis=1))
        first, last = int(np.argmax(read)), len(read) - int(np.argmax(read[::-1]))
        piece = slice(first, last)
        times, gyro, force = log.time_s[piece], log.gyro_rad_s[piece], log.acceleration_m_s2[piece]
        dt = steps_s(times)
        rate = step_rates(gyro, dt, log.gyro_samples)
        known = np.asarray(np.isfinite(force).all(axis=1))
        whole = vectors_at(times, times[known], force[known])
        length = max(_KNOT_S, np.ptp(times) / _MOST_KNOTS)
        at = times[0] + length * np.arange(1, int(np.ptp(times) / length))
        knots = np.unique(np.concatenate([[0], np.searchsorted(times, at), [len(times) - 1]]))
        in_gap = np.zeros(len(knots) - 1, np.bool_)
        for gaps in (sensor_gaps(times, read[piece], _LONGEST_GAP_S), sensor_gaps(times, known, _LONGEST_GAP_S)):
            for before, after in gaps:
                in_gap[np.searchsorted(knots, before, "right") - 1 : np.searchsorted(knots, after, "left")] = True
        return cls(times, dt, rate, whole, knots, in_gap)

    @property
    def span_s(self) -> FloatArray:
        """Lengths (K - 1,) of the intervals."""
        return np.diff(self.time_s[self.knots])

    @property
    def interval(self) -> IntArray:
        """Interval (n,) of each instant; the last instant belongs to the last one."""
        of = np.searchsorted(self.knots, np.arange(len(self.time_s)), "right") - 1
        return np.minimum(of, len(self.knots) - 2)

    def part(self, time_s: FloatArray, interval: IntArray) -> FloatArray:
        """Return the elapsed part of the interval at some times, 0 to 1."""
        begin, end = self.time_s[self.knots[interval]], self.time_s[self.knots[interval + 1]]
        return (time_s - begin) / (end - begin)
