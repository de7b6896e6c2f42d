"""Reader of the results that the viewer shows, complete before a page opens.

A path can be an array (``.toml``), readings or a truth (``.csv``, by their columns), a track (``.json`` or ``.jsonl``
of ``magloc track``), or a map (the folder of ``magloc map``, or its ``map.zarr``).
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.array_file import array_of_table, read_sensors
from arrays.io.csv import read_table
from arrays.io.errors import InputError
from arrays.typing import FloatArray
from magloc.readings import Readings, read_readings
from magloc.tracking.files import read_track
from magloc.tracking.results import TrackPoint, TrackResult
from magloc.truth import Truth, read_truth

if TYPE_CHECKING:
    import xarray as xr

KINDS = (
    "an array (.toml), readings or a truth (.csv), a track of `magloc track` (.json, .jsonl), or the folder of a map"
)
_STORE = "map.zarr"
_MOST_POINTS = 64  # along an axis of a map: more would not be distinguishable


@dataclass(frozen=True, eq=False)
class ReadingsResult:
    """Readings with at least one value, and their array."""

    readings: Readings
    array: SensorArray
    array_path: Path


@dataclass(frozen=True, eq=False)
class MapResult:
    """Map over starts or sources.

    Attributes
    ----------
    axis_m : ndarray, shape (n,)
        Coordinates of the cube, the same along x, y and z [m].
    values : ndarray, shape (n, n, n)
        Values to draw, NaN where there are none.
    failed : ndarray of bool, shape (n, n, n)
        Points without convergence, or whose source was not found.
    over : {"starts", "sources"}
    quantity : str
        Quantity of the values, with its unit.
    logarithmic : bool
        Whether the scale of the values is logarithmic.
    array : SensorArray
    source_m, moment_Am2 : ndarray, shape (3,), optional
        Source of a map over starts.
    title : str
    every : int
        Step of the drawn points along an axis of the map.
    """

    axis_m: FloatArray
    values: FloatArray
    failed: NDArray[np.bool_]
    over: str
    quantity: str
    logarithmic: bool
    array: SensorArray
    source_m: FloatArray | None
    moment_Am2: FloatArray | None
    title: str
    every: int


Result = SensorArray | ReadingsResult | TrackResult | MapResult


def read_result(path: Path, array_path: Path | None = None) -> Result:
    """Read the result at a path; the array of readings is by default the one beside them."""
    if path.is_dir():
        return _read_map(path)
    suffix = path.suffix.lower()
    if not path.exists() and suffix in (".toml", ".csv", ".json", ".jsonl", ""):
        raise InputError(f"{path} does not exist, expected {KINDS}.")
    if suffix == ".toml":
        return read_sensors(path)
    if suffix == ".csv":
        return _read_csv(path, array_path)
    if suffix in (".json", ".jsonl"):
        return read_track(path)
    raise InputError(f"{path}: found a file of an unknown kind, expected {KINDS}.")


def read_rows(path: Path, array_path: Path | None) -> ReadingsResult:
    """Read a readings file with its array, by default the one beside it."""
    array_path = _array_beside(path) if array_path is None else array_path
    array = read_sensors(array_path)
    readings = read_readings(path, array)
    if not np.isfinite(readings.values_T).any():
        raise InputError(f"{path}: found no reading in any row, expected at least one.")
    return ReadingsResult(readings, array, array_path)


def _read_csv(path: Path, array_path: Path | None) -> ReadingsResult | TrackResult:
    header = read_table(path, "a header with time_s and the sensors' columns").header
    if "x_m" in header and "y_m" in header:
        return track_of_truth(read_truth(path))
    if not any(name.endswith("_nT") for name in header):
        raise InputError(
            f"{path}: found neither readings (columns in nT) nor a truth (columns x_m, y_m), expected {KINDS}."
        )
    return read_rows(path, array_path)


def _array_beside(path: Path) -> Path:
    for candidate in (path.with_name(f"{path.stem}-array.toml"), path.with_name("array.toml")):
        if candidate.is_file():
            return candidate
    raise InputError(
        f"{path}: found no array beside the readings ({path.stem}-array.toml or array.toml), expected one, or --array."
    )


def track_of_truth(truth: Truth) -> TrackResult:
    """Return the true path in the order of time."""
    position = np.where(np.isfinite(truth.position_m), truth.position_m, 0.0)  # a truth without z is in the plane z = 0
    moments = [None] * len(position) if truth.moment_Am2 is None else list(truth.moment_Am2)
    order = np.argsort(truth.time_s, kind="stable")
    points = (
        TrackPoint(float(truth.time_s[i]), position_m=position[i], moment_Am2=moments[i], status="truth") for i in order
    )
    return TrackResult(tuple(points), is_truth=True)


def _read_map(folder: Path) -> MapResult:
    store = folder / _STORE if (folder / _STORE).is_dir() else folder
    if not (store / "zarr.json").is_file():
        found = "an empty folder" if not any(folder.iterdir()) else "a folder without a map"
        raise InputError(f"{folder}: found {found}, expected one that `magloc map` wrote, with {_STORE}.")
    from magloc.grids.store import UNREADABLE, open_map

    try:
        dataset = open_map(store)
    except InputError:
        raise
    except UNREADABLE:
        raise _map_error(store) from None
    return map_result(dataset, str(folder))


def _map_error(name: str | Path) -> InputError:
    return InputError(f"{name}: found something else than a map, expected one that `magloc map` wrote.")


def map_result(dataset: xr.Dataset, name: str = "Input result") -> MapResult:
    """Return a map with a bounded number of points; ``name`` is for errors."""
    from magloc.grids.store import UNREADABLE

    try:
        return _thin_map(dataset, name)
    except InputError:
        raise
    except UNREADABLE:
        raise _map_error(name) from None


def _thin_map(dataset: xr.Dataset, name: str) -> MapResult:
    axis = dataset["x"].to_numpy().astype(np.float64)
    if not (np.isfinite(axis).all() and (np.diff(axis) > 0.0).all()):
        raise InputError(f"{name}: found an axis that does not increase, expected the map as it was written.")
    every = max(1, math.ceil(len(axis) / _MOST_POINTS))
    part = dataset.isel(x=slice(None, None, every), y=slice(None, None, every), z=slice(None, None, every))
    over = "starts" if "half" in dataset else "sources"
    status = part["status"].to_numpy()
    shown = part["iterations" if over == "starts" else "sigma_range"].to_numpy().astype(np.float64)
    attributes = dataset.attrs
    array = array_of_table(name, tomllib.loads(attributes["array"], parse_float=Decimal))
    # Points that have not been computed yet have the smallest integer.
    done = status >= 0
    if not done.any():
        raise InputError(f"{name}: found a map without computed points, expected one with some.")
    if over == "starts":
        values = np.where(status == 0, shown, np.nan)
        failed = done & (status != 0)
        quantity = "passes until convergence"
        title = f"Convergence of '{attributes['method']}'"
    else:
        values = np.where(np.isfinite(shown) & done & (status != 3) & (shown > 0.0), shown, np.nan)
        failed = (status == 1) | (status == 2)
        quantity = "bound of the range's standard deviation (Cramér-Rao) [m]"
        title = f"Fixes of sources of {float(attributes['moment_magnitude_Am2']):g} A·m²"
    return MapResult(
        axis[::every],
        values,
        failed,
        over,
        quantity,
        over == "sources",
        array,
        np.atleast_1d(attributes["position_m"]).astype(np.float64) if over == "starts" else None,
        np.atleast_1d(attributes["moment_Am2"]).astype(np.float64) if over == "starts" else None,
        title,
        every,
    )
