"""Stars of the real sky in an image: which they are, and where the camera looks, from the image and a catalogue alone.

See docs/theory/star-identification.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.stats import binom

from arrays.io.errors import check_positive
from arrays.typing import BoolArray, FloatArray, IntArray

# Brighter neighbours with which a star makes triangles, and the neighbours among which they are looked for.
_BRIGHTER = 4
_NEIGHBOURS = 24
# Stars of the catalogue in the triangles, per image on average, and of an image.
_BRIGHT_PER_IMAGE = 20
_IMAGE_STARS = 30
_CHECKED_AGAIN = 8
# Triangles that agree and are checked, of an image: seconds of work, and some hundred megabytes.
_MOST_HYPOTHESES = 250_000
_REFITS = 3
_COMPANIONS = 3  # of the catalogue, within the noise of one place
_LEAST_SPREAD = 0.5  # of the magnitudes of an image
_CLEARLY = 2.0  # difference of two squared distances: less is a toss
MOST_PIXELS = 100_000
"""Of either side of an image."""
SCALE_ARCSEC = (0.01, 3600.0)
"""Of a pixel: from the largest telescopes to a degree."""
WIDEST_RAD = math.radians(150.0)
"""Between opposite corners: no lens that maps like a pinhole shows more."""


@dataclass(frozen=True, eq=False)
class StarCatalogue:
    """Stars of the sky; made by :meth:`of`.

    Attributes
    ----------
    numbers : ndarray, shape (n,)
        Such as those of Hipparcos.
    directions : ndarray, shape (n, 3)
        Unit vectors in the catalogue's frame.
    magnitudes : ndarray, shape (n,)
    """

    numbers: IntArray
    directions: FloatArray
    magnitudes: FloatArray

    @classmethod
    def of(
        cls, numbers: ArrayLike, right_ascension_rad: ArrayLike, declination_rad: ArrayLike, magnitudes: ArrayLike
    ) -> StarCatalogue:
        """Catalogue from right ascension and declination, of shape (n,) each.

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

    @cached_property
    def tree(self) -> cKDTree:
        """Directions, for search."""
        return cKDTree(self.directions)


@dataclass(frozen=True)
class StarCamera:
    """A pinhole camera.

    Attributes
    ----------
    rad_per_px : float
        Scale at the centre [rad/px].

    Raises
    ------
    ValueError
        A value is not positive, or out of the range of :data:`MOST_PIXELS`, :data:`SCALE_ARCSEC` or :data:`WIDEST_RAD`.
    """

    width_px: int
    height_px: int
    rad_per_px: float

    def __post_init__(self) -> None:
        check_positive(**vars(self))
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
                f"An image must be at most {math.degrees(WIDEST_RAD):.0f}° wide from corner to corner; "
                f"instead received a camera of {math.degrees(self.diagonal_rad):.1f}°."
            )

    @property
    def diagonal_rad(self) -> float:
        """Angle between opposite corners."""
        return 2.0 * math.atan(0.5 * math.hypot(self.width_px, self.height_px) * math.tan(self.rad_per_px))

    @property
    def solid_angle_sr(self) -> float:
        """Part of the sphere that an image shows, as if it were flat."""
        return self.width_px * self.height_px * self.rad_per_px**2

    def directions(self, points_px: ArrayLike) -> FloatArray:
        """Unit vectors (f, 3) in the frame's axes of points (f, 2), y up; see docs/theory/star-identification.md.

        Raises
        ------
        ValueError
            The shape is another one, or a number is not finite.
        """
        points = np.asarray(points_px, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise ValueError(
                f"Input points_px must be finite numbers of shape (f, 2); instead received shape {points.shape}."
            )
        offset = (points - 0.5 * np.array([self.width_px, self.height_px])) * math.tan(self.rad_per_px)
        outward = np.concatenate([offset, np.full((len(offset), 1), -1.0)], axis=1)
        return outward / np.linalg.norm(outward, axis=1, keepdims=True)


@dataclass(frozen=True, eq=False)
class StarFix:
    """Attitude of a camera and its stars.

    Attributes
    ----------
    R_catalogue_from_frame : ndarray, shape (3, 3)
        Rotation of components in the frame's axes into those of the catalogue.
    stars : ndarray, shape (k, 2)
        Pairs of a star's number in the image and its row in the catalogue.
    rms_rad : float
        Root mean square angle of these stars from their catalogue's places [rad].
    log10_chance : float
        Logarithm of the number of attitudes expected to match as many stars by chance alone.
    """

    R_catalogue_from_frame: FloatArray
    stars: IntArray
    rms_rad: float
    log10_chance: float


@dataclass(frozen=True, eq=False)
class StarTriangles:
    """Triangles of stars: corners ordered by the opposite side, shortest first."""

    corners: IntArray  # (T, 3)
    sides: FloatArray  # (T, 3): chords, ascending
    is_counter_clockwise: BoolArray  # (T,): seen from the centre of the sphere


def star_triangles(directions: FloatArray, longest: float, neighbours: int = _BRIGHTER) -> StarTriangles:
    """Triangles of every star with its nearest brighter neighbours.

    ``directions`` (n, 3): unit vectors, brightest first. ``longest``: longest side, a chord. ``neighbours``: of each
    star. Returns: each triangle once.
    """
    n = len(directions)
    k = min(_NEIGHBOURS + 1, n)
    found = np.asarray(cKDTree(directions).query(directions, k=k)[1], dtype=np.intp).reshape(n, k)
    own = np.arange(n)[:, None]
    first = np.argsort(found >= own, axis=1, kind="stable")[:, : min(neighbours, k)]
    brighter = np.take_along_axis(found, first, axis=1)
    pairs = list(combinations(range(brighter.shape[1]), 2))
    if not pairs:
        return StarTriangles(np.empty((0, 3), dtype=np.intp), np.empty((0, 3)), np.empty(0, dtype=np.bool_))
    corners = np.concatenate([np.column_stack([own[:, 0], brighter[:, i], brighter[:, j]]) for i, j in pairs])
    corners = corners[(corners[:, 1:] < corners[:, :1]).all(axis=1)]
    opposite = np.stack(
        [
            np.linalg.norm(directions[corners[:, (i + 1) % 3]] - directions[corners[:, (i + 2) % 3]], axis=1)
            for i in range(3)
        ],
        axis=1,
    )
    order = np.argsort(opposite, axis=1)
    corners, sides = np.take_along_axis(corners, order, axis=1), np.take_along_axis(opposite, order, axis=1)
    short = sides[:, 2] <= longest
    # Turned inside out: the triple product is positive for corners that go round clockwise seen from the centre.
    one, two, three = np.moveaxis(directions[corners[short]], 1, 0)
    sense = np.sum(np.cross(one, two) * three, axis=-1) < 0.0
    return StarTriangles(corners[short], sides[short], sense)


@dataclass(frozen=True, eq=False)
class StarMatcher:
    """Lost-in-space identification of star images; made by :meth:`of`.

    Attributes
    ----------
    bright : ndarray
        Rows of the catalogue that make triangles, brightest first.
    triangles : StarTriangles
        Corners count in ``bright``.
    tree : cKDTree
        Of their sides.
    noise_px : float
        Standard deviation of a centroid, per axis [px].
    most_chance : float
        Attitudes as good as the fix that chance may produce.
    """

    catalogue: StarCatalogue
    camera: StarCamera
    bright: IntArray
    triangles: StarTriangles
    tree: cKDTree
    noise_px: float = 1.0
    most_chance: float = 1e-6

    @classmethod
    def of(cls, catalogue: StarCatalogue, camera: StarCamera, noise_px: float = 1.0) -> StarMatcher:
        """Matcher of a camera.

        Parameters
        ----------
        catalogue : StarCatalogue
            At the date of the images.
        noise_px : float
            Standard deviation of a centroid, per axis [px].
        """
        per_image = camera.solid_angle_sr / (4.0 * math.pi)
        bright = np.argsort(catalogue.magnitudes, kind="stable")[: math.ceil(_BRIGHT_PER_IMAGE / per_image)]
        longest = 2.0 * math.sin(0.5 * camera.diagonal_rad)
        triangles = star_triangles(catalogue.directions[bright], longest)
        return cls(catalogue, camera, bright, triangles, cKDTree(triangles.sides), noise_px)

    @property
    def gate_rad(self) -> float:
        """Within which a star of the image is one of the catalogue: three standard deviations."""
        return 3.0 * self.noise_px * self.camera.rad_per_px

    def identify(self, points_px: ArrayLike, magnitudes: ArrayLike) -> StarFix | NoFix:
        """Attitude and stars of an image.

        Parameters
        ----------
        points_px : array_like, shape (f, 2)
            x to the right, y up.
        magnitudes : array_like, shape (f,)
            Their order counts, and of stars that are as near as the noise their differences.

        Raises
        ------
        ValueError
            The shapes do not agree, or a number is not finite.
        """
        directions = self.camera.directions(points_px)
        brightness = np.asarray(magnitudes, dtype=np.float64)
        order = np.argsort(brightness, kind="stable")
        if order.shape != (len(directions),):
            raise ValueError(f"Input magnitudes must have shape ({len(directions)},); instead received {order.shape}.")
        brightest = order[:_IMAGE_STARS]
        if len(brightest) < 4:
            return NoFix(f"{len(brightest)} stars, 4 needed")
        mine = star_triangles(directions[brightest], 2.0)
        agreeing = self._agreeing(mine)
        if agreeing > _MOST_HYPOTHESES:
            return NoFix(f"{agreeing} triangles agree within the noise, {_MOST_HYPOTHESES} can be told apart")
        R = self._hypotheses(directions[brightest], mine)
        if not len(R):
            return NoFix("no triangle of the image is in the catalogue")
        near = self._near(directions[brightest], R)[1]
        fixes = [
            self.fitted(directions, brightness, R[i], len(R))
            for i in np.argsort(-near.sum(axis=1), kind="stable")[:_CHECKED_AGAIN]
        ]
        best = min(fixes, key=lambda fix: fix.log10_chance)
        if best.log10_chance > math.log10(self.most_chance):
            return NoFix(f"chance matches {len(best.stars)} of {len(directions)} stars too easily")
        return best

    @property
    def _side_gate(self) -> float:
        return 4.0 * self.noise_px * self.camera.rad_per_px

    def _agreeing(self, mine: StarTriangles) -> int:
        """Number of triangles whose three sides agree; it grows with the cube of the noise."""
        return int(np.sum(self.tree.query_ball_point(mine.sides, self._side_gate, return_length=True)))

    def _hypotheses(self, directions: FloatArray, mine: StarTriangles) -> FloatArray:
        """Rotations (h, 3, 3) of triangles whose three sides and sense agree."""
        agreeing = self.tree.query_ball_point(mine.sides, self._side_gate)
        found: list[list[int]] = np.asarray(agreeing, dtype=object).tolist()
        image = np.repeat(np.arange(len(found)), [len(matches) for matches in found])
        known = np.array([match for matches in found for match in matches], dtype=np.intp)
        agree = mine.is_counter_clockwise[image] == self.triangles.is_counter_clockwise[known]
        seen = directions[mine.corners[image[agree]]]
        there = self.catalogue.directions[self.bright[self.triangles.corners[known[agree]]]]
        return rotation_between(seen, there)

    def _near(self, directions: FloatArray, R: FloatArray) -> tuple[IntArray, BoolArray]:
        """Row of the catalogue nearest to each star under rotations (..., 3, 3), and whether it is within the gate."""
        found = self.catalogue.tree.query(directions @ np.swapaxes(R, -1, -2), distance_upper_bound=self.gate_rad)
        return np.asarray(found[1], dtype=np.intp), np.isfinite(np.asarray(found[0]))

    def fitted(self, directions: FloatArray, magnitudes: FloatArray, R: FloatArray, hypotheses: int) -> StarFix:
        """Fix by all stars near their places, brightest first or in any order, with the chance of as many."""
        for _ in range(_REFITS):
            row, near = self._near(directions, R)
            if np.count_nonzero(near) < 3:
                break
            R = rotation_between(directions[near], self.catalogue.directions[row[near]])
        stars = self._named(directions, magnitudes, R)
        seen, there = directions[stars[:, 0]], self.catalogue.directions[stars[:, 1]]
        rms = float(np.sqrt(np.mean(np.sum((seen @ R.T - there) ** 2, axis=1)))) if len(stars) else math.inf
        return StarFix(R, stars, rms, self.chance(R, len(stars), len(directions), hypotheses))

    def _named(self, directions: FloatArray, magnitudes: FloatArray, R: FloatArray) -> IntArray:
        """Pairs (k, 2) of a star and its row in the catalogue, each once, by place and, as of doubles, brightness."""
        found = self.catalogue.tree.query(directions @ R.T, k=_COMPANIONS, distance_upper_bound=self.gate_rad)
        distance, row = np.asarray(found[0]), np.asarray(found[1], dtype=np.intp)
        star, of_star = np.nonzero(np.isfinite(distance))
        if not len(star):
            return np.empty((0, 2), dtype=np.intp)
        row, distance = row[star, of_star], distance[star, of_star] / (self.gate_rad / 3.0)
        fainter = magnitudes[star] - self.catalogue.magnitudes[row]
        nearest = fainter[of_star == 0]
        spread = max(1.4826 * float(np.median(np.abs(nearest - np.median(nearest)))), _LEAST_SPREAD)
        # Magnitudes of other colours and of noise have tails: Student's t of two degrees of freedom.
        cost = distance**2 + 3.0 * np.log1p(0.5 * ((fainter - np.median(nearest)) / spread) ** 2)
        # Each star its best row and each row its best star, if no other is nearly as good.
        order = np.argsort(cost, kind="stable")
        for of in (star, row):
            order = order[_clearly_first(of[order], cost[order])]
        order = order[np.argsort(star[order])]
        return np.stack([star[order], row[order]], axis=1)

    def chance(self, R: FloatArray, matched: int, stars: int, hypotheses: int) -> float:
        """Expected number of hypotheses, as a decimal logarithm, that match as many stars besides their three."""
        axis = -R[:, 2]
        radius = 2.0 * math.sin(0.25 * self.camera.diagonal_rad)
        around = self.catalogue.tree.query_ball_point(axis, radius, return_length=True)
        covered = float(np.asarray(around)) * (self.gate_rad / radius) ** 2
        # Of at least `matched` - 3: the survival function counts what is more than its argument.
        chance = float(binom.logsf(matched - 4, max(stars - 3, 0), min(covered, 1.0)))
        return (chance + math.log(hypotheses)) / math.log(10.0)


def identify_stars(
    catalogue: StarCatalogue,
    camera: StarCamera,
    frames: Iterable[tuple[ArrayLike, ArrayLike]],
    *,
    noise_px: float = 1.0,
    progress: Callable[[int], None] | None = None,
) -> list[StarFix | NoFix]:
    """Attitude and stars of images, without knowing where the camera looked.

    Parameters
    ----------
    catalogue : StarCatalogue
        At the date of the images.
    camera : StarCamera
        Its scale and its size in pixels.
    frames : iterable of (array_like, array_like)
        Points (f, 2), y up, and magnitudes (f,) of each image; see :meth:`StarMatcher.identify`.
    noise_px : float
        Standard deviation of a star's place, per axis.
    progress : callable, optional
        Called with 1 after every image.

    Returns
    -------
    list of StarFix or NoFix
        One for every image: attitude and names of the stars, or why there are none.

    Examples
    --------
    >>> import adcs
    >>> from adcs.stars.files import read_star_catalogue, read_star_frames
    >>> camera, frames = read_star_frames("frames")  # doctest: +SKIP
    >>> catalogue = read_star_catalogue("stars.csv")  # doctest: +SKIP
    >>> images = [(frame.points_px, frame.magnitudes) for frame in frames]  # doctest: +SKIP
    >>> adcs.identify_stars(catalogue, camera, images)  # doctest: +SKIP
    """
    matcher = StarMatcher.of(catalogue, camera, noise_px)
    fixes = []
    for points_px, magnitudes in frames:
        fixes.append(matcher.identify(points_px, magnitudes))
        if progress is not None:
            progress(1)
    return fixes


def _clearly_first(of: IntArray, cost: FloatArray) -> IntArray:
    """Where each value stands first in an order of ascending costs (k,), unless its second one is nearly as good."""
    _, first, count = np.unique(of, return_index=True, return_counts=True)
    later = np.ones(len(of), dtype=np.bool_)
    later[first] = False
    second = np.full(int(of.max()) + 1, math.inf)
    np.minimum.at(second, of[later], cost[later])
    clear: IntArray = np.sort(first[(count == 1) | (second[of[first]] - cost[first] > _CLEARLY)])
    return clear


def rotation_between(seen: FloatArray, there: FloatArray) -> FloatArray:
    """Rotations (..., 3, 3) of least squares of k ≥ 2 unit vectors (..., k, 3): there ≈ R seen, by SVD (Kabsch)."""
    U, _, Vt = np.linalg.svd(np.swapaxes(there, -1, -2) @ seen)
    sign = np.ones(U.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return (U * sign[..., None, :]) @ Vt


@dataclass(frozen=True)
class NoFix:
    """There is no fix, and why."""

    reason: str
