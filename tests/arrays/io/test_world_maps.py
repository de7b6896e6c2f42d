"""What is no place near the origin is put nowhere on the Earth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from arrays.io.world_maps import FARTHEST_M, world_place

ORIGIN = (52.41, 13.12, 41.0)


class TestWorldPlace:
    @given(st.floats(1.01 * FARTHEST_M, 1e9), st.floats(-np.pi, np.pi))
    def test_far_away_is_refused(self, distance_m: float, bearing: float) -> None:
        with pytest.raises(ValueError, match="eastings and northings of a grid"):
            world_place(distance_m * np.array([np.cos(bearing), np.sin(bearing), 0.0]), ORIGIN)

    @given(st.floats(-0.7 * FARTHEST_M, 0.7 * FARTHEST_M), st.floats(-0.7 * FARTHEST_M, 0.7 * FARTHEST_M))
    def test_near_it_is_placed(self, east_m: float, north_m: float) -> None:
        """A degree of latitude is 111 km, and of longitude at least half of that here."""
        longitude, latitude, _ = world_place(np.array([east_m, north_m, 0.0]), ORIGIN)
        assert abs(latitude - ORIGIN[0]) < 1.0
        assert abs(longitude - ORIGIN[1]) < 1.5
