"""Matcher that is robust to lost, false and blurred lights: triangle hypotheses, verified by all stars.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.vision.paper_matcher import SLIVER_RAD, CameraFix, camera_fix
from adcs.mockup.vision.similarity import fit_similarity, mirrored_image, pairs_of
from adcs.mockup.vision.triangles import LightTriangles, TriangleCatalogue, delaunay_triangles
from adcs.stars.identification import NoFix
from arrays.typing import ComplexArray, FloatArray, IntArray

# Number of best hypotheses that are refined; their counts are often equal.
_CHECKED_AGAIN = 6
# Radius at which two fits are compared; if they agree there, they agree in the whole image.
_IMAGE_RADIUS_PX = 400.0


@dataclass(frozen=True, eq=False)
class RobustMatcher:
    """Matcher by triangles in a k-d tree, gates, and the number of stars that fit.

    Attributes
    ----------
    catalogue : TriangleCatalogue
        Catalogue of the lights.
    m_per_px : float
        Nominal scale of the image on the ceiling.
    radius_rad : float
        Largest distance of two pairs of angles.
    scale_range : tuple of two floats
        Least and largest ratio of a fitted scale to the nominal one.
    triangle_residual_m : float
        Largest root mean square residual of a similarity of three corners.
    inlier_m, refit_m : float
        Largest distance of a star from its light in the first check, and in the fits.
    hypotheses : int
        Largest number of matches that are checked.
    refits : int
        Largest number of fits of each of the best hypotheses.
    minimum_inliers : int
        Least number of stars that the fix must explain.
    minimum_fraction : float
        Least share of the image's stars that the fix must explain.
    most_chance : float
        Largest expected number of hypotheses of one image that fit as well by chance. It is far below the wanted rate
        of false fixes, because the fit adapts pose and scale to chance matches too.

    Examples
    --------
    >>> from adcs import mockup
    >>> catalogue = mockup.TriangleCatalogue.of(mockup.led_sky().positions_m)
    >>> matcher = mockup.RobustMatcher(catalogue, m_per_px=0.0014)
    >>> matcher.identify([[0.0, 0.0], [50.0, 0.0]]).reason
    '2 stars, 5 needed'
    """

    catalogue: TriangleCatalogue
    m_per_px: float
    radius_rad: float = math.radians(1.5)
    scale_range: tuple[float, float] = (0.8, 1.25)
    triangle_residual_m: float = 0.008
    inlier_m: float = 0.024
    refit_m: float = 0.008
    hypotheses: int = 400
    refits: int = 3
    minimum_inliers: int = 5
    minimum_fraction: float = 0.5
    most_chance: float = 1e-7

    def identify(self, points_px: ArrayLike) -> CameraFix | NoFix:
        """Identify the pose of the camera from the stars of an image.

        Parameters
        ----------
        points_px : array_like, shape (f, 2)
            Centred pixels: relative to the optical centre, undistorted, y up.

        Returns
        -------
        CameraFix or NoFix
            Pose, or the reason for which there is none.

        Raises
        ------
        ValueError
            The shape does not match, or a number is not finite.
        """
        image = mirrored_image(points_px)
        needed = max(self.minimum_inliers, math.ceil(self.minimum_fraction * len(image)))
        if len(image) < needed:
            return NoFix(f"{len(image)} stars, {needed} needed")
        a, b = self._hypotheses(image, delaunay_triangles(image, SLIVER_RAD))
        if not len(a):
            return NoFix("no triangle of the image is in the catalogue")
        counts, misses = self._count_inliers(image, a, b)
        fits: list[tuple[complex, complex, IntArray]] = []
        for i in np.lexsort((misses, -counts))[:_CHECKED_AGAIN]:
            if not any(self._are_one(fit, complex(a[i]), complex(b[i])) for fit in fits):
                fits.append(self._refit(image, complex(a[i]), complex(b[i])))
        a_best, b_best, stars = max(fits, key=lambda fit: len(fit[2]))
        if len(stars) < needed:
            return NoFix(f"{len(stars)} of {len(image)} stars fit, {needed} needed")
        if any(len(fit[2]) == len(stars) and not self._are_one(fit, a_best, b_best) for fit in fits):
            return NoFix(f"{len(stars)} of {len(image)} stars fit at several places")
        fix = camera_fix(self.catalogue, image, stars, a_best, b_best, len(stars))
        chance = self._chance(fix, len(image), len(a))
        if chance > self.most_chance:
            return NoFix(f"{len(stars)} of {len(image)} stars fit, as do {chance:.1g} false hypotheses per image")
        return fix

    def _hypotheses(self, image: ComplexArray, triangles: LightTriangles) -> tuple[ComplexArray, ComplexArray]:
        """Return the similarities of matches that pass the gates, sorted by the difference of their angles."""
        known = self.catalogue.triangles
        near = self.catalogue.angle_tree.query_ball_point(triangles.angles_rad, self.radius_rad)
        found: list[list[int]] = np.asarray(near, dtype=object).tolist()
        mine = np.repeat(np.arange(len(triangles)), [len(matches) for matches in found])
        theirs = np.array([match for matches in found for match in matches], dtype=np.intp)
        # The image has been mirrored, so that a true match has the same orientation.
        handed = triangles.is_counter_clockwise[mine] == known.is_counter_clockwise[theirs]
        mine, theirs = mine[handed], theirs[handed]
        seen, lights = image[triangles.corners[mine]], self.catalogue.plane[known.corners[theirs]]
        a, b = fit_similarity(seen, lights)
        residual = np.abs(a[:, None] * seen + b[:, None] - lights)
        scale = np.abs(a) / self.m_per_px
        passed = np.sqrt((residual**2).mean(axis=1)) < self.triangle_residual_m
        passed &= (self.scale_range[0] <= scale) & (scale <= self.scale_range[1])
        difference = np.hypot(*(triangles.angles_rad[mine] - known.angles_rad[theirs]).T)
        order = np.argsort(difference[passed], kind="stable")[: self.hypotheses]
        return a[passed][order], b[passed][order]

    def _count_inliers(self, image: ComplexArray, a: ComplexArray, b: ComplexArray) -> tuple[IntArray, FloatArray]:
        """Return the number of lights with a star near them, and the sum of squared distances, by hypothesis."""
        placed = pairs_of(a[:, None] * image + b[:, None])
        distance, light = self.catalogue.star_tree.query(placed, distance_upper_bound=self.inlier_m)
        light = np.sort(np.where(np.isfinite(distance), light, -1), axis=1)
        is_first = np.diff(light, axis=1, prepend=-1) > 0
        misses = np.minimum(distance, self.inlier_m) ** 2
        return is_first.sum(axis=1), misses.sum(axis=1)

    def _chance(self, fix: CameraFix, stars: int, hypotheses: int) -> float:
        """Return the expected number of hypotheses with as good a match by chance.

        Three corners fit by construction. Each other star is within r of a light with a probability equal to the part
        of the ceiling within r of a light.
        """
        density = self.catalogue.n_stars / float(np.prod(np.ptp(self.catalogue.positions_m, axis=0)))
        # The mean square of distances by chance within r is half of r².
        covered = min(density * math.pi * 2.0 * fix.rms_m**2, 1.0)
        others = len(fix.stars) - 3
        return hypotheses * math.comb(stars - 3, others) * covered**others

    def _are_one(self, fit: tuple[complex, complex, IntArray], a: complex, b: complex) -> bool:
        """Return whether a hypothesis is near a fit all over the image."""
        return abs(fit[0] - a) * _IMAGE_RADIUS_PX + abs(fit[1] - b) < self.inlier_m

    def _refit(self, image: ComplexArray, a: complex, b: complex) -> tuple[complex, complex, IntArray]:
        """Refine a fit by the stars near their lights; also return these stars."""
        stars = one_to_one(self.catalogue, image, a, b, self.inlier_m)
        for _ in range(self.refits):
            if len(stars) < 2:
                break
            fitted = fit_similarity(image[stars[:, 0]], self.catalogue.plane[stars[:, 1]])
            a, b = complex(fitted[0]), complex(fitted[1])
            near = one_to_one(self.catalogue, image, a, b, self.refit_m)
            if np.array_equal(near, stars):
                break
            stars = near
        return a, b, stars


def one_to_one(catalogue: TriangleCatalogue, image: ComplexArray, a: complex, b: complex, radius_m: float) -> IntArray:
    """Match stars (k, 2) of image and catalogue within a distance under a fit, each light once.

    ``image`` (f,): mirrored image points x - iy [px]. ``a``, ``b``: see :mod:`adcs.mockup.vision.similarity`. A light
    with several stars keeps the nearest.
    """
    found = catalogue.star_tree.query(pairs_of(a * image + b), distance_upper_bound=radius_m)
    distance, light = np.asarray(found[0]), np.asarray(found[1], dtype=np.intp)
    star = np.argsort(distance, kind="stable")[: np.count_nonzero(np.isfinite(distance))]
    _, first = np.unique(light[star], return_index=True)
    star = star[first]
    return np.stack([star, light[star]], axis=1)
