"""Tracker of several moving sources: a joint filter with a few hypotheses."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.localization.fit.prior import NOTHING_KNOWN, SourcePrior
from magloc.localization.locator import Locator
from magloc.measurement.rows import check_magnitudes, check_spans
from magloc.readings import Readings
from magloc.tracking.multi_target.explanations import (
    BIRTH,
    COST_LIMIT,
    IDS_PER_ROW,
    LEFT_LIMIT,
    MANOEUVRE_AGILITY,
    MOST_BY_ITSELF,
    Explanation,
    RowProblem,
    Scene,
    are_same,
    drop_duplicates,
    drop_same_places,
    far_sources,
)
from magloc.tracking.multi_target.hypotheses import (
    Hypothesis,
    by_score,
    inherit_ids,
    match_sources,
    merged_pairs,
    moments_of_source,
    split,
)
from magloc.tracking.multi_target.measurement import Channels
from magloc.tracking.multi_target.motion import FreeMotion, predict_state
from magloc.tracking.multi_target.smoothing import YoungTrack
from magloc.tracking.multi_target.state import N_COMMON, N_SEEN, JointState
from magloc.tracking.multi_target.update import innovation_chi2
from magloc.tracking.results import SourcePoint, SourcesPoint
from magloc.tracking.rows import Row, next_row
from magloc.tracking.sensor_health import SENSOR_LIMIT, Misfits, SensorHealth

ROWS_TO_REPORT = 10
"""Rows after its birth before a source is reported, unless it is the only one; a wrong division is dropped sooner."""
# Largest number of searches for many sources in the first row, each with other random numbers.
_SEARCHES = 4
# Largest number of hypotheses, and largest difference of their scores.
_MOST_HYPOTHESES = 8
_LESS_LIKELY = 25.0
# Rows of a restart's probation, and rows between restarts while χ² is poor. Otherwise the first restart comes a few
# rows after a change of the number of sources, and each next one after twice as many.
_PROBATION_ROWS = 11
_RESTART_PAUSE, _FIRST_PAUSE = 15, 4
# Largest number of restarts with an additional source, and of others.
_MOST_RESTARTS = 3
# Rows for which a doubt lasts: restarts and births reset the residuals, and may be wrong at first.
_DOUBT_LASTS = 25
# Rows between tests for redundant sources.
_DOUBT_EVERY = 12
# Memories of the excess of χ² [rows], and five standard deviations of its mean with each.
_MEMORIES = np.array([10.0, 80.0])
_POOR = 5.0 / np.sqrt(2.0 * _MEMORIES - 1.0)
# Gain of the score for which a restart is accepted at the end of its probation, and at once.
_MUST_GAIN, _CLEAR_GAIN = 20.0, 60.0
# Standard deviation of ln |m| below which a source is not redundant by itself.
_CERTAIN_STRENGTH = 0.05
# Largest score of a row without an explanation.
_UNBEARABLE = 1000.0
# Least and largest number of rows between late births, fewest rows for one, and largest increase of its score. Other
# causes of such residuals, as errors of gains, persist: each failure doubles the pause.
_LATE_PAUSE, _LONGEST_PAUSE, _FEWEST_ROWS = 5, 160, 10
_LATE_WORSE = 10.0
# Largest number of smoothing passes for a late birth.
_LATE_PASSES = 8


class SourcesTracker:
    """Tracker of several sources, row by row.

    Parameters
    ----------
    array : SensorArray
        Array of vector sensors.
    sources : int or "auto"
        Largest number of sources; "auto": five, or as many as the array can determine. More than five are searched for
        in the first row, as by :func:`locate`, which takes seconds.
    motion : FreeMotion
        Motion of each source.
    prior : SourcePrior
        Bounds of every source in the array's frame, and its strength, if known.

    Raises
    ------
    ValueError
        The array has a scalar sensor, or cannot determine that many sources.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> tracker = magloc.SourcesTracker(board.array, sources=2)
    >>> for row in range(12):
    ...     point = tracker.update(board.readings[row])
    >>> [(track.id, track.position_m.round(2).tolist()) for track in point.tracks]
    [(1, [0.0, -0.04, 0.11])]
    """

    def __init__(
        self,
        array: SensorArray,
        *,
        sources: int | Literal["auto"] = "auto",
        motion: FreeMotion = FreeMotion(),  # noqa: B008 - frozen
        prior: SourcePrior = NOTHING_KNOWN,
    ) -> None:
        if array.channel_is_scalar.any():
            raise ValueError("Input array must have vector sensors alone for several moving sources.")
        check_magnitudes(array)
        check_spans(array)
        most = (array.n_channels - N_COMMON - 1) // N_SEEN
        wanted = min(most, MOST_BY_ITSELF) if sources == "auto" else sources
        if not 1 <= wanted <= most:
            raise ValueError(
                f"Input sources must be between 1 and {most} for an array of {array.n_channels} readings a row, with"
                f" {N_SEEN} unknowns a source and {N_COMMON} of the common field; instead received {wanted}."
            )
        self.scene = Scene(Channels(array), motion, prior, wanted)
        self._hypotheses: list[Hypothesis] = []
        self._numbers: dict[int, int] = {}
        self._time_s = math.nan
        self._n_rows = self._doubtful_rows = 0
        self._ids: tuple[int, ...] = ()
        self._last_restart = self._next_restart = -_RESTART_PAUSE
        self._pause = _FIRST_PAUSE
        self._late_pause, self._next_late = _LATE_PAUSE, 0
        self._noise_T, self._misfits = float(np.median(array.channel_noise_T)), Misfits()

    def update(self, row: Row | Readings) -> SourcesPoint:
        """Update all sources by one more row.

        Parameters
        ----------
        row : Row or Readings of length one
            A row later than the one before. Saturated readings are not used.

        Raises
        ------
        ValueError
            Time goes backwards, or the readings are not one row.
        """
        row = next_row(row, self.scene.array, self._time_s)
        dt_s = 0.0 if math.isnan(self._time_s) else row.time_s - self._time_s
        self._time_s = row.time_s
        problem = RowProblem(self.scene, row, self._n_rows, self.scene.motion.numbers(dt_s))
        self._n_rows += 1
        if not row.available.any() or self._misfits.waits:
            step = problem.step
            self._hypotheses = [
                replace(one, state=predict_state(one.state, step, problem.joint_row), young=None)
                for one in self._hypotheses
            ]
            if self._misfits.waits and self._hypotheses:
                self._misfits = self._misfits.skip_row()
                return self._point(problem, "misfit", math.nan)
            return self._point(problem, "no readings", math.nan)
        if not self._hypotheses:
            self._hypotheses = [self._initial_hypothesis(problem)]
        children = [child for one in self._hypotheses for child in self._extend(problem, one, dt_s)]
        joint_row = problem.joint_row
        known = [(one.refit(joint_row), found, one.state is found.update.state) for one, found in children]
        self._hypotheses = self._prune([hypothesis for hypothesis, _, _ in known])
        best = self._hypotheses[0]
        found, explained = next((found, fits) for one, found, fits in known if one.state is best.state)
        status = "misfit" if not explained else "tracked" if best.ids else "no source"
        if explained:
            self._misfits = Misfits(pause=self._misfits.pause)
        else:
            self._misfits = self._misfits.after(found.update.standardised.ravel(), self._noise_T)
        is_poor = bool((best.excess > _POOR).any())
        left, energy = problem.mean_residual(best.health) if best.ids else (None, 0.0)
        if status == "tracked" and (is_poor or energy > SENSOR_LIMIT):
            self._doubtful_rows = _DOUBT_LASTS
        if status == "tracked" and self._doubtful_rows:
            status, self._doubtful_rows = "doubtful", self._doubtful_rows - 1
        poor = is_poor or best.health.suspect is not None
        if len(best.ids) > 1 and self._n_rows % _DOUBT_EVERY == 0:
            self._hypotheses += self._removals(problem, best, found)
        if best.ids != self._ids:
            self._ids, self._pause = best.ids, _FIRST_PAUSE
            self._next_restart = self._n_rows + _FIRST_PAUSE
        if best.ids and self._n_rows >= (self._last_restart + _RESTART_PAUSE if poor else self._next_restart):
            self._pause *= 2
            self._last_restart, self._next_restart = self._n_rows, self._n_rows + self._pause
            restarts = self._restarts(problem, best, found)
            if poor:  # the restarts test the suspect
                self._hypotheses[0] = replace(best, health=best.health.forget_residuals())
            self._hypotheses += restarts
        if left is None or energy < 0.5 * LEFT_LIMIT:
            self._late_pause = _LATE_PAUSE
        elif energy > LEFT_LIMIT and self._n_rows >= self._next_late:
            born = self._late_births(problem, best, found, left)
            self._hypotheses += born
            self._late_pause = _LATE_PAUSE if born else min(2 * self._late_pause, _LONGEST_PAUSE)
            self._next_late = self._n_rows + self._late_pause
        point = self._point(problem, status, found.update.cost)
        self._hypotheses = self._split(problem)
        return point

    def _initial_hypothesis(self, problem: RowProblem) -> Hypothesis:
        """Return the first hypothesis: no source, or those of a search if there may be many."""
        nothing, scene, row = self._no_source(problem), self.scene, problem.row
        if scene.most_sources <= MOST_BY_ITSELF:
            return nothing
        R, best = row.R_world_from_array, None
        for seed in range(_SEARCHES):
            locator = Locator(
                scene.array,
                sources=scene.most_sources,
                prior=scene.prior,
                body_length_m=0.0,
                exclude_faulty=False,
                rng=seed,
            )
            fix = locator.fit(row.readings_T, row.ambient_T)
            if not fix.solutions:
                continue
            positions_m = np.array([row.origin_m + R @ source.position_m for source in fix.best.sources])
            moments_Am2 = np.array([R @ source.moment_Am2 for source in fix.best.sources])
            found = problem.explain_sources(nothing.state, positions_m, moments_Am2, nothing.health.dead)
            if best is None or found.score < best.score:
                best = found
            if best.excess < COST_LIMIT:
                break
        return nothing if best is None else replace(nothing, state=best.prior, ids=best.ids)

    def _no_source(self, problem: RowProblem) -> Hypothesis:
        """Return the hypothesis of no source and a common field as large as the readings."""
        array = self.scene.array
        sigma_T = array.common_field_T
        if sigma_T is None:
            largest = np.nanmax(np.abs(problem.row.readings_T - array.channel_offset_T), initial=0.0)
            sigma_T = 3.0 * float(largest) + 100.0 * float(array.channel_noise_T.max())
        return Hypothesis(
            JointState.empty(np.zeros(3), sigma_T, problem.joint_row.centroid_m, array.circumradius),
            (),
            SensorHealth.of(array.n_sensors),
        )

    def _extend(self, problem: RowProblem, before: Hypothesis, dt_s: float) -> list[tuple[Hypothesis, Explanation]]:
        """Return a hypothesis for each explanation of the row, or the prediction without any."""
        prior = predict_state(before.state, problem.step, problem.joint_row)
        plain = problem.update(prior, before.ids, before.health.dead)
        if problem.is_consistent(plain) or (before.probation > 0 and plain.update.converged):
            explanations = [plain]
        else:
            agile = self.scene.motion.numbers(dt_s, agility=MANOEUVRE_AGILITY)
            manoeuvring = predict_state(before.state, agile, problem.joint_row)
            explanations = problem.explanations(plain, manoeuvring)
        if not explanations:
            predicted = replace(before, state=prior, young=None, score=before.score + min(plain.score, _UNBEARABLE))
            return [(self._with_excess(predicted, plain), plain)]
        after = [self._after(problem, before, found) for found in explanations]
        if not before.ids:  # the same source has the same id in all hypotheses
            after[1:] = [replace(one, ids=inherit_ids(one, after[0])) for one in after[1:]]
        return list(zip(after, explanations, strict=True))

    def _after(self, problem: RowProblem, before: Hypothesis, found: Explanation) -> Hypothesis:
        """Return a hypothesis after an explanation of the row."""
        dead_chi2 = innovation_chi2(found.update.state, problem.joint_row, before.health.dead)
        used = found.update.row.used.reshape(-1, 3)
        residuals = np.where(used.all(axis=1, keepdims=True), found.update.standardised, np.nan)
        young = before.young
        changed = bool(found.penalty) or found.ids != before.ids
        if not 0 < len(found.ids) <= MOST_BY_ITSELF:
            young = None
        else:
            young = YoungTrack(found.prior, is_young=changed) if changed or young is None else young
            young = young.after(found.update.row, problem.step, found.update.state, found.update.score)
        after = replace(
            before,
            young=young,
            state=found.update.state,
            ids=found.ids,
            health=before.health.after(residuals, found.out, dead_chi2),
            score=before.score + found.score,
            probation=max(0, before.probation - 1),
        )
        return self._with_excess(after, found)

    def _with_excess(self, after: Hypothesis, found: Explanation) -> Hypothesis:
        excess = min(found.excess, 2.0 * COST_LIMIT)
        return replace(after, excess=after.excess + (excess - after.excess) / _MEMORIES)

    def _late_births(
        self, problem: RowProblem, best: Hypothesis, found: Explanation, left: FloatArray
    ) -> list[Hypothesis]:
        """Return hypotheses with another source in all recent rows, from a mean residual (C,).

        A source that approaches slowly biases the others row by row, and no single row shows it. A refit of all recent
        rows with and without it gives its likelihood, and corrects the others.
        """
        rows, ids = best.young, (*best.ids, problem.first_id + IDS_PER_ROW - 1)
        if rows is None or len(rows.rows) < _FEWEST_ROWS or len(ids) > self.scene.most_sources:
            return []
        without = rows.smooth()
        if without is None:
            return []
        known, health = [one.state for one in self._hypotheses], best.health.forget_residuals()
        born: list[Hypothesis] = []
        starts = problem.late_birth_priors(rows.prior, found, left)
        tried = [rows.add_sources(prior).smooth(_LATE_PASSES, without.score) for prior in starts]
        for young in sorted((one for one in tried if one is not None), key=lambda one: one.score):
            state, score = young.states[-1], best.score + young.score - without.score + BIRTH
            new = score < best.score + _LATE_WORSE and not any(are_same(state, other) for other in known)
            if new and problem.allows(state, problem.joint_row.without(found.out), slice(-1, None)):
                known.append(state)
                born.append(replace(best, state=state, ids=ids, young=young, score=score, health=health))
        return born

    def _removals(self, problem: RowProblem, best: Hypothesis, found: Explanation) -> list[Hypothesis]:
        """Return hypotheses with one source fewer that explain the row, on probation.

        They remove an uncertain source, or replace two merged ones by one, since two sources with opposite moments
        may stand for a single one. A far source, like a gradient of the ambient field, is removed without
        probation.
        """
        state = best.state
        far = problem.remove_sources(found, far_sources(state), [])
        without_far = [self._after(problem, best, one) for one in far if problem.is_consistent(one)]
        if without_far:
            return [replace(one, score=best.score - _MUST_GAIN) for one in without_far]
        doubtful = [k for k in range(state.n_sources) if state.log_strength_sigma(k) > _CERTAIN_STRENGTH]
        fewer = problem.remove_sources(found, doubtful, merged_pairs(state))
        consistent = [self._after(problem, best, one) for one in fewer if problem.is_consistent(one)]
        return [replace(one, score=best.score, excess=np.zeros(2), probation=_PROBATION_ROWS) for one in consistent]

    def _restarts(self, problem: RowProblem, best: Hypothesis, found: Explanation) -> list[Hypothesis]:
        """Return hypotheses on probation: a drifting sensor, an additional source, or a restart.

        A restart forgets all, or all but the positions and moments. Too few sources at wrong places may explain the
        first rows with a good χ², so that restarts are also tried without a sign of an error, at growing intervals.
        """
        common, dead, known = best.state.without_sources, best.health.dead, len(best.ids)
        again = problem.explain_sources(common, best.state.position_m, best.state.moment_Am2, dead)
        anew, nothing = [again], problem.update(common, (), dead)
        for number in (known, known - 1, known + 1):  # a beam search for many takes seconds and fails
            if 0 < number <= min(self.scene.most_sources, MOST_BY_ITSELF):
                anew += problem.explain_with_at_least(nothing, number)
        if known < self.scene.most_sources:
            anew += drop_duplicates(one for start in (found, again) for one in problem.births(start))
        tried = drop_same_places(one for one in anew if one.update.converged)
        more = [one for one in tried if len(one.ids) > known]
        tried = [one for one in tried if len(one.ids) <= known][:_MOST_RESTARTS] + more[:_MOST_RESTARTS]
        # Restarts have yet to learn the sources' motion, which the best hypothesis knows.
        information = 2.0 * (np.linalg.slogdet(again.update.state.S)[1] - np.linalg.slogdet(best.state.S)[1])
        score, health = best.score - max(0.0, float(information)), best.health.forget_residuals()
        restarts = [
            replace(self._after(problem, best, one), score=score + BIRTH * (len(one.ids) - known), health=health)
            for one in tried
        ]
        suspect = best.health.suspect
        if suspect is not None and best.health.may_drift:
            restarts.append(replace(best, health=best.health.without(suspect)))
        return [replace(one, excess=np.zeros(2), probation=_PROBATION_ROWS) for one in restarts]

    def _prune(self, hypotheses: list[Hypothesis]) -> list[Hypothesis]:
        """Return the likeliest hypotheses, the best first, followed by those on probation."""
        accepted = sorted((one for one in hypotheses if not one.probation), key=by_score)
        on_probation = []
        for one in (one for one in hypotheses if one.probation):
            gain = accepted[0].score - one.score
            if gain > (_MUST_GAIN if one.probation == 1 else _CLEAR_GAIN):
                ids = inherit_ids(one, accepted[0])
                accepted.append(replace(one, ids=ids, score=accepted[0].score - _MUST_GAIN, probation=0))
            elif one.probation > 1:
                on_probation.append(one)
        likely: list[Hypothesis] = []
        for one in sorted(accepted, key=by_score):
            same = (i for i, other in enumerate(likely) if are_same(one.state, other.state))
            if (i := next(same, None)) is not None:
                score = -2.0 * np.logaddexp(-0.5 * one.score, -0.5 * likely[i].score)
                likely[i] = replace(likely[i], score=float(score))
            elif not likely or (len(likely) < _MOST_HYPOTHESES and one.score < likely[0].score + _LESS_LIKELY):
                likely.append(one)
        return likely + on_probation

    def _split(self, problem: RowProblem) -> list[Hypothesis]:
        """Return hypotheses split where readings are nonlinear, up to their largest number."""
        parts: list[Hypothesis] = []
        for i, one in enumerate(self._hypotheses):
            room = _MOST_HYPOTHESES - len(parts) - sum(not other.probation for other in self._hypotheses[i:])
            of_one = split(one.state, problem.joint_row) if room > 1 and not one.probation else [(1.0, one.state)]
            parts += [one.take_part(share, state) for share, state in of_one]
        return parts

    def _point(self, problem: RowProblem, status: str, chi2: float) -> SourcesPoint:
        """Return the point of the best hypothesis."""
        array, row = self.scene.array, problem.row
        best = self._hypotheses[0] if self._hypotheses else self._no_source(problem)
        reported = [k for k, id in enumerate(best.ids) if self._n_rows - id // IDS_PER_ROW >= ROWS_TO_REPORT]
        reported = reported or list(range(len(best.ids)))
        for k in reported:
            self._numbers.setdefault(best.ids[k], len(self._numbers) + 1)
        merged = np.isin(np.arange(len(best.ids)), merged_pairs(best.state))
        accepted = [one for one in self._hypotheses if not one.probation]
        weights = np.exp(-0.5 * np.array([one.score - best.score for one in accepted]))
        matches = [match_sources(best, one) for one in accepted]
        tracks = [
            SourcePoint(
                row.time_s,
                *moments_of_source([one.state for one in accepted], weights, [match.get(k) for match in matches]),
                nis=chi2,
                nis_dof=int(np.count_nonzero(row.available)),
                status="predicted" if status in ("misfit", "no readings") else "merged" if merged[k] else status,
                weight=float(weights @ [best.ids[k] in one.ids for one in accepted] / weights.sum()),
                centroid_m=row.origin_m + row.R_world_from_array @ array.centroid,
                radius_m=array.circumradius,
                id=self._numbers[best.ids[k]],
                merged=bool(merged[k]),
            )
            for k in reported
        ]
        return SourcesPoint(
            row.time_s,
            tuple(sorted(tracks, key=lambda track: track.id)),
            status,
            chi2,
            int(np.count_nonzero(row.available)),
            tuple(name for name, dead in zip(array.ids, best.health.dead, strict=True) if dead),
        )
