"""Tracks in JSON and GeoJSON."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from arrays.io.errors import InputError
from arrays.io.text import read_text
from arrays.typing import FloatArray, Vector
from magloc.tracking.consistency import Consistency
from magloc.tracking.results import TrackPoint, TrackResult

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


def json_of_track(points: Sequence[TrackPoint], consistency: Consistency | None) -> dict[str, object]:
    """What ``magloc track --json`` prints."""
    entries: dict[str, object] = {"results": [json_entry(point) for point in points]}
    if consistency is not None:
        entries["consistency"] = {key: getattr(consistency, key) for key in _CONSISTENCY_KEYS}
    return entries


def geojson_of_track(points: Sequence[TrackPoint], origin: Vector) -> dict[str, Any]:
    """:meth:`magloc.tracking.track.Track.to_geojson`."""
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
    time_s = entry.get("time_s")
    if not isinstance(time_s, int | float):
        raise InputError(f"{place}, key time_s: found {time_s!r}, expected a number.")
    nis = entry.get("nis")
    return TrackPoint(
        float(time_s),
        _numbers(place, entry, "position_m", (3,)),
        _numbers(place, entry, "moment_Am2", (3,)),
        _numbers(place, entry, "covariance", (6, 6)),
        nis=math.nan if nis is None else float(nis),
        nis_dof=int(entry.get("nis_dof") or 0),
        status=str(entry.get("status", "")),
    )


def _numbers(place: str, entry: dict[str, Any], key: str, shape: tuple[int, ...]) -> FloatArray | None:
    """Numbers of an entry; None where the key is missing or null."""
    value = entry.get(key)
    if value is None:
        return None
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        size = "×".join(map(str, shape))
        raise InputError(f"{place}, key {key}: found something else, expected {size} numbers or null.")
    return numbers
