r"""Field of a body of several magnets, and its derivatives by the body's pose.

A body at x with the rotation R (array from body) has magnet k at :math:`x + R p_k` with the moment :math:`R m_k`.
Small changes of the pose are :math:`x + δx` and :math:`R \exp([δθ]_×)`, so δθ is in the body's frame:

.. math:: δ(x + R p_k) = δx - R [p_k]_× δθ, \qquad δ(R m_k) = -R [m_k]_× δθ.

Positions are in the array's frame [m], fields in T. Leading axes are poses.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from arrays.typing import FloatArray
from magloc.bodies.body import Magnet, MagnetBody
from magloc.fields import dipole
from magloc.fields.shapes import Shape, fields_or_nan
from magloc.navigation.rotations import cross_matrix


@dataclass(frozen=True, eq=False)
class MagnetFields:
    """Fields of K magnets at N points, and their derivatives, in the array's frame.

    Attributes
    ----------
    field_T : ndarray, shape (..., K, N, 3)
    by_position : ndarray, shape (..., K, N, 3, 3)
        Derivative by the magnet's position [T/m].
    by_rotation : ndarray, shape (..., K, N, 3, 3)
        Derivative by a small rotation of the magnet about its own centre, a vector in the array's frame [T/rad].
    """

    field_T: FloatArray
    by_position: FloatArray
    by_rotation: FloatArray


def magnet_fields(body: MagnetBody, points_m: FloatArray, position_m: FloatArray, R: FloatArray) -> MagnetFields:
    """Return the field of each magnet and its derivatives.

    Parameters
    ----------
    body : MagnetBody
    points_m : ndarray, shape (N, 3)
        Points, such as the sensors [m].
    position_m : ndarray, shape (..., 3)
        Position of the body's origin [m].
    R : ndarray, shape (..., 3, 3)
        Rotation matrix from the body's frame to the array's.
    """
    parts = [
        dipole_fields(points_m, place, moment)
        if magnet.shape is None
        else _shape_fields(magnet, magnet.shape, points_m - place, R)
        for magnet, place, moment in _magnets_in_array(body, position_m, R)
    ]
    field_T, by_position, by_rotation = (
        np.stack(part, axis=-3 - extra) for part, extra in zip(zip(*parts, strict=True), (0, 1, 1), strict=True)
    )
    return MagnetFields(field_T, by_position, by_rotation)


def placed_magnets(body: MagnetBody, position_m: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return positions and moments (..., K, 3) of the magnets in the array's frame."""
    places = np.asarray(position_m)[..., None, :] + body.positions_m @ np.swapaxes(R, -1, -2)
    return places, body.moments_Am2 @ np.swapaxes(R, -1, -2)


def _magnets_in_array(
    body: MagnetBody, position_m: FloatArray, R: FloatArray
) -> Iterator[tuple[Magnet, FloatArray, FloatArray]]:
    """Yield each magnet with its position and moment (..., 1, 3) in the array's frame."""
    places, moments = placed_magnets(body, position_m, R)
    for k, magnet in enumerate(body.magnets):
        yield magnet, places[..., k, None, :], moments[..., k, None, :]


def dipole_fields(
    points_m: FloatArray, source_m: FloatArray, moment_Am2: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the field (..., 3) of dipoles, and its derivatives (..., 3, 3) by position and rotation."""
    jacobian = dipole.field_jacobian(points_m, source_m, moment_Am2)
    by_position, by_moment = jacobian[..., :3], jacobian[..., 3:]
    field_T = (by_moment @ moment_Am2[..., None])[..., 0]
    return field_T, by_position, -by_moment @ cross_matrix(moment_Am2)


def _shape_fields(
    magnet: Magnet, shape: Shape, ways_m: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return :func:`dipole_fields` of a magnet with a shape, NaN inside it, for ways (..., N, 3) from its centre."""
    axes = (R @ magnet.R_body_from_shape)[..., None, :, :]
    moment = magnet.R_body_from_shape.T @ np.array(magnet.moment_Am2)
    in_shape = (np.swapaxes(axes, -1, -2) @ ways_m[..., None])[..., 0]
    field, by_point, _ = fields_or_nan(shape, in_shape, moment)
    field_T = (axes @ field[..., None])[..., 0]
    gradient = axes @ by_point @ np.swapaxes(axes, -1, -2)
    return field_T, -gradient, gradient @ cross_matrix(ways_m) - cross_matrix(field_T)


def body_fields(body: MagnetBody, points_m: FloatArray, position_m: FloatArray, R: FloatArray) -> FloatArray:
    """Return the field (..., N, 3) [T] of a body; for the arguments see :func:`magnet_fields`."""
    parts = [
        dipole.field(points_m, place, moment)
        if magnet.shape is None
        else _shape_fields(magnet, magnet.shape, points_m - place, R)[0]
        for magnet, place, moment in _magnets_in_array(body, position_m, R)
    ]
    return np.sum(parts, axis=0)


def pose_jacobian(body: MagnetBody, fields: MagnetFields, R: FloatArray) -> FloatArray:
    """Return the derivative (..., N, 3, 6) of the body's field by its pose, (δx, δθ), δθ in the body's frame."""
    by_position = fields.by_position.sum(axis=-4)
    turned = R[..., None, :, :] @ cross_matrix(body.positions_m)
    by_rotation = fields.by_rotation @ R[..., None, None, :, :] - fields.by_position @ turned[..., :, None, :, :]
    return np.concatenate([by_position, by_rotation.sum(axis=-4)], axis=-1)


def magnet_errors(body: MagnetBody, fields: MagnetFields, R: FloatArray) -> FloatArray:
    """Return the fields (..., N, 3, q) of the stated errors of the magnets, one standard deviation each.

    They are errors of the moments, then of the positions, then of the directions.
    """
    columns = [np.einsum("...kna,kq->...naq", fields.field_T, body.moment_root)]
    for k, magnet in enumerate(body.magnets):
        if magnet.position_sigma_m:
            columns.append(magnet.position_sigma_m * fields.by_position[..., k, :, :, :])
        if magnet.direction_sigma_rad:
            across = magnet.direction_sigma_rad * R @ null_space(np.array([magnet.moment_Am2]))
            columns.append(fields.by_rotation[..., k, :, :, :] @ across[..., None, :, :])
    return np.concatenate(columns, axis=-1)
