"""Odds of a pose against chance, from the stars of an image.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import betaln

from adcs.mockup.vision.camera import Camera, distort, in_frame
from adcs.mockup.vision.light_map import LightMap
from adcs.mockup.vision.similarity import pairs_of
from adcs.mockup.vision.triangles import TriangleCatalogue
from arrays.typing import BoolArray, ComplexArray, FloatArray, IntArray

NOISE_PX = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Equally likely standard deviations of centroids, from an image at rest to a smeared one."""
# Fits from a rough pose to the final match of stars.
_FITS = 3
# Fits that differ by less all over the image count as one.
_IMAGE_RADIUS_PX = 400.0
_DISTINCT_PX = 20.0


@dataclass(frozen=True, eq=False)
class Poses:
    """Fits to one image of f stars, with the light of each star."""

    a: ComplexArray  # (h,): of q = a p̄ + b
    b: ComplexArray  # (h,): of q = a p̄ + b
    lights: IntArray  # (h, f): the light nearest to each star
    matched: BoolArray  # (h, f): whether the star is that light; no light is matched twice

    def stars(self, index: int) -> IntArray:
        """Return pairs (k, 2) of indices in image and catalogue under one pose."""
        star = np.flatnonzero(self.matched[index])
        return np.stack([star, self.lights[index, star]], axis=1)


@dataclass(frozen=True, eq=False)
class PoseOdds:
    """Model of a camera's image of a catalogue; made by :meth:`of`.

    Attributes
    ----------
    catalogue : TriangleCatalogue
        Catalogue of the lights.
    camera : Camera
        Calibrated camera, with its scale and its distortion.
    light_map : LightMap
        Map of the nearest light to each place of the ceiling.
    gate_px : float
        Largest distance of a star from its light.
    scale_sigma : float
        Relative standard deviation of the camera's scale.
    detection : tuple of two floats
        α and β of the beta distribution of the detected share of lights; by default 0.8 ± 0.16.
    border_px : float
        Width of the image's border in which a light may or may not be detected.
    noise_px : tuple of floats
        Equally likely standard deviations of centroids.

    Examples
    --------
    >>> from adcs import mockup
    >>> catalogue = mockup.TriangleCatalogue.of(mockup.led_sky().positions_m)
    >>> mockup.PoseOdds.of(catalogue, mockup.Camera()).gate_px
    3.0
    """

    catalogue: TriangleCatalogue
    camera: Camera
    light_map: LightMap
    gate_px: float = 3.0
    scale_sigma: float = 0.002
    detection: tuple[float, float] = (4.0, 1.0)
    border_px: float = 12.0
    noise_px: tuple[float, ...] = NOISE_PX

    @classmethod
    def of(cls, catalogue: TriangleCatalogue, camera: Camera) -> PoseOdds:
        """Return a model with the default settings.

        Parameters
        ----------
        catalogue : TriangleCatalogue
            Catalogue of the lights.
        camera : Camera
            Calibrated camera.

        Returns
        -------
        PoseOdds
            Model of the camera's images.
        """
        return cls(catalogue, camera, LightMap.of(catalogue))

    @property
    def log_anywhere(self) -> float:
        """Logarithm of the uniform density of poses below the ceiling, per px² and rad."""
        positions = self.catalogue.positions_m / self.camera.m_per_px
        return -math.log(2.0 * math.pi * float(np.prod(np.ptp(positions, axis=0))))

    def fit(self, image: ComplexArray, a: ComplexArray, b: ComplexArray, first_gate_px: float) -> Poses:
        """Fit poses by least squares from rough ones.

        Parameters
        ----------
        image : ndarray, shape (f,)
            Mirrored centred pixels x - iy.
        a, b : ndarray, shape (h,)
            Rough poses of q = a p̄ + b.
        first_gate_px : float
            Gate of the first fit; it shrinks to ``gate_px`` in steps.

        Returns
        -------
        Poses
            Fits, whose scales are weighted means of fit and calibration.
        """
        s = self.camera.m_per_px
        stiffness = (float(np.median(self.noise_px)) / self.scale_sigma) ** 2
        for gate in np.linspace(max(first_gate_px, self.gate_px), self.gate_px, _FITS).tolist():
            lights, matched = self._match(image, a, b, gate)
            n = np.maximum(matched.sum(axis=1), 1)
            places = self.catalogue.plane[lights]
            p, q = (matched @ image) / n, (matched * places).sum(axis=1) / n
            centred = image - p[:, None]
            turn = (matched * np.conj(centred) * (places - q[:, None])).sum(axis=1)
            inertia = (matched * _squared_modulus(centred)).sum(axis=1)
            length = np.abs(turn)
            can = length > 0.0
            scale = (length + s * stiffness) / (inertia + stiffness)
            a = np.where(can, scale * turn / np.where(can, length, 1.0), a)
            b = np.where(can, q - a * p, b)
        return Poses(a, b, *self._match(image, a, b, self.gate_px))

    def log_odds(self, image: ComplexArray, poses: Poses, log_density: FloatArray | float) -> FloatArray:
        """Return the log-odds of poses against "all clutter", shape (h,); see docs/theory/tabletop-vision.md.

        Parameters
        ----------
        image : ndarray, shape (f,)
            Mirrored centred pixels x - iy.
        poses : Poses
            Fits from :meth:`fit`.
        log_density : float or ndarray, shape (h,)
            Logarithm of the prior density of a pose, per px² and rad, such as :attr:`log_anywhere`.

        Returns
        -------
        ndarray, shape (h,)
            Log-odds; -inf for a pose with fewer than two stars.
        """
        s = self.camera.m_per_px
        matched = poses.matched
        m = matched.sum(axis=1)
        n = np.maximum(m, 1)
        offset = poses.a[:, None] * image + poses.b[:, None] - self.catalogue.plane[poses.lights]
        squares = (matched * _squared_modulus(offset)).sum(axis=1) / s**2
        centred = image - ((matched @ image) / n)[:, None]
        inertia = np.maximum((matched * _squared_modulus(centred)).sum(axis=1), 1.0)
        scale_error = (np.abs(poses.a) / s - 1.0) / self.scale_sigma
        alpha, beta = self.detection
        found = betaln(alpha + m, beta + self._missing_lights(poses)) - betaln(alpha, beta)
        clutter = m * math.log(self.camera.width_px * self.camera.height_px / max(len(image), 1))
        variance = np.array(self.noise_px)[:, None] ** 2
        likelihood = -m * np.log(2.0 * np.pi * variance) - 0.5 * (squares / variance + scale_error**2)
        # Posterior volume of X, Y, φ and of the scale.
        volume = 1.5 * np.log(2.0 * np.pi * variance) - np.log(n) - 0.5 * np.log(inertia)
        volume -= 0.5 * np.log1p(self.scale_sigma**2 * inertia / variance)
        total = np.logaddexp.reduce(likelihood + volume, axis=0) - math.log(len(self.noise_px))
        return np.where(m >= 2, total + found + clutter + log_density, -np.inf)

    def distinct(self, poses: Poses, log_odds: FloatArray) -> IntArray:
        """Return indices of poses, best first, without duplicates.

        Parameters
        ----------
        poses : Poses
            Fits from :meth:`fit`.
        log_odds : ndarray, shape (h,)
            Log-odds from :meth:`log_odds`.

        Returns
        -------
        ndarray of int, shape (k,)
            Indices of distinct poses with finite log-odds.
        """
        kept: list[int] = []
        limit = _DISTINCT_PX * self.camera.m_per_px
        for i in np.argsort(-log_odds, kind="stable"):
            apart = np.abs(poses.a[kept] - poses.a[i]) * _IMAGE_RADIUS_PX + np.abs(poses.b[kept] - poses.b[i])
            if np.isfinite(log_odds[i]) and np.all(apart > limit):
                kept.append(int(i))
        return np.array(kept, dtype=np.intp)

    def _match(
        self, image: ComplexArray, a: ComplexArray, b: ComplexArray, gate_px: float
    ) -> tuple[IntArray, BoolArray]:
        """Match each star to its nearest light, within the gate and each light once."""
        placed = a[:, None] * image + b[:, None]
        lights = self.light_map.lights_near(placed)
        distance = np.abs(placed - self.catalogue.plane[lights]) / (gate_px * self.camera.m_per_px)
        # The key sorts by light, then by distance, which is below 1: the first star of a light is its nearest.
        key = np.where(distance < 1.0, lights + distance, np.inf)
        order = np.argsort(key, axis=1)
        light = np.floor(np.take_along_axis(key, order, axis=1))
        first = np.isfinite(light)
        first[:, 1:] &= light[:, 1:] != light[:, :-1]
        matched = np.zeros(first.shape, dtype=np.bool_)
        np.put_along_axis(matched, order, first, axis=1)
        return lights, matched

    def _missing_lights(self, poses: Poses) -> IntArray:
        """Return the number (h,) of lights well within the image without a star."""
        seen = np.conj((self.catalogue.plane - poses.b[:, None]) / poses.a[:, None])
        expected = in_frame(self.camera, distort(self.camera, pairs_of(seen)), self.border_px)
        found = np.take_along_axis(expected, poses.lights, axis=1) & poses.matched
        return expected.sum(axis=1) - found.sum(axis=1)


def _squared_modulus(plane: ComplexArray) -> FloatArray:
    """Return the squared modulus."""
    return plane.real**2 + plane.imag**2
