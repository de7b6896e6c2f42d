"""Layers of a survey as another program reads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import magloc
from arrays.io.errors import InputError
from magloc.deliverables.layers import survey_layers, write_layers
from magloc.deliverables.map_frame import MapFrame

pyogrio = pytest.importorskip("pyogrio", reason="extra gis")
shapely = pytest.importorskip("shapely", reason="extra gis")


def read(path: Path, layer: str | None = None) -> tuple[dict[str, Any], NDArray[Any], dict[str, NDArray[Any]]]:
    """Metadata, geometries and fields of a layer."""
    metadata, _, geometry, fields = pyogrio.raw.read(path, layer=layer)
    return metadata, shapely.from_wkb(geometry), dict(zip(metadata["fields"], fields, strict=True))


@pytest.fixture
def package(survey: magloc.Survey, frame: MapFrame, tmp_path: Path) -> Path:
    write_layers(tmp_path / "targets.gpkg", survey, frame)
    return tmp_path / "targets.gpkg"


class TestTargets:
    def test_stand_where_they_are(self, survey: magloc.Survey, frame: MapFrame, package: Path) -> None:
        metadata, points, fields = read(package, "targets")
        assert metadata["crs"] == frame.crs
        assert list(fields["id"]) == [target.id for target in survey]
        places = frame.project(survey.position_m)
        np.testing.assert_allclose(
            shapely.get_coordinates(points), places, rtol=0.0, atol=1e-9 if frame.is_geographic else 1e-3
        )
        np.testing.assert_allclose(fields["latitude"], frame.geodetic(survey.position_m)[:, 0], rtol=0.0, atol=1e-12)
        grid = np.stack([fields["easting"], fields["northing"]], axis=-1)
        assert np.isnan(grid).all() if frame.is_geographic else (grid == places).all()
        np.testing.assert_array_equal(fields["depth_m"], [target.depth_m for target in survey])
        assert list(fields["size_class"]) == ["large", "medium", "small"]  # 13, 1.2 and 0.19 A·m²
        assert list(fields["fit_quality"]) == ["good"] * 3

    def test_their_ellipses(self, survey: magloc.Survey, package: Path, frame: MapFrame) -> None:
        """95 % of a normal distribution with the covariance on the map are inside: area π χ²(2, 0.95) √det."""
        _, polygons, _ = read(package, "ellipses")
        per_m2 = float(np.prod(frame.units_per_m))
        for target, polygon, point in zip(survey, polygons, read(package, "targets")[1], strict=True):
            expected = np.pi * 5.991464547 * np.sqrt(np.linalg.det(target.covariance[:2, :2]))
            assert polygon.area / per_m2 == pytest.approx(expected, rel=5e-3)
            assert polygon.contains(point)


class TestLines:
    def test_hold_all_rows(self, survey: magloc.Survey, package: Path, frame: MapFrame) -> None:
        _, ways, fields = read(package, "lines")
        assert fields["rows"].sum() == len(survey.rows.time_s)
        flown = shapely.get_coordinates(ways)
        np.testing.assert_allclose(
            flown, frame.project(survey.rows.place_m), rtol=0.0, atol=1e-9 if frame.is_geographic else 1e-3
        )


class TestReach:
    def test_leaves_out_places_that_need_more(self, survey: magloc.Survey, package: Path, frame: MapFrame) -> None:
        """Larger moments are found in larger areas."""
        _, polygons, fields = read(package, "reach")
        assert len(polygons)
        for polygon, depth, moment in zip(polygons, fields["depth_m"], fields["moment_Am2"], strict=True):
            at = np.isclose(survey.ground_m - survey.reach.place_m[:, 2], depth)
            needs_more = survey.reach.moment_Am2[at] > moment
            points = shapely.points(frame.project(survey.reach.place_m[at]))
            assert not (shapely.contains_properly(polygon, points) & needs_more).any()
        areas = [polygon.area for polygon, depth in zip(polygons, fields["depth_m"], strict=True) if depth == 1.0]
        assert areas == sorted(areas)


class TestFiles:
    def test_a_shapefile(self, survey: magloc.Survey, frame: MapFrame, tmp_path: Path) -> None:
        """Names of ten letters; each layer is a file."""
        write_layers(tmp_path / "targets.shp", survey, frame)
        metadata, _, fields = read(tmp_path / "targets.shp")
        assert metadata["crs"] == frame.crs
        np.testing.assert_allclose(fields["depth_high"], [target.depth_interval95_m[1] for target in survey], rtol=1e-9)
        names = {path.name for path in tmp_path.glob("*.shp")}
        assert names == {"targets.shp", *(f"targets_{name}.shp" for name in ("ellipses", "lines", "reach"))}

    def test_layers_of_a_package(self, package: Path) -> None:
        assert [name for name, _ in pyogrio.list_layers(package)] == ["targets", "ellipses", "lines", "reach"]

    def test_another_suffix(self, survey: magloc.Survey, frame: MapFrame, tmp_path: Path) -> None:
        with pytest.raises(ValueError, match=r"\.gpkg or \.shp; instead received 'targets\.dxf'"):
            write_layers(tmp_path / "targets.dxf", survey, frame)

    def test_a_survey_without_targets(self, survey: magloc.Survey, frame: MapFrame, tmp_path: Path) -> None:
        write_layers(tmp_path / "none.gpkg", replace(survey, targets=()), frame)
        assert len(read(tmp_path / "none.gpkg", "targets")[1]) == 0
        assert {layer.name for layer in survey_layers(survey, frame)} == {"targets", "ellipses", "lines", "reach"}

    def test_a_file_that_cannot_be_written(self, survey: magloc.Survey, frame: MapFrame, tmp_path: Path) -> None:
        """One sentence, and nothing stays behind."""
        (tmp_path / "targets.gpkg").mkdir()
        with pytest.raises(InputError, match=r"targets\.gpkg cannot be written \(Is a directory\)"):
            write_layers(tmp_path / "targets.gpkg", survey, frame)
        assert [path.name for path in tmp_path.iterdir()] == ["targets.gpkg"]
