r"""Paths of arrays and sources: positions and attitudes as functions of time.

World frame: x east, y north, z up [m]. A course ψ is counted clockwise from north, so that its direction is
(sin ψ, cos ψ, 0). A carrier's own axes are forward, left and up: with the course 90° they are parallel to the world's.

Every path is a frozen dataclass with ``at(time_s) -> Motion``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import jv

from arrays.typing import FloatArray

Vector = tuple[float, float, float]
EAST_RAD = math.pi / 2
_BESSEL_TAIL = 30
_SAME_PLACE_M = 1e-9


@dataclass(frozen=True, eq=False)
class Motion:
    """Positions and velocities at n instants.

    ``course_rad`` (n,): direction of the horizontal velocity, clockwise from north [rad]; at rest, the last
    one.
    """

    position_m: FloatArray  # (n, 3): in the world frame [m]
    velocity_m_s: FloatArray  # (n, 3): its derivative [m/s]
    course_rad: FloatArray


class Path(Protocol):
    """Path of a moving array or source."""

    def at(self, time_s: ArrayLike) -> Motion:
        """Return the motion at instants (n,) [s]."""
        ...


@dataclass(frozen=True)
class Steered:
    r"""Path of constant speed whose course turns steadily, weaves, or both.

    .. math:: ψ(t) = ψ_0 + ω t + a \sin(2π t/T)

    The position is the exact integral: by the Jacobi-Anger expansion :math:`e^{i a \sin θ} = Σ_k J_k(a) e^{ikθ}`, the
    direction is a sum of harmonics, each of which integrates in closed form.

    Attributes
    ----------
    start_m : tuple
        Position at the time 0, world frame [m].
    course_rad : float
        ψ_0.
    speed_m_s : float
        Horizontal speed, not negative.
    turn_rad_s : float
        ω, positive clockwise (to the right).
    weave_rad : float
        a, the amplitude of the course's weaving.
    weave_period_s : float
        T.
    climb_m_s : float
        Vertical velocity, upwards.
    """

    start_m: Vector = (0.0, 0.0, 0.0)
    course_rad: float = EAST_RAD
    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0
    weave_rad: float = 0.0
    weave_period_s: float = 1.0
    climb_m_s: float = 0.0

    def at(self, time_s: ArrayLike) -> Motion:
        """Return the motion at instants (n,) [s]."""
        t = np.asarray(time_s, dtype=np.float64)
        weaving = 2.0 * math.pi / self.weave_period_s
        course = self.course_rad + self.turn_rad_s * t + self.weave_rad * np.sin(weaving * t)
        # J_k(a) falls faster than exponentially once k exceeds a.
        most = math.ceil(abs(self.weave_rad)) + _BESSEL_TAIL if self.weave_rad else 0
        order = np.arange(-most, most + 1)
        rate: FloatArray = self.turn_rad_s + weaving * order.astype(np.float64)
        north_and_east = np.exp(1j * self.course_rad) * (_integral(rate, t) @ jv(order, self.weave_rad))
        velocity = np.stack([np.sin(course), np.cos(course), np.zeros_like(t)], axis=-1) * self.speed_m_s
        velocity[..., 2] = self.climb_m_s
        way = np.stack([north_and_east.imag, north_and_east.real], axis=-1) * self.speed_m_s
        position = np.concatenate([way, (self.climb_m_s * t)[..., None]], axis=-1) + self.start_m
        return Motion(position, velocity, course)


def circle(
    centre_m: Vector, radius_m: float, speed_m_s: float, start_rad: float = 0.0, *, clockwise: bool = True
) -> Steered:
    """Return a horizontal circle.

    ``centre_m``: world frame [m]. ``start_rad``: bearing of the position at the time 0, seen from the centre, clockwise
    from north. ``clockwise``: seen from above.
    """
    x, y, z = centre_m
    start = (x + radius_m * math.sin(start_rad), y + radius_m * math.cos(start_rad), z)
    sense = 1.0 if clockwise else -1.0
    return Steered(start, start_rad + sense * EAST_RAD, speed_m_s, turn_rad_s=sense * speed_m_s / radius_m)


@dataclass(frozen=True)
class Waypoints:
    """Straight lines between points at constant speed, at rest in the last point."""

    points_m: tuple[Vector, ...]  # (k, 3): two at least, each at some distance from the one before, world frame [m]
    speed_m_s: float  # along the path, also where it climbs

    def __post_init__(self) -> None:
        if len(self.points_m) < 2:
            raise ValueError(f"Input points_m must have two points at least; instead received {len(self.points_m)}.")
        lengths = np.linalg.norm(np.diff(np.array(self.points_m), axis=0), axis=1)
        if not (lengths > _SAME_PLACE_M).all():
            same = int((lengths <= _SAME_PLACE_M).argmax())
            raise ValueError(
                f"Input points_m must differ from one to the next; instead received {list(self.points_m[same])} twice."
            )
        if not self.speed_m_s > 0.0:
            raise ValueError(f"Input speed_m_s must be positive; instead received {self.speed_m_s:g}.")

    def at(self, time_s: ArrayLike) -> Motion:
        """Return the motion at instants (n,) [s]; at a corner the velocity belongs to the next leg."""
        points = np.array(self.points_m, dtype=np.float64)
        legs = np.diff(points, axis=0)
        lengths = np.linalg.norm(legs, axis=1)
        ends = np.cumsum(lengths)
        way = self.speed_m_s * np.asarray(time_s, dtype=np.float64)
        leg = np.minimum(np.searchsorted(ends, way, side="right"), len(legs) - 1)
        along = np.minimum(way - (ends - lengths)[leg], lengths[leg])
        direction = legs / lengths[:, None]
        velocity = np.where((way < ends[-1])[:, None], self.speed_m_s * direction[leg], 0.0)
        # A vertical leg has no course: it keeps that of the leg before it; north at the start.
        courses = np.arctan2(legs[:, 0], legs[:, 1])
        horizontal = np.hypot(legs[:, 0], legs[:, 1]) > _SAME_PLACE_M
        last = np.maximum.accumulate(np.where(horizontal, np.arange(len(legs)), -1))
        courses = np.where(last >= 0, courses[last], 0.0)
        return Motion(points[leg] + along[:, None] * direction[leg], velocity, courses[leg])


@dataclass(frozen=True)
class Lawnmower:
    """Parallel lines at constant height and speed, joined by half circles, at rest at the end.

    ``length_m``, ``spacing_m``: length of every line, distance between neighbours.
    """

    start_m: Vector  # start of the first line, world frame [m]
    course_rad: float  # course of the first line; the other lines lie to its right
    length_m: float
    spacing_m: float
    lines: int
    speed_m_s: float

    def __post_init__(self) -> None:
        for name in ("length_m", "spacing_m", "lines", "speed_m_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Input {name} must be positive; instead received {getattr(self, name):g}.")

    def at(self, time_s: ArrayLike) -> Motion:
        """Return the motion at instants (n,) [s]."""
        radius = self.spacing_m / 2.0
        turn = math.pi * radius
        end = self.lines * self.length_m + (self.lines - 1) * turn
        way = self.speed_m_s * np.asarray(time_s, dtype=np.float64)
        s = np.clip(way, 0.0, end)
        line = np.minimum(s // (self.length_m + turn), self.lines - 1)
        beyond = s - line * (self.length_m + turn)
        angle = np.maximum(beyond - self.length_m, 0.0) / radius
        outward = np.where(line % 2 == 0, 1.0, -1.0)
        # Along the first course and to its right; odd lines run backwards and turn to the left.
        forward = np.minimum(beyond, self.length_m)
        along = np.where(outward > 0.0, forward, self.length_m - forward) + outward * radius * np.sin(angle)
        across = line * self.spacing_m + radius * (1.0 - np.cos(angle))
        sine, cosine = math.sin(self.course_rad), math.cos(self.course_rad)
        position = np.stack([sine * along + cosine * across, cosine * along - sine * across, np.zeros_like(s)], axis=-1)
        course = self.course_rad + np.where(outward > 0.0, angle, math.pi - angle)
        speed = np.where(way < end, self.speed_m_s, 0.0)
        velocity = np.stack([speed * np.sin(course), speed * np.cos(course), np.zeros_like(s)], axis=-1)
        return Motion(position + self.start_m, velocity, course)


@dataclass(frozen=True)
class Attitude:
    r"""Attitude along a path.

    .. math:: R_{world←body} = R_{course}\, R_{wobble}\, R_{mount}\, e^{[ω t]_×}

    R_course takes the carrier's axes (forward, left, up) to the world's; it is the unit matrix if the attitude does not
    follow the course. R_wobble turns about forward, left and up by :math:`a_i \sin(2π t/T_i + φ_i)`: roll first, then
    pitch, then yaw.

    Attributes
    ----------
    mount_xyzw : tuple
        Unit quaternion, body axes to carrier's axes, at the time 0.
    rate_rad_s : tuple
        ω, constant in body axes: tumbling.
    wobble_rad : tuple
        Amplitudes a of roll, pitch and yaw.
    wobble_period_s : tuple
        Their periods T.
    """

    follows_course: bool = False
    mount_xyzw: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 1.0)
    rate_rad_s: Vector = (0.0, 0.0, 0.0)
    wobble_rad: Vector = (0.0, 0.0, 0.0)
    wobble_period_s: Vector = (1.0, 1.0, 1.0)

    @property
    def is_world(self) -> bool:
        """Return whether the body's axes always equal those of the world."""
        turned = self.follows_course or any(self.mount_xyzw[:3]) or any(self.rate_rad_s) or any(self.wobble_rad)
        return not turned

    def at(self, time_s: ArrayLike, course_rad: ArrayLike, wobble_phase_rad: ArrayLike) -> Rotation:
        """Return the rotations from the body's axes to the world.

        Parameters
        ----------
        time_s, course_rad : array_like, shape (n,)
            Instants [s], and the courses at them.
        wobble_phase_rad : array_like, shape (3,)
            Phases φ of roll, pitch and yaw.

        Returns
        -------
        scipy.spatial.transform.Rotation
            n of them.
        """
        t = np.asarray(time_s, dtype=np.float64)
        yaw = EAST_RAD - np.asarray(course_rad) if self.follows_course else np.zeros_like(t)
        phase = 2.0 * math.pi * t[:, None] / np.array(self.wobble_period_s) + np.asarray(wobble_phase_rad)
        wobble = np.array(self.wobble_rad) * np.sin(phase)
        turned = Rotation.from_rotvec(t[:, None] * np.array(self.rate_rad_s))
        carrier = Rotation.from_euler("z", yaw[:, None]) * Rotation.from_euler("xyz", wobble)
        return carrier * Rotation.from_quat(self.mount_xyzw) * turned


def _integral(rate: FloatArray, t: FloatArray) -> NDArray[np.complex128]:
    """Return the integral (n, K) of exp(i·rate·τ) from 0 to t, without a singularity at rate 0."""
    half = 0.5 * rate * t[..., None]
    return t[..., None] * np.sinc(half / math.pi) * np.exp(1j * half)
