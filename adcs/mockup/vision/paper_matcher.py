"""Pose of the camera from one image: result of all matchers, and the matcher of the paper.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.vision.similarity import fit_similarity, mirrored_image
from adcs.mockup.vision.triangles import LightTriangles, TriangleCatalogue, delaunay_triangles
from adcs.stars.identification import NoFix
from arrays.typing import ComplexArray, FloatArray, IntArray

SLIVER_RAD = math.radians(3.0)
"""Smallest angle of a triangle in use; noise changes the angles of narrower ones too much."""

# Prior standard deviation of a centroid along each axis, and the number of values that it counts for.
_USUAL_PX, _USUAL_NUMBERS = 0.1, 4


@dataclass(frozen=True, eq=False)
class CameraFix:
    """Pose of the camera from an image.

    Attributes
    ----------
    position_m : ndarray, shape (2,)
        X, Y at which the camera's optical axis meets the ceiling, table axes.
    heading_rad : float
        Heading φ, counter-clockwise seen from above, from -π to π.
    stars : ndarray, shape (k, 2)
        Pairs of a star's index in the image and in the catalogue.
    rms_m : float
        Root mean square distance of these stars from their lights on the ceiling.
    votes : int
        Number of agreeing triangles (:class:`PaperMatcher`) or of matched stars (other matchers).
    m_per_px : float
        Fitted scale of the image on the ceiling.
    sigma_m, sigma_rad : float
        Standard deviations of the position, each axis, and of the heading, from the residuals of the stars.

    Examples
    --------
    >>> import numpy as np
    >>> from adcs import mockup
    >>> stars = np.array([[0, 17], [1, 4]])
    >>> fix = mockup.CameraFix(np.zeros(2), 0.3, stars, rms_m=1e-4, votes=2, m_per_px=1.4e-3)
    >>> round(np.degrees(fix.heading_rad))
    17
    """

    position_m: FloatArray
    heading_rad: float
    stars: IntArray
    rms_m: float
    votes: int
    m_per_px: float
    sigma_m: float = math.nan
    sigma_rad: float = math.nan


class Matcher(Protocol):
    """Lost-in-space identification of one image."""

    def identify(self, points_px: ArrayLike) -> CameraFix | NoFix:
        """Identify the pose of the camera from stars (f, 2): centred undistorted pixels, y up."""
        ...


@dataclass(frozen=True, eq=False)
class PaperMatcher:
    """Matcher of the paper: all pairs of triangles, and centres that agree.

    Attributes
    ----------
    catalogue : TriangleCatalogue
        Catalogue of the lights.
    tolerance_rad : float
        Largest difference of the angles of two matching triangles.
    closeness_m : float
        Largest distance between two centres that agree.
    minimum_votes : int
        Least number of agreeing triangles.
    opposite_handedness : bool
        Whether a triangle of the image must have the opposite orientation of the catalogue's, as in the image of a
        camera that looks up. The paper does not require it, which doubles its false matches.

    Examples
    --------
    >>> from adcs import mockup
    >>> catalogue = mockup.TriangleCatalogue.of(mockup.led_sky().positions_m)
    >>> mockup.PaperMatcher(catalogue).identify([[0.0, 0.0], [50.0, 0.0]]).reason
    'no triangle between 2 stars'
    """

    catalogue: TriangleCatalogue
    tolerance_rad: float = math.radians(0.5)
    closeness_m: float = 0.02
    minimum_votes: int = 2
    opposite_handedness: bool = True

    def identify(self, points_px: ArrayLike) -> CameraFix | NoFix:
        """Identify the pose of the camera from the stars of an image.

        Parameters
        ----------
        points_px : array_like, shape (f, 2)
            Centred pixels: relative to the optical centre, undistorted, y up.

        Returns
        -------
        CameraFix or NoFix
            Pose, or the reason for which there is none. The position is the mean of the agreeing centres, the heading
            their circular mean.

        Raises
        ------
        ValueError
            The shape does not match, or a number is not finite.
        """
        image = mirrored_image(points_px)
        triangles = delaunay_triangles(image, SLIVER_RAD)
        if not len(triangles):
            return NoFix(f"no triangle between {len(image)} stars")
        mine, theirs = self.matches(triangles)
        if not len(mine):
            return NoFix(f"none of {len(triangles)} triangles is in the catalogue")
        corners, lights = triangles.corners[mine], self.catalogue.triangles.corners[theirs]
        # A triangle with the catalogue's orientation fits the image as seen from above; another one, if it is accepted,
        # fits the mirrored image only.
        turned = triangles.is_counter_clockwise[mine] != self.catalogue.triangles.is_counter_clockwise[theirs]
        seen = np.where(turned[:, None], np.conj(image[corners]), image[corners])
        a, b = fit_similarity(seen, self.catalogue.plane[lights])
        agreeing = longest_close_subset(b, self.closeness_m)
        votes = min(len(np.unique(mine[agreeing])), len(np.unique(theirs[agreeing])))
        if votes < self.minimum_votes:
            return NoFix(f"{votes} of {len(triangles)} triangles agree on a centre, {self.minimum_votes} needed")
        stars = np.stack([corners[agreeing].ravel(), lights[agreeing].ravel()], axis=1)
        heading = np.exp(1j * np.angle(a[agreeing])).sum()
        scale = np.abs(a[agreeing]).mean()
        fitted = scale * heading / max(abs(heading), 1e-300)
        if np.mean(turned[agreeing]) > 0.5:
            image = np.conj(image)
        return camera_fix(self.catalogue, image, stars, complex(fitted), complex(b[agreeing].mean()), votes)

    def matches(self, triangles: LightTriangles) -> tuple[IntArray, IntArray]:
        """Return the pairs of matching triangles of image and catalogue; all pairs are compared.

        Parameters
        ----------
        triangles : LightTriangles
            Triangles of the image.

        Returns
        -------
        mine : ndarray of int, shape (c,)
            Indices of matching triangles in the image.
        theirs : ndarray of int, shape (c,)
            Indices of the same triangles in the catalogue.
        """
        known = self.catalogue.triangles
        difference = np.abs(triangles.angles_rad[:, None] - known.angles_rad)
        close = (difference <= self.tolerance_rad).all(axis=2)
        if self.opposite_handedness:
            # The image has been mirrored, so that a true match has the same orientation.
            close &= triangles.is_counter_clockwise[:, None] == known.is_counter_clockwise
        mine, theirs = np.nonzero(close)
        return mine, theirs


def camera_fix(
    catalogue: TriangleCatalogue, image: ComplexArray, stars: IntArray, a: complex, b: complex, votes: int
) -> CameraFix:
    """Return the fix of a fit q = a p̄ + b, see :mod:`adcs.mockup.vision.similarity`.

    ``image`` (f,): mirrored image points x - iy [px]. ``stars`` (k, 2): pairs of indices in image and catalogue, which
    may repeat.
    """
    pairs = np.unique(stars, axis=0)
    points = image[pairs[:, 0]]
    residual = a * points + b - catalogue.plane[pairs[:, 1]]
    squares, k = float(np.sum(residual.real**2 + residual.imag**2)), len(points)
    # Two numbers of each star minus the four of the fit, and the prior of a centroid.
    known = _USUAL_NUMBERS * (_USUAL_PX * abs(a)) ** 2
    sigma_m = math.sqrt((known + squares) / (_USUAL_NUMBERS + 2 * k - 4))
    middle = points.mean()
    spread_px = max(float(np.linalg.norm(points - middle)), _USUAL_PX)
    return CameraFix(
        np.array([b.real, b.imag]),
        float(np.angle(a)),
        pairs,
        math.sqrt(squares / k),
        votes,
        abs(a),
        sigma_m * math.hypot(1.0 / math.sqrt(k), abs(middle) / spread_px),
        sigma_m / (abs(a) * spread_px),
    )


def longest_close_subset(points: ComplexArray, closeness: float) -> IntArray:
    """Return a large subset of points within a distance of one another, by a greedy search.

    For each point in turn, the other points are added in order of their distance if they are close to all added ones.
    ``points`` (c,): x + iy. Returns (k,): indices of the longest subset; of equally long ones, the one around the point
    with most neighbours.
    """
    distance = np.abs(points[:, None] - points)
    close = distance <= closeness
    neighbours = close.sum(axis=1)
    longest: list[int] = []
    for centre in np.argsort(-neighbours, kind="stable"):
        if neighbours[centre] <= len(longest):
            break
        mutual = close[centre].copy()
        subset: list[int] = []
        for point in np.argsort(distance[centre], kind="stable")[: neighbours[centre]]:
            if mutual[point]:
                subset.append(int(point))
                mutual &= close[point]
        if len(subset) > len(longest):
            longest = subset
    return np.array(longest, dtype=np.intp)
