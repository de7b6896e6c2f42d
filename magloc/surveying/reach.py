"""Least moment that the rows of a survey can detect, at places in the ground."""

from __future__ import annotations

import numpy as np
from scipy.special import chndtrinc

from arrays.typing import FloatArray
from magloc.surveying.fit.joint_fit import Sources, with_free_sources
from magloc.surveying.rounds import WHILE_SEARCHING, Groups, SurveyModel
from magloc.surveying.search import WINDOW, SearchGrid, groups_near, normal_equations

DEPTHS_M = (0.5, 1.0, 2.0)
SEEN = 0.95
_ROUNDING = 1e-12  # relative rounding error of the information on all three axes


def least_moments(
    model: SurveyModel, sources: Sources, groups: Groups, low_m: FloatArray, high_m: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return places (k, 3) below a rectangle, and the moments (k,) that are found with 95 %.

    The moments hold for the worst direction. A moment is found if a noncentral χ² with 3 degrees of freedom,
    moment·information·moment, exceeds the threshold. Places where the rows have no information are omitted.
    """
    record = model.record
    directions = record.directions(sources.fields(record))
    bounds, ground_m = model.bounds, record.terrain.height_m
    low, high = np.maximum(low_m, bounds.low_m[:2]), np.minimum(high_m, bounds.high_m[:2])
    needed = chndtrinc(model.threshold, 3, 1.0 - SEEN)
    places, moments = [], []
    inside = [at for at in DEPTHS_M if bounds.low_m[2] <= ground_m - at <= bounds.high_m[2] and (low <= high).all()]
    distances = [record.height_m - ground_m + at for at in inside]
    levels = SearchGrid.of(low, high, record.height_m, distances, record.terrain).levels
    of_levels = model.backgrounds(sources, (groups(WHILE_SEARCHING * distance) for distance in levels))
    for (distance, level), background in zip(levels.items(), of_levels, strict=True):
        white, Q = background.white, with_free_sources(record, background, sources)
        for _, at in level.tiles:
            used = groups_near(record, white, at, WINDOW * distance)
            alone, projected, _ = normal_equations(record, white, directions, at, used, Q, np.zeros(len(Q)))
            least = np.linalg.eigvalsh(projected)[:, 0]
            shown = least > _ROUNDING * np.trace(alone, axis1=1, axis2=2)
            places.append(at[shown])
            moments.append(np.sqrt(needed / least[shown]))
    return np.concatenate([np.zeros((0, 3)), *places]), np.concatenate([np.zeros(0), *moments])
