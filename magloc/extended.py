r"""Sources that are no points: when a dipole describes them, and the dipole that stands for a magnetic body.

Two checks tell whether a source is too near for a dipole: its distance in body lengths, where its size is known
(:func:`dipole_validity`), and the pattern of the residuals of a fix, where it is not (:func:`nearness_test`): the next
terms of the multipole expansion about the solution,

.. math::  B = k \frac{(2l + 1)\,(S : n^l)\,n - l\, S : n^{l-1}}{r^{l+2}}, \qquad k = μ_0/4π,

with a symmetric traceless tensor S of rank l (l = 1 is the moment itself), must not explain them better than noise
does. A uniformly magnetised body that is symmetric about its centre has no quadrupole (l = 2) there; what it has is an
octupole (l = 3), smaller by (length/distance)². Of the five numbers of a quadrupole a shift of the dipole makes up
three, so that only two are left to be seen in a fix.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations_with_replacement, permutations

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import null_space
from scipy.special import elliprd
from scipy.stats import chi2 as chi2_distribution
from scipy.stats import f as f_distribution

from arrays.differences import decorrelated_differences, reading_covariance
from arrays.sensor import SensorArray
from magloc import dipole
from magloc.dipole import MU0_OVER_4PI
from magloc.measurement import DifferenceMeasurement, channel_jacobian

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

BODY_LENGTHS = 3.0
"""Distance in body lengths from which on a body counts as a dipole."""

_MU0 = 4.0 * np.pi * MU0_OVER_4PI
_ORDERS = (2, 3)
_NAMES = {2: "a quadrupole", 3: "an octupole"}
_NO_OTHER_MISFIT = 0.05
# Columns whose part outside the earlier ones is smaller than this are not seen by the array.
_UNSEEN_RTOL = 1e-6


@dataclass(frozen=True, eq=False)
class EquivalentDipole:
    """The dipole of a magnetised body, with the ellipsoid that stands for the body.

    Attributes
    ----------
    position_m : ndarray, shape (3,)
        Centroid of the body [m].
    moment_Am2 : ndarray, shape (3,)
        [A·m²].
    volume_m3 : float
    semi_axes_m : ndarray, shape (3,)
        Of the ellipsoid, longest first [m].
    axes : ndarray, shape (3, 3)
        Their directions as rows, in the frame of the body.
    demagnetising_factors : ndarray, shape (3,)
        Along the axes.
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


@dataclass(frozen=True)
class MultipoleGain:
    """What one more order of the multipole expansion explains of the readings.

    Attributes
    ----------
    order : int
        2 for the quadrupole, 3 for the octupole.
    gain : float
        By how much χ² decreases.
    n_parameters : int
        How many more parameters the array sees.
    noise_probability : float
        Probability that noise of the stated size gains as much: χ² test.
    misfit_probability : float
        Probability that a misfit without any pattern gains as much: F test against what is left. 1 where nothing is
        left to compare it with.
    """

    order: int
    gain: float
    n_parameters: int
    noise_probability: float
    misfit_probability: float


@dataclass(frozen=True)
class NearnessTest:
    """Whether a fix leaves residuals that a dipole does not, and whether they have the pattern of an extended source.

    Attributes
    ----------
    misfit : bool
        Whether χ² is larger than noise explains.
    extended : bool
        Whether a quadrupole or an octupole explains significantly more than noise, and more than a misfit of another
        kind does: the source is too near or too large for a dipole. So near that the expansion about one point does
        not hold, and with few sensors, there is a misfit only.
    chi2 : float
        Of the dipole, at the end of one linearised step.
    dof : int
        Differences minus the unknowns of a dipole that the array sees.
    gains : tuple of MultipoleGain
        Each beyond the orders before it.
    warning : str
        A sentence for the user; empty if there is neither.
    """

    misfit: bool
    extended: bool
    chi2: float
    dof: int
    gains: tuple[MultipoleGain, ...]
    warning: str


def dipole_validity(distance_m: ArrayLike, body_length_m: ArrayLike) -> BoolArray:
    """Whether a body is at least three body lengths away, so that it counts as a dipole.

    At three lengths, the length being the longest side, the field of a uniformly magnetised cube differs from that of a
    dipole by 0.3 % at most, that of a cylinder as long as it is wide by 1.3 %, of a flat brick by 5 % and of a thin rod
    by 6 %, on whose axis the ratio of the two is ``1/(1 - (L/2r)²)²``.

    Parameters
    ----------
    distance_m : array_like
        From the body's centre to the sensors [m].
    body_length_m : array_like
        Greatest extent of the body [m].

    Returns
    -------
    ndarray of bool
        Their shapes broadcast; False where either is NaN.

    Raises
    ------
    ValueError
        A distance or a length is negative.
    """
    distance, length = np.asarray(distance_m, dtype=np.float64), np.asarray(body_length_m, dtype=np.float64)
    for name, values in (("distance_m", distance), ("body_length_m", length)):
        if np.any(values < 0.0):
            raise ValueError(f"Input {name} must not be negative; instead received {values.min()}.")
    return np.asarray(distance >= BODY_LENGTHS * length)


def demagnetising_factors(semi_axes_m: ArrayLike) -> FloatArray:
    r"""Demagnetising factors of an ellipsoid along its axes.

    They are 0 along a long needle, 1/3 in a sphere, 1 across a thin disc.

    .. math:: N_i = \frac{abc}{2} \int_0^\infty \frac{ds}{(a_i^2 + s)\sqrt{(a^2 + s)(b^2 + s)(c^2 + s)}}
              = \frac{abc}{3} R_D(a_j^2, a_k^2, a_i^2)

    with Carlson's integral R_D, which is accurate for every shape, near the sphere too, where the closed forms of
    spheroids lose their digits. J. A. Osborn, "Demagnetizing factors of the general ellipsoid", Physical Review 67,
    1945.

    Parameters
    ----------
    semi_axes_m : array_like, shape (..., 3)
        Positive, in any order; only their ratios count.

    Returns
    -------
    ndarray, shape (..., 3)
        In the order of the axes; their sum is 1.

    Raises
    ------
    ValueError
        A semi-axis is not positive and finite.
    """
    axes = np.asarray(semi_axes_m, dtype=np.float64)
    if axes.ndim == 0 or axes.shape[-1] != 3:
        raise ValueError(f"Input semi_axes_m must have shape (..., 3); instead received shape {axes.shape}.")
    if not (np.isfinite(axes).all() and (axes > 0.0).all()):
        raise ValueError(f"Input semi_axes_m must be positive and finite; instead received {axes.tolist()}.")
    axes = axes / axes.max(axis=-1, keepdims=True)
    square = axes**2
    others = [(1, 2), (2, 0), (0, 1)]
    integrals = [elliprd(square[..., j], square[..., k], square[..., i]) for i, (j, k) in enumerate(others)]
    factors: FloatArray = np.prod(axes, axis=-1)[..., None] / 3.0 * np.stack(integrals, axis=-1)
    return factors


def equivalent_dipole(
    mesh: trimesh.Trimesh,
    susceptibility: float,
    ambient_T: ArrayLike,
    remanence_A_m: ArrayLike = (0.0, 0.0, 0.0),
) -> EquivalentDipole:
    r"""Dipole of a magnetic body in a uniform field.

    The body is replaced by the ellipsoid of its volume and of the principal axes and the proportions of its second
    moments. In an ellipsoid the magnetisation is uniform,

    .. math:: M = (1 + χ N)^{-1} (χ B_0 / μ_0 + M_r), \qquad m = V M,

    with N its demagnetising factors along its axes: m = 3 V B_0/μ_0 of a sphere of large χ, χ V B_0/μ_0 of a long
    needle.

    Parameters
    ----------
    mesh : trimesh.Trimesh
        Closed surface of the body [m], in the frame of the fields.
    susceptibility : float
        χ of the material, relative to the field inside it; from -1 (a superconductor) to 1e6 and more (soft iron).
    ambient_T : array_like, shape (3,)
        Field without the body [T].
    remanence_A_m : array_like, shape (3,)
        Magnetisation M_r that the material has without a field inside it [A/m].

    Returns
    -------
    EquivalentDipole
        In the frame of the mesh.

    Raises
    ------
    ValueError
        The mesh is not closed or has no volume, or a number is not finite or out of bounds.
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


def multipole_field_matrix(points_m: ArrayLike, source_m: ArrayLike, order: int) -> FloatArray:
    """Field of every component of a multipole: the dipole (order 1), the quadrupole (2), the octupole (3), and so on.

    Parameters
    ----------
    points_m : array_like, shape (..., 3)
        Where the field is wanted [m].
    source_m : array_like, shape (..., 3)
        Where the multipole is [m].
    order : int
        l, at least 1.

    Returns
    -------
    ndarray, shape (..., 3, 2 l + 1)
        [T/(A·m^(l+1))], for an orthonormal basis of the symmetric traceless tensors of rank l. NaN on the source.

    Raises
    ------
    ValueError
        The order is below 1, or the points are no 3-vectors.
    """
    if order < 1:
        raise ValueError(f"Input order must be at least 1; instead received {order}.")
    points, source = np.asarray(points_m, dtype=np.float64), np.asarray(source_m, dtype=np.float64)
    for name, values in (("points_m", points), ("source_m", source)):
        if values.ndim == 0 or values.shape[-1] != 3:
            raise ValueError(f"Input {name} must have shape (..., 3); instead received shape {values.shape}.")
    separation = points - source
    r = np.linalg.norm(separation, axis=-1)[..., None]
    r = np.where(r > 0.0, r, np.nan)
    n = separation / r
    # Contracted with n once per index: S n^(l-1) is a vector, S n^l a number.
    contracted = np.broadcast_to(_traceless_basis(order), n.shape[:-1] + (2 * order + 1,) + (3,) * order)
    for _ in range(order - 1):
        contracted = np.einsum(
            "...i,...i->...", contracted, n[(..., *(None,) * (contracted.ndim - n.ndim), slice(None))]
        )
    along = np.einsum("...si,...i->...s", contracted, n)
    pattern = (2 * order + 1) * along[..., None] * n[..., None, :] - order * contracted
    field: FloatArray = MU0_OVER_4PI * np.swapaxes(pattern / r[..., None] ** (order + 2), -1, -2)
    return field


def nearness_test(
    array: SensorArray,
    position_m: ArrayLike,
    moment_Am2: ArrayLike,
    readings_T: ArrayLike,
    *,
    false_alarm: float = 1e-3,
) -> NearnessTest:
    """Whether the residuals of a fix have the pattern of a source that is extended or too near.

    A quadrupole and then an octupole at the solution are added to the linearised dipole. Either is a finding if χ²
    decreases by more than noise explains, and by more, per parameter, than what is left of the misfit (F test at 5 %).
    The octupole is left out where it would leave no degree of freedom. That χ² itself is too large is a finding too.
    Each of the three tests has a third of the rate of false alarms.

    Parameters
    ----------
    array : SensorArray
        Its noise decides what is significant.
    position_m, moment_Am2 : array_like, shape (3,)
        Solution of a fix, in the array's frame [m], [A·m²].
    readings_T : array_like, shape (C,)
        The readings of that fix [T]; NaN where missing.
    false_alarm : float
        Probability at most of any finding for a dipole with noise of the stated size.

    Returns
    -------
    NearnessTest

    Raises
    ------
    ValueError
        The shapes do not agree, or the rate of false alarms is not between 0 and 1.
    """
    position, moment = _vector("position_m", position_m), _vector("moment_Am2", moment_Am2)
    readings = np.asarray(readings_T, dtype=np.float64)
    if readings.shape != (array.n_channels,):
        raise ValueError(f"Input readings_T must have shape ({array.n_channels},); instead received {readings.shape}.")
    if not 0.0 < false_alarm < 1.0:
        raise ValueError(f"Input false_alarm must be between 0 and 1; instead received {false_alarm}.")
    covariance = reading_covariance(array, readings)
    measurement = DifferenceMeasurement(
        array, decorrelated_differences(array, np.isfinite(readings), covariance_T2=covariance)
    )
    whitener = measurement.differences.transform / np.sqrt(measurement.variance)[:, None]
    residual = (measurement.measured(readings) - measurement.predicted(position, moment)) / np.sqrt(
        measurement.variance
    )
    known = _orthonormal(whitener @ channel_jacobian(array, position, moment), np.zeros((residual.size, 0)))
    residual = residual - known @ (known.T @ residual)
    chi2, dof = float(residual @ residual), residual.size - known.shape[1]
    steps: list[tuple[int, float, int]] = []
    left = dof
    for order in _ORDERS:
        fields = multipole_field_matrix(array.positions, position, order)[array.channel_sensor]
        columns = np.einsum("ci,cij->cj", _channel_rows(array, position, moment), fields)
        new = _orthonormal(whitener @ columns, known)
        if new.shape[1] == 0 or (steps and left - new.shape[1] <= 0):
            break
        steps.append((order, float(np.sum((new.T @ residual) ** 2)), new.shape[1]))
        known, left = np.concatenate([known, new], axis=1), left - new.shape[1]
    rest = max(chi2 - sum(gain for _, gain, _ in steps), 0.0)
    gains = tuple(_tested(order, gain, n, rest, left) for order, gain, n in steps)
    level = false_alarm / 3.0
    misfit = dof > 0 and bool(chi2_distribution.sf(chi2, dof) < level)
    extended = any(gain.noise_probability < level and gain.misfit_probability < _NO_OTHER_MISFIT for gain in gains)
    return NearnessTest(misfit, extended, chi2, dof, gains, _warning(misfit, extended, chi2, dof, gains))


def _tested(order: int, gain: float, n_parameters: int, rest: float, left: int) -> MultipoleGain:
    comparable = left > 0 and rest > 0.0
    ratio = (gain / n_parameters) / (rest / left) if comparable else 0.0
    return MultipoleGain(
        order=order,
        gain=gain,
        n_parameters=n_parameters,
        noise_probability=float(chi2_distribution.sf(gain, n_parameters)),
        misfit_probability=float(f_distribution.sf(ratio, n_parameters, left)) if comparable else 1.0,
    )


def _warning(misfit: bool, extended: bool, chi2: float, dof: int, gains: Sequence[MultipoleGain]) -> str:
    if extended:
        best = min(gains, key=lambda gain: gain.misfit_probability)
        return (
            f"The source is too near or too large for a dipole: {_NAMES[best.order]} explains {best.gain:.4g} of "
            f"χ² {chi2:.4g}."
        )
    if misfit:
        return (
            f"The readings are not those of one dipole (χ² {chi2:.4g} for {dof} degrees of freedom): the source may be "
            "too near, too large or one of several, or the noise or the calibration is wrong."
        )
    return ""


def _channel_rows(array: SensorArray, position: FloatArray, moment: FloatArray) -> FloatArray:
    """What each channel reads of a small change of the field, (C, 3)."""
    if not array.channel_is_scalar.any():
        return array.channel_gain
    total = dipole.field(array.positions, position, moment) + array.ambient_fields
    direction = total / np.linalg.norm(total, axis=-1, keepdims=True)
    of_modulus = array.channel_gain[:, :1] * direction[array.channel_sensor]
    return np.where(array.channel_is_scalar[:, None], of_modulus, array.channel_gain)


def _orthonormal(columns: FloatArray, known: FloatArray) -> FloatArray:
    """Orthonormal basis of what columns (k, n) add to the orthonormal ones that are known."""
    length = np.linalg.norm(columns, axis=0)
    unit = columns / np.where(length > 0.0, length, 1.0)
    new = unit - known @ (known.T @ unit)
    basis, size, _ = np.linalg.svd(new, full_matrices=False)
    result: FloatArray = basis[:, size > _UNSEEN_RTOL]
    return result


@cache
def _traceless_basis(order: int) -> FloatArray:
    """Orthonormal basis of the symmetric traceless tensors of a rank, (2 l + 1, 3, …, 3)."""
    symmetric = []
    for index in combinations_with_replacement(range(3), order):
        tensor = np.zeros((3,) * order)
        for place in set(permutations(index)):
            tensor[place] = 1.0
        symmetric.append(tensor / np.linalg.norm(tensor))
    basis = np.stack(symmetric)
    if order == 1:
        return basis
    traces = np.trace(basis, axis1=1, axis2=2).reshape(len(basis), -1)
    return np.tensordot(null_space(traces.T).T, basis, axes=1)


def _greatest_distance(points: FloatArray) -> float:
    return max(float(np.linalg.norm(points - point, axis=1).max()) for point in points)


def _vector(name: str, value: ArrayLike) -> FloatArray:
    vector = np.asarray(value, dtype=np.float64)
    if vector.shape != (3,) or not np.isfinite(vector).all():
        raise ValueError(f"Input {name} must be finite and have shape (3,); instead received {vector.tolist()}.")
    return vector
