"""Preparation of gyro, accelerometer and magnetometer readings on Earth: bias, lag and level attitude.

See docs/theory/complementary-filters.md. Source of the low-pass: D. Laidig, T. Seel, VQF, Information Fusion 91, 2023.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.complementary.heading import HeadingModel
from adcs.complementary.inertial.gaps import (
    LOST_RAD,
    UNKNOWN_RAD,
    gap_warnings,
    hidden_variance,
    numbered_windows,
    observed_turn_variance,
    sensor_gaps,
    window_scatter,
)
from adcs.complementary.inertial.integration import gyro_attitudes, level_attitudes, low_pass
from adcs.complementary.inertial.level import GRAVITY_TIME_S, TILT_FLOOR_RAD, Steady, Up, direction_up
from adcs.complementary.inertial.misreadings import check_lengths, check_turns
from adcs.satellite.conventions import median
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import GyroSamples, instants_within, step_rates, steps_s
from adcs.satellite.wahba import attitude_of_vectors
from arrays.io.values import numbers, seconds
from arrays.typing import BoolArray, FloatArray
from magloc import core

_TURN_S = 0.5  # time for which a hand turns in one direction
_USEFUL_TILT_RAD = math.radians(2.0)  # largest σ of the tilt with which the field is used
_UP_STEP = 0.15  # part of the tilt's error that a step corrects; the direction up is already smooth
_LONGEST_UP_STEP = 0.5 / _UP_STEP  # in usual steps: after a gap half of the error is corrected
_REST_S = 1.5
_REST_RATE_RAD_S = math.radians(0.5)
_REST_ACCELERATION_M_S2 = 0.15
_START_RATE_RAD_S = math.radians(2.0)
_START_ACCELERATION_M_S2 = 0.3
_START_BIAS_RAD_S = math.radians(5.0)
_UNKNOWN_BIAS_RAD_S = 0.01  # standard deviation for a gyro that is never at rest
_LAG_WINDOW_S = 0.2
_LAG_EVERY_S = 0.01  # closer readings are redundant
LONGEST_LAG_S = 0.04
"""Longest lag of a magnetometer behind the gyro [s]."""
_USUAL_LENGTH = 0.1  # largest relative difference of the length of an undisturbed field
_LARGEST = {"rate_rad_s": (1e4, "rad/s"), "acceleration_m_s2": (1e6, "m/s²"), "field_T": (1.0, "T")}


@dataclass(frozen=True, eq=False)
class InertialMagneticRecord:
    """Readings of one inertial unit at n instants, NaN where missing.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Ascending times, in any steps.
    rate_rad_s, acceleration_m_s2, field_T : ndarray, shape (n, 3)
        Readings in body axes. At rest the acceleration is 9.8 m/s² upwards. Without a magnetometer the field has no
        reading.
    gyro_samples : str
        Kind of the gyro's samples: see :func:`adcs.satellite.vector_record.step_rates`.

    Raises
    ------
    ValueError
        The times do not ascend, the shapes do not match, a value is infinite, a sensor is not read at the start, a
        vector is zero, or there is less than a second.
    """

    time_s: FloatArray
    rate_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    field_T: FloatArray
    gyro_samples: GyroSamples = "mean"

    def __post_init__(self) -> None:
        object.__setattr__(self, "time_s", seconds(self.time_s))
        shape = (len(steps_s(self.time_s)), 3)
        if np.ptp(self.time_s) < 1.0:
            raise ValueError(
                f"Input time_s must cover a second at least, in seconds; instead received {np.ptp(self.time_s):g} s."
            )
        for name in ("rate_rad_s", "acceleration_m_s2", "field_T"):
            values = numbers(getattr(self, name))
            if values.shape != shape or np.isinf(values).any():
                found = "an infinite value" if values.shape == shape else f"shape {values.shape}"
                raise ValueError(f"Input {name} must be finite, of shape {shape}; instead received {found}.")
            largest, unit = _LARGEST[name]
            if (most := np.nanmax(np.abs(values), initial=0.0)) > largest:
                raise ValueError(
                    f"Input {name} must not exceed {largest:g} {unit}; instead received {most:.3g}. "
                    f"Convert it to {unit}."
                )
            missing = np.asarray(np.isnan(values).any(axis=1))
            if missing.any():
                values = np.where(missing[:, None], np.nan, values)
            if missing[self.in_first_second].all() and not (name == "field_T" and missing.all()):
                raise ValueError(f"Input {name} must have a reading within the first second; instead received none.")
            if name != "rate_rad_s" and (values == 0.0).all(axis=1).any():
                zero = int(np.argmax((values == 0.0).all(axis=1)))
                raise ValueError(
                    f"Input {name} must have a length, of gravity or of the Earth's field; instead received a zero "
                    f"vector at row {zero + 1}."
                )
            object.__setattr__(self, name, values)

    @property
    def has_field(self) -> bool:
        """True if any row has a reading of the magnetometer."""
        return bool(is_read(self.field_T).any())

    @property
    def dt_s(self) -> FloatArray:
        """Steps (n,) that end at each instant."""
        return steps_s(self.time_s)

    @property
    def in_first_second(self) -> BoolArray:
        """Mask (n,) of the instants within the first second."""
        return self.time_s < self.time_s[0] + 1.0

    def __len__(self) -> int:
        """Return the number of instants."""
        return len(self.time_s)


def rest_bias(record: InertialMagneticRecord) -> FloatArray:
    """Return the bias of the gyro at each instant, (n, 3) [rad/s].

    It is the mean of the last 20 rests of 1.5 s. Earlier instants have the bias of the first rest. It is zero if the
    sensor never rests.
    """
    window = numbered_windows(record.time_s, _REST_S)
    rate, *of_rate = window_scatter(record.rate_rad_s, window)
    _, *of_acceleration = window_scatter(record.acceleration_m_s2, window)
    rest = np.ones(len(rate), dtype=np.bool_)
    for (scatter, counts), most in ((of_rate, _REST_RATE_RAD_S), (of_acceleration, _REST_ACCELERATION_M_S2)):
        rest &= (scatter < most) & (2 * counts >= np.median(counts))
    found = rate[rest]
    if len(found) == 0:
        return np.zeros((len(record), 3))
    means = np.array([found[max(0, i - 19) : i + 1].mean(axis=0) for i in range(len(found))])
    # A rest counts from its end on.
    latest = np.maximum(np.cumsum(np.concatenate([[False], rest[:-1]])) - 1, 0)
    return means[latest[window]]


def start_motion(record: InertialMagneticRecord, bias_rad_s: FloatArray) -> str:
    """Describe the motion of the unit in the first second; return an empty string if it rests.

    ``bias_rad_s`` (3,): bias of the gyro, as far as it is known.
    """
    rate, acceleration = (v[record.in_first_second] for v in (record.rate_rad_s, record.acceleration_m_s2))
    turns, varies = (float(np.nanstd(v, axis=0).max()) for v in (rate, acceleration))
    mean = float(np.linalg.norm(np.nanmean(rate, axis=0) - bias_rad_s))
    if turns < _START_RATE_RAD_S and varies < _START_ACCELERATION_M_S2 and mean < _START_BIAS_RAD_S:
        return ""
    return (
        f"the rate is {math.degrees(mean):.2g}°/s and varies by {math.degrees(turns):.2g}°/s, "
        f"the acceleration varies by {varies:.2g} m/s²"
    )


@dataclass(frozen=True, eq=False)
class PreparedReadings:
    """Prepared readings of an inertial unit, for the heading filter.

    ``q_level`` (n, 4): level from body, from gyro and accelerometer alone; its heading starts unknown and drifts.
    """

    time_s: FloatArray  # (n,)
    rate_rad_s: FloatArray  # (n, 3): mean over the step that ends at each instant, without the bias
    bias_rad_s: FloatArray  # (n, 3)
    field_T: FloatArray  # (n, 3): rotated by the gyro to remove the magnetometer's lag
    q_level: FloatArray
    lag_s: float  # lag of the magnetometer behind the gyro
    tilt_sigma_rad: FloatArray  # (n,): σ of the angle between up and its estimate
    hidden_rad2: FloatArray | None = None  # (n,): growth of the attitude's variance within gaps of the gyro
    start_tilt_rad: float = 0.0  # σ of the tilt at the first used field, after a start in motion
    bias_sigma_rad_s: float = 0.0  # σ of the bias of a gyro that never rests
    warnings: tuple[str, ...] = ()

    @property
    def in_first_second(self) -> BoolArray:
        """Mask (n,) of the instants within the first second."""
        return self.time_s < self.time_s[0] + 1.0


def check_units(record: InertialMagneticRecord) -> None:
    """Raise ValueError if the units or axes of a sensor, or the unit of time, contradict the others."""
    check_lengths(record.acceleration_m_s2, record.field_T, record.in_first_second)
    gap = np.zeros(len(record), np.bool_)
    for before, after in sensor_gaps(record.time_s, is_read(record.rate_rad_s)):
        gap[before + 1 : after + 1] = True
    rate = step_rates(_extend_to_start(record.rate_rad_s), record.dt_s, record.gyro_samples)
    check_turns(record.time_s, rate, record.acceleration_m_s2, record.field_T, gap)


def _extend_to_start(rate_rad_s: FloatArray) -> FloatArray:
    """Fill the rows before the first rate by that rate."""
    first = int(np.argmax(is_read(rate_rad_s)))
    return np.concatenate([np.repeat(rate_rad_s[first : first + 1], first, axis=0), rate_rad_s[first:]])


@dataclass(frozen=True, eq=False)
class RecordMotion:
    """Motion that the gyro of a record shows, and gaps of its sensors."""

    time_s: FloatArray  # (n,)
    bias_rad_s: FloatArray  # (n, 3)
    bias_sigma_rad_s: float  # σ of the bias of a gyro that never rests
    start_motion: str  # in words; empty at rest
    read: dict[str, BoolArray]  # (n,): rows with a reading of each sensor that the record has, the gyro first
    rate_rad_s: FloatArray  # (n, 3): mean over the step that ends at each instant, without the bias
    q_gyro: FloatArray  # (n, 4): attitudes of the gyro alone, starting with the identity
    gaps: NDArray[np.intp]  # (k, 2): rows before and after the gaps of the gyro
    hidden_rad2: FloatArray  # (n,): growth of the attitude's variance within these gaps, and by rotations seen after

    @classmethod
    def of(cls, record: InertialMagneticRecord, model: HeadingModel) -> RecordMotion:
        """Return the motion of a record."""
        time_s, dt_s, bias = record.time_s, record.dt_s, rest_bias(record)
        moves = start_motion(record, bias[0])
        read = {"gyro": is_read(record.rate_rad_s), "accelerometer": is_read(record.acceleration_m_s2)}
        if record.has_field:
            read["magnetometer"] = is_read(record.field_T)
        bias_sigma = 0.0
        if not bias.any():
            bias_sigma = _UNKNOWN_BIAS_RAD_S if moves else 0.0
            bias = bias if moves else bias + np.nanmean(record.rate_rad_s[record.in_first_second], axis=0)
        rate = step_rates(_extend_to_start(record.rate_rad_s) - bias, dt_s, record.gyro_samples)
        q_gyro = gyro_attitudes(rate, dt_s)
        gaps = sensor_gaps(time_s, read["gyro"])
        hidden = hidden_variance(time_s, record.rate_rad_s, gaps, model.gap_rad_s, model.long_gap_rad_s)
        usual_field_T = np.where(_has_usual_length(record)[:, None], record.field_T, np.nan)
        hidden += observed_turn_variance(time_s, gaps, hidden, quaternion.rotate(q_gyro, usual_field_T))
        return cls(time_s, bias, bias_sigma, moves, read, rate, q_gyro, gaps, hidden)

    @property
    def warnings(self) -> tuple[str, ...]:
        """Sentences on a start in motion and on gaps of the sensors."""
        hides = [np.sum(self.hidden_rad2[before + 1 : after + 1]) > LOST_RAD**2 for before, after in self.gaps]
        of_gaps = gap_warnings(self.time_s, self.read, self.gaps[np.array(hides, np.bool_)])
        if not self.start_motion:
            return tuple(of_gaps)
        never = ", and it never rests, so that the gyro's bias is unknown" if self.bias_sigma_rad_s else ""
        start = f"the unit is not at rest in the first second ({self.start_motion}){never}"
        return f"{start}; the start is estimated with a larger σ", *of_gaps


def prepare(
    record: InertialMagneticRecord, model: HeadingModel = HeadingModel(), *, offline: bool = False
) -> PreparedReadings:
    """Remove bias, lag and motion from a record; see :class:`PreparedReadings`.

    Each instant uses the readings up to it, offline the whole record. The lag always uses the whole record. Without
    `offline` it is the reference, with :func:`adcs.complementary.heading.heading_track`, for
    :class:`adcs.AttitudeFilter`.
    """
    motion = RecordMotion.of(record, model)
    time_s, dt_s, rate, q_gyro = record.time_s, record.dt_s, motion.rate_rad_s, motion.q_gyro
    gaps, hidden, bias_sigma = motion.gaps, motion.hidden_rad2, motion.bias_sigma_rad_s
    at_rest = record.in_first_second & (not motion.start_motion) & (np.cumsum(hidden) < LOST_RAD**2)
    acceleration = quaternion.rotate(q_gyro, record.acceleration_m_s2)
    drift = max(model.gyro_drift_rad_s, bias_sigma)
    up = direction_up(Steady(time_s, dt_s, acceleration, at_rest, gaps, hidden, drift), offline=offline)
    part = _UP_STEP * np.minimum(dt_s / float(np.median(dt_s)), _LONGEST_UP_STEP)
    q_level = _level_attitudes(q_gyro, up, np.where(up.fresh, 1.0, part))
    lag, field_T, start_tilt = magnetometer_lag(record, motion), record.field_T, 0.0
    if record.has_field:
        field_T = _remove_lag(q_gyro, time_s, field_T, lag)
        has_field = motion.read["magnetometer"]
        best = float(up.sigma_rad[has_field].min())
        useful = up.sigma_rad <= max(_USEFUL_TILT_RAD, 1.5 * best)
        for before, after in gaps:
            useful[before + 1 : after] = False
        field_T = np.where(useful[:, None], field_T, np.nan)
        start_tilt = float(up.sigma_rad[np.argmax(useful & has_field)])
    more_rad2 = up.sigma_rad**2 + (GRAVITY_TIME_S * bias_sigma) ** 2 + up.drift_rad**2
    return PreparedReadings(
        time_s,
        rate,
        motion.bias_rad_s,
        field_T,
        q_level,
        lag,
        _tilt_sigma_rad(dt_s, rate, up.hidden_rad2, model, np.sqrt(more_rad2)),
        up.hidden_rad2,
        start_tilt,
        bias_sigma,
        motion.warnings,
    )


def _level_attitudes(q_gyro: FloatArray, up: Up, part: FloatArray) -> FloatArray:
    """Return level attitudes (n, 4), from body.

    Where the direction up starts anew, the shortest rotation turns it upwards.
    """
    q_level = np.empty_like(q_gyro)
    starts = 1 + np.flatnonzero(up.fresh[1:] & ~up.fresh[:-1])
    for begin, end in pairwise([0, *starts, len(up.up)]):
        v = up.up[begin]
        if begin == 0:
            # North is any axis that is not along the direction up.
            north = np.eye(3)[np.argmin(np.abs(v))]
            frame = [[[0.0, 0.0, 1.0]], [[0.0, 1.0, 0.0]]]
            start = attitude_of_vectors([v[None], north[None]], frame, [1.0, 1.0], method="triad").q[0]
        else:
            start = quaternion.multiply(q_level[begin - 1], quaternion.conjugate(q_gyro[begin - 1]))
            start = quaternion.turned_onto(start, v, np.array([0.0, 0.0, 1.0]))
        q_level[begin:end] = level_attitudes(q_gyro[begin:end], up.up[begin:end], part[begin:end], start)
    return q_level


def _tilt_sigma_rad(
    dt_s: FloatArray, rate: FloatArray, hidden_rad2: FloatArray, model: HeadingModel, more_rad: FloatArray
) -> FloatArray:
    """Return σ of the tilt from the accelerometer, the gyro's scale and the delay of the low-pass."""
    squares = (model.gyro_scale**2 * np.einsum("ni,ni->n", rate, rate) + hidden_rad2 / _TURN_S**2)[:, None]
    smooth = low_pass(squares, dt_s, GRAVITY_TIME_S, squares[0])[:, 0]
    sigma = np.sqrt(TILT_FLOOR_RAD**2 + _TURN_S**2 * np.maximum(smooth, 0.0) + np.square(more_rad))
    return np.minimum(sigma, UNKNOWN_RAD)


def magnetometer_lag(record: InertialMagneticRecord, motion: RecordMotion) -> float:
    """Return the lag of the magnetometer behind the gyro [s]; zero without a magnetometer or rotations.

    With it, the field in a fixed frame changes least within a fifth of a second. Readings with another length than in
    the first second are not used, because a magnet on the sensor rotates with it.
    """
    if not record.has_field:
        return 0.0
    time_s, field_T = record.time_s, record.field_T
    rows = np.flatnonzero(is_read(field_T))
    step = float(np.median(record.dt_s))
    rows = rows[:: instants_within(_LAG_EVERY_S, time_s[rows])]
    apart = instants_within(_LAG_WINDOW_S, time_s[rows])
    good = _has_usual_length(record)[rows]
    most = round(LONGEST_LAG_S / step)
    changes = np.zeros(most + 1)
    work = core.problem(
        "lags",
        n_instants=len(time_s),
        n_rows=len(rows),
        apart=apart,
        time=np.ascontiguousarray(time_s),
        q=np.ascontiguousarray(motion.q_gyro),
        field=np.ascontiguousarray(field_T),
        rows=np.ascontiguousarray(rows),
        is_good=good.astype(np.uint8),
        lags=step * np.arange(most + 1),
        changes=changes,
    )
    core.run("lag_changes", work, len(changes), block=1)
    least = int(np.argmin(changes))
    if not 0 < least < most:
        return min(least * step, LONGEST_LAG_S)
    a, b, c = changes[least - 1 : least + 2]
    return min((least + 0.5 * (a - c) / (a - 2.0 * b + c)) * step, LONGEST_LAG_S)


def _has_usual_length(record: InertialMagneticRecord) -> BoolArray:
    """Return whether each field (n, 3) is as long as in the first second, within a tenth."""
    lengths = np.sqrt(np.einsum("ni,ni->n", record.field_T, record.field_T))
    usual = median(lengths[record.in_first_second])
    return np.asarray(np.abs(lengths - usual) < _USUAL_LENGTH * usual)


def _remove_lag(q_gyro: FloatArray, time_s: FloatArray, field_T: FloatArray, lag_s: float) -> FloatArray:
    return quaternion.rotate_back(q_gyro, rotate_to_fixed_frame(q_gyro, time_s, field_T, lag_s))


def rotate_to_fixed_frame(q: FloatArray, time_s: FloatArray, field_T: FloatArray, lag_s: float) -> FloatArray:
    """Rotate readings (n, 3) of a sensor with a lag into a frame that does not rotate.

    ``q`` (n, 4): attitudes at the times (n,), interpolated linearly.
    """
    then = np.stack([np.interp(time_s - lag_s, time_s, component) for component in q.T], axis=-1)
    return quaternion.rotate(quaternion.normalised(then), field_T)
