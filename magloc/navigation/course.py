"""Course over ground, as the attitude of an array that is carried forward."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from arrays.array import SensorArray
from arrays.columns import POSITION_COLUMNS, ROTATION_COLUMNS, LogColumns
from arrays.io.csv import Table
from arrays.logs.places import array_origins
from arrays.typing import FloatArray

_LOG = logging.getLogger(__name__)
APART_M = 0.05
"""Distance of sensors on the map below which a wrong heading matters no more than errors of places."""
CHORD_M = 2.0
"""Length over which the course is measured."""


def chords(xy_m: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return the way (n,) [m], the chords (n, 2) that end and that begin at each row, and their length [m].

    At the ends the chord is shorter, because there is no path beyond them. Without motion all are zero.
    """
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy_m, axis=0), axis=1))])
    chord = float(min(CHORD_M, way[-1] / 10.0))
    if not chord > 0.0:
        return way, np.zeros_like(xy_m), np.zeros_like(xy_m), 0.0
    way += np.arange(len(way)) * 1e-9 * chord  # rows at rest: interpolation needs increasing abscissae
    before, here, after = (
        np.stack([np.interp(way + shift, way, axis) for axis in xy_m.T], axis=-1) for shift in (-chord, 0.0, chord)
    )
    return way, here - before, after - here, chord


def turned_to_course(table: Table, array: SensorArray, columns: LogColumns) -> Table:
    """Return the table of a log with attitudes whose x axis points along the course, and whose z axis points up.

    Positions of an antenna become those of the array. Logs without `course` stay as they are; a warning names those
    whose sensors are apart on the map but have no attitude.
    """
    if not columns.course:
        apart_m = float(np.ptp(array.positions[:, :2], axis=0).max())
        attitudes = table.values[:, [i for i, name in enumerate(table.header) if name in ROTATION_COLUMNS]]
        if columns.is_placed and apart_m > APART_M and (attitudes == [0.0, 0.0, 0.0, 1.0]).all():
            _LOG.warning(
                f"{table.path}: found no attitude for sensors that are up to {apart_m:.2g} m apart on the map; x of the"
                " array counts as east. State angles in the table columns, or course = true if x is ahead"
            )
        return table
    at = [table.header.index(name) for name in POSITION_COLUMNS[:2]]
    _, back, forth, _ = chords(table.values[:, at])
    ahead = back + forth
    half = 0.5 * np.arctan2(ahead[:, 1], ahead[:, 0])
    zero = np.zeros(len(half))
    turns = np.stack([zero, zero, np.sin(half), np.cos(half)], axis=1)
    values = table.values.copy()
    values[:, [table.header.index(name) for name in ROTATION_COLUMNS]] = turns
    at = [table.header.index(name) for name in POSITION_COLUMNS]
    values[:, at] = array_origins(values[:, at], turns, columns)
    return replace(table, values=values)
