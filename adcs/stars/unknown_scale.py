"""Identification of images of the sky with unknown scale, and of photographs in one step.

See docs/theory/star-identification.md.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from adcs.stars.camera import StarCamera
from adcs.stars.catalogue import WHOLE_SKY, SkyCap, StarCatalogue
from adcs.stars.identification import NoFix, StarFix, StarMatcher, ranked_triangles
from adcs.stars.lens import KnownLens
from adcs.stars.pictures import LEAST_PX, PictureStars, find_picture_stars
from adcs.stars.pose import UNKNOWN_LENS, LensPrior
from arrays.io.errors import check_positive
from arrays.typing import FloatArray

_STRONG_RAD = math.radians(25.0)  # field of view from which on a lens may bend the corners strongly
_STARS = 100  # number of the brightest lights in use; the catalogue has no fainter stars
_WIDEST_TOLERANCE = 0.1
_SAME_LENS = LensPrior(scale=3e-3, bent=3e-3)  # of the picture before, which heat and focus change a little
_FIRST_FIELD_RAD, _LAST_FIELD_RAD = math.radians(3.0), math.radians(45.0)
# Fields from corner to corner of equidistant lenses; the angles of a lens do not scale as those of another one.
_FIRST_WIDE_RAD, _LAST_WIDE_RAD, _WIDE_FIELDS = math.radians(45.0), math.radians(100.0), 9


def solve_photograph(
    picture: ArrayLike,
    catalogue: StarCatalogue,
    *,
    rad_per_px: float | None = None,
    tolerance: float = 0.05,
    noise_px: float = 0.5,
    near: SkyCap = WHOLE_SKY,
    lens: KnownLens | None = None,
    dark: ArrayLike | None = None,
    last: StarFix | None = None,
) -> tuple[PictureStars, StarFix | NoFix]:
    """Identify attitude, scale and stars of a photograph of the sky.

    Parameters
    ----------
    picture : array_like, shape (height, width)
        Grey picture in any unit, the first row at the top, such as from :func:`adcs.read_picture`.
    catalogue : StarCatalogue
        Catalogue, such as :func:`adcs.hipparcos_catalogue`.
    rad_per_px : float, optional
        Scale at the centre; by default fields of 3 to 45° from corner to corner are tried, and
        of 45 to 100° with an equidistant lens.
    tolerance : float
        Relative error of that scale, at most 0.1.
    noise_px : float
        Standard deviation of a star's place, with errors of the lens.
    near : SkyCap
        Part of the sky in which the picture's centre is, such as ``adcs.stars.catalogue.SkyCap.of(ra_rad, dec_rad,
        radius_rad)``; by default the whole sky.
    lens : KnownLens, optional
        Lens of the camera, such as from ``adcs.stars.lens.read_lens``, instead of ``rad_per_px``.
    dark : array_like, shape (height, width), optional
        Picture of the camera without light, which is subtracted.
    last : StarFix, optional
        Fix of the picture before in a sequence: its lens and the sky around its centre are tried first. It has no
        effect together with ``near`` or ``lens``.

    Returns
    -------
    stars : PictureStars
        Detected lights, brightest first.
    fix : StarFix or NoFix
        Attitude, scale, distortion and stars, or the reason for which there are none. A picture without a fix is also
        tried mirrored.

    Raises
    ------
    ValueError
        A shape does not match, or a number is out of range.

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
        near=near,
        lens=lens,
        last=last,
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
    near: SkyCap = WHOLE_SKY,
    lens: KnownLens | None = None,
    last: StarFix | None = None,
) -> StarFix | NoFix:
    """Identify attitude, scale and stars of a picture.

    ``rad_per_px``: scale at the centre with the relative error ``tolerance``, at most 0.1; by default fields of 3 to
    100° from corner to corner are tried, the widest with an equidistant lens. ``noise_px``: standard deviation of a
    star's place, with errors of the lens. ``near``: part of the sky in which the picture's centre is. ``lens``: known
    lens, instead of ``rad_per_px``. ``last``: fix of the picture before, see :func:`solve_photograph`.
    """
    check_positive(tolerance=tolerance, noise_px=noise_px)
    if tolerance > _WIDEST_TOLERANCE:
        raise ValueError(f"Input tolerance must be at most {_WIDEST_TOLERANCE}; instead received {tolerance}.")
    brightest = np.argsort(magnitudes, kind="stable")[:_STARS]
    points, magnitudes = points_px[brightest], magnitudes[brightest]
    if len(points) < 4:
        return NoFix(f"{len(points)} stars, 4 needed")
    if lens is not None:
        cameras, prior = [lens.camera], lens.prior
    else:
        cameras, prior = _cameras(width_px, height_px, rad_per_px, tolerance)
    used = None if lens is not None or near.share < 1.0 else last
    for matcher, lens_prior, mirrored in _matchers(catalogue, cameras, prior, noise_px, near, used):
        fix = matcher.identify(points, magnitudes, lens_prior, mirrored=mirrored)
        if isinstance(fix, StarFix) and fix.log10_chance < -6.0 - math.log10(2 * len(cameras) + (used is not None)):
            if lens is None and matcher.camera.diagonal_rad > _STRONG_RAD:
                fix = matcher.refine_lens(points, magnitudes, fix)
            return replace(fix, stars=np.stack([brightest[fix.stars[:, 0]], fix.stars[:, 1]], axis=1))
    where = "" if near.share >= 1.0 else f"not solved near {near}: "
    return NoFix(f"{where}no scale of {len(cameras)} explains the {len(points)} brightest lights, mirrored or not")


def _matchers(
    catalogue: StarCatalogue,
    cameras: list[StarCamera],
    prior: LensPrior,
    noise_px: float,
    near: SkyCap,
    last: StarFix | None,
) -> Iterator[tuple[StarMatcher, LensPrior, bool]]:
    """Yield the matchers to try, with the prior of their lens, and whether the picture is mirrored.

    The matcher of the picture before comes first, for the sky around its centre, if the pictures have the same size.
    """
    if last is not None:
        camera = last.pose.camera
        if (camera.width_px, camera.height_px) == (cameras[0].width_px, cameras[0].height_px):
            around = SkyCap(-last.R_catalogue_from_frame[:, 2], camera.diagonal_rad)
            yield StarMatcher.of(catalogue, camera, noise_px, around), _SAME_LENS, last.mirrored
    ranked = ranked_triangles(catalogue)

    @cache
    def matcher_of(camera: StarCamera) -> StarMatcher:
        return StarMatcher.of(catalogue, camera, noise_px, near, ranked)

    for mirrored, camera in product((False, True), cameras):
        yield matcher_of(camera), prior, mirrored


def _cameras(
    width_px: int, height_px: int, rad_per_px: float | None, tolerance: float
) -> tuple[list[StarCamera], LensPrior]:
    """Return the cameras to try, and the prior of their lens."""
    if rad_per_px is not None:
        camera = StarCamera(width_px, height_px, rad_per_px)
        kinds = [camera] if camera.diagonal_rad < _FIRST_WIDE_RAD else [camera, _equidistant(camera)]
        return kinds, replace(UNKNOWN_LENS, scale=tolerance)
    step = (1.0 + _WIDEST_TOLERANCE) / (1.0 - _WIDEST_TOLERANCE)
    n = math.ceil(math.log(_LAST_FIELD_RAD / _FIRST_FIELD_RAD) / math.log(step))
    fields = _FIRST_FIELD_RAD * step ** np.arange(n + 1)
    # Fields near ten degrees come first, as most star cameras have them. The narrowest need the most triangles.
    from_usual = np.log(fields / math.radians(10.0))
    fields = fields[np.argsort(np.where(from_usual < -0.1, 10.0 - from_usual, from_usual))]
    diagonal_px = math.hypot(width_px, height_px)
    cameras = [StarCamera(width_px, height_px, math.atan(2.0 * math.tan(0.5 * f) / diagonal_px)) for f in fields]
    narrow = int(np.count_nonzero(from_usual < -0.3))  # beyond these, after the wide ones
    wide = [
        _equidistant(StarCamera(width_px, height_px, math.atan(f / diagonal_px)))
        for f in np.geomspace(_FIRST_WIDE_RAD, _LAST_WIDE_RAD, _WIDE_FIELDS)
    ]
    ordered = [*cameras[: len(cameras) - narrow], *wide, *cameras[len(cameras) - narrow :]]
    return ordered, replace(UNKNOWN_LENS, scale=_WIDEST_TOLERANCE)


def _equidistant(camera: StarCamera) -> StarCamera:
    return replace(camera, projection="equidistant")
