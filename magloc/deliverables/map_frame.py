"""Map frame: positions of the world frame in a coordinate system that a client's map uses."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.errors import of_extra
from arrays.io.world_maps import check_near
from arrays.logs.systems import area_words, coordinate_system, is_outside_area, transform_points
from arrays.typing import FloatArray, Vector

if TYPE_CHECKING:
    import pyproj

WGS84 = "EPSG:4326"


@dataclass(frozen=True)
class MapFrame:
    """Coordinate system of a map, and the origin of the world frame in it.

    Attributes
    ----------
    origin : tuple of 3 floats
        Latitude, longitude [deg] and height [m] of the origin of the world frame, which is east, north, up.
    crs : str
        Coordinate system that PROJ knows, such as "EPSG:32633". Any projected or geographic system.

    Raises
    ------
    ValueError
        PROJ does not know the system, it is neither projected nor geographic, or the origin is far outside its area.

    Examples
    --------
    >>> import numpy as np
    >>> from magloc.deliverables.map_frame import MapFrame
    >>> frame = MapFrame((52.41, 13.12, 41.0), "EPSG:32633")
    >>> frame.project(np.zeros((1, 3))).round(1)
    array([[ 372125.2, 5808303.8]])
    """

    origin: Vector
    crs: str = WGS84

    def __post_init__(self) -> None:
        system = self.system
        if not (system.is_projected or system.is_geographic):
            received = f"{self.crs!r} ({system.name})"
            raise ValueError(f"Input crs must be a projected or geographic system; instead received {received}.")
        latitude, longitude, _ = self.origin
        if is_outside_area(system, np.array([latitude]), np.array([longitude])).any():
            place = f"latitude {latitude:.4g}, longitude {longitude:.4g}"
            received = f"{self.crs!r} ({system.name}: {area_words(system)})"
            raise ValueError(f"Input crs must be a system for {place}; instead received {received}.")

    @cached_property
    def system(self) -> pyproj.CRS:
        """System of coordinates as PROJ describes it; without the vertical part, if there is one."""
        system = coordinate_system(self.crs)
        parts = system.sub_crs_list if system.is_compound else [system]
        return parts[0].to_2d()

    @cached_property
    def label(self) -> str:
        """Name of the system by its authority, such as "EPSG:32633"; without one the system as it was named."""
        authority = self.system.to_authority(min_confidence=100)
        return ":".join(authority) if authority else self.crs

    @property
    def is_geographic(self) -> bool:
        """True if coordinates are longitudes and latitudes in degrees."""
        return bool(self.system.is_geographic)

    def geodetic(self, position_m: FloatArray) -> FloatArray:
        """Return latitude, longitude [deg] and height [m] (n, 3) of positions (n, 3) in the world frame."""
        check_near(float(np.abs(position_m).max(initial=0.0)))
        with of_extra("geo", "a map of the world"):
            from pymap3d import enu2geodetic
        return np.stack(enu2geodetic(*position_m.T, *self.origin), axis=-1)

    def project(self, position_m: FloatArray) -> FloatArray:
        """Return easting and northing [m], or longitude and latitude [deg], (n, 2) of positions (n, 3)."""
        latitude, longitude, _ = self.geodetic(position_m).T
        return transform_points(self._transformer, longitude, latitude)

    @cached_property
    def _transformer(self) -> pyproj.Transformer:
        import pyproj

        return pyproj.Transformer.from_crs(WGS84, self.system, always_xy=True)

    @cached_property
    def units_per_m(self) -> FloatArray:
        """Length of a metre along both axes of the map at the origin (2,)."""
        steps = np.vstack([np.zeros((1, 3)), np.eye(3)[:2]])
        here, *ends = self.project(steps)
        return np.linalg.norm(np.array(ends) - here, axis=0)
