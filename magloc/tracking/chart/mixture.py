"""Gaussian mixture of a source's state in log-range, direction and scaled moment."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr, ndtri

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.localization.fit.results import Intervals
from magloc.tracking.coordinates import MOMENT_POWER, Chart
from magloc.tracking.motion import N_SOURCE

MERGED_BELOW = 0.02
"""Kullback-Leibler divergence below which two components are merged."""
DROPPED_BELOW = -12.0
"""Logarithm of a component's weight over the largest one below which it is dropped."""
NEAREST, FARTHEST = 0.6, 60.0
"""Range of the search for a source, in radii of the array. A set that reaches the upper bound is open, unless it is
narrow."""
_OUTSIDE = 0.025
# Largest standard deviation of the log-range in the mean of a log-normal range: with more, the prior dominates.
_WIDEST = 1.0
# Range in radii beyond which a component has run away, and the least logarithm of its weight over the largest one then.
_RUN_AWAY, _LEAST_RUN_AWAY = 20.0 * FARTHEST, -5.0
# Bounds of the logarithm of quantiles of the range in metres.
_BEYOND, _N_BISECTIONS = 30.0, 60


@dataclass(frozen=True, eq=False)
class Mixture:
    """Gaussian mixture of the states of a source and of its array's lasting errors.

    Attributes
    ----------
    x : ndarray, shape (K, N)
        Cartesian means: source, motion, errors of the pose, lasting errors of the sensors.
    S : ndarray, shape (K, N, N)
        Roots of the covariances, in the chart about each mean; of a point of a track (K, 6, N) until
        :meth:`source_marginal`.
    log_weight : ndarray, shape (K,)
        Logarithms of the weights, which sum to one.
    n_charted : int
        Length of the states without the sensors' errors.
    centroid_m : ndarray, shape (3,)
        Centroid of the sensors, in the world frame.
    radius_m : float
        Largest distance of a sensor from the centroid.
    n_pose : int
        Number of errors of the array's pose, the last of the `n_charted` states.
    n_rows : int
        Number of rows used.
    """

    x: FloatArray
    S: FloatArray
    log_weight: FloatArray
    n_charted: int
    centroid_m: FloatArray
    radius_m: float
    n_pose: int = 0
    n_rows: int = 1

    @classmethod
    def of_gaussian(cls, x: FloatArray, S: FloatArray, centroid_m: FloatArray, radius_m: float) -> Mixture:
        """Return the mixture of one source with a Cartesian state (6,) and root (6, m) of its covariance."""
        root = Chart.at(x, centroid_m, radius_m).inverse_jacobian() @ S
        return cls(x[None], root_of(root)[None], np.zeros(1), x.size, centroid_m, radius_m)

    def __len__(self) -> int:
        return len(self.x)

    @property
    def weight(self) -> FloatArray:
        """Weights (K,)."""
        return np.exp(self.log_weight)

    @property
    def chart(self) -> Chart:
        """Charts about the components."""
        return Chart.at(self.x[:, : self.n_charted], self.centroid_m, self.radius_m, self.n_pose)

    @property
    def widths(self) -> FloatArray:
        """Largest standard deviation (K,) of log-range and direction."""
        return np.sqrt(np.max(np.sum(self.S[:, :3] ** 2, axis=2), axis=1))

    @property
    def log_range_sigma(self) -> float:
        """Standard deviation of the log-range of the whole mixture."""
        if len(self) == 1:
            return float(np.linalg.norm(self.S[0, 0]))
        log_range, weight = np.log(self.chart.length), self.weight
        apart = log_range - weight @ log_range
        return float(np.sqrt(weight @ (apart**2 + np.sum(self.S[:, 0] ** 2, axis=1))))

    def take(self, index: IntArray | BoolArray) -> Mixture:
        """Return some of the components, with normalised weights."""
        log_weight = self.log_weight[index]
        log_weight = log_weight - np.logaddexp.reduce(log_weight)
        return replace(self, x=self.x[index], S=self.S[index], log_weight=log_weight)

    def source_marginal(self) -> Mixture:
        """Return the marginal of position and moment."""
        if self.S.shape[1:] == (N_SOURCE, N_SOURCE):
            return self
        return replace(self, x=self.x[:, :N_SOURCE], S=root_of(self.S[:, :N_SOURCE]), n_charted=N_SOURCE, n_pose=0)

    def drop_unlikely(self) -> Mixture:
        """Return the mixture without components of negligible weight; at absurd ranges the limit is higher.

        A light component at an absurd range would be the mean of all.
        """
        least = np.where(self.chart.length > _RUN_AWAY * self.radius_m, _LEAST_RUN_AWAY, DROPPED_BELOW)
        return self.take(self.log_weight >= self.log_weight.max() + least)

    def reduce(self) -> Mixture:
        """Drop unlikely components, and merge those that are nearly equal."""
        likely = self.drop_unlikely()
        if len(likely) == 1:
            return likely
        likely = likely.take(np.argsort(-likely.log_weight, kind="stable"))
        groups = _groups(likely)
        if len(groups) == len(likely):
            return likely
        first = np.array([group[0] for group in groups])
        merged, log_weight = likely.take(first), likely.log_weight[first]
        for i, group in enumerate(groups):
            if len(group) > 1:
                one = likely.take(group).match_moments()
                merged.x[i], merged.S[i] = one.x[0], one.S[0]
                log_weight[i] = np.logaddexp.reduce(likely.log_weight[group])
        return replace(merged, log_weight=log_weight - np.logaddexp.reduce(log_weight))

    def match_moments(self) -> Mixture:
        """Return the Gaussian of equal mean and covariance in the heaviest component's chart."""
        if len(self) == 1:
            return self
        n, best = self.n_charted, int(np.argmax(self.log_weight))
        about = self.take(np.array([best])).chart
        offset, roots = _in_chart(about, self)
        mean = self.weight @ offset
        spread = np.sqrt(self.weight)[:, None, None] * np.concatenate([roots, (offset - mean)[:, :, None]], axis=2)
        x = self.x[best] + mean
        x[:n] = about.retract(mean[None, :n])[0]
        after = Chart.at(x[None, :n], self.centroid_m, self.radius_m, self.n_pose)
        rows = np.concatenate(list(spread), axis=1)
        turn = after.inverse_jacobian()[0] @ about.jacobian(mean[None, :n])[0]
        rows[:n] = turn @ rows[:n]
        return replace(self, x=x[None], S=root_of(rows)[None], log_weight=np.zeros(1))

    def moments(self) -> tuple[FloatArray, FloatArray]:
        """Return Cartesian mean (6,) and covariance (6, 6); ranges are log-normal."""
        mean, covariance = component_moments(self.chart, self.S)
        return (mean[0], covariance[0]) if len(self) == 1 else mixture_moments(self.weight, mean, covariance)

    def square_distance(self, x: FloatArray) -> FloatArray:
        """Return the squared Mahalanobis distance (K,) of a state (N,), or of one each (K, N), from the components."""
        n = self.n_charted
        e = self.chart.coordinates(x[..., :n])
        return np.asarray(np.sum(np.linalg.solve(root_of(self.S[:, :n]), e[..., None])[..., 0] ** 2, axis=1))

    def range_interval_m(self) -> Intervals:
        """Return the 95 % set of the distance from the centroid [m], by quantiles of the mixture."""
        chart = self.chart
        r = np.linalg.norm(self.x[:, :3] - self.centroid_m, axis=1)
        sigma, weight = np.linalg.norm(self.S[:, 0], axis=1), self.weight
        # The chart's origin is behind the centroid if the source is nearer than the array's radius.
        back = chart.length - r

        def quantile(share: float) -> float:
            low, high = -_BEYOND, _BEYOND
            if len(self) == 1:
                at = float(chart.length[0]) * math.exp(float(sigma[0]) * float(ndtri(share))) - float(back[0])
                return min(max(at, math.exp(low)), math.exp(high))
            for _ in range(_N_BISECTIONS):
                middle = 0.5 * (low + high)
                with np.errstate(divide="ignore"):
                    below = ndtr((np.log((np.exp(middle) + back) / chart.length)) / np.maximum(sigma, 1e-300))
                low, high = (middle, high) if weight @ below < share else (low, middle)
            return float(np.exp(low))

        nearest, farthest = quantile(_OUTSIDE), quantile(1.0 - _OUTSIDE)
        is_open = farthest > max(2.0 * nearest, FARTHEST * self.radius_m)
        return ((nearest, None if is_open else farthest),)


def component_moments(chart: Chart, S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return Cartesian means (K, 6) and covariances (K, 6, 6) of components with roots S."""
    reach = chart.length[:, None, None]
    of_position = reach * (chart.u[:, :, None] * S[:, :1] + chart.E @ S[:, 1:3])
    of_moment = MOMENT_POWER * chart.x[:, 3:6, None] * S[:, :1] + reach**MOMENT_POWER * S[:, 3:6]
    root = np.concatenate([of_position, of_moment], axis=1)
    mean = chart.x[:, :N_SOURCE].copy()
    by_range = np.expm1(0.5 * np.minimum(np.sum(S[:, 0] ** 2, axis=1), _WIDEST**2))
    mean[:, :3] += (by_range * chart.length)[:, None] * chart.u
    return mean, root @ np.swapaxes(root, -1, -2)


def mixture_moments(weight: FloatArray, mean: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return mean (n,) and covariance (n, n) of a mixture, from its weights (K,) and components."""
    centre = weight @ mean
    off = mean - centre
    return centre, np.einsum("k,kij->ij", weight, covariance) + (weight[:, None] * off).T @ off


def _in_chart(about: Chart, mixture: Mixture) -> tuple[FloatArray, FloatArray]:
    """Return means (K, N) and roots (K, N, N) of all components in the chart of one."""
    n, K = mixture.n_charted, len(mixture)
    chart = about.take(np.zeros(K, dtype=np.intp))
    offset, roots = np.zeros_like(mixture.x), mixture.S.copy()
    best = int(np.argmax(mixture.log_weight))
    offset[:, n:] = mixture.x[:, n:] - mixture.x[best, n:]
    offset[:, :n] = chart.coordinates(mixture.x[:, :n])
    turn = np.linalg.solve(chart.jacobian(offset[:, :n]), mixture.chart.jacobian(np.zeros((K, n))))
    roots[:, :n] = turn @ roots[:, :n]
    return offset, roots


def root_of(rows: FloatArray) -> FloatArray:
    """Return the lower root (..., n, n) of ``rows rowsᵀ`` by QR of rows (..., n, m), m ≥ n."""
    return np.swapaxes(np.linalg.qr(np.swapaxes(rows, -1, -2), mode="r"), -1, -2)


def _groups(mixture: Mixture) -> list[IntArray]:
    """Return groups of components that are nearly equal to the group's first, heaviest first."""
    chart, S, K = mixture.chart, mixture.S, len(mixture)
    variance = np.sum(S[:, :3] ** 2, axis=2)
    log_range, log_variance = np.log(chart.length), np.log(variance[:, 0])
    # The divergence of the log-range alone, and half the squared offset in any coordinate, are lower bounds.
    square = (log_range - log_range[:, None]) ** 2 + variance[:, 0]
    of_range = square / variance[:, :1] - 1.0 + log_variance[:, None] - log_variance
    angle = np.sum((chart.u - chart.u[:, None]) ** 2, axis=2)
    near = of_range < 2.0 * MERGED_BELOW
    near &= angle < 4.0 * MERGED_BELOW * (variance[:, 1] + variance[:, 2])[:, None]
    first, other = np.nonzero(np.triu(near, 1))
    same, left = np.zeros((K, K), dtype=bool), np.ones(K, dtype=bool)
    same[first, other] = _divergences(mixture, first, other) < MERGED_BELOW
    groups = []
    for i in range(K):
        if left[i]:
            same[i, i] = True
            groups.append(np.flatnonzero(same[i] & left))
            left[groups[-1]] = False
    return groups


def _divergences(mixture: Mixture, first: IntArray, others: IntArray) -> FloatArray:
    """Return the Kullback-Leibler divergences (m,) of pairs of components, in source and motion."""
    if not first.size:
        return np.zeros(0)
    n, about, chart = mixture.n_charted, mixture.chart.take(first), mixture.chart.take(others)
    d, unit = about.coordinates(chart.x), root_of(mixture.S[first, :n])
    # In units of the first ones' standard deviations.
    of_others = chart.jacobian(np.zeros_like(d)) @ mixture.S[others, :n]
    roots = np.linalg.solve(about.jacobian(d) @ unit, of_others)
    e = np.linalg.solve(unit, d[..., None])[..., 0]
    log_det = np.linalg.slogdet(roots @ np.swapaxes(roots, -1, -2))[1]
    return np.asarray(0.5 * (np.sum(roots**2, axis=(1, 2)) + np.sum(e**2, axis=1) - n - log_det))
