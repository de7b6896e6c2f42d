"""Tracks as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from magloc.tracking.consistency import Consistency
    from magloc.tracking.results import TrackPoint


def track_table(points: Sequence[TrackPoint]) -> list[str]:
    """Aligned lines: a header, then one for every row."""
    header = ["time_s", "x_m", "y_m", "z_m", "s_x_m", "s_y_m", "s_z_m", "m_Am2", "nis", "status"]
    rows = [header]
    for point in points:
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
    return [
        "  ".join([*(cell.rjust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in rows
    ]


def report(result: Consistency) -> list[str]:
    """Errors against the truth, and what they should be."""
    lines = [
        f"against the truth, {result.tracked_rows} of {result.rows} rows tracked:",
        f"  position rms {result.position_rms_m:.4g} m",
    ]
    if np.isfinite(result.position_bound_m):
        ratio = result.position_rms_m / result.position_bound_m
        lines[-1] += (
            f", least possible {result.position_bound_m:.4g} m on average over such motions (posterior Cramér-Rao"
            f" bound), ratio {ratio:.2f}"
        )
    for name, value, (low, high) in (
        ("NEES", result.nees_per_dimension, result.nees_bounds),
        ("NIS", result.nis_per_dimension, result.nis_bounds),
    ):
        lines.append(f"  {name} per dimension {value:.3f}, 99 % bounds for independent rows {low:.3f} to {high:.3f}")
    return lines
