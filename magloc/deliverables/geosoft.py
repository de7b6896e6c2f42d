"""Geosoft XYZ: the rows of a survey as text, line by line."""

from __future__ import annotations

import numpy as np

from magloc.deliverables.map_frame import MapFrame
from magloc.surveying.results import Survey


def geosoft_xyz(found: Survey, frame: MapFrame) -> str:
    """Return the text of a Geosoft XYZ file: coordinates of the map, height, time, anomaly and residual of each row."""
    rows = found.rows
    x, y = frame.project(rows.place_m).T
    height = frame.geodetic(rows.place_m)[:, 2]
    names = ("Longitude", "Latitude") if frame.is_geographic else ("X", "Y")
    digits = 9 if frame.is_geographic else 3
    text = [f"/ coordinates: {frame.label} ({frame.system.name})"]
    text.append(f"/{names[0]} {names[1]} Height_m Time_s Anomaly_nT Residual_nT")
    columns = np.column_stack([x, y, height, rows.time_s, 1e9 * rows.anomaly_T, 1e9 * rows.residual_T])
    form = f"%.{digits}f %.{digits}f %.3f %.3f %.3f %.3f"
    for line in found.flight_lines:
        text.append(f"Line {line.name}")
        text += [form % tuple(row) for row in columns[line.rows].tolist()]
    return "\n".join([*text, ""])
