"""Star camera: a pinhole with the radial distortion of its lens."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import check_positive
from arrays.typing import FloatArray

MOST_PIXELS = 100_000
"""Largest number of pixels of either side of an image."""
SCALE_ARCSEC = (0.01, 3600.0)
"""Range of a pixel's size, from the largest telescopes to one degree."""
WIDEST_RAD = math.radians(150.0)
"""Largest angle between opposite corners; no pinhole lens shows more."""


@dataclass(frozen=True)
class StarCamera:
    """Pinhole camera with a lens: tangents s = tan(rad_per_px) x, distorted to s (1 + radial |s|²).

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    rad_per_px : float
        Scale at the centre.
    radial : float
        Distortion; if positive, a star is nearer to the centre than with a pinhole.

    Raises
    ------
    ValueError
        A value is not positive, or out of the range of :data:`MOST_PIXELS`, :data:`SCALE_ARCSEC` or :data:`WIDEST_RAD`.
    """

    width_px: int
    height_px: int
    rad_per_px: float
    radial: float = 0.0

    def __post_init__(self) -> None:
        check_positive(width_px=self.width_px, height_px=self.height_px, rad_per_px=self.rad_per_px)
        if max(self.width_px, self.height_px) > MOST_PIXELS:
            raise ValueError(
                f"Inputs width_px and height_px must be at most {MOST_PIXELS}; "
                f"instead received {self.width_px} and {self.height_px}."
            )
        low, high = SCALE_ARCSEC
        arcsec = math.degrees(self.rad_per_px) * 3600.0
        if not low * (1.0 - 1e-9) <= arcsec <= high * (1.0 + 1e-9):
            raise ValueError(f"Input rad_per_px must be {low:g} to {high:g} arc seconds; instead received {arcsec:g}.")
        if self.diagonal_rad > WIDEST_RAD:
            raise ValueError(
                f"Input camera must be at most {math.degrees(WIDEST_RAD):.0f}° wide from corner to corner; "
                f"instead received {math.degrees(self.diagonal_rad):.1f}°."
            )

    @property
    def diagonal_rad(self) -> float:
        """Angle between opposite corners of the image."""
        return 2.0 * math.atan(self.corner)

    @property
    def solid_angle_sr(self) -> float:
        """Solid angle of an image in the flat approximation."""
        return self.width_px * self.height_px * self.rad_per_px**2

    @property
    def corner(self) -> float:
        """Tangent of the angle between a corner and the centre, without distortion."""
        return 0.5 * math.hypot(self.width_px, self.height_px) * math.tan(self.rad_per_px)

    @property
    def corner_shift_px(self) -> float:
        """Displacement of a corner by the distortion, negative towards the centre."""
        bent, x = self.radial * self.corner**2, 1.0
        for _ in range(8):  # Newton's method for x (1 + bent x²) = 1
            x -= (x * (1.0 + bent * x**2) - 1.0) / (1.0 + 3.0 * bent * x**2)
        return 0.5 * math.hypot(self.width_px, self.height_px) * (x - 1.0)

    def tangents(self, points_px: ArrayLike) -> FloatArray:
        """Return the tangents (f, 2) of points (f, 2), y up: components across the line of sight over that along it.

        Raises
        ------
        ValueError
            The shape does not match, or a number is not finite.
        """
        points = np.asarray(points_px, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise ValueError(
                f"Input points_px must be finite numbers of shape (f, 2); instead received shape {points.shape}."
            )
        pinhole = (points - 0.5 * np.array([self.width_px, self.height_px])) * math.tan(self.rad_per_px)
        bent: FloatArray = pinhole * (1.0 + self.radial * np.sum(pinhole**2, axis=1, keepdims=True))
        return bent

    def directions(self, points_px: ArrayLike) -> FloatArray:
        """Return unit vectors (f, 3) in the camera frame of points (f, 2).

        See docs/theory/star-identification.md.
        """
        tangents = self.tangents(points_px)
        outward = np.concatenate([tangents, np.full((len(tangents), 1), -1.0)], axis=1)
        return outward / np.linalg.norm(outward, axis=1, keepdims=True)
