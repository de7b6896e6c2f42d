"""Guaranteed ellipsoids, one operation and one run at a time in NumPy: the oracle of the compiled observer.

See docs/theory/guaranteed-ellipsoids.md. Source: Pankratova, Sholokhov, Cybernetics and Systems Analysis 55(1), 2019.
The tightening of the strip, the search of the cubic's root and the floors are ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import brentq

from adcs.ellipsoids.ellipsoid import Ellipsoid, measurement_direction, segment_shape, shape_matrix
from adcs.ellipsoids.names import StepRule
from adcs.ellipsoids.observer import INFLATION, BoundedSystem
from arrays.typing import FloatArray

EPS = float(np.finfo(np.float64).eps)
# A direction along which the ellipsoid is thinner than this much of its trace is not seen by a reading.
UNSEEN_RTOL = 1e-12
# Floors, all of which enlarge the set. Without the first, cut after cut along a tangent makes the set vanish.
SMALLEST_TIGHTENED_DELTA = 1e-3
SMALLEST_GROWTH = 1e-6
LARGEST_STEP = 1.0 - 1e-9


def is_informative(mu: float, delta: float, g: float) -> bool:
    """Whether a strip decreases the trace: F'(0) = δ² - μ² - g < 0.

    A strip that contains the ellipsoid, δ ≥ |μ| + 1, never does.
    """
    return mu * mu + g > delta * delta


def growth(mu: float, delta: float, step: float, margin: float = 0.0) -> float:
    """β² = 1 + λ (δ²/(1 - λ) - μ²), the factor of the shape after a step λ in [0, 1), where e² is known to a margin.

    With another e² the same cut has another λ, but the same λ μ² and λ δ²: only 1 - λ is not known.
    """
    return 1.0 + step * (delta * delta / (1.0 - step * (1.0 + margin)) - mu * mu) + margin


def trace_ratio(mu: float, delta: float, g: float, step: float) -> float:
    """F(λ) = β² (1 - λ g), the trace after a step relative to that before."""
    return growth(mu, delta, step) * (1.0 - step * g)


def lemma_step(mu: float, delta: float, g: float) -> float:
    """The source paper's simplified step λ = 1 - δ²/(g + μ²) of an informative strip.

    It gives β² = 1 + λ g and F = 1 - λ² g², which is always a decrease; it is no minimum.
    """
    return min(1.0 - delta * delta / (g + mu * mu), LARGEST_STEP)


def optimal_step(mu: float, delta: float, g: float) -> float:
    """The step of an informative strip that minimises the trace.

    (1 - λ)² F'(λ) is a cubic in λ. In s = 1 - λ it is, to the sign, s² (b + 2 g μ² s) - δ² (1 - g) with
    b = g (1 - δ²) + μ² (1 - 2 g), which keeps the digits of a small s. It is negative at s = 0, positive at s = 1, and
    has one root between.
    """
    a, b, c = 2.0 * g * mu * mu, g * (1.0 - delta * delta) + mu * mu * (1.0 - 2.0 * g), delta * delta * (1.0 - g)

    def cubic(s: float) -> float:
        return s * s * (b + a * s) - c

    smallest = 1.0 - LARGEST_STEP
    if cubic(smallest) >= 0.0:
        return LARGEST_STEP
    return 1.0 - float(brentq(cubic, smallest, 1.0, xtol=1e-20, rtol=1e-15))


def tightened_strip(mu: float, delta: float) -> tuple[float, float]:
    """The part [max(-1, μ-δ), min(1, μ+δ)] of a strip that touches the ellipsoid, as middle and half-width.

    It cuts the same set from the ellipsoid, with a smaller bound. The half-width has a floor of 0.001.
    """
    low, high = max(-1.0, mu - delta), min(1.0, mu + delta)
    return 0.5 * (low + high), max(0.5 * (high - low), SMALLEST_TIGHTENED_DELTA)


def cut(mu: float, delta: float, g: float, rule: StepRule, margin: float = 0.0) -> tuple[float, float, float] | None:
    r"""Middle μ of the strip that is used, step λ and growth β² of an update, floors included.

    ``mu``, ``delta``, ``g``: of a strip that touches the ellipsoid, \|μ\| ≤ 1 + δ. ``rule``, one of 'lemma', 'optimal',
    'tightened': ``tightened`` is the optimal step of :func:`tightened_strip`. ``margin``: to which part of itself e² is
    known. Returns: None where the update would not decrease the trace.
    """
    if rule == "tightened":
        mu, delta = tightened_strip(mu, delta)
    if not is_informative(mu, delta, g):
        return None
    step = lemma_step(mu, delta, g) if rule == "lemma" else optimal_step(mu, delta, g)
    step = min(step, 1.0 / (1.0 + 2.0 * margin))
    beta2 = max(growth(mu, delta, step, margin), SMALLEST_GROWTH)
    return (mu, step, beta2) if beta2 * (1.0 - step * g + margin) < 1.0 else None


def transformed(ellipsoid: Ellipsoid, A: ArrayLike, offset: ArrayLike = 0.0) -> Ellipsoid:
    """Ellipsoid of all A x + offset.

    Shape ``offset`` (m,). ``A`` (m, n): may be singular or map to another dimension. Returns: exact but for an addition
    of some eps, which covers rounding: a flat or tiny ellipsoid would lose its points to it.
    """
    A, offset = np.asarray(A, dtype=np.float64), np.asarray(offset, dtype=np.float64)
    # An entry of A H Aᵀ is known to n eps r_i r_j, see the notes of intersect_strip.
    reach = np.abs(A) @ ellipsoid.half_widths
    shape = A @ ellipsoid.shape @ A.T + 4.0 * ellipsoid.n * EPS * np.diag(reach**2)
    size = np.abs(A) @ np.abs(ellipsoid.centre) + np.abs(offset)
    return Ellipsoid(A @ ellipsoid.centre + offset, _around_rounded(_symmetric(shape), size))


def minimum_trace_sum(H: FloatArray, Q: FloatArray) -> FloatArray:
    r"""Shape of the ellipsoid of least trace around the sum of two ellipsoids.

    :math:`(1 + 1/k) Q + (1 + k) H` with :math:`k^2 = \mathrm{tr} Q / \mathrm{tr} H`; its trace is
    :math:`(\sqrt{\mathrm{tr} H} + \sqrt{\mathrm{tr} Q})^2`.
    ``H``, ``Q`` (n, n): positive semidefinite; either may be zero or of low rank. Returns shape (n, n).
    """
    trace_H, trace_Q = float(np.trace(H)), float(np.trace(Q))
    if trace_Q == 0.0:
        return H
    if trace_H == 0.0:
        return Q
    # Of the roots, not of the traces: these may differ by more than a number can hold.
    k = math.sqrt(trace_Q) / math.sqrt(trace_H)
    return (1.0 + 1.0 / k) * Q + (1.0 + k) * H


def sum_with_ellipsoid(ellipsoid: Ellipsoid, Q: ArrayLike) -> Ellipsoid:
    """Ellipsoid of least trace around all x + w with wᵀ Q⁻¹ w ≤ 1.

    ``Q`` (n, n): positive semidefinite, singular ones as in :class:`Ellipsoid`.
    """
    added = shape_matrix(Q, ellipsoid.n, "Q")
    return Ellipsoid(ellipsoid.centre, minimum_trace_sum(ellipsoid.shape, added))


def sum_with_segment(ellipsoid: Ellipsoid, direction: ArrayLike, half_length: float) -> Ellipsoid:
    r"""Ellipsoid of least trace around all x + f η with \|η\| ≤ d.

    ``direction`` (n,): f; only its direction counts. ``half_length``: d, positive.
    """
    return Ellipsoid(
        ellipsoid.centre, minimum_trace_sum(ellipsoid.shape, segment_shape(direction, half_length, ellipsoid.n))
    )


class Outcome(IntEnum):
    """What a reading did to an ellipsoid."""

    UNINFORMATIVE = 0
    REDUCED = 1
    INCONSISTENT = 2


@dataclass(frozen=True, eq=False)
class StripUpdate:
    """Result of a reading.

    ``ellipsoid``: contains what the strip leaves of the ellipsoid before; the same where the outcome is not
    ``REDUCED``.
    """

    ellipsoid: Ellipsoid
    outcome: Outcome  # ``INCONSISTENT`` where strip and ellipsoid have no point in common


def intersect_strip(
    ellipsoid: Ellipsoid, direction: ArrayLike, value: float, bound: float, rule: StepRule = "optimal"
) -> StripUpdate:
    r"""Ellipsoid around its intersection with the strip \|y - hᵀx\| ≤ c.

    Parameters
    ----------
    direction : array_like, shape (n,)
        h, of any length but zero.
    value : float
        y, the reading.
    bound : float
        c, the largest error of the reading, positive.
    rule : {'optimal', 'tightened', 'lemma'}
        ``optimal`` has the least trace for the strip as it is; ``tightened`` first narrows the strip to where it
        touches the ellipsoid, which usually gives the smallest set (2 % above the true minimum in the plane, on
        average); ``lemma`` is the source paper's simplified step.

    Notes
    -----
    In one dimension the intersection of two intervals is an interval, and every rule
    gives it.

    Rounding is covered. With r = Σ \|h_i\| √H_ii, the largest half-width that an ellipsoid in the same box could have
    along h, e² is known to n eps r², and an entry of the cut shape to n eps (r/e)² √(H_ii H_jj); a matrix of entries
    below √(H_ii H_jj) is below n diag(H). So some n eps (r/e)² diag(H) is added, and as much to the growth of the
    shape, which may be a small difference of large numbers.
    """
    h = measurement_direction(direction, ellipsoid.n)
    x, H = ellipsoid.centre, ellipsoid.shape
    Hh = H @ h
    e2, trace = float(h @ Hh), ellipsoid.trace
    e = math.sqrt(max(e2, 0.0))
    nu = float(value - h @ x)
    c = bound + 4.0 * EPS * (abs(value) + float(np.abs(h) @ np.abs(x)))
    rounding = 4.0 * ellipsoid.n * EPS * float(np.abs(h) @ ellipsoid.half_widths) ** 2
    if abs(nu) > c + math.sqrt(max(e2, 0.0) + rounding):
        return StripUpdate(ellipsoid, Outcome.INCONSISTENT)
    if e2 <= UNSEEN_RTOL * trace * float(h @ h):
        return StripUpdate(ellipsoid, Outcome.UNINFORMATIVE)
    mu, delta = nu / e, c / e
    if ellipsoid.n == 1:
        if abs(mu) + 1.0 <= delta:
            return StripUpdate(ellipsoid, Outcome.UNINFORMATIVE)
        mu, delta = tightened_strip(mu, delta)
        shape = _around_rounded(delta * delta * H, np.abs(x) + ellipsoid.half_widths)
        return StripUpdate(Ellipsoid(x + (mu / e) * Hh, shape), Outcome.REDUCED)
    g = min(float(Hh @ Hh) / (e2 * trace), 1.0)
    margin = rounding / e2
    found = cut(mu, delta, g, rule, margin)
    if found is None:
        return StripUpdate(ellipsoid, Outcome.UNINFORMATIVE)
    mu, step, beta2 = found
    shape = beta2 * (H - (step / e2) * np.outer(Hh, Hh) + margin * np.diag(np.diagonal(H)))
    return StripUpdate(
        Ellipsoid(x + step * (mu / e) * Hh, _around_rounded(_symmetric(shape), np.abs(x))), Outcome.REDUCED
    )


def _around_rounded(shape: FloatArray, size: FloatArray) -> FloatArray:
    """Shape that also holds what rounding of the centre, a sum of terms up to size (n,), moves out of it."""
    return minimum_trace_sum(shape, np.diag(len(size) * (4.0 * EPS * size) ** 2))


def _symmetric(matrix: FloatArray) -> FloatArray:
    return 0.5 * (matrix + matrix.T)


def predict(system: BoundedSystem, ellipsoid: Ellipsoid, known_input: ArrayLike = 0.0) -> Ellipsoid:
    """Set of the next state: A x + u + w for all x and w of their ellipsoids.

    Parameters
    ----------
    known_input : array_like, shape (n,)
        u.
    """
    mapped = transformed(ellipsoid, system.A, known_input)
    return Ellipsoid(mapped.centre, minimum_trace_sum(mapped.shape, system.disturbance))


@dataclass(frozen=True, eq=False)
class Correction:
    """Result of the readings of one instant."""

    ellipsoid: Ellipsoid
    bounds: FloatArray  # (m,): bounds that the readings do not contradict: to be used from now on
    resets: int  # channels that contradicted the set


def correct(
    system: BoundedSystem,
    ellipsoid: Ellipsoid,
    readings: ArrayLike,
    bounds: FloatArray,
    *,
    rule: StepRule = "optimal",
    reinflation: FloatArray | None = None,
) -> Correction:
    """Set of the states that the readings of one instant allow, channel after channel.

    Parameters
    ----------
    ellipsoid : Ellipsoid
        Predicted set.
    readings : array_like, shape (m,)
        NaN where missing.
    bounds : ndarray, shape (m,)
        Bounds in force: ``system.bounds`` at first, then those of the correction before.
    rule : {'optimal', 'tightened', 'lemma'}
        See :func:`intersect_strip`.
    reinflation : ndarray, shape (n, n), optional
        Shape of an ellipsoid that is added to the set where a reading contradicts it.
    """
    bounds, resets = bounds.copy(), 0
    for channel, y in enumerate(np.atleast_1d(np.asarray(readings, dtype=np.float64))):
        if np.isnan(y):
            continue
        h = system.directions[channel]
        update = intersect_strip(ellipsoid, h, float(y), float(bounds[channel]), rule)
        if update.outcome is Outcome.INCONSISTENT:
            if reinflation is not None:
                ellipsoid = sum_with_ellipsoid(ellipsoid, reinflation)
            bounds[channel] = max(abs(float(y - h @ ellipsoid.centre)), INFLATION * bounds[channel])
            resets += 1
            update = intersect_strip(ellipsoid, h, float(y), float(bounds[channel]), rule)
        ellipsoid = update.ellipsoid
    return Correction(ellipsoid, bounds, resets)
