"""Files of terrain: GeoTIFF and CSV; and the ground below the altimeter of a log."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.ndimage import median

from arrays.array import SensorArray
from arrays.io.csv import Table, read_table
from arrays.io.errors import InputError, of_extra
from arrays.io.text import read_text
from arrays.io.world_maps import place_in_words
from arrays.logs.format import LogFormat
from arrays.logs.systems import coordinate_system, transform_points
from arrays.typing import FloatArray, Vector
from magloc.readings import EXPECTED_HEADER, Readings, log_format
from magloc.terrain.surface import Terrain, interpolate_nodes, interpolate_points, point_spacing

if TYPE_CHECKING:
    import pyproj

_LOG = logging.getLogger(__name__)
_WGS84 = "EPSG:4326"
_EARTH_RADIUS_M = 6.371e6  # its local radii differ by 1 %: 2 mm of height at 1 km
_MARGIN_M = 20.0  # around the lines
_WIDE = 4.0  # further margin for points, in their spacings
_MOST_CHECKED = 20_000  # rows that must lie above the terrain
_ALIKE, _MOST_SLOPE = 0.7, 2.0  # correlation and ratio of altimeter and height in another unit
_ALTIMETER_CELL_M = 0.5  # readings of an altimeter in one cell become their median
_NO_DATA_M = 9999.0  # larger numbers stand for unknown heights, such as -9999 and -32768
_METRES = {None, "", "m", "metre", "meter", "metres", "meters"}
_AXES = {
    "local": ({"x", "x_m"}, {"y", "y_m"}),
    "grid": ({"easting", "easting_m", "east", "e"}, {"northing", "northing_m", "north", "n"}),
    "geographic": ({"lon", "longitude", "lng", "longitude_deg"}, {"lat", "latitude", "latitude_deg"}),
}
_HEIGHTS = {"height", "height_m", "z", "z_m", "elevation", "elevation_m", "altitude", "altitude_m"}
_EXPECTED = "x, y, height; easting, northing, height; or longitude, latitude, height"


def read_terrain(
    path: str | PathLike[str], places_m: FloatArray, *, origin: Vector | None = None, crs: str | None = None
) -> Terrain:
    r"""Read the ground below a survey from a file of heights.

    Heights refer to the same level as `origin`, such as the sea.

    Parameters
    ----------
    path : str or path-like
        GeoTIFF in any coordinate system, whose first band has heights [m]; or CSV with a point in every row: columns
        ``x, y, height`` in the world frame, ``easting, northing, height``, or ``longitude, latitude, height``.
    places_m : ndarray, shape (n, 2) or (n, 3)
        Places in the world frame that the terrain must cover: those of the sensors.
    origin : tuple of 3 floats, optional
        Latitude, longitude [deg] and height [m] of the origin of the world frame, which is east, north, up. Without it
        the file must be in the world frame.
    crs : str, optional
        Coordinate system of eastings and northings in a CSV file, such as "EPSG:32633".

    Returns
    -------
    Terrain
        Ground that covers the places.

    Raises
    ------
    InputError
        The file cannot be read, is in a system that needs an origin, or does not cover the places.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> from pathlib import Path
    >>> _ = Path("ground.csv").write_text("x,y,height\n-5,-5,0\n5,-5,0\n-5,5,1\n5,5,1\n")
    >>> magloc.read_terrain("ground.csv", np.array([[0.0, 0.0], [1.0, 2.0]])).height_at([[0.0, 0.0]]).round(3).tolist()
    [0.5]
    """
    xy_m = np.asarray(places_m, dtype=np.float64)[:, :2]
    low, high = xy_m.min(axis=0) - _MARGIN_M, xy_m.max(axis=0) + _MARGIN_M
    is_table = Path(path).suffix.lower() in (".csv", ".txt", ".xyz")
    heights, spacing_m = (_heights_of_table if is_table else _heights_of_raster)(str(path), low, high, origin, crs)
    _refuse_uncovered(str(path), heights, xy_m, origin)
    return Terrain.sample(heights, low, high, spacing_m, Path(path).name)


_Heights = tuple[Callable[[FloatArray], FloatArray], float]
"""Height at places (n, 2) of the world frame, NaN where unknown, and the spacing of the data."""


def _heights_of_table(path: str, low: FloatArray, high: FloatArray, origin: Vector | None, crs: str | None) -> _Heights:
    table = read_table(path, f"columns {_EXPECTED}", only=_named(path))
    kind, names = _kind_of(table)
    if kind == "grid" and crs is None:
        raise InputError(f"{path}: found eastings and northings for a log without crs, expected crs in [columns].")
    if kind != "local" and origin is None:
        found = f"{names[0]} and {names[1]} for lines in a frame without a place on the Earth"
        raise InputError(f"{path}: found {found}, expected x, y, height.")
    points = table.complete(names)
    points = points[np.abs(points[:, 2]) < _NO_DATA_M]
    system = None if kind == "local" else coordinate_system(_WGS84 if kind == "geographic" or crs is None else crs)
    on_map = _to_system(system, origin)
    near = on_map(_rectangle(low, high))
    margin = _WIDE * point_spacing(points[:, :2]) if len(points) > 1 else 0.0
    inside = (points[:, :2] >= near.min(axis=0) - margin) & (points[:, :2] <= near.max(axis=0) + margin)
    points = points[inside.all(axis=1)]
    try:
        of_points = interpolate_points(points)
    except ValueError:
        found = f"{len(points)} points near the lines" if len(points) < 3 else "points on one line"
        raise InputError(f"{path}: found {found}, expected terrain that covers all lines.") from None
    spacing_m = point_spacing(points[:, :2]) * _metres_per_unit(on_map, low, high)
    return (lambda xy_m: _in_world(of_points(on_map(xy_m)), xy_m, None if system is None else origin)), spacing_m


def _named(path: str) -> list[str]:
    """Return the names of columns with places or heights in the header of a file."""
    header = read_text(path, "a CSV file").partition("\n")[0]
    known = {name for kind in _AXES.values() for names in kind for name in names} | _HEIGHTS
    return [name for name in (cell.strip().strip('"') for cell in header.split(",")) if name.lower() in known]


def _kind_of(table: Table) -> tuple[str, tuple[str, str, str]]:
    """Return the kind of coordinates, and the columns of both and of the height."""
    for kind, axes in _AXES.items():
        found = [[name for name in table.header if name.lower() in wanted] for wanted in (*axes, _HEIGHTS)]
        if all(len(names) == 1 for names in found):
            return kind, (found[0][0], found[1][0], found[2][0])
    there = ", ".join(table.header) or "other columns"
    raise InputError(f"{table.path}: found {there}, expected columns {_EXPECTED}.")


def _heights_of_raster(path: str, low: FloatArray, high: FloatArray, origin: Vector | None, _: str | None) -> _Heights:
    with of_extra("gis", "terrain from a GeoTIFF"):
        import rasterio
    try:
        with rasterio.open(path) as file:
            return _heights_of_band(path, file, low, high, origin)
    except rasterio.errors.RasterioIOError:
        there = "found no raster that GDAL reads" if Path(path).is_file() else "does not exist"
        raise InputError(f"{path}: {there}, expected heights as GeoTIFF or CSV.") from None


def _heights_of_band(path: str, file: Any, low: FloatArray, high: FloatArray, origin: Vector | None) -> _Heights:
    """Return the heights of the first band of an open raster, near a rectangle."""
    import rasterio

    system = None if file.crs is None else coordinate_system(file.crs.to_wkt())
    of_system = [] if system is None else [axis.unit_name for axis in system.axis_info if axis.direction == "up"]
    for unit in (file.units[0], *of_system):
        if unit not in _METRES:
            raise InputError(f"{path}: found heights in {unit!r}, expected metres.")
    if (system is None) != (origin is None):
        found = "coordinates without a system" if system is None else f"coordinates of {system.name}"
        log = "known on the Earth" if system is None else "in a frame without a place on the Earth"
        raise InputError(f"{path}: found {found} for lines that are {log}, expected both in one frame.")
    on_map = _to_system(system, origin)
    pixels = _apply(~file.transform, on_map(_rectangle(low, high)))
    first = np.clip(np.floor(pixels.min(axis=1)) - 2.0, 0.0, [file.width, file.height])
    end = np.clip(np.ceil(pixels.max(axis=1)) + 2.0, 0.0, [file.width, file.height])
    (column, row), (n_columns, n_rows) = first.astype(int).tolist(), (end - first).astype(int).tolist()
    if min(n_columns, n_rows) < 1:
        _refuse_uncovered(path, lambda xy: np.full(len(xy), np.nan), 0.5 * (low + high)[None], origin)
    band = file.read(1, window=rasterio.windows.Window(column, row, n_columns, n_rows), masked=True)
    height_m = band.astype(np.float64).filled(np.nan) * file.scales[0] + file.offsets[0]
    of_nodes = interpolate_nodes(np.where(np.abs(height_m) < _NO_DATA_M, height_m, np.nan))
    to_pixel = ~file.transform

    def heights(xy_m: FloatArray) -> FloatArray:
        at = (_apply(to_pixel, on_map(xy_m)) - first[:, None])[::-1] - 0.5
        return _in_world(of_nodes(at), xy_m, origin)

    return heights, _metres_per_unit(lambda xy_m: _apply(to_pixel, on_map(xy_m)).T, low, high)


def _rectangle(low: FloatArray, high: FloatArray) -> FloatArray:
    """Return places (n, 2) in a rectangle, whose first three are the ends of two of its sides."""
    part = np.linspace(0.0, 1.0, 9)
    inside = np.stack(np.meshgrid(part, part), axis=-1).reshape(-1, 2)
    return np.asarray(low + (high - low) * np.vstack([[[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], inside]))


def _metres_per_unit(on_map: Callable[[FloatArray], FloatArray], low: FloatArray, high: FloatArray) -> float:
    """Return the length of a unit of coordinates, along the side of a rectangle where it is shorter."""
    sides = _rectangle(low, high)[:3]
    lengths, lengths_on_map = (np.linalg.norm(np.diff(at, axis=0), axis=1) for at in (sides, on_map(sides)))
    return float((lengths / lengths_on_map).min())


def _apply(transform: Sequence[float], places: FloatArray) -> FloatArray:
    """Return the coordinates (2, n) of places (n, 2) after an affine transform, a matrix by rows."""
    matrix = np.reshape(transform, (3, 3))[:2]
    return np.asarray(matrix[:, :2] @ places.T + matrix[:, 2:])


def _to_system(system: pyproj.CRS | None, origin: Vector | None) -> Callable[[FloatArray], FloatArray]:
    """Return a function from places (n, 2) of the world frame to coordinates (n, 2) of a system."""
    if system is None or origin is None:
        return lambda xy_m: xy_m
    with of_extra("geo", "terrain on the Earth"):
        from pymap3d import enu2geodetic
        from pyproj import Transformer

    transformer = Transformer.from_crs(_WGS84, system.to_2d(), always_xy=True)

    def on_map(xy_m: FloatArray) -> FloatArray:
        latitude, longitude, _ = enu2geodetic(*xy_m.T, -_drop_m(xy_m), *origin)
        return transform_points(transformer, longitude, latitude)

    return on_map


def _in_world(height_m: FloatArray, xy_m: FloatArray, origin: Vector | None) -> FloatArray:
    """Return heights (n,) on the Earth, at places (n, 2), as heights in the world frame."""
    return height_m if origin is None else height_m - origin[2] - _drop_m(xy_m)


def _drop_m(xy_m: FloatArray) -> FloatArray:
    """Return how far places (n, 2) at the height of the origin lie below the plane of the world frame."""
    return np.asarray(np.sum(xy_m**2, axis=1) / (2.0 * _EARTH_RADIUS_M))


def _refuse_uncovered(
    path: str, heights: Callable[[FloatArray], FloatArray], xy_m: FloatArray, origin: Vector | None
) -> None:
    """Refuse terrain without a height at some place (n, 2)."""
    checked = xy_m[:: -(-len(xy_m) // _MOST_CHECKED)]
    unknown = np.isnan(heights(checked))
    if unknown.any():
        x, y = checked[np.argmax(unknown)]
        where = "" if origin is None else f" from {place_in_words(origin)}"
        raise InputError(
            f"{path}: found no height at x {x:.1f} m, y {y:.1f} m{where}, expected terrain that covers all lines."
        )


def read_altitudes(path: str | PathLike[str], array: SensorArray, column: str, time_s: FloatArray) -> FloatArray:
    """Return an altimeter's heights above ground (n,) at some times, from a column of a log.

    Missing values, and values that are not positive, are interpolated.
    """
    columns = array.columns
    form = log_format(array, None)
    of_readings = {name for of in form.channels.values() for name in of}
    if columns is not None:
        of_readings |= set(columns.of_sensors(form.channels).values())
    if column in {"time_s", *form.others, *of_readings}:
        raise InputError(f"{path}, column {column}: found times, poses or readings, expected heights above ground.")
    form = LogFormat({}, columns, EXPECTED_HEADER, (column,))
    table = form.table(read_text(path, "a CSV file", form.encoding), str(path))
    table.require(column, ())
    read_s, height_m = table.complete(["time_s"])[:, 0], table.values[:, table.header.index(column)]
    known = np.isfinite(height_m) & (height_m > 0.0)
    if not known.any():
        raise InputError(f"{table.header_place(column)}: found no positive height, expected heights above ground in m.")
    order = np.argsort(read_s[known], kind="stable")
    return np.interp(time_s, read_s[known][order], height_m[known][order])


def terrain_below(parts: Sequence[Readings], altitudes_m: Sequence[FloatArray], name: str) -> Terrain:
    """Return the ground below readings: the height of the array minus that of the altimeter.

    The ground is the median in cells of half a metre, and linear between them.
    """
    places = []
    for part, altitude_m in zip(parts, altitudes_m, strict=True):
        if part.array_position_m is None:
            raise ValueError("Input readings must have the pose of the array in every row; instead received none.")
        _warn_of_unit(part.array_position_m, altitude_m, name)
        places.append(part.array_position_m - altitude_m[:, None] * [0.0, 0.0, 1.0])
    place = np.concatenate(places)
    cells = np.floor(place[:, :2] / _ALTIMETER_CELL_M)
    labels = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    index = np.arange(labels.max() + 1)
    return Terrain.from_points(np.column_stack([median(axis, labels, index) for axis in place.T]), name)


def _warn_of_unit(place_m: FloatArray, altitude_m: FloatArray, name: str) -> None:
    """Warn of an altimeter (n,) that changes by much more than the height of places (n, 3), as one in feet does.

    Where the ground is the same, both change alike; where the carrier follows the ground, the altimeter changes less.
    """
    step_m = float(np.median(np.linalg.norm(np.diff(place_m[:, :2], axis=0), axis=1))) if len(place_m) > 1 else 0.0
    apart = max(1, min(int(_ALTIMETER_CELL_M / step_m), len(place_m) // 2)) if step_m else 1
    rise_m, more_m = (values[apart:] - values[:-apart] for values in (place_m[:, 2], altitude_m))
    rise, more = float(np.linalg.norm(rise_m)), float(np.linalg.norm(more_m))
    if float(rise_m @ more_m) > _ALIKE * rise * more and more > _MOST_SLOPE * rise:
        _LOG.warning(
            f"{name} changes by {more / rise:.2f} times the change of the height, expected once at most: is it in"
            " metres? A foot is 0.3048 m"
        )
