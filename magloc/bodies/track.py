"""Track of a body as a result, and the motion that a tracker assumes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from arrays.io.csv import Column
from arrays.typing import BoolArray, FloatArray
from magloc.bodies.poses import BodyPoses
from magloc.state_space import ornstein_uhlenbeck_step

_LARGEST_TURN_RAD = 0.5  # of a prediction; beyond it one Gaussian does not describe the pose
_LARGEST_WAY = 0.3  # the same of a translation, in radii of the array


@dataclass(frozen=True)
class BodyMotion:
    """Motion of a body: velocity and rotation rate with a typical size and a correlation time.

    Attributes
    ----------
    speed_m_s, turn_rad_s : float
        Standard deviations of velocity and rotation rate, along and about each axis.
    correlation_s : float
        Correlation time of both.
    """

    speed_m_s: float = 0.1
    turn_rad_s: float = 2.0
    correlation_s: float = 0.2

    def step(self, dt_s: float, radius_m: float) -> list[float]:
        """Return ten numbers of a step for the kernel, with lengths in radii."""
        lasts_s, left, root = ornstein_uhlenbeck_step(self.correlation_s, dt_s)
        parts = root[[0, 1, 1], [0, 0, 1]]
        return [
            *(lasts_s, left, *(self.speed_m_s / radius_m * parts)),
            *(lasts_s, left, *(self.turn_rad_s * parts)),
        ]

    def is_lost(self, dt_s: FloatArray, radius_m: float) -> BoolArray:
        """Return whether predictions over gaps (n,) are too uncertain for one Gaussian."""
        far: BoolArray = self.speed_m_s * dt_s > _LARGEST_WAY * radius_m
        return (self.turn_rad_s * dt_s > _LARGEST_TURN_RAD) | far


@dataclass(frozen=True, eq=False)
class BodyTrack(BodyPoses):
    """Poses of a body through time, one of each row.

    Attributes
    ----------
    nis : ndarray, shape (n,)
        Normalised innovation squared; `chi2` is the same.
    status : list of str
        "tracked", or why the row is not.
    velocity_m_s, rate_rad_s : ndarray, shape (n, 3)
        Velocity in the array's frame, rotation rate in the body's.
    """

    status: list[str] = None  # type: ignore[assignment]
    velocity_m_s: FloatArray = None  # type: ignore[assignment]
    rate_rad_s: FloatArray = None  # type: ignore[assignment]

    command = "magloc track --body"

    @classmethod
    def none(cls, n: int, width: int = 1, symmetry: str = "") -> BodyTrack:
        """Return n rows without a pose."""
        poses, (velocity, rate) = BodyPoses.none(n, width, symmetry), np.full((2, n, 3), np.nan)
        return cls(**vars(poses), status=[""] * n, velocity_m_s=velocity, rate_rad_s=rate)

    @property
    def nis(self) -> FloatArray:
        """Normalised innovation squared of each row (n,)."""
        return self.chi2[:, 0]

    def columns(self) -> dict[str, Column]:
        """Return the columns of the CSV file."""
        of_rates = {f"v{axis}_m_s": self.velocity_m_s[:, i] for i, axis in enumerate("xyz")}
        of_rates |= {f"rate_{axis}_deg_s": np.degrees(self.rate_rad_s[:, i]) for i, axis in enumerate("xyz")}
        return super().columns() | of_rates | {"status": self.status}

    def entries(self) -> Iterator[dict[str, object]]:
        """Return the results that ``magloc track --body --json`` prints."""
        for i, entry in enumerate(super().entries()):
            yield entry | {"status": self.status[i]}
