"""Maps as GeoTIFF."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

import magloc
from magloc.deliverables.map_frame import MapFrame
from magloc.deliverables.rasters import METHOD, grid_rows, line_spacing, write_geotiff

rasterio = pytest.importorskip("rasterio", reason="extra gis")


class TestGridRows:
    def test_a_plane_is_interpolated_exactly(self, survey: magloc.Survey, frame: MapFrame) -> None:
        """Linear in the map's coordinates; cells have their values at their middles."""
        low = frame.project(survey.rows.place_m).min(axis=0)
        x, y = ((frame.project(survey.rows.place_m) - low) / frame.units_per_m).T
        raster = grid_rows(survey.rows, 3.0 * x - 2.0 * y, frame)
        rows, columns = np.nonzero(np.isfinite(raster.values))
        assert len(rows) > 1000
        middles = raster.corner + np.stack([columns + 0.5, -(rows + 0.5)], axis=-1) * raster.cell
        east, north = ((middles - low) / frame.units_per_m).T
        np.testing.assert_allclose(raster.values[rows, columns], 3.0 * east - 2.0 * north, rtol=0.0, atol=1e-3)

    def test_cells_far_from_all_rows_have_no_value(self, survey: magloc.Survey, frame: MapFrame) -> None:
        left_out = np.abs(survey.rows.place_m[:, 0]) > 4.0
        rows = type(survey.rows)(*(column[left_out] for column in survey.rows))
        raster = grid_rows(rows, np.zeros(left_out.sum()), frame)
        assert np.isnan(raster.values[:, raster.values.shape[1] // 2]).all()

    def test_size_of_a_cell(self, survey: magloc.Survey, frame: MapFrame) -> None:
        """Lines 1 m apart, of which the outermost have one neighbour: a quarter, rounded down."""
        assert line_spacing(survey.rows.place_m[:, :2]) == pytest.approx(1.0, abs=0.25)
        assert grid_rows(survey.rows, survey.rows.anomaly_T, frame).cell_m == 0.2
        assert grid_rows(survey.rows, survey.rows.anomaly_T, frame, 0.5).cell_m == 0.5

    def test_the_residual_has_no_offset(self, survey: magloc.Survey) -> None:
        """Both maps still differ by the targets' fields."""
        levelled = survey.levelled_rows
        assert abs(np.median(levelled.residual_T)) < 1e-15
        fields_T = survey.rows.anomaly_T - survey.rows.residual_T
        np.testing.assert_allclose(levelled.anomaly_T - levelled.residual_T, fields_T, rtol=0.0, atol=1e-15)

    def test_corners_are_round_numbers(self, survey: magloc.Survey) -> None:
        """A cell is 0.2 m on the map, although a metre of the ground is 0.9998 m there."""
        raster = grid_rows(survey.rows, survey.rows.anomaly_T, MapFrame((52.41, 13.12, 41.0), "EPSG:32633"))
        np.testing.assert_array_equal(raster.cell, 0.2)
        np.testing.assert_allclose(raster.corner / 0.2, np.round(raster.corner / 0.2), rtol=0.0, atol=1e-6)


class TestWriteGeotiff:
    def test_as_rasterio_reads_it(self, survey: magloc.Survey, frame: MapFrame, tmp_path: Path) -> None:
        raster = grid_rows(survey.rows, 1e9 * survey.rows.anomaly_T, frame)
        write_geotiff(tmp_path / "field.tif", raster, frame, "anomaly", "nT", survey.levelling)
        with rasterio.open(tmp_path / "field.tif") as file:
            assert file.crs == frame.crs
            corner = np.array([file.transform.c, file.transform.f])
            assert (np.abs(corner - raster.corner) < 1e-3 * frame.units_per_m).all()
            np.testing.assert_array_equal(file.read(1), raster.values.astype(np.float32))
            assert (file.descriptions, file.units) == (("anomaly",), ("nT",))
            tags = file.tags()
            assert (tags["method"], tags["cell_m"], tags["levelling"]) == (METHOD, "0.2", survey.levelling)

    @pytest.mark.skipif(shutil.which("gdalinfo") is None, reason="gdalinfo is not installed")
    def test_as_gdalinfo_reads_it(self, survey: magloc.Survey, tmp_path: Path) -> None:
        frame = MapFrame((52.41, 13.12, 41.0), "EPSG:32633")
        raster = grid_rows(survey.rows, survey.rows.anomaly_T, frame)
        write_geotiff(tmp_path / "field.tif", raster, frame, "anomaly", "nT")
        told = subprocess.run(["gdalinfo", tmp_path / "field.tif"], capture_output=True, encoding="utf-8").stdout
        assert f"Origin = ({raster.corner[0]:.3f}" in told
        assert 'ID["EPSG",32633]' in told
