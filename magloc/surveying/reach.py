"""What could have been found where: the least moment that the rows of a survey show."""

from __future__ import annotations

import numpy as np
from scipy.special import chndtrinc

from arrays.typing import FloatArray
from magloc.surveying.fit.joint_fit import Background, JointFit, with_free_sources
from magloc.surveying.rounds import Model
from magloc.surveying.search import WINDOW, SearchGrid, groups_near, normal_equations

DEPTHS_M = (0.5, 1.0, 2.0)
SEEN = 0.95


def least_moments(
    model: Model, fit: JointFit, background: Background, rows_m: FloatArray, ground_m: float
) -> tuple[FloatArray, FloatArray]:
    """Places (k, 3) under rows (n, 3), and the moments (k,) that would be found there with 95 %, however they point.

    What is found is a noncentral χ² of 3 degrees of freedom, moment·information·moment, above the threshold.
    """
    record = model.record
    Q = with_free_sources(record, background, fit.sources)
    directions = record.directions(fit.sources.fields(record))
    low = np.maximum(rows_m.min(axis=0), model.bounds.low_m)
    high = np.minimum(rows_m.max(axis=0), model.bounds.high_m)
    needed = chndtrinc(model.threshold, 3, 1.0 - SEEN)
    places, moments = [], []
    inside = [at for at in DEPTHS_M if model.bounds.low_m[2] <= ground_m - at <= model.bounds.high_m[2]]
    for distance, at in SearchGrid.of(
        low, high, record.height_m, [record.height_m - ground_m + d for d in inside]
    ).tiles:
        used = groups_near(record, background.white, at, WINDOW * distance)
        projected = normal_equations(record, background.white, directions, at, used, Q, fit.residual)[1]
        places.append(at)
        moments.append(np.sqrt(needed / np.maximum(np.linalg.eigvalsh(projected)[:, 0], np.finfo(float).tiny)))
    return np.concatenate([np.zeros((0, 3)), *places]), np.concatenate([np.zeros(0), *moments])
