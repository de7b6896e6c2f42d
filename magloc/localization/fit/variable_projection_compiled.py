"""Compiled variable projection: the moment is linear and eliminated, so a fit is a search over the position.

The readable twin is ``tests/variable_projection.py``; coordinates are :mod:`magloc.measurement.whitened_compiled`'s.
"""

from __future__ import annotations

import math

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import compiled
from magloc.linalg_compiled import _directional_tangent, _solve_damped, _tangent, orthonormalise, put
from magloc.measurement.whitened_compiled import (
    SMALLEST_S,
    ModelRow,
    _project_common,
    homogeneous_jacobian,
    unit_basis,
)

# How a refinement ends.
CONVERGED, KNOWN, FAILED = 0, 1, 2
# Gauss-Newton gain in χ² at which an optimum is one: the position is then within 1e-4 σ of it.
OPTIMUM_TOLERANCE = 1e-9


@compiled
def _residual(
    q: FloatArray,
    y: FloatArray,
    row: ModelRow,
    basis: FloatArray,
    triangle: FloatArray,
    mu: FloatArray,
    residual: FloatArray,
) -> float:
    """Orthonormal basis, best scaled moment mu and residual at q; returns χ²."""
    unit_basis(q, row, basis)
    orthonormalise(basis, triangle)
    n = y.size
    for c in range(n):
        residual[c] = y[c]
    for j in range(3):
        t = 0.0
        for c in range(n):
            t += basis[j, c] * residual[c]
        mu[j] = t
        for c in range(n):
            residual[c] -= t * basis[j, c]
    for j in range(2, -1, -1):
        t = mu[j]
        for k in range(j + 1, 3):
            t -= triangle[j, k] * mu[k]
        mu[j] = t / triangle[j, j] if triangle[j, j] > 0.0 else 0.0
    chi2 = 0.0
    for c in range(n):
        chi2 += residual[c] * residual[c]
    return chi2


@compiled
def same_optimum(q: FloatArray, chi2: float, other_q: FloatArray, other_chi2: float) -> bool:
    """Whether two ends are one optimum: 0.01 rad apart on the sphere of homogeneous coordinates, at the same χ²."""
    t = q[0] * other_q[0] + q[1] * other_q[1] + q[2] * other_q[2] + q[3] * other_q[3]
    return abs(t) > 0.99995 and abs(chi2 - other_chi2) < 0.01


@compiled
def refine(
    q: FloatArray,
    y: FloatArray,
    row: ModelRow,
    n_free: int,
    tolerance: float,
    max_iterations: int,
    known_q: FloatArray,
    known_chi2: FloatArray,
    n_known: int,
    mu: FloatArray,
) -> tuple[float, int, int]:
    """Damped Gauss-Newton on the projected cost, from q (4,), which becomes the optimum as mu its scaled moment.

    With n_free = 3 it moves on the sphere of homogeneous coordinates, with 2 at one range. Every accepted step
    decreases χ². It ends where a further Gauss-Newton step would gain less than the tolerance, or as soon as it has
    come to one of the known optima. Returns χ², the number of linearisations, and CONVERGED, KNOWN or FAILED.
    """
    n = y.size
    basis, triangle, residual = np.empty((3, n)), np.zeros((3, 3)), np.empty(n)
    new_basis, new_triangle, new_residual = np.empty((3, n)), np.zeros((3, 3)), np.empty(n)
    jacobian, rows = np.empty((4, n)), np.empty((n_free, n))
    tangent, new_q, new_mu = np.empty((3, 4)), np.empty(4), np.empty(3)
    a, b, step = np.empty((3, 3)), np.empty(3), np.empty(3)
    chi2 = _residual(q, y, row, basis, triangle, mu, residual)
    if not math.isfinite(chi2):
        return math.inf, 0, FAILED
    damping = 1e-3
    for iteration in range(1, max_iterations + 1):
        for j in range(n_known):
            if same_optimum(q, chi2, known_q[j], known_chi2[j]):
                return chi2, iteration - 1, KNOWN
        homogeneous_jacobian(q, mu, row, jacobian)
        if n_free == 2:
            _directional_tangent(q, tangent)
        else:
            _tangent(q, tangent)
        for j in range(n_free):
            for c in range(n):
                rows[j, c] = (
                    tangent[j, 0] * jacobian[0, c]
                    + tangent[j, 1] * jacobian[1, c]
                    + tangent[j, 2] * jacobian[2, c]
                    + tangent[j, 3] * jacobian[3, c]
                )
        _project_common(rows, n_free, row)
        # Kaufman's form of variable projection: the moment's part of every column is taken out.
        for j in range(n_free):
            for k in range(3):
                t = 0.0
                for c in range(n):
                    t += basis[k, c] * rows[j, c]
                for c in range(n):
                    rows[j, c] -= t * basis[k, c]
        for i in range(n_free):
            t = 0.0
            for c in range(n):
                t += rows[i, c] * residual[c]
            b[i] = t
            for j in range(i + 1):
                t = 0.0
                for c in range(n):
                    t += rows[i, c] * rows[j, c]
                a[i, j] = t
                a[j, i] = t
        _solve_damped(a, b, n_free, 0.0, step)
        decrement = 0.0
        for i in range(n_free):
            decrement += b[i] * step[i]
        if not math.isfinite(decrement):
            return chi2, iteration, FAILED
        if decrement < tolerance + 1e-14 * chi2:
            return chi2, iteration, CONVERGED
        accepted = False
        while damping < 1e12:
            _solve_damped(a, b, n_free, damping, step)
            length = 0.0
            for i in range(n_free):
                length += step[i] * step[i]
            length = math.sqrt(length)
            shorten = 0.5 / length if length > 0.5 else 1.0
            norm = 0.0
            for d in range(4):
                t = q[d]
                for i in range(n_free):
                    t += shorten * step[i] * tangent[i, d]
                new_q[d] = t
                norm += t * t
            if n_free == 2:
                u2 = norm - new_q[3] * new_q[3]
                stretch = math.sqrt((1.0 - new_q[3] * new_q[3]) / u2)
                for d in range(3):
                    new_q[d] *= stretch
            else:
                norm = 1.0 / math.sqrt(norm)
                for d in range(4):
                    new_q[d] *= norm
                if abs(new_q[3]) < SMALLEST_S:
                    new_q[3] = math.copysign(SMALLEST_S, new_q[3])
            new_chi2 = _residual(new_q, y, row, new_basis, new_triangle, new_mu, new_residual)
            if new_chi2 < chi2:
                accepted = True
                break
            damping = max(damping, 1e-4) * 5.0
        if not accepted:
            # No representable step decreases χ²: an optimum to rounding if the model promised next to nothing.
            return chi2, iteration, CONVERGED if decrement < 1e-6 * (1.0 + chi2) else FAILED
        # χ² falls by twice the step's product with the gradient, less its curvature: a ratio of gains of one is a model
        # that holds, a low one a step that went too far.
        promised = 0.0
        for i in range(n_free):
            t = 0.0
            for j in range(n_free):
                t += a[i, j] * shorten * step[j]
            promised += shorten * step[i] * (2.0 * b[i] - t)
        gained = chi2 - new_chi2
        if gained > 0.75 * promised:
            damping *= 0.1
        elif gained < 0.5 * promised:
            damping = max(damping, 0.1) * 3.0
        put(q, new_q)
        put(mu, new_mu)
        chi2 = new_chi2
        basis, new_basis = new_basis, basis
        residual, new_residual = new_residual, residual
    return chi2, max_iterations, FAILED
