r"""Fixes that a bad sensor does not ruin.

A row whose χ² is not credible is fitted again with Student-t scores, which give the residual of a whole sensor,
:math:`\rho_s`, the weight :math:`(\nu + n_s)/(\nu + \rho_s)`, iterated from the plain fit and from the fits without
one sensor each. The sensors that are then far outside of what their noise allows are named, and the row is fitted anew
without them; what is returned is a plain least-squares fix, with the χ² and the covariance of the sensors that it uses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Protocol

import numpy as np
from scipy.special import chdtri, fdtri

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.chi_square import energy_threshold
from magloc.levels import CREDIBLE_ROW, MISFIT, SENSOR_FALSE_ALARM
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.gauss_newton import refine
from magloc.localization.fit.model_errors import model_errors
from magloc.localization.fit.results import Fix
from magloc.localization.search.multi_source import NOISE_ALONE
from magloc.measurement.rows import (
    NO_SIGNAL,
    rows_of_equal_mask,
    whitened_model,
    whitenings_of,
)
from magloc.measurement.whitened import WhitenedModel

DEGREES_OF_FREEDOM = 4.0
# Above this χ² per degree of freedom a bad sensor may have bent the fit so much that it does not stand out.
_SPOILT = 4.0
# Above this variance, in units of what is stated, the noise is taken to be larger than stated.
_UNDERSTATED = 2.0
# Squared residuals, in limits, above which a larger one says nothing more.
_BEYOND_DOUBT = 10.0
# A fix that explains the other sensors badly must be better by this factor in χ² per degree of freedom.
_INCOMPARABLE = 1000.0
_N_REWEIGHTINGS = 30
_MOST_LEFT_OUT = 8
_LEAST_WEIGHT = 1e-16
# Share of a source's energy in one sensor above which no other sensor sees it.
_LONELY = 0.9
# Columns of the common field that are smaller than this against the largest are none.
_UNSEEN = 1e-13
# Median of χ²/n of three degrees of freedom.
_MEDIAN_RATIO = 0.789
_ROWS_AT_ONCE = 64


class Refit(Protocol):
    """Fixes some rows anew."""

    def __call__(self, rows: IntArray, readings_T: FloatArray, /) -> Sequence[Fix]:
        """Fixes of rows of these indices with other readings (n, C), NaN where missing."""


def without_faulty_sensors(
    array: SensorArray,
    fixes: Fixes,
    refit: Refit,
    readings_T: FloatArray,
    ambient_T: FloatArray | None = None,
    *,
    free_position: bool = True,
) -> Fixes:
    """Fixes without the sensors that contradict all others, which `dropped_sensors` names.

    No sensor is dropped from a row whose χ² is credible, nor where too few would be left to tell which of them is
    wrong.
    """
    doubtful = _doubtful(fixes)
    examined, found = [], []
    for mask, rows in rows_of_equal_mask(np.isfinite(readings_T)):
        of_mask = rows[doubtful[rows]]
        for start in range(0, of_mask.size, _ROWS_AT_ONCE):
            block = of_mask[start : start + _ROWS_AT_ONCE]
            ambient = None if ambient_T is None else ambient_T[block]
            examination = _Examination(array, refit, mask, block, readings_T[block], ambient, free_position)
            plain = [fixes[row] for row in block]
            examination.allow_for_model_errors(plain)
            found += examination.fixes(examination.without_lonely_sources(plain) if free_position else plain)
            examined.append(block)
    if not examined:
        return fixes
    return fixes.replaced(np.concatenate(examined), found)


def _doubtful(fixes: Fixes) -> BoolArray:
    """Rows (n,) to be looked at: those whose χ² is not credible, that have several sources, or no solution."""
    result = ~fixes.solved & np.array([reason != NO_SIGNAL for reason in fixes.reason], dtype=bool)
    solutions, first = fixes.solutions, fixes.first[fixes.solved]
    dof = solutions.dof[first]
    incredible = (dof > 0) & (solutions.chi2[first] > chdtri(np.maximum(dof, 1), 1.0 - CREDIBLE_ROW))
    result[fixes.solved] = incredible | (solutions.n_sources[first] > 1)
    return result


def _explains(fix: Fix) -> bool:
    """Whether a fix is credible and might have been incredible."""
    return bool(fix.solutions) and fix.solutions[0].dof > 0 and _is_credible(fix)


def _is_credible(fix: Fix) -> bool:
    best = fix.solutions[0]
    # The prior of a body's shape is a coarse one, and no fault of a sensor.
    level = MISFIT if fix.body_length_m > 0.0 else 1.0 - CREDIBLE_ROW
    return best.dof <= 0 or bool(best.chi2 <= chdtri(best.dof, level))


def _is_worth_dropping_for(fix: Fix, plain: Fix) -> bool:
    """Whether a fix without some sensors explains all others, or all but incomparably better than with them.

    Where it does not, it is the model, or what is known of the source, that is wrong.
    """
    if not fix.solutions or fix.solutions[0].dof <= 0:
        return False
    per_degree = fix.solutions[0].chi2 / fix.solutions[0].dof
    if not plain.solutions:
        return _is_credible(fix)
    before = plain.solutions[0].chi2 / max(1, plain.solutions[0].dof)
    return per_degree <= _SPOILT or per_degree * _INCOMPARABLE < before


@dataclass(frozen=True, eq=False)
class _Start:
    """A fix to reweight from, and the sensors that it was made without."""

    fix: Fix
    without: frozenset[int]


class _Examination:
    """Rows that miss the same channels and have a doubtful fix."""

    def __init__(
        self,
        array: SensorArray,
        refit: Refit,
        mask: BoolArray,
        rows: IntArray,
        readings: FloatArray,
        ambient: FloatArray | None,
        free_position: bool,
    ) -> None:
        self.array, self.readings, self.ambient = array, readings, ambient
        self.refit, self.of_all = refit, rows
        self.free_position = free_position
        of_rows = whitenings_of(array, mask, readings)
        self.n_differences = of_rows[0].n_differences
        self.problem, self.raw = whitened_model(array, mask, readings, of_rows, ambient)
        self.count = np.bincount(array.channel_sensor[mask], minlength=array.n_sensors)
        level = 1.0 - SENSOR_FALSE_ALARM / array.n_sensors
        self.limits = np.array(chdtri(np.maximum(self.count, 1), 1.0 - level), dtype=np.float64)

    def allow_for_model_errors(self, plain: Sequence[Fix]) -> None:
        """Count as noise what bodies and the ambient field add to the fixes: no sensor is to be accused of it."""
        errors = []
        sigma_T = self.array.row_ambient_uncertainty_T if self.array.channel_is_scalar.any() else 0.0
        for row, fix in enumerate(plain):
            if fix.solutions and (fix.body_length_m > 0.0 or sigma_T):
                q, mu = self._scaled(fix)
                lengths = np.full((1, len(q)), fix.body_length_m)
                at = self.problem.rows(np.array([row]))
                errors.append((row, model_errors(at, q[None], mu[None], lengths, sigma_T)[0]))
        if errors:
            widest = max(columns.shape[1] for _, columns in errors)
            every = np.zeros((len(plain), self.raw.shape[1], widest))
            for row, columns in errors:
                every[row, :, : columns.shape[1]] = columns
            self.problem = self.problem.marginalised(every)

    def without_lonely_sources(self, plain: Sequence[Fix]) -> list[Fix]:
        """Fixes without sources that a single sensor sees: nothing tells such a source from a fault of the sensor."""
        found = list(plain)
        for row, fix in enumerate(plain):
            if not fix.solutions or len(self._scaled(fix)[0]) < 2:
                continue
            sensors = self._seers_of_lonely_sources(row, fix)
            if not sensors:
                continue
            (other,) = self._without(sensors, np.array([row]))
            if other.solutions and _is_credible(other) and len(self._scaled(other)[0]) < len(self._scaled(fix)[0]):
                found[row] = replace(other, dropped_sensors=tuple(self.array.ids[sensor] for sensor in sorted(sensors)))
        return found

    def _seers_of_lonely_sources(self, row: int, fix: Fix) -> frozenset[int]:
        q, mu = self._scaled(fix)
        problem = self.problem.rows(np.full(len(q), row))
        seen = problem.predicted(problem.source_fields(q[:, None], mu[:, None]))
        seen -= problem.predicted(np.zeros_like(problem.ambient))
        energy = np.stack([np.bincount(self.array.channel_sensor, of**2, self.array.n_sensors) for of in seen])
        lonely = energy.max(axis=1) > _LONELY * energy.sum(axis=1)
        return frozenset(np.argmax(energy[lonely], axis=1).tolist())

    def fixes(self, plain: Sequence[Fix]) -> list[Fix]:
        """The plain fix, or that without the sensors that stand out."""
        found = list(plain)
        suspected = self._suspected(plain)
        if not suspected.size:
            return found
        starts = {int(row): [_Start(plain[row], frozenset[int]())] for row in suspected}
        for sensor, rows in self._left_out(plain, suspected):
            self._start_without(starts, frozenset({sensor}), rows)
        unexplained = [row for row, tried in starts.items() if not any(_explains(start.fix) for start in tried)]
        for sensors in self._all_left_out():
            rows = np.array([r for r in unexplained if all(start.without != sensors for start in starts[r])], np.intp)
            if rows.size:
                self._start_without(starts, sensors, rows)
        standing_out = self._standing_out(starts)
        for dropped in set(standing_out.values()) - {frozenset()}:
            rows = np.array([row for row, sensors in standing_out.items() if sensors == dropped], dtype=np.intp)
            names = tuple(self.array.ids[sensor] for sensor in sorted(dropped))
            for row, fix in zip(rows, self._without(dropped, rows), strict=True):
                if _is_worth_dropping_for(fix, plain[row]):
                    found[row] = replace(fix, dropped_sensors=names)
        return found

    def _suspected(self, plain: Sequence[Fix]) -> IntArray:
        """Rows where a sensor may stand out: it does so from the plain fix, or nothing fits and the fit is spoilt."""
        solved = np.array([bool(fix.solutions) for fix in plain])
        credible = np.array([bool(fix.solutions) and _is_credible(fix) for fix in plain])
        # What a fit of so many unknowns leaves of a sensor's residual on average.
        unknowns = np.array([3.0 + 6.0 * (len(self._scaled(fix)[0]) if fix.solutions else 1) for fix in plain])
        unseen = np.clip(1.0 - unknowns / max(1, self.count.sum()), 0.2, 1.0)
        spoilt = ~solved
        spoilt[solved] = [fix.solutions[0].chi2 > _SPOILT * fix.solutions[0].dof for fix in plain if fix.solutions]
        judged = np.flatnonzero(~spoilt & ~credible).tolist()
        for of_count, q, mu in self._by_count([(row, plain[row]) for row in judged]):
            misfit = self._misfit(of_count, q, mu, np.ones((len(of_count), self.array.n_sensors)))
            spoilt[of_count] = np.any(
                misfit > unseen[of_count, None] * self.limits * self._scale2(misfit)[:, None], axis=1
            )
        return np.flatnonzero(spoilt & ~credible & ~self._as_noise(plain))

    def _as_noise(self, plain: Sequence[Fix]) -> BoolArray:
        """Rows without a source whose energy is one of noise: there is nothing that a bad sensor would explain."""
        without = self.problem.whitened(self.raw) - self.problem.predicted(np.zeros_like(self.problem.ambient))
        energy = np.einsum("bc,bc->b", without, without)
        alone = np.array([fix.reason == NOISE_ALONE for fix in plain], dtype=bool)
        return alone & (energy <= energy_threshold(max(1, self.n_differences)))

    def _by_count(self, fixes: Sequence[tuple[int, Fix]]) -> Iterator[tuple[IntArray, FloatArray, FloatArray]]:
        """Rows, and best solutions (f, K, …), of fixes of equally many sources."""
        scaled = [(row, *self._scaled(fix)) for row, fix in fixes if fix.solutions]
        for count in sorted({len(q) for _, q, _ in scaled}):
            alike = [(row, q, mu) for row, q, mu in scaled if len(q) == count]
            rows, q, mu = zip(*alike, strict=True)
            yield np.array(rows, dtype=np.intp), np.stack(q), np.stack(mu)

    def _left_out(self, plain: Sequence[Fix], rows: IntArray) -> list[tuple[int, IntArray]]:
        """Sensors to leave out in turn, and in which rows: those that fit worst, and the nearest to the source."""
        standing = np.flatnonzero(self.count)
        if standing.size <= _MOST_LEFT_OUT:
            return [(int(sensor), rows) for sensor in standing]
        chosen: dict[int, list[int]] = {}
        for row in rows.tolist():
            near: list[int] = []
            if plain[row].solutions:
                q, mu = self._scaled(plain[row])
                position = self.problem.position(q)
                nearest = np.argmin(np.linalg.norm(self.array.positions[standing] - position[:, None], axis=-1), axis=1)
                near = standing[nearest].tolist()
            else:
                q, mu = np.array([[0.0, 0.0, 1.0, 1e-3]]), np.zeros((1, 3))
            misfit = self._misfit(np.array([row]), q[None], mu[None], np.ones((1, self.array.n_sensors)))[0]
            worst = np.argsort(-misfit)[: _MOST_LEFT_OUT - 1]
            for sensor in {*worst.tolist(), *near}:
                chosen.setdefault(int(sensor), []).append(row)
        return [(sensor, np.array(of_sensor, dtype=np.intp)) for sensor, of_sensor in sorted(chosen.items())]

    def _all_left_out(self) -> list[frozenset[int]]:
        """What to leave out where nothing has helped: every sensor, and of a small array every two."""
        standing = np.flatnonzero(self.count).tolist()
        singles = [frozenset({sensor}) for sensor in standing]
        if len(standing) > _MOST_LEFT_OUT:
            return singles
        return singles + [frozenset(pair) for pair in combinations(standing, 2)]

    def _start_without(self, starts: dict[int, list[_Start]], sensors: frozenset[int], rows: IntArray) -> None:
        for row, fix in zip(rows.tolist(), self._without(sensors, rows), strict=True):
            starts[row].append(_Start(fix, sensors))

    def _without(self, sensors: set[int] | frozenset[int], rows: IntArray) -> list[Fix]:
        readings = self.readings[rows].copy()
        readings[:, np.isin(self.array.channel_sensor, list(sensors))] = np.nan
        return list(self.refit(self.of_all[rows], readings))

    def _scaled(self, fix: Fix) -> tuple[FloatArray, FloatArray]:
        sources = fix.solutions[0].sources
        q = self.problem.homogeneous(np.stack([source.position_m for source in sources]))
        return q, self.problem.scaled_moment(q, np.stack([source.moment_Am2 for source in sources]))

    def _misfit(self, row: IntArray, q: FloatArray, mu: FloatArray, weight: FloatArray) -> FloatArray:
        """Squared residuals (f, N) of the sensors of some rows, the common field being that of the weighted fit."""
        owner = self.array.channel_sensor
        problem, raw = weighted(self.problem.rows(row), self.raw[row], weight[:, owner])
        residual = problem.whitened(raw) - problem.predicted(problem.source_fields(q, mu))
        squares = residual**2 / weight[:, owner]
        return np.stack([np.bincount(owner, of_row, self.array.n_sensors) for of_row in squares])

    def _scale2(self, misfit: FloatArray) -> FloatArray:
        """Variance of the noise (f,) in units of what is stated, one at least, from the median sensor.

        Where everything fits badly it is the model or the stated noise that is wrong, not a sensor.
        """
        standing = self.count > 0
        ratio = np.median(misfit[:, standing] / self.count[standing], axis=1) / _MEDIAN_RATIO
        return np.maximum(1.0, ratio)

    def _standing_out(self, starts: dict[int, list[_Start]]) -> dict[int, frozenset[int]]:
        """Sensors of every row that stand out from the best of its robust fits."""
        best = dict.fromkeys(starts, np.inf)
        found = dict.fromkeys(starts, frozenset[int]())
        every = [(row, start) for row, of_row in starts.items() for start in of_row]
        for index, q, mu in self._by_count([(i, start.fix) for i, (_, start) in enumerate(every)]):
            row = np.array([every[i][0] for i in index], dtype=np.intp)
            weight = np.ones((len(row), self.array.n_sensors))
            for f, i in enumerate(index):
                weight[f, list(every[i][1].without)] = _LEAST_WEIGHT
            misfit, scale2 = self._reweighted(row, q, mu, weight)
            # Beyond doubt is beyond doubt: two sensors that are far off must not cost less than one that is farther.
            bounded = np.minimum(misfit / scale2[:, None], _BEYOND_DOUBT * self.limits)
            score = 0.5 * np.sum(
                (DEGREES_OF_FREEDOM + self.count) * np.log1p(bounded / DEGREES_OF_FREEDOM), axis=1
            ) + 0.5 * self.count.sum() * np.log(scale2)
            for f, r in enumerate(row.tolist()):
                if score[f] < best[r]:
                    best[r] = score[f]
                    out = np.flatnonzero(misfit[f] > self._limits_of(float(scale2[f]), q.shape[1]) * scale2[f])
                    few = 2 * out.size < np.count_nonzero(self.count)
                    found[r] = frozenset(out.tolist()) if few else frozenset()
        return found

    def _limits_of(self, scale2: float, n_sources: int) -> FloatArray:
        """Limits (N,) of the squared residuals over the variance of the noise; wider where that is a guess."""
        if scale2 < _UNDERSTATED:
            return self.limits
        count = np.maximum(self.count, 1)
        # A median is about as good as the mean of half as many.
        spare = 0.5 * max(2.0, self.count.sum() - 6.0 * n_sources - 6.0)
        quantile: FloatArray = fdtri(count, spare, 1.0 - SENSOR_FALSE_ALARM / self.array.n_sensors)
        return np.array(count * quantile, dtype=np.float64)

    def _reweighted(
        self, row: IntArray, q: FloatArray, mu: FloatArray, weight: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Squared residuals (f, N) of the sensors after reweighting from starts, and the scale of the noise."""
        problem, raw = self.problem.rows(row), self.raw[row]
        owner = self.array.channel_sensor
        free = np.full((q.shape[1], 3), self.free_position)
        for _ in range(_N_REWEIGHTINGS):
            misfit = self._misfit(row, q, mu, weight)
            scale2 = self._scale2(misfit)
            new = (DEGREES_OF_FREEDOM + self.count) / (DEGREES_OF_FREEDOM + misfit / scale2[:, None])
            new = np.clip(new, _LEAST_WEIGHT, None)
            if np.all(np.abs(new - weight) < 1e-3 * weight):
                break
            weight = new
            lighter, lighter_raw = weighted(problem, raw, weight[:, owner])
            fits = refine(lighter, lighter.whitened(lighter_raw), q, mu, free=free, max_iterations=8)
            q, mu = fits.q, fits.mu
        return misfit, scale2


def weighted(problem: WhitenedModel, raw: FloatArray, weight: FloatArray) -> tuple[WhitenedModel, FloatArray]:
    """A problem and its raw readings (b, C) with the variance of every channel divided by a weight (b, C)."""
    root = np.sqrt(weight)[..., None]
    flat = problem.shrinkage >= 1.0
    # A flat prior needs only the span of its columns; of the others the variance along each of them counts.
    span, size, _ = np.linalg.svd(root * problem.basis * flat[:, None], full_matrices=False)
    seen = size > _UNSEEN * size[:, :1]
    lighter = replace(problem, gain=root * problem.gain, basis=span, shrinkage=seen.astype(np.float64))
    if not flat.all():
        with np.errstate(divide="ignore"):
            deviation = np.where(flat, 0.0, np.sqrt(1.0 / (1.0 - problem.shrinkage) ** 2 - 1.0))
        lighter = lighter.marginalised(root * problem.basis * deviation[:, None])
    return lighter, root[..., 0] * raw
