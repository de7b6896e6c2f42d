"""Tests of adcs.mockup.vision.sky: the sky of the source paper, what is refused or warned of, and the file.

Who checks whom
---------------

====================  =====================================================================================
of the sky            oracle
====================  =====================================================================================
triangles, hull       scipy.spatial.Delaunay and ConvexHull; T = 2n - 2 - h of Euler's formula
spacing               scipy.spatial.distance.pdist
angles                known triangles
co-circular           four points placed on a circle, and shifted off it
====================  =====================================================================================
"""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, Delaunay
from scipy.spatial.distance import pdist

from adcs.mockup.vision.sky import AmbiguousSkyWarning, LedSky, interior_angles, led_sky, read_sky, write_sky
from arrays.io.errors import InputError

SEEDS = range(10)


def grid(columns, rows, spacing=0.2):
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return spacing * np.stack([x.ravel(), y.ravel()], axis=1)


class TestPaperSky:
    @pytest.mark.parametrize("seed", SEEDS)
    def test_180_lights_make_322_triangles_with_36_on_the_hull(self, seed):
        sky = led_sky(seed)
        assert len(sky) == 180
        assert len(Delaunay(sky.positions_m).simplices) == 322
        assert len(sky.hull) == 36
        np.testing.assert_array_equal(np.sort(ConvexHull(sky.positions_m).vertices), sky.hull)

    @pytest.mark.parametrize("seed", SEEDS)
    def test_size_and_spacing(self, seed):
        positions = led_sky(seed).positions_m
        assert pdist(positions).min() >= 0.07
        assert np.all(np.abs(positions) <= [1.5, 1.2])
        assert np.all(np.ptp(positions, axis=0) > [2.98, 2.38])

    def test_hull_does_not_hang_on_rounding(self):
        """Each light on the border stands out from the line between its neighbours, none by less than 0.1 mm."""
        for seed in SEEDS:
            sky = led_sky(seed)
            corners = sky.positions_m[ConvexHull(sky.positions_m).vertices]
            before, after = np.roll(corners, 1, axis=0), np.roll(corners, -1, axis=0)
            chord, to_corner = after - before, corners - before
            height = np.abs(chord[:, 0] * to_corner[:, 1] - chord[:, 1] * to_corner[:, 0])
            assert np.min(height / np.linalg.norm(chord, axis=1)) > 1e-4

    def test_the_seed_alone_makes_the_sky(self):
        np.testing.assert_array_equal(led_sky(3).positions_m, led_sky(3).positions_m)
        assert not np.array_equal(led_sky(3).positions_m, led_sky(4).positions_m)

    @settings(deadline=None, max_examples=30)
    @given(st.integers(4, 200), st.integers(0, 2**32 - 1))
    def test_euler(self, n, seed):
        positions = np.random.default_rng(seed).uniform(-1.0, 1.0, (n, 2))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AmbiguousSkyWarning)  # few lights may well be near a circle
            sky = LedSky(positions)
        assert len(Delaunay(positions).simplices) == 2 * n - 2 - len(sky.hull)


class TestAngles:
    def test_known_triangles(self):
        triangles = np.array([[[0, 0], [1, 0], [0, 1]], [[0, 0], [2, 0], [1, math.sqrt(3)]]], dtype=float)
        np.testing.assert_allclose(np.degrees(interior_angles(triangles)), [[90, 45, 45], [60, 60, 60]])


class TestDoubt:
    def test_random_skies_are_accepted_without_a_word(self):
        for seed in range(30):
            led_sky(seed)  # a warning is an error here

    @pytest.mark.parametrize(("columns", "rows"), [(2, 2), (5, 4), (15, 12)])
    def test_square_grid(self, columns, rows):
        with pytest.warns(AmbiguousSkyWarning, match="not unique"):
            LedSky(grid(columns, rows))

    def test_square_grid_measured_to_a_millimetre(self):
        measured = grid(15, 12) + 1e-3 * np.random.default_rng(0).standard_normal((180, 2))
        with pytest.warns(AmbiguousSkyWarning, match="nearly on one circle"):
            LedSky(measured)

    def test_triangular_grid_is_unique_but_says_nothing(self):
        triangular = grid(15, 12)
        triangular[:, 0] += 0.5 * triangular[:, 1]
        triangular[:, 1] *= math.sqrt(0.75)
        with pytest.warns(AmbiguousSkyWarning, match="alike"):
            LedSky(triangular)

    def test_one_square_among_many_lights(self):
        """A small square in an empty place: its circle holds no other light."""
        others = led_sky(0).positions_m
        square = 0.01 * np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) + [0.2, 0.1]
        with pytest.warns(AmbiguousSkyWarning, match="unique: 1 of"):
            LedSky(np.concatenate([others[np.linalg.norm(others - square[0], axis=1) > 0.05], square]))

    def test_margin_is_zero_on_a_circle_and_grows_off_it(self):
        angles = np.radians([10.0, 80.0, 190.0, 300.0])
        four = np.stack([np.cos(angles), np.sin(angles)], axis=1)
        with pytest.warns(AmbiguousSkyWarning):
            on_circle = LedSky(four)
        np.testing.assert_allclose(on_circle.cocircular_margins_rad, 0.0, atol=1e-12)
        margins = [LedSky(four * [[factor], [1], [1], [1]]).cocircular_margins_rad for factor in (1.1, 1.3)]
        assert 0.0 < margins[0][0] < margins[1][0]


class TestRefused:
    @pytest.mark.parametrize(
        ("positions", "words"),
        [
            ([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]], "at least 4 lights; instead received 3"),
            ([[0.0, 0.0, 0.0]] * 4, r"shape \(n, 2\)"),
            ([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.0, math.nan]], "finite"),
            ([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0]], "lights 1 and 3 at the same one"),
            ([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [0.5, 0.5]], "one line"),
        ],
    )
    def test_no_sky(self, positions, words):
        with pytest.raises(ValueError, match=words):
            LedSky(np.array(positions))

    def test_lights_cannot_be_moved(self):
        with pytest.raises(ValueError, match="read-only"):
            led_sky(0).positions_m[0] = 0.0


class TestFile:
    @pytest.mark.parametrize("name", ["laboratory", 'a "quoted" \\ name', "Небо"])
    def test_round_trip_is_exact(self, tmp_path, name):
        sky = LedSky(led_sky(5).positions_m, name)
        write_sky(sky, tmp_path / "sky.toml")
        again = read_sky(tmp_path / "sky.toml")
        np.testing.assert_array_equal(again.positions_m, sky.positions_m)
        assert again.name == name

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ("positions_m = [[0, 0], [1, 0], [0, 1]]", "at least 4 lights"),
            ("positions_m = []", "at least 4 lights"),
            ("positions_m = [[0, 0], [1, 0], [0, 1], [3]]", r"key positions_m\[3\]"),
            ("positions_m = [[0, 0], [1, 0], [0, 1], [3, 'x']]", "expected a number"),
            ("positions_m = [[0, 0], [1, 0], [0, 1], [3, nan]]", "finite"),
            ("positions = [[0, 0]]", "key positions: found an unknown key"),
            ("name = 'empty'", "found no key positions_m"),
            ("format_version = 2\npositions_m = [[0, 0], [1, 0], [0, 1], [3, 2]]", "expected 1"),
            ("positions_m = [[0, 0]", "line 1"),
        ],
    )
    def test_no_sky_in_it(self, tmp_path, text, words):
        path = tmp_path / "sky.toml"
        path.write_text(text)
        with pytest.raises(InputError, match=words) as raised:
            read_sky(path)
        assert str(path) in str(raised.value)
        assert "\n" not in str(raised.value)

    def test_no_file(self, tmp_path):
        with pytest.raises(InputError, match="does not exist"):
            read_sky(tmp_path / "sky.toml")

    def test_grid_in_a_file_is_warned_of(self, tmp_path):
        rows = ", ".join(f"[{x}, {y}]" for x, y in grid(4, 4).tolist())
        (tmp_path / "sky.toml").write_text(f"positions_m = [{rows}]")
        with pytest.warns(AmbiguousSkyWarning, match="not unique"):
            read_sky(tmp_path / "sky.toml")
