"""Greedy rounds: look for sources in what is left, fit all of them together, leave out what is not significant."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import zip_longest

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import Background, Bounds, JointFit, Layer, Sources, fit_jointly
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.whitening import Drift
from magloc.surveying.search import Candidates, SearchGrid, peaks, search, sources_at

MOST_ROUNDS = 60
_MOST_IN_VAIN = 4  # rounds: beside strong sources, and at the rims of tiles, there is always something left to try
_MOST_OF_MISFITS, _MISFIT = 8, 1.5  # and as long as χ² per reading says that something is missing
_PROGRESS, _WORSE = 0.999, 1.02
_MOST_AT_ONCE = 8
_SAME_PLACE_M = 1e-6
_FELT = 0.3  # of the noise of a group of rows: sources that change it by less are the same
_REACH = 0.6  # of a fit, over the distance from the sensors
_TWINS = 0.15  # over the distance from the sensors: sources that are nearer to each other are one
_MOST_WEIGHINGS = 4
_SETTLED_COARSELY = 0.5
# Steps of a fit whose weights follow it, and χ² that the last one may change by.
_MOST_STEPS, _FEW_STEPS, _SMALL_STEP = 6, 3, 0.1
_HARDLY_DAMPED = 1e-9
# Rows that pass within such a part of the distance to a source count as one.
WHILE_SEARCHING, AT_LAST = 0.33, 0.15
Groups = Callable[[float], IntArray]
"""Group of every row (n,), of neighbours within a length."""
# While sources are missing, what they leave of each other's field counts as errors of the place.
_POSE_WHILE_SEARCHING_M = 0.04


@dataclass(frozen=True, eq=False)
class Model:
    """What a survey's rows hold beside its sources."""

    record: SurveyRecord
    errors: PoseErrors
    layer: Layer
    drift: Drift
    bounds: Bounds
    threshold: float
    body_length_m: float = 0.0
    beside: Sources | None = None

    @property
    def nearest_m(self) -> float:
        """Distance from the sensors to the shallowest sources."""
        return self.record.height_m - float(self.bounds.high_m[2])

    def background(self, sources: Sources, group: IntArray) -> Background:
        """Where some sources are, for groups of rows."""
        return next(self.backgrounds(sources, [group]))

    def backgrounds(self, sources: Sources, groups: Iterable[IntArray]) -> Iterator[Background]:
        """Where some sources are, for several ways to group the rows."""
        what = self.layer, self.errors, self.drift
        return Background.of_each(self.record, sources, *what, groups, self.body_length_m, self.beside)

    def refitted(self, sources: Sources, group: IntArray) -> tuple[JointFit, Background]:
        """The same sources where they fit best, within their reach."""
        background = self.background(sources, group)
        fit = fit_jointly(self.record, background, sources, self._around(sources), settled=_SETTLED_COARSELY)
        return self.relinearised(fit, background, group, _FEW_STEPS)

    def misfit(self, sources: Sources, group: IntArray) -> float:
        """Minus twice the log-likelihood of some sources, but for a constant; the ground is Gaussian."""
        background = self.background(sources, group)
        return JointFit(self.record, background, self.bounds, sources).cost + background.noise_log_determinant

    def _around(self, sources: Sources) -> Bounds:
        """Bounds within which sources stay what they are: one that leaps takes the place of one not found yet."""
        return self.bounds.around(sources, _REACH * self._distances(sources))

    def _distances(self, sources: Sources) -> FloatArray:
        """From the sensors down to sources (K,)."""
        return np.asarray(np.median(self.record.sensors_m[..., 2]) - sources.position_m[:, 2])

    def fitted(self, sources: Sources, group: IntArray, settled: float) -> tuple[JointFit, Background]:
        """Sources fitted and weighed anew until none is left out that is not significant or not within the bounds."""
        for weighing in range(_MOST_WEIGHINGS):
            background = self.background(sources, group)
            fit = fit_jointly(self.record, background, sources, self._around(sources), settled=settled)
            if not len(sources):
                break
            kept = fit.significance > self.threshold
            if weighing:  # where a source starts its errors of the pose hide what keeps it from a rim
                kept &= self.bounds.hold(fit.sources)
            sources = fit.sources.some(kept).without_twins(_TWINS * self._distances(fit.sources.some(kept)))
            if len(sources) == len(kept) and weighing:
                break
        if len(sources) < len(fit.sources):
            background = self.background(sources, group)
            fit = fit_jointly(self.record, background, sources, self.bounds, settled=settled)
        return self.relinearised(fit, background, group) if settled < _SETTLED_COARSELY else (fit, background)

    def relinearised(
        self, fit: JointFit, background: Background, group: IntArray, most: int = _MOST_STEPS
    ) -> tuple[JointFit, Background]:
        """Return the fit where sources and errors of the pose are linear about the same place, step by step.

        A fit holds the weights of where it begins. An error that all places share is then told from a shift of all
        sources by the curvature of their fields alone, which is noise.
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
        """What one more source would explain in each tile; the deeper, the longer the averages of rows that show it."""
        of_levels = self.backgrounds(sources, (groups(WHILE_SEARCHING * distance) for distance in grid.levels))
        return [
            candidates
            for background, level in zip(of_levels, grid.levels.values(), strict=True)
            for candidates in search(self.record, background, sources, level)
        ]


@dataclass
class Searched:
    """The places of a grid, and where the sources were when each of its tiles was searched last.

    Attributes
    ----------
    model : Model
    groups : Groups
    grid : SearchGrid
    candidates : list of Candidates
        Of every tile.
    predicted : list of ndarray
        What sources made the channels (n, C) read, once a search.
    of : ndarray of int
        Which of them each tile was searched with.
    """

    model: Model
    groups: Groups
    grid: SearchGrid
    candidates: list[Candidates]
    predicted: list[FloatArray]
    of: IntArray

    @classmethod
    def nowhere(cls, model: Model, groups: Groups, grid: SearchGrid) -> Searched:
        """No tile is searched yet."""
        return cls(model, groups, grid, [], [], np.full(len(grid.tiles), -1))

    def again(self, sources: Sources, background: Background) -> Candidates:
        """All of them, those anew that look at rows where the sources have changed more than noise and ground hide."""
        record, white, Q = self.model.record, background.white, background.Q
        now = record.predicted(sources.fields(record))
        due = self.of < 0
        for then in set(self.of[~due].tolist()):
            change = white((now - self.predicted[then])[..., None])[:, 0]
            change = np.abs(change - Q @ (Q.T @ change)).reshape(white.n_groups, -1).max(axis=1)
            due |= (self.of == then) & self.grid.seeing(record.middles_m[white.starts[:-1]][change > _FELT])
        found = iter(self.model.candidates(sources, self.grid.some(due), self.groups) if due.any() else [])
        self.candidates = [next(found) if new else old for new, old in zip_longest(due, self.candidates)]
        self.of[due] = len(self.predicted)
        self.predicted.append(now)
        return Candidates.joined(self.candidates)


def found_in(
    model: Model, groups: Groups, grid: SearchGrid, known: Sources, most: int, own: Callable[[FloatArray], BoolArray]
) -> Sources:
    """Sources of a record after some rounds, new ones only where places (m, 3) are its own."""
    group = groups(WHILE_SEARCHING * model.nearest_m)
    stated = model.errors.uncertainty.position_m
    share = max(1.0, _POSE_WHILE_SEARCHING_M / stated) if stated else 1.0
    wide = replace(model, record=replace(model.record, pose_effects=share * model.record.pose_effects))
    best = sources = known
    in_vain = 0
    tried: FloatArray = np.zeros((0, 3))
    least = math.inf
    searched = Searched.nowhere(wide, groups, grid)
    for number in range(most):
        fit, background = wide.fitted(sources, group, _SETTLED_COARSELY)
        at_once = _MOST_AT_ONCE
        if fit.cost > _WORSE * least:
            # Too many at a time led away: back, and one by one from there.
            fit, background = wide.fitted(best, group, _SETTLED_COARSELY)
            at_once = 1
        elif fit.cost < min(_PROGRESS * least, least - model.threshold):
            tried, in_vain = np.zeros((0, 3)), 0
        in_vain += 1
        if in_vain > (_MOST_OF_MISFITS if fit.cost > _MISFIT * fit.residual.size else _MOST_IN_VAIN):
            break
        best, least = fit.sources, min(least, fit.cost)
        if number == most - 1:
            break
        candidates = searched.again(fit.sources, background)
        # What was left out again is not tried twice, unless something else was found meanwhile.
        tried_before = (np.linalg.norm(candidates.place_m[:, None] - tried, axis=-1) < _SAME_PLACE_M).any(axis=1)
        strongest = peaks(candidates.without(tried_before), model.threshold)
        chosen = sources_at(candidates, strongest[own(candidates.place_m[strongest])][:at_once])
        if not len(chosen):
            break
        tried = np.concatenate([tried, chosen.position_m])
        sources = best.with_more(chosen)
    return best
