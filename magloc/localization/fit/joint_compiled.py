"""Compiled variable projection of several dipoles: all moments are linear and eliminated, the positions are searched.

The readable twin is :func:`magloc.localization.fit.gauss_newton.damped_gauss_newton`, which takes any sensors.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.compilation import compiled, internal
from magloc.linalg_compiled import (
    cholesky,
    dot,
    fill_frame,
    multiply_transposed,
    put,
    put_rows,
    solve_cholesky,
    subtract_product,
)
from magloc.localization.fit.variable_projection_compiled import MOST_GAINED
from magloc.measurement.whitened_compiled import (
    SMALLEST_S,
    ModelRow,
    ModelRows,
    homogeneous_jacobian,
    row_at,
    unit_readings,
)

# A ridge of columns of unit norm: below it they are one column to rounding.
_RIDGE = 1e-13
LARGEST_STEP_RAD, LARGEST_DAMPING = 0.5, 1e9


class JointEnds(NamedTuple):
    """Outputs of refinements (n, …): q, scaled moments, χ², infinite where it did not converge, and linearisations."""

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]


class JointRules(NamedTuple):
    """How refinements end: where the linearised model promises to lower χ² by less than absolute and relative parts.

    Or after most iterations, or where they will not come below a χ² (n,) that is too high.
    """

    promise: float
    of_chi2: float
    max_iterations: int
    too_high: FloatArray


class _Workspace(NamedTuple):
    """Of K sources and C channels: columns as rows, of unit norm in `basis`; see :func:`_fit_moments` and on."""

    basis: FloatArray  # (3 K, C) readings of unit moments
    norm: FloatArray  # (3 K,) of these before
    root: FloatArray  # (3 K, 3 K) of their Gram matrix
    mu: FloatArray  # (3 K, 1)
    residual: FloatArray  # (C,)
    common: FloatArray  # (3 K, c) of the rows along the common field
    more: FloatArray  # (3 K, 1)
    jacobian: FloatArray  # (3 K, C) along the tangents, free of the basis
    along: FloatArray  # (3 K, 3 K) of the Jacobian along the basis
    normal: FloatArray  # (3 K, 3 K) of the Jacobian
    gradient: FloatArray  # (3 K, 1)
    scale: FloatArray  # (3 K,) one over the norms of the Jacobian
    damped: FloatArray  # (3 K, 3 K) root
    step: FloatArray  # (3 K, 1)
    tangent: FloatArray  # (K, 3, 4)
    homogeneous: FloatArray  # (4, C)
    frame: FloatArray  # (3, 3)
    trial: FloatArray  # (K, 4)


@compiled
def refine_rows(
    begin: int,
    end: int,
    y: FloatArray,
    free: FloatArray,
    rows: ModelRows,
    rules: JointRules,
    out: JointEnds,
) -> None:
    """Damped Gauss-Newton of fits begin to end, from the q (n, K, 4) of the outputs, on whitened readings y (n, C).

    `free` (K, 3) is 1 where a source may move along a tangent, else 0.
    """
    n, n_sources, n_channels = 3 * out.q.shape[1], out.q.shape[1], y.shape[1]
    w = _Workspace(
        np.empty((n, n_channels)), np.empty(n), np.empty((n, n)), np.empty((n, 1)), np.empty(n_channels),
        np.empty((n, rows.shrinkage.shape[1])), np.empty((n, 1)), np.empty((n, n_channels)), np.empty((n, n)),
        np.empty((n, n)), np.empty((n, 1)), np.empty(n), np.empty((n, n)), np.empty((n, 1)),
        np.empty((n_sources, 3, 4)), np.empty((4, n_channels)), np.empty((3, 3)), np.empty((n_sources, 4)),
    )  # fmt: skip
    for i in range(begin, end):
        q, row = out.q[i], row_at(rows, i)
        chi2 = _fit_moments(q, row, y[i], w)
        _keep_moments(w, out.mu[i])
        damping, count, fresh, optimum = 1e-3, 0, True, False
        for _ in range(rules.max_iterations):
            if not chi2 < math.inf:
                break
            if fresh:
                _linearise(q, row, free, w)
                reachable = _promised(0.0, w)
                count += 1
            if chi2 - MOST_GAINED * reachable > rules.too_high[i]:
                break
            promised = _promised(damping, w)
            share = _move(q, free, w)
            lower = _fit_moments(w.trial, row, y[i], w)
            gained = chi2 - lower
            fresh = gained > 0.0
            small = abs(reachable) < rules.promise + rules.of_chi2 * chi2
            ended = small or (not fresh and damping > LARGEST_DAMPING)
            optimum = small or (ended and abs(reachable) < 1e-6 * (1.0 + chi2))
            if fresh:
                put_rows(q, w.trial)
                _keep_moments(w, out.mu[i])
                chi2 = lower
                if gained > 0.75 * promised and share == 1.0:
                    damping *= 0.1
                elif gained < 0.5 * promised:
                    damping = 3.0 * max(damping, 0.1)
            else:
                damping = 5.0 * max(damping, 1e-4)
            if ended:
                break
        out.chi2[i] = chi2 if optimum else math.inf
        out.iterations[i] = count


@internal
def _fit_moments(q: FloatArray, row: ModelRow, y: FloatArray, w: _Workspace) -> float:
    """Basis, moments and residual of sources at q (K, 4); χ²."""
    for k in range(len(q)):
        unit_readings(q[k], row, w.basis[3 * k : 3 * k + 3])
    _project_common(w.basis, row, w.common)
    for j in range(len(w.basis)):
        column = w.basis[j]
        square = dot(column, column)
        w.norm[j] = math.sqrt(square)
        inverse = 1.0 / w.norm[j] if square > 0.0 else 0.0
        for c in range(y.size):
            column[c] *= inverse
    multiply_transposed(w.basis, w.basis, w.root)
    cholesky(w.root, _RIDGE)
    w.mu[:] = 0.0
    put(w.residual, y)
    for _ in range(2):  # once more, for the digits that squares lose
        for j in range(len(w.basis)):
            w.more[j, 0] = dot(w.basis[j], w.residual)
        solve_cholesky(w.root, w.more)
        for j in range(len(w.basis)):
            w.mu[j, 0] += w.more[j, 0]
            for c in range(y.size):
                w.residual[c] -= w.more[j, 0] * w.basis[j, c]
    return dot(w.residual, w.residual)


@internal
def _project_common(rows: FloatArray, row: ModelRow, along: FloatArray) -> None:
    """Remove the common field, which may have many columns, from whitened rows (n, C) in place."""
    multiply_transposed(rows, row.common, along)
    for j in range(len(along)):
        for k in range(row.shrinkage.size):
            along[j, k] *= row.shrinkage[k]
    subtract_product(rows, along, row.common)


@internal
def _keep_moments(w: _Workspace, mu: FloatArray) -> None:
    """Scaled moments (K, 3)."""
    for j in range(len(w.mu)):
        mu[j // 3, j % 3] = w.mu[j, 0] / w.norm[j] if w.norm[j] > 0.0 else 0.0


@internal
def _linearise(q: FloatArray, row: ModelRow, free: FloatArray, w: _Workspace) -> None:
    """Normal equations of the positions by Kaufman's form, at q (K, 4) and its moments."""
    mu = np.empty((len(q), 3))
    _keep_moments(w, mu)
    for k in range(len(q)):
        _fill_tangents(q[k], w.frame, w.tangent[k])
        homogeneous_jacobian(q[k], mu[k], row, w.homogeneous)
        for j in range(3):
            t = w.tangent[k, j]
            for c in range(w.homogeneous.shape[1]):
                w.jacobian[3 * k + j, c] = free[k, j] * (
                    t[0] * w.homogeneous[0, c]
                    + t[1] * w.homogeneous[1, c]
                    + t[2] * w.homogeneous[2, c]
                    + t[3] * w.homogeneous[3, c]
                )
    _project_common(w.jacobian, row, w.common)
    multiply_transposed(w.basis, w.jacobian, w.along)
    solve_cholesky(w.root, w.along)
    for j in range(len(w.along)):
        for k in range(len(w.along)):
            w.normal[k, j] = w.along[j, k]
    subtract_product(w.jacobian, w.normal, w.basis)
    multiply_transposed(w.jacobian, w.jacobian, w.normal)
    for j in range(len(w.normal)):
        w.gradient[j, 0] = dot(w.jacobian[j], w.residual)
        w.scale[j] = 1.0 / math.sqrt(w.normal[j, j]) if w.normal[j, j] > 0.0 else 0.0


@internal
def _fill_tangents(q: FloatArray, frame: FloatArray, tangent: FloatArray) -> None:
    """Orthonormal tangents (3, 4) of the sphere at q: two that turn u at one range, and along the range."""
    line = np.array([q[0], q[1], q[2]])
    centred = q[0] * q[0] + q[1] * q[1] + q[2] * q[2] <= 1e-24
    if centred:
        line[2] = 1.0
    length = fill_frame(line, frame)
    for d in range(3):
        tangent[0, d], tangent[1, d], tangent[2, d] = frame[0, d], frame[1, d], frame[2, d] * q[3]
    tangent[0, 3], tangent[1, 3], tangent[2, 3] = 0.0, 0.0, 0.0 if centred else -length


@internal
def _promised(damping: float, w: _Workspace) -> float:
    """Fill the damped step; by how much it promises to lower χ²."""
    n = len(w.normal)
    for i in range(n):
        for j in range(n):
            w.damped[i, j] = w.scale[i] * w.normal[i, j] * w.scale[j]
        w.damped[i, i] += damping
        w.step[i, 0] = w.scale[i] * w.gradient[i, 0]
    cholesky(w.damped, _RIDGE)
    solve_cholesky(w.damped, w.step)
    promised = 0.0
    for i in range(n):
        w.step[i, 0] *= w.scale[i]
    for i in range(n):
        curvature = 0.0
        for j in range(n):
            curvature += w.normal[i, j] * w.step[j, 0]
        promised += w.step[i, 0] * (2.0 * w.gradient[i, 0] - curvature)
    return promised


@internal
def _move(q: FloatArray, free: FloatArray, w: _Workspace) -> float:
    """Fill the trial state; the share of the step that is taken, half a radian of every source at most."""
    longest = 0.0
    for k in range(len(q)):
        a, b, c = w.step[3 * k, 0], w.step[3 * k + 1, 0], w.step[3 * k + 2, 0]
        longest = max(longest, math.sqrt(a * a + b * b + c * c))
    share = LARGEST_STEP_RAD / longest if longest > LARGEST_STEP_RAD else 1.0
    for k in range(len(q)):
        moved, before, after = w.trial[k], 0.0, 0.0
        for d in range(4):
            moved[d] = q[k, d]
            for j in range(3):
                moved[d] += share * w.step[3 * k + j, 0] * w.tangent[k, j, d]
        for d in range(3):
            before += q[k, d] * q[k, d]
            after += moved[d] * moved[d]
        if free[k, 2] == 0.0:  # a step along the tangents lengthens u: at one range it keeps its length
            for d in range(3):
                moved[d] *= math.sqrt(before / after)
            after = before
        norm = math.sqrt(after + moved[3] * moved[3])
        for d in range(4):
            moved[d] /= norm
        if abs(moved[3]) < SMALLEST_S:
            moved[3] = SMALLEST_S if moved[3] >= 0.0 else -SMALLEST_S
    return share
