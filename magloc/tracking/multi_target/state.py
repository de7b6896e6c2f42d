"""Joint state of several sources: one Gaussian in the charts of the sources.

Each source has position p, moment m, velocity v and rate of turn ω; the common field is shared. Errors are Gaussian in
the coordinates of :mod:`magloc.tracking.coordinates`, always with strength and direction for a moment. In Cartesian
coordinates the filter would be overconfident of moments, because |m| is known better than its direction.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.typing import FloatArray
from magloc.tracking.chart.mixture import root_of
from magloc.tracking.coordinates import Chart
from magloc.tracking.row_filter import Gaussians

N_SEEN = 6
"""Number of states of a source that readings depend on: position and moment."""
N_OF_SOURCE = 12
N_COMMON = 3
_POWER = 0
"""Power of the range by which the chart scales moments: 0, since near an array strength and range are uncorrelated."""


@dataclass(frozen=True, eq=False)
class JointState:
    """K sources and the common field, with the covariance of their errors.

    Attributes
    ----------
    x : ndarray, shape (12 K + 3,)
        Position, moment, velocity and rate of turn of each source, and the common field.
    S : ndarray, shape (12 K + 3, 12 K + 3)
        Root of the covariance in the charts about x.
    centroid_m : ndarray, shape (3,)
        Centroid of the sensors, the origin of ranges.
    radius_m : float
        Radius of the array, the least scale of the charts.
    """

    x: FloatArray
    S: FloatArray
    centroid_m: FloatArray
    radius_m: float

    @classmethod
    def empty(cls, common_T: FloatArray, sigma_T: float, centroid_m: FloatArray, radius_m: float) -> JointState:
        """Return a state without sources."""
        return cls(common_T, sigma_T * np.eye(N_COMMON), centroid_m, radius_m)

    @property
    def n_sources(self) -> int:
        """Number of sources K."""
        return (len(self.x) - N_COMMON) // N_OF_SOURCE

    @property
    def sources(self) -> FloatArray:
        """States (K, 12) of the sources."""
        return self.x[:-N_COMMON].reshape(-1, N_OF_SOURCE)

    @property
    def position_m(self) -> FloatArray:
        """Positions (K, 3)."""
        return self.sources[:, :3]

    @property
    def moment_Am2(self) -> FloatArray:
        """Moments (K, 3)."""
        return self.sources[:, 3:N_SEEN]

    @property
    def common_T(self) -> FloatArray:
        """Common field (3,)."""
        return self.x[-N_COMMON:]

    @property
    def gaussians(self) -> Gaussians:
        """The state as an argument of kernels."""
        return Gaussians(self.x[None], self.S[None], self.n_sources, N_COMMON, _POWER, math.inf)

    def after(self, found: Gaussians, centroid_m: FloatArray) -> JointState:
        """Return the state with the result of a kernel."""
        return replace(self, x=found.x[0], S=found.S[0], centroid_m=centroid_m)

    @cached_property
    def chart(self) -> Chart:
        """Charts (K,) about the sources."""
        return chart_at(self.sources, self.centroid_m, self.radius_m)

    @cached_property
    def _roots(self) -> FloatArray:
        """Roots (K, 12, n) of the sources' Cartesian covariances."""
        of_sources = self.S[:-N_COMMON].reshape(self.n_sources, N_OF_SOURCE, len(self.S))
        return self.chart.jacobian(np.zeros((self.n_sources, N_OF_SOURCE))) @ of_sources

    @cached_property
    def covariances(self) -> FloatArray:
        """Second moments (K, 6, 6) of the Cartesian errors of the sources' positions and moments.

        A rotation by δ shortens the projection of a moment on its mean by 1 - cos δ ≈ δ²/2, which may exceed the error
        of |m| itself. Its mean square is (tr² Σ + 2 tr Σ²)/4 for rotations of covariance Σ.
        """
        m, root = self.moment_Am2, self._roots[:, :N_SEEN]
        covariances: FloatArray = root @ np.swapaxes(root, 1, 2)
        square = np.vecdot(m, m)[:, None, None]
        across = np.eye(3) - m[:, :, None] * m[:, None] / square
        turns = across @ covariances[:, 3:, 3:] @ across / square
        trace = np.trace(turns, axis1=1, axis2=2)
        shorter = 0.25 * trace**2 + 0.5 * np.sum(turns * turns, axis=(1, 2))
        covariances[:, 3:, 3:] += shorter[:, None, None] * m[:, :, None] * m[:, None]
        return covariances

    def log_strength_sigma(self, source: int) -> float:
        """Return the standard deviation of ln |m| of a source."""
        m = self.moment_Am2[source]
        return float(np.linalg.norm(m @ self._roots[source, 3:N_SEEN]) / (m @ m))

    def gap(self, first: int, second: int) -> tuple[float, float]:
        """Return the distance between two sources, and its standard deviation [m]."""
        offset = self.position_m[first] - self.position_m[second]
        distance = float(np.linalg.norm(offset))
        direction = offset / distance if distance else np.array([1.0, 0.0, 0.0])
        return distance, float(np.linalg.norm(direction @ (self._roots[first, :3] - self._roots[second, :3])))

    @property
    def without_sources(self) -> JointState:
        """The marginal state of the common field, without sources."""
        return replace(self, x=self.common_T, S=root_of(self.S[-N_COMMON:]))

    def without(self, source: int) -> JointState:
        """Return the state without one source."""
        own = slice(N_OF_SOURCE * source, N_OF_SOURCE * (source + 1))
        return replace(self, x=np.delete(self.x, own), S=root_of(np.delete(self.S, own, 0)))

    def with_sources(self, position_m: FloatArray, moment_Am2: FloatArray, roots: FloatArray) -> JointState:
        """Return the state with further sources (j, 3) at rest, with Cartesian roots (j, 12, 12)."""
        n, j = len(self.x) - N_COMMON, len(position_m)
        new = np.concatenate([position_m, moment_Am2, np.zeros((j, N_OF_SOURCE - N_SEEN))], axis=1)
        in_chart = chart_at(new, self.centroid_m, self.radius_m).inverse_jacobian() @ roots
        x = np.concatenate([self.x[:n], new.ravel(), self.common_T])
        S = np.zeros((len(x), len(x)))
        S[:n, : n + N_COMMON], S[-N_COMMON:, : n + N_COMMON] = self.S[:n], self.S[n:]
        for k, root in enumerate(in_chart):
            at = slice(n + N_OF_SOURCE * k, n + N_OF_SOURCE * (k + 1))
            S[at, at.start + N_COMMON : at.stop + N_COMMON] = root
        return replace(self, x=x, S=S)

    def narrow(self, along: FloatArray, share: float, offset: float) -> JointState:
        """Return the state shifted along one σ (n,), with a share of the variance along it removed."""
        # In standardised coordinates `along` is a unit vector.
        axis = np.linalg.solve(self.S, along)
        S = self.S - (1.0 - math.sqrt(1.0 - share)) * np.outer(along, axis)
        return self.shift(offset * along, S)

    def shift(self, error: FloatArray, S: FloatArray) -> JointState:
        """Return the state shifted by an error (n,), with a root S moved to the charts there."""
        K, n = self.n_sources, len(self.x) - N_COMMON
        sources, L = self.chart.linearise(error[:n].reshape(K, N_OF_SOURCE))
        x = np.concatenate([sources.ravel(), self.common_T + error[n:]])
        after = replace(self, x=x, S=S.copy())
        turn = chart_at(sources, self.centroid_m, self.radius_m).inverse_jacobian() @ L
        after.S[:n] = (turn @ S[:n].reshape(K, N_OF_SOURCE, len(S))).reshape(n, len(S))
        return after


def chart_at(sources: FloatArray, centroid_m: FloatArray, radius_m: float) -> Chart:
    """Return the charts about sources (..., 12)."""
    firm = np.ones(sources.shape[:-1], dtype=bool)
    return replace(Chart.at(sources, centroid_m, radius_m), firm=firm, power=_POWER)
