"""Several dipoles at once, by any sensors: how many there are, where, and how well all of it is known.

One source is searched for, then another in what the first leaves, and so on; all sources are refined together and the
best three distinct fits go on. A source is only added where it lowers χ² by more than a threshold: the larger one of
the penalty of the Bayesian information criterion and of what noise alone reaches in one of a thousand sets of readings,
drawn for the array at hand. A plain χ² test would not do, because without a source its position has no meaning, and the
best of many positions is what is compared. While the best fit of the largest number of sources is not credible, random
sources are replaced by others; in the end every source is left out in turn, and stays out where it is not missed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import FloatArray, IntArray
from magloc.localization.fit.gauss_newton import JointFits, covariances, refine
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN, SILENT, JointFix, JointSolution, Source
from magloc.localization.search.beam_search import Beam, Search, best_distinct, merged
from magloc.localization.search.candidates import candidate_positions, linear_bases, linear_scores
from magloc.localization.uncertainty.covariance import fit_uncertainty
from magloc.localization.uncertainty.range_interval import is_detected, is_observable_set
from magloc.measurement.rows import NO_SIGNAL, checked_rows, rows_of_equal_mask, whitened_model, whitenings_of
from magloc.measurement.whitened import WhitenedModel

N_UNKNOWNS = 6
# A fit whose χ² is above this quantile is no optimum worth the name yet; above the lower one another source is tried.
_CREDIBLE = 0.9999
_SUSPICIOUS = 0.99
FALSE_ALARM = 1e-3
_N_DRAWS = 5_000
_MOST_RESTARTS = 20
_ROWS_AT_ONCE = 64
# Squares, in units of their covariance, of a moment that is hardly known and of an offset that hardly is one.
_FAINT = 40.0
_NEAR = 150.0
_MOST_BY_ITSELF = 5


def most_sources(n_differences: int) -> int:
    """Largest number of sources that leaves a degree of freedom."""
    return (n_differences - 1) // N_UNKNOWNS


class SeveralLocator:
    """Start-free fixes of several dipoles with any sensors.

    Parameters
    ----------
    array : SensorArray
    n_sources : int, optional
        Number of sources; by default it is chosen, up to five.
    knowledge : SourcePrior
        Bounds that hold for every source.
    seed : int
        Of random restarts and of the draws for the threshold.

    Raises
    ------
    ValueError
        The array has too few channels for that many sources.
    """

    def __init__(
        self,
        array: SensorArray,
        *,
        n_sources: int | None = None,
        knowledge: SourcePrior = NOTHING_KNOWN,
        seed: int = 0,
    ) -> None:
        whitening = whitenings_of(array, np.ones(array.n_channels, dtype=bool), np.zeros((1, array.n_channels)))[0]
        if whitening.n_differences < N_UNKNOWNS:
            raise ValueError(
                f"Input array must give {N_UNKNOWNS} independent differences at least for a position and a moment;"
                f" instead it gives {whitening.n_differences}."
            )
        # A single source may be exactly determined: no χ² to judge it by, but a solution.
        most = max(1, most_sources(whitening.n_differences))
        if n_sources is not None and not 1 <= n_sources <= most:
            allowed = "1" if most == 1 else f"between 1 and {most}"
            raise ValueError(
                f"Input n_sources must be {allowed}, as an array of {whitening.n_differences} independent differences"
                f" can tell no more, with {N_UNKNOWNS} unknowns a source; instead received {n_sources}."
            )
        self.array = array
        self.n_sources = n_sources
        self.most = n_sources or min(most, _MOST_BY_ITSELF)
        self.knowledge = knowledge
        self.seed = seed
        candidates = candidate_positions(array)
        self._thresholds: dict[int, float] = {}
        self._candidates = candidates[knowledge.allows_position(candidates)]
        if not len(self._candidates):
            raise ValueError(
                "Input knowledge must leave some of the space around the array; instead it leaves nothing."
            )

    def fit_rows(
        self,
        readings_T: ArrayLike,
        ambient_T: ArrayLike | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> list[JointFix]:
        """Fixes of many sets of readings, each on its own.

        Parameters
        ----------
        readings_T : array_like, shape (n, C)
            Raw readings in channel order [T]; NaN where missing.
        ambient_T : array_like, shape (n, 3), optional
            Ambient field of every row in the array's frame [T], in place of the array's own.
        progress : callable, optional
            Called with the number of rows finished since the last call.

        Returns
        -------
        list of JointFix
            In the order of the rows. Sources keep their place from row to row where they can be followed.
        """
        readings = checked_rows(self.array, readings_T)
        ambient = None if ambient_T is None else np.asarray(ambient_T, dtype=np.float64)
        fixes: list[JointFix] = [JointFix(())] * len(readings)
        for mask, rows in rows_of_equal_mask(np.isfinite(readings)):
            for start in range(0, rows.size, _ROWS_AT_ONCE):
                block = rows[start : start + _ROWS_AT_ONCE]
                found = self._fit_block(mask, readings[block], None if ambient is None else ambient[block])
                for row, fix in zip(block, found, strict=True):
                    fixes[row] = fix
                if progress is not None:
                    progress(block.size)
        return in_stable_order(fixes)

    def threshold_of(self, levels: _Levels, first: Beam) -> float:
        """The threshold for another source, drawn once for every number of differences."""
        if levels.n_differences not in self._thresholds:
            self._thresholds[levels.n_differences] = levels.threshold(first)
        return self._thresholds[levels.n_differences]

    def _fit_block(self, mask: NDArray[np.bool_], readings: FloatArray, ambient: FloatArray | None) -> list[JointFix]:
        whitenings = whitenings_of(self.array, mask, readings)
        n_differences = whitenings[0].n_differences
        fewest = N_UNKNOWNS * (self.n_sources or 1)
        if n_differences < fewest:
            reason = f"{int(mask.sum())} readings give {n_differences} independent differences, {fewest} are needed"
            return [JointFix((), reason, detected=False)] * len(readings)
        problem, raw = whitened_model(self.array, mask, readings, whitenings, ambient)
        y = problem.whitened(raw)
        loud = np.flatnonzero(np.sum(y * y, axis=1) >= SILENT * n_differences)
        fixes = [JointFix((), NO_SIGNAL, detected=False)] * len(readings)
        if not loud.size:
            return fixes
        found = _Levels(self, problem.rows(loud), y[loud], n_differences).fixes()
        for row, fix in zip(loud, found, strict=True):
            fixes[row] = fix
        return fixes


class _Levels:
    """The search over numbers of sources for one block of rows."""

    def __init__(self, locator: SeveralLocator, problem: WhitenedModel, y: FloatArray, n_differences: int) -> None:
        self.locator, self.problem, self.y, self.n_differences = locator, problem, y, n_differences
        self.asked = locator.n_sources
        self.most = min(locator.most, max(1, most_sources(n_differences)))
        self.rng = np.random.default_rng(locator.seed)
        knowledge = locator.knowledge

        def allowed(q: FloatArray, mu: FloatArray) -> NDArray[np.bool_]:
            with np.errstate(invalid="ignore"):
                kept: NDArray[np.bool_] = knowledge.allows_position(problem.position(q)) & knowledge.allows_moment(
                    problem.moment(q, mu)
                )
            return kept

        # A single source is listed with all its solutions, several ones with those of the beam.
        self.search = Search(problem.homogeneous(locator._candidates), allowed, width=8 if self.most == 1 else 3)

    def fixes(self) -> list[JointFix]:
        """The chosen number of sources of every row, and its solutions."""
        everything = np.arange(len(self.y))
        beams: list[Beam] = [self._first(everything)]
        level = np.zeros(len(self.y), dtype=np.intp)
        threshold = self.locator.threshold_of(self, beams[0]) if self.most > 1 else math.inf
        rows = everything
        while len(beams) < self.most:
            if self.asked is None:
                rows = rows[self._worth_another(rows, beams[-1].rows(rows), threshold)]
            if not rows.size:
                break
            before = beams[-1].rows(rows)
            wider = self.search.one_more(self.problem.rows(rows), self.y[rows], before)
            last = len(beams) + 1 == self.most
            gained = wider.chi2[:, 0] < before.chi2[:, 0] - threshold
            # Where no number of sources is credible so far, the search failed, at this number or at an earlier one.
            credible = self._quantile(wider.n_sources, _CREDIBLE)
            failed = np.flatnonzero(~(wider.chi2[:, 0] <= credible) & (last | ~gained))
            if failed.size:
                wider = wider.replaced(failed, self._restarted(rows[failed], wider.rows(failed)))
                gained = wider.chi2[:, 0] < before.chi2[:, 0] - threshold
            beams.append(_scattered(wider, rows, len(self.y)))
            rows = rows if self.asked is not None else rows[gained]
            level[rows] = len(beams) - 1
        wanted = level.copy()
        certain = np.zeros(len(self.y), dtype=bool)
        for n in range(len(beams) - 1, 0, -1):
            at = np.flatnonzero(level == n)
            if not at.size:
                continue
            fewer = merged(
                beams[n - 1].rows(at), self.search.one_less(self.problem.rows(at), self.y[at], beams[n].rows(at))
            )
            if n > 1:
                fewer = self._restarted(at, fewer, rounds=2)
            beams[n - 1] = beams[n - 1].replaced(at, fewer)
            superfluous = fewer.chi2[:, 0] <= beams[n].chi2[at, 0] + threshold
            unresolved = self._has_unresolved_pair(at, beams[n].rows(at))
            level[at[superfluous | unresolved]] = n - 1
            certain[at[unresolved & ~superfluous]] = True
        fixes = self._assembled(beams, level, wanted, certain)
        if self.asked is None and self.most > 1:
            nothing = np.sum((self.y - self.problem.predicted(np.zeros_like(self.problem.ambient))) ** 2, axis=1)
            # Against the chosen number: a single source may have no fit where several ones stand out.
            chosen = np.array([beams[n].chi2[row, 0] for row, n in enumerate(level)])
            for row in np.flatnonzero(np.isfinite(chosen) & (nothing - chosen <= threshold)):
                fixes[row] = JointFix(
                    (), "noise alone explains the readings: no source stands out of it", detected=False
                )
        return fixes

    def _first(self, rows: IntArray) -> Beam:
        beam = self.search.first(self.problem, self.y)
        doubtful = rows[beam.chi2[:, 0] > self._quantile(1, _CREDIBLE)]
        if doubtful.size and self.most == 1:
            wide = replace(self.search, n_starts=5 * self.search.n_starts, apart_rad=0.4 * self.search.apart_rad)
            again = wide.first(self.problem.rows(doubtful), self.y[doubtful])
            beam = beam.replaced(doubtful, merged(beam.rows(doubtful), again))
        return beam

    def _worth_another(self, rows: IntArray, beam: Beam, threshold: float) -> NDArray[np.bool_]:
        """Whether another source might pay: a suspicious χ², or a candidate that explains much of what is left."""
        suspicious = ~(beam.chi2[:, 0] <= self._quantile(beam.n_sources, _SUSPICIOUS))
        clean = np.flatnonzero(~suspicious)
        if clean.size:
            scores = self.search.left_scores(
                self.problem.rows(rows[clean]), self.y[rows[clean]], beam.q[clean, 0], beam.mu[clean, 0]
            )
            suspicious[clean] = scores.max(axis=1) > 0.5 * threshold
        return suspicious

    def _restarted(self, rows: IntArray, beam: Beam, rounds: int = _MOST_RESTARTS) -> Beam:
        """Beams of rows, with random sources replaced until the best fit is credible."""
        credible = self._quantile(beam.n_sources, _CREDIBLE)
        for _ in range(rounds):
            bad = np.flatnonzero(~(beam.chi2[:, 0] <= credible))
            if not bad.size:
                break
            again = self.search.restarted(self.problem.rows(rows[bad]), self.y[rows[bad]], beam.rows(bad), self.rng)
            beam = beam.replaced(bad, again)
        return beam

    def _quantile(self, n_sources: int, level: float) -> float:
        dof = self.n_differences - N_UNKNOWNS * n_sources
        return float(chdtri(dof, 1.0 - level)) if dof > 0 else 1e-6

    def threshold(self, beam: Beam) -> float:
        """By how much χ² must fall for another source: what noise reaches in one of a thousand rows, or BIC's penalty.

        Noise is drawn around the best fit of all rows; only the loudest draws, where a candidate explains most, are
        searched for a second source.
        """
        penalty = N_UNKNOWNS * math.log(self.n_differences)
        best = int(np.argmin(beam.chi2[:, 0]))
        if not np.isfinite(beam.chi2[best, 0]):
            return penalty
        rng = np.random.default_rng(0)
        row = np.full(_N_DRAWS, best)
        problem = self.problem.rows(row)
        at = self.problem.rows(row[:1])
        q, mu = beam.q[row[:1], 0], beam.mu[row[:1], 0]
        fields = at.source_fields(q, mu)
        noise = rng.normal(size=(_N_DRAWS, self.y.shape[1])) * np.any(at.gain[0] != 0.0, axis=-1)
        draws = at.predicted(fields) + problem.whitened(noise)
        bases = linear_bases(at, at.linear_gain(fields)[0], 0, self.search.candidates)
        loudness = np.concatenate([linear_scores(bases, part).max(axis=1) for part in np.array_split(noise, 20)])
        loud = np.argsort(-loudness)[: int(10 * FALSE_ALARM * _N_DRAWS)]
        search = replace(self.search, width=1)
        problem, draws = self.problem.rows(row[loud]), draws[loud]
        one = refine(problem, draws, q[np.zeros(loud.size, dtype=np.intp)], mu[np.zeros(loud.size, dtype=np.intp)])
        first = best_distinct(one, loud.size, 1)
        fall = first.chi2[:, 0] - search.one_more(problem, draws, first).chi2[:, 0]
        fall = np.sort(fall[np.isfinite(fall)])
        n_above = int(FALSE_ALARM * _N_DRAWS)
        return max(penalty, float(fall[-n_above - 1])) if fall.size > n_above else penalty

    def _has_unresolved_pair(self, rows: IntArray, beam: Beam) -> NDArray[np.bool_]:
        """Whether a source of the best fit is hardly known beside another one, so that other pairs would do as well.

        Its moment is not far from nothing, and its place not far from the other's, both by their own covariance. In
        such a fit χ² has curved valleys and several optima, and the covariance of one of them says far too little.
        """
        fits = JointFits(beam.q[:, 0], beam.mu[:, 0], beam.chi2[:, 0], beam.iterations[:, 0])
        problem = self.problem.rows(rows)
        covariance = covariances(problem, fits).reshape(len(rows), beam.n_sources, 6, beam.n_sources, 6)
        position, moment = problem.position(fits.q), problem.moment(fits.q, fits.mu)
        unresolved = np.asarray(~np.isfinite(covariance).all(axis=(1, 2, 3, 4)))
        for i in range(beam.n_sources):
            for j in range(beam.n_sources):
                if i == j:
                    continue
                of_moment = covariance[:, i, 3:, i, 3:]
                pair = [[covariance[:, a, :3, b, :3] for b in (i, j)] for a in (i, j)]
                of_offset = pair[0][0] - pair[0][1] - pair[1][0] + pair[1][1]
                faint = _squared_ratio(moment[:, i], of_moment) < _FAINT
                near = _squared_ratio(position[:, i] - position[:, j], of_offset) < _NEAR
                unresolved |= faint & near
        return unresolved

    def _assembled(
        self, beams: list[Beam], level: IntArray, wanted: IntArray, certain: NDArray[np.bool_]
    ) -> list[JointFix]:
        fixes: list[JointFix] = [JointFix(())] * len(level)
        for n, beam in enumerate(beams):
            rows = np.flatnonzero(level == n)
            if not rows.size:
                continue
            for row, fix in zip(rows, self._solutions(rows, beam.rows(rows)), strict=True):
                if wanted[row] > n and fix.solutions and (self.asked is not None or certain[row]):
                    fix = _marked_as_merged(fix, self.problem, beams[n + 1], int(row), self.asked, certain=certain[row])
                fixes[row] = fix
        return fixes

    def _solutions(self, rows: IntArray, beam: Beam) -> list[JointFix]:
        listed = beam.chi2 <= beam.chi2[:, :1] + DISTINCT_WITHIN
        listed &= np.isfinite(beam.chi2)
        of_row, of_fit = np.nonzero(listed)
        fits = JointFits(
            beam.q[of_row, of_fit], beam.mu[of_row, of_fit], beam.chi2[of_row, of_fit], beam.iterations[of_row, of_fit]
        )
        problem, y = self.problem.rows(rows[of_row]), self.y[rows[of_row]]
        position, moment = problem.position(fits.q), problem.moment(fits.q, fits.mu)
        covariance = covariances(problem, fits)
        nothing = self.y[rows] - self.problem.rows(rows).predicted(np.zeros_like(self.problem.ambient[rows]))
        energy = np.sum(nothing * nothing, axis=1)
        told = fit_uncertainty(problem, y, fits, covariance, of_row, energy, self.n_differences)
        dof = self.n_differences - N_UNKNOWNS * beam.n_sources
        solutions: list[list[JointSolution]] = [[] for _ in rows]
        for i in np.flatnonzero(np.isfinite(covariance).all(axis=(1, 2))):
            sources = tuple(
                Source(
                    position_m=position[i, k],
                    moment_Am2=moment[i, k],
                    covariance=told.covariance[i, 6 * k : 6 * k + 6, 6 * k : 6 * k + 6],
                    range_observable=is_observable_set(told.sets[i][k]),
                    range_interval95_m=told.sets[i][k],
                    gaussian=bool(told.gaussian[i, k]),
                )
                for k in range(beam.n_sources)
            )
            solutions[of_row[i]].append(
                JointSolution(
                    sources,
                    told.covariance[i],
                    float(fits.chi2[i]),
                    dof,
                    int(fits.iterations[i]),
                    weight=float(told.weight[i]),
                )
            )
        any_fit = np.isfinite(beam.chi2[:, 0])
        detected = is_detected(energy, self.n_differences).tolist()
        return [
            JointFix(tuple(found), "" if found else _why_unsolved(bool(any_fit[i])), detected=seen)
            for i, (found, seen) in enumerate(zip(solutions, detected, strict=True))
        ]


def _scattered(beam: Beam, rows: IntArray, n_rows: int) -> Beam:
    """A beam of some rows among all; the others have no fit."""
    width, n_sources = beam.chi2.shape[1], beam.n_sources
    empty = Beam(
        np.full((n_rows, width, n_sources, 4), np.nan),
        np.full((n_rows, width, n_sources, 3), np.nan),
        np.full((n_rows, width), np.inf),
        np.zeros((n_rows, width), dtype=np.int64),
    )
    return empty.replaced(rows, beam)


def _why_unsolved(found: bool) -> str:
    if found:
        return "the differences between the sensors do not determine the source: no signal, or a degenerate array"
    return "the search did not converge to a solution within the known region and largest moment"


def _squared_ratio(values: FloatArray, covariance: FloatArray) -> FloatArray:
    """Squares of vectors (b, 3) in units of their covariance (b, 3, 3); 0 where that is not known."""
    known = np.asarray(np.isfinite(covariance).all(axis=(1, 2)) & np.isfinite(values).all(axis=1))
    scale = np.sqrt(np.abs(np.diagonal(covariance, axis1=1, axis2=2)))
    safe = np.where(known[:, None], scale, 1.0)
    correlation = np.where(known[:, None, None], covariance / (safe[:, :, None] * safe[:, None]), np.eye(3))
    unit = np.where(known[:, None], values / safe, 0.0)
    ratio: FloatArray = np.sum(unit * (np.linalg.pinv(correlation) @ unit[..., None])[..., 0], axis=-1)
    return ratio


def _marked_as_merged(
    fix: JointFix, problem: WhitenedModel, more: Beam, row: int, asked: int | None, *, certain: bool
) -> JointFix:
    """A fix with fewer sources than asked for: the source that stands for the closest pair of the larger fit."""
    best = fix.solutions[0]
    n = len(best.sources)
    reason = f"the readings support {n} source{'s' if n > 1 else ''}"
    reason += "" if asked is None else f", {asked} were asked for"
    if not np.isfinite(more.chi2[row, 0]):
        return replace(fix, reason=reason)
    position = problem.position(more.q[row, 0])
    moment = problem.moment(more.q[row, 0], more.mu[row, 0])
    distance = np.linalg.norm(position[:, None] - position, axis=-1)
    np.fill_diagonal(distance, np.inf)
    i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
    together = moment[i] + moment[j]
    offsets = [np.linalg.norm(source.position_m - 0.5 * (position[i] + position[j])) for source in best.sources]
    nearest = int(np.argmin(offsets))
    stands_for_both = np.linalg.norm(together - best.sources[nearest].moment_Am2) < 0.5 * np.linalg.norm(together)
    if not certain and not (stands_for_both and offsets[nearest] < 2.0 * distance[i, j]):
        return replace(fix, reason=reason)
    sources = tuple(replace(source, merged=k == nearest) for k, source in enumerate(best.sources))
    solutions = (replace(best, sources=sources), *fix.solutions[1:])
    return replace(fix, solutions=solutions, reason=f"{reason}: two are closer than the array resolves")


def in_stable_order(fixes: Sequence[JointFix]) -> list[JointFix]:
    """Fixes of successive rows, their sources numbered as in the row before; at first the strongest comes first."""
    ordered: list[JointFix] = []
    before: FloatArray | None = None
    for fix in fixes:
        if not fix.solutions:
            ordered.append(fix)
            continue
        solutions = []
        for solution in fix.solutions:
            order = _order(solution, before)
            solutions.append(_reordered(solution, order))
        ordered.append(replace(fix, solutions=tuple(solutions)))
        before = np.stack([source.position_m for source in solutions[0].sources])
    return ordered


def _order(solution: JointSolution, before: FloatArray | None) -> list[int]:
    strengths = np.array([np.linalg.norm(source.moment_Am2) for source in solution.sources])
    if before is None:
        return [int(k) for k in np.argsort(-strengths, kind="stable")]
    position = np.stack([source.position_m for source in solution.sources])
    known, found = linear_sum_assignment(np.linalg.norm(before[:, None] - position, axis=-1))
    followed = [int(k) for _, k in sorted(zip(known.tolist(), found.tolist(), strict=True))]
    return followed + [int(k) for k in np.argsort(-strengths, kind="stable") if k not in followed]


def _reordered(solution: JointSolution, order: list[int]) -> JointSolution:
    index = np.concatenate([np.arange(6 * k, 6 * k + 6) for k in order])
    return replace(
        solution,
        sources=tuple(solution.sources[k] for k in order),
        covariance=solution.covariance[np.ix_(index, index)],
    )
