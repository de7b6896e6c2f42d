"""A rigid body with two or more magnets, and the limits of its motion."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.sensor import _finite, _not_negative
from arrays.typing import FloatArray, Vector
from magloc.fields.dipole import MU0_OVER_4PI
from magloc.fields.shapes import Shape
from magloc.navigation.rotations import unit_across

LARGEST_REMANENCE_T = 2.0
"""Remanence beyond that of all magnets [T]; the best of NdFeB have 1.5 T."""
NDFEB_PER_K = -1.1e-3
"""Relative change of the moment of NdFeB magnets per kelvin."""
_MU0 = 4.0 * math.pi * MU0_OVER_4PI
_SAME_PLACE = 1e-6


@dataclass(frozen=True)
class Magnet:
    """One magnet of a body, in the body's frame.

    Attributes
    ----------
    id : str
        Name, one line of text.
    position_m : tuple, shape (3,)
        Centre of the magnet [m].
    moment_Am2 : tuple, shape (3,)
        Magnetic moment [A·m²].
    moment_sigma_Am2 : float
        Standard deviation of the moment's modulus [A·m²].
    position_sigma_m : float
        Standard deviation of the position, per axis [m].
    direction_sigma_rad : float
        Standard deviation of the moment's direction, about each of two axes across it [rad].
    shape : Shape, optional
        Shape of a uniformly magnetised magnet; None for a dipole.
    rotation_xyzw : tuple, shape (4,), optional
        Rotation from the axes of the shape to the body's frame; z is the axis of a cylinder or a ring. None: a cylinder
        or ring has its axis along the moment, a cuboid has its edges along the body's axes.

    Raises
    ------
    ValueError
        A number is not finite, the moment is zero, or larger than any magnet of this size has.
    """

    id: str
    position_m: Vector
    moment_Am2: Vector
    moment_sigma_Am2: float = 0.0
    position_sigma_m: float = 0.0
    direction_sigma_rad: float = 0.0
    shape: Shape | None = None
    rotation_xyzw: tuple[float, float, float, float] | None = None

    def __post_init__(self) -> None:
        if not self.id or not self.id.isprintable():
            raise ValueError(f"Input id must be one line of printable text; instead received {self.id!r}.")
        for name in ("position_m", "moment_Am2"):
            object.__setattr__(self, name, tuple(_finite(name, getattr(self, name), (3,)).tolist()))
        for name in ("moment_sigma_Am2", "position_sigma_m", "direction_sigma_rad"):
            object.__setattr__(self, name, _not_negative(name, getattr(self, name)))
        if not self.modulus_Am2 > 0.0:
            raise ValueError("Input moment_Am2 must be different from zero; instead received zero.")
        if self.rotation_xyzw is not None:
            xyzw = _finite("rotation_xyzw", self.rotation_xyzw, (4,))
            if abs(np.linalg.norm(xyzw) - 1.0) > 1e-6:
                raise ValueError(f"Input rotation_xyzw must be a unit quaternion; instead received {xyzw.tolist()}.")
            object.__setattr__(self, "rotation_xyzw", tuple(xyzw.tolist()))
        if self.shape is not None and not self.remanence_T <= LARGEST_REMANENCE_T:
            raise ValueError(
                f"Input moment_Am2 must be that of a magnet of this size; instead received {self.modulus_Am2:g} A·m²,"
                f" a remanence of {self.remanence_T:.3g} T."
            )

    @property
    def modulus_Am2(self) -> float:
        """Modulus of the moment [A·m²]."""
        return math.hypot(*self.moment_Am2)

    @property
    def relative_sigma(self) -> float:
        """Standard deviation of the moment's modulus over this modulus."""
        return self.moment_sigma_Am2 / self.modulus_Am2

    @property
    def remanence_T(self) -> float:
        """Remanence of the shape [T]; infinite for a dipole."""
        return _MU0 * self.modulus_Am2 / self.shape.volume_m3 if self.shape is not None else math.inf

    @cached_property
    def R_body_from_shape(self) -> FloatArray:
        """Rotation matrix (3, 3) from the axes of the shape to the body's frame."""
        if self.rotation_xyzw is not None:
            return Rotation.from_quat(self.rotation_xyzw).as_matrix()
        if self.shape is None or self.shape.kind not in ("cylinder", "ring"):
            return np.eye(3)
        axis = np.array(self.moment_Am2) / self.modulus_Am2
        x = unit_across(axis)
        return np.column_stack([x, np.cross(axis, x), axis])

    def rotate(self, turn: FloatArray) -> Magnet:
        """Return the magnet after a rotation (3, 3) in the body's frame about its centre."""
        moment = tuple((turn @ np.array(self.moment_Am2)).tolist())
        if self.shape is None or (self.rotation_xyzw is None and self.shape.kind != "cuboid"):
            return replace(self, moment_Am2=moment)
        rotation = Rotation.from_matrix(turn @ self.R_body_from_shape).as_quat()
        return replace(self, moment_Am2=moment, rotation_xyzw=tuple(rotation.tolist()))


@dataclass(frozen=True)
class PoseLimits:
    """Limits of a body's motion in the array's frame: the prior of its pose.

    Attributes
    ----------
    low_m, high_m : tuple, shape (3,)
        Box of the positions of the body's origin [m]; infinite without limits.
    angle_rad : float
        Largest rotation from the rest attitude, in which the axes of body and array agree [rad].

    Raises
    ------
    ValueError
        A lower limit is not below the upper one, or the angle is not above 0 and at most π.
    """

    low_m: Vector = (-math.inf, -math.inf, -math.inf)
    high_m: Vector = (math.inf, math.inf, math.inf)
    angle_rad: float = math.pi

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(
                "Input position_m must have a lower limit below the upper one on each axis; instead received"
                f" {[list(pair) for pair in zip(self.low_m, self.high_m, strict=True)]}."
            )
        if not 0.0 < self.angle_rad <= math.pi:
            raise ValueError(
                f"Input angle_deg must be above 0 and at most 180; instead received {math.degrees(self.angle_rad):g}."
            )

    @property
    def is_bounded(self) -> bool:
        """True if the box of positions is finite."""
        return all(map(math.isfinite, (*self.low_m, *self.high_m)))


@dataclass(frozen=True)
class MagnetBody:
    """Magnets that are rigidly connected, in the frame of their body.

    Attributes
    ----------
    magnets : tuple of Magnet
        Two or more magnets with different ids, not all at one place.
    name : str
        One line of text, or empty.
    limits : PoseLimits
        Limits of the pose.
    temperature_sigma_K : float
        Standard deviation of the temperature of all magnets, about that of the stated moments [K].
    remanence_per_K : float
        Relative change of all moments per kelvin.

    Raises
    ------
    ValueError
        One of these conditions does not hold.
    """

    magnets: tuple[Magnet, ...]
    name: str = ""
    limits: PoseLimits = PoseLimits()
    temperature_sigma_K: float = 0.0
    remanence_per_K: float = NDFEB_PER_K

    def __post_init__(self) -> None:
        object.__setattr__(self, "magnets", tuple(self.magnets))
        object.__setattr__(self, "temperature_sigma_K", _not_negative("temperature_sigma_K", self.temperature_sigma_K))
        if len(self.magnets) < 2:
            raise ValueError(
                f"Input magnets must be at least 2; instead received {len(self.magnets)}. A single magnet is a source:"
                " locate it without a body."
            )
        if len(set(self.ids)) < len(self.ids):
            raise ValueError(f"Input magnets must have different ids; instead received {', '.join(self.ids)}.")
        if not math.isfinite(self.remanence_per_K):
            raise ValueError(f"Input remanence_per_K must be finite; instead received {self.remanence_per_K}.")
        self._check_places()

    def _check_places(self) -> None:
        size = max(self.radius_m, float(np.abs(self.positions_m).max()))
        for one, other in combinations(self.magnets, 2):
            if math.dist(one.position_m, other.position_m) <= _SAME_PLACE * size:
                raise ValueError(
                    f"Input magnets must stand in different places; instead received {one.id} and {other.id} at"
                    f" {list(one.position_m)} m. Magnets in one place act as a single one."
                )

    @property
    def ids(self) -> tuple[str, ...]:
        """Ids of the magnets."""
        return tuple(magnet.id for magnet in self.magnets)

    @cached_property
    def positions_m(self) -> FloatArray:
        """Positions of the magnets (K, 3) [m]."""
        return np.array([magnet.position_m for magnet in self.magnets])

    @cached_property
    def moments_Am2(self) -> FloatArray:
        """Moments of the magnets (K, 3) [A·m²]."""
        return np.array([magnet.moment_Am2 for magnet in self.magnets])

    @cached_property
    def centre_m(self) -> FloatArray:
        """Mean position of the magnets (3,) [m]."""
        return np.asarray(self.positions_m.mean(axis=0))

    @cached_property
    def radius_m(self) -> float:
        """Largest distance of a magnet from the mean position [m]."""
        return float(np.linalg.norm(self.positions_m - self.centre_m, axis=1).max())

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        """Hash of all fields, cached because every fix needs it."""
        return hash(tuple(getattr(self, field.name) for field in fields(self)))

    @cached_property
    def has_shapes(self) -> bool:
        """True if some magnet is not a dipole."""
        return any(magnet.shape is not None for magnet in self.magnets)

    @property
    def common_strength_sigma(self) -> float:
        """Standard deviation of the relative change of all moments by their common temperature."""
        return abs(self.remanence_per_K) * self.temperature_sigma_K

    @cached_property
    def moment_root(self) -> FloatArray:
        """Square root (K, q) of the covariance of relative errors of the moments; q is 0 for exact moments.

        The first columns belong to single magnets, the last one to the temperature that all of them share.
        """
        own = np.array([magnet.relative_sigma for magnet in self.magnets])
        columns = np.diag(own)[:, own > 0.0]
        common = self.common_strength_sigma
        return np.column_stack([columns, np.full(len(own), common)]) if common else columns

    @cached_property
    def n_errors(self) -> int:
        """Number of stated errors of the magnets, of moments, positions and directions."""
        placed = (3 * bool(m.position_sigma_m) + 2 * bool(m.direction_sigma_rad) for m in self.magnets)
        return self.moment_root.shape[1] + sum(placed)

    def with_known_moments(self) -> MagnetBody:
        """Return the body without errors of its moments."""
        magnets = tuple(replace(magnet, moment_sigma_Am2=0.0) for magnet in self.magnets)
        return replace(self, magnets=magnets, temperature_sigma_K=0.0)

    def without(self, index: int) -> tuple[Magnet, ...]:
        """Return all magnets but one; they may be a single one, which is no body."""
        return self.magnets[:index] + self.magnets[index + 1 :]

    def as_dipoles(self) -> MagnetBody:
        """Return the body with a dipole instead of every shape."""
        magnets = tuple(replace(magnet, shape=None, rotation_xyzw=None) for magnet in self.magnets)
        return replace(self, magnets=magnets)
