"""Places and attitudes of a log in the world frame."""

from __future__ import annotations

import numpy as np

from arrays.columns import LogColumns
from arrays.io.csv import Table
from arrays.io.errors import of_extra
from arrays.typing import FloatArray

_ENU_FROM_NED = ((0, 1, 0), (1, 0, 0), (0, 0, -1))
_BODY_FROM_ARRAY = ((1, 0, 0), (0, -1, 0), (0, 0, -1))


def positions(table: Table, columns: LogColumns, *, is_file: bool) -> FloatArray:
    """Return the places (n, 3) [m] in the world, NaN in the rows of a file that have none."""
    place = table.finite_or_missing(columns.place) if is_file else table.complete(columns.place)
    if columns.fix is not None:
        place[~np.isin(table.values[:, table.header.index(columns.fix.column)], columns.fix.equals)] = np.nan
    if columns.geodetic is not None:
        place[(place[:, :2] == 0.0).all(axis=1)] = np.nan  # a receiver without a fix
    height = place[:, 2] if columns.height_m is None else np.full(len(place), columns.height_m)
    if columns.origin is None:
        return np.column_stack([place[:, :2], height])
    with of_extra("geo", "latitude and longitude"):
        from pymap3d import geodetic2enu
    latitude, longitude = place[:, :2].T
    if columns.height_m is not None:
        height = height + columns.origin[2]
    # Where the height alone is missing the rest is as if it were that of the other rows: the Earth is nearly plane.
    known = height[np.isfinite(height)]
    usual = float(np.median(known)) if len(known) else columns.origin[2]
    east, north, up = geodetic2enu(latitude, longitude, np.where(np.isnan(height), usual, height), *columns.origin)
    if columns.height_m is not None:
        return np.column_stack([east, north, np.where(np.isnan(east), np.nan, columns.height_m)])
    return np.column_stack([east, north, np.where(np.isnan(height), np.nan, up)])


def quaternions(table: Table, columns: LogColumns) -> FloatArray:
    """Return the attitudes (n, 4), from the array's axes to the world's, which they are where nothing is known."""
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
