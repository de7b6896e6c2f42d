"""Coordinate systems of positions on the Earth, and the areas that they are made for."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import of_extra
from arrays.typing import FloatArray

if TYPE_CHECKING:
    import pyproj

_RIM_deg = 4.0  # offices use one UTM zone beyond its borders, such as zone 32 in all of Germany


def coordinate_system(crs: str) -> pyproj.CRS:
    """Return the system of a name such as "EPSG:32633".

    Raises
    ------
    ValueError
        PROJ does not know the system.
    """
    with of_extra("geo", "a system of coordinates (crs)"):
        import pyproj
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError:
        raise ValueError(
            f"Input crs must be a system that PROJ knows, such as EPSG:32633; instead received {crs!r}."
        ) from None


def transform_points(transformer: pyproj.Transformer, x: FloatArray, y: FloatArray) -> FloatArray:
    """Return transformed coordinates (n, 2) of points (n,)."""
    # pyproj turns an array of one point into a number, which older NumPy warns of.
    points = (x, y) if len(x) != 1 else (float(x[0]), float(y[0]))
    return np.stack(np.atleast_1d(*transformer.transform(*points)), axis=-1)


def is_outside_area(system: pyproj.CRS, latitude_deg: FloatArray, longitude_deg: FloatArray) -> NDArray[np.bool_]:
    """Return whether places (n,) lie far outside the area of a system; NaN and systems without an area do not."""
    area = system.area_of_use
    if area is None:
        return np.zeros(len(latitude_deg), np.bool_)
    lost = np.isinf(latitude_deg) | np.isinf(longitude_deg)
    outside = (latitude_deg < area.south - _RIM_deg) | (latitude_deg > area.north + _RIM_deg)
    width = (area.east - area.west) % 360.0 or 360.0  # the area may cross the meridian of 180 degrees
    if width + 2.0 * _RIM_deg < 360.0:
        from_west = (np.where(lost, np.nan, longitude_deg) - area.west + _RIM_deg) % 360.0
        outside |= from_west > width + 2.0 * _RIM_deg
    return np.asarray(outside | lost)


def area_words(system: pyproj.CRS) -> str:
    """Return the bounds of the area of a system in words; empty for a system without one."""
    area = system.area_of_use
    if area is None:
        return ""
    return f"latitude {area.south:g} to {area.north:g}, longitude {area.west:g} to {area.east:g}"
