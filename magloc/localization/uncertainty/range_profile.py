r"""Profile of χ² over the range of a source, for any sensors; all else is fitted again.

The coordinate of the range is :math:`\alpha = \mathrm{atan2}(s, |u|)`: π/2 at the sensors' centroid, 0 at infinity, and
negative beyond it, on the other side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.levels import DELTA_CHI2_95
from magloc.localization.fit.gauss_newton import JointFits, refine
from magloc.localization.uncertainty.range_interval import ranges_of, relative_range_sigma
from magloc.measurement.whitened import WhitenedModel

_SMALLEST_ALPHA = 1e-6
# Half width of a stretch below which the profile is a parabola; without kernels its points take long.
_NARROW_RAD = 0.01
# Steps outwards, relative to the step at which a Gaussian profile would reach the limit.
_STEPS = np.array([1.0, 1.5, 2.2, 4.0, 9.0, 25.0, 80.0])
_ROUNDS = 3
# Tolerance of χ² at a point of the profile.
_PROMISE = 1e-4


def profile_stretches(
    problem: WhitenedModel,
    y: FloatArray,
    fits: JointFits,
    source: int,
    sigma_over_range: FloatArray,
    rise: FloatArray,
) -> FloatArray:
    """Return intervals (b, 2) of α of one source in which χ² stays within a rise (b,).

    The ends are -π/2 and π/2 if χ² does not rise so much. The relative σ of the range from the covariance, NaN if
    unknown, sets the first steps.
    """
    n = len(y)
    if not n:
        return np.empty((0, 2))
    q = fits.q[:, source]
    alpha = np.arctan2(np.abs(q[:, 3]), np.linalg.norm(q[:, :3], axis=-1))
    sigma = np.abs(np.nan_to_num(sigma_over_range, nan=1.0)) * np.sin(alpha) * np.cos(alpha)
    reach = np.sqrt(rise) * sigma
    if not problem.has_kernels and (narrow := reach < _NARROW_RAD).any():
        ends = np.stack([alpha - reach, alpha + reach], axis=1)
        wide = np.flatnonzero(~narrow)
        of_wide = problem.rows(wide), y[wide], fits.rows(wide), source, sigma_over_range[wide], rise[wide]
        if wide.size:
            ends[wide] = profile_stretches(*of_wide)
        return ends
    step = np.clip(reach, 1e-7, 0.05)
    # Both sides at once: first outwards (decreasing α) for all fits, then inwards.
    rows = np.tile(np.arange(n), 2)
    sign = np.repeat([-1.0, 1.0], n)
    at_optimum, allowed = alpha[rows], rise[rows]
    # The last point of the grid is the bound itself.
    grid = at_optimum[:, None] + (sign * step[rows])[:, None] * np.append(_STEPS, np.inf)
    grid = np.clip(grid, _SMALLEST_ALPHA - 0.5 * np.pi, 0.5 * np.pi - _SMALLEST_ALPHA)
    grid = np.where(np.abs(grid) < _SMALLEST_ALPHA, _SMALLEST_ALPHA, grid)
    f_grid, left = np.full(grid.shape, -np.inf), np.arange(2 * n)
    for k in range(grid.shape[1]):
        f_grid[left, k] = _rises(problem, y, fits, source, rows[left], grid[left, k])
        left = left[f_grid[left, k] <= allowed[left]]
        if not left.size:
            break
    beyond = f_grid > allowed[:, None]
    first = np.where(beyond.any(axis=1), np.argmax(beyond, axis=1), grid.shape[1])
    found = np.flatnonzero(first < grid.shape[1])
    rows, allowed, first = rows[found], allowed[found], first[found]
    outside, f_outside = grid[found, first], f_grid[found, first]
    inside = np.where(first > 0, grid[found, first - 1], at_optimum[found])
    f_inside = np.where(first > 0, f_grid[found, first - 1], 0.0)
    for _ in range(_ROUNDS):
        # The profile is nearly a parabola: interpolate its square root.
        a, b = np.sqrt(np.clip(f_inside, 0.0, None)), np.sqrt(np.clip(f_outside, 0.0, 1e6))
        with np.errstate(divide="ignore", invalid="ignore"):
            share = np.clip((np.sqrt(allowed) - a) / (b - a), 0.05, 0.95)
        middle = inside + np.nan_to_num(share, nan=0.5) * (outside - inside)
        f = _rises(problem, y, fits, source, rows, middle)
        higher = f > allowed
        outside, f_outside = np.where(higher, middle, outside), np.where(higher, f, f_outside)
        inside, f_inside = np.where(higher, inside, middle), np.where(higher, f_inside, f)
    end = np.where(f_outside - allowed < allowed - f_inside, outside, inside)
    ends = 0.5 * np.pi * sign
    ends[found] = end
    return ends.reshape(2, n).T


def ranges_within(
    problem: WhitenedModel,
    y: FloatArray,
    fits: JointFits,
    source: int,
    covariance: FloatArray,
    rise: FloatArray | float = DELTA_CHI2_95,
) -> FloatArray:
    """Return range limits (b, 2) [m] of one source in which χ² stays within a rise (b,)."""
    offset = problem.position(fits.q)[:, source] - problem.centroid
    sigma = relative_range_sigma(covariance[:, 6 * source :, 6 * source :], offset)
    return ranges_of(profile_stretches(problem, y, fits, source, sigma, np.broadcast_to(rise, len(y))), problem.radius)


def _rises(
    problem: WhitenedModel,
    y: FloatArray,
    fits: JointFits,
    source: int,
    row: NDArray[np.intp],
    alpha: FloatArray,
) -> FloatArray:
    """Return the rise of χ² (r,) over the optima at ranges (r,), all else fitted again."""
    q, mu = fits.q[row].copy(), fits.mu[row].copy()
    u = q[:, source, :3]
    length = np.linalg.norm(u, axis=-1, keepdims=True)
    at = alpha[:, None]
    sign = np.where(q[:, source, 3:] < 0.0, -1.0, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = np.where(length > 1e-12, u / length, [0.0, 0.0, 1.0])
        mu[:, source] *= np.clip(np.cos(at) / length, 1e-3, 1e3) ** 3
    q[:, source] = np.concatenate([direction * np.cos(at), sign * np.sin(at)], axis=-1)
    free = np.ones((q.shape[1], 3), dtype=bool)
    free[source, 2] = False
    profile = refine(problem.rows(row), y[row], q, mu, free=free, max_iterations=100, promise=_PROMISE)
    # A refinement that did not converge gives no value of the profile; the points beyond it decide.
    chi2 = np.where(profile.converged, profile.chi2, -np.inf)
    return np.asarray(chi2 - fits.chi2[row])
