"""Where an image of the sky looks whose scale is known roughly or not at all, and photographs in one step.

Triangles are told by the ratios of their sides, which no scale changes, and each that agrees with one of the catalogue
states a scale. See docs/theory/star-identification.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from adcs.stars.identification import (
    WIDEST_RAD,
    NoFix,
    StarCamera,
    StarCatalogue,
    StarFix,
    StarMatcher,
    StarTriangles,
    rotation_between,
    star_triangles,
)
from adcs.stars.pictures import LEAST_PX, PictureStars, find_picture_stars
from arrays.io.errors import check_positive
from arrays.typing import FloatArray, IntArray

_BEGINNINGS = (15, 30, 60, 100)
_STARS = 100  # of a picture, the brightest: what is fainter than all of the catalogue tells nothing
_TRIANGLE_STARS = 24
_NEIGHBOURS = 8  # of each: hot pixels and planets are among them
_CHECKED_STARS = 12
_CHECKED_AGAIN = 10
_MOST_HYPOTHESES = 400_000
_AT_ONCE = 20_000
_MOST_LOG10_CHANCE = -6.0
_WIDEST_TOLERANCE = 0.1
_FIRST_FIELD_RAD, _LAST_FIELD_RAD = math.radians(3.0), math.radians(45.0)


@dataclass(frozen=True, eq=False)
class PictureFix:
    """Where a picture looks.

    Attributes
    ----------
    fix : StarFix
        Its stars are pairs of a light and a row of the catalogue.
    camera : StarCamera
        With the scale at the centre that fits best.
    scale_sigma_rad : float
        Of that scale, from the residuals.
    """

    fix: StarFix
    camera: StarCamera
    scale_sigma_rad: float


def solve_photograph(
    picture: ArrayLike,
    catalogue: StarCatalogue,
    *,
    rad_per_px: float | None = None,
    tolerance: float = 0.05,
    noise_px: float = 0.5,
    dark: ArrayLike | None = None,
) -> tuple[PictureStars, PictureFix | NoFix]:
    """Where a photograph of the sky looks, and which stars it shows.

    Parameters
    ----------
    picture : array_like, shape (height, width)
        Grey, any unit, its first row at the top, such as of :func:`adcs.read_picture`.
    catalogue : StarCatalogue
        Such as :func:`adcs.hipparcos_catalogue`.
    rad_per_px : float, optional
        Scale at the centre; without it fields of 3 to 45° from corner to corner are tried.
    tolerance : float
        Relative error of that scale, 0.1 at most.
    noise_px : float
        Standard deviation of a star's place, with what the lens bends.
    dark : array_like, shape (height, width), optional
        What the camera shows without a sky; it is subtracted.

    Returns
    -------
    stars : PictureStars
        Lights that were found, brightest first.
    fix : PictureFix or NoFix
        Attitude, scale and the names of the stars, or why there are none.

    Raises
    ------
    ValueError
        A shape or number is not of this kind.

    Examples
    --------
    >>> import adcs
    >>> picture = adcs.read_picture("night.png")  # doctest: +SKIP
    >>> stars, found = adcs.solve_photograph(picture, adcs.hipparcos_catalogue())  # doctest: +SKIP
    """
    values = np.asarray(picture, dtype=np.float64)
    if values.ndim != 2 or min(values.shape) < LEAST_PX:
        raise ValueError(f"Input picture must have {LEAST_PX} pixels each way; instead received {values.shape}.")
    off = None if dark is None else np.asarray(dark, dtype=np.float64)
    if off is not None and off.shape != values.shape:
        raise ValueError(f"Input dark must have shape {values.shape}; instead received {off.shape}.")
    stars = find_picture_stars(values, off)
    height, width = values.shape
    found = identify_at_unknown_scale(
        catalogue,
        width,
        height,
        stars.points_px,
        stars.magnitudes,
        rad_per_px=rad_per_px,
        tolerance=tolerance,
        noise_px=noise_px,
    )
    return stars, found


def identify_at_unknown_scale(
    catalogue: StarCatalogue,
    width_px: int,
    height_px: int,
    points_px: FloatArray,
    magnitudes: FloatArray,
    *,
    rad_per_px: float | None = None,
    tolerance: float = 0.05,
    noise_px: float = 0.5,
) -> PictureFix | NoFix:
    """Attitude, scale and stars of a picture.

    ``rad_per_px``: at the centre, within ``tolerance`` of it, 0.1 at most; without one, fields of 3 to 45° from corner
    to corner are tried. ``noise_px``: standard deviation of a star's place, with what a lens bends.
    """
    check_positive(tolerance=tolerance, noise_px=noise_px)
    if tolerance > _WIDEST_TOLERANCE:
        raise ValueError(f"Input tolerance must be at most {_WIDEST_TOLERANCE}; instead received {tolerance}.")
    brightest = np.argsort(magnitudes, kind="stable")[:_STARS]
    points, magnitudes = points_px[brightest], magnitudes[brightest]
    if len(points) < 4:
        return NoFix(f"{len(points)} stars, 4 needed")
    tried = 0
    scales, within = _scales(math.hypot(width_px, height_px), rad_per_px, tolerance)
    for scale in scales:
        matcher = StarMatcher.of(catalogue, StarCamera(width_px, height_px, scale), noise_px)
        candidates, count = _candidates(matcher, points, within)
        tried += count
        fixes = [_refined(matcher, points, magnitudes, candidate, max(tried, 1)) for candidate in candidates]
        found = [fix for fix in fixes if fix is not None and fix.fix.log10_chance < _MOST_LOG10_CHANCE]
        if found:
            best = min(found, key=lambda one: one.fix.log10_chance)
            stars = np.stack([brightest[best.fix.stars[:, 0]], best.fix.stars[:, 1]], axis=1)
            return replace(best, fix=replace(best.fix, stars=stars))
    return NoFix(f"no scale of {len(scales)} explains the {len(points)} brightest lights")


def _scales(diagonal_px: float, rad_per_px: float | None, tolerance: float) -> tuple[list[float], float]:
    """Scales to try, and how far from each the true one may be."""
    if rad_per_px is not None:
        return [rad_per_px], tolerance
    step = (1.0 + _WIDEST_TOLERANCE) / (1.0 - _WIDEST_TOLERANCE)
    n = math.ceil(math.log(_LAST_FIELD_RAD / _FIRST_FIELD_RAD) / math.log(step))
    fields = _FIRST_FIELD_RAD * step ** np.arange(n + 1)
    # From those of ten degrees outwards: most star cameras.
    fields = fields[np.argsort(np.abs(np.log(fields / math.radians(10.0))))]
    return [
        math.atan(2.0 * math.tan(0.5 * min(field, WIDEST_RAD)) / diagonal_px) for field in fields
    ], _WIDEST_TOLERANCE


def _candidates(matcher: StarMatcher, points: FloatArray, within: float) -> tuple[list[tuple[FloatArray, float]], int]:
    """The best rotations with their scales, relative to the camera's, and of how many."""
    camera = matcher.camera
    directions = camera.directions(points)
    mine = star_triangles(directions[:_TRIANGLE_STARS], 2.0, _NEIGHBOURS)
    image, known = _agreeing(matcher, mine, within)
    if not len(image):
        return [], 0
    scale = matcher.triangles.sides[known].sum(axis=1) / mine.sides[image].sum(axis=1)
    there = matcher.catalogue.directions[matcher.bright[matcher.triangles.corners[known]]]
    best: list[tuple[int, float, FloatArray]] = []
    for begin in range(0, len(image), _AT_ONCE):
        part = slice(begin, begin + _AT_ONCE)
        seen = _scaled(directions, scale[part])
        R = rotation_between(np.take_along_axis(seen, mine.corners[image[part]][:, :, None], axis=1), there[part])
        checked = seen[:, :_CHECKED_STARS] @ np.swapaxes(R, -1, -2)
        near = np.isfinite(matcher.catalogue.tree.query(checked, distance_upper_bound=2.0 * matcher.gate_rad)[0])
        counts = near.sum(axis=1)
        best += [(int(counts[i]), float(scale[part][i]), R[i]) for i in np.argsort(-counts)[:_CHECKED_AGAIN]]
    best.sort(key=lambda one: -one[0])
    return [(R, factor) for _, factor, R in best[:_CHECKED_AGAIN]], len(image)


def _agreeing(matcher: StarMatcher, mine: StarTriangles, within: float) -> tuple[IntArray, IntArray]:
    """Pairs of a triangle of the picture and one of the catalogue that agree in ratios, sense and scale."""
    sides = matcher.triangles.sides
    tree = cKDTree(sides[:, :2] / sides[:, 2:])
    gate = 4.0 * matcher.noise_px * matcher.camera.rad_per_px / mine.sides[:, 2]
    found = tree.query_ball_point(mine.sides[:, :2] / mine.sides[:, 2:], gate)
    image = np.repeat(np.arange(len(found)), [len(matches) for matches in found])
    known = np.fromiter((match for matches in found for match in matches), dtype=np.intp, count=len(image))
    right = np.abs(sides[known, 2] / mine.sides[image, 2] - 1.0) < within
    right &= mine.is_counter_clockwise[image] == matcher.triangles.is_counter_clockwise[known]
    image, known = image[right], known[right]
    if len(image) > _MOST_HYPOTHESES:
        kept = np.linspace(0, len(image) - 1, _MOST_HYPOTHESES).astype(np.intp)
        image, known = image[kept], known[kept]
    return image, known


def _scaled(directions: FloatArray, factor: FloatArray) -> FloatArray:
    """Directions (h, f, 3) of cameras whose scales are by some factors (h,) those of one that sees (f, 3)."""
    tangents = factor[:, None, None] * (directions[:, :2] / -directions[:, 2:])
    outward = np.concatenate([tangents, np.full((*tangents.shape[:2], 1), -1.0)], axis=2)
    return outward / np.linalg.norm(outward, axis=2, keepdims=True)


def _refined(
    matcher: StarMatcher,
    points: FloatArray,
    magnitudes: FloatArray,
    candidate: tuple[FloatArray, float],
    hypotheses: int,
) -> PictureFix | None:
    """Fix with the scale of least squares, by turns with the rotation."""
    R, factor = candidate
    centre = 0.5 * np.array([matcher.camera.width_px, matcher.camera.height_px])
    rad_per_px = math.atan(factor * math.tan(matcher.camera.rad_per_px))
    sigma = math.inf
    for _ in range(6):
        scaled = replace(matcher, camera=replace(matcher.camera, rad_per_px=rad_per_px))
        fix = scaled.fitted(scaled.camera.directions(points), magnitudes, R, hypotheses)
        if len(fix.stars) < 4:
            return None
        R = fix.R_catalogue_from_frame
        seen = matcher.catalogue.directions[fix.stars[:, 1]] @ R
        tangents, offsets = seen[:, :2] / -seen[:, 2:], points[fix.stars[:, 0]] - centre
        tangent = float(np.sum(tangents * offsets) / np.sum(offsets**2))
        left = np.sum((tangents - tangent * offsets) ** 2) / max(2 * len(fix.stars) - 4, 1)
        sigma = math.sqrt(float(left) / float(np.sum(offsets**2)))
        rad_per_px = math.atan(tangent)
    # Lights are brightest first, and few of a picture may be stars: the chance of the best beginning.
    sizes = sorted({min(size, len(points)) for size in _BEGINNINGS})
    chances = [
        scaled.chance(R, int(np.count_nonzero(fix.stars[:, 0] < size)), size, hypotheses * len(sizes)) for size in sizes
    ]
    return PictureFix(replace(fix, log10_chance=min(chances)), scaled.camera, sigma)
