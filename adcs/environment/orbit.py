"""Orbits around the Earth: a circle, or published two-line elements.

Any class with the methods of :class:`Orbit` is an orbit. Positions and velocities are in the inertial frame eci of
:mod:`adcs.frames`.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from adcs.frames import DAY_S, Dates, Instants, R_eci_from_teme, instants, julian_dates, pyerfa, turned
from arrays.io.errors import check_positive, of_extra
from arrays.typing import FloatArray

MU_M3_S2 = 3.986004418e14
"""Gravitational parameter of the Earth, WGS-84."""
EARTH_RADIUS_M = 6_378_137.0
"""Equatorial radius, WGS-84; altitudes of circular orbits are measured from it."""
WARNED_DAYS, REFUSED_DAYS = 7.0, 30.0
"""Ages of two-line elements from which on there is a warning, and from which on they are refused."""
_LOG = logging.getLogger(__name__)
_FIRST_M, _PER_DAY_M = 1e3, 2e3  # published errors of two-line elements of low orbits: 1 km, and 1 to 3 km a day
_DRAG_SHARE = 0.2  # relative error of models of the atmosphere
_SURFACE_FIELD_T = 45e-6
_DECAYED = 6  # SGP4's error code


class Orbit(Protocol):
    """Interface of an orbit: position and velocity over time."""

    def __hash__(self) -> int: ...

    @property
    def epoch(self) -> np.datetime64:
        """UTC of the elements."""
        ...

    def position_velocity_eci(self, utc: Instants) -> tuple[FloatArray, FloatArray]:
        """Return position [m] and velocity [m/s] in eci, two arrays (..., 3), at instants (...)."""
        ...


@dataclass(frozen=True)
class CircularOrbit:
    """Circular orbit around a point mass, in a fixed plane.

    Attributes
    ----------
    altitude_m : float
        Altitude above the equatorial radius, 6378.137 km.
    inclination_rad, node_rad : float
        Inclination to the equator of J2000, and right ascension of the ascending node.
    epoch : datetime64
        UTC at which the satellite is at ``latitude_argument_rad``.
    latitude_argument_rad : float
        Angle from the ascending node at the epoch.

    Raises
    ------
    ValueError
        The altitude is not positive, or a number is not finite.
    """

    altitude_m: float
    inclination_rad: float
    node_rad: float
    epoch: np.datetime64
    latitude_argument_rad: float = 0.0

    def __post_init__(self) -> None:
        check_positive(altitude_m=self.altitude_m)
        for name in ("inclination_rad", "node_rad", "latitude_argument_rad"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"Input {name} must be finite; instead received {getattr(self, name)}.")
        object.__setattr__(self, "epoch", instants(self.epoch)[()])

    @property
    def radius_m(self) -> float:
        """Distance from the Earth's centre."""
        return EARTH_RADIUS_M + self.altitude_m

    @property
    def rate_rad_s(self) -> float:
        """Mean motion n = √(μ/r³)."""
        return math.sqrt(MU_M3_S2 / self.radius_m**3)

    @property
    def period_s(self) -> float:
        """Time of one revolution."""
        return 2.0 * math.pi / self.rate_rad_s

    def position_velocity_eci(self, utc: Instants) -> tuple[FloatArray, FloatArray]:
        """Return position [m] and velocity [m/s] in eci; instants (...) -> two arrays (..., 3)."""
        seconds = (instants(utc) - self.epoch).astype(np.float64) / 1e6
        u = self.latitude_argument_rad + self.rate_rad_s * seconds
        cos_node, sin_node = math.cos(self.node_rad), math.sin(self.node_rad)
        cos_i, sin_i = math.cos(self.inclination_rad), math.sin(self.inclination_rad)
        to_node = np.array([cos_node, sin_node, 0.0])
        across = np.array([-sin_node * cos_i, cos_node * cos_i, sin_i])
        cosine, sine = np.cos(u)[..., None], np.sin(u)[..., None]
        position = self.radius_m * (cosine * to_node + sine * across)
        velocity = self.radius_m * self.rate_rad_s * (cosine * across - sine * to_node)
        return position, velocity


def circular_orbit(
    *,
    altitude_m: float,
    inclination_deg: float,
    epoch: Dates,
    node_deg: float | None = None,
    local_time_h: float | None = None,
    latitude_argument_deg: float = 0.0,
) -> CircularOrbit:
    """Return a circular orbit around a point mass.

    Parameters
    ----------
    altitude_m : float
        Altitude above the equatorial radius, 6378.137 km.
    inclination_deg : float
        Inclination to the equator of J2000.
    epoch : datetime, datetime64 or str
        UTC at which the satellite is at ``latitude_argument_deg`` from the ascending node.
    node_deg, local_time_h : float, optional
        Right ascension of the ascending node, by default 0; or the mean solar time at the node at the epoch.
    latitude_argument_deg : float
        Angle from the ascending node to the satellite at the epoch.

    Returns
    -------
    CircularOrbit
        Orbit that :class:`adcs.Satellite` takes.

    Raises
    ------
    ValueError
        The node is given twice, the altitude is not positive, or a number is not finite.

    Examples
    --------
    >>> import adcs
    >>> orbit = adcs.circular_orbit(
    ...     altitude_m=550e3, inclination_deg=97.6, epoch="2026-11-21"
    ... )
    >>> round(orbit.radius_m / 1e3, 1)
    6928.1
    """
    if node_deg is not None and local_time_h is not None:
        raise ValueError("Inputs node_deg and local_time_h must not both be given; instead received both.")
    start: np.datetime64 = instants(epoch)[()]  # type: ignore[assignment]
    node = math.radians(node_deg or 0.0) if local_time_h is None else node_of_local_time(local_time_h, start)
    return CircularOrbit(altitude_m, math.radians(inclination_deg), node, start, math.radians(latitude_argument_deg))


def node_of_local_time(local_time_h: float, date: Dates) -> float:
    """Return the right ascension of an ascending node with a mean solar time, LTAN, at a date [rad, 0 to 2π].

    The mean Sun is 12 h minus UT away from Greenwich, whose right ascension is the mean sidereal time.
    ``local_time_h``: local mean solar time at the node [h]. ``date``: UTC.
    """
    day, fraction = julian_dates(instants(date))
    greenwich = float(pyerfa().gmst82(day, fraction))
    since_midnight = float(day + 0.5 + fraction) % 1.0
    return (greenwich + 2.0 * math.pi * (local_time_h / 24.0 - since_midnight)) % (2.0 * math.pi)


class Sgp4Orbit:
    """Orbit of published two-line elements, by SGP4 with WGS-72, the constants of such elements.

    Parameters
    ----------
    line1, line2 : str
        Lines of the elements.
    allow_old_elements : bool
        Accept instants 30 days or more from the epoch.

    Raises
    ------
    ValueError
        A line is malformed, or its checksum is wrong.
    """

    def __init__(self, line1: str, line2: str, *, allow_old_elements: bool = False) -> None:
        with of_extra("satellites", "an orbit of two-line elements"):
            from sgp4.api import Satrec

        for number, line in (("1", line1), ("2", line2)):
            if len(line) < 69 or line[0] != number or line[68] != str(_checksum(line)):
                raise ValueError(
                    f"Input line{number} must be line {number} of two-line elements with a right checksum; "
                    f"instead received {line!r}."
                )
        self._satellite = Satrec.twoline2rv(line1, line2)
        self._allow_old_elements = allow_old_elements
        self._is_told = False

    @property
    def epoch(self) -> np.datetime64:
        """Epoch of the elements, UTC."""
        microseconds = round((self._satellite.jdsatepoch - 2_440_587.5 + self._satellite.jdsatepochF) * 86_400e6)
        return np.datetime64(microseconds, "us")

    def age_days(self, utc: Instants) -> float:
        """Return the longest time of instants (...) from the epoch, before or after it [days]."""
        return float(np.max(np.abs((instants(utc) - self.epoch).astype(np.float64)))) / (1e6 * DAY_S)

    def relative_error(self, utc: Instants) -> float:
        """Return the largest expected error of positions at instants (...), over the distance from the centre.

        The error is 1 km at the epoch, 2 km more each day, and 20 % of the displacement by drag, which grows with the
        square of time. It is at most 2, the diameter of the orbit.
        """
        days = self.age_days(utc)
        error_m = _FIRST_M + _PER_DAY_M * days + _DRAG_SHARE * self._drag_of_a_day_m * days**2
        return min(error_m / self._radius_m, 2.0)

    @property
    def _radius_m(self) -> float:
        """Semi-major axis."""
        return float(1e3 * self._satellite.a * self._satellite.radiusearthkm)

    @cached_property
    def _drag_of_a_day_m(self) -> float:
        """Displacement of the satellite by drag in the first day."""
        from sgp4.api import WGS72, Satrec

        own, without = self._satellite, Satrec()
        since_1949 = own.jdsatepoch - 2_433_281.5 + own.jdsatepochF
        shape = own.ecco, own.argpo, own.inclo, own.mo, own.no_kozai, own.nodeo
        without.sgp4init(WGS72, "i", 0, since_1949, 0.0, own.ndot, own.nddot, *shape)
        (_, here, _), (_, there, _) = (one.sgp4_tsince(DAY_S / 60.0) for one in (own, without))
        moved_m = 1e3 * math.dist(here, there)
        return moved_m if math.isfinite(moved_m) else math.inf  # it decays within that day

    def _age(self, utc: Instants) -> str:
        """Return the age and its effects in words."""
        relative = self.relative_error(utc)
        field_T = min(3.0 * relative, 2.0) * _SURFACE_FIELD_T * (EARTH_RADIUS_M / self._radius_m) ** 3
        values = 1e-3 * relative * self._radius_m, 1e9 * field_T, math.degrees(min(2.0 * relative, math.pi))
        error_km, field_nT, angle_deg = (f"{float(f'{value:.2g}'):g}" for value in values)
        return (
            f"{self.age_days(utc):.1f} days from the epoch {np.datetime_as_string(self.epoch, 's')} of the two-line "
            f"elements, where positions may be wrong by {error_km} km, the field by {field_nT} nT and an attitude from "
            f"it by {angle_deg}°"
        )

    def age_warning(self, utc: Instants) -> str:
        """Return a sentence on elements a week or more from some instants (...), or an empty one."""
        if self.age_days(utc) < WARNED_DAYS:
            return ""
        return f"found instants {self._age(utc)}: use elements of that time"

    def refuse_old(self, utc: Instants) -> None:
        """Raise ValueError if one of some instants (...) is 30 days or more from the epoch, unless that is allowed."""
        if self.age_days(utc) >= REFUSED_DAYS and not self._allow_old_elements:
            raise ValueError(
                f"Input utc must be less than {REFUSED_DAYS:g} days from the epoch of the elements; instead received "
                f"instants {self._age(utc)}. Use elements of that time, or set allow_old_elements."
            )

    def position_velocity_teme(self, utc: Instants) -> tuple[FloatArray, FloatArray]:
        """Return position [m] and velocity [m/s] in teme; instants (...) -> two arrays (..., 3).

        Raises
        ------
        ValueError
            An instant is 30 days or more from the epoch and that is not allowed, or SGP4 fails, as for a decayed
            satellite.
        """
        self.refuse_old(utc)
        if not self._is_told and (text := self.age_warning(utc)):
            self._is_told = True
            _LOG.warning(text)
        day, fraction = julian_dates(utc)
        errors, position, velocity = self._satellite.sgp4_array(np.ravel(day), np.ravel(fraction))
        if errors.any():
            first = int(np.flatnonzero(errors)[0])
            raise ValueError(
                f"Input utc must be instants that SGP4 reaches; instead received {np.ravel(utc)[first]}: "
                + ("the satellite has decayed by then." if errors[first] == _DECAYED else "no orbit remains by then.")
            )
        shape = (*np.shape(utc), 3)
        return 1e3 * position.reshape(shape), 1e3 * velocity.reshape(shape)

    def position_velocity_eci(self, utc: Instants) -> tuple[FloatArray, FloatArray]:
        """Return position [m] and velocity [m/s] in eci, as :meth:`position_velocity_teme`."""
        utc = instants(utc)
        position, velocity = self.position_velocity_teme(utc)
        rotation = R_eci_from_teme(utc)
        return turned(rotation, position), turned(rotation, velocity)


def _checksum(line: str) -> int:
    """Return the sum of the digits before the last place, modulo 10; a minus counts as 1."""
    return sum(int(c) if c.isdigit() else c == "-" for c in line[:68]) % 10
