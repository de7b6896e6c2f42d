"""Files of a survey for a client's map, in one folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.csv import Column
from arrays.io.errors import InputError
from arrays.io.text import replace_file
from magloc.deliverables.geosoft import geosoft_xyz
from magloc.deliverables.layers import target_fields, write_layers
from magloc.deliverables.map_frame import MapFrame
from magloc.deliverables.rasters import METHOD, grid_rows, write_geotiff
from magloc.deliverables.report import report_html
from magloc.navigation.flight_lines import covers_area

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from magloc.surveying.results import Survey

_LOG = logging.getLogger(__name__)
MAP_FILES = (
    *("targets.geojson", "targets.kml", "targets.gpkg", "field.tif", "residual.tif"),
    *("lines.xyz", "report.html", "report.pdf"),
)
"""Names of all files that :func:`survey_files` may write."""
_LIBRARIES = ("pyogrio", "rasterio", "shapely")


def survey_files(
    found: Survey, frame: MapFrame, title: str, assumptions: Mapping[str, str], figures: tuple[Figure, Figure]
) -> Iterator[tuple[str, Any]]:
    """Yield names and contents of the files of a survey, as :func:`arrays.io.outputs.write_files` takes them.

    Without the extra ``gis`` the GeoPackage and GeoTIFF are not written; without a browser the PDF is not. A note
    is logged then. Surveys of a single line have no GeoTIFF. The report shows the figures: maps, and profiles.
    """
    yield "targets.geojson", json.dumps(found.to_geojson(frame.origin)) + "\n"
    yield "targets.kml", found.to_kml(frame.origin)
    yield "lines.xyz", geosoft_xyz(found, frame)
    if all(map(find_spec, _LIBRARIES)):
        yield "targets.gpkg", partial(write_layers, found=found, frame=frame)
        if covers_area(found.rows.place_m[:, :2]):
            rows = found.levelled_rows
            both = grid_rows(rows, 1e9 * np.stack([rows.anomaly_T, rows.residual_T], axis=-1), frame)
            write = partial(write_geotiff, frame=frame, unit="nT", levelling=found.levelling)
            for i, name in enumerate(("field", "residual")):
                yield f"{name}.tif", partial(write, raster=both._replace(values=both.values[..., i]), title=name)
            assumptions = {**assumptions, "maps": f"{METHOD}, cells of {both.cell_m:g} m; {found.levelling}"}
    else:
        _LOG.info('note: a GeoPackage and GeoTIFF need the extra "gis": pip install "magloc[gis]"')
    yield "report.html", report_html(found, frame, title, assumptions, figures)
    yield "report.pdf", _print_report


def map_columns(found: Survey, frame: MapFrame) -> dict[str, Column]:
    """Return columns of the list of targets: easting and northing on a grid, latitude and longitude in WGS 84."""
    names = ("latitude", "longitude") if frame.is_geographic else ("easting", "northing", "latitude", "longitude")
    fields = target_fields(found, frame)
    return {name: fields[name] for name in names}


def _print_report(path: Path) -> None:
    """Print the HTML page beside a PDF file into it; without a browser, log a note instead."""
    try:
        from magloc.viewer.chromium import BrowserError, Chromium
    except InputError as error:
        _LOG.info(f"note: {path.name} is not written: {error}")
        return
    try:
        with Chromium(path.with_suffix(".html").absolute().as_uri()) as browser:
            content = browser.pdf()
    except (InputError, BrowserError) as error:
        _LOG.info(f"note: {path.name} is not written: {error}")
        return
    replace_file(path, lambda place: place.write_bytes(content))
