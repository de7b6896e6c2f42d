"""Star catalogue and its search structures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree

from arrays.typing import BoolArray, FloatArray, IntArray

CELLS = 64
"""Number of cells of the sky's cube along each axis."""


class SkyCap(NamedTuple):
    """Part of the sky around a direction.

    Attributes
    ----------
    centre : ndarray, shape (3,)
        Unit vector in the catalogue's frame.
    radius_rad : float
        Largest angle from the centre.
    """

    centre: FloatArray
    radius_rad: float

    @classmethod
    def of(cls, right_ascension_rad: float, declination_rad: float, radius_rad: float) -> SkyCap:
        """Return the cap around right ascension and declination."""
        ra, dec = right_ascension_rad, declination_rad
        centre = np.array([math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)])
        return cls(centre, radius_rad)

    @property
    def share(self) -> float:
        """Solid angle over that of the whole sky."""
        return math.sin(0.5 * min(self.radius_rad, math.pi)) ** 2

    def widened(self, by_rad: float) -> SkyCap:
        """Return the cap with a larger radius."""
        return self._replace(radius_rad=self.radius_rad + by_rad)

    def contains(self, directions: FloatArray) -> BoolArray:
        """Return which unit vectors (…, 3) are inside."""
        half = 0.5 * np.linalg.norm(directions - self.centre, axis=-1)
        return np.asarray(2.0 * np.arcsin(np.minimum(half, 1.0)) <= self.radius_rad)

    def __str__(self) -> str:
        x, y, z = self.centre.tolist()
        ra, dec = math.degrees(math.atan2(y, x)) % 360.0, math.degrees(math.asin(z))
        return f"RA {ra:.3f}°, Dec {dec:+.3f}° within {math.degrees(self.radius_rad):g}°"


WHOLE_SKY = SkyCap(np.array([0.0, 0.0, 1.0]), math.pi)
"""Cap that contains every direction."""


class SkyCells(NamedTuple):
    """Stars of a catalogue by their cell of the cube [-1, 1]³."""

    directions: FloatArray  # (n, 3): ordered by cell
    begins: IntArray  # (CELLS³ + 1,)


@dataclass(frozen=True, eq=False)
class StarCatalogue:
    """Star catalogue; made by :meth:`of`.

    Attributes
    ----------
    numbers : ndarray, shape (n,)
        Numbers of the stars, such as those of Hipparcos.
    directions : ndarray, shape (n, 3)
        Unit vectors in the catalogue's frame.
    magnitudes : ndarray, shape (n,)
        Magnitudes.
    """

    numbers: IntArray
    directions: FloatArray
    magnitudes: FloatArray

    @classmethod
    def of(
        cls, numbers: ArrayLike, right_ascension_rad: ArrayLike, declination_rad: ArrayLike, magnitudes: ArrayLike
    ) -> StarCatalogue:
        """Return a catalogue from right ascension and declination, shape (n,) each.

        Raises
        ------
        ValueError
            The shapes differ, a number is not finite, or there are fewer than four stars.
        """
        ra, dec = np.asarray(right_ascension_rad, dtype=np.float64), np.asarray(declination_rad, dtype=np.float64)
        hip, magnitude = np.asarray(numbers, dtype=np.intp), np.asarray(magnitudes, dtype=np.float64)
        if not (ra.shape == dec.shape == hip.shape == magnitude.shape and ra.ndim == 1 and ra.size >= 4):
            raise ValueError(
                "Input numbers, right_ascension_rad, declination_rad and magnitudes must be of one shape (n,), "
                f"n at least 4; instead received shapes {hip.shape}, {ra.shape}, {dec.shape} and {magnitude.shape}."
            )
        if not (np.isfinite(ra).all() and np.isfinite(dec).all() and np.isfinite(magnitude).all()):
            raise ValueError("Inputs of a star catalogue must be finite; instead received NaN or infinity.")
        directions = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
        return cls(hip, directions, magnitude)

    def aberrated(self, velocity_m_s: ArrayLike) -> StarCatalogue:
        """Return the catalogue with aberration, up to v/c towards the velocity; 20.5″ for the Earth.

        ``velocity_m_s`` (3,): velocity against the solar system's centre, in the catalogue's frame.
        """
        beta = np.asarray(velocity_m_s, dtype=np.float64) / speed_of_light
        along = self.directions @ beta
        slower = np.sqrt(1.0 - beta @ beta)
        moved = slower * self.directions + np.outer(1.0 + along / (1.0 + slower), beta)
        return replace(self, directions=moved / (1.0 + along[:, None]))

    def rows(self, rows: IntArray) -> StarCatalogue:
        """Return the catalogue of some rows."""
        return StarCatalogue(self.numbers[rows], self.directions[rows], self.magnitudes[rows])

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the directions."""
        return cKDTree(self.directions)

    @cached_property
    def cells(self) -> SkyCells:
        """Directions by their cell of a cube, for the compiled search."""
        cell = np.clip(((self.directions + 1.0) * (0.5 * CELLS)).astype(np.intp), 0, CELLS - 1)
        number = cell @ np.array([CELLS * CELLS, CELLS, 1])
        order = np.argsort(number, kind="stable")
        begins = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=CELLS**3))])
        return SkyCells(self.directions[order], begins)
