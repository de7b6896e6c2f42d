r"""All sources of a survey fitted together, with everything else that the readings hold projected out.

The ground is an equivalent layer: poles below it, whose strengths are Gaussian and are eliminated,

.. math:: \min_a |r - L a|^2 + |a|^2 = r^T (1 - L (L^T L + 1)^{-1} L^T) r

in white units, and so are their columns in the Jacobian of the sources: damped least squares on what is left.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.linalg import cho_factor, solve_triangular

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.least_squares import damped_step, minimise
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.kernels import MeasuredRows
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.whitening import Drift, Whitening

_MOST_STEPS = 25
_SETTLED, _DAMPING = 1e-3, 1e-3
_UNKNOWN = 1e4  # standard deviation of a column of unit length
_NEGLIGIBLE = 0.1  # of the noise
_BESIDE_M, _BESIDE_SHARE = 0.1, 0.2  # errors of sources that other rows tell: of places, and of moments over their size
_RIDGE = 1e-10  # of a parameter's own information: above rounding, so that few rows leave no matrix singular


@dataclass(frozen=True, eq=False)
class Sources:
    """Positions and moments (K, 3)."""

    position_m: FloatArray
    moment_Am2: FloatArray

    @classmethod
    def none(cls) -> Sources:
        """No source."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.position_m)

    def some(self, which: BoolArray | IntArray) -> Sources:
        """Those of a mask or of indices."""
        return Sources(self.position_m[which], self.moment_Am2[which])

    def fields(self, record: SurveyRecord) -> FloatArray:
        """Field (n, N, 3) of these, and of those that a record knows, at its sensors."""
        return record.fields(self.position_m, self.moment_Am2)

    @classmethod
    def joined(cls, parts: Sequence[Sources]) -> Sources:
        """All of several."""
        every = [cls.none(), *parts]
        return cls(*(np.concatenate(each) for each in zip(*(vars(part).values() for part in every), strict=True)))

    def with_more(self, others: Sources) -> Sources:
        """These and others."""
        return Sources.joined([self, others])

    def without_twins(self, nearest_m: FloatArray) -> Sources:
        """With one source, where they are together, in place of two that are nearer to each other than some (K,)."""
        position, moment, alone = self.position_m.copy(), self.moment_Am2.copy(), np.ones(len(self), np.bool_)
        for k in range(1, len(self)):
            apart = np.where(alone[:k], np.linalg.norm(position[:k] - position[k], axis=1), np.inf)
            twin = int(np.argmin(apart))
            if apart[twin] < nearest_m[k]:
                position[twin], moment[twin] = 0.5 * (position[twin] + position[k]), moment[twin] + moment[k]
                alone[k] = False
        return Sources(position, moment).some(alone)

    def moved(self, step: FloatArray) -> Sources:
        """After a step (K, 6)."""
        return Sources(self.position_m + step[:, :3], self.moment_Am2 + step[:, 3:])


@dataclass(frozen=True, eq=False)
class Layer:
    """Poles (P, 3) below the ground, and the field that each is expected to make right above itself [T]."""

    places_m: FloatArray
    depth_m: float
    field_T: float

    @classmethod
    def below(cls, record: SurveyRecord, shortest_m: float, field_T: float) -> Layer:
        """A layer for fields whose wavelengths are no shorter than some length; its places are those of all records."""
        depth = shortest_m / 2.5
        spacing = depth / 1.5
        low, high = record.sensors_m.min(axis=(0, 1)), record.sensors_m.max(axis=(0, 1))
        x, y = (
            spacing * np.arange(math.floor((a - depth) / spacing), math.ceil((b + depth) / spacing) + 1)
            for a, b in zip(low[:2], high[:2], strict=True)
        )
        grid = np.stack(np.meshgrid(x, y, [low[2] - depth], indexing="ij"), axis=-1).reshape(-1, 3)
        return cls(grid, depth, field_T)

    def columns(self, record: SurveyRecord, directions: FloatArray, white: Whitening) -> FloatArray:
        """White columns (g·k, P) of what poles of their expected strength add to the measurements."""
        starts, owner = white.starts, record.array.channel_sensor
        # Poles are deep: from the middles of the halves of a group they are seen as from its rows.
        halves = np.unique(np.concatenate([starts[:-1], (starts[:-1] + starts[1:]) // 2]))
        weight = np.diff(halves, append=starts[-1])[:, None, None]
        sensors, seen = (np.add.reduceat(rows, halves) for rows in (record.sensors_m, directions))
        of_group = np.searchsorted(halves, starts)
        scale = np.repeat(np.sqrt(np.diff(of_group) / np.diff(starts)), np.diff(of_group))[:, None, None]
        halved = MeasuredRows(sensors / weight, seen * scale, white.U, owner, of_group)
        return self.field_T * self.depth_m**2 * white.of_groups(halved.pole_columns(self.places_m))


@dataclass(frozen=True, eq=False)
class Background:
    """What is projected out where some sources are: noise in time, the layer, what is wrong with sensors and points.

    Attributes
    ----------
    white : Whitening
    Q : ndarray, shape (g·k, P)
        White columns of the layer, of what is wrong with the sensors, and of bodies that are no points, times a root of
        the inverse of ``LᵀL + 1``.
    """

    white: Whitening
    Q: FloatArray

    @property
    def noise_log_determinant(self) -> float:
        """Log-determinant of the covariance of all that is projected out: of the noise in time, and of ``LᵀL + 1``."""
        return self.white.log_determinant - float(np.linalg.slogdet(np.eye(self.Q.shape[1]) - self.Q.T @ self.Q)[1])

    @classmethod
    def of_each(
        cls,
        record: SurveyRecord,
        sources: Sources,
        layer: Layer,
        errors: PoseErrors,
        drift: Drift,
        groups: Iterable[IntArray],
        body_length_m: float = 0.0,
        beside: Sources | None = None,
    ) -> Iterator[Background]:
        """With errors of the pose as the field of the sources makes them felt, and of bodies that are no points.

        One for every way to group the rows (n,). Sources beside, which the record knows, are where they are said to be
        but for small errors.
        """
        beside = Sources.none() if beside is None else beside
        fields = sources.fields(record)
        gradients = record.gradients(sources.position_m, sources.moment_Am2)
        directions = record.directions(fields)
        least_T = _NEGLIGIBLE * float(record.array.channel_noise_T.min())
        near = sources.with_more(beside)
        where = directions, near.position_m, near.moment_Am2
        size = _BESIDE_SHARE * np.repeat(np.linalg.norm(beside.moment_Am2, axis=1)[:, None], 6, axis=1)
        size[:, :3] = _BESIDE_M
        by_square = record.by_squared_shift(*where, least_T)
        by_pose = record.by_pose(directions, fields, gradients)
        by_turn = record.by_turned_carrier(errors, least_T)
        wrong = record.by_sensors(directions), record.by_bodies(*where, body_length_m, least_T)
        for group in groups:
            white = Whitening.of(record, by_pose, by_turn, by_square, errors, drift, group)
            moved = size.ravel() * source_jacobian(record, directions, white, beside)
            columns = [layer.columns(record, directions, white), moved, *map(white, wrong)]
            yield cls(white, orthogonal(np.concatenate(columns, axis=1)))


def with_free_sources(record: SurveyRecord, background: Background, sources: Sources) -> FloatArray:
    """``Q`` of a background where some sources, too, are free to move, to first order."""
    Q = background.Q
    if not len(sources):
        return Q
    J = jacobian_of(record, background, sources, sources.fields(record))
    J *= _UNKNOWN / np.linalg.norm(J, axis=0)
    # What is left of J is J' = (1 - QQᵀ) J, and its square JᵀJ', not J'ᵀJ': the ground is Gaussian, not free.
    left = J - Q @ (Q.T @ J)
    return np.concatenate([Q, _times_root_of_inverse(left, J.T @ left)], axis=1)


def orthogonal(L: FloatArray) -> FloatArray:
    """``Q`` with ``Q Qᵀ = L (LᵀL + 1)⁻¹ Lᵀ``."""
    return _times_root_of_inverse(L, L.T @ L)


def _times_root_of_inverse(L: FloatArray, square: FloatArray) -> FloatArray:
    """``Q`` with ``Q Qᵀ = L (A + 1)⁻¹ Lᵀ`` of some symmetric matrix ``A``."""
    factor = cho_factor(square + np.eye(L.shape[1]), lower=True)[0]
    return np.asarray(L @ solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False).T)


@dataclass(frozen=True, eq=False)
class Bounds:
    """Where a source may be, and how strong."""

    low_m: FloatArray
    high_m: FloatArray
    moment_Am2: float = 300.0

    def hold(self, sources: Sources) -> BoolArray:
        """Which sources (K,) are within."""
        inside = np.all((sources.position_m > self.low_m) & (sources.position_m < self.high_m), axis=1)
        return np.asarray(inside & (np.linalg.norm(sources.moment_Am2, axis=1) < self.moment_Am2))

    def around(self, sources: Sources, reach_m: FloatArray) -> Bounds:
        """Those of sources that stay within some reach (K,) of where they are."""
        return replace(
            self,
            low_m=np.maximum(self.low_m, sources.position_m - reach_m[:, None]),
            high_m=np.minimum(self.high_m, sources.position_m + reach_m[:, None]),
        )

    def clipped(self, sources: Sources) -> Sources:
        """Sources moved within."""
        return replace(sources, position_m=np.clip(sources.position_m, self.low_m, self.high_m))


@dataclass(frozen=True, eq=False)
class JointFit:
    """Sources fitted together, with the noise held.

    Attributes
    ----------
    record : SurveyRecord
    background : Background
    bounds : Bounds
        Where steps may lead.
    sources : Sources
    """

    record: SurveyRecord
    background: Background
    bounds: Bounds
    sources: Sources

    @cached_property
    def _fields(self) -> FloatArray:
        return self.sources.fields(self.record)

    @cached_property
    def residual(self) -> FloatArray:
        """White (g·k,), the layer not yet taken out."""
        return residual_of(self.record, self.background, self._fields)

    @cached_property
    def _of_layer(self) -> FloatArray:
        return np.asarray(self.background.Q.T @ self.residual)

    @cached_property
    def cost(self) -> float:
        """χ² of the white residual, the layer's own prior included."""
        return float(self.residual @ self.residual - self._of_layer @ self._of_layer)

    @cached_property
    def _jacobian(self) -> tuple[FloatArray, FloatArray]:
        """White columns (g·k, 6 K) of the sources, and what the layer's columns take of them."""
        J = jacobian_of(self.record, self.background, self.sources, self._fields)
        return J, self.background.Q.T @ J

    @cached_property
    def information(self) -> FloatArray:
        """Of positions and moments (6 K, 6 K), everything else eliminated."""
        if not len(self.sources):
            return np.zeros((0, 0))
        J, J_layer = self._jacobian
        return np.asarray(J.T @ J - J_layer.T @ J_layer)

    def step(self, damping: float) -> tuple[JointFit, float]:
        """The sources after a damped step, within the bounds."""
        J, J_layer = self._jacobian
        gradient = J_layer.T @ self._of_layer - J.T @ self.residual
        step, promised = damped_step(self.information, gradient, damping)
        return replace(self, sources=self.bounds.clipped(self.sources.moved(step.reshape(-1, 6)))), promised

    @property
    def covariance(self) -> FloatArray:
        """Of positions and moments (6 K, 6 K)."""
        scale = 1.0 / np.sqrt(np.diagonal(self.information))
        scaled = scale[:, None] * self.information * scale
        return np.asarray(scale[:, None] * np.linalg.inv(scaled + _RIDGE * np.eye(len(scale))) * scale)

    @property
    def significance(self) -> FloatArray:
        """What χ² would grow by without each source (K,), the others free to move in its place."""
        H, K = self.information, len(self.sources)
        found = np.empty(K)
        for j in range(K):
            own = np.arange(6 * j + 3, 6 * j + 6)
            others = np.delete(np.arange(6 * K), np.arange(6 * j, 6 * j + 6))
            scale = 1.0 / np.sqrt(np.diagonal(H)[others])
            among = scale[:, None] * H[np.ix_(others, others)] * scale + _RIDGE * np.eye(len(others))
            shared = scale[:, None] * H[np.ix_(others, own)]
            left = H[np.ix_(own, own)] - shared.T @ np.linalg.solve(among, shared)
            m = self.sources.moment_Am2[j]
            found[j] = m @ left @ m
        return found


def residual_of(record: SurveyRecord, background: Background, fields_T: FloatArray) -> FloatArray:
    """White residual (g·k,) of the fields of sources."""
    return background.white((record.values_T - record.predicted(fields_T))[..., None])[:, 0]


def jacobian_of(record: SurveyRecord, background: Background, sources: Sources, fields_T: FloatArray) -> FloatArray:
    """White columns (g·k, 6 K) of what positions and moments add to the measurements, where their fields are."""
    return source_jacobian(record, record.directions(fields_T), background.white, sources)


def source_jacobian(record: SurveyRecord, directions: FloatArray, white: Whitening, sources: Sources) -> FloatArray:
    """The same where it is said what channels read of a small change of the field."""
    rows = white.measured_rows(record, directions)
    return white.of_groups(rows.source_columns(sources.position_m, sources.moment_Am2))


def fit_jointly(
    record: SurveyRecord,
    background: Background,
    sources: Sources,
    bounds: Bounds,
    *,
    most: int = _MOST_STEPS,
    settled: float = _SETTLED,
    damping: float = _DAMPING,
) -> JointFit:
    """Levenberg-Marquardt from some sources, the noise held."""
    start = JointFit(record, background, bounds, sources)
    # While much is missing, little is settled.
    least = lambda fit: settled * max(1.0, fit.cost / fit.residual.size)  # noqa: E731
    return minimise(start, least, damping=damping, max_iterations=most if len(sources) else 0).point
