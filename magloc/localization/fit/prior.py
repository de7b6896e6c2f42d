"""Prior knowledge of a source."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.errors import LARGEST
from arrays.typing import BoolArray, FloatArray
from magloc.measurement.known_moment import KnownMoment

if TYPE_CHECKING:
    from magloc.measurement.whitened import ScaledSensors

# Default σ of a stated moment, relative to its modulus.
_DEFAULT_SIGMA = 0.1


@dataclass(frozen=True)
class SourcePrior:
    """Prior knowledge of a source; solutions outside its bounds are rejected.

    Attributes
    ----------
    low_m, high_m : tuple of 3 floats
        Bounds of the position in the array's frame [m]: a box, a slab or a half-space. Infinite for no bound.
    largest_moment_Am2 : float
        Upper bound of the moment's modulus [A·m²].
    known_moment_Am2 : float or tuple of 3 floats, optional
        Known modulus of the moment, or its known components in the array's frame [A·m²]. It counts as one more
        measurement, or as three.
    known_moment_sigma_Am2 : float, optional
        Standard deviation of the known modulus, or of each known component; a tenth of the modulus by default.

    Raises
    ------
    ValueError
        The bounds exclude all sources, or a known moment or its σ is not positive.

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
    known_moment_Am2: float | tuple[float, float, float] | None = None
    known_moment_sigma_Am2: float | None = None

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError(
                f"Input low_m must be below high_m along every axis; instead received {self.low_m}, {self.high_m}."
            )
        if not self.largest_moment_Am2 > 0.0:
            raise ValueError(f"Input largest_moment_Am2 must be positive; instead received {self.largest_moment_Am2}.")
        if self.known_moment_Am2 is None:
            if self.known_moment_sigma_Am2 is not None:
                raise ValueError("Input known_moment_sigma_Am2 must come with known_moment_Am2; instead it came alone.")
            return
        value = np.atleast_1d(np.asarray(self.known_moment_Am2, dtype=np.float64))
        if (
            value.shape not in ((1,), (3,))
            or not 0.0 < np.abs(value).max() <= LARGEST
            or value[0] <= 0.0 == value.size - 1
        ):
            raise ValueError(
                f"Input known_moment_Am2 must be a positive number up to {LARGEST:g} or three numbers, not all zero;"
                f" instead received {self.known_moment_Am2}."
            )
        sigma = self.known_moment_sigma_Am2
        if sigma is not None and not 0.0 < sigma < math.inf:
            raise ValueError(f"Input known_moment_sigma_Am2 must be positive and finite; instead received {sigma}.")

    @property
    def known_moment(self) -> KnownMoment | None:
        """Known moment as a pseudo-measurement."""
        if self.known_moment_Am2 is None:
            return None
        value = tuple(np.atleast_1d(self.known_moment_Am2).tolist())
        sigma = self.known_moment_sigma_Am2
        return KnownMoment(value, _DEFAULT_SIGMA * float(np.linalg.norm(value)) if sigma is None else sigma)

    def allows_position(self, position_m: FloatArray) -> Any:
        """Return whether positions (..., 3) lie within the bounds."""
        return np.all((position_m >= np.asarray(self.low_m)) & (position_m <= np.asarray(self.high_m)), axis=-1)

    def allows_moment(self, moment_Am2: FloatArray) -> Any:
        """Return whether moments (..., 3) lie within the bound."""
        return np.linalg.norm(moment_Am2, axis=-1) <= self.largest_moment_Am2

    def allows(self, sensors: ScaledSensors, q: FloatArray, mu: FloatArray) -> BoolArray:
        """Return whether sources at q (..., 4) with moments μ (..., 3) lie within all bounds."""
        with np.errstate(invalid="ignore"):
            allowed = self.allows_position(sensors.position(q)) & self.allows_moment(sensors.moment(q, mu))
        return np.asarray(allowed)


NOTHING_KNOWN = SourcePrior()
