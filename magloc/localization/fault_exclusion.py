r"""Fixes that a bad sensor does not ruin.

A row whose χ² is not credible is fitted again with Student-t scores, which give the residual of a whole sensor,
:math:`\rho_s`, the weight :math:`(\nu + n_s)/(\nu + \rho_s)`, iterated from the plain fit and from the best fits
without one sensor each. These are refined from the plain fit, which a single sensor seldom moves to another optimum;
only where none of them explains the others are optima without some sensors searched for anew. The sensors that are then
far outside of what their noise allows are named, and the row is fitted anew without them; what is returned is a plain
least-squares fix, with the χ² and the covariance of the sensors that it uses.
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
from magloc.localization.fit.gauss_newton import JointFits, first_alike, refine
from magloc.localization.fit.results import Fix
from magloc.localization.model_errors import model_errors
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
# Fits of a row of which this is the difference, of the weights in themselves, end as one.
_SAME_PLACE, _SAME_WEIGHT = 0.01, 0.05
# Sensors of an array of which every two are left out in turn, and every one: of a larger one where a fit blames them.
_MOST_IN_PAIRS, _MOST_ONE_BY_ONE = 8, 16
# Fits without one sensor that are kept of a row.
_MOST_REFINED = 3
# Sensors of a larger array without which an optimum is searched for anew, of those that a fit blames.
_MOST_SEARCHED = 2
_LEAST_WEIGHT = 1e-16
# Share of a source's energy in one sensor above which no other sensor sees it.
_LONELY = 0.9
# Columns of the common field whose squares are smaller than this against the largest are none.
_UNSEEN = 1e-13
# Median of χ²/n of three degrees of freedom.
_MEDIAN_RATIO = 0.789
# Rows, and fits of them, whose numbers a processor's cache holds.
_ROWS_AT_ONCE, _FITS_AT_ONCE = 64, 64


Weighted = tuple[WhitenedModel, FloatArray]


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


def _is_credible(fix: Fix) -> bool:
    best = fix.solutions[0]
    return best.dof <= 0 or best.chi2 <= _largest_credible(best.dof, fix.body_length_m)


def _largest_credible(dof: int, body_length_m: float) -> float:
    """Largest χ² that is credible."""
    # The prior of a body's shape is a coarse one, and no fault of a sensor.
    return float(chdtri(dof, MISFIT if body_length_m > 0.0 else 1.0 - CREDIBLE_ROW))


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
    """A fit q (K, 4), mu (K, 3) to reweight from, the sensors that it was made without, and whether it is credible.

    A fit is not for lack of degrees of freedom.
    """

    q: FloatArray
    mu: FloatArray
    without: frozenset[int]
    explains: bool


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
        self.n_differences = of_rows.n_differences
        self.problem, self.raw = whitened_model(array, mask, readings, of_rows, ambient)
        self.count = np.bincount(array.channel_sensor[mask], minlength=array.n_sensors)
        level = 1.0 - SENSOR_FALSE_ALARM / array.n_sensors
        self.limits = np.array(chdtri(np.maximum(self.count, 1), 1.0 - level), dtype=np.float64)

    def allow_for_model_errors(self, plain: Sequence[Fix]) -> None:
        """Count as noise what bodies and the ambient field add to the fixes: no sensor is to be accused of it."""
        sigma_T = self.array.row_ambient_uncertainty_T if self.array.channel_is_scalar.any() else 0.0
        length_m = np.array([fix.body_length_m for fix in plain])
        errors = []
        for rows, q, mu in self._by_count([(row, fix) for row, fix in enumerate(plain) if length_m[row] or sigma_T]):
            lengths = np.tile(length_m[rows, None], q.shape[1])
            errors.append((rows, model_errors(self.problem.rows(rows), q, mu, lengths, sigma_T)))
        if errors:
            every = np.zeros((len(plain), self.raw.shape[1], max(columns.shape[2] for _, columns in errors)))
            for rows, columns in errors:
                every[rows, :, : columns.shape[2]] = columns
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
        starts = self._refined_without_one(plain, suspected)
        unexplained = [row for row in suspected.tolist() if not any(start.explains for start in starts[row])]
        for sensors, without in self._searched(plain, starts, unexplained).items():
            for row, fix in zip(without, self._without(sensors, np.array(without)), strict=True):
                starts[row] += self._start(fix, sensors)
        standing_out = self._standing_out(
            {row: [start for start in tried if start.explains] or tried for row, tried in starts.items()}
        )
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

    def _start(self, fix: Fix, without: frozenset[int]) -> list[_Start]:
        """The fit of a fix, if there is one."""
        if not fix.solutions:
            return []
        return [_Start(*self._scaled(fix), without, fix.solutions[0].dof > 0 and _is_credible(fix))]

    def _refined_without_one(self, plain: Sequence[Fix], rows: IntArray) -> dict[int, list[_Start]]:
        """The plain fits of rows, and the best of those without one sensor, refined from them, best first."""
        starts = {row: self._start(plain[row], frozenset()) for row in rows.tolist()}
        standing = np.flatnonzero(self.count)
        for row in rows.tolist():
            if not starts[row]:
                continue
            ((q, mu),) = [(start.q, start.mu) for start in starts[row]]
            n = standing.size
            weight = np.ones((n, self.array.n_sensors))
            weight[np.arange(n), standing] = _LEAST_WEIGHT
            of_row = np.full(n, row)
            lighter = weighted(self.problem.rows(of_row), self.raw[of_row], weight[:, self.array.channel_sensor])
            fits = self._refined(lighter, np.tile(q, (n, 1, 1)), np.tile(mu, (n, 1, 1)))
            dof = plain[row].solutions[0].dof - self.count[standing]
            for k in np.argsort(fits.chi2)[:_MOST_REFINED]:
                if np.isfinite(fits.chi2[k]):
                    credible = dof[k] > 0 and fits.chi2[k] <= _largest_credible(dof[k], plain[row].body_length_m)
                    starts[row].append(_Start(fits.q[k], fits.mu[k], frozenset({int(standing[k])}), bool(credible)))
        return starts

    def _searched(
        self, plain: Sequence[Fix], starts: dict[int, list[_Start]], unexplained: Sequence[int]
    ) -> dict[frozenset[int], list[int]]:
        """Rows in which to search anew, by the sensors that are left out: of a small array every one and every two.

        Of a large one those that the refinements blame most, and the nearest to every source.
        """
        standing = np.flatnonzero(self.count).tolist()
        every = [frozenset({sensor}) for sensor in standing] + [frozenset(pair) for pair in combinations(standing, 2)]
        chosen: dict[frozenset[int], list[int]] = {}
        for row in unexplained:
            sets = every
            if len(standing) > _MOST_IN_PAIRS:
                sets = every[: len(standing)] if len(standing) <= _MOST_ONE_BY_ONE else []
                sets += [start.without for start in starts[row][1 : 1 + _MOST_SEARCHED]]
                q, mu = self._fit_of(plain[row])
                distance = np.linalg.norm(self.array.positions[standing] - self.problem.position(q)[:, None], axis=-1)
                misfit = self._misfit(np.array([row]), q[None], mu[None], np.ones((1, self.array.n_sensors)))[0]
                blamed = {*np.argsort(-misfit)[:_MOST_SEARCHED].tolist()}
                blamed |= {standing[k] for k in np.argmin(distance, axis=1)} if plain[row].solutions else set()
                sets += [frozenset({sensor}) for sensor in blamed]
            for sensors in dict.fromkeys(sets):
                chosen.setdefault(sensors, []).append(row)
        return chosen

    def _fit_of(self, fix: Fix) -> tuple[FloatArray, FloatArray]:
        """Sources of a fix, or nothing far away where it has none."""
        return self._scaled(fix) if fix.solutions else (np.array([[0.0, 0.0, 1.0, 1e-3]]), np.zeros((1, 3)))

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
        return self._squares(weighted(self.problem.rows(row), self.raw[row], weight[:, owner]), q, mu, weight)

    def _squares(self, lighter: Weighted, q: FloatArray, mu: FloatArray, weight: FloatArray) -> FloatArray:
        """Squared residuals (f, N) of the sensors of some weighted rows."""
        owner, (problem, raw) = self.array.channel_sensor, lighter
        residual = problem.whitened(raw) - problem.predicted(problem.source_fields(q, mu))
        of_sensor = owner[:, None] == np.arange(self.array.n_sensors)
        squares: FloatArray = (residual**2 / weight[:, owner]) @ of_sensor
        return squares

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
        for count in sorted({len(start.q) for _, start in every}):
            index = [i for i, (_, start) in enumerate(every) if len(start.q) == count]
            row = np.array([every[i][0] for i in index], dtype=np.intp)
            q, mu = np.stack([every[i][1].q for i in index]), np.stack([every[i][1].mu for i in index])
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
        owner, q, mu, weight = self.array.channel_sensor, q.copy(), mu.copy(), weight.copy()
        misfit, scale2 = np.empty(weight.shape), np.empty(len(row))
        live = twin = np.arange(len(row))
        for n in range(_N_REWEIGHTINGS + 1):
            for some in np.array_split(live, -(-live.size // _FITS_AT_ONCE)):
                lighter = weighted(self.problem.rows(row[some]), self.raw[row[some]], weight[some][:, owner])
                if n:
                    fits = self._refined(lighter, q[some], mu[some], max_iterations=8)
                    q[some], mu[some] = fits.q, fits.mu
                misfit[some] = self._squares(lighter, q[some], mu[some], weight[some])
            scale2[live] = self._scale2(misfit[live])
            new = (DEGREES_OF_FREEDOM + self.count) / (DEGREES_OF_FREEDOM + misfit[live] / scale2[live, None])
            new = np.clip(new, _LEAST_WEIGHT, None)
            moved = np.any(np.abs(new - weight[live]) >= 1e-3 * weight[live], axis=1)
            live = live[moved]
            weight[live] = new[moved]
            twin = np.minimum(twin, first_alike(row, q, weight, _SAME_PLACE, _SAME_WEIGHT))
            live = live[twin[live] == live]
            if not live.size:
                break
        while not np.array_equal(twin[twin], twin):
            twin = twin[twin]
        return misfit[twin], scale2[twin]

    def _refined(self, lighter: Weighted, q: FloatArray, mu: FloatArray, max_iterations: int = 60) -> JointFits:
        """Fits of weighted rows (f,) from sources (f, K, …)."""
        problem, raw = lighter
        free = np.full((q.shape[1], 3), self.free_position)
        return refine(problem, problem.whitened(raw), q, mu, free=free, max_iterations=max_iterations)


def weighted(problem: WhitenedModel, raw: FloatArray, weight: FloatArray) -> Weighted:
    """A problem and its raw readings (b, C) with the variance of every channel divided by a weight (b, C)."""
    root = np.sqrt(weight)[..., None]
    flat = problem.shrinkage >= 1.0
    # A flat prior needs only the span of its columns; of the others the variance along each of them counts.
    some, known = flat.any(axis=0), ~flat.all(axis=0)
    span = root * (problem.basis * flat[:, None])[..., some]
    for _ in range(2):  # once more, for the digits that squares lose
        square, axes = np.linalg.eigh(span.transpose(0, 2, 1) @ span)
        seen = square > _UNSEEN * square[:, -1:]
        span = span @ (axes * np.where(seen, 1.0 / np.sqrt(np.where(seen, square, 1.0)), 0.0)[:, None])
    lighter = replace(problem, gain=root * problem.gain, basis=span, shrinkage=seen.astype(np.float64))
    if not flat.all():
        with np.errstate(divide="ignore"):
            deviation = np.where(flat, 0.0, np.sqrt(1.0 / (1.0 - problem.shrinkage) ** 2 - 1.0))
        lighter = lighter.marginalised(root * (problem.basis * deviation[:, None])[..., known])
    return lighter, root[..., 0] * raw
