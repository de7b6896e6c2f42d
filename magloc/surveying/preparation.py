"""Preparation of readings for a survey: whole rows, as anomalies in the world frame."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter1d, minimum_filter1d

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.pose import PoseErrors, with_stated_pose
from magloc.measurement.rows import check_magnitudes, check_order
from magloc.measurement.screening import wild_readings
from magloc.navigation.course import APART_M
from magloc.navigation.fixes import between_fixes, interval_of_fixes
from magloc.navigation.flight_lines import FlightLine, flight_lines, rows_of_turns
from magloc.navigation.poses import vectors_at
from magloc.readings import Readings, without_saturated
from magloc.surveying.error_components import unstated_pose
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.sensor_noise import white_noise_T, with_measured_noise
from magloc.terrain.surface import FLAT, Terrain

_LOG = logging.getLogger(__name__)
FEWEST_ROWS = 20
_MOST_APART = 2.0  # largest ratio of fields in one survey; more means another unit
_LEAST_DEPTH_M, _LOWEST = 0.1, 0.1  # least distance to the shallowest sources; quantile of the sensor's heights
_LEAST_JITTER_M = 0.01
_BASE_STEP, _BASE_NOISE_T = 0.4, 1e-10  # usual step of a base's rows relative to the depth of sources, and its noise
_LONG_GAP, _LONG_GAP_S = 5.0, 30.0  # shortest long gap of a base, in usual steps and in seconds
FASTEST_M_S = 300.0
"""Speed between two rows above which their places leap."""
_BLOCK = 2**18  # rows per block
_LONGEST_RUN = 25  # equal readings in a run, relative to the mean run of the best sensor
_LEAST_DIGIT_T = 1e-14  # smaller steps are rounding errors
_STILL, _LAST_DIGITS = 50, 2.0  # rows within so many steps of the last digit, although the noise is larger
_STILL_ALONE, _OTHERS = 200, 100.0  # the same, although another sensor changes by so many steps
_CUT_RUN, _FEWEST_CUT, _MOST_CUT = 3, 5, 0.25  # rows of a run of clipped readings, of all such runs, and their share
_FEWEST_RUNS = 2  # a carrier that stops at a peak makes one
_CUT_STEP = 4.0  # least step beside such a run, in steps of the last digit; at a rounded peak it is 2
_CUT_RUNS, _PILED, _SMALL_STEP = 3, 5.0, 1.5  # or this step, with so many runs and more rows than the next values have


def whole_rows(
    array: SensorArray,
    readings: Readings,
    base: Readings | None = None,
    shallowest_m: float = 0.0,
    terrain: Terrain = FLAT,
) -> tuple[SensorArray, Readings]:
    """Return the rows with readings of all sensors, and the array.

    Sensors that miss too many rows are excluded. The ambient field varies like the modulus at a base station. No source
    is above `shallowest_m` on a flattened ground.
    """
    if readings.array_rotation is None:
        raise ValueError("Input readings must have the pose of the array in every row; instead received none.")
    check_magnitudes(array)
    readings = without_saturated(readings, array)
    stuck, wild, clipped, missing = unusable_readings(array, readings, shallowest_m, terrain)
    order = np.argsort(missing.sum(axis=0), kind="stable")
    worth = [(i + 1) * int((~missing[:, order[: i + 1]].any(axis=1)).sum()) for i in range(len(order))]
    kept = np.sort(order[: len(worth) - int(np.argmax(worth[::-1]))])
    whole = np.asarray(~missing[:, kept].any(axis=1))
    for i, sensor in enumerate(array.sensors):
        if i not in kept:
            why = "is stuck" if stuck[:, i].any() else "lacks readings"
            _LOG.warning(f"sensor {sensor.id} {why} in {missing[:, i].sum()} of {len(missing)} rows and is left out")
        elif stuck[:, i].any():
            _LOG.warning(
                f"sensor {sensor.id} is stuck in {stuck[:, i].sum()} of {len(missing)} rows, which are left out"
            )
    if (counts := wild[:, kept].sum(axis=0)).any():
        each = ", ".join(f"{n} of sensor {array.sensors[i].id}" for i, n in zip(kept, counts, strict=True) if n)
        _LOG.warning(f"spikes in the readings: {counts.sum()} in all, {each}; their rows are left out")
    for i, sensor in enumerate(array.sensors):
        if clipped[:, i].any():
            _LOG.warning(
                f"{clipped[:, i].sum()} readings of sensor {sensor.id} repeat its largest or smallest reading exactly,"
                " as if they were clipped; they are left out. State saturation_nT"
            )
    if whole.sum() < FEWEST_ROWS:
        raise ValueError(f"Input readings must have {FEWEST_ROWS} whole rows or more; instead received {whole.sum()}.")
    if len(kept) < array.n_sensors:
        readings = replace(readings, values_T=readings.values_T[:, np.isin(array.channel_sensor, kept)])
    readings = _some(readings, whole)
    check_order(readings)
    earlier = earlier_rows(readings)
    if (again := earlier >= 0).any():
        k = int(again.argmax())
        _LOG.warning(
            f"{again.sum()} rows repeat earlier ones with new times and are left out; the row at"
            f" {readings.time_s[k]:.10g} s is the same as at {readings.time_s[earlier[k]]:.10g} s"
        )
        readings = _some(readings, ~again)
    readings = _some(readings, ~leaping_rows(readings))
    readings = _some(readings, ~rows_without_attitude(array, readings))
    array = replace(array, sensors=tuple(array.sensors[i] for i in kept))
    array = with_stated_pose(array, readings)
    array = replace(array, pose=unstated_pose(array)) if array.pose is None else array
    ambient = _ambient_T(array, readings)
    readings = replace(readings, ambient_T=ambient if base is None else vary_with_base(ambient, readings.time_s, base))
    return with_measured_noise(array, readings), readings


def with_places_between_fixes(array: SensorArray, readings: Readings) -> tuple[SensorArray, Readings]:
    """Interpolate places between fixes; the array's pose errors last at least one interval."""
    if readings.array_position_m is None or readings.array_rotation is None:
        return array, readings
    found = between_fixes(readings.time_s, readings.array_position_m, readings.array_rotation)
    if found is None:
        return array, readings
    n = len(readings)
    _LOG.warning(
        f"places stand still in {found.held} of {n} rows: they are interpolated between fixes at"
        f" {found.rate_Hz:.3g} Hz" + (f", and the last {n - found.end} rows are left out" if found.end < n else "")
    )
    error_m = found.error_m if readings.interpolated_m is None else np.maximum(found.error_m, readings.interpolated_m)
    poses = {"array_position_m": found.position_m, "array_rotation": found.rotation, "interpolated_m": error_m}
    readings = replace(readings, **poses)[: found.end]  # type: ignore[arg-type]
    pose, interval_s = array.pose, 1.0 / found.rate_Hz
    if pose is not None and pose.correlation_s < interval_s:  # the error of a fix lasts until the next one
        array = replace(array, pose=replace(pose, correlation_s=interval_s))
    return array, readings


def _some(readings: Readings, which: BoolArray) -> Readings:
    return readings if which.all() else readings[which]


def unusable_readings(
    array: SensorArray, readings: Readings, shallowest_m: float, terrain: Terrain
) -> tuple[BoolArray, BoolArray, BoolArray, BoolArray]:
    """Return readings (n, N) that are stuck, spikes, clipped, and all unusable readings; they need a pose."""
    assert readings.array_position_m is not None
    assert readings.array_rotation is not None
    blocks = [readings.values_T[first : first + _BLOCK] for first in range(0, max(len(readings), 1), _BLOCK)]
    stuck = np.concatenate([stuck_readings(array, values) for values in blocks])
    moduli = np.concatenate([field_moduli(array, values) for values in blocks])
    moduli[stuck] = np.nan
    wild = np.zeros(moduli.shape, np.bool_)
    jitter_m = _jitter_m(array, readings)
    for i, arm_m in enumerate(array.positions.copy()):
        place_m = readings.array_position_m + readings.array_rotation.apply(arm_m)
        depth_m = max(float(np.quantile(terrain.flatten(place_m)[:, 2], _LOWEST)) - shallowest_m, _LEAST_DEPTH_M)
        noise_T = float(white_noise_T(array)[array.channel_sensor == i].max())
        wild[:, i] = wild_readings(moduli[:, i], place_m, depth_m, noise_T, jitter_m)
    left_out = np.asarray(np.isnan(moduli) | wild)
    clipped = clipped_readings(array, np.where(left_out[:, array.channel_sensor], np.nan, readings.values_T))
    return stuck, wild, clipped, left_out | clipped


def field_moduli(array: SensorArray, values: FloatArray) -> FloatArray:
    """Return the moduli of the field (n, N) that sensors read, independent of the attitude."""
    scalar = array.channel_is_scalar
    moduli = np.linalg.norm(array.calibrated_field(values), axis=2)
    moduli[:, array.channel_sensor[scalar]] = values[:, scalar]
    return np.asarray(moduli)


def _jitter_m(array: SensorArray, readings: Readings) -> float:
    """Return the error of the place from one row to the next [m]."""
    pose = with_stated_pose(array, readings).pose
    if pose is None:
        return _LEAST_JITTER_M
    stated = pose.position_m if readings.pose_sigma is None else float(np.median(readings.pose_sigma[:, 0]))
    if pose.correlation_s and len(readings) > 1:
        stated *= min(1.0, math.sqrt(2.0 * abs(float(np.median(np.diff(readings.time_s)))) / pose.correlation_s))
    return max(stated, _LEAST_JITTER_M)


def stuck_readings(array: SensorArray, values: FloatArray) -> BoolArray:
    """Return rows and sensors (n, N) in long runs of one reading while others change, or in the whole log.

    A sensor is also stuck if only its last digit changes.
    """
    n = len(values)
    lengths = np.empty((n, array.n_sensors))
    for i in range(array.n_sensors):
        own = values[:, array.channel_sensor == i]
        begins = np.concatenate([[True], (own[1:] != own[:-1]).any(axis=1)])  # NaN is no run
        run = np.cumsum(begins) - 1
        lengths[:, i] = np.bincount(run)[run]
    typical = [len(column) / np.sum(1.0 / column) for column in lengths.T]  # mean length of a run
    least = min(typical, default=math.inf)
    runs = lengths > _LONGEST_RUN * (1.0 if least >= n else least)  # a log of one reading shows no field
    return np.asarray(runs | _still_readings(array, values))


def clipped_readings(array: SensorArray, values: FloatArray) -> BoolArray:
    """Return readings (n, N) of sensors that repeat the largest or smallest value of a channel in runs.

    Beside a run of clipped readings the readings change by many steps of the last digit. At the peak of a rounded
    curve, and while a sensor is at rest, they change by one or two.
    """
    out = np.zeros((len(values), array.n_sensors), np.bool_)
    for owner, column in zip(array.channel_sensor, values.T, strict=True):
        known = np.flatnonzero(np.isfinite(column))
        read = column[known]
        steps = np.abs(np.diff(read))
        digit = np.min(steps, where=steps > _LEAST_DIGIT_T, initial=math.inf)
        for level in (read.max(initial=-math.inf), read.min(initial=math.inf)):
            edges = np.flatnonzero(np.diff(np.concatenate([[False], read == level, [False]])))
            begins, ends = edges.reshape(-1, 2).T
            long = ends - begins >= _CUT_RUN
            begins, ends = begins[long], ends[long]
            beside = np.concatenate([steps[begins[begins > 0] - 1], steps[ends[ends < len(read)] - 1]])
            number = int((ends - begins).sum())
            if len(begins) < _FEWEST_RUNS or not _FEWEST_CUT <= number < _MOST_CUT * len(read):
                continue
            step, away = float(np.median(beside)) / digit, np.rint(np.abs(read - level) / digit)
            is_pile = len(begins) >= _CUT_RUNS and number > _PILED * max(np.sum(away == k) for k in (1, 2, 3))
            if step > _CUT_STEP or (is_pile and step > _SMALL_STEP):
                out[known[read == level], owner] = True
    return out


def _still_readings(array: SensorArray, values: FloatArray) -> BoolArray:
    """Return rows and sensors (n, N) that change by two steps of the last digit at most.

    The noise of the sensor is larger, or another sensor changes much more.
    """
    out = np.zeros((len(values), array.n_sensors), np.bool_)
    known = [np.flatnonzero(np.isfinite(column)) for column in values.T]
    if len(values) < _STILL_ALONE or not all(map(len, known)):
        return out
    rows = np.arange(len(values))
    whole = np.stack([np.interp(rows, at, column[at]) for at, column in zip(known, values.T, strict=True)], axis=1)
    steps = np.abs(np.diff(whole, axis=0))
    digit = np.where(steps > _LEAST_DIGIT_T, steps, np.inf).min(axis=0)
    fourth = np.abs(np.diff(whole, 4, axis=0)) / math.sqrt(70.0)
    is_finer = np.median(fourth, axis=0) > _LAST_DIGITS * digit

    def span(size: int) -> FloatArray:
        return np.asarray(maximum_filter1d(whole, size, axis=0) - minimum_filter1d(whole, size, axis=0))

    brief, long = span(_STILL), span(_STILL_ALONE)
    for i in range(array.n_sensors):
        own = array.channel_sensor == i
        most = _LAST_DIGITS * digit[own] * (1.0 + 1e-6)
        others = (long[:, ~own] > _OTHERS * digit[own].max()).any(axis=1)
        is_still = (brief[:, own] <= most).all(axis=1) & is_finer[own].all()
        is_still_alone = (long[:, own] <= most).all(axis=1) & others
        out[:, i] = maximum_filter1d(is_still, _STILL - 1) | maximum_filter1d(is_still_alone, _STILL_ALONE - 1)
    return out


def without_ambient(rows: Readings, moduli_T: FloatArray) -> FloatArray:
    """Return moduli less that of the ambient field, where it is known for every row."""
    if rows.ambient_T is None:
        return moduli_T
    return np.asarray(moduli_T - np.linalg.norm(rows.ambient_T, axis=1)[:, None])


def variations_of_lines(array: SensorArray, rows: Readings) -> tuple[FloatArray, list[FlightLine]]:
    """Return the moduli (n, N) less that of the ambient field, and the lines of the rows."""
    place_m = rows.array_position_m
    assert place_m is not None
    variations_T = without_ambient(rows, field_moduli(array, rows.values_T))
    return variations_T, flight_lines(rows.time_s, place_m, place_m[:, 2], rows.lines)


def earlier_rows(readings: Readings) -> IntArray:
    """Return for each row (n,) the earlier row that it repeats within a moving block of twenty or more; -1 if none.

    Places and readings are equal to the last digit. A carrier at rest may repeat a row by chance.
    """
    assert readings.array_position_m is not None
    numbers = np.nan_to_num(np.column_stack([1e9 * readings.values_T, readings.array_position_m]))
    key = numbers @ np.sqrt(1.0 + np.arange(1.0, numbers.shape[1] + 1.0))
    _, first, of = np.unique(key, return_index=True, return_inverse=True)
    back = np.arange(len(key)) - first[of]
    run = np.cumsum(np.diff(back, prepend=-1) != 0) - 1
    way_m = np.linalg.norm(np.diff(readings.array_position_m, axis=0, prepend=np.nan), axis=1)
    way_m[np.diff(run, prepend=-1) != 0] = 0.0
    is_block = (np.bincount(run) >= FEWEST_ROWS) & (np.bincount(run, way_m) > 0.0)
    return np.where((back > 0) & is_block[run], first[of], -1)


def leaping_rows(readings: Readings) -> BoolArray:
    """Return the rows (n,) whose place is far from those before and after."""
    assert readings.array_position_m is not None
    way, time_s = np.linalg.norm(np.diff(readings.array_position_m, axis=0), axis=1), readings.time_s
    leaps = way > FASTEST_M_S * np.diff(time_s)
    wild = np.concatenate([[False], leaps[1:] & leaps[:-1], [False]])
    if wild.any():
        _LOG.warning(f"spikes in the positions: {wild.sum()}; their rows are left out")
    left = np.flatnonzero(leaps & ~wild[1:] & ~wild[:-1])
    if left.size:
        k = int(left[0])
        raise ValueError(
            f"Input readings must have all poses in one frame; instead received rows at {time_s[k]:.15g} and"
            f" {time_s[k + 1]:.15g} s that are {way[k]:.4g} m apart."
        )
    return np.asarray(wild)


def rows_without_attitude(array: SensorArray, readings: Readings) -> BoolArray:
    """Return the rows (n,) of turns, if the attitude is the course and sensors are apart on the map.

    In a turn the course over some metres is not the attitude.
    """
    none = np.zeros(len(readings), np.bool_)
    if array.columns is None or not array.columns.course or np.ptp(array.positions[:, :2], axis=0).max() < APART_M:
        return none
    assert readings.array_position_m is not None
    turning = rows_of_turns(readings.array_position_m[:, :2])
    if not none.size - turning.sum() >= FEWEST_ROWS:
        return none
    if turning.any():
        _LOG.warning(f"{turning.sum()} rows of turns are left out, because the course is not the attitude there")
    return turning


def record_of(
    array: SensorArray,
    readings: Readings,
    terrain: Terrain = FLAT,
) -> tuple[SurveyRecord, PoseErrors]:
    """Return the anomalies of whole rows in the world frame, and their pose errors."""
    assert array.pose is not None
    errors = PoseErrors.of(array.pose, between_s=interval_of_fixes(readings.time_s, readings.interpolated_m))
    assert readings.ambient_T is not None
    return SurveyRecord.of(array, readings, readings.ambient_T, errors, terrain), errors


def vary_with_base(ambient_T: FloatArray, time_s: FloatArray, base: Readings) -> FloatArray:
    """Return the ambient field (n, 3) with the variation of its modulus at a base station.

    The variation is relative to the median of the base's readings during the survey.
    """
    if base.values_T.shape[1] != 1:
        raise ValueError(f"Input base must have one channel; instead received {base.values_T.shape[1]}.")
    read = _usable_base(base)
    if not len(read) or time_s[0] < read.time_s.min() or time_s[-1] > read.time_s.max():
        ends = f"{read.time_s.min():.15g} to {read.time_s.max():.15g} s" if len(read) else "nothing"
        raise ValueError(
            f"Input base must cover the survey from {time_s[0]:.15g} to {time_s[-1]:.15g} s; instead received {ends}."
        )
    _warn_of_gap(time_s, read)
    there, modulus = vectors_at(time_s, read.time_s, read.values_T), np.linalg.norm(ambient_T, axis=1, keepdims=True)
    middle, usual = float(np.median(there)), float(np.median(modulus))  # stations read before and after the survey
    if not usual / _MOST_APART < middle < usual * _MOST_APART:
        raise ValueError(
            f"Input base must read the modulus of the Earth's field, about {1e9 * usual:.0f} nT; instead received"
            f" {1e9 * middle:.4g} nT in the median."
        )
    return np.asarray(ambient_T * (1.0 + (there - middle) / modulus))


def _usable_base(base: Readings) -> Readings:
    """Return a base station's readings without outliers; log these and long gaps."""
    base = base[np.argsort(base.time_s, kind="stable")]
    read = base[np.isfinite(base.values_T[:, 0])]
    step_s = float(np.median(np.abs(np.diff(read.time_s)))) if len(read) > 1 else 1.0
    place_m = np.zeros((len(read), 3))
    place_m[:, 0] = read.time_s * (_BASE_STEP / step_s)
    wild = wild_readings(read.values_T[:, 0], place_m, 1.0, _BASE_NOISE_T, 0.0)
    if wild.any():
        _LOG.warning(f"spikes in the readings of the base station: {wild.sum()}; they are left out")
    return _some(read, ~wild)


def _warn_of_gap(time_s: FloatArray, read: Readings) -> None:
    """Log the longest gap of a base station during a survey."""
    gaps = np.diff(read.time_s)
    gaps[(read.time_s[1:] < time_s[0]) | (read.time_s[:-1] > time_s[-1])] = 0.0
    k = int(gaps.argmax()) if len(gaps) else 0
    if len(gaps) and gaps[k] > max(_LONG_GAP * float(np.median(np.diff(read.time_s))), _LONG_GAP_S):
        _LOG.warning(
            f"the base station reads nothing from {read.time_s[k]:.15g} to {read.time_s[k + 1]:.15g} s: its field is"
            " interpolated there"
        )


def _ambient_T(array: SensorArray, readings: Readings) -> FloatArray:
    """Return the ambient field of every row (n, 3) in the array's frame.

    For vector sensors it is their median reading.
    """
    if readings.ambient_T is not None:
        if not (np.linalg.norm(readings.ambient_T, axis=1) > 0.0).all():
            raise ValueError(
                "Input readings must have an ambient field in every row; instead received zero or nothing."
            )
        return readings.ambient_T
    if array.ambient_T is not None:
        return np.tile(array.ambient_T, (len(readings), 1))
    if array.channel_is_scalar.all():
        raise ValueError("Input readings must have the ambient field for scalar sensors; instead received none.")
    assert readings.array_rotation is not None
    vector = np.array([sensor.kind == "vector" for sensor in array.sensors])
    fields = array.calibrated_field(readings.values_T)[:, vector]
    world = np.median(readings.array_rotation.apply(fields.mean(axis=1)), axis=0)
    return np.asarray(readings.array_rotation.inv().apply(world))
