"""Lag between readings and poses of a field log, from opposite lines and its strongest anomaly."""

from __future__ import annotations

import logging
import math

import numpy as np

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.grids.work import workers
from magloc.navigation.crossovers import ClockShift
from magloc.readings import Readings
from magloc.surveying.clock import ClockLag, lag_of_lines
from magloc.surveying.piece import Ground, strongest_sources
from magloc.surveying.preparation import FASTEST_M_S, FEWEST_ROWS
from magloc.surveying.survey import tile_rows

_LOG = logging.getLogger(__name__)
_HEIGHTS, _SPACINGS = 10.0, 3.0  # half width of the area from which the lag is estimated
_MOST_ROWS = 10_000


def clock_lag(
    array: SensorArray,
    rows: Readings,
    variations_T: FloatArray,
    ground: Ground,
    spacing_m: float,
    clock: ClockShift | None,
) -> ClockLag | None:
    """Return the lag of rows with variations (n,) of the field; None if neither targets nor lines show one.

    The targets are those around the strongest anomaly.
    """
    lines = lag_of_lines(clock)
    without_targets = lines if math.isfinite(lines.sigma_s) else None
    known = rows.ambient_T is not None or array.ambient_T is not None
    if len(rows) < FEWEST_ROWS or not (known or not array.channel_is_scalar.any()):
        return without_targets
    assert rows.array_position_m is not None
    speed_m_s = np.linalg.norm(np.diff(rows.array_position_m, axis=0), axis=1) / np.diff(rows.time_s)
    if (fastest := float(speed_m_s.max())) > FASTEST_M_S:
        _LOG.warning(
            f"the lag is not estimated: found places that move at up to {fastest:.2g} m/s, expected {FASTEST_M_S:g} m/s"
            " at most; check times, units and spikes of the places"
        )
        return None
    middle = rows.array_position_m[np.argmax(np.abs(variations_T - np.median(variations_T)))]
    height_m = float(np.median(-ground.terrain.depth_of(rows.array_position_m)))
    half_m = max(_HEIGHTS * height_m, _SPACINGS * spacing_m)
    apart_m = np.abs(rows.array_position_m - middle)[:, :2].max(axis=1)
    nearest = np.argsort(apart_m)[:_MOST_ROWS]
    near = rows[np.sort(nearest[apart_m[nearest] < half_m])]
    if len(near) < FEWEST_ROWS:
        return without_targets
    tiled = tile_rows(array, near, ground)
    with workers(1, None, None) as each:
        tiled, _ = tiled.settle(strongest_sources, each, lambda _: None)
    if not len(tiled.sources):
        return without_targets
    return tiled.correct_lag(array.pose is None and rows.pose_sigma is None, lines)[1]
