"""Orbit and attitude messages of the CCSDS: OEM (502.0-B) and AEM (504.0-B), as text with keywords.

An attitude relates a body to an inertial frame. With ``ATTITUDE_DIR = A2B`` and A inertial, the matrix of the
message's quaternion transforms components from A to B. As a Hamilton quaternion it is the rotation, inertial from body,
that :mod:`adcs` uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike

from adcs.environment.ephemeris import EphemerisOrbit
from adcs.frames import Instants, R_eci_from_teme, instants, turned
from arrays.io.errors import InputError, naming
from arrays.io.text import read_text, write_text
from arrays.typing import FloatArray

INERTIAL = ("EME2000", "GCRF", "ICRF", "J2000")
"""Frames with the axes of eci within 0.03″."""
_ORIGINATOR = "ADCS"


@dataclass(frozen=True, eq=False)
class _Segment:
    """Segment of a message: line number, keywords, instants, and numbers of the data lines."""

    line: int
    meta: Mapping[str, str]
    utc: Instants
    values: FloatArray


def read_oem(path: str | PathLike[str]) -> EphemerisOrbit:
    """Read the orbit of an orbit ephemeris message of the CCSDS (OEM).

    Segments are joined; accelerations and covariances are ignored.

    Parameters
    ----------
    path : str or path-like
        Message as text with keywords, in UTC and in EME2000, GCRF, ICRF or TEME.

    Returns
    -------
    EphemerisOrbit
        Orbit in eci, interpolated between the states of the message.

    Raises
    ------
    InputError
        The file is no such message; the text states line and cause.

    Examples
    --------
    >>> import adcs
    >>> import numpy as np
    >>> orbit = adcs.circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21")
    >>> utc = adcs.frames.instants("2026-11-21", np.arange(0.0, 3600.0, 60.0))
    >>> adcs.write_oem("orbit.oem", utc, *orbit.position_velocity_eci(utc))
    >>> adcs.read_oem("orbit.oem").epoch
    np.datetime64('2026-11-21T00:00:00.000000')
    """
    position: list[FloatArray] = []
    velocity: list[FloatArray] = []
    utc: list[Instants] = []
    for segment in _segments(path, "CCSDS_OEM_VERS", 6):
        frame = _word(path, segment, "REF_FRAME", (*INERTIAL, "TEME"))
        states = 1e3 * segment.values[:, :6].reshape(-1, 2, 3)
        if frame == "TEME":
            states = turned(R_eci_from_teme(segment.utc)[:, None], states)
        new = slice(int(np.sum(segment.utc <= utc[-1][-1])) if utc else 0, None)
        utc.append(segment.utc[new])
        position.append(states[new, 0])
        velocity.append(states[new, 1])
    with naming(str(path)):
        return EphemerisOrbit(np.concatenate(utc), np.concatenate(position), np.concatenate(velocity))


def read_aem(path: str | PathLike[str]) -> tuple[Instants, FloatArray]:
    """Read the attitude of an attitude ephemeris message of the CCSDS (AEM).

    Parameters
    ----------
    path : str or path-like
        Message as text with keywords, in UTC: quaternions of a body against an inertial frame, in either direction.

    Returns
    -------
    utc : ndarray of datetime64, shape (n,)
        Instants.
    q : ndarray, shape (n, 4)
        Attitudes, inertial from body, scalar last.

    Raises
    ------
    InputError
        The file is no such message; the text states line and cause.

    Examples
    --------
    >>> import adcs
    >>> utc = adcs.frames.instants("2026-11-21", [0.0, 1.0])
    >>> adcs.write_aem("attitude.aem", utc, [[0, 0, 0, 1], [0, 0, 0.6, 0.8]])
    >>> adcs.read_aem("attitude.aem")[1][1]
    array([0. , 0. , 0.6, 0.8])
    """
    utc, q = [], []
    for segment in _segments(path, "CCSDS_AEM_VERS", 4):
        _word(path, segment, "ATTITUDE_TYPE", ("QUATERNION",))
        direction = _word(path, segment, "ATTITUDE_DIR", ("A2B", "B2A"))
        inertial_is_a = segment.meta.get("REF_FRAME_A", "") in INERTIAL
        _word(path, segment, "REF_FRAME_A" if inertial_is_a else "REF_FRAME_B", INERTIAL)
        order = segment.meta.get("QUATERNION_TYPE", "LAST")
        values = segment.values[:, :4] if order == "LAST" else np.roll(segment.values[:, :4], -1, axis=1)
        conjugated = (direction == "A2B") != inertial_is_a
        utc.append(segment.utc)
        q.append(values * [-1.0, -1.0, -1.0, 1.0] if conjugated else values)
    return np.concatenate(utc), np.concatenate(q)


def write_oem(path: str | PathLike[str], utc: Instants, position_m: FloatArray, velocity_m_s: FloatArray) -> None:
    """Write an orbit ephemeris message of the CCSDS (OEM).

    Parameters
    ----------
    path : str or path-like
        File to write.
    utc : ndarray of datetime64, shape (n,)
        Instants.
    position_m, velocity_m_s : ndarray, shape (n, 3)
        States in eci, which is written as EME2000.

    Examples
    --------
    >>> import adcs
    >>> orbit = adcs.circular_orbit(altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21")
    >>> utc = adcs.frames.instants("2026-11-21", [0.0, 60.0])
    >>> adcs.write_oem("two.oem", utc, *orbit.position_velocity_eci(utc))
    """
    meta = {"REF_FRAME": "EME2000", "INTERPOLATION": "HERMITE", "INTERPOLATION_DEGREE": "3"}
    values = 1e-3 * np.concatenate([position_m, velocity_m_s], axis=1)
    _write(path, "CCSDS_OEM_VERS = 2.0", {"CENTER_NAME": "EARTH", **meta}, utc, values, "{:.9f}", data=False)


def write_aem(path: str | PathLike[str], utc: Instants, q: ArrayLike) -> None:
    """Write an attitude ephemeris message of the CCSDS (AEM).

    Parameters
    ----------
    path : str or path-like
        File to write.
    utc : ndarray of datetime64, shape (n,)
        Instants.
    q : array_like, shape (n, 4)
        Attitudes, inertial from body, scalar last.

    Examples
    --------
    >>> import adcs
    >>> utc = adcs.frames.instants("2026-11-21", [0.0])
    >>> adcs.write_aem("one.aem", utc, [[0, 0, 0, 1]])
    """
    meta = {
        "REF_FRAME_A": "EME2000",
        "REF_FRAME_B": "SC_BODY_1",
        "ATTITUDE_DIR": "A2B",
        "ATTITUDE_TYPE": "QUATERNION",
        "QUATERNION_TYPE": "LAST",
    }
    _write(path, "CCSDS_AEM_VERS = 1.0", meta, utc, np.asarray(q, dtype=np.float64), "{:.12f}", data=True)


def _write(
    path: str | PathLike[str],
    version: str,
    meta: Mapping[str, str],
    utc: Instants,
    values: FloatArray,
    shown: str,
    *,
    data: bool,
) -> None:
    """Write one segment; data lines of an attitude stand between DATA_START and DATA_STOP."""
    times = np.datetime_as_string(utc, unit="us")
    span = {"TIME_SYSTEM": "UTC", "START_TIME": times[0], "STOP_TIME": times[-1]}
    keys = {"OBJECT_NAME": "SATELLITE", "OBJECT_ID": "0000-000A", **meta, **span}
    rows = [" ".join([time, *map(shown.format, row)]) for time, row in zip(times, values, strict=True)]
    lines = [
        version,
        # The time of the last state, so that the same states give the same file.
        f"CREATION_DATE = {times[-1]}",
        f"ORIGINATOR = {_ORIGINATOR}",
        "META_START",
        *(f"{key} = {value}" for key, value in keys.items()),
        "META_STOP",
        *(["DATA_START", *rows, "DATA_STOP"] if data else rows),
    ]
    write_text("\n".join([*lines, ""]), path)


def _segments(path: str | PathLike[str], version: str, columns: int) -> list[_Segment]:
    """Return the segments of a message; raise InputError without any."""
    lines = read_text(path, f"a message with {version}").splitlines()
    if not lines or not lines[0].startswith(version):
        first = lines[0][:40] if lines else "nothing"
        raise InputError(f"{path}, line 1: found {first!r}, expected {version} = 1.0 or later, with keywords.")
    found: list[_Segment] = []
    meta: dict[str, str] = {}
    start, skipped = 0, False
    rows: list[tuple[int, list[str]]] = []
    for number, text in enumerate([*lines[1:], "META_START"], start=2):
        words = text.split()
        if not words or words[0] in ("COMMENT", "META_STOP", "DATA_START", "DATA_STOP"):
            continue
        if words[0] in ("COVARIANCE_START", "COVARIANCE_STOP"):
            skipped = words[0] == "COVARIANCE_START"
        elif words[0] == "META_START":
            if rows:
                found.append(_Segment(start, meta, *_numbers(path, rows, columns)))
            meta, start, rows = {}, number, []
        elif "=" in text:
            key, _, value = text.partition("=")
            meta[key.strip()] = value.strip()
        elif not skipped:
            rows.append((number, words))
    if not found:
        raise InputError(f"{path}: found no line of data, expected an instant and {columns} numbers on each.")
    for segment in found:
        _word(path, segment, "TIME_SYSTEM", ("UTC",))
    return found


def _numbers(path: str | PathLike[str], rows: list[tuple[int, list[str]]], columns: int) -> tuple[Instants, FloatArray]:
    """Return the instants and the numbers of data lines."""
    utc, values = [], []
    for number, words in rows:
        try:
            utc.append(np.datetime64(words[0].removesuffix("Z"), "us"))
            values.append([float(word) for word in words[1 : columns + 1]])
        except ValueError:
            values.append([])
        if len(values[-1]) != columns or not np.isfinite(values[-1]).all():
            raise InputError(
                f"{path}, line {number}: found {' '.join(words)[:60]!r}, expected an instant such as "
                f"2026-11-21T12:00:00.000 and {columns} numbers."
            )
    return instants(np.array(utc)), np.array(values)


def _word(path: str | PathLike[str], segment: _Segment, key: str, known: tuple[str, ...]) -> str:
    """Return the value of a keyword; raise InputError unless it is a known one."""
    value = segment.meta.get(key)
    if value not in known:
        expected = " or ".join(known)
        raise InputError(f"{path}, segment from line {segment.line}, {key}: found {value}, expected {expected}.")
    return value
