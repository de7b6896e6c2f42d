"""How far an ellipsoid shrinks to a strip: the step λ of the one-parameter family, its optimum and its bounds.

See docs/theory/guaranteed-ellipsoids.md. Source: Pankratova, Sholokhov, Cybernetics and Systems Analysis 55(1), 2019.
The tightening of the strip, the search of the cubic's root and the floors are ours.
"""

from __future__ import annotations

from typing import Literal, get_args

StepRule = Literal["lemma", "optimal", "tightened"]
STEP_RULES: tuple[StepRule, ...] = get_args(StepRule)
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
    from scipy.optimize import brentq

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
