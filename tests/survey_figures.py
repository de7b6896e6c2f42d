"""What a survey of a simulated field finds: pairs of a true target and a found one, and what is missed or false."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

import magloc
from arrays.typing import FloatArray
from magloc.localization.fit.prior import NOTHING_KNOWN
from magloc.surveying.fit.joint_fit import SourceBounds, Sources, fit_jointly
from magloc.surveying.piece import Ground
from magloc.surveying.preparation import whole_rows
from magloc.surveying.rounds import AT_LAST
from magloc.surveying.tiled import TiledSurvey
from sims.magnetics.simulation import Simulation

NEAREST_M = 0.5


class Pair(NamedTuple):
    """A true target and the one that was found there."""

    error_m: FloatArray
    depth_m: float
    covariance: FloatArray
    interval_m: tuple[float, float]
    significance: float
    bound_m: float
    visible_chi2: float
    merged: bool


class Field(NamedTuple):
    """One field: pairs, χ² at the true places of those that were missed, and false targets."""

    pairs: list[Pair]
    missed_chi2: list[float]
    n_false: int
    threshold: float
    seconds: float
    processors_s: float
    rows: int
    chi2_per_dof: float

    @property
    def all_chi2(self) -> list[float]:
        """At the true places of all targets."""
        return self.missed_chi2 + [pair.visible_chi2 for pair in self.pairs]


def judged(field: Simulation, false_per_hectare: float = 0.1) -> Field:
    """A simulated field surveyed, and its targets paired with the true ones."""
    began = sum(os.times()[:4])  # of this process and of those that it waited for
    found = magloc.survey(field.array, field.readings, false_per_hectare=false_per_hectare)
    processors_s = sum(os.times()[:4]) - began
    significance, bound = at_truth(field, found)
    pairs, missed, used = [], [], set()
    for j, position in enumerate(field.target_position_m):
        apart = np.linalg.norm(found.position_m - position, axis=1)
        k = int(apart.argmin()) if len(found) else -1
        near = k >= 0 and apart[k] < max(NEAREST_M, 4.0 * np.sqrt(np.trace(found[k].covariance[:3, :3])))
        if not near or k in used:
            missed.append(float(significance[j]))
            continue
        used.add(k)
        target = found[k]
        error = target.position_m - position
        own = target.covariance[:3, :3]
        interval, chi2 = target.depth_interval95_m, float(significance[j])
        merged = "merged" in target.flags
        pairs.append(Pair(error, -position[2], own, interval, target.significance, float(bound[j]), chi2, merged))
    n_false = len(found) - len(used)
    cost = found.seconds, processors_s, len(field.readings)
    return Field(pairs, missed, n_false, found.threshold, *cost, found.chi2_per_dof)


def at_truth(field: Simulation, found: magloc.Survey) -> tuple[FloatArray, FloatArray]:
    """χ² of the true targets (K,), and Cramér-Rao bounds of their places [m], each from the rows of its tile."""
    truth = Sources(field.target_position_m, field.target_moment_Am2)
    ground = Ground(NOTHING_KNOWN, found.terrain, 15.0, found.threshold)
    tiled = replace(TiledSurvey.of(found.array, whole_rows(field.array, field.readings)[1], ground), sources=truth)
    everywhere = SourceBounds(np.full(3, -np.inf), np.full(3, np.inf), np.inf)
    significance, bound = np.zeros(len(truth)), np.zeros(len(truth))
    for number, tile in enumerate(tiled.tiles):
        piece, inside_m = tiled.piece(number), tile.inside_m(truth.position_m)
        held = tile.contains(truth.position_m)
        if not (inside_m > 0.0).any():
            continue
        model = piece.model()
        background = model.background(piece.known, piece.groups(model.record, AT_LAST * model.nearest_m))
        fit = fit_jointly(model.record, background, piece.known, everywhere, most=0)
        own = inside_m[held] > 0.0
        significance[inside_m > 0.0] = fit.significance[own]
        squares = np.diagonal(fit.covariance).reshape(-1, 6)[:, :3]
        bound[inside_m > 0.0] = np.sqrt(squares.sum(axis=1))[own]
    return significance, bound


def holds(pair: Pair) -> bool:
    """Whether the 95 % ellipsoid holds the truth."""
    return bool(pair.error_m @ np.linalg.solve(pair.covariance, pair.error_m) < chdtri(3, 0.05))
