"""Lost-in-space identification of stars and attitude from an image and a catalogue.

See docs/theory/star-identification.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import islice
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike
from scipy.stats import binom

from adcs.stars.camera import Projection, StarCamera, as_projection
from adcs.stars.catalogue import WHOLE_SKY, SkyCap, StarCatalogue
from adcs.stars.pose import CameraPose, LensPrior, fit_pose
from adcs.stars.triangles import AttitudeHypothesis, Checks, RankedTriangles, TriangleIndex, star_triangles
from arrays.typing import FloatArray, IntArray
from magloc.levels import SIGMA_OF_MAD

# Number of brighter neighbours with which a star forms triangles, in the catalogue and in an image with hot pixels.
_BRIGHTER, _IMAGE_BRIGHTER = 4, 8
# Mean number of catalogue stars in the triangles of an image, of image stars in triangles, and of checking stars.
_BRIGHT_PER_IMAGE = 30
_IMAGE_STARS = 30
_CHECKED = 24
# Largest number of checked triangle matches of an image: a second of computing.
_MOST_HYPOTHESES = 250_000
_WIDER = 1.1  # field of view over the stated one, by an error of the scale
_ROUNDS = 3  # largest number of groups of hypotheses that are fitted
_CROWDED = 4.0  # largest density of stars over the mean
_WIDENED = 2.0  # gate of a hypothesis from three noisy stars over the usual one
_REFITS = 6
# Gates over the usual one of a wide field, whose lens may bend the corners; its prior.
_NARROWING, _STRONG_LENS = (2.0, 4.0, 4.0, 3.0, 3.0, 2.0, 2.0), LensPrior(scale=0.1, bent=0.1, bent2=0.02)
# Numbers of the brightest lights whose match is tested: in a picture only the brightest may be stars.
_BEGINNINGS = (15, 30, 60, 100)
_COMPANIONS = 3  # largest number of catalogue stars within the noise of one place
_LEAST_SPREAD = 0.5  # least spread of the magnitudes of an image
_CLEARLY = 2.0  # least difference of two costs that decides between two stars


@dataclass(frozen=True, eq=False)
class StarFix:
    """Attitude of a camera and its stars.

    Attributes
    ----------
    stars : ndarray, shape (k, 2)
        Pairs of a star's index in the image and its row in the catalogue.
    rms_rad : float
        Root mean square angle of these stars from their places in the catalogue.
    log10_chance : float
        Logarithm of the expected number of attitudes that match as many stars by chance.
    pose : CameraPose
        Attitude and lens with their covariance.
    mirrored : bool
        Whether the image is mirrored. Attitude and lens are then those of the image with left and right exchanged.
    """

    stars: IntArray
    rms_rad: float
    log10_chance: float
    pose: CameraPose
    mirrored: bool = False

    @property
    def R_catalogue_from_frame(self) -> FloatArray:
        """Rotation of the pose, catalogue from camera frame."""
        return self.pose.R_catalogue_from_frame


@dataclass(frozen=True, eq=False)
class StarMatcher:
    """Lost-in-space identification of star images; made by :meth:`of`.

    Attributes
    ----------
    catalogue : StarCatalogue
        Stars that an image with its centre in the cap may show, at the date of the images.
    rows : ndarray, shape (n,)
        Their rows in the whole catalogue.
    near : SkyCap
        Part of the sky in which the centre of an image is.
    camera : StarCamera
        Camera of the images.
    index : TriangleIndex
        Triangles of the catalogue's stars that an image of this camera shows.
    noise_px : float
        Standard deviation of a centroid, per axis.
    most_chance : float
        Largest expected number of equally good attitudes by chance.
    """

    catalogue: StarCatalogue
    rows: IntArray
    near: SkyCap
    camera: StarCamera
    index: TriangleIndex
    noise_px: float
    most_chance: float = 1e-6

    @classmethod
    def of(
        cls,
        catalogue: StarCatalogue,
        camera: StarCamera,
        noise_px: float = 1.0,
        near: SkyCap = WHOLE_SKY,
        ranked: RankedTriangles | None = None,
    ) -> StarMatcher:
        """Return a matcher for a camera.

        Parameters
        ----------
        catalogue : StarCatalogue
            Stars at the date of the images.
        camera : StarCamera
            Camera of the images.
        noise_px : float
            Standard deviation of a centroid, per axis.
        near : SkyCap
            Part of the sky in which the centre of an image is.
        ranked : RankedTriangles, optional
            :func:`ranked_triangles` of the catalogue, which several cameras share.
        """
        seen = cls._seen(near, camera)
        rows = np.arange(len(catalogue.numbers))
        if seen.share < 1.0:
            rows = np.flatnonzero(seen.contains(catalogue.directions))
            catalogue, ranked = catalogue.rows(rows), None
        images = 4.0 * math.pi * seen.share / camera.solid_angle_sr
        longest = 2.0 * math.sin(0.5 * camera.diagonal_rad)
        index = TriangleIndex.of(ranked or ranked_triangles(catalogue), math.ceil(_BRIGHT_PER_IMAGE * images), longest)
        return cls(catalogue, rows, near, camera, index, noise_px)

    @staticmethod
    def _seen(near: SkyCap, camera: StarCamera) -> SkyCap:
        """Return the part of the sky in images whose centre lies in the cap."""
        return near.widened(_WIDER * 0.5 * camera.diagonal_rad)

    def gate_rad(self, camera: StarCamera) -> float:
        """Return the matching radius of a star of the image: three standard deviations."""
        return 3.0 * self.noise_px * camera.rad_per_px

    def identify(
        self,
        points_px: ArrayLike,
        magnitudes: ArrayLike,
        prior: LensPrior = LensPrior(),  # noqa: B008 - frozen
        *,
        mirrored: bool = False,
    ) -> StarFix | NoFix:
        """Identify stars and attitude of an image.

        Parameters
        ----------
        points_px : array_like, shape (f, 2)
            Stars, x to the right, y up.
        magnitudes : array_like, shape (f,)
            Magnitudes. Their order matters, and for stars closer than the noise their differences.
        prior : LensPrior
            Errors of the camera's scale and distortion; by default none.
        mirrored : bool
            Whether to exchange left and right first.

        Returns
        -------
        StarFix or NoFix
            Attitude and stars, or the reason for which there are none.

        Raises
        ------
        ValueError
            The shapes do not match, or a number is not finite.
        """
        tangents = self.camera.tangents(points_px)
        brightness = np.asarray(magnitudes, dtype=np.float64)
        order = np.argsort(brightness, kind="stable")
        if order.shape != (len(tangents),):
            raise ValueError(f"Input magnitudes must have shape ({len(tangents)},); instead received {order.shape}.")
        if min(len(order), len(self.rows)) < 4:
            return self._unsolved(f"{min(len(order), len(self.rows))} stars, 4 needed")
        points = np.asarray(points_px, dtype=np.float64)[order]
        if mirrored:
            points = self.camera.exchange_sides(points)
            tangents = tangents * [-1.0, 1.0]
        checks = self._checks(min(len(order), _CHECKED), prior)
        image = star_triangles(self.camera.directions(points[:_IMAGE_STARS]), 2.0, _IMAGE_BRIGHTER)
        found = self.index.best(tangents[order], image, self.catalogue.cells, checks)
        reason = "no triangle of the image is in the catalogue"
        for hypotheses in islice(found, _ROUNDS):
            fixes = [
                self._fit(points, brightness[order], self._pose(hypothesis), prior, hypothesis.tried)
                for hypothesis in hypotheses
            ]
            best = min(fixes, key=lambda fix: fix.log10_chance)
            if best.log10_chance <= math.log10(self.most_chance):
                if not self.near.contains(-best.R_catalogue_from_frame[:, 2]):
                    return self._unsolved("the centre that fits the stars is outside")
                stars = np.stack([order[best.stars[:, 0]], self.rows[best.stars[:, 1]]], axis=1)
                return replace(best, stars=stars, mirrored=mirrored)
            reason = f"chance matches {len(best.stars)} of {len(points)} stars too easily"
        return self._unsolved(reason)

    def _unsolved(self, reason: str) -> NoFix:
        """Return the reason, with the hint of direction if there is one."""
        return NoFix(reason if self.near.share >= 1.0 else f"not solved near {self.near}: {reason}")

    def _checks(self, stars: int, prior: LensPrior) -> Checks:
        """Return the limits of the search.

        The search ends at a number of matches that chance reaches a hundred times less often than the accepted limit,
        even in a crowded part of the sky.
        """
        near = _WIDENED * self.gate_rad(self.camera)
        share = self._seen(self.near, self.camera).share
        crowd = min(_CROWDED * len(self.catalogue.numbers) / share * (0.5 * near) ** 2, 1.0)
        chance = binom.logsf(np.arange(stars) - 3, max(stars - 3, 0), crowd) + math.log(_MOST_HYPOTHESES)
        enough = int(np.count_nonzero(chance > math.log(0.01 * self.most_chance)))
        return Checks(4.0 * self.noise_px * self.camera.rad_per_px, prior.scale, near, stars, enough, _MOST_HYPOTHESES)

    def _pose(self, hypothesis: AttitudeHypothesis) -> CameraPose:
        """Return the pose of a hypothesis, without a covariance."""
        rad_per_px = math.atan(hypothesis.scale * math.tan(self.camera.rad_per_px))
        return CameraPose(hypothesis.R, replace(self.camera, rad_per_px=rad_per_px), np.zeros((8, 8)))

    def refine_lens(self, points_px: FloatArray, magnitudes: FloatArray, fix: StarFix) -> StarFix:
        """Fit the lens of a wide field to more stars, as a pinhole and as an equidistant lens; the better one.

        ``points_px`` (f, 2), ``magnitudes`` (f,): stars of the fix, brightest first. The gate narrows in steps, because
        the first fit may miss the stars in the corners.
        """
        points = self.camera.exchange_sides(points_px) if fix.mirrored else points_px
        best = fix
        for projection in get_args(Projection):
            start = replace(fix.pose, camera=as_projection(fix.pose.camera, projection))
            lens = replace(self, camera=replace(self.camera, projection=projection))
            found = lens._fit(points, magnitudes, start, _STRONG_LENS, 1, _NARROWING)
            if (len(found.stars), -found.rms_rad) > (len(best.stars), -best.rms_rad):
                best = found
        rows = best.stars if best is fix else np.stack([best.stars[:, 0], self.rows[best.stars[:, 1]]], axis=1)
        return replace(best, stars=rows, log10_chance=fix.log10_chance, mirrored=fix.mirrored)

    def _fit(
        self,
        points: FloatArray,
        magnitudes: FloatArray,
        pose: CameraPose,
        prior: LensPrior,
        tried: int,
        gates: tuple[float, ...] = (_WIDENED,),
    ) -> StarFix:
        """Fit the pose to all stars near their places, with the probability of as many by chance.

        ``gates``: gates of the first fits, relative to the usual one.
        """
        before = np.empty(0, dtype=np.intp)
        for i in range(len(gates) + _REFITS - 1):
            directions = pose.camera.directions(points) @ pose.R_catalogue_from_frame.T
            gate = (gates[i] if i < len(gates) else 1.0) * self.gate_rad(pose.camera)
            row = np.asarray(self.catalogue.tree.query(directions, distance_upper_bound=gate)[1], dtype=np.intp)
            near = row < len(self.catalogue.numbers)
            if np.count_nonzero(near) < 3 or (i >= len(gates) and np.array_equal(row, before)):
                break
            there = self.catalogue.directions[row[near]]
            pose = fit_pose(points[near], there, pose, self.camera, prior, self.noise_px)
            before = row
        directions = pose.camera.directions(points) @ pose.R_catalogue_from_frame.T
        stars = self._match(directions, magnitudes, self.gate_rad(pose.camera))
        off = directions[stars[:, 0]] - self.catalogue.directions[stars[:, 1]]
        rms = float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) if len(stars) else math.inf
        sizes = np.unique(np.minimum((*_BEGINNINGS, len(points)), len(points)))
        chance = self._log_chance(pose, np.searchsorted(stars[:, 0], sizes), sizes).min()
        chance = (float(chance) + math.log(tried * len(sizes))) / math.log(10.0)
        return StarFix(stars, rms, chance, pose)

    def _match(self, directions: FloatArray, magnitudes: FloatArray, gate: float) -> IntArray:
        """Match stars to the catalogue one to one, by place and brightness; pairs (k, 2)."""
        found = self.catalogue.tree.query(directions, k=_COMPANIONS, distance_upper_bound=gate)
        distance, row = np.asarray(found[0]), np.asarray(found[1], dtype=np.intp)
        star, of_star = np.nonzero(np.isfinite(distance))
        if not len(star):
            return np.empty((0, 2), dtype=np.intp)
        row, distance = row[star, of_star], distance[star, of_star] / (gate / 3.0)
        fainter = magnitudes[star] - self.catalogue.magnitudes[row]
        nearest = fainter[of_star == 0]
        spread = max(SIGMA_OF_MAD * float(np.median(np.abs(nearest - np.median(nearest)))), _LEAST_SPREAD)
        # Magnitudes in other colours and noise have tails: Student's t with two degrees of freedom.
        cost = distance**2 + 3.0 * np.log1p(0.5 * ((fainter - np.median(nearest)) / spread) ** 2)
        # Each star keeps its best row and each row its best star, unless another one is nearly as good.
        order = np.argsort(cost, kind="stable")
        for of in (star, row):
            order = order[_clear_ranks(of[order], cost[order])]
        order = order[np.argsort(star[order])]
        return np.stack([star[order], row[order]], axis=1)

    def _log_chance(self, pose: CameraPose, matched: IntArray, stars: IntArray) -> FloatArray:
        """Return the log-probability that an attitude matches as many stars by chance, besides its triangle."""
        radius = 2.0 * math.sin(0.25 * self.camera.diagonal_rad)
        axis = -pose.R_catalogue_from_frame[:, 2]
        around = self.catalogue.tree.query_ball_point(axis, radius, return_length=True)
        covered = float(np.asarray(around)) * (self.gate_rad(pose.camera) / radius) ** 2
        # At least `matched` - 3 matches; the survival function is the probability of more than its argument.
        return np.asarray(binom.logsf(matched - 4, np.maximum(stars - 3, 0), min(covered, 1.0)))


def ranked_triangles(catalogue: StarCatalogue) -> RankedTriangles:
    """Return the triangles of a catalogue, which matchers of several cameras share."""
    return RankedTriangles(catalogue.directions[np.argsort(catalogue.magnitudes, kind="stable")], _BRIGHTER)


def identify_stars(
    catalogue: StarCatalogue,
    camera: StarCamera,
    frames: Iterable[tuple[ArrayLike, ArrayLike]],
    *,
    noise_px: float = 1.0,
    lens: LensPrior = LensPrior(),  # noqa: B008 - frozen
    near: SkyCap = WHOLE_SKY,
    progress: Callable[[int], None] | None = None,
) -> list[StarFix | NoFix]:
    """Identify attitude and stars of images without a prior attitude.

    Parameters
    ----------
    catalogue : StarCatalogue
        Stars at the date of the images.
    camera : StarCamera
        Scale of the images, and their size in pixels.
    frames : iterable of (array_like, array_like)
        Points (f, 2), y up, and magnitudes (f,) of each image; see :meth:`StarMatcher.identify`.
    noise_px : float
        Standard deviation of a star's place, per axis.
    lens : LensPrior
        Errors of the camera's scale and distortion, such as ``adcs.stars.pose.UNKNOWN_LENS``; by default none.
    near : SkyCap
        Part of the sky in which the centre of each image is; by default the whole sky.
    progress : callable, optional
        Function that is called with 1 after each image.

    Returns
    -------
    list of StarFix or NoFix
        Attitude and stars of each image, or the reason for which there are none. An image without a fix is also tried
        mirrored.

    Raises
    ------
    ValueError
        The shapes of an image do not match, or a number is not finite.

    Examples
    --------
    >>> import adcs
    >>> from adcs.stars.files import read_star_catalogue, read_star_frames
    >>> camera, frames = read_star_frames("frames")  # doctest: +SKIP
    >>> catalogue = read_star_catalogue("stars.csv")  # doctest: +SKIP
    >>> images = [(frame.points_px, frame.magnitudes) for frame in frames]  # doctest: +SKIP
    >>> adcs.identify_stars(catalogue, camera, images)  # doctest: +SKIP
    """
    matcher = StarMatcher.of(catalogue, camera, noise_px, near)
    fixes = []
    for points_px, magnitudes in frames:
        fix = matcher.identify(points_px, magnitudes, lens)
        if isinstance(fix, NoFix):
            of_mirror = matcher.identify(points_px, magnitudes, lens, mirrored=True)
            fix = of_mirror if isinstance(of_mirror, StarFix) else fix
        fixes.append(fix)
        if progress is not None:
            progress(1)
    return fixes


def _clear_ranks(of: IntArray, cost: FloatArray) -> IntArray:
    """Return the best place of each value by ascending costs (k,), unless its second is nearly as good."""
    _, first, count = np.unique(of, return_index=True, return_counts=True)
    later = np.ones(len(of), dtype=np.bool_)
    later[first] = False
    second = np.full(int(of.max()) + 1, math.inf)
    np.minimum.at(second, of[later], cost[later])
    clear: IntArray = np.sort(first[(count == 1) | (second[of[first]] - cost[first] > _CLEARLY)])
    return clear


@dataclass(frozen=True)
class NoFix:
    """Reason for which there is no fix."""

    reason: str
