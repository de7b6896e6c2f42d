"""Areas of coordinate systems."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.logs.systems import area_words, coordinate_system, is_outside_area


class TestIsOutsideArea:
    @pytest.mark.parametrize(
        ("crs", "inside", "outside"),
        [
            ("EPSG:32633", [(52.4, 13.1), (52.4, 9.0), (-3.0, 15.0)], [(52.4, -73.0), (52.4, 24.0), (-34.0, 15.0)]),
            ("EPSG:32734", [(-33.9, 18.4)], [(33.9, 18.4)]),
            ("EPSG:3460", [(-17.8, 178.0), (-17.0, -179.0), (-17.0, 181.0)], [(-17.8, 150.0), (-17.8, -150.0)]),
            ("EPSG:4326", [(89.0, 179.0), (-89.0, -180.0)], [(99.0, 0.0), (np.inf, np.inf)]),
        ],
    )
    def test_four_degrees_beyond_the_borders(
        self, crs: str, inside: list[tuple[float, float]], outside: list[tuple[float, float]]
    ) -> None:
        """Fiji's grid reaches over the meridian of 180 degrees."""
        found = is_outside_area(coordinate_system(crs), *np.array([*inside, *outside, (np.nan, np.nan)]).T)
        assert found.tolist() == [False] * len(inside) + [True] * len(outside) + [False]

    def test_a_system_without_an_area(self) -> None:
        system = coordinate_system("+proj=utm +zone=33")
        assert not is_outside_area(system, np.array([52.4]), np.array([-73.0])).any()
        assert area_words(system) == ""
