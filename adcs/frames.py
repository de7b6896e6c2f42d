r"""Frames of a satellite's attitude, and the one place that converts between them.

==========  ======================================================================================================
eci         inertial, origin in the Earth's centre: axes of the GCRS, which are those of J2000 within 0.03″
teme        inertial axes of SGP4's results: true equator, mean equinox of date
ecef        turns with the Earth, see :mod:`magloc.fields.geomagnetic`
orbital     e3 local vertical outwards, e2 orbit normal (along r×v), e1 = e2×e3, along the velocity of a circular
            orbit; it turns at (0, n, 0) against eci
body        of the satellite
ned         north, east, down of a place: geodetic, see :func:`magloc.fields.geomagnetic.R_ned_from_ecef`
==========  ======================================================================================================

Quaternions are Hamilton's, scalar part first, in files and in arrays called ``q``, and take components from body axes
to the named frame: ``v_orbital = q∘v_body∘q*``. Rotations are scipy's, whose ``as_quat`` has the scalar last; only
:mod:`adcs.quaternion` converts.

Matrices are called ``R_to_from``: ``v_to = R_to_from @ v_from``. Everything is computed offline, so that the Earth's
rotation runs on UTC in place of UT1, and without polar motion: up to 0.9 s or 0.004° of longitude, some 400 m on the
ground, where the geomagnetic field changes by about 1 nT.
"""

from __future__ import annotations

import datetime
import warnings
from types import ModuleType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.io.errors import of_extra
from arrays.typing import FloatArray

Instants = NDArray[np.datetime64]
Dates = ArrayLike | datetime.date
DAY_S = 86_400.0
_J2000 = np.datetime64("2000-01-01T12:00:00", "us")
_JD_J2000 = 2_451_545.0


def instants(date: Dates, time_s: ArrayLike = 0.0) -> Instants:
    """Instants of time, UTC to the microsecond, of dates and seconds after them, shape (...) or (..., n).

    Parameters
    ----------
    date : datetime, datetime64 or str, or an array of them, shape (...)
        A datetime without a time zone is UTC; a string is ISO 8601.
    time_s : array_like, shape (n,), optional
        Seconds after every date; a number keeps the shape of the dates.

    Raises
    ------
    ValueError
        A date is none of these, or missing; a time is not finite.
    """
    if isinstance(date, datetime.datetime) and date.tzinfo is not None:
        date = date.astimezone(datetime.UTC).replace(tzinfo=None)
    try:
        start = np.asarray(date).astype("datetime64[us]")
    except (ValueError, TypeError) as error:
        raise ValueError(f"Input date must be dates or ISO 8601 strings; instead received {date!r}.") from error
    if np.isnat(start).any():
        raise ValueError("Input date must not be missing; instead received NaT.")
    seconds = np.asarray(time_s, dtype=np.float64)
    if not np.isfinite(seconds).all():
        raise ValueError("Input time_s must be finite; instead received a value that is not.")
    after = np.round(1e6 * seconds).astype("timedelta64[us]")
    return start + after if after.ndim == 0 else start[..., None] + after


def julian_dates(utc: Instants) -> tuple[FloatArray, FloatArray]:
    """Julian dates as a whole and a fraction of a day: two arrays of the shape of ``utc``.

    Days of UTC have 86,400 s here: an instant in a leap second does not exist in datetime64.
    """
    # Half a day of microseconds, so that the fraction counts from midnight.
    days, rest = np.divmod((utc - _J2000).astype(np.int64) + 43_200_000_000, 86_400_000_000)
    return _JD_J2000 - 0.5 + days, rest / 86_400e6


def of_julian_year(year: float) -> Instants:
    """Instant, UTC, of a Julian year such as 2026.9, shape ()."""
    return instants(_J2000, (year - 2000.0) * 365.25 * DAY_S)


def pyerfa() -> ModuleType:
    """The standards of astronomy, loaded when they are first used."""
    with of_extra("satellites", "the rotation of the Earth"):
        import erfa
    return erfa


def terrestrial_dates(utc: Instants) -> tuple[FloatArray, FloatArray]:
    """Julian dates of Terrestrial Time, which is 69.184 s ahead of UTC since 2017, as :func:`julian_dates`."""
    erfa = pyerfa()
    with warnings.catch_warnings():
        # Beyond the table of leap seconds, and before UTC began in 1960, the nearest entry is used.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        day, fraction = erfa.utctai(*julian_dates(utc))
    return erfa.taitt(day, fraction)


def R_ecef_from_eci(utc: Instants) -> FloatArray:
    """Rotation of the Earth, IAU 2000B precession and nutation, UT1 = UTC. Instants (...) -> (..., 3, 3)."""
    return np.asarray(pyerfa().c2t00b(*terrestrial_dates(utc), *julian_dates(utc), 0.0, 0.0), dtype=np.float64)


def R_eci_from_teme(utc: Instants) -> FloatArray:
    """Axes of SGP4's results in eci: TEME is turned to ecef by the mean sidereal time of 1982. (...) -> (..., 3, 3)."""
    return R_ecef_from_eci(utc).mT @ rotation_about_z(pyerfa().gmst82(*julian_dates(utc)))


def rotation_about_z(angle_rad: ArrayLike) -> FloatArray:
    """Components in axes that are turned about z by an angle against the old ones. Angles (...) -> (..., 3, 3)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack(
        [np.stack([c, s, zero], axis=-1), np.stack([-s, c, zero], axis=-1), np.stack([zero, zero, one], axis=-1)],
        axis=-2,
    )


def R_orbital_from_eci(position_eci_m: ArrayLike, velocity_eci_m_s: ArrayLike) -> FloatArray:
    """Rotation matrices whose rows are e1, e2, e3 of the orbital frame in eci, shape (..., 3, 3).

    Parameters
    ----------
    position_eci_m : array_like, shape (..., 3)
    velocity_eci_m_s : array_like, shape (..., 3)
    """
    position = np.asarray(position_eci_m, dtype=np.float64)
    e3 = position / np.linalg.norm(position, axis=-1, keepdims=True)
    momentum = np.cross(position, np.asarray(velocity_eci_m_s, dtype=np.float64))
    e2 = momentum / np.linalg.norm(momentum, axis=-1, keepdims=True)
    return np.stack([np.cross(e2, e3), e2, e3], axis=-2)


def orbital_rate(position_eci_m: ArrayLike, velocity_eci_m_s: ArrayLike) -> FloatArray:
    r"""Rate n = \|r×v\|/r² at which the orbital frame turns about e2 [rad/s]. Shapes (..., 3) -> (...).

    It turns about e3, too, by what the forces across the orbit's plane make: some 1e-9 rad/s on a low orbit, left out.
    """
    position = np.asarray(position_eci_m, dtype=np.float64)
    momentum = np.cross(position, np.asarray(velocity_eci_m_s, dtype=np.float64))
    return np.linalg.norm(momentum, axis=-1) / np.sum(position * position, axis=-1)


def turned(rotation: ArrayLike, vectors: ArrayLike) -> FloatArray:
    """Vectors (..., 3), each turned by its rotation matrix (..., 3, 3)."""
    return (np.asarray(rotation, dtype=np.float64) @ np.asarray(vectors, dtype=np.float64)[..., None])[..., 0]
