"""Tiles of a survey: every row belongs to one, and every source to one."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.surveying.tiles import Tile, assign_sources, tiles_of

RNG = np.random.default_rng(8)
REACH_M = 2.0


class TestTiles:
    PLACES = RNG.uniform([0.0, 0.0], [40.0, 25.0], (4000, 2))

    def test_every_row_is_of_one(self) -> None:
        tiles, _ = tiles_of(self.PLACES, REACH_M)
        assert len(tiles) == 5 * 3
        of_all = np.concatenate([tile.rows[tile.own] for tile in tiles])
        assert sorted(of_all.tolist()) == list(range(len(self.PLACES)))

    def test_rows_are_those_in_the_margin(self) -> None:
        tiles, margin_m = tiles_of(self.PLACES, REACH_M)
        for tile in tiles:
            x, y = self.PLACES.T
            inside = (x >= tile.low_m[0] - margin_m) & (x <= tile.high_m[0] + margin_m)
            inside &= (y >= tile.low_m[1] - margin_m) & (y <= tile.high_m[1] + margin_m)
            assert tile.rows.tolist() == np.flatnonzero(inside).tolist()

    def test_no_two_that_touch_have_one_colour(self) -> None:
        tiles, _ = tiles_of(self.PLACES, REACH_M)
        for i, tile in enumerate(tiles):
            for other in tiles[:i]:
                apart = np.maximum(tile.low_m - other.high_m, other.low_m - tile.high_m).max()
                assert tile.colour != other.colour or apart > 1.0

    def test_a_small_survey_is_one(self) -> None:
        (tile,), _ = tiles_of(self.PLACES[:, ::-1] / 4.0, REACH_M)
        assert tile.own.all()
        assert np.isinf([*tile.low_m, *tile.high_m]).all()

    def test_none_where_no_rows_are(self) -> None:
        far = np.concatenate([self.PLACES, [[1e6, 1e6]]])
        tiles, _ = tiles_of(far, REACH_M)
        assert min(len(tile.rows) for tile in tiles) == 1
        assert sum(tile.own.sum() for tile in tiles) == len(far)

    def test_their_extents_leave_no_gap(self) -> None:
        """Lines 20 m apart: the rows of every tile have less than its rectangle between them."""
        x, y = (each.ravel() for each in np.meshgrid(np.linspace(0.0, 100.0, 201), np.arange(6) * 20.0))
        places = np.column_stack([x, y])
        tiles, _ = tiles_of(places, 5.7)
        ends = np.array([tile.extent_m(places[tile.rows[tile.own]]) for tile in tiles])
        assert len(tiles) == 16
        assert np.prod(ends[:, 1] - ends[:, 0], axis=1).sum() == pytest.approx(1e4)

    def test_one_line(self) -> None:
        (tile,), _ = tiles_of(np.column_stack([np.zeros(30), np.arange(30.0) / 10.0]), REACH_M)
        assert len(tile.rows) == 30


class TestOwned:
    NONE = np.zeros(0, np.intp)
    WEST = Tile(np.array([-np.inf, -np.inf]), np.array([0.0, np.inf]), NONE, NONE)
    EAST = Tile(np.array([0.0, -np.inf]), np.array([np.inf, np.inf]), NONE, NONE)

    def owned(self, west: list[list[float]], east: list[list[float]]) -> list[tuple[int, int]]:
        found = [np.reshape(np.array(places, dtype=float), (-1, 3)) for places in (west, east)]
        return sorted(assign_sources([self.WEST, self.EAST], found, 0.5))

    def test_each_its_own(self) -> None:
        assert self.owned([[-5.0, 0.0, -1.0], [5.0, 0.0, -1.0]], [[5.0, 0.0, -1.0]]) == [(0, 0), (1, 0)]

    def test_one_on_the_seam_is_found_once(self) -> None:
        """Each tile sees it on the other's side, or on its own."""
        assert len(self.owned([[0.02, 0.0, -1.0]], [[-0.02, 0.0, -1.0]])) == 1
        assert len(self.owned([[-0.02, 0.0, -1.0]], [[0.02, 0.0, -1.0]])) == 1

    def test_a_pair_on_the_seam_stays_two(self) -> None:
        pair = [[0.02, 0.0, -1.0], [0.02, 0.3, -1.0]]
        assert len(self.owned(pair, pair)) == 2

    def test_what_one_did_not_see(self) -> None:
        assert self.owned([[0.3, 0.0, -1.0]], []) == [(0, 0)]
