"""Positions of the world frame in coordinate systems of maps, against PROJ's own topocentric frame."""

from __future__ import annotations

import numpy as np
import pyproj
import pytest

from magloc.deliverables.map_frame import MapFrame

LATITUDE, LONGITUDE, HEIGHT_M = ORIGIN = (52.41, 13.12, 41.0)
TOPOCENTRIC = (
    f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lat_0={LATITUDE} +lon_0={LONGITUDE} +h_0={HEIGHT_M}"
    " +step +inv +proj=cart +ellps=WGS84"
)
PLACES_M = np.array([[0.0, 0.0, 0.0], [100.0, -40.0, -1.0], [-2000.0, 3000.0, 25.0]])


class TestGeodetic:
    def test_is_that_of_proj(self) -> None:
        longitude, latitude, height = pyproj.Transformer.from_pipeline(TOPOCENTRIC).transform(*PLACES_M.T)
        found = MapFrame(ORIGIN).geodetic(PLACES_M)
        np.testing.assert_allclose(found[:, :2], np.stack([latitude, longitude], axis=-1), rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(found[:, 2], height, rtol=0.0, atol=1e-6)

    def test_too_far_from_the_origin(self) -> None:
        with pytest.raises(ValueError, match="within 100 km"):
            MapFrame(ORIGIN).geodetic(np.array([[372000.0, 5808000.0, 0.0]]))


class TestProject:
    @pytest.mark.parametrize("zone", [32632, 32633, 25833, 3857])
    def test_is_that_of_proj(self, zone: int) -> None:
        """UTM of two zones, ETRS89 and web Mercator: convergence and scale count."""
        longitude, latitude, _ = pyproj.Transformer.from_pipeline(TOPOCENTRIC).transform(*PLACES_M.T)
        expected = pyproj.Proj(f"EPSG:{zone}")(longitude, latitude)
        found = MapFrame(ORIGIN, f"EPSG:{zone}").project(PLACES_M)
        np.testing.assert_allclose(found, np.stack(expected, axis=-1), rtol=0.0, atol=1e-4)

    def test_a_metre_in_degrees(self) -> None:
        east, north = MapFrame(ORIGIN).units_per_m
        assert 1.0 / east == pytest.approx(111320.0 * np.cos(np.radians(LATITUDE)), rel=5e-3)
        assert 1.0 / north == pytest.approx(111132.0, rel=5e-3)


class TestBadInput:
    def test_unknown_system(self) -> None:
        with pytest.raises(ValueError, match=r"a system that PROJ knows.*'EPSG:999999'"):
            MapFrame(ORIGIN, "EPSG:999999")

    def test_a_geocentric_system(self) -> None:
        with pytest.raises(ValueError, match=r"projected or geographic.*WGS 84"):
            MapFrame(ORIGIN, "EPSG:4978")

    def test_origin_outside_the_area(self) -> None:
        """Zone 10 lies in America; zone 32 serves all of Germany."""
        with pytest.raises(ValueError, match=r"a system for latitude 52\.41.*longitude -126 to -120"):
            MapFrame(ORIGIN, "EPSG:32610")
        MapFrame(ORIGIN, "EPSG:25832")

    def test_no_name(self) -> None:
        with pytest.raises(ValueError, match=r"a system that PROJ knows.*''"):
            MapFrame(ORIGIN, "")


class TestLabel:
    @pytest.mark.parametrize("crs", ["EPSG:25833", "25833", "ETRS89 / UTM zone 33N", "EPSG:25833+5783"])
    def test_names_the_horizontal_system_by_its_authority(self, crs: str) -> None:
        """Other programs do not take a bare number, and files have no heights of the system."""
        assert MapFrame(ORIGIN, crs).label == "EPSG:25833"
