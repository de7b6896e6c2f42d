"""Records of vector sensors and a gyro, for complementary filters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.io.errors import check_positive
from arrays.typing import FloatArray


@dataclass(frozen=True, eq=False)
class VectorRecord:
    """Readings of one or several runs at n instants, NaN where missing, and what they would be in the reference frame.

    Attributes
    ----------
    dt_s : float
        Between instants.
    rate_rad_s : ndarray, shape (R, n, 3)
        Gyro, from each instant to the next.
    first_body, second_body : ndarray, shape (R, n, 3)
        Measured vectors, such as the field and the Sun, of any length.
    first_reference, second_reference : ndarray, shape (R or 1, n, 3)
        The same in the reference frame.
    frame_rate_rad_s : ndarray, shape (R or 1, n, 3)
        Rate of the reference frame against inertial space, in its own axes.

    Raises
    ------
    ValueError
        The shapes do not match, the step is not positive, a rate or reference is not finite, or a vector is zero.
    """

    dt_s: float
    rate_rad_s: FloatArray
    first_body: FloatArray
    second_body: FloatArray
    first_reference: FloatArray
    second_reference: FloatArray
    frame_rate_rad_s: FloatArray

    def __post_init__(self) -> None:
        check_positive(dt_s=self.dt_s)
        for name in ("rate_rad_s", *_OF_RUNS, *_OF_FRAME):
            values = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if values.ndim not in (2, 3):
                raise ValueError(f"Input {name} must have shape (R, n, 3) or (n, 3); instead received {values.shape}.")
            object.__setattr__(self, name, values[None] if values.ndim == 2 else values)
        n_runs, n = self.rate_rad_s.shape[:2]
        for name in ("rate_rad_s", *_OF_RUNS, *_OF_FRAME):
            values = getattr(self, name)
            shape = (n_runs if name not in _OF_FRAME else self.first_reference.shape[0], n, 3)
            if values.shape != shape or shape[0] not in (1, n_runs):
                raise ValueError(f"Input {name} must have shape {shape}; instead received {values.shape}.")
            if name not in _OF_RUNS and not np.isfinite(values).all():
                raise ValueError(f"Input {name} must be finite; instead received a value that is not.")
            zero = (values == 0.0).all(axis=-1)
            if name not in ("rate_rad_s", "frame_rate_rad_s") and zero.any():
                instant = int(np.flatnonzero(zero.any(axis=0))[0])
                raise ValueError(
                    f"Input {name} must have a length; instead received a zero vector at instant {instant}."
                )

    @property
    def n_runs(self) -> int:
        """R."""
        return self.rate_rad_s.shape[0]

    def __len__(self) -> int:
        """Return the number of instants."""
        return self.rate_rad_s.shape[1]


_OF_RUNS = ("first_body", "second_body")
_OF_FRAME = ("first_reference", "second_reference", "frame_rate_rad_s")
