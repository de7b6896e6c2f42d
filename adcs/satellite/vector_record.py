"""Records of vector sensors and a gyro, for complementary filters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from arrays.typing import FloatArray

GyroSamples = Literal["mean", "point"]
GYRO_SAMPLES: tuple[GyroSamples, ...] = get_args(GyroSamples)
GAP_STEPS = 2.5
"""Length of a gap in usual steps; longer steps are gaps."""


def steps_s(time_s: FloatArray) -> FloatArray:
    """Return the steps (n,) that end at n ascending times; the first is the median."""
    steps = np.diff(time_s)
    if time_s.ndim != 1 or len(time_s) < 2 or not (np.isfinite(steps) & (steps > 0.0)).all():
        raise ValueError("Input time_s must ascend and have at least two instants; instead it does not.")
    return np.concatenate([[np.median(steps)], steps])


def instants_within(seconds: float, time_s: FloatArray) -> int:
    """Return the number, 1 to n, of n ascending times in a duration, by their median step."""
    return max(1, min(len(time_s), round(seconds / float(np.median(np.diff(time_s)))))) if len(time_s) > 1 else 1


def step_rates(rate_rad_s: FloatArray, dt_s: FloatArray, samples: GyroSamples = "mean") -> FloatArray:
    """Return mean rates (n, 3) over the steps to each instant, from a gyro's samples (n, 3).

    A sample is the ``mean`` rate since the one before, or the rate at a ``point`` in time; then the mean of two samples
    is the rate between them. Without a sample (NaN) the last one is held, and the next one corrects for it. So no
    rotation is lost, and no sample is used before its time. Across a gap the rate is the mean of both ends.
    """
    if samples not in GYRO_SAMPLES:
        raise ValueError(f"Input samples must be one of {', '.join(GYRO_SAMPLES)}; instead received {samples!r}.")
    rows = np.flatnonzero(np.isfinite(rate_rad_s).all(axis=1))
    if not len(rows) or rows[0] != 0:
        raise ValueError("Input gyro_rad_s must have a reading at the first instant; instead received none.")
    read = rate_rad_s[rows]
    until = np.cumsum(dt_s)
    span = np.diff(until[rows], prepend=until[0] - dt_s[0])
    means = read.copy()
    between = 1 + np.flatnonzero((samples == "point") | (span[1:] > GAP_STEPS * np.median(span)))
    means[between] = 0.5 * (read[between - 1] + read[between])
    if len(rows) == len(rate_rad_s):
        return means
    last = np.searchsorted(rows, np.arange(len(rate_rad_s)), side="right") - 1
    found = read[last]
    held = span - dt_s[rows]
    made_up = (means[1:] * span[1:, None] - read[:-1] * held[1:, None]) / dt_s[rows[1:], None]
    found[rows[0]], found[rows[1:]] = means[0], made_up
    return found


@dataclass(frozen=True, eq=False)
class VectorRecord:
    """Readings of one or several runs at n instants, NaN where missing, with their reference vectors.

    Attributes
    ----------
    dt_s : ndarray, shape (n,)
        Steps to each instant from :func:`steps_s`; the first one is only the time for which the first readings correct.
    rate_rad_s : ndarray, shape (R, n, 3)
        Mean rate of the gyro over the step that ends at each instant; see :func:`step_rates`.
    first_body, second_body : ndarray, shape (R, n, 3)
        Measured vectors, such as the field and the Sun, of any length.
    first_reference, second_reference : ndarray, shape (R or 1, n, 3)
        The same vectors in the reference frame.
    frame_rate_rad_s : ndarray, shape (R or 1, n, 3)
        Rate of the reference frame against inertial space, in its own axes, over the step that ends at each instant.

    Raises
    ------
    ValueError
        The shapes do not match, the step is not positive, a rate or reference is not finite, or a vector is zero.
    """

    dt_s: FloatArray
    rate_rad_s: FloatArray
    first_body: FloatArray
    second_body: FloatArray
    first_reference: FloatArray
    second_reference: FloatArray
    frame_rate_rad_s: FloatArray

    def __post_init__(self) -> None:
        for name in ("rate_rad_s", *_OF_RUNS, *_OF_FRAME):
            values = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if values.ndim not in (2, 3):
                raise ValueError(f"Input {name} must have shape (R, n, 3) or (n, 3); instead received {values.shape}.")
            object.__setattr__(self, name, values[None] if values.ndim == 2 else values)
        n_runs, n = self.rate_rad_s.shape[:2]
        given = np.asarray(self.dt_s, dtype=np.float64)
        if given.shape != (n,) or not ((given > 0.0) & (given < np.inf)).all():
            raise ValueError(f"Input dt_s must be positive and finite, of shape ({n},); instead received others.")
        object.__setattr__(self, "dt_s", given)
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
        """Number R of runs."""
        return self.rate_rad_s.shape[0]

    @property
    def usual_dt_s(self) -> float:
        """Median step; 1 without any instant."""
        return float(np.median(self.dt_s)) if len(self) else 1.0

    def __len__(self) -> int:
        """Return the number of instants."""
        return self.rate_rad_s.shape[1]


_OF_RUNS = ("first_body", "second_body")
_OF_FRAME = ("first_reference", "second_reference", "frame_rate_rad_s")
