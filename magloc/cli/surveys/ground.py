"""Ground of the survey commands: a height, a file of terrain, or the altimeter of the log."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from arrays.io.errors import InputError, naming, naming_options
from arrays.typing import Vector
from magloc.cli.framework import note, refuse_outside

if TYPE_CHECKING:
    import arrays
    from arrays.typing import FloatArray
    from magloc.readings import Readings
    from magloc.terrain.surface import Terrain

_FILES = (".tif", ".tiff", ".vrt", ".csv", ".txt", ".xyz")
_HIGHEST_M = 1e5
_HIGH_M = 5.0  # above the ground: sensors that find targets are rarely higher


@Parameter(name="*", group="Ground")
@dataclass(frozen=True)
class SurfaceOptions:
    """Surface of the ground.

    Parameters
    ----------
    ground_m : float
        Height of the ground in the world frame [m]. With --terrain: amount to add to its heights, such as the height of
        the sea above the ellipsoid.
    terrain : str
        Heights of uneven ground: a GeoTIFF (.tif) in any coordinate system, a CSV file with columns x, y, height or
        easting, northing, height or longitude, latitude, height, or the name of the log's column with the height above
        ground [m] from an altimeter. It must cover all lines. Depths, and limits of heights in --region, are then
        measured from the ground.
    terrain_sigma_m : float
        Standard deviation of the heights of the ground below the sensors [m]. Intervals of depths include it.
    """

    ground_m: Annotated[float, Parameter(allow_leading_hyphen=True)] = 0.0
    terrain: str | None = None
    terrain_sigma_m: float = 0.0

    def refuse(self) -> None:
        """Refuse a height or an error that is not finite."""
        refuse_outside(0.0, _HIGHEST_M, "zero or a positive number of metres", terrain_sigma_m=self.terrain_sigma_m)
        refuse_outside(-_HIGHEST_M, _HIGHEST_M, "a finite number of metres", ground_m=self.ground_m)

    def below(
        self, logs: list[Path], parts: list[Readings], array: arrays.SensorArray, origin: Vector | None
    ) -> tuple[float | Terrain, list[Readings], Vector | None]:
        """Return the ground with its error, the readings in the world frame, and its origin.

        If heights of the log are above the ground, the terrain gives the heights of the readings, and of an origin
        without one.
        """
        ground, parts, origin = self._surface(logs, parts, array, origin)
        if not self.terrain_sigma_m:
            return ground, parts, origin
        from magloc.terrain.surface import Terrain

        surface = ground if isinstance(ground, Terrain) else Terrain(ground)
        return replace(surface, sigma_m=self.terrain_sigma_m), parts, origin

    def _surface(
        self, logs: list[Path], parts: list[Readings], array: arrays.SensorArray, origin: Vector | None
    ) -> tuple[float | Terrain, list[Readings], Vector | None]:
        """Return the same with a ground without error."""
        if self.terrain is None:
            return self.ground_m, parts, origin
        from magloc.terrain.files import read_altitudes, read_terrain, terrain_below

        columns = array.columns
        above_ground = columns is not None and columns.above_ground
        if Path(self.terrain).suffix.lower() not in _FILES:
            if above_ground:
                raise InputError(
                    f"--terrain {self.terrain}: found heights above ground in the log, expected heights above the sea"
                    " or the ellipsoid beside an altimeter."
                )
            each = zip(logs, parts, strict=True)
            altitudes_m = [read_altitudes(path, array, self.terrain, part.time_s) for path, part in each]
            with naming(f"--terrain {self.terrain}"):
                ground = terrain_below(parts, altitudes_m, f"altimeter {self.terrain}")
            return ground.raise_by(self.ground_m), parts, origin
        places = [part.array_position_m for part in parts if part.array_position_m is not None]
        if len(places) < len(parts):
            raise InputError(f"--terrain {self.terrain}: found a log without a pose, expected places in every row.")
        import numpy as np

        crs = None if columns is None else columns.crs
        with naming_options("crs"):
            ground = read_terrain(self.terrain, np.concatenate(places), origin=origin, crs=crs)
        ground = ground.raise_by(self.ground_m)
        if not above_ground:
            _note_clearance(ground, np.concatenate(places))
            return ground, parts, origin
        if origin is not None and not origin[2]:
            height_m = float(ground.height_at(np.zeros(2)))
            ground, origin = ground.raise_by(-height_m), (origin[0], origin[1], height_m)
        return ground, [ground.place_above(part) for part in parts], origin


def _note_clearance(ground: Terrain, place_m: FloatArray) -> None:
    """Print a note if places (n, 3) are high above terrain, as they are if both refer to different levels."""
    import numpy as np

    low_m, usual_m = np.nanquantile(-ground.depth_of(place_m), [0.0, 0.5]).tolist()
    if low_m > _HIGH_M:
        note(
            f"note: the log is {low_m:.4g} m or more, and in the median {usual_m:.4g} m, above {ground.name}. If it"
            " was flown lower, its heights are above the ellipsoid and the terrain's above the sea: raise the"
            " terrain by the difference (--ground-m)"
        )
