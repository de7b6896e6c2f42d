"""Files of a survey: JSON and CSV."""

from __future__ import annotations

from typing import Any

from arrays.io.csv import Column
from magloc.surveying.results import Survey
from magloc.surveying.review.decisions import entry_of
from magloc.truth import TRUE_POSITION_COLUMNS


def json_of_survey(found: Survey) -> dict[str, Any]:
    """Return the JSON that ``magloc survey --json`` prints."""
    return {
        "targets": found.entries,
        "rows": len(found.rows.time_s),
        "seconds": found.seconds,
        "threshold": found.threshold,
        "chi2_per_dof": found.chi2_per_dof,
        "pose_assumed": found.pose_assumed,
        "lag_s": found.lag_s,
        **({"decisions": [entry_of(decision) for decision in found.decisions]} if found.decisions else {}),
    }


def residual_columns(found: Survey) -> dict[str, Column]:
    """Return the columns of ``residual.csv``: every row's anomaly and residual."""
    rows = found.rows
    columns: dict[str, Column] = {"time_s": rows.time_s}
    columns |= dict(zip(TRUE_POSITION_COLUMNS, rows.place_m.T, strict=True))
    columns["anomaly_nT"] = 1e9 * rows.anomaly_T
    columns["residual_nT"] = 1e9 * rows.residual_T
    return columns


def reach_columns(found: Survey) -> dict[str, Column]:
    """Return the columns of ``reach.csv``: places, and the least moment that is detected there."""
    x, y, _ = found.reach.place_m.T
    depth_m = found.terrain.depth_of(found.reach.place_m)
    return {"x_m": x, "y_m": y, "depth_m": depth_m, "moment_Am2": found.reach.moment_Am2}
