"""Maps of a survey as GeoTIFF: the anomaly, and the residual without the targets."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import Delaunay, KDTree

from arrays.io.errors import of_extra
from arrays.io.text import replace_file
from arrays.typing import FloatArray
from magloc.deliverables.map_frame import MapFrame
from magloc.navigation.flight_lines import line_spacing

if TYPE_CHECKING:
    from magloc.surveying.results import SurveyRows

METHOD = "linear interpolation between rows"
_CELLS_PER_SPACING = 4.0
_FARTHEST = 1.0  # Cells farther from the nearest row, in spacings of lines, have no value.
_MOST_CELLS = 4_000_000
_ROWS_PER_CELL = 2.0  # rows of one line that are used for each cell
_DIGITS = 3  # of the size of a cell in units of the map, so that corners are round numbers
_STEPS = (1.0, 2.0, 5.0, 10.0)


class Raster(NamedTuple):
    """Grid of values, or of several sets along the last axis; NaN where there is no value.

    Rows go from north to south, columns from west to east.

    `corner` (2,) is the north-west corner and `cell` (2,) the size of a cell, both in units of the map; `cell_m` is the
    size of a cell in metres.
    """

    values: FloatArray
    corner: FloatArray
    cell: FloatArray
    cell_m: float


def grid_rows(rows: SurveyRows, values: FloatArray, frame: MapFrame, cell_m: float | None = None) -> Raster:
    """Return values of rows on a regular grid of the map.

    Parameters
    ----------
    rows : SurveyRows
    values : ndarray, shape (n,) or (n, k)
        Values, or k sets of them, to interpolate linearly between the rows. A cell has no value if it is farther from
        all rows than the spacing of lines.
    frame : MapFrame
    cell_m : float, optional
        Size of a cell [m], by default a quarter of the spacing of lines, rounded down to 1, 2 or 5 times a power of 10.
    """
    xy_m = rows.place_m[:, :2]
    spacing_m = line_spacing(xy_m)
    cell_m = _round_down(spacing_m / _CELLS_PER_SPACING) if cell_m is None else cell_m
    cell_m = max(cell_m, float(np.sqrt(np.prod(np.ptp(xy_m, axis=0)) / _MOST_CELLS)))
    step_m = float(np.median(np.linalg.norm(np.diff(xy_m, axis=0), axis=1)))
    used = slice(None, None, max(1, int(cell_m / _ROWS_PER_CELL / step_m)) if step_m else 1)
    xy, values = frame.project(rows.place_m[used]), values[used]
    cell = np.array([float(f"{side:.{_DIGITS}g}") for side in cell_m * frame.units_per_m])
    low = np.floor(xy.min(axis=0) / cell) * cell
    n_columns, n_rows = (np.ceil((xy.max(axis=0) - low) / cell).astype(int) + 1).tolist()
    corner = np.array([low[0], low[1] + n_rows * cell[1]])
    east, north = (
        corner[0] + (np.arange(n_columns) + 0.5) * cell[0],
        corner[1] - (np.arange(n_rows) + 0.5) * cell[1],
    )
    cells = np.stack(np.meshgrid(east, north), axis=-1)
    scaled, known = cells / frame.units_per_m, xy / frame.units_per_m
    unique, first = np.unique(known, axis=0, return_index=True)
    gridded = LinearNDInterpolator(Delaunay(unique), values[first])(scaled)
    gridded[KDTree(unique).query(scaled)[0] > _FARTHEST * spacing_m] = np.nan
    return Raster(gridded, corner, cell, cell_m)


def _round_down(length: float) -> float:
    decade = 10.0 ** np.floor(np.log10(length))
    return float(decade * max(step for step in _STEPS if step <= length / decade * (1.0 + 1e-9)))


def write_geotiff(path: Path, raster: Raster, frame: MapFrame, title: str, unit: str, levelling: str = "") -> None:
    """Write a raster as GeoTIFF with its coordinate system; tags name gridding, size of a cell and levelling."""
    with of_extra("gis", "a GeoTIFF"):
        from rasterio import Affine, MemoryFile
    n_rows, n_columns = raster.values.shape
    with MemoryFile() as memory:
        with memory.open(
            driver="GTiff",
            height=n_rows,
            width=n_columns,
            count=1,
            dtype="float32",
            crs=frame.label,
            transform=Affine(raster.cell[0], 0.0, raster.corner[0], 0.0, -raster.cell[1], raster.corner[1]),
            nodata=np.nan,
            compress="deflate",
        ) as file:
            file.write(raster.values.astype(np.float32), 1)
            file.update_tags(method=METHOD, cell_m=f"{raster.cell_m:g}", levelling=levelling)
            file.set_band_description(1, title)
            file.set_band_unit(1, unit)
        content = bytes(memory.getbuffer())
    replace_file(path, lambda place: place.write_bytes(content))
