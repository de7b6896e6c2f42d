"""Star camera: a pinhole or equidistant lens with the distortion of Brown and Conrady."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from arrays.io.errors import check_positive
from arrays.typing import FloatArray

Projection = Literal["pinhole", "equidistant"]

MOST_PIXELS = 100_000
"""Largest number of pixels of either side of an image."""
SCALE_ARCSEC = (0.01, 3600.0)
"""Range of a pixel's size, from the largest telescopes to one degree."""
_MOST_ANGLE_RAD = math.radians(89.0)
DISTORTION_DEGREES = np.array([3.0, 5.0, 2.0, 2.0])
"""Degree of each distortion in the place."""
WIDEST_RAD = math.radians(150.0)
"""Largest angle between opposite corners; tangents of larger angles are useless."""


@dataclass(frozen=True)
class StarCamera:
    """Camera with a lens: places s = tan(rad_per_px) x, corrected to q by the formula of Brown and Conrady.

    .. math:: q = s (1 + k_1 |s|^2 + k_2 |s|^4) + (2 p_1 s_x s_y + p_2 (|s|^2 + 2 s_x^2),
              p_1 (|s|^2 + 2 s_y^2) + 2 p_2 s_x s_y)

    The length of q is the tangent of the angle from the axis for a pinhole, and the angle for an equidistant lens.

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    rad_per_px : float
        Scale at the centre.
    radial : float
        Distortion k₁; if positive, a star is nearer to the centre than without it.
    projection : str
        "pinhole" or "equidistant".
    radial2 : float
        Distortion k₂.
    tangential : tuple of float
        Distortions p₁ and p₂, of a lens whose elements are not centred.

    Raises
    ------
    ValueError
        A value is not positive, or out of the range of :data:`MOST_PIXELS`, :data:`SCALE_ARCSEC` or :data:`WIDEST_RAD`.
    """

    width_px: int
    height_px: int
    rad_per_px: float
    radial: float = 0.0
    projection: Projection = "pinhole"
    radial2: float = 0.0
    tangential: tuple[float, float] = (0.0, 0.0)

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
        return 2.0 * (self.corner if self.projection == "equidistant" else math.atan(self.corner))

    @property
    def solid_angle_sr(self) -> float:
        """Solid angle of an image in the flat approximation."""
        return self.width_px * self.height_px * self.rad_per_px**2

    @property
    def corner(self) -> float:
        """Place |s| of a corner: tangent of its angle from the centre, or the angle, without distortion."""
        return 0.5 * math.hypot(self.width_px, self.height_px) * math.tan(self.rad_per_px)

    @property
    def corner_shift_px(self) -> float:
        """Displacement of a corner by the distortion, negative towards the centre."""
        k1, k2, x = self.radial * self.corner**2, self.radial2 * self.corner**4, 1.0
        for _ in range(8):  # Newton's method for x (1 + k1 x² + k2 x⁴) = 1
            x -= (x * (1.0 + k1 * x**2 + k2 * x**4) - 1.0) / (1.0 + 3.0 * k1 * x**2 + 5.0 * k2 * x**4)
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
        bent = self.corrected(self.image_places(points))
        if self.projection == "equidistant":
            # Distortions far outside the picture must not turn a star to behind the camera.
            angle = np.minimum(np.linalg.norm(bent, axis=1, keepdims=True), _MOST_ANGLE_RAD)
            bent = bent * np.tan(angle) / np.maximum(np.linalg.norm(bent, axis=1, keepdims=True), 1e-300)
        return bent

    @property
    def distortion(self) -> FloatArray:
        """Coefficients k₁, k₂, p₁, p₂."""
        return np.array([self.radial, self.radial2, *self.tangential])

    def image_places(self, points_px: FloatArray) -> FloatArray:
        """Return the places s (f, 2) of points (f, 2) of the image."""
        return (points_px - 0.5 * np.array([self.width_px, self.height_px])) * math.tan(self.rad_per_px)

    def exchange_sides(self, points_px: FloatArray) -> FloatArray:
        """Return the points (f, 2) of the image with left and right exchanged."""
        return points_px * [-1.0, 1.0] + [float(self.width_px), 0.0]

    def corrected(self, places: FloatArray) -> FloatArray:
        """Return the places q (f, 2) without distortion of places s (f, 2) of the image."""
        return places + distortion_terms(places) @ self.distortion

    def places(self, tangents: FloatArray) -> FloatArray:
        """Return the places q (f, 2) of tangents (f, 2)."""
        if self.projection == "pinhole":
            return tangents
        length = np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
        return np.asarray(tangents * np.arctan(length) / length)

    def place_changes(self, tangents: FloatArray, changes: FloatArray) -> FloatArray:
        """Return the changes (f, 2, n) of the places q by changes (f, 2, n) of tangents (f, 2)."""
        if self.projection == "pinhole":
            return changes
        length = np.maximum(np.linalg.norm(tangents, axis=1), 1e-12)[:, None, None]
        outward = tangents[:, :, None] / length
        along = outward * np.sum(outward * changes, axis=1, keepdims=True)
        return np.asarray((changes - along) * np.arctan(length) / length + along / (1.0 + length**2))

    def directions(self, points_px: ArrayLike) -> FloatArray:
        """Return unit vectors (f, 3) in the camera frame of points (f, 2).

        See docs/theory/star-identification.md.
        """
        tangents = self.tangents(points_px)
        outward = np.concatenate([tangents, np.full((len(tangents), 1), -1.0)], axis=1)
        return outward / np.linalg.norm(outward, axis=1, keepdims=True)


def distortion_terms(places: FloatArray) -> FloatArray:
    """Return the derivatives (f, 2, 4) of q by k₁, k₂, p₁, p₂ at places s (f, 2); see :data:`DISTORTION_DEGREES`."""
    x, y = places[:, 0], places[:, 1]
    squared = np.sum(places**2, axis=1)
    first = np.stack([2.0 * x * y, squared + 2.0 * y**2], axis=1)
    second = np.stack([squared + 2.0 * x**2, 2.0 * x * y], axis=1)
    return np.stack([places * squared[:, None], places * squared[:, None] ** 2, first, second], axis=2)


def as_projection(camera: StarCamera, projection: Projection) -> StarCamera:
    """Return a camera with another projection that shows the same up to the third power of the angle."""
    if projection == camera.projection:
        return camera
    # atan t = t - t³/3 + …
    cube = 1.0 / 3.0 if camera.projection == "equidistant" else -1.0 / 3.0
    return replace(camera, projection=projection, radial=camera.radial + cube, radial2=0.0, tangential=(0.0, 0.0))
