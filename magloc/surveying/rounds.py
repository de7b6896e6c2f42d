"""Greedy rounds: search residuals for sources, fit all together, drop insignificant ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import JointFit, Layer, SourceBounds, Sources, SurveyBackground, fit_jointly
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.whitening import SurveyDrift
from magloc.surveying.search import Candidates, SearchGrid, peaks, search, sources_at

MOST_ROUNDS = 60
_MOST_IN_VAIN = 4  # rounds without a new source; near strong sources and edges of tiles some candidates always remain
_MOST_OF_MISFITS, _MISFIT = 8, 1.5  # the same while χ² per reading exceeds a limit
_PROGRESS, _WORSE = 0.999, 1.02
_PROGRESS_OF_MISFITS = 0.98  # errors larger than stated make false sources without end, each of which explains little
_MOST_AT_ONCE = 8
_SAME_PLACE_M = 1e-6
_FELT = 0.3  # smallest change of sources that counts, in units of the noise of a group of rows
_REACH = 0.6  # largest shift in a fit, relative to the distance from the sensors
NEAR = 1.5
"""Distance on the map within which rows are above a source, relative to its distance from the sensors."""
_TWINS = 0.15  # largest distance of sources that are merged, relative to that from the sensors
_MOST_WEIGHINGS = 4
_SETTLED_COARSELY = 0.5
# Steps of a fit with new weights at each, and the change of χ² in the last one.
_MOST_STEPS, _FEW_STEPS, _SMALL_STEP = 6, 3, 0.1
_HARDLY_DAMPED = 1e-9
# Rows within this share of the distance to a source count as one group.
WHILE_SEARCHING, AT_LAST = 0.33, 0.15
Groups = Callable[[float], IntArray]
"""Group of every row (n,), of neighbours within a length."""
# While sources are missing, errors of the known ones count as errors of the place.
_POSE_WHILE_SEARCHING_M = 0.04


@dataclass(frozen=True, eq=False)
class SurveyModel:
    """Model of a survey's rows apart from its sources."""

    record: SurveyRecord
    errors: PoseErrors
    layer: Layer
    drift: SurveyDrift
    bounds: SourceBounds
    threshold: float
    body_length_m: float = 0.0
    beside: Sources | None = None
    counts_misfits: bool = False

    @property
    def nearest_m(self) -> float:
        """Distance from the sensors to the shallowest sources."""
        return self.record.height_m - float(self.bounds.high_m[2])

    def background(self, sources: Sources, group: IntArray) -> SurveyBackground:
        """Return the background at some sources, for groups of rows."""
        return next(self.backgrounds(sources, [group]))

    def backgrounds(self, sources: Sources, groups: Iterable[IntArray]) -> Iterator[SurveyBackground]:
        """Return the backgrounds at some sources, for several ways to group the rows."""
        what = self.layer, self.errors, self.drift
        return SurveyBackground.of_each(self.record, sources, *what, groups, self.body_length_m, self.beside)

    def refit(
        self, sources: Sources, group: IntArray, settled: float = _SETTLED_COARSELY
    ) -> tuple[JointFit, SurveyBackground]:
        """Refit sources within their reach, and keep all of them."""
        background = self.background(sources, group)
        fit = fit_jointly(self.record, background, sources, self._around(sources), settled=settled)
        return self.relinearise(fit, background, group, _FEW_STEPS if settled >= _SETTLED_COARSELY else _MOST_STEPS)

    def misfit(self, sources: Sources, group: IntArray) -> float:
        """Return minus twice the log-likelihood of sources, up to a constant.

        The ground is Gaussian.
        """
        background = self.background(sources, group)
        return JointFit(self.record, background, self.bounds, sources).cost + background.noise_log_determinant

    def _around(self, sources: Sources) -> SourceBounds:
        """Return bounds around sources that keep their identity.

        A source that jumps would replace one that is not found yet.
        """
        return self.bounds.around(sources, _REACH * self._distances(sources))

    def _distances(self, sources: Sources) -> FloatArray:
        """Return the distances (K,) from the sensors down to sources."""
        flat_m = self.record.terrain.flatten(sources.position_m)
        return np.asarray(np.median(self.record.flat_m[..., 2]) - flat_m[:, 2])

    def fit(self, sources: Sources, group: IntArray, settled: float) -> tuple[JointFit, SurveyBackground]:
        """Fit sources and drop those that are not significant or out of bounds, until none remains."""
        for weighing in range(_MOST_WEIGHINGS):
            background = self.background(sources, group)
            fit = fit_jointly(self.record, background, sources, self._around(sources), settled=settled)
            if not len(sources):
                break
            kept = fit.significance > self.threshold * self._misfits(fit, background)
            if weighing:  # at the start pose errors hide the signal that keeps a source off an edge
                kept &= self.bounds.contains(fit.sources)
            sources = fit.sources.some(kept).without_twins(_TWINS * self._distances(fit.sources.some(kept)))
            if len(sources) == len(kept) and weighing:
                break
        if len(sources) < len(fit.sources):
            background = self.background(sources, group)
            fit = fit_jointly(self.record, background, sources, self.bounds, settled=settled)
        return self.relinearise(fit, background, group) if settled < _SETTLED_COARSELY else (fit, background)

    def _misfits(self, fit: JointFit, background: SurveyBackground) -> FloatArray:
        """Return χ² per reading above each source (K,), or 1 where it is close to 1 or not used.

        Where errors are larger than stated, a source has to explain more, as in an F-test. Otherwise each false source
        would make room for the next. It is not used before the lag is known, because an unknown lag splits a source
        into two.
        """
        if not self.counts_misfits:
            return np.ones(len(fit.sources))
        left, above = residuals_above(self.record, fit, background)
        chi2 = np.array([np.mean(left[near] ** 2) if near.any() else 1.0 for near in above])
        return np.asarray(np.where(chi2 > _MISFIT, chi2, 1.0))

    def relinearise(
        self, fit: JointFit, background: SurveyBackground, group: IntArray, most: int = _MOST_STEPS
    ) -> tuple[JointFit, SurveyBackground]:
        """Return the fit with sources and pose errors linear about the same place.

        A fit keeps the weights of its start. Then only the curvature of the fields, which is noise, would separate an
        error that all places share from a shift of all sources.
        """
        for _ in range(most if len(fit.sources) else 0):
            before, background = fit.sources, self.background(fit.sources, group)
            around = self._around(before)
            fit = fit_jointly(self.record, background, before, around, most=1, damping=_HARDLY_DAMPED)
            step = np.hstack([fit.sources.position_m - before.position_m, fit.sources.moment_Am2 - before.moment_Am2])
            if step.ravel() @ fit.information @ step.ravel() < _SMALL_STEP:
                break
        return fit, background

    def candidates(self, sources: Sources, grid: SearchGrid, groups: Groups) -> list[Candidates]:
        """Return candidates for one more source in each tile.

        Deeper tiles average over longer groups of rows.
        """
        of_levels = self.backgrounds(sources, (groups(WHILE_SEARCHING * distance) for distance in grid.levels))
        return [
            candidates
            for background, level in zip(of_levels, grid.levels.values(), strict=True)
            for candidates in search(self.record, background, sources, level)
        ]


def residuals_above(record: SurveyRecord, fit: JointFit, background: SurveyBackground) -> tuple[FloatArray, BoolArray]:
    """Return white residuals of groups (g, k), and which groups are above sources (K, g)."""
    left = (fit.residual - background.Q @ (background.Q.T @ fit.residual)).reshape(background.white.n_groups, -1)
    middles, position = record.middles_m[background.white.starts[:-1]], fit.sources.position_m
    reach = NEAR * record.height_above(position)[:, None]
    return left, np.linalg.norm(position[:, None, :2] - middles[:, :2], axis=-1) < reach


@dataclass
class SearchState:
    """Candidates of a grid, and the sources at the last search of each tile.

    Attributes
    ----------
    model : Model
    groups : Groups
    grid : SearchGrid
    candidates : list of Candidates
        Candidates of every tile.
    predicted : list of ndarray
        Predictions of the channels (n, C), one per search.
    of : ndarray of int
        Index of the prediction at the last search of each tile.
    """

    model: SurveyModel
    groups: Groups
    grid: SearchGrid
    candidates: list[Candidates]
    predicted: list[FloatArray]
    of: IntArray

    @classmethod
    def empty(cls, model: SurveyModel, groups: Groups, grid: SearchGrid) -> SearchState:
        """Return a state without searched tiles."""
        return cls(model, groups, grid, [], [], np.full(len(grid.tiles), -1))

    def update(self, sources: Sources, background: SurveyBackground) -> Candidates:
        """Search again the tiles whose rows have changed, and return all candidates.

        A change is significant if it exceeds noise and ground.
        """
        record, white, Q = self.model.record, background.white, background.Q
        now = record.predict(sources.fields(record))
        due = self.of < 0
        for then in set(self.of[~due].tolist()):
            change = white((now - self.predicted[then])[..., None])[:, 0]
            change = np.abs(change - Q @ (Q.T @ change)).reshape(white.n_groups, -1).max(axis=1)
            due |= (self.of == then) & self.grid.tiles_near(record.middles_m[white.starts[:-1]][change > _FELT])
        found = iter(self.model.candidates(sources, self.grid.some(due), self.groups) if due.any() else [])
        self.candidates = [next(found) if new else old for new, old in zip_longest(due, self.candidates)]
        self.of[due] = len(self.predicted)
        self.predicted.append(now)
        return Candidates.concatenate(self.candidates)


def find_sources(
    model: SurveyModel,
    groups: Groups,
    grid: SearchGrid,
    known: Sources,
    most: int,
    own: Callable[[FloatArray], BoolArray],
) -> Sources:
    """Find the sources of a record in some rounds.

    New ones start only where places (m, 3) are the record's own.
    """
    group = groups(WHILE_SEARCHING * model.nearest_m)
    stated = model.errors.uncertainty.position_m
    share = max(1.0, _POSE_WHILE_SEARCHING_M / stated) if stated else 1.0
    wide = replace(model, record=replace(model.record, pose_effects=share * model.record.pose_effects))
    best = sources = known
    in_vain = 0
    tried: FloatArray = np.zeros((0, 3))
    least = math.inf
    searched = SearchState.empty(wide, groups, grid)
    for number in range(most):
        fit, background = wide.fit(sources, group, _SETTLED_COARSELY)
        at_once, misfits = _MOST_AT_ONCE, fit.cost > _MISFIT * fit.residual.size
        if fit.cost > _WORSE * least:
            # Too many at once made the fit worse: return to the best one and add one at a time.
            fit, background = wide.fit(best, group, _SETTLED_COARSELY)
            at_once = 1
        elif fit.cost < min((_PROGRESS_OF_MISFITS if misfits else _PROGRESS) * least, least - model.threshold):
            tried, in_vain = np.zeros((0, 3)), 0
        in_vain += 1
        if in_vain > (_MOST_OF_MISFITS if misfits else _MOST_IN_VAIN):
            break
        best, least = fit.sources, min(least, fit.cost)
        if number == most - 1:
            break
        candidates = searched.update(fit.sources, background)
        # A dropped source is not tried again until another one is found.
        tried_before = (np.linalg.norm(candidates.place_m[:, None] - tried, axis=-1) < _SAME_PLACE_M).any(axis=1)
        strongest = peaks(candidates.without(tried_before), model.threshold)
        chosen = sources_at(candidates, strongest[own(candidates.place_m[strongest])][:at_once])
        if not len(chosen):
            break
        tried = np.concatenate([tried, chosen.position_m])
        sources = best.with_more(chosen)
    return best
