"""Compiled covariances of optima of one dipole; tests hold them to the inverse information of ``tests/oracles.py``."""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import internal
from magloc.linalg_compiled import dot, orthonormalise, put
from magloc.measurement.whitened_compiled import (
    ModelRow,
    homogeneous_jacobian,
    project_common,
    unit_basis,
)


@internal
def covariance_and_volume(
    q: FloatArray, mu: FloatArray, row: ModelRow, variance: float, covariance: FloatArray
) -> float:
    """Covariance of (ρ, μ), ρ = u/s and μ scaled at s = 1, by QR of the whitened Jacobian, of noise of some variance.

    The result is :func:`magloc.localization.uncertainty.ambiguity.log_evidence_volume`, NaN where it is singular,
    as the covariance is then.
    """
    n = row.channel_sensor.size
    covariance[:] = math.nan
    rho, mu1 = np.empty(4), np.empty(3)
    for d in range(4):
        rho[d] = q[d] / q[3]
    inverse = 1.0 / abs(q[3]) ** 3
    for d in range(3):
        mu1[d] = mu[d] * inverse
    rows, basis, jacobian = np.empty((6, n)), np.empty((3, n)), np.empty((4, n))
    unit_basis(rho, row, basis)
    homogeneous_jacobian(rho, mu1, row, jacobian)
    project_common(jacobian, 3, row)
    scale = np.empty(6)
    # Moment first: its three columns are the well-conditioned part.
    for j in range(6):
        put(rows[j], basis[j] if j < 3 else jacobian[j - 3])
        scale[j] = math.sqrt(dot(rows[j], rows[j]))
        if not (scale[j] > 0.0 and math.isfinite(scale[j])):
            return math.nan
        for c in range(n):
            rows[j, c] /= scale[j]
    triangle = np.zeros((6, 6))
    orthonormalise(rows, triangle)
    inverse_triangle, log_root = np.zeros((6, 6)), 3.0 * math.log(variance)
    for j in range(6):
        if not triangle[j, j] > 1e-13:
            return math.nan
        log_root -= math.log(triangle[j, j] * scale[j])
        inverse_triangle[j, j] = 1.0 / triangle[j, j]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for k in range(i + 1, j + 1):
                t += triangle[i, k] * inverse_triangle[k, j]
            inverse_triangle[i, j] = -t / triangle[i, i]
    for i in range(6):
        for j in range(6):
            t = 0.0
            for k in range(max(i, j), 6):
                t += inverse_triangle[i, k] * inverse_triangle[j, k]
            covariance[(i + 3) % 6, (j + 3) % 6] = variance * t / (scale[i] * scale[j])
    rho2 = rho[0] * rho[0] + rho[1] * rho[1] + rho[2] * rho[2]
    moment2 = mu1[0] * mu1[0] + mu1[1] * mu1[1] + mu1[2] * mu1[2]
    along = 0.0
    for i in range(3):
        for j in range(3):
            along += rho[i] * covariance[i, j] * rho[j]
    return log_root - 1.5 * math.log(rho2 * moment2) - 0.5 * math.log(max(along / (rho2 * rho2), 1.0))
