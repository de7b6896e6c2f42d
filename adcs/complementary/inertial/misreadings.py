"""Detection of wrong units and axes in the log of an inertial unit.

Gravity and the Earth's field have known lengths, and are constant in a frame that does not rotate. Their rotation in
body axes must agree with the gyro. If a sensor contradicts the others, all likely misreadings are tried.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.complementary.inertial.integration import gyro_attitudes
from adcs.satellite.conventions import FIELD_UNITS, RATE_UNITS, angle, median, reflected_axes, remedies
from adcs.satellite.telemetry import is_read
from adcs.satellite.vector_record import instants_within, steps_s
from arrays.typing import BoolArray, FloatArray
from magloc.measurement.plausibility import EARTH_T

_GRAVITY_M_S2 = 9.81
_LEAST_GRAVITY_M_S2 = 5.0  # least median of all readings for any motion of the unit
_ACCELERATION_UNITS = {
    "g taken for m/s²": 9.80665,
    "mg taken for m/s²": 9.80665e-3,
    "m/s² taken for g": 1.0 / 9.80665,
    "m/s² taken for mg": 1e3 / 9.80665,
}
_PLAUSIBLE_T = (5e-6, 500e-6)
_MORE_RATE_UNITS = {
    "mrad/s taken for rad/s": 1e-3,
    "rad/s taken for mrad/s": 1e3,
    "°/h taken for °/s": 1.0 / 3600.0,
    "°/s taken for °/h": 3600.0,
}
_TIME_UNITS = {"ms taken for s": 1e-3, "µs taken for s": 1e-6, "ns taken for s": 1e-9, "s taken for ms": 1e3}
_STEP_S = (5e-4, 0.5)  # usual steps of a log
# Rotation of a quarter of the windows; accelerations of a hand have larger errors than fields of a room.
_TURNS_RAD = {"magnetometer": math.radians(15.0), "accelerometer": math.radians(30.0)}
_LEAST_TURN = 1.0 / 3.0  # least part of that rotation in a window that counts
_SUSPICIOUS = 0.5
_ALLOWED_PART, _ALLOWED_RAD, _DIP_RAD = 0.3, math.radians(2.0), math.radians(20.0)
_WINDOWS, _MOST_WINDOWS = 16, 200
_CHANCE = 2e-5
_SAMPLE_S = 0.02
_LIKE_PART = (0.2, 10.0)  # path of the gyro over the rotation of a vector if the units are right
_VECTORS = ("magnetometer", "accelerometer")


@dataclass(frozen=True, eq=False)
class _Windows:
    """Pairs of readings of a vector, between which it rotates."""

    first: NDArray[np.intp]  # rows
    last: NDArray[np.intp]
    before: FloatArray  # (k, 3): unit vectors at the first row,
    after: FloatArray  # and at the last one

    def differences(self, turns: FloatArray) -> FloatArray:
        """Return the angles (k,) between the vector's rotations and others, rotation vectors (k, 3)."""
        return angle(quaternion.rotate(quaternion.exp(turns), self.after), self.before)

    @property
    def allowed_rad(self) -> float:
        """Largest median difference of good readings, of a hand in a room."""
        return _ALLOWED_PART * median(angle(self.before, self.after)) + _ALLOWED_RAD


def check_lengths(acceleration_m_s2: FloatArray, field_T: FloatArray, starting: BoolArray) -> None:
    """Raise ValueError if the length of the acceleration or of the field fits another unit.

    Both the first second (``starting``, (n,)) and the whole log must show it.
    """
    lengths, fields = (np.sqrt(np.einsum("ni,ni->n", v, v)) for v in (acceleration_m_s2, field_T))
    gravity, field = (np.array([median(v[starting]), median(v)]) for v in (lengths, fields))
    scatter = median(np.abs(lengths[starting] - gravity[0]))
    for name, factor in _ACCELERATION_UNITS.items():
        if (np.abs(gravity * factor / _GRAVITY_M_S2 - 1.0) < 0.1).all() and scatter < 0.1 * gravity[0]:
            raise ValueError(
                f"Input acceleration_m_s2 must be 9.8 m/s² at rest; instead received {gravity[0]:.3g} m/s², which is "
                f"the accelerometer in {name}. Convert it, or state its unit in the layout of the log."
            )
    if (gravity < _LEAST_GRAVITY_M_S2).all():
        raise ValueError(
            f"Input acceleration_m_s2 must include gravity, 9.8 m/s² upwards at rest; instead received a median of "
            f"{gravity[1]:.2g} m/s². The readings are without gravity, as of a linear acceleration, or in another "
            "unit. Use the accelerometer's raw readings."
        )
    if np.isfinite(field_T).any() and not (_PLAUSIBLE_T[0] < field[0] < _PLAUSIBLE_T[1]):
        for name, factor in FIELD_UNITS.items():
            if ((EARTH_T[0] < factor * field) & (factor * field < EARTH_T[1])).all():
                raise ValueError(
                    "Input field_T must be near the Earth's field, 22 to 67 µT; instead received "
                    f"{1e6 * field[0]:.3g} µT at the start, which is the magnetometer in {name}. Convert it, or state "
                    "its unit in the layout of the log."
                )


def check_turns(
    time_s: FloatArray, rate_rad_s: FloatArray, acceleration_m_s2: FloatArray, field_T: FloatArray, hidden: BoolArray
) -> None:
    """Raise ValueError if one misreading of a sensor or of the time explains why the turns contradict each other.

    The rotations of gravity and field in body axes are compared with the gyro's over windows with rotations of 15 to
    30°. A change counts if it removes three quarters of a disagreement, makes no other one worse, and improves more
    windows than chance does once in 50,000 times. With 120 changes, that last rule alone refuses fewer than one right
    log in 400. A log that rotates too little shows nothing.
    ``rate_rad_s`` (n, 3): mean over the step that ends at each instant. ``acceleration_m_s2``, ``field_T`` (n, 3): NaN
    without a reading. ``hidden`` (n,): instants within a gap of the gyro.
    """
    gaps = np.cumsum(hidden, dtype=np.intp)
    vectors = {"magnetometer": field_T, "accelerometer": acceleration_m_s2}
    windows = {name: _windows(time_s, v, gaps, _TURNS_RAD[name]) for name, v in vectors.items()}
    windows = {name: w for name, w in windows.items() if len(w.first)}
    if not windows:
        return
    dt_s = steps_s(time_s)
    dips = _thin(np.flatnonzero(is_read(field_T) & is_read(acceleration_m_s2)))
    pair = field_T[dips], acceleration_m_s2[dips]
    turns = _gyro_turns(rate_rad_s, dt_s, windows)
    before = _differences(windows, turns, pair)
    allowed = {**{name: w.allowed_rad for name, w in windows.items()}, "dip": _DIP_RAD}
    as_read = _disagreements(before, allowed)
    if as_read.max() < _SUSPICIOUS:
        return
    changed = {}
    for sensor, name, factor in _units(dt_s, rate_rad_s, windows):
        changed[f"the {sensor} in {name}"] = _differences(
            windows, _gyro_turns(factor * rate_rad_s, dt_s, windows), pair
        )
    # If gyro and field agree, both are right.
    agree = "magnetometer" in windows and as_read[0] < _SUSPICIOUS
    for sensor, name, matrix in _axes(["accelerometer"] if agree else ["gyro", *windows]):
        changed[f"the {sensor}{name}"] = _differences(windows, turns, pair, sensor, matrix)
    disagreements = {name: _disagreements(found, allowed) for name, found in changed.items()}
    for worst in np.argsort(as_read)[::-1]:
        seen = list(before)[worst]
        if seen == "dip" or as_read[worst] < _SUSPICIOUS:
            continue
        named = remedies(as_read, disagreements, int(worst))
        if named := [name for name in named if _is_nearer(before[seen], changed[name][seen])]:
            raise ValueError(_sentence(named, seen, before[seen], changed[named[0]][seen]))


_ARGUMENTS = {"gyro": "gyro_rad_s", "accelerometer": "acceleration_m_s2", "magnetometer": "field_T", "time": "time_s"}


def _sentence(named: list[str], seen: str, before: FloatArray, after: FloatArray) -> str:
    argument = next(value for word, value in _ARGUMENTS.items() if word in named[0])
    as_read, undone = (f"{math.degrees(median(found)):.2g}°" for found in (before, after))
    return (
        f"Input {argument} must turn as the other sensors do; instead received readings that agree if this is undone: "
        f"{', or '.join(named[:3])}. The turns of gyro and {seen} differ by {as_read} as read and by {undone} without "
        f"it (median of {len(before)} windows). Convert it, or state unit, time_format, order of the columns and "
        "mounting in the layout of the log."
    )


def _thin(rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Thin rows evenly to at most :data:`_MOST_WINDOWS`."""
    return rows[:: -(-len(rows) // _MOST_WINDOWS)] if len(rows) else rows


def _windows(time_s: FloatArray, v: FloatArray, gaps: NDArray[np.intp], turn_rad: float) -> _Windows:
    """Return the shortest consecutive windows such that a quarter of them turn enough; none if there are few."""
    rows = np.flatnonzero(is_read(v))
    rows = rows[:: instants_within(_SAMPLE_S, time_s[rows])]
    units = v[rows] / np.linalg.norm(v[rows], axis=1, keepdims=True)
    size = 1
    while len(rows) // size > _WINDOWS:
        turned = angle(units[:-size:size], units[size::size])
        enough = np.percentile(turned, 75.0) >= turn_rad
        if enough or len(rows) // (2 * size) <= _WINDOWS:
            first = rows[:-size:size]
            moves = (turned > _LEAST_TURN * turn_rad) & (gaps[first] == gaps[rows[size::size]])
            if np.count_nonzero(moves) >= _WINDOWS:
                chosen = _thin(np.flatnonzero(moves)) * size
                return _Windows(rows[chosen], rows[chosen + size], units[chosen], units[chosen + size])
            break
        size *= 2
    return _Windows(rows[:0], rows[:0], units[:0], units[:0])


def _gyro_turns(rate_rad_s: FloatArray, dt_s: FloatArray, windows: dict[str, _Windows]) -> dict[str, FloatArray]:
    """Return the gyro's rotation vectors (k, 3) over the windows of each vector."""
    q = gyro_attitudes(rate_rad_s, dt_s)
    return {
        name: quaternion.log(quaternion.multiply(quaternion.conjugate(q[w.first]), q[w.last]))
        for name, w in windows.items()
    }


def _differences(
    windows: dict[str, _Windows],
    turns: dict[str, FloatArray],
    pair: tuple[FloatArray, FloatArray],
    sensor: str = "",
    matrix: FloatArray | None = None,
) -> dict[str, FloatArray]:
    """Return the angles between the rotations of each vector and the gyro, and of the dip to its median.

    ``matrix`` corrects a sensor's axes. For the gyro it acts on the rotations of short windows as on rates.
    """
    found = {}
    for name, w in windows.items():
        undone = turns[name] @ matrix if sensor == "gyro" and matrix is not None else turns[name]
        if sensor == name and matrix is not None:
            w = replace(w, before=w.before @ matrix, after=w.after @ matrix)
        found[name] = w.differences(undone)
    field, acceleration = (
        v @ matrix if sensor == name and matrix is not None else v for name, v in zip(_VECTORS, pair, strict=True)
    )
    dip = angle(field, acceleration)
    return {**found, "dip": np.abs(dip - median(dip))}


def _disagreements(differences: dict[str, FloatArray], allowed: dict[str, float]) -> FloatArray:
    """Return medians of differences over their allowed values."""
    return np.array([median(found) / allowed[name] for name, found in differences.items()])


def _is_nearer(before: FloatArray, after: FloatArray) -> bool:
    """Return whether more windows agree better than by chance, by a sign test."""
    from scipy.stats import binom

    return bool(binom.sf(np.count_nonzero(after < before) - 1, len(before), 0.5) < _CHANCE)


def _units(dt_s: FloatArray, rate_rad_s: FloatArray, windows: dict[str, _Windows]) -> Iterator[tuple[str, str, float]]:
    """Yield gyro or time, names of wrong units, and the factor of the rotations that corrects each."""
    path = np.cumsum(np.sqrt(np.einsum("ni,ni->n", rate_rad_s, rate_rad_s)) * dt_s)
    parts = [median((path[w.last] - path[w.first]) / angle(w.before, w.after)) for w in windows.values()]
    if all(_LIKE_PART[0] < part < _LIKE_PART[1] for part in parts):
        return
    step_s = float(np.median(dt_s))
    times = {
        name: factor
        for name, factor in _TIME_UNITS.items()
        if _STEP_S[0] <= step_s * factor <= _STEP_S[1] and not _STEP_S[0] <= step_s <= _STEP_S[1]
    }
    yield from (("time", name, factor) for name, factor in times.items())
    for name, factor in {**RATE_UNITS, **_MORE_RATE_UNITS}.items():
        if factor not in times.values():
            yield "gyro", name, factor


def _axes(sensors: list[str]) -> Iterator[tuple[str, str, FloatArray]]:
    """Yield sensors, names of wrong axes, and the matrix that corrects each."""
    for sensor in sensors:
        known = [np.eye(3)]
        for name, matrix in _all_axes():
            # A vector and its opposite have the same rotations.
            same = [matrix] if sensor == "gyro" else [matrix, -matrix]
            if not any(np.array_equal(a, b) for a in same for b in known):
                known.append(matrix)
                yield sensor, name, matrix


def _all_axes() -> Iterator[tuple[str, FloatArray]]:
    """Yield the 48 permutations and reversals of axes, the likely ones first."""
    yield from reflected_axes()
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            words = [f"{'-' if sign < 0.0 else ''}{'xyz'[k]}" for k, sign in zip(order, signs, strict=True)]
            yield f", its axes in the order {', '.join(words)}", np.eye(3)[list(order)] * np.array(signs)[:, None]
