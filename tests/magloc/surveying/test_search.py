"""Where the search of a survey starts sources."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.surveying.search import PITCH, Candidates, SearchGrid, peaks


def candidates(*rows: tuple[float, float, float]) -> Candidates:
    """Places along x with their χ², at a distance of 1 m from the sensors."""
    x, y, chi2 = np.array(rows).T
    place = np.column_stack([x, y, np.zeros_like(x)])
    return Candidates(place, np.ones_like(x), chi2, np.zeros((len(x), 3)))


class TestGrid:
    @pytest.mark.parametrize(("width_m", "places"), [(0.0, 1), (0.5, 1), (3.0, 3)])
    def test_one_place_at_least_across(self, width_m: float, places: int) -> None:
        """Of a line or a strip along x: in its middle, else half a pitch within its edge."""
        low, high = np.array([0.0, 5.0]), np.array([6.0, 5.0 + width_m])
        ((distance, at),) = SearchGrid.of(low, high, 1.5, [PITCH]).tiles
        assert distance == PITCH
        y = 5.0 + min(0.5 * width_m, 0.5) + np.arange(places)
        np.testing.assert_allclose(at.reshape(6, places, 3)[2, :, 1], y)
        np.testing.assert_allclose(at.reshape(6, places, 3)[:, 0, 0], 0.5 + np.arange(6.0))


class TestPeaks:
    def test_strongest_first(self) -> None:
        assert peaks(candidates((0.0, 0.0, 50.0), (20.0, 0.0, 80.0)), 25.0).tolist() == [1, 0]

    def test_below_the_threshold(self) -> None:
        assert peaks(candidates((0.0, 0.0, 24.0)), 25.0).tolist() == []

    def test_the_same_peak(self) -> None:
        """A neighbour in the grid is the same source."""
        assert peaks(candidates((0.0, 0.0, 80.0), (1.0, 0.0, 79.0)), 25.0).tolist() == [0]

    def test_a_skirt_of_a_stronger_one(self) -> None:
        assert peaks(candidates((0.0, 0.0, 1000.0), (4.0, 0.0, 300.0)), 25.0).tolist() == [0]

    def test_one_nearly_as_strong_is_no_skirt(self) -> None:
        assert peaks(candidates((0.0, 0.0, 1000.0), (4.0, 0.0, 700.0)), 25.0).tolist() == [0, 1]

    def test_weak_ones_wait(self) -> None:
        """What a strong source leaves of its field would be taken for them."""
        assert peaks(candidates((0.0, 0.0, 1e5), (30.0, 0.0, 1e3)), 25.0).tolist() == [0]

    def test_places_that_were_tried(self) -> None:
        found = candidates((0.0, 0.0, 50.0), (20.0, 0.0, 80.0))
        assert peaks(found.without(np.array([False, True])), 25.0).tolist() == [0]
