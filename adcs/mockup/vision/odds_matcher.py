"""Matcher for sparse and for damaged images: pairs of stars, weighed by the likelihood of all stars.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.vision.camera import Camera
from adcs.mockup.vision.paper_matcher import CameraFix, Matcher, camera_fix
from adcs.mockup.vision.pose_odds import NOISE_PX, PoseOdds, Poses
from adcs.mockup.vision.similarity import mirrored_image
from adcs.mockup.vision.triangles import TriangleCatalogue
from adcs.stars.identification import NoFix
from arrays.typing import ComplexArray, FloatArray, IntArray

ROUGH_NOISE_PX = (*NOISE_PX, 3.2, 6.4)
# More stars than this are noise, and their pairs would fill the memory.
_MOST_STARS = 500
# Size of a cell of poses in position and heading; one hypothesis of each cell is fitted.
_CELL_PX = 10.0
_CELL_RAD = 0.05
# Best hypotheses per candidate: each true pair of stars gives the same pose.
_PER_CANDIDATE = 16


@dataclass(frozen=True, eq=False)
class LightPairs:
    """Pairs of lights sorted by distance; made by :meth:`of`."""

    lights: IntArray  # (k, 2)
    lengths_m: FloatArray  # (k,): ascending

    @classmethod
    def of(cls, catalogue: TriangleCatalogue, longest_m: float) -> LightPairs:
        """Return all pairs up to a distance [m]."""
        pairs = np.asarray(catalogue.star_tree.query_pairs(longest_m, output_type="ndarray"), dtype=np.intp)
        lengths = np.abs(catalogue.plane[pairs[:, 0]] - catalogue.plane[pairs[:, 1]])
        order = np.argsort(lengths, kind="stable")
        return cls(pairs[order], lengths[order])

    def between(self, least_m: FloatArray, most_m: FloatArray) -> tuple[IntArray, IntArray]:
        """Return the pairs with lengths in several ranges.

        Shapes ``least_m``, ``most_m`` (r,) -> (c,), (c, 2): number of the range, and lights. A pair may be in several
        ranges.
        """
        first, last = np.searchsorted(self.lengths_m, least_m), np.searchsorted(self.lengths_m, most_m)
        counts = np.maximum(last - first, 0)
        entry = np.arange(counts.sum()) + np.repeat(first - (np.cumsum(counts) - counts), counts)
        return np.repeat(np.arange(len(counts)), counts), self.lights[entry]


@dataclass(frozen=True, eq=False)
class OddsMatcher:
    """Matcher by pairs of stars, weighed by odds; made by :meth:`of`.

    Attributes
    ----------
    odds : PoseOdds
        Model of the camera's images.
    pairs : LightPairs
        Pairs of lights up to the image's diagonal on the ceiling.
    image_pairs : int
        Number of the shortest pairs of the image in use; one pair of true stars is enough.
    length_tolerance_px : float
        Largest error of a pair's length.
    coarse_px : float
        Largest error of another star's place under a pose from one pair.
    candidates : int
        Number of hypotheses that are fitted.
    minimum_log_odds : float
        Least log-odds of the fix; by default a thousand to one.
    minimum_stars : int
        Least number of stars that the fix must explain.
    """

    odds: PoseOdds
    pairs: LightPairs
    image_pairs: int = 20
    length_tolerance_px: float = 3.0
    coarse_px: float = 6.0
    candidates: int = 24
    minimum_log_odds: float = math.log(1000.0)
    minimum_stars: int = 3

    @classmethod
    def of(cls, catalogue: TriangleCatalogue, camera: Camera) -> OddsMatcher:
        """Return a matcher with the default settings.

        Parameters
        ----------
        catalogue : TriangleCatalogue
            Catalogue of the lights.
        camera : Camera
            Calibrated camera, with its scale and its distortion.

        Returns
        -------
        OddsMatcher
            Matcher with precise tolerances.
        """
        diagonal = math.hypot(*camera.footprint_m)
        return cls(PoseOdds.of(catalogue, camera), LightPairs.of(catalogue, 1.05 * diagonal))

    def rough(self) -> OddsMatcher:
        """Return a matcher with wide tolerances, for an unknown lens, a scale wrong by 1 %, or smeared stars."""
        odds = replace(self.odds, gate_px=16.0, scale_sigma=0.01, noise_px=ROUGH_NOISE_PX)
        return replace(self, odds=odds, length_tolerance_px=6.0, coarse_px=24.0)

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
        if not self.minimum_stars <= len(image) <= _MOST_STARS:
            return NoFix(f"{len(image)} stars, {self.minimum_stars} to {_MOST_STARS} needed")
        a, b = self._hypotheses(image)
        if not len(a):
            return NoFix("no two stars are as far apart as two lights")
        best = self._best_cells(image, a, b)
        poses = self.odds.fit(image, a[best], b[best], self.coarse_px)
        log_odds = self.odds.log_odds(image, poses, self.odds.log_anywhere)
        return best_fix(self.odds, image, poses, log_odds, self.minimum_log_odds, self.minimum_stars)

    def _hypotheses(self, image: ComplexArray) -> tuple[ComplexArray, ComplexArray]:
        """Return the poses under which a short pair of stars is a pair of lights of a similar length."""
        i, j = np.triu_indices(len(image), 1)
        length = np.abs(image[j] - image[i])
        shortest = np.argsort(length, kind="stable")[: self.image_pairs]
        i, j, length = i[shortest], j[shortest], length[shortest]
        s = self.odds.camera.m_per_px
        slack = self.length_tolerance_px + 3.0 * self.odds.scale_sigma * length
        pair, lights = self.pairs.between(s * (length - slack), s * (length + slack))
        pair, lights = np.concatenate([pair, pair]), np.concatenate([lights, lights[:, ::-1]])
        first, second = self.odds.catalogue.plane[lights].T
        first_px, second_px = image[i][pair], image[j][pair]
        apart = length[pair] > 0.0
        turn = (second - first) * np.conj(second_px - first_px)
        a = s * turn[apart] / np.abs(turn[apart])
        return a, 0.5 * (first + second)[apart] - a * 0.5 * (first_px + second_px)[apart]

    def _best_cells(self, image: ComplexArray, a: ComplexArray, b: ComplexArray) -> IntArray:
        """Return the indices of the best hypotheses, one of each cell of poses."""
        s = self.odds.camera.m_per_px
        misses = self.odds.light_map.misses_of_poses(image, a, b, self.coarse_px * s)
        best = np.argpartition(misses, min(_PER_CANDIDATE * self.candidates, len(misses)) - 1)
        best = best[: _PER_CANDIDATE * self.candidates]
        order = best[np.lexsort((best, misses[best]))]
        cells = np.stack([b.real / (_CELL_PX * s), b.imag / (_CELL_PX * s), np.angle(a) / _CELL_RAD])
        x, y, heading = np.round(cells[:, order]).astype(np.int64)
        # A unique key of each cell for any ceiling: a million cells in each direction.
        _, first = np.unique((x << 40) + (y << 12) + heading, return_index=True)
        return order[np.sort(first)[: self.candidates]]


@dataclass(frozen=True)
class FirstFix:
    """Matcher that tries several matchers in turn until one has a fix."""

    matchers: tuple[Matcher, ...]

    def identify(self, points_px: ArrayLike) -> CameraFix | NoFix:
        """Return the first fix, or the first matcher's reason for none; see :meth:`OddsMatcher.identify`."""
        first: NoFix | None = None
        for matcher in self.matchers:
            fix = matcher.identify(points_px)
            if isinstance(fix, CameraFix):
                return fix
            first = first or fix
        return first or NoFix("there is no matcher")


def odds_matcher(catalogue: TriangleCatalogue, camera: Camera) -> FirstFix:
    """Return the recommended matcher: :class:`OddsMatcher`, precise and then rough.

    Parameters
    ----------
    catalogue : TriangleCatalogue
        Catalogue of the lights.
    camera : Camera
        Camera, calibrated as well as possible.

    Returns
    -------
    FirstFix
        Matcher with the method ``identify``.

    Examples
    --------
    >>> import numpy as np
    >>> import sims
    >>> from adcs import mockup
    >>> sky, camera, pose = mockup.led_sky(), mockup.Camera(), mockup.Pose(0.1, 0.2, 0.3)
    >>> frame = sims.rendered_frame(sky, camera, pose, np.random.default_rng(0))
    >>> stars = mockup.find_stars(frame.image)
    >>> points_px = mockup.undistorted(camera, stars.positions_px)
    >>> catalogue = mockup.TriangleCatalogue.of(sky.positions_m)
    >>> mockup.odds_matcher(catalogue, camera).identify(points_px).position_m.round(2)
    array([0.1, 0.2])
    """
    precise = OddsMatcher.of(catalogue, camera)
    return FirstFix((precise, precise.rough()))


def best_fix(
    odds: PoseOdds, image: ComplexArray, poses: Poses, log_odds: FloatArray, minimum_log_odds: float, minimum_stars: int
) -> CameraFix | NoFix:
    """Return the fix of the best pose if its odds are high enough.

    ``image`` (f,): mirrored centred pixels x - iy. ``log_odds`` (h,): log-odds of each pose against "all clutter".
    ``minimum_log_odds``: least log-odds of the best pose against all others and "all clutter" together.
    ``minimum_stars``: least number of stars that it must explain.
    """
    distinct = odds.distinct(poses, log_odds)
    if not len(distinct):
        return NoFix("no two stars fit the catalogue")
    best, others = int(distinct[0]), distinct[1:]
    against = float(log_odds[best] - np.logaddexp.reduce(np.append(log_odds[others], 0.0)))
    stars = poses.stars(best)
    if len(stars) < minimum_stars:
        return NoFix(f"{len(stars)} of {len(image)} stars fit, {minimum_stars} needed")
    if against < minimum_log_odds:
        return NoFix(f"odds of the best pose are e^{against:.1f}, e^{minimum_log_odds:.1f} needed")
    return camera_fix(odds.catalogue, image, stars, complex(poses.a[best]), complex(poses.b[best]), len(stars))
