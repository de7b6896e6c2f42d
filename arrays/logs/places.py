"""Positions and attitudes of a log in the world frame."""

from __future__ import annotations

import numpy as np

from arrays.columns import LogColumns
from arrays.io.csv import Table
from arrays.io.errors import InputError, naming, of_extra
from arrays.logs.systems import area_words, coordinate_system, is_outside_area, transform_points
from arrays.typing import FloatArray

_ENU_FROM_NED = ((0, 1, 0), (1, 0, 0), (0, 0, -1))
_BODY_FROM_ARRAY = ((1, 0, 0), (0, -1, 0), (0, 0, -1))


def positions(table: Table, columns: LogColumns, *, is_file: bool) -> FloatArray:
    """Return the positions (n, 3) [m] in the world; NaN for rows without one."""
    place = geodetic_places(table, columns, is_file=is_file)
    height = place[:, 2]
    if columns.origin is None:
        if columns.is_geodetic:
            _refuse_no_origin(table, place)
        return place
    with of_extra("geo", "latitude and longitude"):
        from pymap3d import geodetic2enu
    above_m = height if columns.above_ground else None
    if above_m is not None:
        height = height + columns.origin[2]
    # A missing height does not change east and north much, so use that of the other rows.
    known = height[np.isfinite(height)]
    usual = float(np.median(known)) if len(known) else columns.origin[2]
    east, north, up = geodetic2enu(*place[:, :2].T, np.where(np.isnan(height), usual, height), *columns.origin)
    up = np.where(np.isnan(height), np.nan, up) if above_m is None else np.where(np.isnan(east), np.nan, above_m)
    return np.column_stack([east, north, up])


def geodetic_places(table: Table, columns: LogColumns, *, is_file: bool) -> FloatArray:
    """Return latitude, longitude [deg] and height [m] (n, 3), or places [m] of a frame without an origin."""
    place = table.finite_or_missing(columns.place) if is_file else table.complete(columns.place)
    if columns.fix is not None:
        place[~np.isin(table.values[:, table.header.index(columns.fix.column)], columns.fix.equals)] = np.nan
    if columns.is_geodetic:
        place[(place[:, :2] == 0.0).all(axis=1)] = np.nan  # a receiver without a fix
    if columns.crs is not None:
        place[:, :2] = _latitudes_and_longitudes(table, columns, columns.crs, place[:, :2])
    if columns.geodetic is not None:
        _refuse_exchanged(table, columns.geodetic, place[:, 0])
    height = place[:, 2] if columns.height_m is None else np.full(len(place), columns.height_m)
    return np.column_stack([place[:, :2], height])


def array_origins(antenna_m: FloatArray, quaternion: FloatArray, columns: LogColumns) -> FloatArray:
    """Return the origins of the array's frame (n, 3) [m] from the positions of its antenna."""
    from scipy.spatial.transform import Rotation

    if columns.antenna_m is None or not len(antenna_m):
        return antenna_m
    return np.asarray(antenna_m - Rotation.from_quat(quaternion).apply(columns.antenna_m))


def _latitudes_and_longitudes(table: Table, columns: LogColumns, crs: str, place: FloatArray) -> FloatArray:
    """Return latitude and longitude (n, 2) [deg] of positions in a coordinate system."""
    with naming(table.path):
        system = coordinate_system(crs)
    is_grid = columns.geodetic is None
    if not (system.is_projected if is_grid else system.is_geographic):
        kind, key = ("eastings and northings", "position") if is_grid else ("latitude and longitude", "geodetic")
        raise InputError(f"{table.path}: found {crs} ({system.name}), expected a system of {kind} for the key {key}.")
    from pyproj import Transformer

    transformer = Transformer.from_crs(system, "EPSG:4326", always_xy=True)
    known = np.isfinite(place).all(axis=1)
    longitude, latitude = transform_points(transformer, *(place if is_grid else place[:, ::-1])[known].T).T
    found = np.full(place.shape, np.nan)
    found[known] = np.column_stack([latitude, longitude])
    outside = is_outside_area(system, *found.T)
    if outside.any():
        first = "latitude {:.4g}, longitude {:.4g}".format(*found[np.argmax(outside)])
        area = f"the area of {crs} ({area_words(system)})"
        fault = f"found a place outside {area}: {first}, expected one in it: correct crs, or exchange the columns"
        table.refuse(outside[:, None], columns.place[:1], fault)
    return found


def _refuse_exchanged(table: Table, names: tuple[str, ...], latitude_deg: FloatArray) -> None:
    """Refuse columns of longitude and latitude in this order, by their names or by a latitude above 90 degrees."""
    first, second = names[0].lower(), names[1].lower()
    if ("lon" in first or "lng" in first) and "lat" in second:
        raise InputError(f"{table.path}: found geodetic = {list(names[:2])}, expected latitude before longitude.")
    fault = "found a latitude beyond 90 degrees, expected latitude before longitude in geodetic"
    table.refuse((np.abs(latitude_deg) > 90.0)[:, None], names[:1], fault)


def _refuse_no_origin(table: Table, place: FloatArray) -> None:
    known = place[np.isfinite(place[:, :2]).all(axis=1)]
    if len(known):
        near = f"[{known[0, 0]:.6f}, {known[0, 1]:.6f}, 0.0]"
        raise InputError(
            f"{table.path}: found places on the Earth without an origin of the world, expected latitude, longitude and"
            f" height: origin = {near} in the table columns of the array file is where the log begins."
        )


def quaternions(table: Table, columns: LogColumns) -> FloatArray:
    """Return the attitudes (n, 4) from array to world; identity if the log has none."""
    from scipy.spatial.transform import Rotation

    logged = table.complete(columns.attitude)
    if columns.quaternion is not None:
        return logged
    if not columns.attitude:
        return np.tile([0.0, 0.0, 0.0, 1.0], (len(logged), 1))
    angles = np.zeros((len(logged), 3))
    angles[:, : logged.shape[1]] = logged
    enu_from_ned, body_from_array = map(Rotation.from_matrix, (_ENU_FROM_NED, _BODY_FROM_ARRAY))
    turn = enu_from_ned * Rotation.from_euler("ZYX", angles, degrees=True) * body_from_array
    return np.asarray(turn.as_quat())
