"""Files of a survey's targets: JSON, CSV, GeoJSON and KML."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.csv import Column
from arrays.io.world_maps import feature, feature_collection, kml, placemark, world_place
from arrays.typing import Vector
from magloc.truth import TRUE_POSITION_COLUMNS, state_columns

if TYPE_CHECKING:
    from magloc.surveying.results import Survey


def json_of_survey(found: Survey) -> dict[str, Any]:
    """What ``magloc survey --json`` prints."""
    targets = [
        {
            "id": target.id,
            "position_m": target.position_m.tolist(),
            "moment_Am2": target.moment_Am2.tolist(),
            "covariance": target.covariance.tolist(),
            "depth_m": target.depth_m,
            "depth_interval95_m": list(target.depth_interval95_m),
            "ellipse95_m": list(target.ellipse95[:2]),
            "ellipse95_bearing_deg": target.ellipse95[2],
            "iron_kg": list(target.iron_kg),
            "significance": target.significance,
            "flags": list(target.flags),
        }
        for target in found
    ]
    return {
        "targets": targets,
        "rows": len(found.rows.time_s),
        "seconds": found.seconds,
        "threshold": found.threshold,
        "chi2_per_dof": found.chi2_per_dof,
        "pose_assumed": found.pose_assumed,
        "lag_s": found.lag_s,
    }


def columns_of_survey(found: Survey) -> dict[str, Column]:
    """Columns of ``targets.csv``."""
    covariance = np.array([t.covariance for t in found]).reshape(-1, 6, 6)
    moment = np.array([t.moment_Am2 for t in found]).reshape(-1, 3)
    low, high = np.array([t.depth_interval95_m for t in found]).reshape(-1, 2).T
    columns: dict[str, Column] = {"id": [t.id for t in found]}
    columns |= state_columns(found.position_m, moment, covariance)
    columns |= {"depth_m": np.array([t.depth_m for t in found]), "depth_low_m": low, "depth_high_m": high}
    columns |= {"strength_Am2": np.array([t.strength_Am2 for t in found])}
    columns |= {"significance": np.array([t.significance for t in found])}
    columns["flags"] = [" ".join(t.flags) for t in found]
    return columns


def residual_columns(found: Survey) -> dict[str, Column]:
    """Columns of ``residual.csv``: every row's anomaly, and what the targets leave of it."""
    rows = found.rows
    columns: dict[str, Column] = {"time_s": rows.time_s}
    columns |= dict(zip(TRUE_POSITION_COLUMNS, rows.place_m.T, strict=True))
    columns["anomaly_nT"] = 1e9 * rows.anomaly_T
    columns["residual_nT"] = 1e9 * rows.residual_T
    return columns


def reach_columns(found: Survey) -> dict[str, Column]:
    """Columns of ``reach.csv``: places, and the least moment that is seen there."""
    x, y, z = found.reach.place_m.T
    return {"x_m": x, "y_m": y, "depth_m": found.ground_m - z, "moment_Am2": found.reach.moment_Am2}


def geojson_of_survey(found: Survey, origin: Vector) -> dict[str, Any]:
    """:meth:`magloc.surveying.results.Survey.to_geojson`."""
    entries = json_of_survey(found)["targets"]
    return feature_collection(
        feature("Point", world_place(target.position_m, origin), entry)
        for target, entry in zip(found, entries, strict=True)
    )


def kml_of_survey(found: Survey, origin: Vector) -> str:
    """:meth:`magloc.surveying.results.Survey.to_kml`."""
    places = ((target, [world_place(target.position_m, origin)]) for target in found)
    return kml(placemark(target.id, target.in_words, place) for target, place in places)
