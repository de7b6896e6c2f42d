r"""Frames of a satellite's attitude, and conversions between them.

==========  ======================================================================================================
eci         inertial, origin at the Earth's centre: axes of the GCRS, which equal those of J2000 within 0.03″
teme        inertial axes of SGP4's results: true equator, mean equinox of date
ecef        rotates with the Earth, see :mod:`magloc.fields.geomagnetic`
orbital     e3 along the local vertical outwards, e2 along the orbit normal r×v, e1 = e2×e3, which is along the velocity
            of a circular orbit; it rotates at (0, n, 0) against eci
body        axes of the satellite
ned         north, east, down at a place, geodetic, see :func:`magloc.fields.geomagnetic.R_ned_from_ecef`
==========  ======================================================================================================

Quaternions are Hamilton's, scalar part first, in files and in arrays called ``q``. They transform components from body
axes to the named frame: ``v_orbital = q∘v_body∘q*``. Rotations are scipy's, whose ``as_quat`` has the scalar last;
:mod:`adcs.quaternion` converts.

Matrices are called ``R_to_from``: ``v_to = R_to_from @ v_from``. All data are offline: the Earth's rotation uses UTC
instead of UT1 and no polar motion. The error is up to 0.9 s or 0.004° of longitude, about 400 m on the ground, where
the geomagnetic field changes by about 1 nT.
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
    """Return instants of time, UTC to the microsecond, from dates and seconds after them.

    Parameters
    ----------
    date : datetime, datetime64 or str, or an array of them, shape (...)
        Dates; a datetime without a time zone is UTC, a string is ISO 8601.
    time_s : array_like, shape (n,), optional
        Seconds after each date; a number keeps the shape of the dates.

    Returns
    -------
    ndarray of datetime64, shape (...) or (..., n)
        Instants in microseconds.

    Raises
    ------
    ValueError
        A date has another type or is missing, or a time is not finite.

    Examples
    --------
    >>> from adcs import frames
    >>> frames.instants("2026-11-21", [0.0, 0.5]).tolist()[1].isoformat()
    '2026-11-21T00:00:00.500000'
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
    """Return Julian dates as days and fractions of a day: two arrays of the shape of ``utc``.

    Days of UTC have 86,400 s: an instant in a leap second does not exist in datetime64.
    """
    # The added half day makes the fraction count from midnight.
    days, rest = np.divmod((utc - _J2000).astype(np.int64) + 43_200_000_000, 86_400_000_000)
    return _JD_J2000 - 0.5 + days, rest / 86_400e6


def of_julian_year(year: float) -> Instants:
    """Return the instant, UTC, of a Julian year such as 2026.9, shape ()."""
    return instants(_J2000, (year - 2000.0) * 365.25 * DAY_S)


def pyerfa() -> ModuleType:
    """Return the module erfa, the routines of the IAU, which is imported at the first use."""
    with of_extra("satellites", "the rotation of the Earth"):
        import erfa
    return erfa


def terrestrial_dates(utc: Instants) -> tuple[FloatArray, FloatArray]:
    """Return Julian dates of Terrestrial Time, 69.184 s ahead of UTC since 2017, as :func:`julian_dates`."""
    erfa = pyerfa()
    with warnings.catch_warnings():
        # Outside of the table of leap seconds, and before UTC began in 1960, erfa uses the nearest entry.
        warnings.simplefilter("ignore", erfa.ErfaWarning)
        day, fraction = erfa.utctai(*julian_dates(utc))
    return erfa.taitt(day, fraction)


def R_ecef_from_eci(utc: Instants) -> FloatArray:
    """Return the rotation of the Earth: IAU 2000B precession and nutation, UT1 = UTC; (...) -> (..., 3, 3)."""
    return np.asarray(pyerfa().c2t00b(*terrestrial_dates(utc), *julian_dates(utc), 0.0, 0.0), dtype=np.float64)


def R_eci_from_teme(utc: Instants) -> FloatArray:
    """Return the axes of TEME in eci, by ecef and the mean sidereal time of 1982; (...) -> (..., 3, 3)."""
    return R_ecef_from_eci(utc).mT @ rotation_about_z(pyerfa().gmst82(*julian_dates(utc)))


def rotation_about_z(angle_rad: ArrayLike) -> FloatArray:
    """Return matrices of components in axes that are turned about z by angles; (...) -> (..., 3, 3)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack(
        [np.stack([c, s, zero], axis=-1), np.stack([-s, c, zero], axis=-1), np.stack([zero, zero, one], axis=-1)],
        axis=-2,
    )


def R_orbital_from_eci(position_eci_m: ArrayLike, velocity_eci_m_s: ArrayLike) -> FloatArray:
    """Return rotation matrices, orbital from eci, whose rows are e1, e2, e3 of the orbital frame.

    Parameters
    ----------
    position_eci_m : array_like, shape (..., 3)
        Position from the Earth's centre [m].
    velocity_eci_m_s : array_like, shape (..., 3)
        Velocity [m/s].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Rotation matrices.

    Examples
    --------
    >>> from adcs import frames
    >>> frames.R_orbital_from_eci([7e6, 0.0, 0.0], [0.0, 7.5e3, 0.0])[2]
    array([1., 0., 0.])
    """
    position = np.asarray(position_eci_m, dtype=np.float64)
    e3 = position / np.linalg.norm(position, axis=-1, keepdims=True)
    momentum = np.cross(position, np.asarray(velocity_eci_m_s, dtype=np.float64))
    e2 = momentum / np.linalg.norm(momentum, axis=-1, keepdims=True)
    return np.stack([np.cross(e2, e3), e2, e3], axis=-2)


def orbital_rate(position_eci_m: ArrayLike, velocity_eci_m_s: ArrayLike) -> FloatArray:
    r"""Return the rate n = \|r×v\|/r² of the orbital frame about e2 [rad/s]; shapes (..., 3) -> (...).

    Forces across the orbit's plane also turn the frame about e3. That rate, about 1e-9 rad/s on a low orbit, is
    neglected.
    """
    position = np.asarray(position_eci_m, dtype=np.float64)
    momentum = np.cross(position, np.asarray(velocity_eci_m_s, dtype=np.float64))
    return np.linalg.norm(momentum, axis=-1) / np.sum(position * position, axis=-1)


def turned(rotation: ArrayLike, vectors: ArrayLike) -> FloatArray:
    """Rotate vectors (..., 3), each by its rotation matrix (..., 3, 3)."""
    return (np.asarray(rotation, dtype=np.float64) @ np.asarray(vectors, dtype=np.float64)[..., None])[..., 0]
