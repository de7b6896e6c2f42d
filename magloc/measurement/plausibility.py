"""Plausibility of a record: units, clocks and attitudes that contradict the readings.

Every doubt is a warning, and none is an error, because unusual numbers may still be right.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.world_maps import FARTHEST_M
from arrays.typing import FloatArray
from magloc.ambient import in_world_field
from magloc.levels import SIGMA_OF_MAD
from magloc.measurement.rows import ambient_fields
from magloc.readings import Readings, as_readings, without_saturated

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_LOG = logging.getLogger(__name__)
EARTH_T = (15e-6, 80e-6)
"""Smallest and largest modulus of the Earth's field, with a margin for a platform."""
FEWEST_ROWS = 20
"""Least number of rows for a check of a record."""
_OF_A_NANOTESLA = {"µT": 1e-3, "G": 1e-5, "T": 1e-9}
_LIKE = 3.0  # largest factor between the measured noise and the stated noise in another unit
_WHITE = 5.0  # growth from lag 1 to lag 2: 1 for white noise, 8 after a filter of second order, 2**6 for smooth fields
_OTHER_UNIT = 5.0  # ratio of moduli to the ambient field; a source near the sensors is not so strong for long
_ALTERNATES = 0.15  # sum of successive differences relative to each, in a reading with two levels
_OF_STEP = 0.6745 * math.sqrt(924.0) / 2.0**5  # step between two levels, relative to robust σ of sixth differences
_STEADY = 0.02  # largest relative change of the modulus of the Earth's field
_TURNS_RAD = 0.06  # three times the effect of attitude errors of 1° and of a source
_TURNS_UNEXPLAINED_RAD = 0.3  # offsets of 10 µT in 50 µT cause 0.2
_SLOWEST_M_S, _FASTEST_M_S, _FAR_M = 0.01, 500.0, 2.0
_ORBIT_M_S = (3e3, 11e3)  # geostationary to escape
_AMBIENT_SIGMAS = 4.0
_MODEL_SIGMA_T = 150e-9  # default error of a geomagnetic model: crust and storms
_ALIKE = 0.2  # largest relative spread of a difference over rows and sensors; that by a source varies more
_FEWEST_COMPARED, _MOST_COMPARED = 16, 10_000  # readings, rows
_WIDEST_M, _COARSE_T = 3.0, 50e-9  # widest array of coarse sensors, and their noise; finer sensors may be farther apart
_NARROWEST_M = 1e-3
_WIDEST_ON_THE_MOVE_M = 30.0
_MAGNET_A_m, _MAGNET_M = 1.1e6, 0.05  # magnetisation of the strongest magnets, and the radius of a large one
_IRON_A_m = 125.0  # magnetisation of vehicles and ships, over a sphere that reaches the sensors
_MOMENTS_Am2 = (1e-9, 1e7)  # a grain of magnetite, the largest ships


def usable_readings(array: SensorArray, values: Readings | ArrayLike) -> Readings:
    """Return readings without saturated values and with their ambient field; warn of implausible input."""
    readings = as_readings(values)
    used = _drop_saturated(array, readings)
    _warn(doubts(array, readings, used))
    return used


def warn_of_doubts(array: SensorArray, readings: Readings) -> None:
    """Warn of implausible readings."""
    _warn(doubts(array, readings))


def warn_of_array(array: SensorArray, readings: Readings | None = None) -> None:
    """Warn of an array whose size is implausible in metres."""
    _warn(array_doubts(array, readings))


def warn_of_record(array: SensorArray, readings: Readings) -> None:
    """Warn of implausible readings, without checks of the array."""
    _warn(record_doubts(array, readings))


def warn_of_moments(distance_m: ArrayLike, moment_Am2: ArrayLike) -> None:
    """Warn of moments (n, 3) that are implausible at distances (n,) from the sensors.

    NaN are ignored.
    """
    _warn(moment_doubts(distance_m, moment_Am2))


def _warn(sentences: Iterator[str]) -> None:
    for doubt in sentences:
        _LOG.warning(doubt)


def _drop_saturated(array: SensorArray, readings: Readings) -> Readings:
    return in_world_field(without_saturated(readings, array), array)


def doubts(array: SensorArray, readings: Readings, used: Readings | None = None) -> Iterator[str]:
    """Yield sentences on an array and readings that are implausible.

    `used` are the readings without saturated values and with their ambient field, if known already.
    """
    yield from array_doubts(array, readings)
    yield from record_doubts(array, readings, used)


def record_doubts(array: SensorArray, readings: Readings, used: Readings | None = None) -> Iterator[str]:
    """Yield sentences on readings alone; units and clocks need twenty rows or more."""
    yield from _origin_doubts(readings)
    used = _drop_saturated(array, readings) if used is None else used
    if len(readings) < FEWEST_ROWS:
        yield from _ambient_doubts(array, used)
        return
    read = np.isfinite(readings.values_T)
    saturated = 1.0 - np.isfinite(used.values_T).sum() / max(int(read.sum()), 1)
    if read.any() and saturated > 0.5:
        yield f"{saturated:.0%} of the readings reach saturation_nT: are they in nT?"
    noise = noise_ratio(array, used.values_T)
    for unit, nanotesla in _OF_A_NANOTESLA.items():
        if nanotesla / _LIKE < noise < nanotesla * _LIKE:
            yield (
                f"the readings change from row to row by {noise:.1g} times the stated noise, as they would in {unit}:"
                " are they in nT, is noise_nT right, were they filtered?"
            )
    yield from _alternation_doubts(array, used.values_T)
    ambient_T = array.ambient_fields if used.ambient_T is None else used.ambient_T
    of_unit = list(_moduli_doubts(array, used.values_T, finite_median(np.linalg.norm(ambient_T, axis=-1))))
    yield from of_unit or _ambient_doubts(array, used)
    if used.pose is not None:
        yield from _path_doubts(used.time_s, used.pose[0])
        yield from _attitude_doubts(array, used, used.pose[1])


def array_doubts(array: SensorArray, readings: Readings | None = None) -> Iterator[str]:
    """Yield a sentence on an array of implausible size, given its noise and motion."""
    if array.n_sensors < 2:
        return
    place_m = None if readings is None else readings.array_position_m
    moves = place_m is not None and bool((np.abs(place_m - place_m[:1]) > 0.0).any())
    across_m, noise_T = 2.0 * array.circumradius, float(np.median(array.channel_noise_T))
    widest_m = _WIDEST_M * max(1.0, _COARSE_T / noise_T) ** (2.0 / 3.0)
    if _NARROWEST_M <= across_m <= (min(widest_m, _WIDEST_ON_THE_MOVE_M) if moves else widest_m):
        return
    moving = "a moving array" if moves else f"an array with a noise of {1e9 * noise_T:.3g} nT"
    yield (
        f"the sensors span {across_m:.3g} m, which is not plausible for {moving}: are their positions in metres? If"
        f" they are in mm the array spans {across_m / 1e3:.3g} m, in cm {across_m / 1e2:.3g} m, in inches"
        f" {0.0254 * across_m:.3g} m"
    )


def moment_doubts(distance_m: ArrayLike, moment_Am2: ArrayLike) -> Iterator[str]:
    """Yield a sentence on moments (n, 3) that are implausible at distances (n,).

    Distances are from the sensors; NaN are ignored.
    """
    distance, strength = np.asarray(distance_m, np.float64), np.linalg.norm(moment_Am2, axis=-1)
    known = np.isfinite(distance) & np.isfinite(strength)
    if not known.any():
        return
    distance, strength = distance[known], strength[known]
    of_sphere = 4.0 / 3.0 * np.pi * np.array([_MAGNET_A_m, _IRON_A_m])
    largest = of_sphere[0] * np.minimum(distance, _MAGNET_M) ** 3 + of_sphere[1] * distance**3
    if np.median(strength / np.minimum(largest, _MOMENTS_Am2[1])) < 1.0 and np.median(strength) > _MOMENTS_Am2[0]:
        return
    yield (
        f"the moment is {np.median(strength):.2g} A·m² at {np.median(distance):.2g} m in the median, which is not"
        " plausible for any object: are the positions of the sensors in metres, and the readings in nT? Lengths in mm"
        " make a moment 10⁹ times as large, in cm 10⁶ times, in inches 6·10⁴ times"
    )


def _origin_doubts(readings: Readings) -> Iterator[str]:
    farthest_m = farthest_place(readings)
    if farthest_m > FARTHEST_M:
        yield (
            f"places lie up to {farthest_m / 1e3:.4g} km from the origin of their frame: if they are eastings and"
            " northings of a grid, subtract those of a place nearby, because large numbers lose digits"
        )


def farthest_place(readings: Readings) -> float:
    """Return the largest distance [m] of the array from the world's origin; 0 without a pose."""
    if readings.array_position_m is None:
        return 0.0
    far_m = np.linalg.norm(readings.array_position_m, axis=1)
    return float(far_m[np.isfinite(far_m)].max(initial=0.0))


def noise_ratio(array: SensorArray, values_T: FloatArray) -> float:
    """Return the ratio of the white noise of rows (n, C) to the stated noise; NaN if it cannot be measured.

    The noise follows from differences of sixth order in time, which remove slow fields. White noise is equally large in
    differences of every other row. Filtered noise, and a source too fast for the rows, are several times larger there.
    """
    own = _beyond_each_other(array, values_T)
    # The median of Gaussian errors is 0.6745 of their σ.
    ratio, of_every_other = (finite_median(np.abs(_sixth_difference(own, lag))) / 0.6745 for lag in (1, 2))
    return ratio if 0.0 < of_every_other < _WHITE * ratio else float("nan")


def _beyond_each_other(array: SensorArray, values_T: FloatArray) -> FloatArray:
    """Return readings minus the mean of their kind of sensor, divided by the stated noise (n, ...).

    For a single sensor of its kind the result is its modulus, which does not depend on the attitude.
    """
    fields, noise = array.calibrated_field(values_T), np.array([sensor.noise_T for sensor in array.sensors])
    owner, scalar = array.channel_sensor, array.channel_is_scalar
    own = []
    for kind, of_kind in (("vector", fields[:, np.unique(owner[~scalar])]), ("scalar", values_T[:, scalar, None])):
        sigma = noise[[sensor.kind == kind for sensor in array.sensors], None]
        alone = len(sigma) == 1
        beyond = np.linalg.norm(of_kind, axis=2, keepdims=True) if alone else of_kind
        if len(sigma) > 1:
            beyond = beyond - beyond.mean(axis=1, keepdims=True)
        own.append((beyond / sigma).reshape(len(values_T), -1))
    return np.concatenate(own, axis=1)


def _sixth_difference(values: FloatArray, lag: int) -> FloatArray:
    """Return sixth differences of rows `lag` apart, scaled to keep the variance of white noise."""
    for _ in range(6):
        values = values[lag:] - values[:-lag]
    return values / np.sqrt(924.0)  # 1² + 6² + 15² + 20² + 15² + 6² + 1²


def alternates(differences: FloatArray) -> bool:
    """Return whether high differences (n,) of readings only change their sign from row to row.

    The sum of successive differences of white noise is half as large as the differences themselves.
    """
    return robust_sigma(differences[1:] + differences[:-1]) < _ALTERNATES * robust_sigma(differences)


def _alternation_doubts(array: SensorArray, values_T: FloatArray) -> Iterator[str]:
    """Yield a sentence if readings alternate between two levels."""
    differences = _sixth_difference(values_T, 1)
    for name, noise_T, own in zip(array.channel_names, array.channel_noise_T, differences.T, strict=True):
        if alternates(own) and robust_sigma(own) > _OTHER_UNIT * noise_T:
            # An alternating reading of ± 1 has a sixth difference of 2⁶, which √924 divides.
            yield (
                f"the readings of {name} alternate from row to row by {1e9 * robust_sigma(own) * _OF_STEP:.3g} nT: are"
                " two instruments in one column, or is it mains hum at half the rate of the rows?"
            )


def _moduli_doubts(array: SensorArray, values_T: FloatArray, ambient_T: float) -> Iterator[str]:
    """Yield a sentence if scalar sensors do not read about the ambient field.

    Values of both signs are residuals after the field was subtracted.
    """
    moduli_T = values_T[:, array.channel_is_scalar]
    each_T = np.array([finite_median(column) for column in moduli_T.T])
    unlike = (each_T < ambient_T / _OTHER_UNIT) | (each_T > ambient_T * _OTHER_UNIT)
    if ambient_T > 0.0 and unlike.any() and not (moduli_T < 0.0).any():
        read = finite_median(each_T[unlike])
        ids = (array.ids[i] for i in array.channel_sensor[array.channel_is_scalar][unlike])
        which = "scalar sensors read" if unlike.all() else f"of the scalar sensors, {', '.join(ids)} read"
        yield (
            f"{which} {1e9 * read:.4g} nT in the median where the ambient field is {1e9 * ambient_T:.4g}"
            " nT: are both in nT, or was it subtracted from the readings?"
        )


def _ambient_doubts(array: SensorArray, used: Readings) -> Iterator[str]:
    """Yield a sentence if moduli disagree with the stated ambient field.

    Only rows without a source nearby count. An error of the ambient field is the same in most rows and for all sensors,
    unlike the field of a source.
    """
    if used.ambient_T is None and array.ambient_T is None:
        return
    used = used[:: -(-len(used) // _MOST_COMPARED)]
    scalar = np.array([sensor.kind == "scalar" for sensor in array.sensors])
    moduli = np.linalg.norm(array.calibrated_field(used.values_T), axis=2)
    moduli[:, scalar] = used.values_T[:, array.channel_is_scalar] - array.channel_offset_T[array.channel_is_scalar]
    if scalar.any():
        moduli = np.where(scalar, moduli, np.nan)
    stated = np.linalg.norm(ambient_fields(array, len(used), used.ambient_T), axis=2)
    of_sensors = [_shortest_half(d[np.isfinite(d)]) for d in (moduli - stated).T if np.isfinite(d).any()]
    modulus_T = finite_median(stated)
    was_taken_off = not finite_median(moduli) > modulus_T / _OTHER_UNIT or bool((moduli < 0.0).any())
    if was_taken_off or np.isfinite(moduli).sum() < _FEWEST_COMPARED:
        return
    levels, widths = np.array(of_sensors).T
    off_T = float(np.median(levels))
    spread_T = max(np.median(widths), np.quantile(np.abs(levels - off_T), 0.9, method="nearest"))
    of_field_T = array.row_ambient_uncertainty_T or _MODEL_SIGMA_T
    of_sensor_T = [
        math.hypot(s.offset_uncertainty_T, math.hypot(s.gain_uncertainty, s.induced_uncertainty) * modulus_T)
        for s in array.sensors
        if s.kind == ("scalar" if scalar.any() else "vector")
    ]
    sigma_T = math.hypot(of_field_T, max(of_sensor_T), array.common_field_T or 0.0)
    if abs(off_T) < _AMBIENT_SIGMAS * sigma_T or spread_T > _ALIKE * abs(off_T):
        return
    stated_or_not = "stated" if array.row_ambient_uncertainty_T else "assumed, as none is stated"
    yield (
        f"the sensors read {abs(1e9 * off_T):.0f} nT {'more' if off_T > 0.0 else 'less'} than the ambient field of"
        f" {1e9 * modulus_T:.0f} nT, in most rows, far beyond an uncertainty of {1e9 * sigma_T:.3g} nT"
        f" ({stated_or_not}): check the place, the date and the units that the field is from, and whether iron or"
        " geology is near; with a larger ambient_uncertainty_nT of the array, the field is estimated"
    )


def _shortest_half(values: FloatArray) -> tuple[float, float]:
    """Return centre and half width of the shortest interval with half of the values."""
    ordered = np.sort(values)
    n = len(ordered) // 2 + 1
    widths = ordered[n - 1 :] - ordered[: len(ordered) - n + 1]
    k = int(np.argmin(widths))
    return float(ordered[k] + ordered[k + n - 1]) / 2.0, float(widths[k]) / 2.0


def _path_doubts(time_s: FloatArray, position_m: FloatArray) -> Iterator[str]:
    known = np.isfinite(time_s) & np.isfinite(position_m).all(axis=1)
    time_s, position_m = time_s[known], position_m[known]
    dt_s = np.diff(time_s)
    if not known.any() or not (dt_s > 0.0).all() or np.ptp(position_m, axis=0).max() < _FAR_M:
        return
    step_m = np.linalg.norm(np.diff(position_m, axis=0), axis=1)
    speed = step_m / dt_s
    order = np.argsort(speed)
    made_m = np.cumsum(step_m[order])
    slow = speed[order[np.searchsorted(made_m, made_m[-1] / 2.0)]]  # median over the path, so rests do not count
    fast = np.quantile(speed, 0.9)  # single jumps do not count
    if slow < _SLOWEST_M_S or (fast > _FASTEST_M_S and not _ORBIT_M_S[0] < fast < _ORBIT_M_S[1]):
        wrong = slow if slow < _SLOWEST_M_S else fast
        yield f"the array moves at {wrong:.2g} m/s by its poses: are times in s, and places in m?"


def _attitude_doubts(array: SensorArray, readings: Readings, rotation: Rotation) -> Iterator[str]:
    """Yield a sentence if a field of steady modulus (the Earth's) rotates in the world frame.

    The field is the mean reading of the vector sensors, otherwise the ambient field of the rows.
    """
    from scipy.spatial.transform import Rotation

    vector = np.unique(array.channel_sensor[~array.channel_is_scalar])
    if vector.size:
        field_T = np.asarray(array.calibrated_field(readings.values_T)[:, vector].mean(axis=1))
    elif readings.ambient_T is not None:
        field_T = readings.ambient_T
    else:
        return
    whole = np.flatnonzero(np.isfinite(field_T).all(axis=1) & np.isfinite(rotation.as_quat()).all(axis=1))
    if len(whole) < FEWEST_ROWS:
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
    of_carrier = [(s.offset_uncertainty_T / middle, s.induced_uncertainty) for s in array.sensors if s.kind == "vector"]
    by_carrier = 3.0 * max((math.hypot(*fields) for fields in of_carrier), default=0.0)
    if stated < _TURNS_RAD + by_carrier:
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
    if left[best] < stated / 3.0:
        explained, question = f", and {best} by {np.degrees(left[best]):.1f}°", "?"
    elif stated > _TURNS_UNEXPLAINED_RAD + by_carrier:
        explained, question = "", ", and are the sensors calibrated?"
    else:
        return
    yield (
        f"the ambient field, of steady modulus, turns in the world by {np.degrees(stated):.0f}° in the median as the"
        f" array turns{explained}: does the attitude rotate the array's frame to the world's{question}"
    )


def finite_median(values: FloatArray) -> float:
    """Return the median of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(np.median(finite)) if finite.size else float("nan")


def robust_sigma(residuals: FloatArray) -> float:
    """Return σ of Gaussian residuals with outliers, by their median modulus; NaN without any."""
    return SIGMA_OF_MAD * finite_median(np.abs(residuals))
