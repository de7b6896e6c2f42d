"""What of a record cannot be so: a unit, a clock or an attitude other than the one that its columns stand for.

Every doubt is a sentence. None is a refusal: the numbers could be true, of a laboratory that is not imagined here.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.ambient import in_world_field
from magloc.readings import Readings, as_readings, without_saturated

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_LOG = logging.getLogger(__name__)
_FEWEST_ROWS = 20
_QUIETER = 0.01  # of the noise that is stated; microtesla taken for nanotesla are 0.001
_OTHER_UNIT = 5.0  # ratio of moduli to the ambient field's: a source beside the sensors is not so strong for long
_STEADY = 0.02  # relative change of the modulus of a field that is the Earth's
_TURNS_RAD = 0.06  # three times what an attitude of 1° and a source's share of the field do
_SLOWEST_M_S, _FASTEST_M_S, _FAR_M = 0.01, 500.0, 2.0


def usable_readings(array: SensorArray, values: Readings | ArrayLike) -> Readings:
    """Readings without those that saturate, in their ambient field; warns of what is hardly as stated."""
    readings = as_readings(values)
    warn_of_doubts(array, readings)
    return in_world_field(without_saturated(readings, array), array)


def warn_of_doubts(array: SensorArray, readings: Readings) -> None:
    """Warn of what in readings is hardly as stated."""
    for doubt in doubts(array, readings):
        _LOG.warning(doubt)


def doubts(array: SensorArray, readings: Readings) -> Iterator[str]:
    """Sentences on readings that are hardly as stated; none for fewer than twenty rows."""
    if len(readings) < _FEWEST_ROWS:
        return
    used = in_world_field(without_saturated(readings, array), array)
    read = np.isfinite(readings.values_T)
    saturated = 1.0 - np.isfinite(used.values_T).sum() / max(int(read.sum()), 1)
    if read.any() and saturated > 0.5:
        yield f"{saturated:.0%} of the readings reach saturation_nT: are they in nT?"
    noise = noise_ratio(array, used.values_T)
    if noise < _QUIETER:
        yield (
            f"the readings change from row to row by {noise:.1g} of the noise that is stated: are they in nT, and is"
            " noise_nT right?"
        )
    ambient_T = array.ambient_fields if used.ambient_T is None else used.ambient_T
    moduli, ambient = _median(used.values_T[:, array.channel_is_scalar]), _median(np.linalg.norm(ambient_T, axis=-1))
    if ambient > 0.0 and (moduli < ambient / _OTHER_UNIT or moduli > ambient * _OTHER_UNIT):
        yield (
            f"scalar sensors read {1e9 * moduli:.4g} nT in the median where the ambient field is"
            f" {1e9 * ambient:.4g} nT: are both in nT?"
        )
    if used.pose is not None:
        yield from _of_path(used.time_s, used.pose[0])
        yield from _of_attitude(_shared_field(array, used), used.pose[1])


def noise_ratio(array: SensorArray, values_T: FloatArray) -> float:
    """Noise that rows (n, C) show over that which is stated, 1 where it is right; NaN where nothing changes.

    From differences of third order in time, in which little is left of fields that last, of what sensors read beyond
    each other. A sensor alone of its kind tells it by its modulus, which no attitude changes.
    """
    fields, noise = array.calibrated_field(values_T), np.array([sensor.noise_T for sensor in array.sensors])
    owner, scalar = array.channel_sensor, array.channel_is_scalar
    ratios = []
    for kind, of_kind in (("vector", fields), ("scalar", values_T[:, scalar, None])):
        sigma = noise[[sensor.kind == kind for sensor in array.sensors]]
        own = of_kind[:, np.unique(owner[~scalar])] if kind == "vector" else of_kind
        if own.shape[1] == 1:
            own = np.linalg.norm(own, axis=2, keepdims=True)
        elif own.shape[1]:
            own = own - own.mean(axis=1, keepdims=True)
        ratios.append(np.abs(np.diff(own, n=3, axis=0) / sigma[:, None]).ravel())
    size = np.concatenate(ratios)
    size = size[np.isfinite(size)]
    if not size.size or np.median(size) == 0.0:
        return float("nan")
    return float(np.median(size) / (0.6745 * np.sqrt(20.0)))  # of Gaussian noise: 1² + 3² + 3² + 1²


def _shared_field(array: SensorArray, readings: Readings) -> FloatArray:
    """What vector sensors read on average, else the ambient field of the rows: (n, 3), in the array's frame."""
    vector = np.unique(array.channel_sensor[~array.channel_is_scalar])
    if vector.size:
        return np.asarray(array.calibrated_field(readings.values_T)[:, vector].mean(axis=1))
    return np.empty((0, 3)) if readings.ambient_T is None else readings.ambient_T


def _of_path(time_s: FloatArray, position_m: FloatArray) -> Iterator[str]:
    steps = np.diff(time_s)
    if not (steps > 0.0).all() or np.ptp(position_m, axis=0).max() < _FAR_M:
        return
    speed = float(np.quantile(np.linalg.norm(np.diff(position_m, axis=0), axis=1) / steps, 0.9))
    if not _SLOWEST_M_S <= speed <= _FASTEST_M_S:
        yield f"the array moves at {speed:.2g} m/s by its poses: are times in s, and places in m?"


def _of_attitude(field_T: FloatArray, rotation: Rotation) -> Iterator[str]:
    """Whether a field of steady modulus, which is the Earth's, stands still in the world."""
    from scipy.spatial.transform import Rotation

    whole = np.flatnonzero(np.isfinite(field_T).all(axis=1))
    if len(whole) < _FEWEST_ROWS:
        return
    field_T, rotation = field_T[whole], rotation[whole]
    size = np.linalg.norm(field_T, axis=1)
    middle = float(np.median(size))
    if not middle > 0.0 or float(np.median(np.abs(size - middle))) > _STEADY * middle:
        return
    unit = field_T / size[:, None]

    def turns(of: Rotation) -> float:
        world = of.apply(unit)
        mean = world.mean(axis=0)
        return float(np.median(np.arccos(np.clip(world @ (mean / np.linalg.norm(mean)), -1.0, 1.0))))

    stated = turns(rotation)
    if stated < _TURNS_RAD:
        return
    x, y, z, w = rotation.as_quat().T
    first = rotation[0]
    others = {
        "if the quaternions are taken from the world's frame to the array's": rotation.inv(),
        "if their first column is the scalar": Rotation.from_quat(np.stack([y, z, w, x], axis=1)),
        "if turns are taken in radians": Rotation.from_rotvec(np.rad2deg((rotation * first.inv()).as_rotvec())) * first,
    }
    left = {words: turns(of) for words, of in others.items()}
    best = min(left, key=lambda words: left[words])
    cure = f"; {best} it turns by {np.degrees(left[best]):.1f}°" if left[best] < stated / 3.0 else ""
    yield (
        f"the ambient field, of steady modulus, turns in the world by {np.degrees(stated):.0f}° in the median as the"
        f" array turns: the attitude is not that from the array's frame to the world's{cure}"
    )


def _median(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")
