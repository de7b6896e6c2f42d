"""Files of terrain against PROJ, and the ground below an altimeter."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.columns import LogColumns
from arrays.typing import FloatArray
from magloc.terrain.files import read_altitudes, terrain_below

pymap3d, pyproj = pytest.importorskip("pymap3d"), pytest.importorskip("pyproj")

ORIGIN = (52.41, 13.12, 41.0)
LINES = np.random.default_rng(1).uniform(-25.0, 25.0, (300, 2))


def to_system(xy_m: FloatArray, crs: str) -> FloatArray:
    """Coordinates of places in the world, by pymap3d and PROJ."""
    latitude, longitude, _ = pymap3d.enu2geodetic(*xy_m.T, np.zeros(len(xy_m)), *ORIGIN)
    return np.stack(pyproj.Transformer.from_crs(4326, crs, always_xy=True).transform(longitude, latitude), axis=-1)


def sea_level(coordinates: FloatArray, unit_m: float) -> FloatArray:
    """Heights above the sea of a hill in a system whose unit is so many metres."""
    x, y = unit_m * (coordinates - coordinates.mean(axis=0)).T
    return np.asarray(38.0 + 0.8 * np.sin(x / 9.0) * np.cos(y / 7.0))


def expected(crs: str, unit_m: float, centre: FloatArray) -> FloatArray:
    at = np.vstack([to_system(LINES, crs), centre, 2.0 * centre - to_system(LINES, crs)])  # its mean is the centre
    height = sea_level(at, unit_m)[: len(LINES)]
    latitude, longitude, _ = pymap3d.enu2geodetic(*LINES.T, np.zeros(len(LINES)), *ORIGIN)
    return np.asarray(pymap3d.geodetic2enu(latitude, longitude, height, *ORIGIN)[2])


UNITS = {"EPSG:25833": 1.0, "EPSG:4326": 8e4, "EPSG:3035": 1.0}


def write_raster(
    path: Path,
    crs: str,
    *,
    turn_deg: float = 0.0,
    change: Callable[[FloatArray], None] = lambda _: None,
    **more: object,
) -> FloatArray:
    """Write the hill on cells of about 0.8 m, and return the centre of the raster."""
    rasterio = pytest.importorskip("rasterio")
    centre = to_system(np.zeros((2, 2)), crs)[0]  # pyproj 3.7 warns of arrays of one number
    cell, n = 0.8 / UNITS[crs], 160
    cosine, sine = cell * np.cos(np.radians(turn_deg)), cell * np.sin(np.radians(turn_deg))
    axes = np.array([[cosine, sine], [sine, -cosine]])  # of columns and rows
    corner = centre - axes @ [0.5 * n, 0.5 * n]
    transform = rasterio.Affine(axes[0, 0], axes[0, 1], corner[0], axes[1, 0], axes[1, 1], corner[1])
    columns, rows = np.meshgrid(np.arange(n) + 0.5, np.arange(n) + 0.5)
    at = np.stack([columns.ravel(), rows.ravel()], axis=-1) @ axes.T + corner
    values = sea_level(at, UNITS[crs]).reshape(n, n)
    change(values)
    profile = {"driver": "GTiff", "height": n, "width": n, "count": 1, "dtype": "float64", "crs": crs} | more
    with rasterio.open(path, "w", transform=transform, nodata=-9999.0, **profile) as file:
        file.write(values, 1)
    return centre


class TestRaster:
    @pytest.mark.parametrize(("crs", "turn_deg"), [("EPSG:25833", 0.0), ("EPSG:4326", 0.0), ("EPSG:3035", 20.0)])
    def test_heights(self, tmp_path: Path, crs: str, turn_deg: float) -> None:
        centre = write_raster(tmp_path / "dem.tif", crs, turn_deg=turn_deg)
        terrain = magloc.read_terrain(tmp_path / "dem.tif", LINES, origin=ORIGIN)
        np.testing.assert_allclose(terrain.height_at(LINES), expected(crs, UNITS[crs], centre), atol=1e-3)
        assert terrain.name == "dem.tif"

    def test_the_earth_is_round(self, tmp_path: Path) -> None:
        """A level plain lies 7.8 cm below the tangent plane at 1 km."""
        write_raster(tmp_path / "dem.tif", "EPSG:25833", change=lambda values: values.fill(41.0))
        near = LINES + np.array([1000.0, 0.0])
        origin = tuple(map(float, pymap3d.enu2geodetic(-1000.0, 0.0, 0.0, *ORIGIN)[:2]))
        terrain = magloc.read_terrain(tmp_path / "dem.tif", near, origin=(*origin, 41.0))
        level = pymap3d.geodetic2enu(*pymap3d.enu2geodetic(1000.0, 0.0, 0.0, *origin, 41.0)[:2], 41.0, *origin, 41.0)
        assert terrain.height_at(np.array([1000.0, 0.0])) == pytest.approx(float(level[2]), abs=1e-3)

    def test_terrain_that_does_not_cover_the_lines(self, tmp_path: Path) -> None:
        write_raster(tmp_path / "dem.tif", "EPSG:25833")
        for shift in (50.0, 5000.0):
            with pytest.raises(
                arrays.InputError, match=r"dem\.tif: found no height at .* expected terrain that covers"
            ):
                magloc.read_terrain(tmp_path / "dem.tif", LINES + shift, origin=ORIGIN)

        def spoil(values: FloatArray) -> None:
            values[70:90, 70:90] = -9999.0

        write_raster(tmp_path / "dem.tif", "EPSG:25833", change=spoil)
        with pytest.raises(arrays.InputError, match="expected terrain that covers"):
            magloc.read_terrain(tmp_path / "dem.tif", LINES, origin=ORIGIN)

    def test_heights_in_feet_by_the_coordinate_system(self, tmp_path: Path) -> None:
        rasterio = pytest.importorskip("rasterio")
        write_raster(tmp_path / "dem.tif", "EPSG:25833")
        with rasterio.open(tmp_path / "dem.tif", "r+") as file:
            file.crs = "EPSG:25833+6360"
        with pytest.raises(arrays.InputError, match="found heights in 'US survey foot', expected metres"):
            magloc.read_terrain(tmp_path / "dem.tif", LINES, origin=ORIGIN)

    def test_other_faults(self, tmp_path: Path) -> None:
        rasterio = pytest.importorskip("rasterio")
        write_raster(tmp_path / "dem.tif", "EPSG:25833")
        with pytest.raises(arrays.InputError, match="without a place on the Earth"):
            magloc.read_terrain(tmp_path / "dem.tif", LINES)
        with rasterio.open(tmp_path / "dem.tif", "r+") as file:
            file.units = ("ft",)
        with pytest.raises(arrays.InputError, match="found heights in 'ft', expected metres"):
            magloc.read_terrain(tmp_path / "dem.tif", LINES, origin=ORIGIN)
        with pytest.raises(arrays.InputError, match="does not exist"):
            magloc.read_terrain(tmp_path / "none.tif", LINES, origin=ORIGIN)
        (tmp_path / "text.tif").write_text("no picture")
        with pytest.raises(arrays.InputError, match="found no raster"):
            magloc.read_terrain(tmp_path / "text.tif", LINES, origin=ORIGIN)


def write_points(path: Path, crs: str | None, names: str) -> None:
    """Write heights of a sloping plane: a rise of 0.05 to the east and of -0.02 to the north."""
    axis = np.linspace(-60.0, 60.0, 25)
    xy = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    height = xy @ [0.05, -0.02] + (0.0 if crs is None else ORIGIN[2])
    at = xy if crs is None else to_system(xy, crs)
    rows = "\n".join(",".join(map(repr, row)) for row in np.column_stack([at, height]).tolist())
    path.write_text(f"{names}\n{rows}\n")


class TestPoints:
    @pytest.mark.parametrize(
        ("crs", "names"),
        [(None, "x,y,height"), ("EPSG:25833", "Easting,Northing,Height"), ("EPSG:4326", "lon,lat,height_m")],
    )
    def test_heights(self, tmp_path: Path, crs: str | None, names: str) -> None:
        write_points(tmp_path / "grid.csv", crs, names)
        of_grid = crs if crs == "EPSG:25833" else None
        terrain = magloc.read_terrain(tmp_path / "grid.csv", LINES, origin=crs and ORIGIN, crs=of_grid)
        np.testing.assert_allclose(terrain.height_at(LINES), LINES @ [0.05, -0.02], atol=1e-3)

    @pytest.mark.parametrize("unknown", [-9999.0, -32768.0, 32767.0])
    def test_numbers_that_stand_for_unknown_heights(self, unknown: float, tmp_path: Path) -> None:
        """A spline through them would ring below the lines."""
        x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
        height = np.where(x > 30.0, unknown, 0.1 * x)
        rows = np.stack([x.ravel(), y.ravel(), height.ravel()], axis=1)
        np.savetxt(tmp_path / "dem.csv", rows, delimiter=",", header="x,y,height", comments="")
        places = np.array([[8.0, 20.0], [28.0, 20.0]])
        np.testing.assert_allclose(
            magloc.read_terrain(tmp_path / "dem.csv", places).height_at(places), 0.1 * places[:, 0], atol=1e-6
        )

    def test_faults(self, tmp_path: Path) -> None:
        path = tmp_path / "grid.csv"
        write_points(path, "EPSG:25833", "easting,northing,height")
        with pytest.raises(arrays.InputError, match="expected crs in"):
            magloc.read_terrain(path, LINES, origin=ORIGIN)
        write_points(path, "EPSG:4326", "lon,lat,height")
        with pytest.raises(arrays.InputError, match="expected x, y, height"):
            magloc.read_terrain(path, LINES)
        write_points(path, None, "a,b,height")
        with pytest.raises(arrays.InputError, match="found height, expected columns x, y, height"):
            magloc.read_terrain(path, LINES)
        write_points(path, None, "x,y,height")
        with pytest.raises(arrays.InputError, match="expected terrain that covers all lines"):
            magloc.read_terrain(path, LINES + 50.0)
        with pytest.raises(arrays.InputError, match="found 0 points near the lines"):
            magloc.read_terrain(path, LINES + 5000.0)


class TestAltimeter:
    def test_ground_below_a_log(self, tmp_path: Path) -> None:
        """Lines 2 m apart over a slope, with noise of 3 cm and rows without an echo."""
        rng = np.random.default_rng(2)
        x = np.linspace(-20.0, 20.0, 400)
        xy = np.concatenate([np.column_stack([x[:: 1 - 2 * (i % 2)], np.full(400, 2.0 * i)]) for i in range(12)])
        n = len(xy)
        ground, z = xy @ [0.05, 0.03], xy @ [0.05, 0.03] + 1.5 + 0.2 * np.sin(np.arange(n) / 40.0)
        altitude = z - ground + 0.03 * rng.normal(size=n)
        cells = [f"{value:.4f}" for value in altitude]
        cells[100:120], cells[500] = [""] * 20, "0"
        time_s = 0.1 * np.arange(n)
        text = "\n".join(f"{t:.2f},{1.0},{cell}" for t, cell in zip(time_s, cells, strict=True))
        (tmp_path / "log.csv").write_text(f"t,B,Alt\n{text}\n")
        array = arrays.SensorArray(
            (arrays.Sensor("B", "scalar", (0.0, 0.0, 0.0), 1e-10),), columns=LogColumns(time="t", sensors={"B": "B"})
        )
        found = read_altitudes(tmp_path / "log.csv", array, "Alt", time_s)
        turn = Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
        rows = magloc.Readings(
            np.ones((n, 1)), time_s=time_s, array_position_m=np.column_stack([xy, z]), array_rotation=turn
        )
        terrain = terrain_below([rows], [found], "Alt")
        error = terrain.height_at(xy) - ground
        assert np.abs(np.median(error)) < 0.003
        assert np.sqrt(np.mean(error**2)) < 0.03
        with pytest.raises(arrays.InputError, match="column Height"):
            read_altitudes(tmp_path / "log.csv", array, "Height", time_s)
