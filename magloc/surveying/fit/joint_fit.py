r"""Joint fit of all sources of a survey, with all other contributions projected out.

The ground is an equivalent layer: poles below it, whose strengths are Gaussian and are eliminated,

.. math:: \min_a |r - L a|^2 + |a|^2 = r^T (1 - L (L^T L + 1)^{-1} L^T) r

in white units. The columns of the sources' Jacobian are projected in the same way; damped least squares fits the rest.
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
from magloc.surveying.fit.sensor_noise import white_noise_T
from magloc.surveying.fit.whitening import RecordWhitening, SurveyDrift
from magloc.terrain.surface import FLAT, Terrain

_MOST_STEPS = 25
_SETTLED, _DAMPING = 1e-3, 1e-3
_UNKNOWN = 1e4  # standard deviation of a column of unit length
_NEGLIGIBLE = 0.1  # negligible effect, in units of the noise
_BESIDE_M, _BESIDE_SHARE = 0.1, 0.2  # errors of sources from other rows: of positions [m], and relative, of moments
_RIDGE = 1e-10  # share of a parameter's own information that is added, so that no matrix is singular for few rows


@dataclass(frozen=True, eq=False)
class Sources:
    """Positions and moments (K, 3) of sources."""

    position_m: FloatArray
    moment_Am2: FloatArray

    @classmethod
    def none(cls) -> Sources:
        """Return an empty set of sources."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)))

    def __len__(self) -> int:
        return len(self.position_m)

    def some(self, which: BoolArray | IntArray) -> Sources:
        """Return the sources of a mask or of indices."""
        return Sources(self.position_m[which], self.moment_Am2[which])

    def fields(self, record: SurveyRecord) -> FloatArray:
        """Return the field (n, N, 3) of these sources and of known ones at a record's sensors."""
        return record.fields(self.position_m, self.moment_Am2)

    @classmethod
    def concatenate(cls, parts: Sequence[Sources]) -> Sources:
        """Return several sets of sources as one."""
        every = [cls.none(), *parts]
        return cls(*(np.concatenate(each) for each in zip(*(vars(part).values() for part in every), strict=True)))

    def with_more(self, others: Sources) -> Sources:
        """Return these sources and others."""
        return Sources.concatenate([self, others])

    def without_twins(self, nearest_m: FloatArray) -> Sources:
        """Merge sources that are nearer to each other than distances (K,)."""
        position, moment, alone = self.position_m.copy(), self.moment_Am2.copy(), np.ones(len(self), np.bool_)
        for k in range(1, len(self)):
            apart = np.where(alone[:k], np.linalg.norm(position[:k] - position[k], axis=1), np.inf)
            twin = int(np.argmin(apart))
            if apart[twin] < nearest_m[k]:
                position[twin], moment[twin] = 0.5 * (position[twin] + position[k]), moment[twin] + moment[k]
                alone[k] = False
        return Sources(position, moment).some(alone)

    def apply_step(self, step: FloatArray) -> Sources:
        """Return the sources after a step (K, 6)."""
        return Sources(self.position_m + step[:, :3], self.moment_Am2 + step[:, 3:])


@dataclass(frozen=True, eq=False)
class Layer:
    """Poles (P, 3) below the ground, and the expected field of each right above it [T]."""

    places_m: FloatArray
    depth_m: float
    field_T: float

    @classmethod
    def below(cls, record: SurveyRecord, shortest_m: float, field_T: float) -> Layer:
        """Return a layer for fields above a shortest wavelength, below all rows of a record."""
        depth = shortest_m / 2.5
        spacing = depth / 1.5
        low, high = record.flat_m.min(axis=(0, 1)), record.flat_m.max(axis=(0, 1))
        x, y = (
            spacing * np.arange(math.floor((a - depth) / spacing), math.ceil((b + depth) / spacing) + 1)
            for a, b in zip(low[:2], high[:2], strict=True)
        )
        grid = np.stack(np.meshgrid(x, y, [low[2] - depth], indexing="ij"), axis=-1).reshape(-1, 3)
        return cls(record.terrain.drape(grid), depth, field_T)

    def columns(self, record: SurveyRecord, directions: FloatArray, white: RecordWhitening) -> FloatArray:
        """Return white columns (g·k, P): the readings of poles of the expected strength."""
        starts, owner = white.starts, record.array.channel_sensor
        # Poles are deep, so that the means of half a group replace its rows.
        halves = np.unique(np.concatenate([starts[:-1], (starts[:-1] + starts[1:]) // 2]))
        weight = np.diff(halves, append=starts[-1])[:, None, None]
        sensors, seen = (np.add.reduceat(rows, halves) for rows in (record.sensors_m, directions))
        of_group = np.searchsorted(halves, starts)
        scale = np.repeat(np.sqrt(np.diff(of_group) / np.diff(starts)), np.diff(of_group))[:, None, None]
        halved = MeasuredRows(sensors / weight, seen * scale, white.U, owner, of_group)
        return self.field_T * self.depth_m**2 * white.of_groups(halved.pole_columns(self.places_m))


@dataclass(frozen=True, eq=False)
class SurveyBackground:
    """Nuisances to project out: noise in time, the layer, errors of sensors, bodies.

    Attributes
    ----------
    white : Whitening
    Q : ndarray, shape (g·k, P)
        White columns of the layer, of sensor errors and of the extent of bodies, times a root of the inverse of
        ``LᵀL + 1``.
    """

    white: RecordWhitening
    Q: FloatArray

    @property
    def noise_log_determinant(self) -> float:
        """Log-determinant of the covariance of the noise in time and of ``LᵀL + 1``."""
        return self.white.log_determinant - float(np.linalg.slogdet(np.eye(self.Q.shape[1]) - self.Q.T @ self.Q)[1])

    @classmethod
    def of_each(
        cls,
        record: SurveyRecord,
        sources: Sources,
        layer: Layer,
        errors: PoseErrors,
        drift: SurveyDrift,
        groups: Iterable[IntArray],
        body_length_m: float = 0.0,
        beside: Sources | None = None,
    ) -> Iterator[SurveyBackground]:
        """Return a background for every way to group the rows (n,).

        Pose errors act through the gradient of the sources' field, and bodies deviate from points. Sources ``beside``,
        whose field the record includes, have small errors of position and moment.
        """
        beside = Sources.none() if beside is None else beside
        fields = sources.fields(record)
        gradients = record.gradients(sources.position_m, sources.moment_Am2)
        directions = record.directions(fields)
        least_T = _NEGLIGIBLE * float(white_noise_T(record.array).min())
        near = sources.with_more(beside)
        where = directions, near.position_m, near.moment_Am2
        size = _BESIDE_SHARE * np.repeat(np.linalg.norm(beside.moment_Am2, axis=1)[:, None], 6, axis=1)
        size[:, :3] = _BESIDE_M
        by_square = record.by_squared_shift(*where, least_T)
        by_pose = record.by_pose(directions, fields, gradients)
        by_turn = record.by_turned_carrier(errors, least_T)
        wrong = record.by_sensors(directions), record.by_bodies(*where, body_length_m, least_T)
        for group in groups:
            white = RecordWhitening.of(record, by_pose, by_turn, by_square, errors, drift, group)
            moved = size.ravel() * source_jacobian(record, directions, white, beside)
            columns = [layer.columns(record, directions, white), moved, *map(white, wrong)]
            yield cls(white, orthogonal(np.concatenate(columns, axis=1)))


def with_free_sources(record: SurveyRecord, background: SurveyBackground, sources: Sources) -> FloatArray:
    """Return ``Q`` of a background in which some sources are also free, to first order."""
    Q = background.Q
    if not len(sources):
        return Q
    J = jacobian_of(record, background, sources, sources.fields(record))
    J *= _UNKNOWN / np.linalg.norm(J, axis=0)
    # With J' = (1 - QQᵀ) J the information is JᵀJ', not J'ᵀJ', because the ground is Gaussian, not free.
    left = J - Q @ (Q.T @ J)
    return np.concatenate([Q, _root_of_projection(left, J.T @ left)], axis=1)


def orthogonal(L: FloatArray) -> FloatArray:
    """Return ``Q`` with ``Q Qᵀ = L (LᵀL + 1)⁻¹ Lᵀ``."""
    return _root_of_projection(L, L.T @ L)


def _root_of_projection(L: FloatArray, square: FloatArray) -> FloatArray:
    """Return ``Q`` with ``Q Qᵀ = L (A + 1)⁻¹ Lᵀ`` for a symmetric matrix ``A``."""
    factor = cho_factor(square + np.eye(L.shape[1]), lower=True)[0]
    return np.asarray(L @ solve_triangular(factor, np.eye(len(factor)), lower=True, check_finite=False).T)


@dataclass(frozen=True, eq=False)
class SourceBounds:
    """Limits of a source's position, above a flattened ground, and of its moment."""

    low_m: FloatArray
    high_m: FloatArray
    moment_Am2: float = 300.0
    terrain: Terrain = FLAT

    def contains(self, sources: Sources) -> BoolArray:
        """Return which sources (K,) are within."""
        position_m = self.terrain.flatten(sources.position_m)
        inside = np.all((position_m > self.low_m) & (position_m < self.high_m), axis=1)
        return np.asarray(inside & (np.linalg.norm(sources.moment_Am2, axis=1) < self.moment_Am2))

    def around(self, sources: Sources, reach_m: FloatArray) -> SourceBounds:
        """Return limits (K, 3) of sources that stay within a reach (K,)."""
        position_m = self.terrain.flatten(sources.position_m)
        return replace(
            self,
            low_m=np.maximum(self.low_m, position_m - reach_m[:, None]),
            high_m=np.minimum(self.high_m, position_m + reach_m[:, None]),
        )

    def clip(self, sources: Sources) -> Sources:
        """Return sources moved within the limits."""
        low_m, high_m = self.low_m, self.high_m
        xy_m = np.clip(sources.position_m[:, :2], low_m[..., :2], high_m[..., :2])
        position_m = self.terrain.flatten(np.column_stack([xy_m, sources.position_m[:, 2]]))
        return replace(sources, position_m=self.terrain.drape(np.clip(position_m, low_m, high_m)))


@dataclass(frozen=True, eq=False)
class JointFit:
    """Joint fit of sources with fixed noise.

    Attributes
    ----------
    record : SurveyRecord
    background : Background
    bounds : Bounds
        Limits of steps.
    sources : Sources
    """

    record: SurveyRecord
    background: SurveyBackground
    bounds: SourceBounds
    sources: Sources

    @cached_property
    def _fields(self) -> FloatArray:
        return self.sources.fields(self.record)

    @cached_property
    def residual(self) -> FloatArray:
        """White residual (g·k,) before the layer is projected out."""
        return residual_of(self.record, self.background, self._fields)

    @cached_property
    def _of_layer(self) -> FloatArray:
        return np.asarray(self.background.Q.T @ self.residual)

    @cached_property
    def cost(self) -> float:
        """χ² of the white residual, including the prior of the layer."""
        return float(self.residual @ self.residual - self._of_layer @ self._of_layer)

    @cached_property
    def _jacobian(self) -> tuple[FloatArray, FloatArray]:
        """White columns (g·k, 6 K) of the sources, and their projection on the layer's columns."""
        J = jacobian_of(self.record, self.background, self.sources, self._fields)
        return J, self.background.Q.T @ J

    @cached_property
    def information(self) -> FloatArray:
        """Information on positions and moments (6 K, 6 K), everything else eliminated."""
        if not len(self.sources):
            return np.zeros((0, 0))
        J, J_layer = self._jacobian
        return np.asarray(J.T @ J - J_layer.T @ J_layer)

    def step(self, damping: float) -> tuple[JointFit, float]:
        """Return the fit after a damped step within the bounds."""
        J, J_layer = self._jacobian
        gradient = J_layer.T @ self._of_layer - J.T @ self.residual
        step, promised = damped_step(self.information, gradient, damping)
        return replace(self, sources=self.bounds.clip(self.sources.apply_step(step.reshape(-1, 6)))), promised

    @property
    def covariance(self) -> FloatArray:
        """Covariance of positions and moments (6 K, 6 K)."""
        scale = 1.0 / np.sqrt(np.diagonal(self.information))
        scaled = scale[:, None] * self.information * scale
        return np.asarray(scale[:, None] * np.linalg.inv(scaled + _RIDGE * np.eye(len(scale))) * scale)

    @property
    def significance(self) -> FloatArray:
        """Increase of χ² without each source (K,), the others free to move."""
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


def residual_of(record: SurveyRecord, background: SurveyBackground, fields_T: FloatArray) -> FloatArray:
    """Return the white residual (g·k,) of the fields of sources."""
    return background.white((record.values_T - record.predict(fields_T))[..., None])[:, 0]


def jacobian_of(
    record: SurveyRecord, background: SurveyBackground, sources: Sources, fields_T: FloatArray
) -> FloatArray:
    """Return the white derivative (g·k, 6 K) by positions and moments, at given fields."""
    return source_jacobian(record, record.directions(fields_T), background.white, sources)


def source_jacobian(
    record: SurveyRecord, directions: FloatArray, white: RecordWhitening, sources: Sources
) -> FloatArray:
    """Return the white derivative (g·k, 6 K), given the directions of the channels.

    A direction is the derivative of a channel by the field at its sensor.
    """
    rows = white.measured_rows(record, directions)
    return white.of_groups(rows.source_columns(sources.position_m, sources.moment_Am2))


def fit_jointly(
    record: SurveyRecord,
    background: SurveyBackground,
    sources: Sources,
    bounds: SourceBounds,
    *,
    most: int = _MOST_STEPS,
    settled: float = _SETTLED,
    damping: float = _DAMPING,
) -> JointFit:
    """Fit sources by Levenberg-Marquardt, with fixed noise."""
    start = JointFit(record, background, bounds, sources)
    # A poor fit, with missing sources, needs less precision.
    least = lambda fit: settled * max(1.0, fit.cost / fit.residual.size)  # noqa: E731
    return minimise(start, least, damping=damping, max_iterations=most if len(sources) else 0).point
