"""Detection of wrong units and conventions in the log of a satellite.

A misread sensor contradicts the others, or the model of field and Sun. The checks are: the length of the field, the
angle between field and Sun, field and Sun in the star tracker's attitude, and the gyro's rotations against those of an
attitude. All likely misreadings are then tried, and those that remove all contradictions are named.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from adcs import quaternion
from adcs.environment.orbit import Sgp4Orbit
from adcs.satellite.sensors import SENSOR_WORDS
from adcs.satellite.telemetry import Record, Telemetry, orbital_from_eci
from adcs.satellite.vector_record import step_rates, steps_s
from adcs.satellite.wahba import attitude_of_vectors
from arrays.typing import FloatArray

_MOST_ROWS = 3000
_SUSPICIOUS, _MENDED = 0.25, 4.0
_LEAST_SINE = 0.3  # least sine of the angle between field and Sun for an attitude from both
_FACTOR = 1.4
_ANGLE_RAD = math.radians(20.0)
_TURN_RAD = math.radians(45.0)
_LEAST_TURN_RAD = math.radians(5.0)
# Gains 5 % off and a bias of 2 µT in 25 µT along each axis, as of an uncalibrated magnetometer, make 9 % rms.
_MOST_MODULUS_ERROR = 0.1
_NAMED_MODULUS_ERROR = 0.05
_WRONG_ORBIT = (
    "the modulus of the field is {} % (rms) off its model along the orbit: check the start, altitude, inclination and "
    "node of the orbit, or calibrate the magnetometer"
)
_ALSO_ORBIT = (
    " The modulus of the field is {:.0f} % (rms) off its model, which signs and axes cannot cause: check the orbit too."
)
FIELD_UNITS = {
    "µT taken for nT": 1e3,
    "nT taken for µT": 1e-3,
    "T taken for nT": 1e9,
    "nT taken for T": 1e-9,
    "µT taken for T": 1e-6,
    "mG taken for nT": 1e2,
    "nT taken for mG": 1e-2,
    "G taken for nT": 1e5,
}
RATE_UNITS = {"rad/s taken for °/s": 180.0 / math.pi, "°/s taken for rad/s": math.pi / 180.0}
# Components (w, x, y, z) as read for columns in the order (x, y, z, w), and vice versa.
_ORDERS = {"scalar last taken for scalar first": [3, 0, 1, 2], "scalar first taken for scalar last": [1, 2, 3, 0]}


@dataclass(frozen=True, eq=False)
class _Log:
    """Readings of some rows in body axes, and their models in the inertial frame."""

    time_s: FloatArray
    star: FloatArray  # (n, 4): inertial from body, scalar first
    gyro: FloatArray
    field: FloatArray
    sun: FloatArray
    model_field: FloatArray
    model_sun: FloatArray


def check_conventions(telemetry: Telemetry, record: Record, used: Collection[str]) -> list[str]:
    """Check a log for misread sensors and a wrong orbit, and return sentences of warning.

    Raises ValueError if one misread sensor explains why the log contradicts itself or the orbit. Signs and axes do not
    change the field's modulus: where that is far from the model, the orbit is suspected first.

    ``record``: record of the log. ``used``: names of :data:`SENSORS`. The field is not compared if the elements of the
    orbit are too old for it.
    """
    around, orbit = record.environment, record.satellite.orbit
    old = isinstance(orbit, Sgp4Orbit) and 3.0 * orbit.relative_error(around.utc) > _SUSPICIOUS * math.log(_FACTOR)
    model_field_T = around.b_orbital_T[0] * (np.nan if old else 1.0)
    rows = telemetry.rows
    chosen = slice(0, _MOST_ROWS)
    at = rows[chosen]
    eci_from_orbital = quaternion.conjugate(orbital_from_eci(around)[0, at])
    log = _Log(
        telemetry.time_s[chosen],
        quaternion.normalised(telemetry.star[chosen][:, [3, 0, 1, 2]]),
        telemetry.gyro_rad_s[chosen],
        telemetry.field_T[chosen],
        telemetry.sun[chosen],
        quaternion.rotate(eci_from_orbital, model_field_T[at]),
        quaternion.rotate(eci_from_orbital, around.sun_orbital[0, at]),
    )
    as_read = _disagreements(log)
    error = _modulus_error(log) if "mag" in used else 0.0
    far = f"{100 * error:.0f}" if error > _MOST_MODULUS_ERROR else ""
    warnings = [_WRONG_ORBIT.format(far)] if far else []
    if as_read.max() < _SUSPICIOUS:
        return warnings
    with np.errstate(over="ignore"):
        changed = {
            f"the {SENSOR_WORDS[sensor]}{name}": _disagreements(_apply_change(log, attribute, matrix))
            for sensor, name, attribute, matrix in _changes()
            if sensor in used
        }
    if named := remedies(as_read, changed, int(np.argmax(as_read))):
        if far and not any(name.startswith(("the gyro", "the magnetometer in ")) for name in named):
            raise ValueError(
                "Input telemetry must have a field along the orbit whose modulus is within "
                f"{100 * _MOST_MODULUS_ERROR:.0f} % (rms) of the model; instead received {far} %, more than signs and "
                "axes cause. Check the orbit: start, altitude, inclination and node. Then undo this"
                f"{' or another one' if len(named) > 1 else ''}: {named[0]}."
            )
        is_near = _NAMED_MODULUS_ERROR < error <= _MOST_MODULUS_ERROR
        raise ValueError(
            "Input telemetry must agree with itself and with the orbit; instead received readings that agree if this "
            f"is undone: {', or '.join(named)}.{_ALSO_ORBIT.format(100 * error) if is_near else ''}"
        )
    return warnings


def remedies(as_read: FloatArray, changed: Mapping[str, FloatArray], worst: int) -> list[str]:
    """Return the names of changes that remove the disagreement ``worst`` and make no other one worse.

    ``as_read`` (k,): disagreements over their allowed values. ``changed``: the same after each change, by its name.
    """
    mended = {
        name: found.sum()
        for name, found in changed.items()
        if found[worst] <= min(as_read[worst] / _MENDED, 1.0) and (found <= np.maximum(as_read, 1.0)).all()
    }
    least = min(mended.values(), default=0.0)
    return [name for name, value in mended.items() if value <= 1.2 * least + 0.01]


def _changes() -> Iterator[tuple[str, str, str, FloatArray]]:
    """Yield sensors, names of misreadings, attributes of a log, and matrices that correct them."""
    for name, factor in FIELD_UNITS.items():
        yield "mag", f" in {name}", "field", factor * np.eye(3)
    for name, factor in RATE_UNITS.items():
        yield "gyro", f" in {name}", "gyro", factor * np.eye(3)
    about, conjugation = (
        "body from inertial taken for inertial from body (conjugated)",
        np.diag([1.0, -1.0, -1.0, -1.0]),
    )
    yield "st", f", {about}", "star", conjugation
    for name, order in _ORDERS.items():
        ordering = np.eye(4)[:, order]
        yield "st", f", {name}", "star", ordering
        yield "st", f", {name} and {about}", "star", ordering @ conjugation
    for sensor, attribute in (("gyro", "gyro"), ("mag", "field"), ("sun", "sun")):
        for name, matrix in reflected_axes():
            yield sensor, name, attribute, matrix


def _apply_change(log: _Log, attribute: str, matrix: FloatArray) -> _Log:
    return replace(log, **{attribute: getattr(log, attribute) @ matrix})


def reflected_axes() -> Iterator[tuple[str, FloatArray]]:
    """Yield names and matrices of reversed or exchanged axes."""
    yield ", all its signs reversed", -np.eye(3)
    for axis, name in enumerate("xyz"):
        yield f", its axis {name} reversed", np.diag(np.where(np.arange(3) == axis, -1.0, 1.0))
        yield f", all axes but {name} reversed", np.diag(np.where(np.arange(3) == axis, 1.0, -1.0))
    for order, pair in (([1, 0, 2], "x and y"), ([2, 1, 0], "x and z"), ([0, 2, 1], "y and z")):
        yield f", its axes {pair} exchanged", np.eye(3)[order]
    yield ", its axes in the order y, z, x", np.eye(3)[[1, 2, 0]]
    yield ", its axes in the order z, x, y", np.eye(3)[[2, 0, 1]]


def _disagreements(log: _Log) -> FloatArray:
    """Return contradictions (6,) over their allowed values; 0 without the readings."""
    vectors = attitude_of_vectors([log.sun, log.field], [log.model_sun, log.model_field], [1.0, 1.0], method="triad").q
    vectors[np.sin(angle(log.sun, log.field)) < _LEAST_SINE] = np.nan
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        found = [
            median(np.abs(np.log(_lengths(log.field) / _lengths(log.model_field)))) / math.log(_FACTOR),
            median(np.abs(angle(log.field, log.sun) - angle(log.model_field, log.model_sun))) / _ANGLE_RAD,
            *(
                median(angle(reading, quaternion.rotate_back(log.star, model))) / _ANGLE_RAD
                for reading, model in ((log.field, log.model_field), (log.sun, log.model_sun))
            ),
            *(_turns(log, q) for q in (log.star, vectors)),
        ]
    return np.array(found)


def _modulus_error(log: _Log) -> float:
    """Return the rms of the logarithm of the measured over the modelled modulus of the field; 0 without readings."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.log(_lengths(log.field) / _lengths(log.model_field))
    there = ratio[np.isfinite(ratio)]
    return float(np.sqrt(np.mean(there**2))) if there.size else 0.0


def _turns(log: _Log, q: FloatArray) -> float:
    """Return the angle between rotations of gyro and attitude over its allowed value, for large rotations."""
    if not np.isfinite(log.gyro[:1]).all() or len(log.gyro) < 3 or not np.isfinite(q).any():
        return 0.0
    steps = steps_s(log.time_s)
    window, of_gyro = 1, quaternion.exp(step_rates(log.gyro, steps, "point") * steps[:, None])[1:]
    while True:
        of_q = quaternion.multiply(quaternion.conjugate(q[:-window]), q[window:])
        turned = median(quaternion.angle_between(of_q, quaternion.IDENTITY))
        if turned >= _TURN_RAD or 2 * window >= len(q) - 1:
            break
        of_gyro = quaternion.multiply(of_gyro[:-window], of_gyro[window:])
        window *= 2
    if turned < _LEAST_TURN_RAD:
        return 0.0
    return median(quaternion.angle_between(of_gyro, of_q)) / (0.3 * turned + math.radians(2.0))


def _lengths(v: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(v, axis=-1))


def angle(a: FloatArray, b: FloatArray) -> FloatArray:
    """Return the angles (...) between vectors (..., 3) of any length."""
    return np.arctan2(_lengths(np.cross(a, b)), np.sum(a * b, axis=-1))


def median(values: FloatArray) -> float:
    """Return the median of the finite values; 0 without any."""
    there = values[np.isfinite(values)]
    return float(np.median(there)) if there.size else 0.0
