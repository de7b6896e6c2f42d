"""What is known of a source beforehand."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.typing import BoolArray, FloatArray

if TYPE_CHECKING:
    from magloc.measurement.whitened import ScaledSensors


@dataclass(frozen=True)
class SourcePrior:
    """What is known of the source beforehand; solutions that contradict it are left out.

    Attributes
    ----------
    low_m, high_m : tuple of 3 floats
        Bounds of the position in the array's frame [m], infinite where there is none: a box, a slab or a half-space.
    largest_moment_Am2 : float
        Bound of the moment's modulus [A·m²].

    Raises
    ------
    ValueError
        The bounds leave nothing.

    Examples
    --------
    >>> import math
    >>> import magloc
    >>> low_m = (-math.inf, -math.inf, 0.0)
    >>> above = magloc.SourcePrior(low_m, largest_moment_Am2=500.0)
    >>> board = magloc.datasets.load("board")
    >>> magloc.locate(board.array, board.readings[0], prior=above)[0].best.position_m.round(3)
    array([-0.06, -0.05,  0.12])
    """

    low_m: tuple[float, float, float] = (-math.inf, -math.inf, -math.inf)
    high_m: tuple[float, float, float] = (math.inf, math.inf, math.inf)
    largest_moment_Am2: float = math.inf

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(
                f"Input low_m must be below high_m along every axis; instead received {self.low_m}, {self.high_m}."
            )
        if not self.largest_moment_Am2 > 0.0:
            raise ValueError(f"Input largest_moment_Am2 must be positive; instead received {self.largest_moment_Am2}.")

    def allows_position(self, position_m: FloatArray) -> Any:
        """Whether positions (..., 3) lie within the bounds."""
        return np.all((position_m >= np.asarray(self.low_m)) & (position_m <= np.asarray(self.high_m)), axis=-1)

    def allows_moment(self, moment_Am2: FloatArray) -> Any:
        """Whether moments (..., 3) are small enough."""
        return np.linalg.norm(moment_Am2, axis=-1) <= self.largest_moment_Am2

    def allows(self, sensors: ScaledSensors, q: FloatArray, mu: FloatArray) -> BoolArray:
        """Whether sources at q (..., 4) with scaled moments μ (..., 3) agree with both."""
        with np.errstate(invalid="ignore"):
            allowed = self.allows_position(sensors.position(q)) & self.allows_moment(sensors.moment(q, mu))
        return np.asarray(allowed)


NOTHING_KNOWN = SourcePrior()
