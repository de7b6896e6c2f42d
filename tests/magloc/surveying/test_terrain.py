"""Surveys over hills against the same surveys over flat ground: same targets, noise and errors of the pose."""

from __future__ import annotations

import math

import numpy as np
import pytest

import magloc
from tests.hills import PAIR, depth_errors, hills, plain, terrain_of, walk


class TestHills:
    @pytest.mark.parametrize("level", [False, True])
    def test_depths_count_from_the_local_ground(self, level: bool) -> None:
        flown = walk(41, hills, 5.0, 3, level=level)
        found = magloc.survey(PAIR, flown.readings, ground_m=terrain_of(hills))
        errors = depth_errors(flown, found)
        assert np.abs(errors).max() < 0.1
        for target in found:
            low, high = target.depth_interval95_m
            assert low < target.depth_m < high
            np.testing.assert_allclose(target.depth_m, hills(target.position_m[:2]) - target.position_m[2], atol=5e-3)
        assert set(found.reach_by_depth) == {0.5, 1.0, 2.0}
        np.testing.assert_allclose(
            hills(found.reach.place_m[:, :2]) - found.reach.place_m[:, 2],
            found.terrain.depth_of(found.reach.place_m),
            atol=5e-3,
        )

    def test_limits_of_heights_count_from_the_ground(self) -> None:
        flown = walk(41, hills, 5.0, 3)
        prior = magloc.SourcePrior((-math.inf, -math.inf, -1.7), (math.inf, math.inf, -0.2))
        found = magloc.survey(PAIR, flown.readings, ground_m=terrain_of(hills), prior=prior)
        assert np.abs(depth_errors(flown, found)).max() < 0.1

    def test_error_of_the_ground(self) -> None:
        """It is independent of that of the target: squares of half widths add, and 1.96 σ are 95 %."""
        flown = walk(42, plain, 5.0, 3)
        exact, rough = (magloc.survey(PAIR, flown.readings, ground_m=magloc.Terrain(sigma_m=s)) for s in (0.0, 0.1))
        assert len(exact) == len(rough) > 0
        for one, other in zip(exact, rough, strict=True):
            wide, narrow = (t.depth_interval95_m[1] - t.depth_m for t in (other, one))
            assert wide == pytest.approx(np.hypot(narrow, 0.196), rel=1e-9)

    def test_a_plane_as_a_map_is_the_plane(self) -> None:
        """The same numbers but for rounding, and the interpolation of a constant."""
        flown = walk(42, plain, 5.0, 3)
        flat, mapped = (magloc.survey(PAIR, flown.readings, ground_m=of) for of in (0.0, terrain_of(plain)))
        assert len(flat) == len(mapped)
        np.testing.assert_allclose(mapped.position_m, flat.position_m, atol=1e-6)
        np.testing.assert_allclose([t.depth_m for t in mapped], [t.depth_m for t in flat], atol=1e-6)

    def test_terrain_above_the_sensors(self) -> None:
        """Heights above the ellipsoid beside a map of heights above the sea."""
        flown = walk(41, hills, 5.0, 3)
        with pytest.raises(ValueError, match=r"ground_m must be below all sensors; .* different levels"):
            magloc.survey(PAIR, flown.readings, ground_m=terrain_of(hills).raise_by(47.0))

    @pytest.mark.slow
    def test_50_targets_are_as_deep_as_on_flat_ground(self) -> None:
        """Seeds that nothing was tuned on."""
        seeds = range(5200, 5210)
        errors = []
        for heights, ground in ((plain, 0.0), (hills, terrain_of(hills))):
            flown = [walk(seed, heights, 11.0, 5) for seed in seeds]
            errors.append(
                np.abs([depth_errors(one, magloc.survey(PAIR, one.readings, ground_m=ground)) for one in flown])
            )
        on_plain, on_hills = np.median(np.array(errors).reshape(2, -1), axis=1)
        assert np.isfinite(errors).mean() > 0.95
        assert on_hills < 1.2 * on_plain
