"""Tables, CSV, JSON, GeoJSON, KML and xarray of tracks of one source or several."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
import numpy as np
from scipy.special import chdtri

from arrays.io.closing import pause_garbage_collection
from arrays.io.csv import Column
from arrays.io.errors import LARGEST, InputError
from arrays.io.results import Quantity
from arrays.io.tables import align, by_sigma
from arrays.io.text import read_text
from arrays.io.world_maps import feature, feature_collection, kml, placemark, world_place
from arrays.typing import FloatArray, Vector
from magloc.chi_square import square_columns
from magloc.levels import FALSE_ALARM
from magloc.localization.fit.results import values_of
from magloc.localization.fit.table import cells_of_strength, cells_of_vector
from magloc.tracking.results import SourcePoint, SourcesPoint, TrackPoint, TrackResult, track_column
from magloc.truth import STATE_COLUMNS, STATE_QUANTITIES, state_columns

if TYPE_CHECKING:
    from magloc.tracking.consistency import Consistency

_SAME_PLACE_M = 1e-9
_RIVAL_KEYS = ("position_m", "moment_Am2", "chi2", "dof", "weight")
_STATE_KEYS, _RANGE_KEYS = ("position_m", "moment_Am2", "covariance"), ("range_observable", "range_interval95_m")
_FILTER_KEYS = ("estimability", "iterations", "nis", "nis_dof", "status", "dropped_sensors")
_POINT_KEYS = ("time_s", *_STATE_KEYS, *_FILTER_KEYS, *_RANGE_KEYS, "gaussian", "weight")
_ROW_KEYS = ("time_s", "status", "chi2", "dof", "dropped_sensors")
_SOURCE_KEYS = ("id", *_STATE_KEYS, "weight", "merged", *_RANGE_KEYS)

_Number = Annotated[float, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
_Three = Annotated[list[_Number], msgspec.Meta(min_length=3, max_length=3)]
_Six = Annotated[list[_Number], msgspec.Meta(min_length=6, max_length=6)]
_Matrix = Annotated[list[_Six], msgspec.Meta(min_length=6, max_length=6)]
_READ: dict[str, tuple[Any, str]] = {
    "time_s": (_Number, "a number"),
    **dict.fromkeys(("nis", "nis_dof"), (_Number | None, "a number")),
    **dict.fromkeys(("position_m", "moment_Am2"), (_Three | None, "3 numbers or null")),
    "covariance": (_Matrix | None, "6×6 numbers or null"),
    "dropped_sensors": (list[str] | None, "a list of names"),
}

QUANTITIES = STATE_QUANTITIES | {
    "estimability": Quantity("1", "estimability: 1 - sigma / sigma without any readings", ("component",)),
    "nis": Quantity("1", "normalised innovation squared"),
    "nis_dof": Quantity("1", "degrees of freedom of nis"),
    "weight": Quantity("1", "probability that the track is the right one"),
    "tracked": Quantity("1", "whether the source is tracked"),
    "status": Quantity("1", "how the row was used, or why there is no track"),
}
"""Variables of :meth:`magloc.tracking.track.TrackColumns.to_xarray`."""


def lines_of_track(points: Sequence[TrackPoint | SourcesPoint], *, most: int | None = None) -> list[str]:
    """Return aligned lines: a header and one for each source of at most `most` rows."""
    shown = list(points)
    if most is not None and len(shown) > most:
        shown = shown[: most // 2] + shown[-(most // 2) :]
    several = bool(shown) and isinstance(shown[0], SourcesPoint)
    header = ["x_m", "y_m", "z_m", "s_x_m", "s_y_m", "s_z_m", "m_Am2", "s_m"]
    rows = [["time_s", "id", *header, "status"] if several else ["time_s", *header, "nis", "status"]]
    middle = 0
    for i, row in enumerate(shown):
        middle = len(rows) if 2 * i == len(shown) else middle
        time, faults = f"{row.time_s:.10g}", "".join(f", without {name}" for name in row.dropped_sensors)
        if not row.tracks:
            rows.append([time, *["-"] * 9, row.status + faults])
        for point in row.tracks:
            assert point.position_m is not None
            assert point.moment_Am2 is not None
            assert point.covariance is not None
            cells = [
                *cells_of_vector(point.position_m, np.sqrt(np.diagonal(point.covariance)[:3])),
                *cells_of_strength(point.moment_Am2, point.covariance[3:, 3:]),
            ]
            if several:
                assert isinstance(point, SourcePoint)
                rows.append([time, str(point.id), *cells, row.status + ", merged" * point.merged + faults])
                continue
            unsure = "" if point.range_observable or point.centroid_m is None else ", range?"
            nis = f"{point.nis:.1f}/{point.nis_dof}" if np.isfinite(point.nis) else "-"
            rows.append([time, *cells, nis, row.status + faults + unsure])
    lines = align(rows)
    if len(shown) < len(points):
        lines.insert(middle, f"… {len(points)} rows")
    return lines


def json_entry(point: TrackPoint | SourcesPoint, *, single: bool = False) -> dict[str, object]:
    """Return the JSON object of one row, with null where there is no answer.

    Without a track, range and `rivals` come from the row alone. A row of several sources has a
    list of tracks; with `single`, for at most one source, the row has the keys of that source too.
    """
    if isinstance(point, SourcesPoint):
        entry = json_entry(point.tracks[0]) if single and point.tracks else {}
        return (
            entry | values_of(point, _ROW_KEYS) | {"tracks": [values_of(track, _SOURCE_KEYS) for track in point.tracks]}
        )
    entry = values_of(point, _POINT_KEYS) | {"rivals": [values_of(rival, _RIVAL_KEYS) for rival in point.rivals]}
    return entry if point.tracks else entry | {"iterations": None, "gaussian": None}


def states_of(points: Sequence[TrackPoint]) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return times, positions, moments and covariances of a track, NaN without a source."""
    return (
        track_column(points, "time_s"),
        track_column(points, "position_m", 3),
        track_column(points, "moment_Am2", 3),
        track_column(points, "covariance", 6, 6),
    )


def columns_of_track(
    points: Sequence[TrackPoint], array_m: FloatArray | None = None, *, ids: Sequence[int] | None = None
) -> dict[str, Column]:
    """Return the columns of the CSV file of one source or, with `ids`, of several.

    ``array_m`` (n, 3): origin of the array's frame in every row.
    """
    time, position, moment, covariance = states_of(points)
    columns: dict[str, Column] = {"time_s": time}
    if ids is not None:
        columns["id"] = np.array(ids, dtype=np.intp)
    columns |= state_columns(position, moment, covariance)
    if ids is None:
        nis, nis_dof = np.array([point.nis for point in points]), np.array([point.nis_dof for point in points])
        columns |= square_columns("nis", nis, nis_dof)
        components = (name.split("_")[0] for name in STATE_COLUMNS)
        estimability = track_column(points, "estimability", 6)
        columns |= dict(zip((f"estimability_{name}" for name in components), estimability.T, strict=True))
    if array_m is not None:
        columns |= dict(zip(("array_x_m", "array_y_m", "array_z_m"), array_m.T, strict=True))
    return columns | {"status": [point.status for point in points]}


def json_of_track(points: Sequence[TrackPoint], consistency: Consistency | None) -> dict[str, object]:
    """Return the JSON object of a track of one source."""
    entries: dict[str, object] = {"results": [json_entry(point) for point in points]}
    return entries if consistency is None else entries | {"consistency": consistency.json}


def geojson_of_track(points: Sequence[TrackPoint], origin: Vector) -> dict[str, Any]:
    """Return a track as GeoJSON, see :meth:`magloc.tracking.track.TrackColumns.to_geojson`."""
    lines, known = _on_the_map(points, origin)
    features = [feature("LineString", line, {"name": "track"}) for line in lines]
    return feature_collection([*features, *(_feature(point, origin) for _, point in known)])


def kml_of_track(points: Sequence[TrackPoint], origin: Vector) -> str:
    """Return a track as KML, see :meth:`magloc.tracking.track.TrackColumns.to_kml`."""
    lines, known = _on_the_map(points, origin)
    ends = known[:: max(1, len(known) - 1)]  # the first and the last
    tracks = [placemark("track", "", line) for line in lines]
    return kml([*tracks, *(_placemark(name, point, origin) for name, point in ends)])


def _on_the_map(
    points: Sequence[TrackPoint], origin: Vector
) -> tuple[list[list[list[float]]], list[tuple[str, TrackPoint]]]:
    """Return the unbroken lines of a track, and its points by name.

    A line has at least two rows, all with the source. A source at rest has no line, and only its best point.
    """
    rest = at_rest(points)
    if rest is not None:
        return [], [("source", rest)]
    lines: list[list[list[float]]] = [[]]
    known = []
    for point in points:
        if point.is_on_track and point.position_m is not None:
            lines[-1].append(world_place(point.position_m, origin))
            known.append((f"{point.time_s:.6g} s", point))
        else:
            lines.append([])
    return [line for line in lines if len(line) > 1], known


def at_rest(points: Sequence[TrackPoint]) -> TrackPoint | None:
    """Return the row of the best known position if the source is at rest, otherwise None.

    The source is at rest if χ² of each row's difference from the best one, with both covariances added, is below the
    0.999 quantile (3 degrees of freedom). Errors of neighbouring rows are correlated, so that true differences are even
    smaller. A single row gives None.
    """
    known = [point for point in points if point.is_on_track and point.covariance is not None]
    if len(known) < 2:
        return None
    position, covariance = track_column(known, "position_m", 3), track_column(known, "covariance", 6, 6)[:, :3, :3]
    best = int(np.argmin(np.trace(covariance, axis1=1, axis2=2)))
    # Known places have a covariance of zero: they are at rest if they are equal to a nanometre.
    both = covariance + covariance[best] + _SAME_PLACE_M**2 * np.eye(3)
    offset = position - position[best]
    chi2 = np.einsum("ni,ni->n", offset, np.linalg.solve(both, offset[..., None])[..., 0])
    return known[best] if (chi2 <= chdtri(3, FALSE_ALARM)).all() else None


def _feature(point: TrackPoint, origin: Vector) -> dict[str, Any]:
    """Return a row with a source as a GeoJSON point."""
    position, moment, sigma = _known(point)
    properties = {
        "time_s": point.time_s,
        "depth_m": -float(position[2]),
        **{f"sigma_{name}_m": float(s) for name, s in zip(("east", "north", "up"), sigma, strict=False)},
        "moment_Am2": moment.tolist(),
        "sigma_moment_Am2": sigma[3:].tolist(),
        "status": point.status,
    }
    return feature("Point", world_place(position, origin), properties)


def _placemark(name: str, point: TrackPoint, origin: Vector) -> str:
    """Return a row with a source as a KML placemark with a description."""
    position, moment, sigma = _known(point)
    depth = " ± ".join(by_sigma(-float(position[2]), float(sigma[2])))
    words = (
        f"{depth} m below the origin, ± {np.hypot(*sigma[:2]):.2g} m on the map (1 σ), "
        f"{np.linalg.norm(moment):.3g} A·m² at {point.time_s:.6g} s."
    )
    return placemark(name, words, [world_place(position, origin)])


def _known(point: TrackPoint) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return position, moment and standard deviations (6,) of a row with a source."""
    return np.asarray(point.position_m), np.asarray(point.moment_Am2), np.sqrt(np.diagonal(point.covariance))  # type: ignore[arg-type]


@pause_garbage_collection()
def read_track(path: Path) -> TrackResult:
    """Read a track from a file of ``magloc track --json`` or ``--jsonl``.

    Raises
    ------
    InputError
        The file is not a track.
    """
    text = read_text(path, "a track")
    try:
        entries: Any
        if path.suffix.lower() == ".jsonl":
            entries = [msgspec.json.decode(line) for line in text.splitlines() if line.strip()]
        else:
            entries = msgspec.json.decode(text)
            entries = entries.get("results") if isinstance(entries, dict) else entries
    except (msgspec.DecodeError, RecursionError) as error:
        fault = "nested too deeply" if isinstance(error, RecursionError) else str(error).lower()
        raise InputError(f"{path}: found what is not JSON ({fault}), expected a track.") from None
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InputError(f"{path}: found no list of results, expected what `magloc track --json` or --jsonl prints.")
    if any("solutions" in entry for entry in entries):
        raise InputError(
            f"{path}: found fixes of `magloc locate`, expected a track; give its readings to see the fixes."
        )
    tracks = _tracks(path, entries)
    if not any(point.is_on_track for track in tracks.values() for point in track):
        raise InputError(f"{path}: found no row where the source is tracked, expected one at least.")
    points, *others = tracks.values()
    return TrackResult(points, is_truth=False, ids=tuple(tracks) if others else (), others=tuple(others))


def _tracks(path: Path, entries: Sequence[dict[str, Any]]) -> dict[int, tuple[TrackPoint, ...]]:
    """Return the points of each source by its id; rows without the key tracks belong to source 0."""
    if not any("tracks" in entry for entry in entries):
        return {0: _points(path, entries)}
    own: list[dict[int, dict[str, Any]]] = []
    for i, entry in enumerate(entries, start=1):
        tracks = entry.get("tracks", [entry | {"id": 0}])
        if not isinstance(tracks, list) or not all(isinstance(t, dict) and type(t.get("id")) is int for t in tracks):
            raise InputError(f"{path}, result {i}, key tracks: found something else, expected objects with an id.")
        own.append({track["id"]: track for track in tracks})
    ids = sorted({id for of_id in own for id in of_id}) or [0]
    shared = ("time_s", "status", "dropped_sensors")
    rows = [{key: entry[key] for key in shared if key in entry} for entry in entries]
    return {id: _points(path, [row | of_id.get(id, {}) for row, of_id in zip(rows, own, strict=True)]) for id in ids}


def _points(path: Path, rows: Sequence[dict[str, Any]]) -> tuple[TrackPoint, ...]:
    """Return the points of a source."""
    times = _values_of(path, rows, "time_s")
    if back := next((i for i in range(1, len(times)) if times[i] < times[i - 1]), None):
        raise InputError(
            f"{path}, result {back + 1}, key time_s: found {times[back]:g} after {times[back - 1]:g}, expected times in"
            " order."
        )
    nis, nis_dof, names = (_values_of(path, rows, key) for key in ("nis", "nis_dof", "dropped_sensors"))
    positions, moments, covariances = (_arrays(_values_of(path, rows, key)) for key in _STATE_KEYS)
    for i, covariance in enumerate(covariances, start=1):
        if covariance is not None and covariance.diagonal().min() < 0.0:
            raise InputError(f"{path}, result {i}, key covariance: found a variance below zero, expected none.")
    columns = zip(times, positions, moments, covariances, nis, nis_dof, names, rows, strict=True)
    return tuple(
        TrackPoint(
            float(t),
            place,
            moment,
            C,
            nis=math.nan if value is None else float(value),
            nis_dof=int(dof or 0),
            status=str(row.get("status", "")),
            dropped_sensors=tuple(dropped or ()),
        )
        for t, place, moment, C, value, dof, dropped, row in columns
    )


def _values_of(path: Path, rows: Sequence[dict[str, Any]], key: str) -> list[Any]:
    """Return the values of a key in each row, None where it is missing or null."""
    kind, expected = _READ[key]
    values = [row.get(key) for row in rows]
    try:
        msgspec.convert(values, list[kind])  # type: ignore[valid-type]
    except msgspec.ValidationError as error:
        number = int(re.findall(r"\$\[(\d+)\]", str(error))[0])
        found = "something else" if expected.endswith("null") else f"{values[number]!r:.40}"
        raise InputError(f"{path}, result {number + 1}, key {key}: found {found}, expected {expected}.") from None
    return values


def _arrays(values: list[Any]) -> list[FloatArray | None]:
    """Return lists of numbers as arrays, by one conversion because single ones are slow."""
    known = [i for i, value in enumerate(values) if value is not None]
    arrays = iter(np.array([values[i] for i in known], dtype=np.float64))
    return [None if value is None else next(arrays) for value in values]
