"""Layers of a survey for geographic information systems: targets, ellipses, lines as flown, reach."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import InputError, of_extra
from arrays.typing import FloatArray
from magloc.deliverables.map_frame import MapFrame
from magloc.surveying.results import neighbour_triangles

if TYPE_CHECKING:
    from magloc.surveying.results import Survey, Target

_CORNERS = 72  # corners of the polygon of an ellipse
_LEVEL = 0.95
_MOMENTS_Am2 = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)  # edges of the polygons of reach
# Names in a Shapefile have ten letters at most.
_SHORT_NAMES = {
    "depth_low_m": "depth_low",
    "depth_high_m": "depth_high",
    "sigma_along_m": "sig_along",
    "sigma_across_m": "sig_across",
    "significance": "signif",
    "fit_quality": "fit_qual",
}
_WHAT = "a file for geographic information systems"


class Layer(NamedTuple):
    """Geometries of one kind, as well-known binary, and their attributes by name."""

    name: str
    kind: str
    geometry: NDArray[np.object_]
    fields: Mapping[str, NDArray[Any]]


def write_layers(path: Path, found: Survey, frame: MapFrame) -> None:
    """Write the layers of a survey into a file.

    Parameters
    ----------
    path : Path
        A GeoPackage (``.gpkg``) takes all layers. A Shapefile (``.shp``) takes the targets, and each other layer
        becomes a file beside it, whose name ends with the layer's.
    found : Survey
    frame : MapFrame
        Coordinate system of the file, and the origin of the survey's world frame.

    Raises
    ------
    ValueError
        The suffix is neither of these, or the file cannot be written.
    """
    with of_extra("gis", _WHAT):
        from pyogrio.raw import write
    drivers = {".gpkg": "GPKG", ".shp": "ESRI Shapefile"}
    driver = drivers.get(path.suffix.lower())
    if driver is None:
        raise ValueError(f"Input path must end with .gpkg or .shp; instead received {path.name!r}.")
    one_file = driver == "GPKG"
    try:
        with TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.") as folder:
            unfinished = Path(folder, path.name)
            for number, layer in enumerate(survey_layers(found, frame)):
                write(
                    str(unfinished if one_file or not number else unfinished.with_stem(f"{path.stem}_{layer.name}")),
                    layer.geometry,
                    list(layer.fields.values()),
                    list(layer.fields) if one_file else [_SHORT_NAMES.get(name, name) for name in layer.fields],
                    layer=layer.name if one_file else None,
                    driver=driver,
                    geometry_type=layer.kind,
                    crs=frame.label,
                    append=one_file and number > 0,
                    encoding="UTF-8",
                )
            for file in Path(folder).iterdir():
                file.replace(path.with_name(file.name))
    except (OSError, RuntimeError) as error:  # GDAL's own errors are RuntimeErrors
        raise InputError(f"{path} cannot be written ({getattr(error, 'strerror', None) or error}).") from None


def survey_layers(found: Survey, frame: MapFrame) -> Iterator[Layer]:
    """Yield the layers of a survey in the map's coordinate system."""
    with of_extra("gis", _WHAT):
        import shapely
    places = frame.project(found.position_m)
    yield Layer("targets", "Point", shapely.to_wkb(shapely.points(places)), target_fields(found, frame))
    ellipses = [shapely.Polygon(frame.project(_ellipse(target))) for target in found]
    ids = np.array([target.id for target in found], dtype=np.object_)
    yield Layer("ellipses", "Polygon", _wkb(ellipses), {"id": ids, "level": np.full(len(found), _LEVEL)})
    flown = found.flight_lines
    ways = [shapely.LineString(frame.project(found.rows.place_m[line.rows])) for line in flown]
    fields: dict[str, NDArray[Any]] = {"line": np.array([line.name for line in flown], dtype=np.object_)}
    fields["rows"] = np.array([line.rows.stop - line.rows.start for line in flown], dtype=np.int64)
    fields |= {name: np.array([getattr(line, name) for line in flown]) for name in ("speed_m_s", "height_m")}
    yield Layer("lines", "LineString", _wkb(ways), fields)
    seen = list(_reach_polygons(found, frame))
    fields = {name: np.array([one[i] for one in seen]) for i, name in enumerate(("moment_Am2", "depth_m"))}
    yield Layer("reach", "MultiPolygon", _wkb([one[2] for one in seen]), fields)


def _wkb(geometries: list[Any]) -> NDArray[np.object_]:
    import shapely

    return np.asarray(shapely.to_wkb(np.array(geometries, dtype=np.object_)), dtype=np.object_)


def target_fields(found: Survey, frame: MapFrame) -> dict[str, NDArray[Any]]:
    """Return the attributes of all targets; eastings and northings are NaN in a geographic system."""
    grid = np.full((len(found), 2), np.nan) if frame.is_geographic else frame.project(found.position_m)
    latitude, longitude, height = frame.geodetic(found.position_m).T
    low, high = np.array([target.depth_interval95_m for target in found]).reshape(-1, 2).T
    sigma = np.sqrt([np.linalg.eigvalsh(target.covariance[:2, :2]) for target in found]).reshape(-1, 2)
    return {
        "id": np.array([target.id for target in found], dtype=np.object_),
        "easting": grid[:, 0],
        "northing": grid[:, 1],
        "height_m": height,
        "latitude": latitude,
        "longitude": longitude,
        "depth_m": np.array([target.depth_m for target in found]),
        "depth_low_m": low,
        "depth_high_m": high,
        "moment_Am2": np.array([target.strength_Am2 for target in found]),
        "sigma_along_m": sigma[:, 1],
        "sigma_across_m": sigma[:, 0],
        "significance": np.array([target.significance for target in found]),
        "flags": np.array([" ".join(target.flags) for target in found], dtype=np.object_),
        "size_class": np.array([target.size_class for target in found], dtype=np.object_),
        "fit_quality": np.array([target.fit_quality for target in found], dtype=np.object_),
    }


def _ellipse(target: Target) -> FloatArray:
    """Return corners (n, 3) of the 95 % ellipse in the world frame."""
    major, minor, bearing_deg = target.ellipse95
    angle, bearing = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False), np.radians(bearing_deg)
    along, across = major * np.cos(angle), minor * np.sin(angle)
    east = along * np.sin(bearing) + across * np.cos(bearing)
    north = along * np.cos(bearing) - across * np.sin(bearing)
    return target.position_m + np.stack([east, north, np.zeros(_CORNERS)], axis=-1)


def _reach_polygons(found: Survey, frame: MapFrame) -> Iterator[tuple[float, float, Any]]:
    """Yield moments [A·m²], depths [m] and the polygons in which a target of that moment is found with 95 %."""
    import shapely

    for depth, (places, moments) in found.reach_by_depth.items():
        corners = neighbour_triangles(places[:, :2])
        xy = frame.project(places)
        for moment in _MOMENTS_Am2:
            cells = corners[(moments[corners] <= moment).all(axis=1)]
            if len(cells):
                union = shapely.union_all(shapely.polygons(xy[cells]))
                parts = [union] if union.geom_type == "Polygon" else list(union.geoms)
                yield moment, depth, shapely.MultiPolygon(parts)
