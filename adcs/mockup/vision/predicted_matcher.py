"""Matching near a predicted pose, for which two stars are enough.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.vision.camera import Camera, Pose, distort
from adcs.mockup.vision.odds_matcher import best_fix
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.mockup.vision.pose_odds import PoseOdds, Poses
from adcs.mockup.vision.similarity import mirrored_image, pairs_of
from adcs.mockup.vision.triangles import TriangleCatalogue
from adcs.stars.identification import NoFix
from arrays.typing import ComplexArray, FloatArray, IntArray
from magloc.state_space import symmetric_square_root

CENTROID_PX = 0.3
"""Standard deviation of a centroid in the search; the least radius covers smeared stars."""
# Largest effect of the heading's error at the image's border; beyond it, use a matcher without a prediction.
_MOST_TURNED_PX = 20.0


@dataclass(frozen=True, eq=False)
class ExpectedLights:
    """Expected lights in an image."""

    lights: IntArray  # (k,): indices in the catalogue
    points_px: FloatArray  # (k, 2): centred pixels: relative to the optical centre, undistorted, y up
    radius_px: FloatArray  # (k,): radius in which the light's star is expected

    def __len__(self) -> int:
        return len(self.lights)


def expected_lights(
    catalogue: TriangleCatalogue, camera: Camera, pose: Pose, covariance: ArrayLike, sigmas: float = 4.0
) -> ExpectedLights:
    """Return the expected lights and their places for a predicted pose.

    ``pose``: one pose. ``covariance`` (3, 3): covariance of X, Y [m] and heading [rad]. ``sigmas``: radius in standard
    deviations along the worst direction. Lights outside of the image by at most their radius are included.
    """
    P = _check_covariance(covariance)
    a, b = _fit_of(camera, pose)
    offset = catalogue.plane - b
    seen = np.conj(offset / a)
    # A shift of the pose shifts a light by its negative in the ceiling's plane, a rotation by -i (q - b) per radian.
    J = np.zeros((len(seen), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = -1.0
    J[:, :, 2] = pairs_of(-1j * offset)
    S = J @ P @ np.swapaxes(J, 1, 2) / camera.m_per_px**2
    radius = sigmas * np.sqrt(np.linalg.eigvalsh(S)[:, 1].clip(0.0) + CENTROID_PX**2)
    points = pairs_of(seen)
    place = distort(camera, points)
    nearest_in_frame = np.clip(place, 0.0, [camera.width_px - 1.0, camera.height_px - 1.0])
    visible = np.linalg.norm(place - nearest_in_frame, axis=1) <= radius
    return ExpectedLights(np.flatnonzero(visible), points[visible], radius[visible])


@dataclass(frozen=True, eq=False)
class LightTracker:
    """Fixes from images near a predicted pose.

    Attributes
    ----------
    odds : PoseOdds
        Model of the camera's images.
    sigmas : float
        Radius of the search in standard deviations.
    least_radius_px : float
        Least radius of the search, for smeared stars.
    most_shifts : int
        Largest number of shifts that are weighed, the likeliest of the prediction.
    minimum_log_odds : float
        Least log-odds of a fix against all others and "all clutter"; by default a thousand to one.
    minimum_stars : int
        Least number of stars that a fix must explain.

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
    >>> tracker = mockup.LightTracker(mockup.PoseOdds.of(catalogue, camera))
    >>> tracker.identify_near(points_px, pose, 1e-4 * np.eye(3)).position_m.round(2)
    array([0.1, 0.2])
    """

    odds: PoseOdds
    sigmas: float = 4.0
    least_radius_px: float = 3.0
    most_shifts: int = 64
    minimum_log_odds: float = math.log(1000.0)
    minimum_stars: int = 2

    def identify_near(self, points_px: ArrayLike, pose: Pose, covariance: ArrayLike) -> CameraFix | NoFix:
        """Identify the pose of the camera from the stars of an image near a prediction.

        The prediction guides the search and weighs the candidates; the fix itself depends on the stars alone.

        Parameters
        ----------
        points_px : array_like, shape (f, 2)
            Centred pixels: relative to the optical centre, undistorted, y up.
        pose : Pose
            Prediction for the middle of the exposure.
        covariance : array_like, shape (3, 3)
            Covariance of the prediction's X, Y [m] and heading [rad].

        Returns
        -------
        CameraFix or NoFix
            Pose, or the reason for which there is none.

        Raises
        ------
        ValueError
            The shape of the points does not match, a number is not finite, or the covariance is not symmetric and
            positive semidefinite.
        """
        image = mirrored_image(points_px)
        P = _check_covariance(covariance)
        expected = expected_lights(self.odds.catalogue, self.odds.camera, pose, P, self.sigmas)
        shifts = self._shifts(image, expected)
        if not len(shifts):
            return NoFix(f"none of {len(image)} stars is near one of {len(expected)} expected lights")
        a, b = _fit_of(self.odds.camera, pose)
        turned_px = self.sigmas * math.sqrt(P[2, 2]) * float(np.abs(image).max())
        poses = self.odds.fit(
            image, np.full(len(shifts), a), b + a * shifts, self.least_radius_px + min(turned_px, _MOST_TURNED_PX)
        )
        log_odds = self.odds.log_odds(image, poses, self._log_density(poses, pose, P))
        return best_fix(self.odds, image, poses, log_odds, self.minimum_log_odds, self.minimum_stars)

    def _shifts(self, image: ComplexArray, expected: ExpectedLights) -> ComplexArray:
        """Return shifts of the mirrored image that match a star to a light, the smallest first [px]."""
        offset = np.conj(expected.points_px[:, 0] + 1j * expected.points_px[:, 1])[:, None] - image
        radius = np.maximum(expected.radius_px, self.least_radius_px)
        shifts = offset[np.abs(offset) <= radius[:, None]]
        return shifts[np.argsort(np.abs(shifts), kind="stable")[: self.most_shifts]]

    def _log_density(self, poses: Poses, pose: Pose, P: FloatArray) -> FloatArray:
        """Return the prediction's log-density at fits, per px² and rad, with the noise of a fit of two stars added."""
        s = self.odds.camera.m_per_px
        error = np.stack(
            [poses.b.real - pose.x_m, poses.b.imag - pose.y_m, np.angle(poses.a * np.exp(-1j * pose.heading_rad))]
        )
        blurred = P + np.diag([(CENTROID_PX * s) ** 2, (CENTROID_PX * s) ** 2, (CENTROID_PX / 100.0) ** 2])
        factor = np.linalg.cholesky(blurred)
        whitened = np.linalg.solve(factor, error)
        log_evidence_volume = 1.5 * math.log(2.0 * math.pi) + float(np.log(np.diagonal(factor)).sum())
        return -0.5 * (whitened**2).sum(axis=0) - log_evidence_volume + 2.0 * math.log(s)


def _fit_of(camera: Camera, pose: Pose) -> tuple[complex, complex]:
    """Return the fit of a pose: a and b of :mod:`adcs.mockup.vision.similarity`."""
    a = camera.m_per_px * complex(math.cos(float(pose.heading_rad)), math.sin(float(pose.heading_rad)))
    return a, complex(float(pose.x_m), float(pose.y_m))


def _check_covariance(covariance: ArrayLike) -> FloatArray:
    """Return a covariance of X, Y and heading; raise ValueError unless it is positive semidefinite."""
    P = np.asarray(covariance, dtype=np.float64)
    if P.shape != (3, 3) or not np.isfinite(P).all():
        raise ValueError(f"Input covariance must be 3 by 3 finite numbers; instead received shape {P.shape}.")
    symmetric_square_root(P)
    return P
