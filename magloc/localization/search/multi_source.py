"""Search for several dipoles by any sensors: their number and positions.

The search finds one source, then another in the residuals of the first, and so on. All sources are refined together,
and the best three distinct fits are continued. A source is added only if it lowers χ² by more than a threshold. The
threshold is the larger one of two values: the penalty of the Bayesian information criterion, and the decrease that
noise alone reaches in one of a thousand rows, simulated for the array. A plain χ² test would be wrong, because the best
of many positions is compared, and without a source its position has no meaning. While the best fit with the largest
number of sources is not credible, random sources are replaced by others. At the end each source is removed in turn,
and is dropped if the fit is as good without it.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import chdtri

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.chi_square import energy_threshold, normalised_square
from magloc.levels import CREDIBLE_FIT, FALSE_ALARM, SUSPICIOUS_FIT
from magloc.localization.fit.gauss_newton import JointFits, covariances, refine
from magloc.localization.fit.optima import Optima
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.fit.results import DISTINCT_WITHIN
from magloc.localization.search.beam_search import BeamSearch, best_distinct, merge
from magloc.localization.search.candidates import LastBases, allowed_positions, fine_positions, linear_scores
from magloc.measurement.rows import WhitenedRows, check_magnitudes, whitenings_of

N_UNKNOWNS = 6
_N_DRAWS = 5_000
_MOST_RESTARTS = 20
# Decrease of χ² that noise never reaches: with six degrees of freedom once in 10¹¹ places; an array has less than 10⁶.
_BEYOND_NOISE = 60.0
# If the removal of a source costs so many times that, restarts find no fit without it.
_FAR_BEYOND = 10.0
# Normalised squares of a moment and of an offset below which they are hardly significant.
_FAINT = 40.0
_NEAR = 150.0
_MOST_BY_ITSELF = 5
_NOT_CONVERGED = "the search did not converge to a solution within the known region and largest moment"
NOISE_ALONE = "noise alone explains the readings: no source is significant"


def most_sources(n_differences: int) -> int:
    """Return the largest number of sources that leaves a degree of freedom."""
    return (n_differences - 1) // N_UNKNOWNS


class MultiSourceSearch:
    """Search for several sources, by any sensors, without a start.

    Parameters
    ----------
    n_sources : int, optional
        Number of sources; by default it is chosen, up to five.
    prior : SourcePrior
        Bounds that hold for every source.
    seed : int
        Seed of random restarts and of the draws for the threshold.

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
        prior: SourcePrior = NOTHING_KNOWN,
        seed: int = 0,
    ) -> None:
        check_magnitudes(array)
        whitening = whitenings_of(array, np.ones(array.n_channels, dtype=bool), np.zeros(array.n_channels))
        if whitening.n_differences < N_UNKNOWNS:
            raise ValueError(
                f"Input array must give at least {N_UNKNOWNS} independent differences for a position and a moment;"
                f" instead it gives {whitening.n_differences}."
            )
        # A single source may be exactly determined: a solution without a degree of freedom.
        most = max(1, most_sources(whitening.n_differences))
        if n_sources is not None and not 1 <= n_sources <= most:
            allowed = "1" if most == 1 else f"between 1 and {most}"
            raise ValueError(
                f"Input n_sources must be {allowed}: {whitening.n_differences} independent differences determine no"
                f" more, with {N_UNKNOWNS} unknowns per source; instead received {n_sources}."
            )
        self.array = array
        self.n_sources = n_sources
        self.most = n_sources or min(most, _MOST_BY_ITSELF)
        self.prior = prior
        self.seed = seed
        self._thresholds: dict[int, float] = {}
        self.bases = LastBases()
        self._candidates = allowed_positions(array, prior, fine_positions(array))

    def optima(self, rows: WhitenedRows) -> list[Optima]:
        """Return distinct optima, one entry for every chosen number of sources."""
        return _Levels(self, rows.with_known_moment(self.prior.known_moment)).optima()

    def threshold_of(self, levels: _Levels) -> float:
        """Return the threshold for another source, cached by the number of differences."""
        if levels.n_differences not in self._thresholds:
            self._thresholds[levels.n_differences] = levels.threshold()
        return self._thresholds[levels.n_differences]


class _Levels:
    """Search over the number of sources for one block of rows."""

    def __init__(self, locator: MultiSourceSearch, rows: WhitenedRows) -> None:
        self.locator, self.rows, self.n_differences = locator, rows, rows.n_differences
        self.problem, self.y = rows.model, rows.y
        self.asked = locator.n_sources
        self.most = min(locator.most, max(1, most_sources(self.n_differences)))
        self.rng = np.random.default_rng(locator.seed)
        self.penalty = N_UNKNOWNS * math.log(self.n_differences)

        # A single source has all its solutions in the result, several sources have those of the beam.
        self.search = BeamSearch(
            rows.model.homogeneous(locator._candidates),
            partial(locator.prior.allows, rows.model),
            width=8 if self.most == 1 else 3,
            within=DISTINCT_WITHIN if self.most == 1 and locator.prior == NOTHING_KNOWN else math.inf,
            bases=locator.bases,
        )

    def optima(self) -> list[Optima]:
        """Return optima with the chosen number of sources, one entry for every number."""
        everything = np.arange(len(self.y))
        self.one = self._first(everything)
        beams: list[JointFits] = [self.one]
        level = np.zeros(len(self.y), dtype=np.intp)
        weak = self._is_weak()
        rows = everything[~weak]
        while len(beams) < self.most:
            if self.asked is None:
                rows = rows[self._may_have_another(rows, beams[-1].rows(rows))]
            if not rows.size:
                break
            before = beams[-1].rows(rows)
            last = len(beams) + 1 == self.most
            credible = self._quantile(len(beams) + 1, CREDIBLE_FIT)
            ends = last and self.locator.prior == NOTHING_KNOWN
            wider = self.search.add_source(
                self.problem.rows(rows), self.y[rows], before, credible=credible if ends else 0.0
            )
            gained = self._stands_out(before.chi2[:, 0], wider.chi2[:, 0])
            # No number of sources is credible so far: the search failed at this number or an earlier one.
            failed = np.flatnonzero(~(wider.chi2[:, 0] <= credible) & (last | ~gained))
            if failed.size:
                wider = wider.replace(failed, self._restart(rows[failed], wider.rows(failed)))
                gained = self._stands_out(before.chi2[:, 0], wider.chi2[:, 0])
            # The other rows have no fit.
            nowhere = JointFits.none((len(self.y), wider.chi2.shape[1]), wider.n_sources)
            beams.append(nowhere.replace(rows, wider))
            rows = rows if self.asked is not None else rows[gained]
            level[rows] = len(beams) - 1
        wanted = level.copy()
        certain = np.zeros(len(self.y), dtype=bool)
        for n in range(len(beams) - 1, 0, -1):
            at = np.flatnonzero(level == n)
            if not at.size:
                continue
            fewer = merge(
                beams[n - 1].rows(at), self.search.remove_source(self.problem.rows(at), self.y[at], beams[n].rows(at))
            )
            close = np.flatnonzero(fewer.chi2[:, 0] < beams[n].chi2[at, 0] + _FAR_BEYOND * _BEYOND_NOISE)
            if n > 1 and close.size:
                fewer = fewer.replace(close, self._restart(at[close], fewer.rows(close), rounds=2))
            beams[n - 1] = beams[n - 1].replace(at, fewer)
            superfluous = ~self._stands_out(fewer.chi2[:, 0], beams[n].chi2[at, 0])
            unresolved = self._has_unresolved_pair(at, beams[n].rows(at))
            level[at[superfluous | unresolved]] = n - 1
            certain[at[unresolved & ~superfluous]] = True
        alone = np.zeros(len(self.y), dtype=bool)
        if self.asked is None and self.most > 1:
            # Compare with the chosen number: a single source may have no fit if several are significant.
            chosen = np.array([beams[n].chi2[row, 0] for row, n in enumerate(level)])
            alone = weak | (np.isfinite(chosen) & ~self._stands_out(self.rows.energy, chosen))
        return [
            self._list_optima(
                n,
                np.flatnonzero(level == n),
                beams,
                (wanted > n) & ((self.asked is not None) | certain),
                certain,
                alone,
            )
            for n in range(len(beams))
            if (level == n).any()
        ]

    def _first(self, rows: IntArray) -> JointFits:
        beam = self.search.first_sources(self.problem, self.y)
        doubtful = rows[beam.chi2[:, 0] > self._quantile(1, CREDIBLE_FIT)]
        if doubtful.size and self.most == 1:
            wide = replace(self.search, n_starts=5 * self.search.n_starts, apart_rad=0.4 * self.search.apart_rad)
            again = wide.first_sources(self.problem.rows(doubtful), self.y[doubtful])
            beam = beam.replace(doubtful, merge(beam.rows(doubtful), again))
        return beam

    def _stands_out(self, before: FloatArray, after: FloatArray) -> BoolArray:
        """Return whether χ² falls by more than the threshold for another source.

        The threshold is drawn only if some falls are near to it.
        """
        with np.errstate(invalid="ignore"):
            fall = before - after
            found: BoolArray = fall > max(self.penalty, _BEYOND_NOISE)
            near = ~found & (fall > self.penalty)
        if near.any():
            found[near] = fall[near] > self.locator.threshold_of(self)
        return found

    def _is_weak(self) -> BoolArray:
        """Return which rows need no search for more sources, because only noise remains."""
        if self.asked is not None or self.most == 1:
            return np.zeros(len(self.y), dtype=bool)
        energy = self.rows.energy
        faint = np.flatnonzero(energy <= energy_threshold(self.n_differences))
        weak = np.zeros(len(self.y), dtype=bool)
        weak[faint] = ~self._stands_out(energy[faint], self.one.chi2[faint, 0])
        return weak

    def _may_have_another(self, rows: IntArray, beam: JointFits) -> BoolArray:
        """Return in which rows another source is worth a search.

        There χ² is suspicious, or a candidate explains much of the residual.
        """
        suspicious = ~(beam.chi2[:, 0] <= self._quantile(beam.n_sources, SUSPICIOUS_FIT))
        clean = np.flatnonzero(~suspicious)
        if clean.size:
            scores = self.search.residual_scores(
                self.problem.rows(rows[clean]), self.y[rows[clean]], beam.q[clean, 0], beam.mu[clean, 0]
            )
            suspicious[clean] = scores.max(axis=1) > 0.5 * self.penalty
        return suspicious

    def _restart(self, rows: IntArray, beam: JointFits, rounds: int = _MOST_RESTARTS) -> JointFits:
        """Return beams with random sources replaced until the best fit is credible."""
        credible = self._quantile(beam.n_sources, CREDIBLE_FIT)
        for _ in range(rounds):
            bad = np.flatnonzero(~(beam.chi2[:, 0] <= credible))
            if not bad.size:
                break
            again = self.search.restart(self.problem.rows(rows[bad]), self.y[rows[bad]], beam.rows(bad), self.rng)
            beam = beam.replace(bad, again)
        return beam

    def _quantile(self, n_sources: int, level: float) -> float:
        dof = self.n_differences - N_UNKNOWNS * n_sources
        return float(chdtri(dof, 1.0 - level)) if dof > 0 else 1e-6

    def threshold(self) -> float:
        """Return the decrease of χ² that another source needs.

        It is the larger one of BIC's penalty and of the decrease that noise reaches in one of a thousand rows. Noise is
        drawn around the best fit of all rows. Only the draws with the highest scores of candidates are searched for a
        second source. These are many more than exceed the threshold, because the grid of candidates is coarse.
        """
        beam = self.one
        best = int(np.argmin(beam.chi2[:, 0]))
        if not np.isfinite(beam.chi2[best, 0]):
            return self.penalty
        rng = np.random.default_rng(0)
        row = np.full(_N_DRAWS, best)
        problem = self.problem.rows(row)
        at = self.problem.rows(row[:1])
        q, mu = beam.q[row[:1], 0], beam.mu[row[:1], 0]
        fields = at.source_fields(q, mu)
        noise = rng.normal(size=(_N_DRAWS, self.y.shape[1])) * np.any(at.gain[0] != 0.0, axis=-1)
        draws = at.predict(fields) + problem.whiten(noise)
        bases = self.search.bases_of(at, at.linear_gain(fields)[0], 0)
        loudness = np.concatenate([linear_scores(bases, part).max(axis=1) for part in np.array_split(noise, 20)])
        loud = np.argsort(-loudness)[: int(40 * FALSE_ALARM * _N_DRAWS)]
        search = replace(self.search, width=1)
        problem, draws = self.problem.rows(row[loud]), draws[loud]
        one = refine(problem, draws, q[np.zeros(loud.size, dtype=np.intp)], mu[np.zeros(loud.size, dtype=np.intp)])
        first = best_distinct(one, loud.size, 1)
        with np.errstate(invalid="ignore"):  # neither may have converged
            fall = first.chi2[:, 0] - search.add_source(problem, draws, first).chi2[:, 0]
        fall = np.sort(fall[np.isfinite(fall)])
        # A new draw exceeds the k-th largest of n with probability k / (n + 1).
        k = int(FALSE_ALARM * (_N_DRAWS + 1))
        return max(self.penalty, float(fall[-k])) if fall.size >= k else self.penalty

    def _has_unresolved_pair(self, rows: IntArray, beam: JointFits) -> BoolArray:
        """Return whether the best fit has a pair of sources that cannot be resolved.

        One source of the pair has a moment near zero and a position near the other one, both in terms of their own
        covariance. In such a fit χ² has curved valleys and several optima, and the covariance of one of them is far too
        small.
        """
        fits = beam.rows((slice(None), 0))
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
                faint = ~(normalised_square(moment[:, i], of_moment) >= _FAINT)  # NaN counts as faint too
                near = ~(normalised_square(position[:, i] - position[:, j], of_offset) >= _NEAR)
                unresolved |= faint & near
        return unresolved

    def _list_optima(
        self,
        n: int,
        rows: IntArray,
        beams: list[JointFits],
        fewer: BoolArray,
        certain: BoolArray,
        noise_alone: BoolArray,
    ) -> Optima:
        """Return the optima of the rows with n + 1 sources.

        `fewer` is True if that is less than the requested or the visible number of sources.
        """
        beam = beams[n].rows(rows)
        listed = np.isfinite(beam.chi2) & (beam.chi2 <= beam.chi2[:, :1] + DISTINCT_WITHIN)
        listed[noise_alone[rows]] = False
        of_row, of_fit = np.nonzero(listed)
        fits = beam.rows((of_row, of_fit))
        reason = ["" if found else _NOT_CONVERGED for found in np.asarray(listed.any(axis=1))]
        merged = np.zeros((len(of_row), n + 1), dtype=bool)
        for i, row in enumerate(rows.tolist()):
            if noise_alone[row]:
                reason[i] = NOISE_ALONE
            elif fewer[row] and listed[i].any():
                best = int(np.searchsorted(of_row, i))
                reason[i], merged[best] = self._closest_pair(
                    fits.q[best], fits.mu[best], beams[n + 1], row, bool(certain[row])
                )
        return Optima(self.rows.select(rows), fits, of_row, reason, merged)

    def _closest_pair(
        self, q: FloatArray, mu: FloatArray, more: JointFits, row: int, certain: bool
    ) -> tuple[str, BoolArray]:
        """Return the reason why a row has fewer sources, and the source that represents the closest pair."""
        n = len(q)
        reason = f"the readings support {n} source{'s' if n > 1 else ''}"
        reason += "" if self.asked is None else f", {self.asked} were requested"
        nothing = np.zeros(n, dtype=bool)
        if not np.isfinite(more.chi2[row, 0]):
            return reason, nothing
        pair_m = self.problem.position(more.q[row, 0])
        pair_Am2 = self.problem.moment(more.q[row, 0], more.mu[row, 0])
        distance = np.linalg.norm(pair_m[:, None] - pair_m, axis=-1)
        np.fill_diagonal(distance, np.inf)
        i, j = np.unravel_index(int(np.argmin(distance)), distance.shape)
        together = pair_Am2[i] + pair_Am2[j]
        offsets = np.linalg.norm(self.problem.position(q) - 0.5 * (pair_m[i] + pair_m[j]), axis=-1)
        nearest = int(np.argmin(offsets))
        moment = self.problem.moment(q, mu)[nearest]
        stands_for_both = np.linalg.norm(together - moment) < 0.5 * np.linalg.norm(together)
        if not certain and not (stands_for_both and offsets[nearest] < 2.0 * distance[i, j]):
            return reason, nothing
        return f"{reason}: two are closer than the array resolves", np.arange(n) == nearest
