"""What is known of several sources at one instant, as a table for people, and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from arrays.io.tables import aligned
from arrays.typing import FloatArray
from magloc.localization.fit.table import cells_of_strength, cells_of_vector
from magloc.tracking.files import json_entry
from magloc.tracking.results import TrackPoint

_HEADER = ["time_s", "id", "x_m", "y_m", "z_m", "s_x_m", "s_y_m", "s_z_m", "m_Am2", "s_m", "status"]
_KEYS = ("id", "position_m", "moment_Am2", "covariance", "weight", "merged", "range_observable")


@dataclass(frozen=True, eq=False)
class SourcePoint(TrackPoint):
    """One of several sources at one instant.

    Attributes
    ----------
    id : int
        The same in all rows.
    merged : bool
        Whether it is so near to another that their gap is less certain than a third of it: which is which is then a
        guess, and so are the places.
    """

    position_m: FloatArray
    moment_Am2: FloatArray
    covariance: FloatArray
    id: int = 0
    merged: bool = False


@dataclass(frozen=True, eq=False)
class SourcesPoint:
    """All sources at one instant.

    Attributes
    ----------
    time_s : float
    tracks : tuple of SourcePoint
        In the order of their ids.
    status : str
        "tracked", "no source", "no readings", "misfit": no sources, losses and faults explain the readings, and the
        tracks are predictions; or "doubtful": χ² of the last rows together is beyond noise, and what is wrong is being
        looked for.
    chi2 : float
        Of the row given its prediction.
    dof : int
        Number of its readings.
    dropped_sensors : tuple of str
        Sensors that are left out.
    """

    time_s: float
    tracks: tuple[SourcePoint, ...]
    status: str
    chi2: float
    dof: int
    dropped_sensors: tuple[str, ...] = ()


def lines_of_sources(points: Sequence[SourcesPoint], *, most: int | None = None) -> list[str]:
    """Aligned lines: a header, then one for every source in every row, or in the first and last ones of `most` rows."""
    shown = list(points)
    if most is not None and len(shown) > most:
        shown = shown[: most // 2] + shown[-(most // 2) :]
    rows = [_HEADER]
    for point in shown:
        faults = "".join(f", without {name}" for name in point.dropped_sensors)
        if not point.tracks:
            rows.append([f"{point.time_s:.10g}", *["-"] * 9, point.status + faults])
        for track in point.tracks:
            rows.append(
                [
                    f"{point.time_s:.10g}",
                    str(track.id),
                    *cells_of_vector(track.position_m, np.sqrt(np.diagonal(track.covariance)[:3])),
                    *cells_of_strength(track.moment_Am2, track.covariance[3:6, 3:6]),
                    ", ".join([point.status, *(["merged"] if track.merged else [])]) + faults,
                ]
            )
    return aligned(rows)


def json_of_sources(point: SourcesPoint, *, single: bool) -> dict[str, object]:
    """What ``--json`` and ``--jsonl`` print of one row; of a `single` source the keys of one track stand there too."""
    entry: dict[str, object] = {}
    if single and point.tracks:
        entry = json_entry(point.tracks[0])
    return entry | {
        "time_s": point.time_s,
        "status": point.status,
        "chi2": point.chi2,
        "dof": point.dof,
        "dropped_sensors": point.dropped_sensors,
        "tracks": [
            {key: getattr(track, key) for key in _KEYS} | {"range_interval95_m": track.range_interval_m}
            for track in point.tracks
        ],
    }
