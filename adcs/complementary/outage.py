"""What stands in for the second vector while its sensor is out: an old first vector, as the field turns.

See docs/theory/complementary-filters.md.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from adcs import quaternion
from adcs.complementary.names import RULES, Rule
from arrays.io.errors import check_positive
from arrays.typing import FloatArray

Pair = tuple[FloatArray, FloatArray]


@dataclass(frozen=True)
class Substitution:
    """What stands in for a missing second vector.

    Attributes
    ----------
    rule : {'magnetometer-only', 'raw', 'transported'}
        See docs/theory/complementary-filters.md.
    delay_s : float
        Age of the field that is taken.

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
    """Delay M in samples, 1 at least."""
    return 0 if substitution.rule == "magnetometer-only" else max(1, round(substitution.delay_s / dt_s))


class Substitute:
    """The delay line of one run: measured first vectors, never one that was put in place of another.

    ``n_steps``: M.
    """

    def __init__(self, substitution: Substitution, n_steps: int) -> None:
        self._rule = substitution.rule
        self._line: deque[tuple[Pair, FloatArray, FloatArray]] = deque(maxlen=max(n_steps, 1))
        self._p = self._c = quaternion.IDENTITY

    def vector(self, first: Pair) -> Pair:
        """(body, reference) in place of the second vector now; NaN where there is none.

        ``first``: of this instant, the shapes of the answer.
        """
        missing = np.full_like(first[0], np.nan)
        if self._rule == "magnetometer-only" or len(self._line) < (self._line.maxlen or 0):
            return missing, missing
        (body, reference), p_then, c_then = self._line[0]
        if self._rule == "raw":
            return body, reference
        return (
            quaternion.rotate_back(quaternion.multiply(quaternion.conjugate(p_then), self._p), body),
            quaternion.rotate_back(quaternion.multiply(quaternion.conjugate(c_then), self._c), reference),
        )

    def store(self, first: Pair) -> None:
        """Store this instant's first vector."""
        self._line.append((first, self._p, self._c))

    def turn(self, body_rad: FloatArray, frame_rad: FloatArray) -> None:
        """Go on to the next instant by the rotations of body and frame [rad]."""
        self._p = quaternion.normalised(quaternion.multiply(self._p, quaternion.exp(body_rad)))
        self._c = quaternion.normalised(quaternion.multiply(self._c, quaternion.exp(frame_rad)))
