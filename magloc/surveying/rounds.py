"""Greedy rounds: look for sources in what is left, fit all of them together, leave out what is not significant."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.measurement.pose import PoseErrors
from magloc.surveying.fit.joint_fit import Background, Bounds, JointFit, Layer, Sources, fit_jointly, residual_of
from magloc.surveying.fit.record import SurveyRecord
from magloc.surveying.fit.whitening import Drift
from magloc.surveying.search import Candidates, SearchGrid, peaks, search, sources_at

MOST_ROUNDS = 60
_MOST_IN_VAIN = 4  # rounds: beside strong sources, and at the rims of tiles, there is always something left to try
_MOST_OF_MISFITS, _MISFIT = 8, 1.5  # and as long as χ² per reading says that something is missing
_PROGRESS, _WORSE = 0.999, 1.02
_MOST_AT_ONCE = 8
_SAME_PLACE_M = 1e-6
_FELT = 0.3  # of the noise: sources that change the field by less are the same
_REACH = 0.6  # of a fit, over the distance from the sensors
_MOST_WEIGHINGS = 4
_SETTLED_COARSELY = 0.5
# Rows that pass within such a part of the distance to a source count as one.
WHILE_SEARCHING, AT_LAST = 0.33, 0.05
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

    @property
    def nearest_m(self) -> float:
        """Distance from the sensors to the shallowest sources."""
        return self.record.height_m - float(self.bounds.high_m[2])

    def background(self, sources: Sources, group: IntArray) -> Background:
        """Where some sources are, for groups of rows."""
        return next(self.backgrounds(sources, [group]))

    def backgrounds(self, sources: Sources, groups: Iterable[IntArray]) -> Iterator[Background]:
        """Where some sources are, for several ways to group the rows."""
        return Background.of_each(self.record, sources, self.layer, self.errors, self.drift, groups, self.body_length_m)

    def refitted(self, sources: Sources, group: IntArray) -> Sources:
        """The same sources where they fit best, within their reach."""
        for _ in range(2):
            background = self.background(sources, group)
            sources = fit_jointly(
                self.record, background, sources, self._around(sources), settled=_SETTLED_COARSELY
            ).sources
        return sources

    def misfit(self, sources: Sources, group: IntArray) -> float:
        """Minus twice the log-likelihood of some sources, but for a constant; the ground is Gaussian."""
        background = self.background(sources, group)
        fields = sources.fields(self.record)
        residual = residual_of(self.record, background, fields)
        of_layer = background.Q.T @ residual
        square = float(residual @ residual - of_layer @ of_layer)
        return square + background.white.log_determinant - background.log_determinant

    def _around(self, sources: Sources) -> Bounds:
        """Bounds within which sources stay what they are: one that leaps takes the place of one not found yet."""
        height = np.median(self.record.sensors_m[..., 2])
        return self.bounds.around(sources, _REACH * (height - sources.position_m[:, 2]))

    def fitted(self, sources: Sources, group: IntArray, settled: float) -> tuple[JointFit, Background]:
        """Sources fitted and weighed anew until none is left out that is not significant or not within the bounds."""
        for weighing in range(_MOST_WEIGHINGS):
            background = self.background(sources, group)
            fit = fit_jointly(self.record, background, sources, self._around(sources), settled=settled)
            if not len(sources):
                break
            kept = (fit.significance > self.threshold) & self.bounds.hold(fit.sources)
            sources = fit.sources.some(kept)
            if kept.all() and weighing:
                break
        if len(sources) < len(fit.sources):
            background = self.background(sources, group)
            fit = fit_jointly(self.record, background, sources, self.bounds, settled=settled)
        return fit, background

    def candidates(self, sources: Sources, grid: SearchGrid, groups: Groups) -> Candidates:
        """Where one more source would explain most; the deeper, the longer the averages of rows that show it."""
        of_levels = self.backgrounds(sources, (groups(WHILE_SEARCHING * distance) for distance in grid.levels))
        return Candidates.joined(
            search(self.record, background, sources, level)
            for background, level in zip(of_levels, grid.levels.values(), strict=True)
        )


def found_in(model: Model, groups: Groups, grid: SearchGrid, known: Sources, most: int) -> Sources:
    """Sources of a record after some rounds."""
    group = groups(WHILE_SEARCHING * model.nearest_m)
    stated = model.errors.uncertainty.position_m
    share = max(1.0, _POSE_WHILE_SEARCHING_M / stated) if stated else 1.0
    wide = replace(model, record=replace(model.record, pose_effects=share * model.record.pose_effects))
    best = sources = known
    in_vain = 0
    tried: FloatArray = np.zeros((0, 3))
    least = math.inf
    felt_T = _FELT * float(model.record.array.channel_noise_T.min())
    searched_T: FloatArray = np.full_like(model.record.sensors_m, math.inf)
    for number in range(most):
        fit, _ = wide.fitted(sources, group, _SETTLED_COARSELY)
        at_once = _MOST_AT_ONCE
        if fit.chi2 > _WORSE * least:
            # Too many at a time led away: back, and one by one from there.
            fit, _ = wide.fitted(best, group, _SETTLED_COARSELY)
            at_once = 1
        elif fit.chi2 < min(_PROGRESS * least, least - model.threshold):
            tried, in_vain = np.zeros((0, 3)), 0
        in_vain += 1
        if in_vain > (_MOST_OF_MISFITS if fit.chi2 > _MISFIT * fit.residual.size else _MOST_IN_VAIN):
            break
        best, least = fit.sources, min(least, fit.chi2)
        if number == most - 1:
            break
        fields = fit.sources.fields(wide.record)
        if np.abs(fields - searched_T).max() > felt_T:
            candidates, searched_T = wide.candidates(fit.sources, grid, groups), fields
        # What was left out again is not tried twice, unless something else was found meanwhile.
        tried_before = (np.linalg.norm(candidates.place_m[:, None] - tried, axis=-1) < _SAME_PLACE_M).any(axis=1)
        chosen = sources_at(candidates, peaks(candidates.without(tried_before), model.threshold)[:at_once])
        if not len(chosen):
            break
        tried = np.concatenate([tried, chosen.position_m])
        sources = best.with_more(chosen)
    return best
