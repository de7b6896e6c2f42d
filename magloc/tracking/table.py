"""Tracks as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from magloc.tracking.results import TrackPoint


def lines_of_track(points: Sequence[TrackPoint], *, most: int | None = None) -> list[str]:
    """Aligned lines: a header, then one for every row, or for the first and the last ones of `most`."""
    shown = list(points)
    if most is not None and len(shown) > most:
        shown = shown[: most // 2] + shown[-(most // 2) :]
    header = ["time_s", "x_m", "y_m", "z_m", "s_x_m", "s_y_m", "s_z_m", "m_Am2", "nis", "status"]
    rows = [header]
    for point in shown:
        if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
            rows.append([f"{point.time_s:.10g}", *["-"] * 8, point.status])
            continue
        deviations = np.sqrt(np.diagonal(point.covariance)[:3])
        rows.append(
            [
                f"{point.time_s:.10g}",
                *(f"{value:.3f}" for value in point.position_m),
                *(f"{value:.2g}" for value in deviations),
                f"{np.linalg.norm(point.moment_Am2):.4g}",
                f"{point.nis:.1f}/{point.nis_dof}" if np.isfinite(point.nis) else "-",
                point.status if point.range_observable or point.centroid_m is None else f"{point.status}, range?",
            ]
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(header) - 1)]
    lines = [
        "  ".join([*(cell.rjust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in rows
    ]
    if len(shown) < len(points):
        lines.insert(1 + len(shown) // 2, f"… {len(points)} rows")
    return lines
