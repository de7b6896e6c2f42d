r"""Exclusion of faulty sensors from fixes.

A row whose χ² is not credible is fitted again with Student-t scores (:mod:`magloc.localization.reweighting`). The
iteration starts from the plain fit and from the best fits without one sensor each. These are refined from the plain
fit, because a single sensor seldom moves it to another optimum; a first-order estimate selects the promising ones
(:mod:`magloc.localization.leave_one_out`). If none of them explains the other sensors, a new search without some
sensors follows. Sensors whose residuals are then far beyond their noise are named, and the row is fitted again without
them. The result is a plain least-squares fix, with the χ² and the covariance of the remaining sensors.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Protocol

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.chi_square import energy_threshold, exceeds, quantile
from magloc.levels import CREDIBLE_ROW, MISFIT, SENSOR_FALSE_ALARM
from magloc.localization.fit.fixes import Fixes
from magloc.localization.fit.gauss_newton import JointFits
from magloc.localization.fit.results import Fix
from magloc.localization.model_errors import model_errors
from magloc.localization.reweighting import DEGREES_OF_FREEDOM, LEAST_WEIGHT, WeightedFits
from magloc.localization.search.multi_source import NOISE_ALONE
from magloc.measurement.magnet import magnet_of, model_near
from magloc.measurement.rows import NO_SIGNAL, rows_of_equal_mask, whitened_model, whitenings_of
from magloc.measurement.whitened import WhitenedModel

# χ² per degree of freedom above which a faulty sensor may have biased the fit, so that its residual is small.
_SPOILT = 4.0
# Upper limit of squared residuals, in units of their limits: a larger one is no stronger evidence.
_BEYOND_DOUBT = 10.0
# Factor in χ² per degree of freedom by which a fix must be better if it explains the other sensors badly.
_INCOMPARABLE = 1000.0
# Largest arrays in which each single sensor, and each pair, is excluded in turn; in larger arrays only suspects.
_MOST_IN_PAIRS, _MOST_ONE_BY_ONE = 8, 16
# Number of fits without one sensor that are refined, lowest expected χ² first, and number that are kept for a row.
_MOST_REFINED, _MOST_KEPT = 6, 3
# Largest number of gross faults that are excluded one after another.
_MOST_GROSS = 3
# Share of the largest decrease of χ² below which the decreases without other sensors are negligible.
_MATTERS = 0.05
# Share of a sensor's readings, along any direction, that the other sensors check. Below the first value a fit without
# the sensor is always refined. A faulty sensor that attracts the source has less than the second value.
_HALF_CHECKED, _LEAST_CHECKED = 0.5, 0.1
# Number of suspect sensors of a larger array that are excluded from a new search, one at a time.
_MOST_SEARCHED = 2
# Share of a source's energy in one sensor above which no other sensor sees it.
_LONELY = 0.9
_ROWS_AT_ONCE = 64  # fits in the processor's cache


class Refit(Protocol):
    """Protocol of a function that fits some rows again."""

    def __call__(self, rows: IntArray, readings_T: FloatArray, /) -> Sequence[Fix]:
        """Return the fixes of these rows with other readings (n, C), NaN where missing."""


def exclude_faulty_sensors(
    array: SensorArray,
    fixes: Fixes,
    refit: Refit,
    readings_T: FloatArray,
    ambient_T: FloatArray | None = None,
    *,
    free_position: bool = True,
) -> Fixes:
    """Return fixes without sensors that contradict all others, named in `dropped_sensors`.

    No sensor is dropped from a row whose χ² is credible, or if too few sensors would remain to identify the faulty one.
    """
    doubtful = _is_doubtful(fixes)
    examined, found = [], []
    for mask, rows in rows_of_equal_mask(np.isfinite(readings_T)):
        of_mask = rows[doubtful[rows]]
        for start in range(0, of_mask.size, _ROWS_AT_ONCE):
            block = of_mask[start : start + _ROWS_AT_ONCE]
            ambient = None if ambient_T is None else ambient_T[block]
            examination = _Examination(array, refit, mask, block, readings_T[block], ambient, free_position)
            plain = [fixes[row] for row in block]
            examination.allow_for_model_errors(plain)
            found += examination.fixes(examination.drop_lonely_sources(plain) if free_position else plain)
            examined.append(block)
    if not examined:
        return fixes
    return fixes.replaced(np.concatenate(examined), found)


def _is_doubtful(fixes: Fixes) -> BoolArray:
    """Return doubtful rows (n,): χ² not credible, several sources, or no solution."""
    result = ~fixes.solved
    for row in np.flatnonzero(result).tolist():
        result[row] = fixes.reason[row] != NO_SIGNAL
    solutions, first = fixes.solutions, fixes.first[fixes.solved]
    incredible = exceeds(solutions.chi2[first], solutions.dof[first], 1.0 - CREDIBLE_ROW)
    result[fixes.solved] = incredible | (solutions.n_sources[first] > 1)
    return result


def _is_credible(fix: Fix) -> bool:
    best = fix.solutions[0]
    return best.chi2 <= _largest_credible(best.dof, fix.body_length_m)


def _largest_credible(dof: int, body_length_m: float) -> float:
    """Return the largest credible χ²."""
    # The prior of a body's shape is coarse, so a body needs a lower level.
    return quantile(dof, MISFIT if body_length_m > 0.0 else 1.0 - CREDIBLE_ROW)


def _is_worth_dropping_for(fix: Fix, plain: Fix) -> bool:
    """Return whether a fix without some sensors explains the others, or fits far better.

    Otherwise the model, or the prior of the source, is wrong.
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
    """Start of a reweighting: fit q (K, 4), mu (K, 3), excluded sensors, and whether it is credible.

    A fit without degrees of freedom is not credible.
    """

    q: FloatArray
    mu: FloatArray
    without: frozenset[int]
    explains: bool


_StartOfRow = tuple[int, _Start]


class _Examination:
    """Examination of rows that miss the same channels and have a doubtful fix."""

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
        of_rows = whitenings_of(array, mask, readings)
        self.n_differences = of_rows.n_differences
        problem, self.raw = whitened_model(array, mask, readings, of_rows, ambient)
        problem = model_near(array, problem)
        self.count = np.bincount(array.channel_sensor[mask], minlength=array.n_sensors)
        level = 1.0 - SENSOR_FALSE_ALARM / array.n_sensors
        self.limits = np.array(chdtri(np.maximum(self.count, 1), 1.0 - level), dtype=np.float64)
        channels = array.sensor_channels
        self.fits = WeightedFits(problem, self.raw, channels, self.count, self.limits, free_position)
        # With few sensors each is so informative that first-order tests do not decide.
        self.many = np.count_nonzero(self.count) > _MOST_ONE_BY_ONE

    @property
    def problem(self) -> WhitenedModel:
        """Model of the rows, with model errors counted as noise."""
        return self.fits.problem

    def allow_for_model_errors(self, plain: Sequence[Fix]) -> None:
        """Count errors of bodies and the ambient field as noise, so that no sensor is dropped for them."""
        sigma_T = self.array.row_ambient_uncertainty_T if self.array.channel_is_scalar.any() else 0.0
        length_m = np.array([fix.body_length_m for fix in plain])
        errors = []
        always = sigma_T or magnet_of(self.array)
        counted = [(row, fix) for row, fix in enumerate(plain) if length_m[row] or always]
        for _, rows, q, mu, _ in self._stack(self._starts(counted)):
            lengths = np.tile(length_m[rows, None], q.shape[1])
            errors.append((rows, model_errors(self.problem.rows(rows), q, mu, lengths, sigma_T)))
        if errors:
            every = np.zeros((len(plain), self.raw.shape[1], max(columns.shape[2] for _, columns in errors)))
            for rows, columns in errors:
                every[rows, :, : columns.shape[2]] = columns
            self.fits = replace(self.fits, problem=self.problem.marginalise(every))

    def drop_lonely_sources(self, plain: Sequence[Fix]) -> list[Fix]:
        """Drop sources that only one sensor sees, because they look like a fault of that sensor."""
        found = list(plain)
        for row, fix in enumerate(plain):
            if not fix.solutions or len(self._scale(fix)[0]) < 2:
                continue
            sensors = self._sensors_of_lonely_sources(row, fix)
            if not sensors:
                continue
            (other,) = self._refit_without(sensors, np.array([row]))
            if other.solutions and _is_credible(other) and len(self._scale(other)[0]) < len(self._scale(fix)[0]):
                found[row] = replace(other, dropped_sensors=tuple(self.array.ids[sensor] for sensor in sorted(sensors)))
        return found

    def _sensors_of_lonely_sources(self, row: int, fix: Fix) -> frozenset[int]:
        q, mu = self._scale(fix)
        problem = self.problem.rows(np.full(len(q), row))
        seen = problem.predict(problem.source_fields(q[:, None], mu[:, None]))
        seen -= problem.predict(np.zeros_like(problem.ambient))
        energy = np.stack([np.bincount(self.array.channel_sensor, of**2, self.array.n_sensors) for of in seen])
        lonely = energy.max(axis=1) > _LONELY * energy.sum(axis=1)
        return frozenset(np.argmax(energy[lonely], axis=1).tolist())

    def fixes(self, plain: Sequence[Fix]) -> list[Fix]:
        """Return the plain fixes, or those without the outlying sensors."""
        found = list(plain)
        suspected = self._suspect_rows(plain)
        if not suspected.size:
            return found
        starts = self._refine_without_one(plain, suspected)
        unexplained = [row for row, tried in starts.items() if not any(start.explains for start in tried)]
        if self.many:
            best = [(row, starts[row][1]) for row in unexplained if len(starts[row]) > 1]
            for row, start in self._exclude_gross_faults(plain, best):
                starts[row].append(start)
        for searched in self._plan_searches(plain, starts, unexplained):
            for sensors, of_set in searched.items():
                unsolved = [row for row in of_set if not (self.many and any(start.explains for start in starts[row]))]
                fixes = self._refit_without(sensors, np.array(unsolved, dtype=np.intp))
                anew = self._starts(zip(unsolved, fixes, strict=True), sensors)
                for row, start in anew + (self._exclude_gross_faults(plain, anew) if self.many else []):
                    starts[row].append(start)
        starts = {row: [start for start in tried if start.explains] or tried for row, tried in starts.items()}
        certain = self._certain_faults(starts)
        standing_out = certain | self._outlying_sensors({row: starts[row] for row in starts.keys() - certain.keys()})
        for dropped in set(standing_out.values()) - {frozenset()}:
            rows = np.array([row for row, sensors in standing_out.items() if sensors == dropped], dtype=np.intp)
            names = tuple(self.array.ids[sensor] for sensor in sorted(dropped))
            for row, fix in zip(rows, self._refit_without(dropped, rows), strict=True):
                if _is_worth_dropping_for(fix, plain[row]):
                    found[row] = replace(fix, dropped_sensors=names)
        return found

    def _suspect_rows(self, plain: Sequence[Fix]) -> IntArray:
        """Return rows with an outlier in the plain fix, or with a fit too poor to show one."""
        solved = np.array([bool(fix.solutions) for fix in plain])
        credible = np.array([bool(fix.solutions) and _is_credible(fix) for fix in plain])
        # Mean share of a sensor's residual that remains after a fit of so many unknowns.
        unknowns = np.array([3.0 + 6.0 * (len(self._scale(fix)[0]) if fix.solutions else 1) for fix in plain])
        unseen = np.clip(1.0 - unknowns / max(1, self.count.sum()), 0.2, 1.0)
        spoilt = ~solved
        spoilt[solved] = [fix.solutions[0].chi2 > _SPOILT * fix.solutions[0].dof for fix in plain if fix.solutions]
        judged = np.flatnonzero(~spoilt & ~credible).tolist()
        for _, of_count, q, mu, weight in self._stack(self._starts([(row, plain[row]) for row in judged])):
            misfit = self.fits.misfit(of_count, q, mu, weight)
            spoilt[of_count] = np.any(
                misfit > unseen[of_count, None] * self.limits * self.fits.scale2(misfit)[:, None], axis=1
            )
        return np.flatnonzero(spoilt & ~credible & ~self._is_noise(plain))

    def _is_noise(self, plain: Sequence[Fix]) -> BoolArray:
        """Return the rows (n,) without a source and without more energy than noise."""
        without = self.problem.whiten(self.raw) - self.problem.predict(np.zeros_like(self.problem.ambient))
        energy = np.einsum("bc,bc->b", without, without)
        alone = np.array([fix.reason == NOISE_ALONE for fix in plain], dtype=bool)
        return alone & (energy <= energy_threshold(max(1, self.n_differences)))

    def _starts(self, fixes: Iterable[tuple[int, Fix]], without: frozenset[int] = frozenset()) -> list[_StartOfRow]:
        """Return the fits of those fixes that have a solution."""
        solved = [(row, fix) for row, fix in fixes if fix.solutions]
        explains = [fix.solutions[0].dof > 0 and _is_credible(fix) for _, fix in solved]
        return [
            (row, _Start(*self._scale(fix), without, good)) for (row, fix), good in zip(solved, explains, strict=True)
        ]

    def _refine_without_one(self, plain: Sequence[Fix], rows: IntArray) -> dict[int, list[_Start]]:
        """Return the plain fits and the best fits without one sensor, best first.

        A row is skipped if no sensor is an outlier and each sensor is checked by the others.
        """
        every = self._starts([(row, plain[row]) for row in rows.tolist()])
        starts: dict[int, list[_Start]] = {row: [] for row in rows.tolist()} | {row: [start] for row, start in every}
        for _, of_count, q, mu, _ in self._stack(every):
            chosen = self._exclusion_candidates(of_count, q, mu)
            of_fit, sensor = np.nonzero(chosen)
            for row in of_count[~chosen.any(axis=1)].tolist():
                del starts[row]
            if not of_fit.size:
                continue
            of_row, weight = of_count[of_fit], self.fits.weights_without(sensor[:, None].tolist())
            fits = self.fits.refine(of_row, q[of_fit], mu[of_fit], weight)
            kept = dict.fromkeys(of_count.tolist(), _MOST_KEPT)
            for k in np.argsort(fits.chi2, kind="stable").tolist():
                row = int(of_row[k])
                start = self._start_of_fit(plain[row], fits, k, frozenset({int(sensor[k])}))
                if kept[row] and start is not None:
                    kept[row] -= 1
                    starts[row].append(start)
        return starts

    def _exclude_gross_faults(self, plain: Sequence[Fix], tried: Sequence[_StartOfRow]) -> list[_StartOfRow]:
        """Return fits that explain rows without two or three sensors, each beyond doubt.

        From a fit without one sensor, the next sensor to exclude is the one that lowers χ² most.
        """
        found = []
        left = [(row, start) for row, start in tried if plain[row].solutions and not start.explains]
        while left:
            starts, left = left, []
            for some, rows, q, mu, weight in self._stack(starts):
                fall, _ = self.fits.chi2_falls(rows, q, mu, weight)
                fall[weight < 1.0] = 0.0
                each, worst = np.arange(len(rows)), np.argmax(fall, axis=1)
                gross = np.flatnonzero(fall[each, worst] > _BEYOND_DOUBT * self._limits(fall, q)[each, worst])
                if not gross.size:
                    continue
                weight[each, worst] = LEAST_WEIGHT
                fits = self.fits.refine(rows[gross], q[gross], mu[gross], weight[gross])
                for k, i in enumerate(gross.tolist()):
                    row, last = some[i]
                    start = self._start_of_fit(plain[row], fits, k, last.without | {int(worst[i])})
                    if start is not None and start.explains:
                        found.append((row, start))
                    elif start is not None and len(start.without) < _MOST_GROSS:
                        left.append((row, start))
        return found

    def _limits(self, misfit: FloatArray, q: FloatArray) -> FloatArray:
        """Return limits (f, N) of squared residuals, scaled by the noise of fits q (f, K, 4)."""
        scale2 = self.fits.scale2(misfit)
        return np.array([scale * self.fits.square_limits(float(scale), q.shape[1]) for scale in scale2])

    def _stack(
        self, starts: Sequence[_StartOfRow]
    ) -> Iterator[tuple[list[_StartOfRow], IntArray, FloatArray, FloatArray, FloatArray]]:
        """Yield starts with equally many sources: rows, sources (f, K, …), weights (f, N)."""
        for count in sorted({len(start.q) for _, start in starts}):
            some = [(row, start) for row, start in starts if len(start.q) == count]
            q, mu = np.stack([start.q for _, start in some]), np.stack([start.mu for _, start in some])
            rows = np.array([row for row, _ in some], dtype=np.intp)
            yield some, rows, q, mu, self.fits.weights_without([start.without for _, start in some])

    def _start_of_fit(self, plain: Fix, fits: JointFits, k: int, without: frozenset[int]) -> _Start | None:
        """Return fit k without some sensors as a start; None if it did not converge."""
        if not fits.converged[k]:
            return None
        dof = plain.solutions[0].dof - int(self.count[list(without)].sum())
        dof += 6 * (len(plain.solutions[0].sources) - fits.n_sources)
        credible = dof > 0 and fits.chi2[k] <= _largest_credible(dof, plain.body_length_m)
        return _Start(fits.q[k], fits.mu[k], without, bool(credible))

    def _exclusion_candidates(self, rows: IntArray, q: FloatArray, mu: FloatArray) -> BoolArray:
        """Return sensors (f, N) that are outliers, or that may bias the fits unnoticed.

        None is returned if many sensors have similar residuals, so that the noise is larger than stated.
        """
        fall, checked = self.fits.chi2_falls(rows, q, mu)
        fall = np.where(self.count, fall, 0.0)
        last = np.partition(fall, -_MOST_REFINED, axis=1)[:, -_MOST_REFINED:] if fall.shape[1] > _MOST_REFINED else fall
        least = np.maximum(last.min(axis=1), _MATTERS * fall.max(axis=1) * self.many)
        chosen: BoolArray = ((fall >= least[:, None]) | (checked < _HALF_CHECKED)) & (self.count > 0)
        if self.many:
            chosen &= np.any((fall > self._limits(fall, q)) | (checked < _LEAST_CHECKED), axis=1)[:, None]
        return chosen

    def _plan_searches(
        self, plain: Sequence[Fix], starts: dict[int, list[_Start]], unexplained: Sequence[int]
    ) -> list[dict[frozenset[int], list[int]]]:
        """Return the rows to search again for each set of sensors to exclude, one set after another.

        In a small array these are all single sensors and all pairs. In a large one they are the sensors nearest to each
        source and the strongest suspects of the refinements.
        """
        standing = np.flatnonzero(self.count).tolist()
        every = [frozenset({sensor}) for sensor in standing] if len(standing) <= _MOST_ONE_BY_ONE else []
        if len(standing) <= _MOST_IN_PAIRS:
            every += [frozenset(pair) for pair in combinations(standing, 2)]
        chosen: list[dict[frozenset[int], list[int]]] = []
        for row in unexplained:
            sets = every.copy()
            if len(standing) > _MOST_IN_PAIRS:
                q, mu = self._scale_or_none(plain[row])
                distance = np.linalg.norm(self.array.positions[standing] - self.problem.position(q)[:, None], axis=-1)
                misfit = self.fits.misfit(np.array([row]), q[None], mu[None], np.ones((1, self.array.n_sensors)))[0]
                near = [standing[k] for k in np.argmin(distance, axis=1)] if plain[row].solutions else []
                sets += [frozenset({sensor}) for sensor in near]
                sets += [start.without for start in starts[row][1:] if len(start.without) == 1][:_MOST_SEARCHED]
                sets += [frozenset({sensor}) for sensor in np.argsort(-misfit)[:_MOST_SEARCHED].tolist()]
            for k, sensors in enumerate(dict.fromkeys(sets)):
                turn = k if self.many else 0
                if turn == len(chosen):
                    chosen.append({})
                chosen[turn].setdefault(sensors, []).append(row)
        return chosen

    def _scale_or_none(self, fix: Fix) -> tuple[FloatArray, FloatArray]:
        """Return the sources of a fix, or a zero source far away if it has none."""
        return self._scale(fix) if fix.solutions else (np.array([[0.0, 0.0, 1.0, 1e-3]]), np.zeros((1, 3)))

    def _refit_without(self, sensors: set[int] | frozenset[int], rows: IntArray) -> list[Fix]:
        if not rows.size:
            return []
        readings = self.readings[rows].copy()
        readings[:, np.isin(self.array.channel_sensor, list(sensors))] = np.nan
        return list(self.refit(self.of_all[rows], readings))

    def _scale(self, fix: Fix) -> tuple[FloatArray, FloatArray]:
        sources = fix.solutions[0].sources
        q = self.problem.homogeneous(np.stack([source.position_m for source in sources]))
        return q, self.problem.scaled_moment(q, np.stack([source.moment_Am2 for source in sources]))

    def _certain_faults(self, starts: dict[int, list[_Start]]) -> dict[int, frozenset[int]]:
        """Return sensors that are certainly faulty: the only credible fit excludes them.

        In that fit they are clear outliers, and no other sensor would be an outlier even if excluded.
        """
        only = [(row, tried[0]) for row, tried in starts.items() if len(tried) == 1 and tried[0].explains]
        found: dict[int, frozenset[int]] = {}
        for some, rows, q, mu, weight in self._stack([of for of in only if of[1].without] if self.many else []):
            fall, _ = self.fits.chi2_falls(rows, q, mu, weight)
            beyond = fall / weight > _BEYOND_DOUBT * self.limits
            certain = np.all(np.where(weight < 1.0, beyond, fall <= self.limits), axis=1)
            found |= {row: start.without for (row, start), of_row in zip(some, certain, strict=True) if of_row}
        return found

    def _outlying_sensors(self, starts: dict[int, list[_Start]]) -> dict[int, frozenset[int]]:
        """Return the outlying sensors of every row in the best of its robust fits."""
        best = dict.fromkeys(starts, np.inf)
        found = dict.fromkeys(starts, frozenset[int]())
        every = [(row, start) for row, of_row in starts.items() for start in of_row]
        for _, rows, q, mu, weight in self._stack(every):
            misfit, scale2 = self.fits.reweight(rows, q, mu, weight)
            # Residuals are limited, so that one sensor very far off does not cost more than two far off.
            bounded = np.minimum(misfit / scale2[:, None], _BEYOND_DOUBT * self.limits)
            score = 0.5 * np.sum(
                (DEGREES_OF_FREEDOM + self.count) * np.log1p(bounded / DEGREES_OF_FREEDOM), axis=1
            ) + 0.5 * self.count.sum() * np.log(scale2)
            for f, r in enumerate(rows.tolist()):
                if score[f] < best[r]:
                    best[r] = score[f]
                    out = np.flatnonzero(misfit[f] > self.fits.square_limits(float(scale2[f]), q.shape[1]) * scale2[f])
                    few = 2 * out.size < np.count_nonzero(self.count)
                    found[r] = frozenset(out.tolist()) if few else frozenset()
        return found
