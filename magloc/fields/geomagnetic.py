r"""Magnetic field of the Earth by IGRF-14 and WMM2025, and its gradient across an array.

Both models are a potential of internal sources, in spherical harmonics of the geocentric radius r, colatitude θ and
longitude φ, with a = 6371.2 km, Schmidt semi-normalised Legendre functions P and Gauss coefficients g, h [T]:

    (1)  V = a Σ_n (a/r)^(n+1) Σ_m (g_nm cos mφ + h_nm sin mφ) P_nm(cos θ),   B = -grad V
    (2)  B_r =  Σ (n+1) (a/r)^(n+2) (g cos mφ + h sin mφ) P
    (3)  B_θ = -Σ (a/r)^(n+2) (g cos mφ + h sin mφ) dP/dθ
    (4)  B_φ =  Σ (a/r)^(n+2) m (g sin mφ - h cos mφ) P / sin θ

Between its nodes in time (every five years) a model's coefficients are linear in the decimal year. So every point of a
batch may have its own time at no extra cost. (ppigrf itself counts days, not decimal years. With a leap year among the
five, fields between nodes differ by up to 0.75 days of secular variation, about 0.2 nT.) The degree n = 1 alone is the
field of a dipole at the Earth's centre, which :mod:`magloc.fields.dipole` computes from its moment.

Coefficients come from the packages ppigrf (IGRF-14) and wmm-calculator (WMM2025), Legendre functions from ppigrf, and
geodetic positions (WGS-84) from pymap3d. Nothing is downloaded. The packages are imported when a field is first
computed.

Frames: ECEF has its origin in the Earth's centre, z through the north pole and x through longitude 0. NED is north,
east, down at a place. ENU (x east, y north, z up) is the frame of an array whose place is given. Latitudes, longitudes
and heights are geodetic (WGS-84 ellipsoid), unless the name says geocentric.

References
----------
IAGA, International Geomagnetic Reference Field, 14th generation, doi:10.5281/zenodo.14012302.
NCEI and BGS, The US/UK World Magnetic Model for 2025-2030: technical report, doi:10.25923/ttet-r767.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import _vectors, of_extra
from arrays.typing import FloatArray
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.fields.gauss_coefficients import FIELD
from magloc.fields.gauss_coefficients import MODELS as MODELS
from magloc.fields.gauss_coefficients import Coefficients as Coefficients
from magloc.fields.gauss_coefficients import Model as Model
from magloc.fields.gauss_coefficients import coefficients as coefficients

Dates = ArrayLike | datetime.date | Sequence[datetime.date]
REFERENCE_RADIUS_M = 6_371_200.0
"""Reference radius a of equation (1) in both models."""
CORE_RADIUS_M = 3_485_000.0
"""Radius of the Earth's core, which contains the sources. Equation (1) holds only outside of it."""
GRADIENT_STEP_M = 100.0
"""Half the base of the central differences. At the surface, truncation and rounding stay below 1e-8."""
_POLE_DEG = 1e-9
_CHUNK = 8192


def decimal_year(date: Dates) -> FloatArray:
    """Return the decimal years of dates: the year plus the fraction of it that has passed.

    Parameters
    ----------
    date : date, datetime, datetime64 or float, or an array or sequence of one of them, shape (...)
        A date means its midnight. A datetime without a time zone is UTC. A number is a decimal year.

    Returns
    -------
    ndarray, shape (...)

    Raises
    ------
    ValueError
        If a date is none of these, or missing.
    """
    array = np.asarray(date)
    if array.dtype == object and all(isinstance(one, datetime.date) for one in array.flat):
        array = np.array([_utc(one) for one in array.flat], dtype="datetime64[us]").reshape(array.shape)
    if array.dtype.kind == "M":
        instant = array.astype("datetime64[us]")
        year = instant.astype("datetime64[Y]")
        start, end = year.astype("datetime64[us]"), (year + 1).astype("datetime64[us]")
        # NaT becomes NaN, which raises an error below.
        passed = (instant - start) / (end - start)
        array = np.where(np.isnat(instant), np.nan, 1970.0 + year.astype(np.int64) + passed)
    if array.dtype.kind not in "fiu":
        raise ValueError(f"Input date must be dates, datetime64 or decimal years; instead received {date!r}.")
    return _finite("date", array)


def _utc(date: datetime.date) -> datetime.date:
    """Return a date or datetime in UTC without a time zone; NumPy warns about those with one."""
    if isinstance(date, datetime.datetime) and date.tzinfo is not None:
        return date.astimezone(datetime.UTC).replace(tzinfo=None)
    return date


def field_ned(
    latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike, date: Dates, model: Model = "IGRF-14"
) -> FloatArray:
    """Return the field at geodetic positions, in the north-east-down frame of each.

    Parameters
    ----------
    latitude_deg, longitude_deg : array_like, shape (...)
        Geodetic latitude and longitude, WGS-84 [°].
    height_m : array_like, shape (...)
        Height above the ellipsoid [m].
    date : date, datetime, datetime64 or decimal year, shape (...)
        Date as in :func:`decimal_year`. All four arguments broadcast, so every point may have its own time.
    model : str or Coefficients
        "IGRF-14" or "WMM2025".

    Returns
    -------
    ndarray, shape (..., 3)
        North, east, down [T]. At a pole, north is defined by the meridian of the given longitude.

    Raises
    ------
    ValueError
        If an input is not finite, a latitude is beyond ±90°, a date is outside the model's validity, a point lies in
        the Earth's core, there is no such model, or the shapes do not broadcast.
    """
    b_ecef = field_ecef(ecef_from_geodetic(latitude_deg, longitude_deg, height_m), date, model)
    return _turned(R_ned_from_ecef(latitude_deg, longitude_deg), b_ecef)


def field_enu(
    latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike, date: Dates, model: Model = "IGRF-14"
) -> FloatArray:
    """Return the field at geodetic positions in the east-north-up frame: the ambient field of an array there.

    Parameters
    ----------
    latitude_deg, longitude_deg, height_m, date, model
        As in :func:`field_ned`.

    Returns
    -------
    ndarray, shape (..., 3)
        East, north, up [T].

    Raises
    ------
    ValueError
        As :func:`field_ned`.
    """
    return field_ned(latitude_deg, longitude_deg, height_m, date, model) @ _ENU_FROM_NED.T


def gradient_enu(
    latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike, date: Dates, model: Model = "IGRF-14"
) -> FloatArray:
    """Return the gradient tensor G[i, j] = dB_i/dx_j at geodetic positions, in the east-north-up frame of each.

    At points x [m] of an array at a place, the ambient field is ``field_enu(...) + x @ gradient_enu(...).T``. The
    tensor is the central difference of the field along the three fixed axes of the place. (The Earth's curvature turns
    the axes of neighbouring places.) It is symmetric and traceless because the field has neither curl nor divergence,
    not by construction.

    Parameters
    ----------
    latitude_deg, longitude_deg, height_m, date, model
        As in :func:`field_ned`.

    Returns
    -------
    ndarray, shape (..., 3, 3)
        Gradient [T/m], some tens of pT/m at the Earth's surface. The crust and the surroundings, which no global model
        contains, may add more.

    Raises
    ------
    ValueError
        As :func:`field_ned`.
    """
    place = ecef_from_geodetic(latitude_deg, longitude_deg, height_m)
    R_enu_from_ecef = _ENU_FROM_NED @ R_ned_from_ecef(latitude_deg, longitude_deg)
    steps = GRADIENT_STEP_M * R_enu_from_ecef
    year = decimal_year(date)[..., None]
    ahead, behind = (field_ecef(place[..., None, :] + s, year, model) for s in (steps, -steps))
    # Row j is the change of the field, in ECEF, along axis j of the place.
    change = (ahead - behind) / (2 * GRADIENT_STEP_M)
    return R_enu_from_ecef @ change.mT


def field_geocentric_ned(
    radius_m: ArrayLike,
    geocentric_latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    date: Dates,
    model: Model = "IGRF-14",
) -> FloatArray:
    """Return the field at geocentric positions, in the geocentric north-east-down frame: equations (2) to (4).

    Parameters
    ----------
    radius_m : array_like, shape (...)
        Distance from the Earth's centre [m].
    geocentric_latitude_deg, longitude_deg : array_like, shape (...)
        Angle to the equatorial plane, and longitude [°].
    date : date, datetime, datetime64 or decimal year, shape (...)
        Date as in :func:`decimal_year`; all four arguments broadcast.
    model : str or Coefficients
        "IGRF-14" or "WMM2025".

    Returns
    -------
    ndarray, shape (..., 3)
        North, east, down [T]; down is towards the Earth's centre.

    Raises
    ------
    ValueError
        As :func:`field_ned`.
    """
    radius = _finite("radius_m", radius_m)
    latitude = _latitude("geocentric_latitude_deg", geocentric_latitude_deg)
    longitude = _finite("longitude_deg", longitude_deg)
    if np.any(radius < CORE_RADIUS_M):
        raise ValueError(
            f"Inputs must lie outside the Earth's core, {CORE_RADIUS_M / 1e3:.0f} km from its centre; "
            f"instead received a point {radius.min() / 1e3} km from it."
        )
    points = np.broadcast_arrays(radius, latitude, longitude, decimal_year(date))
    flat = [np.ravel(one) for one in points]
    table = coefficients(model)
    field = np.empty((flat[0].size, 3))
    # Each point needs a hundred harmonics at once; chunks limit the memory to a few tens of MB.
    for start in range(0, len(field), _CHUNK):
        piece = slice(start, start + _CHUNK)
        field[piece] = _harmonic_sum(table, *(one[piece] for one in flat))
    return field.reshape(*points[0].shape, 3)


def _harmonic_sum(
    table: Coefficients, radius_m: FloatArray, latitude_deg: FloatArray, longitude_deg: FloatArray, year: FloatArray
) -> FloatArray:
    """Return equations (2) to (4) as north, east, down (N, 3) [T]; all arguments are (N,)."""
    with of_extra("geo", FIELD):
        from ppigrf.ppigrf import get_legendre

    # (4) divides by sin θ. Every P with m > 0 has that factor, so 0.1 mm from the pole is far enough.
    colatitude = np.clip(90.0 - latitude_deg, _POLE_DEG, 180.0 - _POLE_DEG)
    n, m = table.degree, table.order
    P, dP = get_legendre(colatitude, list(zip(n.tolist(), m.tolist(), strict=True)))
    g, h = table.at(year)
    power = (REFERENCE_RADIUS_M / radius_m)[:, None] ** (n + 2)
    angle = np.radians(longitude_deg)[:, None] * m
    cosine, sine = np.cos(angle), np.sin(angle)
    wave = power * (g * cosine + h * sine)
    radial = np.vecdot((n + 1) * wave, P)
    south = -np.vecdot(wave, dP)
    east = np.vecdot(power * m * (g * sine - h * cosine), P) / np.sin(np.radians(colatitude))
    return np.stack([-south, east, -radial], axis=-1)


def field_ecef(position_ecef_m: ArrayLike, date: Dates, model: Model = "IGRF-14") -> FloatArray:
    """Return the field at Cartesian positions, in the Earth-centred Earth-fixed frame.

    Parameters
    ----------
    position_ecef_m : array_like, shape (..., 3)
        Positions in ECEF [m].
    date : date, datetime, datetime64 or decimal year, shape (...)
        Date as in :func:`decimal_year`; it broadcasts against the leading axes of the positions.
    model : str or Coefficients
        "IGRF-14" or "WMM2025".

    Returns
    -------
    ndarray, shape (..., 3)
        Field in ECEF [T].

    Raises
    ------
    ValueError
        As :func:`field_ned`, or if a position does not have three components.
    """
    position = _vectors("position_ecef_m", _finite("position_ecef_m", position_ecef_m))
    x, y, z = np.moveaxis(position, -1, 0)
    latitude, longitude = np.degrees(np.arctan2(z, np.hypot(x, y))), np.degrees(np.arctan2(y, x))
    b_ned = field_geocentric_ned(np.linalg.norm(position, axis=-1), latitude, longitude, date, model)
    return _turned(R_ned_from_ecef(latitude, longitude).mT, b_ned)


def tilted_dipole_ecef(date: Dates, model: Model = "IGRF-14") -> FloatArray:
    """Moment of the dipole at the Earth's centre whose field is the degree n = 1 of a model: 4π/µ0 a³ (g11, h11, g10).

    Its field is ``magloc.fields.dipole.field(position_ecef_m, 0, moment)`` with the origin as the source.

    Parameters
    ----------
    date : date, datetime, datetime64 or decimal year, shape (...)
        As in :func:`decimal_year`.
    model : str or Coefficients
        "IGRF-14" or "WMM2025".

    Returns
    -------
    ndarray, shape (..., 3)
        ECEF [A·m²]; it points south, some 9.2° from the axis in 2025.

    Raises
    ------
    ValueError
        If a date is outside the model's validity, or there is no such model.
    """
    table = coefficients(model)
    g, h = table.at(decimal_year(date))
    (axial,) = np.flatnonzero((table.degree == 1) & (table.order == 0))
    (across,) = np.flatnonzero((table.degree == 1) & (table.order == 1))
    return REFERENCE_RADIUS_M**3 / MU0_OVER_4PI * np.stack([g[..., across], h[..., across], g[..., axial]], axis=-1)


def ecef_from_geodetic(latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike) -> FloatArray:
    """Return Earth-centred Earth-fixed positions of geodetic positions (WGS-84).

    Parameters
    ----------
    latitude_deg, longitude_deg, height_m : array_like, shape (...)
        Geodetic latitude and longitude [°], height above the ellipsoid [m].

    Returns
    -------
    ndarray, shape (..., 3)
        Positions in ECEF [m].

    Raises
    ------
    ValueError
        If an input is not finite, or a latitude is beyond ±90°.
    """
    with of_extra("geo", "a place on the Earth"):
        from pymap3d import geodetic2ecef

    latitude = _latitude("latitude_deg", latitude_deg)
    longitude, height = _finite("longitude_deg", longitude_deg), _finite("height_m", height_m)
    return np.stack(np.broadcast_arrays(*geodetic2ecef(latitude, longitude, height)), axis=-1)


def R_ned_from_ecef(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> FloatArray:
    """Return rotation matrices whose rows are north, east and down of a place in ECEF.

    Parameters
    ----------
    latitude_deg, longitude_deg : array_like, shape (...)
        A geodetic latitude gives the geodetic frame, a geocentric one the geocentric frame [°].

    Returns
    -------
    ndarray, shape (..., 3, 3)
        ``b_ned = R @ b_ecef``.

    Raises
    ------
    ValueError
        If an input is not finite, or a latitude is beyond ±90°.
    """
    latitude, longitude = np.broadcast_arrays(
        np.radians(_latitude("latitude_deg", latitude_deg)), np.radians(_finite("longitude_deg", longitude_deg))
    )
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    north = np.stack([-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat], axis=-1)
    east = np.stack([-sin_lon, cos_lon, np.zeros_like(latitude)], axis=-1)
    down = np.stack([-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat], axis=-1)
    return np.stack([north, east, down], axis=-2)


_ENU_FROM_NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


def _turned(rotation: FloatArray, vectors: FloatArray) -> FloatArray:
    """Rotate vectors (..., 3), each by its rotation matrix (..., 3, 3)."""
    return (rotation @ vectors[..., None])[..., 0]


def _latitude(name: str, values: ArrayLike) -> FloatArray:
    latitude = _finite(name, values)
    beyond = np.abs(latitude) > 90.0
    if np.any(beyond):
        raise ValueError(f"Input {name} must lie between -90 and 90; instead received {latitude[beyond].flat[0]}.")
    return latitude


def _finite(name: str, values: ArrayLike) -> FloatArray:
    array = np.asarray(values, dtype=np.float64)
    missing = ~np.isfinite(array)
    if np.any(missing):
        raise ValueError(f"Input {name} must be finite; instead received {array[missing].flat[0]}.")
    return array
