"""Covariances of moments at known positions."""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray
from magloc.localization.fit.gauss_newton import JointFits
from magloc.measurement.whitened import WhitenedModel

_LEAST_EIGENVALUE = 1e-13


def moment_covariances(problem: WhitenedModel, y: FloatArray, fits: JointFits) -> FloatArray:
    """Return the inverse of half the Hessian of χ² (b, 3 K, 3 K) [A·m²].

    It is NaN if the Hessian is not positive definite. Second derivatives are needed: where two exact solutions merge,
    the first derivative of the readings vanishes along one direction.
    """
    if not len(problem):
        return np.empty((0, *2 * (3 * fits.n_sources,)))
    fields = problem.source_fields(fits.q, fits.mu)
    jacobian = problem.moment_jacobian(fits.q, problem.linear_gain(fields))
    information = jacobian.transpose(0, 2, 1) @ jacobian
    scalar = problem.channel_is_scalar
    if scalar.any():
        owner = problem.channel_sensor[scalar]
        residual = problem.whiten(y - problem.predict(fields))[:, scalar]
        total = (fields + problem.ambient)[:, owner]
        modulus = np.linalg.norm(total, axis=-1, keepdims=True)
        units = np.eye(3 * fits.n_sources).reshape(-1, *fits.mu.shape[1:])
        matrix = np.stack(
            [problem.source_fields(fits.q, np.broadcast_to(unit, fits.mu.shape)) for unit in units], axis=-1
        )[:, owner]
        with np.errstate(divide="ignore", invalid="ignore"):
            direction = total / modulus
            across = matrix - direction[..., None] * (direction[..., None, :] @ matrix)
            weight = residual * problem.gain[:, scalar, 0] / modulus[..., 0]
            information = information - np.einsum("bc,bcji,bcjk->bik", weight, across, across)
    size = problem.moment(fits.q, np.ones_like(fits.mu))
    if problem.known is not None:
        known = problem.known.information(problem.moment(fits.q, fits.mu)) * size[..., None] ** 2
        for k in range(fits.n_sources):
            information[:, 3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += known[:, k]
    length = np.sqrt(np.abs(np.diagonal(information, axis1=1, axis2=2)))
    scale = length[:, :, None] * length[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = information / scale
    positive = np.isfinite(unit).all(axis=(1, 2))
    values, vectors = np.linalg.eigh(np.where(positive[:, None, None], unit, np.eye(unit.shape[1])))
    positive &= values[:, 0] > _LEAST_EIGENVALUE
    safe = np.where(positive[:, None], values, 1.0)
    inverse = (vectors / safe[:, None]) @ vectors.transpose(0, 2, 1)
    size = size.reshape(len(y), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        covariance: FloatArray = inverse / scale * size[:, :, None] * size[:, None]
    covariance[~positive] = np.nan
    return covariance
