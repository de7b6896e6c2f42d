"""Substitution of a missing second vector by an earlier first vector, possible while the field rotates.

See docs/theory/complementary-filters.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from adcs.complementary.names import RULES, Rule
from arrays.io.errors import check_positive


@dataclass(frozen=True)
class Substitution:
    """Substitution of a missing second vector.

    Attributes
    ----------
    rule : {'magnetometer-only', 'raw', 'transported'}
        See docs/theory/complementary-filters.md.
    delay_s : float
        Age of the field in use.

    Raises
    ------
    ValueError
        The rule is unknown or the delay is not positive.
    """

    rule: Rule = "magnetometer-only"
    delay_s: float = 500.0

    def __post_init__(self) -> None:
        if self.rule not in RULES:
            raise ValueError(f"Input rule must be one of {', '.join(RULES)}; instead received {self.rule!r}.")
        check_positive(delay_s=self.delay_s)


NO_SUBSTITUTE = Substitution()


def delay_steps(substitution: Substitution, dt_s: float) -> int:
    """Return the delay M in samples, 1 at least."""
    return 0 if substitution.rule == "magnetometer-only" else max(1, round(substitution.delay_s / dt_s))
