"""What a survey takes of readings: whole rows of sensors that tell something, as anomalies in the world frame."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import numpy as np
from scipy.interpolate import Akima1DInterpolator
from scipy.ndimage import maximum_filter1d, median_filter

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.measurement.pose import PoseErrors, with_stated_pose
from magloc.measurement.rows import check_magnitudes
from magloc.navigation.fixes import between_fixes, interval_of_fixes
from magloc.navigation.poses import vectors_at
from magloc.readings import Readings, without_saturated
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.pose_components import UNSTATED

_LOG = logging.getLogger(__name__)
FEWEST_ROWS = 20
_WILD, _NEIGHBOURS = 15.0, 20  # over the medians of all rows and of so many on either side
_MOST_APART = 2.0  # ratio of the fields at two places a day trip apart: more is another unit
_MOST_WILD = 0.25  # of all readings: more are not
_FASTEST_M_S = 300.0
_BLOCK = 2**18  # rows that are looked at together
_LONGEST_RUN = 25  # of the same reading, over what the liveliest sensor repeats


def whole_rows(array: SensorArray, readings: Readings, base: Readings | None = None) -> tuple[SensorArray, Readings]:
    """Rows where all sensors read, without the sensors that would cost more rows than they are worth.

    Their ambient field varies as the modulus at a base station.
    """
    if readings.array_rotation is None:
        raise ValueError("Input readings must have the pose of the array in every row; instead received none.")
    check_magnitudes(array)
    readings = without_saturated(readings, array)
    blocks = (readings.values_T[first : first + _BLOCK] for first in range(0, max(len(readings), 1), _BLOCK))
    stuck, wild, missing = map(np.concatenate, zip(*(_unusable(array, values) for values in blocks), strict=True))
    order = np.argsort(missing.sum(axis=0), kind="stable")
    worth = [(i + 1) * int((~missing[:, order[: i + 1]].any(axis=1)).sum()) for i in range(len(order))]
    kept = np.sort(order[: len(worth) - int(np.argmax(worth[::-1]))])
    whole = np.asarray(~missing[:, kept].any(axis=1))
    for i, sensor in enumerate(array.sensors):
        if i not in kept:
            why = "sticks" if stuck[:, i].any() else "lacks readings"
            _LOG.warning(f"sensor {sensor.id} {why} in {missing[:, i].sum()} of {len(missing)} rows and is left out")
        elif stuck[:, i].any():
            _LOG.warning(f"sensor {sensor.id} sticks in {stuck[:, i].sum()} of {len(missing)} rows, which are left out")
    if wild[:, kept].any():
        _LOG.warning(f"{wild[:, kept].sum()} readings leap and come back: their rows are left out")
    if whole.sum() < FEWEST_ROWS:
        raise ValueError(f"Input readings must have {FEWEST_ROWS} whole rows or more; instead received {whole.sum()}.")
    if len(kept) < array.n_sensors:
        readings = replace(readings, values_T=readings.values_T[:, np.isin(array.channel_sensor, kept)])
    readings = _some(readings, whole)
    if not (np.diff(readings.time_s) > 0.0).all():
        raise ValueError("Input readings must be in order of time; instead received others.")
    readings = _some(readings, ~leaping_rows(readings))
    array = replace(array, sensors=tuple(array.sensors[i] for i in kept))
    array = with_stated_pose(array, readings)
    array = replace(array, pose=UNSTATED) if array.pose is None else array
    ambient = _ambient_T(array, readings)
    return array, replace(readings, ambient_T=ambient if base is None else varying(ambient, readings.time_s, base))


def with_places_between_fixes(array: SensorArray, readings: Readings) -> tuple[SensorArray, Readings]:
    """Return readings whose places move between fixes, and the array whose errors last as long as these."""
    if readings.array_position_m is None or readings.array_rotation is None:
        return array, readings
    found = between_fixes(readings.time_s, readings.array_position_m, readings.array_rotation)
    if found is None:
        return array, readings
    n = len(readings)
    _LOG.warning(
        f"places stand still in {found.held} of {n} rows, between fixes that come {found.rate_Hz:.3g} times a second:"
        " interpolated between fixes" + (f", and the last {n - found.end} rows left out" if found.end < n else "")
    )
    poses = {"array_position_m": found.position_m, "array_rotation": found.rotation, "interpolated_m": found.error_m}
    readings = replace(readings, **poses)[: found.end]  # type: ignore[arg-type]
    pose, interval_s = array.pose, 1.0 / found.rate_Hz
    if pose is not None and pose.correlation_s < interval_s:  # a fix errs as long as it counts
        array = replace(array, pose=replace(pose, correlation_s=interval_s))
    return array, readings


def _some(readings: Readings, which: BoolArray) -> Readings:
    return readings if which.all() else readings[which]


def _unusable(array: SensorArray, values: FloatArray) -> tuple[BoolArray, BoolArray, BoolArray]:
    """Readings (n, N) that stick, those that leap, and all that tell nothing."""
    scalar = array.channel_is_scalar
    stuck = stuck_readings(array, values)
    moduli = np.linalg.norm(array.calibrated_field(values), axis=2)  # which no attitude changes
    moduli[:, array.channel_sensor[scalar]] = values[:, scalar]
    wild = wild_readings(moduli) & ~stuck
    return stuck, wild, np.asarray(np.isnan(moduli) | wild | stuck)


def stuck_readings(array: SensorArray, values: FloatArray) -> BoolArray:
    """Rows and sensors (n, N) of long runs of the same reading, while what other sensors read changes."""
    n = len(values)
    lengths = np.empty((n, array.n_sensors))
    for i in range(array.n_sensors):
        own = values[:, array.channel_sensor == i]
        begins = np.concatenate([[True], (own[1:] != own[:-1]).any(axis=1)])  # NaN is no run
        run = np.cumsum(begins) - 1
        lengths[:, i] = np.bincount(run)[run]
    typical = [len(column) / np.sum(1.0 / column) for column in lengths.T]  # mean length of a run
    return np.asarray(lengths > max(_LONGEST_RUN, _LONGEST_RUN * min(typical, default=math.inf)))


def wild_readings(values: FloatArray) -> BoolArray:
    """Single readings (n, N) that are far from the cubic through their neighbours, over what is usual there."""
    wild = np.isnan(values)
    if len(values) <= 2 * _NEIGHBOURS or (~wild).sum(axis=0).min() < 2:
        return np.zeros(values.shape, np.bool_)
    index = np.arange(len(values))
    kept = values.copy()
    while True:
        for channel, lost in zip(kept.T, wild.T, strict=True):
            if lost.any():  # by lines, a field that bends would have a kink at each
                good = index[~lost]
                channel[lost] = Akima1DInterpolator(good, channel[good])(np.clip(index[lost], good[0], good[-1]))
        size = np.zeros(values.shape)
        size[2:-2] = np.abs(kept[2:-2] - (4.0 * (kept[1:-3] + kept[3:-1]) - kept[:-4] - kept[4:]) / 6.0)
        usual = median_filter(size, (2 * _NEIGHBOURS + 1, 1)) + np.median(size, axis=0)
        more = (size == maximum_filter1d(size, 5, axis=0)) & (size > _WILD * usual) & ~wild
        if not more.any() or (wild | more).mean() > _MOST_WILD:
            return np.asarray(wild & ~np.isnan(values))
        wild |= more


def leaping_rows(readings: Readings) -> BoolArray:
    """Rows (n,) whose place is far from that of the row before and of the one after."""
    assert readings.array_position_m is not None
    way, time_s = np.linalg.norm(np.diff(readings.array_position_m, axis=0), axis=1), readings.time_s
    leaps = way > _FASTEST_M_S * np.diff(time_s)
    wild = np.concatenate([[False], leaps[1:] & leaps[:-1], [False]])
    if wild.any():
        _LOG.warning(f"{wild.sum()} places leap and come back: their rows are left out")
    left = np.flatnonzero(leaps & ~wild[1:] & ~wild[:-1])
    if left.size:
        k = int(left[0])
        raise ValueError(
            f"Input readings must have all poses in one frame; instead received rows at {time_s[k]:.15g} and"
            f" {time_s[k + 1]:.15g} s that are {way[k]:.4g} m apart."
        )
    return np.asarray(wild)


def record_of(array: SensorArray, readings: Readings) -> tuple[SurveyRecord, PoseErrors]:
    """Anomalies of whole rows in the world frame, offsets of the sensors with them, and the errors of their pose."""
    assert array.pose is not None
    errors = PoseErrors.of(array.pose, between_s=interval_of_fixes(readings.time_s, readings.interpolated_m))
    assert readings.ambient_T is not None
    return SurveyRecord.of(array, readings, readings.ambient_T, errors), errors


def varying(ambient_T: FloatArray, time_s: FloatArray, base: Readings) -> FloatArray:
    """Ambient field (n, 3) whose modulus changes as that at a base station about its median over them."""
    if base.values_T.shape[1] != 1:
        raise ValueError(f"Input base must have one channel; instead received {base.values_T.shape[1]}.")
    read = base[np.isfinite(base.values_T[:, 0])]
    if not len(read) or time_s[0] < read.time_s.min() or time_s[-1] > read.time_s.max():
        ends = f"{read.time_s.min():.15g} to {read.time_s.max():.15g} s" if len(read) else "nothing"
        raise ValueError(
            f"Input base must read from {time_s[0]:.15g} to {time_s[-1]:.15g} s, as the survey does; instead received"
            f" {ends}."
        )
    there, modulus = vectors_at(time_s, read.time_s, read.values_T), np.linalg.norm(ambient_T, axis=1, keepdims=True)
    middle, usual = float(np.median(there)), float(np.median(modulus))  # stations read before and after the survey
    if not usual / _MOST_APART < middle < usual * _MOST_APART:
        raise ValueError(
            f"Input base must read the modulus of the Earth's field, about {1e9 * usual:.0f} nT; instead received"
            f" {1e9 * middle:.4g} nT in the median."
        )
    return np.asarray(ambient_T * (1.0 + (there - middle) / modulus))


def _ambient_T(array: SensorArray, readings: Readings) -> FloatArray:
    """Ambient field of every row (n, 3) in the array's frame; of vector sensors it is what they read on average."""
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
