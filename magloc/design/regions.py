"""Regions of the sources of a design task, and criteria to minimise."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.special import betainc

from arrays.typing import FloatArray
from magloc.navigation.rotations import unit_across


class Region(Protocol):
    """Distribution of positions."""

    def positions(self, cube: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] for points (n, 3) of the unit cube."""


@dataclass(frozen=True)
class Cap:
    """Sources within an angle of a direction: a shell around the origin, or a part of it.

    Distances are evenly distributed, directions evenly over the sphere.

    Attributes
    ----------
    nearest_m, farthest_m : float
        Distance from the origin of the array's frame.
    towards : tuple, shape (3,)
        Axis of the cap, of any length.
    half_angle_rad : float
        π for the whole shell, π/2 for a half-space.
    """

    nearest_m: float
    farthest_m: float
    towards: tuple[float, float, float] = (1.0, 0.0, 0.0)
    half_angle_rad: float = np.pi

    def positions(self, cube: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] for points (n, 3) of the unit cube."""
        along = 1.0 - cube[:, :1] * (1.0 - np.cos(self.half_angle_rad))
        directions = around(np.array(self.towards), along, cube[:, 1:2])
        return directions * (self.nearest_m + cube[:, 2:3] * (self.farthest_m - self.nearest_m))


@dataclass(frozen=True)
class Block:
    """Sources evenly distributed over a box along the axes.

    Attributes
    ----------
    low_m, high_m : tuple, shape (3,)
        Corners.
    """

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]

    def positions(self, cube: FloatArray) -> FloatArray:
        """Return positions (n, 3) [m] for points (n, 3) of the unit cube."""
        low = np.array(self.low_m)
        return low + cube * (np.array(self.high_m) - low)


class Criterion(Protocol):
    """Criterion to minimise, a function of the range deviations of many sources."""

    def weights(self, n: int) -> FloatArray:
        """Return the weights (n,) of n deviations in ascending order."""

    def of(self, deviations: FloatArray) -> float:
        """Return the criterion of deviations (n,), without smoothing."""


@dataclass(frozen=True)
class Quantile:
    """Deviation that a share of the sources stays below.

    Attributes
    ----------
    level : float
        Share of the sources.
    """

    level: float = 0.95

    def weights(self, n: int) -> FloatArray:
        """Return Harrell and Davis' weights of the order statistics, a smooth quantile.

        Source: Biometrika 69 (1982).
        """
        edges = np.arange(n + 1) / n
        return np.diff(betainc((n + 1) * self.level, (n + 1) * (1.0 - self.level), edges))

    def of(self, deviations: FloatArray) -> float:
        """Return the order statistic; an infinite neighbour does not change it."""
        return float(np.quantile(deviations, self.level, method="inverted_cdf"))

    def __str__(self) -> str:
        return f"q{100.0 * self.level:g}"


@dataclass(frozen=True)
class Mean:
    """Mean deviation."""

    def weights(self, n: int) -> FloatArray:
        """Return equal weights."""
        return np.full(n, 1.0 / n)

    def of(self, deviations: FloatArray) -> float:
        """Return the arithmetic mean."""
        return float(np.mean(deviations))

    def __str__(self) -> str:
        return "mean"


def around(axis: FloatArray, along: FloatArray, turn: FloatArray) -> FloatArray:
    """Return unit vectors with given cosines (n, 1) to an axis (3,).

    They are turned around it by shares (n, 1) of a revolution.
    """
    n = axis / np.linalg.norm(axis)
    first = unit_across(n)
    across = np.sqrt(np.maximum(0.0, 1.0 - along * along))
    angle = 2.0 * np.pi * turn
    return along * n + across * (np.cos(angle) * first + np.sin(angle) * np.cross(n, first))
