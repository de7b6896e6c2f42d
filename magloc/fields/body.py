"""Magnetic bodies and their equivalent dipoles.

See docs/theory/extended-sources.md for when a body counts as a dipole.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import elliprd

from arrays.io.errors import _vector, _vectors
from arrays.typing import FloatArray
from magloc.fields.dipole import MU0_OVER_4PI

if TYPE_CHECKING:
    import trimesh

_MU0 = 4.0 * np.pi * MU0_OVER_4PI


@dataclass(frozen=True, eq=False)
class EquivalentDipole:
    """Dipole of a magnetised body, with the ellipsoid that approximates the body.

    Attributes
    ----------
    position_m : ndarray, shape (3,)
        Centroid of the body [m].
    moment_Am2 : ndarray, shape (3,)
        Moment [A·m²].
    semi_axes_m : ndarray, shape (3,)
        Semi-axes of the ellipsoid, longest first [m].
    axes : ndarray, shape (3, 3)
        Directions of the semi-axes as rows, in the frame of the body.
    demagnetising_factors : ndarray, shape (3,)
        Demagnetising factors along the axes.
    body_length_m : float
        Greatest distance between two points of the body [m].
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    volume_m3: float
    semi_axes_m: FloatArray
    axes: FloatArray
    demagnetising_factors: FloatArray
    body_length_m: float


def demagnetising_factors(semi_axes_m: ArrayLike) -> FloatArray:
    r"""Return the demagnetising factors of an ellipsoid along its axes.

    They are 0 along a long needle, 1/3 in a sphere, 1 across a thin disc.

    .. math:: N_i = \frac{abc}{2} \int_0^\infty \frac{ds}{(a_i^2 + s)\sqrt{(a^2 + s)(b^2 + s)(c^2 + s)}}
              = \frac{abc}{3} R_D(a_j^2, a_k^2, a_i^2)

    with Carlson's integral R_D, which is accurate for every shape. Closed forms for spheroids lose digits near the
    sphere. Source: J. A. Osborn, "Demagnetizing factors of the general ellipsoid", Physical Review 67, 1945.

    Parameters
    ----------
    semi_axes_m : array_like, shape (..., 3)
        Positive semi-axes in any order; only their ratios count.

    Returns
    -------
    ndarray, shape (..., 3)
        Factors in the order of the axes; their sum is 1.

    Raises
    ------
    ValueError
        A semi-axis is not positive and finite.
    """
    axes = _vectors("semi_axes_m", semi_axes_m)
    if not (np.isfinite(axes).all() and (axes > 0.0).all()):
        raise ValueError(f"Input semi_axes_m must be positive and finite; instead received {axes.tolist()}.")
    axes = axes / axes.max(axis=-1, keepdims=True)
    square = axes**2
    others = [(1, 2), (2, 0), (0, 1)]
    integrals = [elliprd(square[..., j], square[..., k], square[..., i]) for i, (j, k) in enumerate(others)]
    return np.prod(axes, axis=-1)[..., None] / 3.0 * np.stack(integrals, axis=-1)


def equivalent_dipole(
    mesh: trimesh.Trimesh,
    susceptibility: float,
    ambient_T: ArrayLike,
    remanence_A_m: ArrayLike = (0.0, 0.0, 0.0),
) -> EquivalentDipole:
    r"""Return the dipole of a magnetic body in a uniform field.

    The body is replaced by an ellipsoid of the same volume. Its principal axes and their proportions are those of the
    body's second moments. In an ellipsoid the magnetisation is uniform,

    .. math:: M = (1 + χ N)^{-1} (χ B_0 / μ_0 + M_r), \qquad m = V M,

    with the demagnetising factors N along the axes. A sphere of large χ has m = 3 V B_0/μ_0, a long needle
    m = χ V B_0/μ_0.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed surface of the body [m], in the frame of the fields.
    susceptibility : float
        Susceptibility χ of the material, relative to the field inside it; from -1 (a superconductor) to 1e6 and more
        (soft iron).
    ambient_T : array_like, shape (3,)
        Field without the body [T].
    remanence_A_m : array_like, shape (3,)
        Magnetisation M_r that the material has without a field inside it [A/m].

    Returns
    -------
    EquivalentDipole
        Dipole in the frame of the mesh.

    Raises
    ------
    ValueError
        The mesh is not closed or has no volume, or a number is not finite or out of bounds.

    Examples
    --------
    >>> import trimesh
    >>> import magloc
    >>> body = trimesh.creation.icosphere(radius=0.1)
    >>> magloc.equivalent_dipole(body, 1000.0, [0.0, 0.0, 50e-6]).moment_Am2.round(2)
    array([0.  , 0.  , 0.49])
    """
    if not mesh.is_volume:
        raise ValueError("Input mesh must be a closed surface with outward normals; instead received one that is not.")
    if not -1.0 <= susceptibility < np.inf:
        raise ValueError(f"Input susceptibility must be finite and at least -1; instead received {susceptibility}.")
    ambient, remanence = _vector("ambient_T", ambient_T), _vector("remanence_A_m", remanence_A_m)
    volume = float(mesh.volume)
    inertia = np.asarray(mesh.moment_inertia) / float(mesh.density)
    second_moment = 0.5 * np.trace(inertia) * np.eye(3) - inertia
    value, vector = np.linalg.eigh(second_moment)
    shape, axes = np.sqrt(value[::-1]), vector.T[::-1]
    semi_axes = shape * (volume / (4.0 / 3.0 * np.pi * float(np.prod(shape)))) ** (1.0 / 3.0)
    factors = demagnetising_factors(semi_axes)
    driving = axes @ (susceptibility / _MU0 * ambient + remanence)
    magnetisation = (driving / (1.0 + susceptibility * factors)) @ axes
    return EquivalentDipole(
        position_m=np.array(mesh.center_mass),
        moment_Am2=volume * magnetisation,
        volume_m3=volume,
        semi_axes_m=semi_axes,
        axes=axes,
        demagnetising_factors=factors,
        body_length_m=_greatest_distance(np.asarray(mesh.convex_hull.vertices)),
    )


def _greatest_distance(points: FloatArray) -> float:
    return max(float(np.linalg.norm(points - point, axis=1).max()) for point in points)


def induced_and_permanent_moment(
    R_world_from_body: ArrayLike, permanent_Am2: ArrayLike, polarisability_Am2_T: ArrayLike, ambient_T: ArrayLike
) -> FloatArray:
    r"""Return the sum of a turning body's permanent and induced moments in the world frame.

    .. math:: m = R (m_p + α R^T B_a)

    Parameters
    ----------
    R_world_from_body : array_like, shape (..., 3, 3)
    permanent_Am2 : array_like, shape (..., 3)
        Permanent moment in the body's axes [A·m²].
    polarisability_Am2_T : array_like, shape (..., 3, 3)
        Induced moment per field in the body's axes [A·m²/T], for example from :func:`equivalent_dipole`.
    ambient_T : array_like, shape (..., 3)
        Ambient field in the world frame [T].

    Returns
    -------
    ndarray, shape (..., 3)
        Moment in the world frame [A·m²].
    """
    R = np.asarray(R_world_from_body, dtype=np.float64)
    field_body = np.swapaxes(R, -1, -2) @ np.asarray(ambient_T, dtype=np.float64)[..., None]
    moment_body = np.asarray(permanent_Am2, dtype=np.float64)[..., None] + np.asarray(polarisability_Am2_T) @ field_body
    return (R @ moment_body)[..., 0]
