r"""Importance sampling of the place of a source that several rows do not determine yet.

The likely places are a curved valley in log-range and direction, and the moment given a place is known far better than
the place, so that a mixture of Gaussians in all six numbers leaves gaps. Therefore places are sampled, and the moment
of each is fitted, in which readings are nearly linear. With the information :math:`A^T C^{-1} A` of the scaled moment
:math:`\mu`, the density of log-range and direction is

.. math:: |C|^{-1/2} e^{-\chi^2/2} |A^T C^{-1} A|^{-1/2} |\mu|^{-3},

the same as for the cells of :mod:`magloc.tracking.chart.start`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import chdtri, ndtri

from arrays.typing import FloatArray, IntArray
from magloc.levels import CONTRADICTION
from magloc.localization.fit.prior import SourcePrior
from magloc.tracking.chart.known_moment import UNIFORM_IN_SPACE
from magloc.tracking.chart.mixture import FARTHEST, NEAREST, Mixture, root_of
from magloc.tracking.chart.stack import Stack
from magloc.tracking.coordinates import MOMENT_POWER, Chart
from magloc.tracking.motion import N_SOURCE

N_PLACES = 300
N_NEIGHBOURS, KERNEL = 30, 0.7
"""Number of neighbours that determine the width of a kernel, and the width over their spread."""
ENOUGH = 40.0
"""Effective sample size at which the sampling ends."""
_MOST_ROUNDS = 4
_INFLATED = 1.5
"""Standard deviations of the first proposal over those of the mixture, to cover its tails."""
# Blocks of places, in the order of their ranges, that share one covariance of the readings.
_N_BLOCKS = 12
_PRIMES = (2, 3, 5)
# Least cosine of the angle between a place and a component that may have proposed it.
_LEAST_COSINE = 1e-3
_POINT = 1e-6
"""Standard deviation of log-range and direction of a sampled place."""


@dataclass(frozen=True, eq=False)
class Places:
    """Proposal density: Gaussians of log-range and direction about states (K, 6).

    Attributes
    ----------
    chart : Chart
    root : ndarray, shape (K, 3, 3)
    log_weight : ndarray, shape (K,)
    """

    chart: Chart
    root: FloatArray
    log_weight: FloatArray

    @classmethod
    def of(cls, mixture: Mixture) -> Places:
        """Return the components of a mixture with inflated covariances."""
        return cls(mixture.chart, _INFLATED * root_of(mixture.S[:, :3]), mixture.log_weight)

    @classmethod
    def about(cls, drawn: Mixture) -> Places:
        """Return kernels about resampled places, each with the spread of its neighbours."""
        k = _resample(drawn.weight, N_PLACES)
        chart = drawn.chart.take(k)
        log_range, u = np.log(chart.length), chart.u
        apart = (log_range[:, None] - log_range) ** 2 + 2.0 - 2.0 * u @ u.T
        near = np.argsort(apart, axis=1, kind="stable")[:, :N_NEIGHBOURS]
        across = np.einsum("kni,kij->knj", u[near], chart.E)
        offset = np.concatenate([(log_range[near] - log_range[:, None])[..., None], across], axis=-1)
        left = offset - offset.mean(axis=1, keepdims=True)
        spread = np.swapaxes(left, -1, -2) @ left / N_NEIGHBOURS + _POINT**2 * np.eye(3)
        return cls(chart, KERNEL * np.linalg.cholesky(spread), np.full(N_PLACES, -math.log(N_PLACES)))

    def draw(self, n: int) -> FloatArray:
        """Return n states (n, 6) drawn by the weights, with the scaled moments of their components."""
        k = _resample(np.exp(self.log_weight - np.logaddexp.reduce(self.log_weight)), n)
        e = np.zeros((n, N_SOURCE))
        e[:, :3] = (self.root[k] @ _normal(n)[..., None])[..., 0]
        return self.chart.take(k).retract(e)

    def log_density(self, x: FloatArray) -> FloatArray:
        """Return the log-density (n,) of log-range and direction at states (n, 6)."""
        chart = self.chart
        offset = x[:, None, :3] - (chart.x[:, :3] - chart.length[:, None] * chart.u)
        r = np.linalg.norm(offset, axis=-1)
        direction = offset / r[..., None]
        cosine = np.sum(direction * chart.u, axis=-1)
        across = (direction[..., None, :] @ chart.E)[..., 0, :] / np.maximum(cosine, _LEAST_COSINE)[..., None]
        e = np.concatenate([np.log(r / chart.length)[..., None], across], axis=-1)
        inverse = np.linalg.inv(self.root)
        standard = (inverse @ e[..., None])[..., 0]
        each = self.log_weight + np.linalg.slogdet(inverse)[1] - 0.5 * np.sum(standard**2, axis=-1)
        # Jacobian of the projection from the sphere of directions to its tangent plane at the component.
        each += 1.5 * np.log1p(np.sum(across**2, axis=-1)) - 1.5 * math.log(2.0 * math.pi)
        return np.asarray(np.logaddexp.reduce(np.where(cosine > _LEAST_COSINE, each, -np.inf), axis=1))


def _resample(weight: FloatArray, n: int) -> IntArray:
    """Return the indices (n,) of a systematic resampling by weights."""
    return np.minimum(np.searchsorted(np.cumsum(weight), (0.5 + np.arange(n)) / n), len(weight) - 1)


@cache
def _normal(n: int) -> FloatArray:
    """Return quasi-random normal numbers (n, 3) by Halton's sequence."""
    uniform = np.zeros((n, len(_PRIMES)))
    for axis, base in enumerate(_PRIMES):
        left, share = np.arange(1, n + 1), 1.0
        while left.any():
            share /= base
            left, digit = np.divmod(left, base)
            uniform[:, axis] += share * digit
    return np.asarray(ndtri(uniform))


def effective_sample_size(drawn: Mixture) -> float:
    """Return the effective number of samples by their weights."""
    return float(1.0 / np.sum(drawn.weight**2))


def sample_places(stack: Stack, places: Sequence[Places], prior: SourcePrior) -> Mixture | None:
    """Sample places by all rows until enough of them have weight; None if none is possible."""
    drawn: Mixture | None = None
    every = list(places)
    for _ in range(_MOST_ROUNDS if places else 0):
        found = _importance_sample(stack, every, prior)
        if found is None:
            break
        drawn = found
        if effective_sample_size(drawn) > ENOUGH:
            break
        # Earlier proposals stay, so that one improbable sample cannot take all of the weight.
        every = [*places, Places.about(drawn)]
    return drawn


def _importance_sample(stack: Stack, places: Sequence[Places], prior: SourcePrior) -> Mixture | None:
    """Return weighted states from several proposals, with the best moment of each place."""
    n_each = N_PLACES // len(places)
    x = np.concatenate([one.draw(n_each) for one in places])
    log_density = np.logaddexp.reduce([one.log_density(x) for one in places], axis=0)
    order = np.argsort(np.linalg.norm(x[:, :3] - stack.centroid_m, axis=1))
    x, log_density = x[order], log_density[order]
    # At similar ranges the covariance of the readings is similar.
    blocks = np.array_split(np.arange(len(x)), _N_BLOCKS)
    roots = np.linalg.cholesky(stack.covariance(x[[block[len(block) // 2] for block in blocks]]))
    predicted, by_moment = stack.linearise_in_moment(x)
    left = stack.z - predicted + (by_moment @ x[:, 3:6, None])[..., 0]
    both = np.concatenate([by_moment, left[..., None]], axis=-1)
    log_C = np.empty(len(x))
    for block, root in zip(blocks, roots, strict=True):
        both[block] = np.linalg.solve(root, both[block])
        log_C[block] = 2.0 * np.sum(np.log(np.diagonal(root)))
    R = np.asarray(np.linalg.qr(both, mode="r"))
    with np.errstate(all="ignore"):
        moment, R, chi2 = _moments(stack, prior, R)
        x = np.concatenate([x[:, :3], moment], axis=1)
        chart = stack.chart(x)
        log_range = np.log(chart.length)
        log_information = 2.0 * np.sum(np.log(np.abs(np.diagonal(R, axis1=1, axis2=2))), axis=1)
        log_prior = -3.0 * np.log(np.linalg.norm(moment, axis=1))
        if prior.known_moment is not None:
            log_prior = log_prior + UNIFORM_IN_SPACE * log_range
        log_weight = log_prior - 0.5 * (chi2 + log_C + log_information) - log_density
    reach = np.linalg.norm(x[:, :3] - stack.centroid_m, axis=1) / stack.radius_m
    in_array = (x[:, :3] - stack.row.origin_m) @ stack.row.R_world_from_array
    sound = np.isfinite(log_weight) & (reach > NEAREST) & (reach < FARTHEST)
    sound &= prior.allows_position(in_array) & prior.allows_moment(x[:, 3:6])
    dof = stack.n_differences - N_SOURCE
    if not sound.any() or (dof > 0 and chi2[sound].min() > chdtri(dof, CONTRADICTION)):
        return None
    S = np.zeros((len(x), N_SOURCE, N_SOURCE))
    S[:, :3, :3] = _POINT * np.eye(3)
    S[sound, 3:, 3:] = root_of(np.linalg.inv(R[sound])) / chart.length[sound, None, None] ** MOMENT_POWER
    return Mixture(x, S, log_weight, N_SOURCE, stack.centroid_m, stack.radius_m).take(sound)


def _moments(stack: Stack, prior: SourcePrior, R: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return best moments (n, 3), roots (n, 3, 3) of their information, and χ² (n,)."""
    chi2 = R[:, 3, 3] ** 2
    known, turn = prior.known_moment, stack.row.R_world_from_array
    of_moment, y = R[:, :3, :3], R[:, :3, 3]
    regular = (np.diagonal(of_moment, axis1=1, axis2=2) != 0.0).all(axis=1)
    of_moment = np.where(regular[:, None, None], of_moment, np.nan)
    if known is None:
        return np.asarray(np.linalg.solve(of_moment, y[..., None])[..., 0]), of_moment, chi2
    # The moment is known in the array's axes.
    of_moment = of_moment @ turn
    information, pull = (
        np.swapaxes(of_moment, -1, -2) @ of_moment,
        (np.swapaxes(of_moment, -1, -2) @ y[..., None])[..., 0],
    )
    moment = known.best_moments(information, pull, np.ones(len(R)))
    chi2 = chi2 + np.sum((y - (of_moment @ moment[..., None])[..., 0]) ** 2, axis=1)
    chi2 += np.sum(known.residual(moment[:, None]) ** 2, axis=1)
    by_known = known.jacobian(moment[:, None])[:, 0]
    both = np.concatenate([of_moment, by_known], axis=1) @ turn.T
    return moment @ turn.T, np.asarray(np.linalg.qr(both, mode="r")), chi2
