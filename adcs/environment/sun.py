"""Sun as seen from an orbit around the Earth: its position, and its part that the Earth hides."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.constants import speed_of_light

from adcs.environment.orbit import EARTH_RADIUS_M
from adcs.frames import DAY_S, Instants, pyerfa, terrestrial_dates
from arrays.typing import FloatArray

SUN_RADIUS_M = 695_700e3
"""Nominal solar radius, IAU 2015."""
ASTRONOMICAL_UNIT_M = 149_597_870_700.0
_AU_DAY_M_S = ASTRONOMICAL_UNIT_M / DAY_S
_SPEED_OF_LIGHT_AU_DAY = speed_of_light / _AU_DAY_M_S


def sun_position_eci(utc: Instants) -> FloatArray:
    """Return the apparent position of the Sun from the Earth's centre in eci [m], with annual aberration.

    Shapes ``utc`` (...) -> (..., 3). The accuracy is some arc seconds from 1900 to 2100 (erfa's series of the Earth's
    orbit, with TT instead of TDB).
    """
    heliocentric, barycentric = pyerfa().epv00(*terrestrial_dates(utc))
    distance = np.linalg.norm(heliocentric["p"], axis=-1)
    direction = -heliocentric["p"] / distance[..., None]
    velocity = barycentric["v"] / _SPEED_OF_LIGHT_AU_DAY
    contraction = np.sqrt(1.0 - np.sum(velocity * velocity, axis=-1))
    apparent: FloatArray = pyerfa().ab(direction, velocity, distance, contraction)
    return ASTRONOMICAL_UNIT_M * distance[..., None] * apparent


def earth_velocity_m_s(utc: Instants) -> FloatArray:
    """Return the velocity (..., 3) of the Earth's centre against the solar system's, in eci, at instants (...)."""
    velocity: FloatArray = _AU_DAY_M_S * pyerfa().epv00(*terrestrial_dates(utc))[1]["v"]
    return velocity


def earth_radius_rad(position_eci_m: ArrayLike) -> FloatArray:
    """Return the angular radius of the Earth (...) [rad] at positions (..., 3); π/2 on the ground."""
    return np.arcsin(np.minimum(EARTH_RADIUS_M / np.linalg.norm(position_eci_m, axis=-1), 1.0))


def illuminated_fraction(position_eci_m: ArrayLike, sun_position_eci_m: ArrayLike) -> FloatArray:
    r"""Return the share of the Sun's disc that the Earth, a sphere without an atmosphere, does not hide.

    On the sky both are circles with the angular radii a (Sun) and b (Earth) and the distance c. The hidden part is the
    area that they share, over :math:`\pi a^2`.
    Shapes ``sun_position_eci_m``, ``position_eci_m`` (..., 3) -> (...). The satellite is outside of the Earth. Returns
    1 in sunlight, 0 in the umbra, values between in the penumbra.

    References
    ----------
    O. Montenbruck, E. Gill, Satellite Orbits, 3.4.2.
    """
    position = np.asarray(position_eci_m, dtype=np.float64)
    to_sun = np.asarray(sun_position_eci_m, dtype=np.float64) - position
    sun_distance, radius = np.linalg.norm(to_sun, axis=-1), np.linalg.norm(position, axis=-1)
    a = np.arcsin(np.minimum(SUN_RADIUS_M / sun_distance, 1.0))
    b = earth_radius_rad(position)
    c = np.arccos(np.clip(-np.sum(position * to_sun, axis=-1) / (radius * sun_distance), -1.0, 1.0))
    # Distance of the common chord from the Sun's centre, clipped where the circles do not cross.
    with np.errstate(divide="ignore", invalid="ignore"):
        x = np.clip((c * c + a * a - b * b) / (2.0 * c), -a, a)
    y = np.sqrt(np.clip(a * a - x * x, 0.0, None))
    lens = a * a * np.arccos(x / a) + b * b * np.arcsin(np.clip(y / b, 0.0, 1.0)) - c * y
    partly = 1.0 - lens / (np.pi * a * a)
    whole = np.where(c >= a + b, 1.0, np.where(c <= b - a, 0.0, 1.0 - (b / a) ** 2))
    return np.where((np.abs(a - b) < c) & (c < a + b), partly, whole)
