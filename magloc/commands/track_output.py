"""What a track looks like: JSON, table, GeoJSON, picture, and the report of its consistency."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from arrays.errors import InputError
from magloc.consistency import Consistency
from magloc.readings import SAME_TIME_S, Readings, Truth
from magloc.track_rows import TrackPoint

if TYPE_CHECKING:
    from magloc.commands.common import Vector

FloatArray = NDArray[np.float64]

_RIVAL_KEYS = ("position_m", "moment_Am2", "chi2", "dof", "weight")
# Of the truth's usual interval: over a longer one it is not interpolated.
_LONGEST_STEP = 2.0


def json_entry(point: TrackPoint) -> dict[str, object]:
    """What ``--json`` and ``--jsonl`` print of one row; null where the source is not tracked.

    What is said of the range is then that of the row alone, and its solutions are the rivals.
    """
    tracked = point.position_m is not None
    return {
        "time_s": point.time_s,
        "position_m": point.position_m,
        "moment_Am2": point.moment_Am2,
        "covariance": point.covariance,
        "estimability": point.estimability,
        "iterations": point.iterations if tracked else None,
        "nis": point.nis,
        "nis_dof": point.nis_dof,
        "status": point.status,
        "range_observable": point.range_observable,
        "range_interval95_m": point.range_interval95_m,
        "gaussian": point.gaussian if tracked else None,
        "weight": point.weight,
        "rivals": [{key: getattr(rival, key) for key in _RIVAL_KEYS} for rival in point.rivals],
    }


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


def truth_of_rows(readings: Readings, truth: Truth, path: Path) -> tuple[FloatArray, FloatArray | None]:
    """True position, and moment if it is known, of every row (n, 3); NaN where the truth says nothing of that time.

    Between two rows of the truth, as the mean time of a window may be, it is interpolated, but not over a gap.
    """
    order = np.argsort(truth.time_s, kind="stable")
    times, wanted = truth.time_s[order], readings.time_s
    after = np.clip(np.searchsorted(times, wanted - SAME_TIME_S), 0, len(times) - 1)
    exact = np.abs(times[after] - wanted) <= SAME_TIME_S
    before = np.where(exact, after, np.maximum(after - 1, 0))
    length = times[after] - times[before]
    longest = _LONGEST_STEP * float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    known = exact | ((times[before] <= wanted) & (wanted <= times[after]) & (length <= longest))
    if not known.any():
        raise InputError(f"{path}: found none of the times of the readings, expected rows with the same time_s.")
    share = np.divide(wanted - times[before], length, out=np.zeros_like(wanted), where=length > 0.0)[:, None]

    def of_rows(values: FloatArray) -> FloatArray:
        values = values[order]
        between = values[before] + share * (values[after] - values[before])
        return np.asarray(np.where(known[:, None], between, np.nan))

    return of_rows(truth.position_m), None if truth.moment_Am2 is None else of_rows(truth.moment_Am2)


def geojson_text(points: Sequence[TrackPoint], origin: Vector) -> str:
    """A GeoJSON feature collection: the track as a line for every unbroken part, and every row as a point.

    Parameters
    ----------
    points : sequence of TrackPoint
        In east, north, up from the origin [m].
    origin : tuple of 3 floats
        Latitude, longitude [deg] and height [m] of the origin.

    Returns
    -------
    str
        Coordinates are longitude, latitude [deg] and height above the ellipsoid [m], as RFC 7946 has them.
    """
    from pymap3d import enu2geodetic

    features: list[dict[str, object]] = []
    line: list[list[float]] = []
    lines: list[list[list[float]]] = []
    for point in points:
        if point.position_m is None or point.covariance is None:
            line = []
            continue
        latitude, longitude, height = enu2geodetic(*point.position_m.tolist(), *origin)
        place = [float(longitude), float(latitude), float(height)]
        if not line:
            line = []
            lines.append(line)
        line.append(place)
        deviations = np.sqrt(np.diagonal(point.covariance)[:3])
        features.append(
            {
                "type": "Feature",
                "geometry": {"type": "Point", "coordinates": place},
                "properties": {
                    "time_s": point.time_s,
                    "sigma_east_m": float(deviations[0]),
                    "sigma_north_m": float(deviations[1]),
                    "sigma_up_m": float(deviations[2]),
                    "moment_Am2": None if point.moment_Am2 is None else point.moment_Am2.tolist(),
                    "status": point.status,
                },
            }
        )
    for part in lines:
        if len(part) > 1:
            geometry = {"type": "LineString", "coordinates": part}
            features.insert(0, {"type": "Feature", "geometry": geometry, "properties": {"name": "track"}})
    return json.dumps({"type": "FeatureCollection", "features": features}, allow_nan=False) + "\n"
