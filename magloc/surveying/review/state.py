"""State of a survey after its search: all rows and sources, from which the targets are measured."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from arrays.typing import FloatArray
from magloc.grids.work import Arrays, Each
from magloc.surveying.piece import ROW_ENTRIES, measure_targets
from magloc.surveying.results import Reach, Survey, SurveyRows, Target
from magloc.surveying.targets import TARGET_ENTRIES
from magloc.surveying.tiled import Tell, TiledSurvey
from magloc.surveying.tiles import assign_sources

_LOG = logging.getLogger(__name__)
_MISFIT = 2.0
Names = Callable[[FloatArray], Sequence[str]]
"""Names of targets at positions (K, 3), the most significant one first; targets without a name are omitted."""


def numbered(position_m: FloatArray) -> list[str]:
    """Return the names t1, t2, … of targets."""
    return [f"t{number}" for number in range(1, len(position_m) + 1)]


@dataclass(frozen=True, eq=False)
class SurveyState:
    """Rows and sources of a survey after its search.

    Attributes
    ----------
    tiled : TiledSurvey
    pose_assumed : bool
        True if the pose errors are estimated from the rows.
    lag_s : float
        Delay of the readings, which is already corrected.
    """

    tiled: TiledSurvey
    pose_assumed: bool
    lag_s: float

    def measure(self, each: Each, tell: Tell, names: Names = numbered, *, keep_all: bool = False) -> Survey:
        """Fit the sources to all rows and return the survey.

        Parameters
        ----------
        each : callable
            Does the work on all tiles.
        tell : callable
            Called with a sentence after every tile.
        names : callable
        keep_all : bool
            Keep sources that are not significant, as a review decided.
        """
        began = time.monotonic()
        tiled = self.tiled.with_likeliest_pose() if self.pose_assumed else self.tiled
        results = tiled.map_tiles(partial(measure_targets, keep_all=keep_all), each, tell)
        chi2_per_dof = float(sum(result["chi2"] for result in results) / sum(result["size"] for result in results))
        if chi2_per_dof > _MISFIT:
            _LOG.warning(
                f"χ² per reading is {chi2_per_dof:.1f}: noise, errors of the pose or changes of the field are larger"
                " than stated, and so are the errors of the targets"
            )
        return Survey(
            _targets(tiled, results, names),
            tiled.array,
            _rows(tiled, results),
            Reach(*(np.concatenate([result[name] for result in results]) for name in ("reach_m", "reach_Am2"))),
            tiled.ground.terrain,
            tiled.ground.threshold,
            chi2_per_dof,
            self.pose_assumed,
            self.lag_s,
            time.monotonic() - began,
            tiled.readings.lines,
            self,
        )


def _targets(tiled: TiledSurvey, results: Sequence[Arrays], names: Names) -> tuple[Target, ...]:
    """Return the targets of all tiles, the most significant one first."""
    kept = assign_sources(tiled.tiles, [result["position_m"] for result in results], tiled.same_m)
    kept.sort(key=lambda where: -results[where[0]]["significance"][where[1]])
    ids = names(np.array([results[t]["position_m"][k] for t, k in kept]).reshape(-1, 3))
    targets = []
    for name, (t, k) in zip(ids, kept, strict=True):
        position, moment, covariance, interval, significance, flags = (results[t][entry][k] for entry in TARGET_ENTRIES)
        depth = float(tiled.ground.terrain.depth_of(position))
        chi2, words = float(significance), tuple(str(flags).split())
        interval95 = (float(interval[0]), float(interval[1]))
        if name:
            targets.append(Target(name, position, moment, covariance, depth, interval95, chi2, words))
    return tuple(targets)


def _rows(tiled: TiledSurvey, results: Sequence[Arrays]) -> SurveyRows:
    """Return the rows of all tiles in order of time."""
    which = np.concatenate([tile.rows[tile.own] for tile in tiled.tiles])
    order = np.argsort(which)
    place, anomaly, residual = (np.concatenate([result[name] for result in results])[order] for name in ROW_ENTRIES)
    return SurveyRows(tiled.readings.time_s[which[order]], place, anomaly, residual)
