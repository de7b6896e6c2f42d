"""Tracks of several sources as a table for people, and as JSON."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magloc.localization.fit.table import cells_of_strength
from magloc.tracking.files import json_entry
from magloc.tracking.multi_target.results import SourcesPoint

_HEADER = ["time_s", "id", "x_m", "y_m", "z_m", "s_x_m", "s_y_m", "s_z_m", "m_Am2", "s_m", "status"]
_KEYS = ("id", "position_m", "moment_Am2", "covariance", "weight", "merged", "range_observable")


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
                    *(f"{value:.4f}" for value in track.position_m),
                    *(f"{value:.2g}" for value in np.sqrt(np.diagonal(track.covariance)[:3])),
                    *cells_of_strength(track.moment_Am2, track.covariance[3:6, 3:6]),
                    ", ".join([point.status, *(["merged"] if track.merged else [])]) + faults,
                ]
            )
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADER) - 1)]
    return [
        "  ".join([*(cell.rjust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in rows
    ]


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
