"""Exact fields of uniformly magnetised magnets: cuboid, cylinder, ring and sphere.

With the potential phi of a body that holds one unit of charge, spread evenly over its volume V,

    phi(d) = (1/V) integral of 1/|d - d'| dV',

the field outside a magnet of moment m is B = k (second derivatives of phi) m with k = mu_0/4 pi. The compiled kernel
(``magloc/core/include/magloc/shapes.hpp``) has these derivatives and the third ones in closed form: arc tangents and
logarithms of a cuboid, complete elliptic integrals of a cylinder. Beyond 15 edges of a cuboid and ten half diagonals of
a cylinder, where closed forms cancel, it adds multipoles to the dipole.

References
----------
N. Derby, S. Olbert, "Cylindrical magnets and ideal solenoids", American Journal of Physics 78, 2010.
A. Caciagli, R. Baars, A. Philipse, B. Kuipers, "Exact expression for the magnetic field of a finite cylinder with
arbitrary uniform magnetization", Journal of Magnetism and Magnetic Materials 456, 2018.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import _vectors
from arrays.typing import FloatArray
from magloc import core

_SIZES = {
    "cuboid": "three edges",
    "cylinder": "diameter, height",
    "ring": "inner diameter, outer diameter, height",
    "sphere": "diameter",
}
KINDS = tuple(_SIZES)
_POINTS_A_BLOCK = 20_000


@dataclass(frozen=True)
class Shape:
    """Shape of a magnet with uniform magnetisation, centred in its own frame.

    Attributes
    ----------
    kind : str
        "cuboid", "cylinder", "ring" or "sphere".
    size_m : tuple of float
        Sizes [m]: three edges of a cuboid along x, y, z; diameter and height of a cylinder; inner diameter, outer
        diameter and height of a ring; diameter of a sphere. The axis of a cylinder or ring is z.

    Raises
    ------
    ValueError
        The kind is unknown, or the sizes are not those of such a body.

    Examples
    --------
    >>> import magloc
    >>> round(1e9 * magloc.Shape("cylinder", (0.010, 0.004)).volume_m3)  # mm³
    314
    """

    kind: str
    size_m: tuple[float, ...]

    def __post_init__(self) -> None:
        if self.kind not in _SIZES:
            raise ValueError(f"Input kind must be one of {', '.join(KINDS)}; instead received {self.kind!r}.")
        object.__setattr__(self, "size_m", tuple(float(size) for size in np.atleast_1d(self.size_m)))
        names = _SIZES[self.kind]
        if len(self.size_m) != 1 + names.count(",") + 2 * (self.kind == "cuboid"):
            raise ValueError(f"Input size_m must be the {names} of a {self.kind}; instead received {[*self.size_m]}.")
        if not all(0.0 < size < math.inf for size in self.size_m):
            raise ValueError(f"Input size_m must be positive and finite; instead received {[*self.size_m]}.")
        if self.kind == "ring" and self.size_m[0] >= self.size_m[1]:
            raise ValueError(
                "Input size_m must be those of a ring with an inner diameter below the outer one;"
                f" instead received {[*self.size_m]}."
            )

    @cached_property
    def length_m(self) -> float:
        """Greatest distance between two points of the magnet [m]."""
        width = self.size_m[-2:] if self.kind in ("cylinder", "ring") else self.size_m
        return math.hypot(*width)

    def check_aligned(self) -> None:
        """Raise ValueError for a cuboid with unequal edges across its last one, along which it is magnetised."""
        if self.kind == "cuboid" and not math.isclose(*self.size_m[:2], rel_tol=1e-6):
            raise ValueError(
                "Input size_m must be edges of which the first two are equal, across the magnetisation of the cuboid;"
                f" instead received {[*self.size_m]}."
            )

    @cached_property
    def volume_m3(self) -> float:
        """Volume [m³]."""
        size = self.size_m
        if self.kind == "cuboid":
            return math.prod(size)
        if self.kind == "sphere":
            return math.pi / 6.0 * size[0] ** 3
        inner = size[0] if self.kind == "ring" else 0.0
        return math.pi / 4.0 * (size[-2] ** 2 - inner**2) * size[-1]

    @cached_property
    def kernel_size(self) -> tuple[int, tuple[float, float, float]]:
        """Number of the shape, and its size, for kernels."""
        half = [0.5 * size for size in self.size_m]
        if self.kind == "cuboid":
            return 1, (half[0], half[1], half[2])
        if self.kind == "sphere":
            return 3, (half[0], 0.0, 0.0)
        return 2, (half[0] if self.kind == "ring" else 0.0, half[-2], half[-1])


def shape_fields(shape: Shape, points_m: ArrayLike, moment_Am2: ArrayLike) -> FloatArray:
    """Return the field of a magnet at points outside it, in the magnet's frame.

    Parameters
    ----------
    shape : Shape
        Shape of the magnet.
    points_m : array_like, shape (..., 3)
        Points from the centre of the magnet, in its frame [m].
    moment_Am2 : array_like, shape (..., 3)
        Moment in the magnet's frame, in any direction [A·m²]; its leading axes broadcast against those of the points.

    Returns
    -------
    ndarray, shape (..., 3)
        Field [T]; NaN where a point or a moment is not finite.

    Raises
    ------
    ValueError
        A point is inside the magnet or on its surface.
    """
    return shape_jacobians(shape, points_m, moment_Am2)[0]


def shape_jacobians(
    shape: Shape, points_m: ArrayLike, moment_Am2: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the field of a magnet and its Jacobians, by the point (..., 3, 3) and by the moment (..., 3, 3).

    For parameters and errors see :func:`shape_fields`. Both Jacobians are symmetric and traceless.
    """
    field, by_point, by_moment = fields_or_nan(shape, points_m, moment_Am2)
    given = np.isfinite(np.broadcast_to(points_m, field.shape)) & np.isfinite(np.broadcast_to(moment_Am2, field.shape))
    inside = np.isnan(field).any(axis=-1) & given.all(axis=-1)
    if inside.any():
        point = np.broadcast_to(points_m, field.shape)[inside][0].tolist()
        raise ValueError(
            "Input points_m must hold points outside the magnet, where sensors are;"
            f" instead received {point} inside a {shape.kind} of size_m {[*shape.size_m]}."
        )
    return field, by_point, by_moment


def fields_or_nan(
    shape: Shape, points_m: ArrayLike, moment_Am2: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the results of :func:`shape_jacobians`, NaN at points inside the magnet or on its surface."""
    points, moments = np.broadcast_arrays(_vectors("points_m", points_m), _vectors("moment_Am2", moment_Am2))
    axes, number = points.shape[:-1], points.size // 3
    field, by_point, by_moment = np.empty((number, 3)), np.empty((number, 3, 3)), np.empty((number, 3, 3))
    kind, size = shape.kernel_size
    work = core.problem(
        "magnets",
        n_points=number,
        shape=kind,
        size=size,
        points=np.ascontiguousarray(points).reshape(-1, 3),
        moments=np.ascontiguousarray(moments).reshape(-1, 3),
        fields=field,
        matrices=by_moment,
        gradients=by_point,
    )
    core.run("shape_fields", work, number, block=_POINTS_A_BLOCK)
    return field.reshape(*axes, 3), by_point.reshape(*axes, 3, 3), by_moment.reshape(*axes, 3, 3)


def aligned_fields(
    shape: Shape,
    points_m: ArrayLike,
    position_m: ArrayLike,
    moment_Am2: ArrayLike,
    roll_rad: ArrayLike | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Return the field of a magnet that is magnetised along its z axis, and its Jacobian by position, moment and roll.

    The magnet turns with its moment. A cuboid must have equal edges across the moment. Its roll about the moment is
    from axes that depend on the moment alone; by default its field is the mean over all rolls.

    Parameters
    ----------
    points_m, position_m, moment_Am2 : array_like, shape (..., 3)
        Points, centre of the magnet and its moment in one frame [m], [A·m²].
    roll_rad : array_like, shape (...), optional
        Roll of a cuboid about its moment [rad].

    Returns
    -------
    field : ndarray, shape (..., 3)
        Field [T]; NaN inside the magnet.
    jacobian : ndarray, shape (..., 3, 7)
        Its derivatives by (p, m) and by the roll [T/m], [T/(A·m²)], [T/rad].

    Raises
    ------
    ValueError
        An argument is not an array of 3-vectors, or the leading axes do not broadcast.
    """
    separation = _vectors("points_m", points_m) - _vectors("position_m", position_m)
    moment = _vectors("moment_Am2", moment_Am2)
    points, moments = (np.empty(np.broadcast(separation, moment).shape) for _ in range(2))
    points[...], moments[...] = separation, moment
    axes, number = points.shape[:-1], points.size // 3
    field, jacobian = np.empty((number, 3)), np.empty((number, 3, 7))
    kind, size = shape.kernel_size
    roll = None if roll_rad is None else np.broadcast_to(np.asarray(roll_rad, dtype=np.float64), axes).ravel()
    work = core.problem(
        "aligned_magnets",
        n_points=number,
        shape=kind,
        size=size,
        rolls=None if roll is None else np.stack([np.cos(roll), np.sin(roll)], axis=-1),
        points=points,
        moments=moments,
        fields=field,
        jacobians=jacobian,
    )
    core.run("aligned_fields", work, number, block=_POINTS_A_BLOCK)
    return field.reshape(*axes, 3), jacobian.reshape(*axes, 3, 7)
