"""Damped Gauss-Newton fits of several dipoles to any sensors, many fits at once.

:mod:`magloc.measurement.whitened` defines the coordinates. Positions are damped, moments are not. After every step
of the positions the moments are fitted again; for vector sensors the iteration is then variable projection.

Shapes: b fits, K sources, N sensors, C channels, c columns of the whitening's common field.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.localization.fit.refinement import MOST_SOURCES, OPTIMUM_TOLERANCE, RELATIVE_TOLERANCE, refine_starts
from magloc.measurement.whitened import WhitenedModel
from magloc.navigation.rotations import cross_matrix, unit_across

# Predicted decrease of χ², absolute and relative, below which a fit has converged.
PROMISE_ABSOLUTE = 1e-8
PROMISE_RELATIVE = 1e-11
LARGEST_STEP_RAD, LARGEST_DAMPING = 0.5, 1e9
_LEAST_SINGULAR = 1e-13


@dataclass(frozen=True, eq=False)
class JointFits:
    """Fits of K sources each, over any leading axes.

    Attributes
    ----------
    q : ndarray, shape (..., K, 4)
    mu : ndarray, shape (..., K, 3)
    chi2 : ndarray, shape (...)
        χ²; infinite if a fit did not converge or does not exist.
    iterations : ndarray of int, shape (...)
        Number of linearisations.
    """

    q: FloatArray
    mu: FloatArray
    chi2: FloatArray
    iterations: NDArray[np.int64]

    @classmethod
    def none(cls, shape: tuple[int, ...], n_sources: int) -> JointFits:
        """Return an array of empty fits."""
        q, mu = np.full((*shape, n_sources, 4), np.nan), np.full((*shape, n_sources, 3), np.nan)
        return cls(q, mu, np.full(shape, np.inf), np.zeros(shape, dtype=np.int64))

    @property
    def n_sources(self) -> int:
        """Number of sources K."""
        return self.q.shape[-2]

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Fits whose iteration ended at an optimum, shape (...)."""
        return np.isfinite(self.chi2)

    def rows(self, index: Any) -> JointFits:
        """Return some of the fits, by an index of the leading axes."""
        return JointFits(*(values[index] for values in vars(self).values()))

    def reshape(self, *shape: int) -> JointFits:
        """Return the fits with other leading axes."""
        n_axes = self.chi2.ndim
        return JointFits(*(values.reshape(*shape, *values.shape[n_axes:]) for values in vars(self).values()))

    def put(self, index: Any, fits: JointFits) -> None:
        """Write fits into this array, at an index of the leading axes."""
        for values, others in zip(vars(self).values(), vars(fits).values(), strict=True):
            values[index] = others

    def replace(self, index: Any, fits: JointFits) -> JointFits:
        """Return the fits with some of them replaced."""
        result = JointFits(*(values.copy() for values in vars(self).values()))
        result.put(index, fits)
        return result

    def distinct(self, width: int, is_same: Callable[[JointFits], BoolArray]) -> JointFits:
        """Return the best distinct fits (b, width) of each row of fits (b, n).

        `is_same` returns which fits (b, n) equal one fit of each row (b,). A row without any converged fit keeps its
        first one, because the next source starts better beside it.
        """
        chi2, rows = self.chi2.copy(), np.arange(len(self.chi2))
        kept = JointFits.none((len(rows), width), self.n_sources)
        for k in range(width):
            best = np.argmin(chi2, axis=1)
            found = np.isfinite(chi2[rows, best]) | (k == 0)
            if not found.any():
                break
            kept.put((found, k), self.rows((rows[found], best[found])))
            chi2[is_same(kept.rows((slice(None), k)))] = np.inf
            chi2[rows, best] = np.inf
        return kept

    def with_opposite_moments(self, n_rows: int) -> JointFits:
        """Return the fits of n rows, each followed by the fit of the opposite moments."""
        both = np.repeat(np.arange(len(self.q)).reshape(n_rows, -1), 2, axis=1).ravel()
        fits = self.rows(both)
        fits.mu[1::2] *= -1.0
        return fits


def tangents(q: FloatArray) -> FloatArray:
    """Return orthonormal tangents (..., 4, 3) of the unit sphere at q (..., 4).

    The first two change the direction u at constant range, the third changes the range alone.
    """
    u, s = q[..., :3], q[..., 3:]
    length = np.linalg.norm(u, axis=-1, keepdims=True)
    direction = np.where(length > 1e-12, u / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    first = unit_across(direction)
    second = (cross_matrix(direction) @ first[..., None])[..., 0]
    zero = np.zeros_like(s)
    columns = (
        np.concatenate([first, zero], axis=-1),
        np.concatenate([second, zero], axis=-1),
        np.concatenate([direction * s, -length], axis=-1),
    )
    return np.stack(columns, axis=-1)


def fit_moments(problem: WhitenedModel, y: FloatArray, q: FloatArray) -> FloatArray:
    """Return scaled moments (b, K, 3) that fit y (b, C) best at q.

    Channels are linearised about the ambient field alone.
    """
    gain = problem.linear_gain(np.zeros_like(problem.ambient))
    return _moment_step(problem.moment_jacobian(q, gain), y - problem.ambient_signals)


def _jacobian(
    problem: WhitenedModel, q: FloatArray, mu: FloatArray, gain: FloatArray, tangent: FloatArray | None = None
) -> FloatArray:
    """Return the Jacobian of predictions and known moments by μ, or along tangents of q."""
    if tangent is None:
        of_readings = problem.moment_jacobian(q, gain, mu)
    else:
        of_readings = problem.position_jacobian(q, mu, gain, tangent)
    if problem.known is None:
        return of_readings
    return np.concatenate([of_readings, problem.known_jacobian(q, mu, tangent)], axis=1)


def _moment_step(jacobian: FloatArray, residual: FloatArray) -> FloatArray:
    step, _ = _FitNormalEquations.of(jacobian, residual).step()
    return step.reshape(len(residual), -1, 3)


@dataclass(frozen=True, eq=False)
class _FitNormalEquations:
    """Normal equations of many fits, in columns of unit norm."""

    norm: FloatArray
    gradient: FloatArray
    information: FloatArray

    @classmethod
    def of(cls, jacobian: FloatArray, residual: FloatArray) -> _FitNormalEquations:
        """Return the normal equations of Jacobians (b, C, n) and residuals (b, C)."""
        norm = np.linalg.norm(jacobian, axis=1)
        norm = np.where(norm > 0.0, norm, 1.0)
        unit = jacobian / norm[:, None]
        transposed = unit.transpose(0, 2, 1)
        return cls(norm, (transposed @ residual[..., None])[..., 0], transposed @ unit)

    def step(self, damping: FloatArray | float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Return the damped step (b, n) and the predicted decrease of χ² (b,).

        Damping may differ between columns.
        """
        diagonal = np.arange(self.norm.shape[-1])
        system = self.information.copy()
        system[:, diagonal, diagonal] += 1e-13 + damping
        with np.errstate(all="ignore"):
            step = np.linalg.solve(system, self.gradient[..., None])[..., 0]
            curvature = np.sum(step * (self.information @ step[..., None])[..., 0], axis=-1)
            promised = 2.0 * np.sum(step * self.gradient, axis=-1) - curvature
        return step / self.norm, promised


def refine_moments(problem: WhitenedModel, y: FloatArray, q: FloatArray, mu: FloatArray) -> JointFits:
    """Fit moments (b, K, 3) of sources fixed at q (b, K, 4) to whitened readings (b, C)."""
    return refine(problem, y, q, mu, free=np.zeros((q.shape[1], 3), dtype=bool))


def refine(
    problem: WhitenedModel,
    y: FloatArray,
    q: FloatArray,
    mu: FloatArray,
    *,
    free: NDArray[np.bool_] | None = None,
    max_iterations: int = 60,
    promise: float = PROMISE_ABSOLUTE,
    too_high: FloatArray | None = None,
) -> JointFits:
    """Fit positions and moments from starts (b, K, 4) and (b, K, 3); χ² never rises.

    y (b, C) are whitened readings. `free` (K, 3) states along which :func:`tangents` a source may move; without the
    third its range is constant. A fit has converged if the predicted decrease of χ² is below `promise`, or below
    ``OPTIMUM_TOLERANCE`` for one free source and vector sensors. Kernels refine several sources with vector sensors,
    starting from the best moments, and one source with any sensors. They stop fits that will not fall below `too_high`
    (b,).
    """
    free = np.ones((q.shape[1], 3), dtype=bool) if free is None else free
    if not _has_kernel(problem, free):
        return damped_gauss_newton(problem, y, q, mu, free, max_iterations, promise)
    moduli, one_free_source = problem.sees_moduli, len(free) == 1 and free.all()
    several = len(free) > 1
    found = refine_starts(
        problem,
        y - problem.ambient_signals if moduli else y,
        q,
        mu if moduli else None,
        free=None if free.all() else free,
        max_iterations=max_iterations,
        tolerance=OPTIMUM_TOLERANCE if one_free_source and not moduli else promise,
        relative_tolerance=PROMISE_RELATIVE if several else RELATIVE_TOLERANCE,
        too_high=too_high,
    )
    useful = found.converged if too_high is None else found.converged & ~(found.chi2 > too_high)
    return JointFits(found.q, found.mu, np.where(useful, found.chi2, np.inf), found.iterations)


def _has_kernel(problem: WhitenedModel, free: NDArray[np.bool_]) -> bool:
    """Return whether kernels can refine this problem.

    They refine sources with unknown moments by vector sensors, and one source of free direction by any sensors.
    """
    if not problem.has_kernels or problem.known is not None or not free.any() or len(free) > MOST_SOURCES:
        return False
    return not problem.sees_moduli or (len(free) == 1 and bool(free[0, :2].all()))


def damped_gauss_newton(
    problem: WhitenedModel,
    y: FloatArray,
    q: FloatArray,
    mu: FloatArray,
    free: NDArray[np.bool_],
    max_iterations: int = 60,
    promise: float = PROMISE_ABSOLUTE,
) -> JointFits:
    """Fit as :func:`refine` does, for any sensors and known moments, without kernels."""
    n_fits, n_sources = q.shape[:2]
    columns = np.flatnonzero(free.ravel())
    # Without free positions the moments are damped.
    damped = np.repeat([1.0, 0.0 if columns.size else 1.0], [columns.size, 3 * n_sources])
    q, mu = q.copy(), mu.copy()
    chi2, iterations = np.full(n_fits, np.inf), np.zeros(n_fits, dtype=np.int64)
    live = np.arange(n_fits)
    damping = np.full(n_fits, 1e-3)
    fields = problem.source_fields(q, mu)
    residual = problem.residual(y, q, mu, fields)
    current = _squares(residual)
    fresh = np.ones(n_fits, dtype=bool)
    jacobian = np.empty((n_fits, residual.shape[1], damped.size))
    tangent = np.empty((n_fits, n_sources, 4, 3))
    sub = problem
    for _ in range(max_iterations):
        if not live.size:
            break
        new = np.flatnonzero(fresh)
        if new.size:
            at = sub if new.size == live.size else sub.rows(new)
            gain = at.linear_gain(fields[new])
            tangent[new] = tangents(q[live[new]])
            along = _jacobian(at, q[live[new]], mu[live[new]], gain, tangent[new])[..., columns]
            jacobian[new] = np.concatenate([along, _jacobian(at, q[live[new]], mu[live[new]], gain)], axis=-1)
            iterations[live[new]] += 1
        normal = _FitNormalEquations.of(jacobian, residual)
        step, promised = normal.step(damping[:, None] * damped)
        _, reachable = normal.step()
        new_q, new_mu, step_share = _take_step(q[live], mu[live], step, tangent, columns)
        new_fields = sub.source_fields(new_q, new_mu)
        new_residual = sub.residual(y[live], new_q, new_mu, new_fields)
        new_chi2 = _squares(new_residual)
        if columns.size:
            gain = sub.linear_gain(new_fields)
            better_mu = new_mu + _moment_step(_jacobian(sub, new_q, new_mu, gain), new_residual)
            better_fields = sub.source_fields(new_q, better_mu)
            better_residual = sub.residual(y[live], new_q, better_mu, better_fields)
            better_chi2 = _squares(better_residual)
            better = better_chi2 < new_chi2
            new_mu = np.where(better[:, None, None], better_mu, new_mu)
            new_fields = np.where(better[:, None, None], better_fields, new_fields)
            new_residual = np.where(better[:, None], better_residual, new_residual)
            new_chi2 = np.where(better, better_chi2, new_chi2)
        with np.errstate(invalid="ignore"):
            accepted = new_chi2 < current
            gained = current - new_chi2
            small = np.abs(reachable) < promise + PROMISE_RELATIVE * current
            # A step refused because of rounding ends the fit too, if almost no decrease was predicted.
            ended = small | (~accepted & (damping > LARGEST_DAMPING))
            at_optimum = small | (np.abs(reachable) < 1e-6 * (1.0 + current))
            well = gained > 0.75 * promised
            badly = gained < 0.5 * promised
        q[live[accepted]], mu[live[accepted]] = new_q[accepted], new_mu[accepted]
        fields, residual = (
            np.where(accepted[:, None, None], new_fields, fields),
            np.where(accepted[:, None], new_residual, residual),
        )
        current = np.where(accepted, new_chi2, current)
        damping = np.where(
            accepted,
            np.where(
                well & (step_share == 1.0), 0.1 * damping, np.where(badly, np.maximum(damping, 0.1) * 3.0, damping)
            ),
            np.maximum(damping, 1e-4) * 5.0,
        )
        finished = ended | ~np.isfinite(current)
        chi2[live[finished]] = np.where(at_optimum, current, np.inf)[finished]
        fresh = accepted
        if finished.any():
            stay = np.flatnonzero(~finished)
            live, fresh, damping, current = live[stay], fresh[stay], damping[stay], current[stay]
            fields, residual, jacobian, tangent = fields[stay], residual[stay], jacobian[stay], tangent[stay]
            sub = sub.rows(stay)
    return JointFits(q, mu, np.where(np.isnan(chi2), np.inf, chi2), iterations)


def _squares(residual: FloatArray) -> FloatArray:
    return np.sum(residual * residual, axis=-1)


def _take_step(
    q: FloatArray, mu: FloatArray, step: FloatArray, tangent: FloatArray, columns: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return coordinates and moments after a step, and the applied share of the step.

    A step that would rotate q too far is shortened.
    """
    n_fits, n_sources = q.shape[:2]
    along = np.zeros((n_fits, 3 * n_sources))
    along[:, columns] = step[:, : columns.size]
    along = along.reshape(n_fits, n_sources, 3)
    longest = np.max(np.linalg.norm(along, axis=-1), axis=-1)
    share = np.minimum(1.0, LARGEST_STEP_RAD / np.maximum(longest, 1e-300))
    moved = q + (tangent @ (share[:, None, None] * along)[..., None])[..., 0]
    if columns.size < 3 * n_sources:
        # A step along the tangents lengthens u slightly; restore its length if the range is constant.
        held = ~np.isin(3 * np.arange(n_sources) + 2, columns)
        before, after = (np.linalg.norm(x[:, held, :3], axis=-1, keepdims=True) for x in (q, moved))
        moved[:, held, :3] *= before / np.maximum(after, 1e-300)
    turned = step[:, columns.size :].reshape(n_fits, n_sources, 3)
    new_mu = mu + share[:, None, None] * turned
    norm = np.linalg.norm(moved, axis=-1, keepdims=True)
    return moved / norm, new_mu / norm**3, share


def first_equal(row: IntArray, q: FloatArray, weight: FloatArray, same_place: float, same_weight: float) -> IntArray:
    """Return the index of the first equal fit of the same row, for every fit (f,).

    Fits are sorted by row; sources (f, K, 4) and weights (f, N) are compared.
    """
    first = np.arange(len(row))
    for apart in range(1, int(np.bincount(row).max(initial=0))):
        alike = row[apart:] == row[:-apart]
        alike &= np.all(np.abs(q[apart:] - q[:-apart]) < same_place, axis=(1, 2))
        alike &= np.all(np.abs(weight[apart:] - weight[:-apart]) < same_weight * weight[:-apart], axis=1)
        first[apart:][alike] = np.minimum(first[apart:], first[:-apart])[alike]
    return first


def covariances(problem: WhitenedModel, fits: JointFits) -> FloatArray:
    """Return covariances (b, 6 K, 6 K) of (p₁, m₁, p₂, m₂, …) [m, A·m²]; NaN if singular."""
    n_sources = fits.n_sources
    if not len(fits.q):
        return np.empty((0, 6 * n_sources, 6 * n_sources))
    unit = problem.state_unit(n_sources)
    return inverse_information(scaled_jacobian(problem, fits.q, fits.mu)) * np.outer(unit, unit)


def scaled_jacobian(problem: WhitenedModel, q: FloatArray, mu: FloatArray) -> FloatArray:
    """Return the Jacobian (b, C + K k, 6 K) by (p₁, m₁, …), in radii and tesla of a moment."""
    n_fits, n_sources = q.shape[:2]
    s = q[..., 3:]
    rho = np.concatenate([q[..., :3] / s, np.ones_like(s)], axis=-1)
    mu = mu / np.abs(s) ** 3
    gain = problem.linear_gain(problem.source_fields(rho, mu))
    along = np.broadcast_to(np.eye(4)[:, :3], (n_fits, n_sources, 4, 3))
    by_position = _jacobian(problem, rho, mu, gain, along).reshape(n_fits, -1, n_sources, 3)
    by_moment = _jacobian(problem, rho, mu, gain).reshape(n_fits, -1, n_sources, 3)
    return np.concatenate([by_position, by_moment], axis=-1).reshape(n_fits, -1, 6 * n_sources)


def inverse_information(jacobian: FloatArray) -> FloatArray:
    """Return ``(JᵀJ)⁻¹`` (b, n, n) of whitened Jacobians (b, C, n); NaN if singular.

    The inverse uses the singular values of scaled columns.
    """
    n_fits, n_rows, n = jacobian.shape
    norm = np.linalg.norm(jacobian, axis=1)
    good = np.isfinite(norm).all(axis=-1) & (norm > 0.0).all(axis=-1) & (n_rows >= n)
    if not good.any():
        return np.full((n_fits, n, n), np.nan)
    safe = np.where(good[:, None], norm, 1.0)
    unit = np.where(good[:, None, None], jacobian, 0.0) / safe[:, None]
    singular, vt = np.linalg.svd(unit, full_matrices=False)[1:]
    good &= singular[:, -1] > _LEAST_SINGULAR * singular[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        rooted = vt / singular[..., None] / safe[:, None]
        inverse: FloatArray = rooted.transpose(0, 2, 1) @ rooted
    inverse[~good] = np.nan
    return inverse
