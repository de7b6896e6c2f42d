"""Tracks as a table for people, and for other programs: JSON, GeoJSON, xarray."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from arrays.io.errors import LARGEST, InputError
from arrays.io.text import read_text
from arrays.typing import FloatArray, Vector
from magloc.tracking.consistency import Consistency
from magloc.tracking.results import TrackPoint, TrackResult

if TYPE_CHECKING:
    import xarray as xr

    from magloc.tracking.track import TrackColumns

_RIVAL_KEYS = ("position_m", "moment_Am2", "chi2", "dof", "weight")
_CONSISTENCY_KEYS = (
    "rows",
    "tracked_rows",
    "position_rms_m",
    "position_bound_m",
    "nees_per_dimension",
    "nees_bounds",
    "nis_per_dimension",
    "nis_bounds",
)

_COLUMNS = {
    "position_m": (("axis",), "m", "position of the source"),
    "moment_Am2": (("axis",), "A m2", "magnetic moment of the source"),
    "covariance": (("component", "component_"), "m, A m2", "covariance of (position, moment)"),
    "estimability": (("component",), "1", "what the readings taught: 1 - sigma / sigma without any of them"),
    "nis": ((), "1", "normalised innovation squared"),
    "nis_dof": ((), "1", "degrees of freedom of nis"),
    "weight": ((), "1", "probability that the track is the right one"),
    "tracked": ((), "1", "whether the source is tracked"),
    "status": ((), "1", "how the row was used, or why there is no track"),
}


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
        "range_interval95_m": point.range_interval_m,
        "gaussian": point.gaussian if tracked else None,
        "weight": point.weight,
        "rivals": [{key: getattr(rival, key) for key in _RIVAL_KEYS} for rival in point.rivals],
    }


def json_of_track(points: Sequence[TrackPoint], consistency: Consistency | None) -> dict[str, object]:
    """What ``magloc track --json`` prints."""
    entries: dict[str, object] = {"results": [json_entry(point) for point in points]}
    if consistency is not None:
        entries["consistency"] = {key: getattr(consistency, key) for key in _CONSISTENCY_KEYS}
    return entries


def geojson_of_track(points: Sequence[TrackPoint], origin: Vector) -> dict[str, Any]:
    """:meth:`magloc.tracking.track.TrackColumns.to_geojson`."""
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
    return {"type": "FeatureCollection", "features": features}


def dataset_of_track(track: TrackColumns) -> xr.Dataset:
    """:meth:`magloc.tracking.track.TrackColumns.to_xarray`."""
    import xarray as xr

    dataset = xr.Dataset(coords={"time_s": ("row", track.time_s), "axis": list("xyz")})
    for name, (dimensions, unit, words) in _COLUMNS.items():
        attributes = {"units": unit, "long_name": words}
        dataset[name] = (("row", *dimensions), np.asarray(getattr(track, name)), attributes)
    dataset["time_s"].attrs = {"units": "s", "long_name": "time"}
    dataset.attrs = {"frame": track.frame, "source": f"magloc {metadata.version('magloc')}, track"}
    return dataset


def _read_track(path: Path) -> TrackResult:
    text = read_text(path, "a track")
    try:
        if path.suffix.lower() == ".jsonl":
            entries: Any = [msgspec.json.decode(line) for line in text.splitlines() if line.strip()]
        else:
            entries = msgspec.json.decode(text)
            entries = entries.get("results") if isinstance(entries, dict) else entries
    except msgspec.DecodeError as error:
        raise InputError(f"{path}: found what is not JSON ({str(error).lower()}), expected a track.") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: found no list of results, expected what `magloc track --json` or --jsonl prints.")
    if any("solutions" in entry for entry in entries):
        raise InputError(
            f"{path}: found fixes of `magloc locate`, expected a track; give its readings to see the fixes."
        )
    points = tuple(_track_point(f"{path}, result {i}", entry) for i, entry in enumerate(entries, start=1))
    if not any(point.position_m is not None for point in points):
        raise InputError(f"{path}: found no row where the source is tracked, expected one at least.")
    return TrackResult(points, is_truth=False)


def _track_point(place: str, entry: dict[str, Any]) -> TrackPoint:
    time_s, nis, nis_dof = (_number(place, entry, key) for key in ("time_s", "nis", "nis_dof"))
    if time_s is None:
        raise InputError(f"{place}, key time_s: found None, expected a number.")
    return TrackPoint(
        time_s,
        _numbers(place, entry, "position_m", (3,)),
        _numbers(place, entry, "moment_Am2", (3,)),
        _numbers(place, entry, "covariance", (6, 6)),
        nis=math.nan if nis is None else nis,
        nis_dof=int(nis_dof or 0),
        status=str(entry.get("status", "")),
    )


def _number(place: str, entry: dict[str, Any], key: str) -> float | None:
    """A number of an entry; None where the key is missing or null."""
    value = entry.get(key)
    if value is not None and not (isinstance(value, int | float) and abs(value) <= LARGEST):
        raise InputError(f"{place}, key {key}: found {value!r:.40}, expected a number.")
    return None if value is None else float(value)


def _numbers(place: str, entry: dict[str, Any], key: str, shape: tuple[int, ...]) -> FloatArray | None:
    """Numbers of an entry; None where the key is missing or null."""
    value = entry.get(key)
    if value is None:
        return None
    try:
        numbers = np.array(value, dtype=np.float64)
    except (OverflowError, TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != shape or not (np.abs(numbers) <= LARGEST).all():
        size = "×".join(map(str, shape))
        raise InputError(f"{place}, key {key}: found something else, expected {size} numbers or null.")
    return numbers
