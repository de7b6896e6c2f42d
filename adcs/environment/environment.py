r"""Environment of a satellite along its orbit: field, Sun, eclipse and gravity, in the frames of :mod:`adcs.frames`.

Field and Sun are computed at knots 30 s apart. Cubic splines interpolate their components in the orbital frame, where
they change slowly. On a low orbit the errors stay below 0.05 nT and 1e-7 rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs.environment.orbit import MU_M3_S2, Orbit
from adcs.environment.sun import illuminated_fraction, sun_position_eci
from adcs.frames import Dates, Instants, R_ecef_from_eci, R_orbital_from_eci, instants, orbital_rate, turned
from arrays.typing import BoolArray, FloatArray
from magloc.fields.geomagnetic import Model, field_ecef

KNOTS_S = 30.0


@dataclass(frozen=True, eq=False)
class Environment:
    """Environment of one or several runs (...) at n instants each."""

    utc: Instants  # (..., n)
    time_s: FloatArray  # (n,): since the start of the run
    position_eci_m: FloatArray  # (..., n, 3)
    velocity_eci_m_s: FloatArray  # (..., n, 3)
    b_orbital_T: FloatArray  # (..., n, 3): geomagnetic field
    sun_orbital: FloatArray  # (..., n, 3): unit vector to the Sun, also in eclipse
    illuminated: FloatArray  # (..., n): visible part of the Sun's disc
    orbital_rate_rad_s: FloatArray  # (..., n): n, rate of the orbital frame about its e2
    gravity_s2: FloatArray  # (..., n): μ/r³, equal to n² on a circle

    @property
    def sunlit(self) -> BoolArray:
        """Mask (..., n) of the instants with at least half of the Sun's disc visible."""
        return np.asarray(self.illuminated >= 0.5)

    @property
    def R_orbital_from_eci(self) -> FloatArray:
        """Rotation of the orbital frame, shape (..., n, 3, 3)."""
        return R_orbital_from_eci(self.position_eci_m, self.velocity_eci_m_s)

    @property
    def separation_rad(self) -> FloatArray:
        """Angle between the lines of Sun and field, 0 to π/2, shape (..., n)."""
        across = np.linalg.norm(np.cross(self.b_orbital_T, self.sun_orbital), axis=-1)
        return np.arctan2(across, np.abs(np.sum(self.b_orbital_T * self.sun_orbital, axis=-1)))


def field_eci(position_eci_m: ArrayLike, utc: Instants, model: Model = "IGRF-14") -> FloatArray:
    """Return the geomagnetic field in eci [T] at positions (..., 3) and instants (...)."""
    rotation = R_ecef_from_eci(utc)
    return turned(rotation.mT, field_ecef(turned(rotation, position_eci_m), utc, model))


def environment(orbit: Orbit, start: Dates, time_s: ArrayLike, *, model: Model = "IGRF-14") -> Environment:
    """Return the environment along an orbit.

    ``start`` (...): start of each run, UTC. ``time_s`` (n,): ascending times since the start. ``model``: model of the
    geomagnetic field, "IGRF-14" (1900 to 2030) or "WMM2025".
    """
    seconds = np.atleast_1d(np.asarray(time_s, dtype=np.float64))
    if seconds.ndim != 1 or seconds.size == 0 or not np.isfinite(seconds).all() or (np.diff(seconds) <= 0.0).any():
        raise ValueError(f"Input time_s must be finite numbers that ascend; instead received shape {seconds.shape}.")
    utc = instants(start, seconds)
    position, velocity = orbit.position_velocity_eci(utc)
    knots_s = _knots(seconds)
    at_knots = instants(start, knots_s)
    knots_position, knots_velocity = orbit.position_velocity_eci(at_knots)
    to_orbital = R_orbital_from_eci(knots_position, knots_velocity)
    field_knots = turned(to_orbital, field_eci(knots_position, at_knots, model))
    sun_knots = turned(to_orbital, sun_position_eci(at_knots) - knots_position)
    sun_orbital = _at(seconds, knots_s, sun_knots)
    from_centre = np.linalg.norm(position, axis=-1)[..., None] * np.array([0.0, 0.0, 1.0])
    return Environment(
        utc=utc,
        time_s=seconds,
        position_eci_m=position,
        velocity_eci_m_s=velocity,
        b_orbital_T=_at(seconds, knots_s, field_knots),
        sun_orbital=sun_orbital / np.linalg.norm(sun_orbital, axis=-1, keepdims=True),
        illuminated=illuminated_fraction(from_centre, from_centre + sun_orbital),
        orbital_rate_rad_s=orbital_rate(position, velocity),
        gravity_s2=MU_M3_S2 / np.linalg.norm(position, axis=-1) ** 3,
    )


def _knots(seconds: FloatArray) -> FloatArray:
    """Return the times at which field and Sun are computed: knots, or the instants themselves if they are few.

    No knot is outside of the instants, because a run may begin and end with the validity of the field model.
    """
    n_knots = max(4, 1 + math.ceil((seconds[-1] - seconds[0]) / KNOTS_S))
    return seconds if len(seconds) <= n_knots else np.linspace(seconds[0], seconds[-1], n_knots)


def _at(seconds: FloatArray, knots_s: FloatArray, values: FloatArray) -> FloatArray:
    """Interpolate values (..., knots, 3) at the instants."""
    from scipy.interpolate import CubicSpline

    if knots_s is seconds:
        return values
    return CubicSpline(knots_s, values, axis=-2)(seconds)
