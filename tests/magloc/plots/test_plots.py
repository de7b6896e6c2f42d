"""Figures: what they show is the data, by their artists; units on every axis; colours that can be told apart.

Oracles: scipy.stats for quantiles, scikit-image for colour spaces, Machado, Oliveira and Fernandes (2009) for what the
colour-blind see.
"""

from __future__ import annotations

import io
import math
import re
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import Any

import numpy as np
import PIL.Image
import pytest
import xarray as xr
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Patch
from matplotlib.text import Text
from numpy.typing import NDArray
from scipy.stats import chi2, norm
from skimage.color import rgb2lab

from arrays.geometries import grid, tetrahedron
from arrays.sensor import Calibration
from magloc.bounds.maps import BoundScenario, bound_slices
from magloc.chi_square import square_columns
from magloc.convergence.over_starts import StartStatus
from magloc.localization.fit.export import distances_from_truth, fix_columns
from magloc.localization.fit.results import Fix, Solution
from magloc.plots import style
from magloc.plots.bounds import _palette
from magloc.plots.bounds import bound_slices as bound_slices_figure
from magloc.plots.calibrations import calibration_figure, turning_figure
from magloc.plots.localization import fix_figure, residual_figure
from magloc.plots.maps import _SOURCE_ENDS, convergence
from magloc.plots.style import save
from magloc.plots.tracks import consistency_figure, track_figure
from magloc.tracking.results import TrackPoint
from tests.plain_locator import columns_of, one_source

FloatArray = NDArray[np.float64]
# Linear RGB as seen without one of the three kinds of cones, severity 1.
COLOUR_BLIND = {
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "tritanopia": [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]],
}
IN_ONE_PANEL = [
    [colour for _, colour, _, _ in style.COMPONENTS],
    [style.ESTIMATE, style.TRUTH, style.BOUND],
    [colour for colour, _, _ in _SOURCE_ENDS.values()],
]
COVARIANCE = np.diag([0.04, 0.01, 0.09, 4.0, 1.0, 9.0])


def track(n: int = 12, lost: tuple[int, ...] = (0, 5, 6)) -> list[TrackPoint]:
    """A track along x that is not there in some rows."""
    points = []
    for i in range(n):
        if i in lost:
            points.append(TrackPoint(0.5 * i, status="not acquired"))
            continue
        position, moment = np.array([float(i), 3.0, -1.0]), np.array([0.0, 30.0, 40.0])
        points.append(
            TrackPoint(0.5 * i, position, moment, COVARIANCE, np.linspace(0.1, 0.6, 6), 2, 9.0 + i, 9, "tracked")
        )
    return points


def solution(position: FloatArray, *, observable: bool = True, high: float | None = None) -> Solution:
    interval = ((3.5 if observable else 0.5, high if high is not None or not observable else 6.0),)
    return one_source(position, [1.0, 2.0, 3.0], COVARIANCE, chi2=4.0, dof=6, range_interval_m=interval)


def line(ax: Axes, label: str) -> Line2D:
    (found,) = [artist for artist in ax.lines if artist.get_label() == label]
    return found


def ellipses(ax: Axes) -> list[Ellipse]:
    return [patch for patch in ax.patches if isinstance(patch, Ellipse)]


def panel(figure: Figure, label: str) -> Axes:
    """The panel whose upright axis is named so."""
    (found,) = [ax for ax in figure.axes if ax.get_ylabel().replace("\n", " ") == label]
    return found


def assert_units(figure: Figure) -> None:
    """Every labelled axis names its unit in brackets, but an axis of names."""
    for ax in figure.axes:
        for label in (ax.get_xlabel(), ax.get_ylabel()):
            assert not label or label == "sensor" or re.search(r"\[[^\]]+\]$", label), label
        assert ax.get_ylabel()


class TestColours:
    @pytest.mark.parametrize("colours", IN_ONE_PANEL)
    def test_a_grey_print_tells_them_apart(self, colours: list[str]) -> None:
        lightness = [rgb2lab(to_rgb(colour))[0] for colour in colours]
        assert min(abs(a - b) for a, b in combinations(lightness, 2)) >= 20.0

    @pytest.mark.parametrize("kind", COLOUR_BLIND)
    @pytest.mark.parametrize("colours", IN_ONE_PANEL)
    def test_the_colour_blind_tell_them_apart(self, colours: list[str], kind: str) -> None:
        """By 20 in CIELAB, where 2 to 3 is just noticed."""
        srgb = np.array([to_rgb(colour) for colour in colours])
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        seen = np.clip(linear @ np.array(COLOUR_BLIND[kind]).T, 0.0, 1.0)
        encoded = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
        assert min(np.linalg.norm(a - b) for a, b in combinations(rgb2lab(encoded), 2)) >= 20.0


class TestPrint:
    def test_a_figure_is_as_wide_as_a_page_and_fine_enough(self, tmp_path) -> None:
        figure = track_figure(track())
        assert figure.get_figwidth() == pytest.approx(180 / 25.4, abs=0.05)
        save(figure, tmp_path / "track.png")
        header = (tmp_path / "track.png").read_bytes()[16:24]
        assert int.from_bytes(header[:4], "big") == round(style.DPI * figure.get_figwidth())

    def test_no_letter_is_below_seven_points(self) -> None:
        figure = consistency_figure(track())
        figure.draw_without_rendering()
        for ax in figure.axes:
            texts = [ax.xaxis.label, ax.yaxis.label, *ax.get_xticklabels(), *ax.get_yticklabels(which="both")]
            assert min(text.get_fontsize() for text in texts) >= 7.0


class TestEllipses:
    @given(
        st.floats(1e-4, 1e3), st.floats(1e-4, 1e3), st.floats(-0.99, 0.99), st.floats(-1e3, 1e3), st.floats(-1e3, 1e3)
    )
    def test_the_rim_is_the_95_percent_contour(self, a: float, b: float, r: float, x: float, y: float) -> None:
        covariance = np.array([[a * a, r * a * b], [r * a * b, b * b]])
        ellipse = style.ellipse95(np.array([x, y]), covariance)
        angles = np.linspace(0.0, 2.0 * np.pi, 9)
        half, turned = 0.5 * np.array([ellipse.width, ellipse.height]), np.radians(ellipse.angle)
        R = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
        rim = (half * np.column_stack([np.cos(angles), np.sin(angles)])) @ R.T
        # Scaled: the inverse of a covariance of unlike numbers loses digits.
        rim, correlation = rim / [a, b], np.array([[1.0, r], [r, 1.0]])
        np.testing.assert_allclose(
            np.einsum("ni,ij,nj->n", rim, np.linalg.inv(correlation), rim), chi2.ppf(0.95, 2), rtol=1e-3
        )
        np.testing.assert_array_equal(ellipse.center, [x, y])

    @pytest.mark.parametrize("n", [0, 1, 24, 25, 1000])
    def test_few_enough_are_drawn_to_be_told_apart(self, n: int) -> None:
        chosen = style.thin(np.arange(n))
        assert min(n, 12) <= len(chosen) <= 24
        assert len(set(np.diff(chosen))) <= 1


class TestBounds:
    def test_columns_of_a_square_are_named_after_it(self) -> None:
        dof = np.array([3, 6])
        for name, of_dof in (("chi2", "dof"), ("nis", "nis_dof")):
            columns = square_columns(name, np.array([2.0, 9.0]), dof)
            assert list(columns) == [name, of_dof, f"{name}_low99", f"{name}_high99"]
            np.testing.assert_allclose(columns[f"{name}_high99"], chi2.ppf(0.995, dof))

    def test_are_not_there_without_degrees_of_freedom(self) -> None:
        assert np.isnan(style.bounds99([0, -1])).all()

    @pytest.mark.parametrize("n", [1, 2, 50])
    def test_are_drawn_where_they_are(self, n: int) -> None:
        ax = Figure().subplots()
        dof = np.full(n, 6)
        squares = np.full(n, 6.0)
        squares[0] = 1000.0
        style.draw_chi_square(ax, np.arange(n, dtype=float), squares, dof, "χ²")
        drawn = [np.unique(artist.get_ydata()) for artist in ax.lines if artist.get_drawstyle() == "steps-mid"]
        np.testing.assert_allclose(np.ravel(drawn), chi2.ppf([0.005, 0.995], 6) / 6)
        np.testing.assert_allclose(line(ax, "outside").get_ydata(), [1000.0 / 6])
        assert len(line(ax, "within").get_ydata()) == n - 1
        assert f"{100.0 * (n - 1) / n:.1f} % of {n} rows" in ax.get_title(loc="left")

    def test_the_share_within_is_what_is_promised(self) -> None:
        """Of right squares 99 % are within; 0.97 to 1 at a false-alarm rate below 1e-8 of the binomial."""
        ax = Figure().subplots()
        squares = np.random.default_rng(0).chisquare(5, 2000)
        style.draw_chi_square(ax, np.arange(2000.0), squares, np.full(2000, 5), "NIS")
        assert len(line(ax, "within").get_ydata()) > 0.97 * 2000


class TestLimits:
    @given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30), st.lists(st.floats(-1e6, 1e6), max_size=5))
    def test_show_what_must_be_seen(self, values: list[float], always: list[float]) -> None:
        low, high = style.axis_limits([np.array(values)], [np.array(always)])
        assert low < high
        assert all(low <= value <= high for value in always)
        assert low <= float(np.median(values)) <= high

    def test_one_wild_value_does_not_rule(self) -> None:
        low, high = style.axis_limits([np.append(np.linspace(0.0, 1.0, 200), 1e6)])
        assert -0.2 < low < high < 1.2

    def test_what_differs_by_rounding_alone_is_one_number(self) -> None:
        assert style.axis_limits([np.array([2.0, 2.0 + 4e-16, 2.0 - 4e-16])]) == pytest.approx((1.84, 2.16))

    def test_nothing_to_show(self) -> None:
        low, high = style.axis_limits([np.array([np.nan])])
        assert low < high

    def test_lengths_below_a_metre_are_in_millimetres(self) -> None:
        assert style.axis_unit(0.3) == ("mm", 1e3)
        assert style.axis_unit(30.0) == ("m", 1.0)


class TestMaps:
    """Maps of 3³ points: the slice z = 0 has every end of a start, the other cells converge in 10 passes."""

    def dataset(self) -> xr.Dataset:
        axis = np.array([-1.0, 0.0, 1.0])
        status, passes = np.zeros((3, 3, 3), dtype=np.int8), np.full((3, 3, 3), 10, dtype=np.int32)
        status[:, 0, 1] = StartStatus.OTHER_OPTIMUM, StartStatus.NOT_STOPPED, StartStatus.DIVERGED
        passes[2, 2, 1] = 40
        return xr.Dataset(
            {
                "status": (("x", "y", "z"), status),
                "iterations": (("x", "y", "z"), passes),
                "half": (("x", "y", "z"), np.ones((3, 3, 3), dtype=np.int8)),
            },
            {"x": axis, "y": axis, "z": axis},
            {
                "position_m": [0.0, 0.0, 0.0],
                "centroid_m": [-1.0, 0.0, 0.0],
                "moment_Am2": [100.0, 0.0, 0.0],
                "method": "repeated",
                "seconds": 1.0,
            },
        )

    def figure(self) -> Figure:
        return convergence(self.dataset())

    def test_values_are_shown_where_the_start_converged(self) -> None:
        figure = self.figure()
        shown = figure.axes[0].images[-1].get_array()
        assert shown is not None
        # Rows of the image are y, columns are x.
        np.testing.assert_array_equal(np.ma.getmaskarray(shown), [[True] * 3, [False] * 3, [False] * 3])
        assert shown[2, 2] == 40
        assert shown[1, 1] == 10
        assert figure.axes[0].get_xlabel() == "start x [m]"
        assert_units(figure)

    def test_every_point_is_in_the_middle_of_its_cell(self) -> None:
        axis = self.dataset()["x"].to_numpy()
        half = 0.5 * (axis[1] - axis[0])
        ends = [axis[0] - half, axis[-1] + half] * 2
        assert [list(ax.images[-1].get_extent()) for ax in self.figure().axes[:3]] == [ends] * 3

    def test_other_ends_are_hatched_each_in_its_way(self) -> None:
        figure = self.figure()
        hatches = [hatch for artist in figure.axes[0].collections for hatch in getattr(artist, "hatches", [])]
        assert sorted(hatches) == ["////", "xxxx"]
        assert not figure.axes[2].images[-1].get_array().mask.all()
        named = {text.get_text(): handle.get_hatch() for text, handle in self.legend(figure)}
        assert (named["did not stop"], named["diverged"], named["stopped elsewhere"]) == ("////", "xxxx", "")

    def test_a_headline_stays_on_the_page(self) -> None:
        """A moment of many figures makes it longer than the page is wide; of a half without a start it says nothing."""
        dataset = self.dataset()
        dataset.attrs["moment_Am2"] = [-123456.0, -23456.7, -1.23456e-05]
        figure = convergence(dataset)
        figure.canvas.draw()
        title = figure.get_suptitle()
        assert "front half 88.9 %, median 10 passes" in title
        (box,) = [text.get_window_extent() for text in figure.texts if text.get_text() == title]
        assert 0.0 <= box.x0 < box.x1 <= figure.bbox.width

    def legend(self, figure: Figure) -> list[tuple[Any, Any]]:
        (legend,) = figure.legends
        pairs = zip(legend.get_texts(), legend.legend_handles, strict=True)
        return [(text, handle) for text, handle in pairs if isinstance(handle, Patch)]


class TestBoundSlices:
    def test_bearings_are_in_degrees_and_planes_to_one_scale(self) -> None:
        scenario = BoundScenario(moment_Am2=(60.0, 50.0, 60.0), n_moments=3)
        dataset = bound_slices(scenario, 5)
        axes = bound_slices_figure(dataset, scenario).axes
        shown = [np.ma.filled(ax.images[0].get_array(), np.nan) for ax in axes[:9]]
        names = ("sigma_range", "sigma_range_q95", "sigma_bearing_q95")
        for images, name, unit in zip(np.split(np.array(shown), 3), names, (1.0, 1.0, 180.0 / math.pi), strict=True):
            values = unit * dataset[name].to_numpy()
            known = np.isfinite(values)
            np.testing.assert_allclose(images[known], values[known])
            assert known.any()
        assert {ax.get_aspect() for ax in axes[:9]} == {1.0}

    def test_small_arrays_are_in_millimetres_and_nothing_is_cut(self) -> None:
        scenario = BoundScenario(grid(3, 3, 0.02), (0.0, 1e-3, 1e-3), half_width_m=0.1, accuracy_m=1e-3, n_moments=3)
        dataset = bound_slices(scenario, 11)
        figure = bound_slices_figure(dataset, scenario)
        first = figure.axes[0]
        assert (first.get_ylabel(), first.get_images()[0].get_extent()[1]) == ("y [mm]", pytest.approx(110.0))
        shown, sigma_m = np.ma.filled(first.get_images()[0].get_array(), np.nan), dataset["sigma_range"].to_numpy()[0]
        known = np.isfinite(sigma_m)
        np.testing.assert_allclose(shown[known], 1e3 * sigma_m[known])
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        texts = [text for text in figure.findobj(Text) if text.get_text() and text.get_visible()]
        assert "required: 1 mm" in [text.get_text() for text in texts]
        assert not [text.get_text() for text in texts if "e-" in text.get_text()]
        for ax in figure.axes:
            for label in (ax.xaxis.label, ax.yaxis.label):
                place = label.get_window_extent()
                assert place.x0 >= 0.0, label.get_text()
                assert place.x1 <= figure.bbox.width, label.get_text()


class TestTrack:
    def test_bands_are_95_percent_and_gaps_are_hatched(self) -> None:
        points = track()
        figure = track_figure(points)
        for name, sigma, centre in (("y [m]", 0.1, 3.0), ("z [m]", 0.3, -1.0)):
            ax = next(ax for ax in figure.axes if ax.get_ylabel() == name and ax.get_xlabel() == "time [s]")
            (gaps,) = (drawn for drawn in ax.collections if drawn.get_hatch())
            band = next(drawn for drawn in ax.collections if not drawn.get_hatch())
            heights = band.get_datalim(ax.transData).intervaly
            np.testing.assert_allclose(heights, centre + norm.ppf([0.025, 0.975]) * sigma)
            spans = [path.get_extents().intervalx.tolist() for path in gaps.get_paths()]
            assert spans == [[0.0, 0.5], [2.0, 3.5]]

    def test_moment_band_is_along_the_moment(self) -> None:
        """Moment (0, 3, 4)/5 with variances (4, 1, 9): the modulus has the variance 0.36 + 0.64 · 9."""
        ax = panel(track_figure(track()), "moment [A·m²]")
        heights = ax.collections[0].get_datalim(ax.transData).intervaly
        np.testing.assert_allclose(heights, 50.0 + norm.ppf([0.025, 0.975]) * math.sqrt(0.36 + 0.64 * 9.0))

    def test_plan_shows_track_truth_array_and_ellipses(self) -> None:
        points = track()
        truth = np.column_stack([np.arange(12.0), np.full(12, 3.1), np.full(12, -1.0)])
        array_m = np.column_stack([np.linspace(-3.0, 2.0, 12), np.zeros(12), np.zeros(12)])
        plan = track_figure(points, truth, array_m).axes[0]
        np.testing.assert_allclose(line(plan, "truth").get_xydata(), truth[:, :2])
        np.testing.assert_allclose(line(plan, "path of the array").get_xydata(), array_m[:, :2])
        np.testing.assert_allclose(line(plan, "array").get_xydata(), array_m[-1:, :2])
        assert len(ellipses(plan)) == 9
        assert plan.get_aspect() == 1.0
        low, high = plan.get_xlim()
        assert low < -3.0 < 11.0 < high

    def test_a_straight_track_has_a_plan_that_is_not_all_width(self) -> None:
        plan = track_figure(track(), array_m=np.array([[0.0, 3.0, 0.0]])).axes[0]
        (left, right), (low, high) = plan.get_xlim(), plan.get_ylim()
        assert high - low == pytest.approx(0.2 * (right - left))

    def test_millimetres_scale_ellipses_too(self) -> None:
        small = [
            TrackPoint(float(i), np.array([0.01 * i, 0.02, 0.0]), np.ones(3), 1e-6 * np.eye(6), status="tracked")
            for i in range(5)
        ]
        figure = track_figure(small)
        assert figure.axes[0].get_xlabel() == "x [mm]"
        assert np.ptp(panel(figure, "z [mm]").get_ylim()) > 0.4  # of what stays 0, in a plan of 46 mm
        assert ellipses(figure.axes[0])[0].width == pytest.approx(2.0 * math.sqrt(chi2.ppf(0.95, 2)))

    def test_a_source_that_stands_still_is_marked(self) -> None:
        plan = track_figure(track(), np.tile([1.0, 2.0, 3.0], (12, 1))).axes[0]
        assert line(plan, "truth").get_marker() == "+"

    def test_units(self) -> None:
        assert_units(track_figure(track()))


class TestConsistency:
    def test_without_truth(self) -> None:
        figure = consistency_figure(track())
        assert len(figure.axes) == 3
        assert_units(figure)

    def test_errors_against_what_is_stated_and_possible(self) -> None:
        points = track()
        truth = np.column_stack([np.arange(12.0) + 0.3, np.full(12, 3.4), np.full(12, np.nan)])
        bound = np.full(12, 0.2)
        bound[0] = np.inf
        figure = consistency_figure(points, truth, (np.full(12, 2.0), np.full(12, 2)), bound)
        assert len(figure.axes) == 5
        assert_units(figure)
        tracked = [i for i in range(12) if i not in (0, 5, 6)]
        ax = panel(figure, "distance from the truth [m]")
        np.testing.assert_allclose(line(ax, "error").get_ydata()[tracked], 0.5)
        np.testing.assert_allclose(line(ax, "σ that the track states").get_ydata()[tracked], math.sqrt(0.05))
        np.testing.assert_allclose(line(ax, "posterior Cramér-Rao bound").get_ydata()[1:], 0.2)

    def test_estimability_by_component(self) -> None:
        figure = consistency_figure(track())
        for label, first in (("estimability of the position [1]", 0), ("estimability of the moment [1]", 3)):
            drawn = panel(figure, label).lines[:3]
            for i, artist in enumerate(drawn):
                np.testing.assert_allclose(artist.get_ydata()[1:5], np.linspace(0.1, 0.6, 6)[first + i])
            assert len({artist.get_linestyle() for artist in drawn}) == 3


class TestFixes:
    SENSORS = np.array([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, -0.5, 0.0]])

    def figure(self, fixes: list[Fix], truth_m: FloatArray | None = None) -> Figure:
        n = len(fixes)
        columns = fix_columns(columns_of(fixes))
        return fix_figure(columns, np.broadcast_to(self.SENSORS, (n, 4, 3)), truth_m)

    def test_planes_show_fixes_sensors_and_ellipses_to_one_scale(self) -> None:
        places = [np.array([2.0 + i, 1.0, 0.5]) for i in range(3)]
        figure = self.figure([Fix((solution(place),)) for place in places])
        widths = []
        for ax, plane in zip(figure.axes[:3], ([0, 1], [0, 2], [1, 2]), strict=True):
            np.testing.assert_allclose(line(ax, "fixes").get_xydata(), np.array(places)[:, plane])
            np.testing.assert_allclose(line(ax, "sensors").get_xydata(), self.SENSORS[:, plane])
            expected = 2.0 * np.sqrt(np.linalg.eigvalsh(COVARIANCE[np.ix_(plane, plane)]) * chi2.ppf(0.95, 2))
            (first, *_) = ellipses(ax)
            np.testing.assert_allclose(sorted([first.width, first.height]), expected)
            widths += [np.ptp(ax.get_xlim()), np.ptp(ax.get_ylim())]
        np.testing.assert_allclose(widths, widths[0])
        assert_units(figure)

    @pytest.mark.parametrize(("high", "arrows"), [(6.0, 0), (None, 1)])
    def test_an_unknown_range_is_a_line_and_not_an_ellipse(self, high: float | None, arrows: int) -> None:
        plane = self.figure([Fix((solution(np.array([3.0, 4.0, 0.0]), observable=False, high=high),))]).axes[0]
        assert not ellipses(plane)
        drawn = line(plane, "95 % of the range").get_xydata()
        far = 6.0 if high is not None else 15.0
        np.testing.assert_allclose(drawn, [[0.3, 0.4], [0.6 * far, 0.8 * far]])
        assert len(plane.texts) == arrows

    def test_error_and_bound(self) -> None:
        truth = np.array([[2.0, 1.0, 0.0], [3.0, 1.0, np.nan]])
        fixes = [Fix((solution(np.array([2.0, 1.0, 0.5])),)), Fix((solution(np.array([3.0, 1.25, 0.5])),))]
        ax = panel(self.figure(fixes, truth), "distance [mm]")
        np.testing.assert_allclose(line(ax, "error").get_ydata(), [500.0, 250.0])
        stated = line(ax, "σ (Cramér-Rao bound at the fix)").get_ydata()
        np.testing.assert_allclose(stated, 1e3 * math.sqrt(np.trace(COVARIANCE[:3, :3])))

    def test_rows_without_a_solution_are_left_out(self) -> None:
        figure = self.figure([Fix((solution(np.array([2.0, 1.0, 0.5])),)), Fix((), "no signal")])
        assert len(line(figure.axes[0], "fixes").get_xdata()) == 1
        assert "of 1 rows" in panel(figure, "χ² / degrees of freedom [1]").get_title(loc="left")

    def test_a_known_place_shows_the_moment(self) -> None:
        known = one_source(np.ones(3), [0.0, 3.0, 4.0], np.eye(3), chi2=4.0, dof=9, range_interval_m=())
        ax = panel(self.figure([Fix((known,))]), "moment [A·m²]")
        (bars,) = [artist for artist in ax.collections if isinstance(artist, LineCollection)]
        np.testing.assert_allclose(bars.get_segments()[0][:, 1], 5.0 + norm.ppf([0.025, 0.975]))

    def test_distance_counts_known_coordinates_only(self) -> None:
        columns = fix_columns(columns_of([Fix((solution(np.array([3.0, 4.0, 9.0])),))]))
        assert distances_from_truth(columns, np.array([[0.0, 0.0, np.nan]])) == pytest.approx(5.0)
        assert np.isnan(distances_from_truth(columns, np.full((1, 3), np.nan)))


class TestResiduals:
    def test_bars_are_quantiles(self) -> None:
        residuals = np.random.default_rng(1).normal(size=(200, 4))
        residuals[:50, 1] = np.nan
        names, owner = ("s1_x", "s1_y", "s1_z", "s2"), np.array([0, 0, 0, 1])
        figure = residual_figure(residuals, names, ("s1", "s2"), owner)
        assert_units(figure)
        (ax,) = figure.axes
        bars = {artist.get_gid(): artist for artist in ax.collections if artist.get_gid()}
        for c, name in enumerate(names):
            for kind, quantiles in (("most", [0.05, 0.95]), ("half", [0.25, 0.75])):
                ends = bars[f"{name} {kind}"].get_segments()[0][:, 1]
                np.testing.assert_allclose(ends, np.nanquantile(residuals[:, c], quantiles))
        band = ax.patches[0]
        np.testing.assert_allclose([band.get_y(), band.get_y() + band.get_height()], norm.ppf([0.05, 0.95]))

    def test_sensors_that_were_never_used(self) -> None:
        figure = residual_figure(np.full((3, 3), np.nan), ("a_x", "a_y", "a_z"), ("a",), np.zeros(3, dtype=int))
        assert [text.get_text() for text in figure.axes[0].get_xticklabels()] == ["a"]


class TestCalibration:
    def arguments(self) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        change = np.arange(30.0).reshape(2, 15) * 1e-3
        deviation, estimated = np.full((2, 15), 2e-4), np.ones((2, 15), dtype=bool)
        return change, deviation, estimated

    def result(self, change: Any, sigma: Any, estimated: Any, before: Any, after: Any) -> Any:
        ids = SimpleNamespace(ids=("a", "b"))
        return SimpleNamespace(array=ids, change=change, sigma=sigma, estimated=estimated, rms_T=(before, after))

    def test_changes_with_their_intervals(self) -> None:
        figure = calibration_figure(self.result(*self.arguments(), np.array([1e-6, 2e-6]), np.array([1e-8, 2e-8])))
        assert_units(figure)
        top = panel(figure, "residual rms [nT]")
        np.testing.assert_allclose(line(top, "before").get_ydata(), [1000.0, 2000.0])
        np.testing.assert_allclose(line(top, "after").get_ydata(), [10.0, 20.0])
        for label, first, scale in (("position [mm]", 0, 1e3), ("gain [%]", 3, 1e2), ("offset [µT]", 12, 1e6)):
            ax = panel(figure, f"change of {label}")
            for k, container in enumerate(ax.containers):
                values = scale * np.array([first + k, 15 + first + k]) * 1e-3
                np.testing.assert_allclose(container.lines[0].get_ydata(), values)
                ends = container.lines[2][0].get_segments()[0][:, 1]
                np.testing.assert_allclose(ends, values[0] + norm.ppf([0.025, 0.975]) * scale * 2e-4)

    def test_what_is_not_estimated_has_no_panel(self) -> None:
        change, deviation, estimated = self.arguments()
        estimated[:, :3] = estimated[:, 6:] = False
        figure = calibration_figure(self.result(change, deviation, estimated, np.ones(2), np.ones(2)))
        assert [ax.get_ylabel() for ax in figure.axes] == ["residual rms [nT]", "change of\ngain [%]"]

    def test_turning(self) -> None:
        nominal, calibrated = (tetrahedron(1.0).subset(("s1", "s2")) for _ in range(2))
        scaled = (replace(s, calibration=Calibration.of("vector", 1.01, 0.0)) for s in calibrated.sensors)
        fits = dict.fromkeys(nominal.ids)
        moduli = (np.full((3, 2), 49e-6), np.full((3, 2), 48.005e-6))
        figure = turning_figure(
            SimpleNamespace(
                nominal=nominal, array=replace(calibrated, sensors=tuple(scaled)), fits=fits, time_s=np.arange(3.0),
                modulus_T=48e-6, moduli_T=moduli,
            )
        )  # fmt: skip
        assert_units(figure)
        np.testing.assert_allclose(line(figure.axes[0], "after").get_ydata(), 5.0)
        np.testing.assert_allclose(figure.axes[1].containers[0].lines[0].get_ydata(), 1.0)


def test_a_notebook_shows_a_figure_without_pyplot() -> None:
    """IPython asks for PNG by this name; 120 dots an inch are as wide as a page on a screen."""
    figure = style.new_figure(2.0)
    picture = PIL.Image.open(io.BytesIO(figure._repr_png_()))
    assert picture.format == "PNG"
    assert picture.size == (round(120 * style.WIDTH_IN), 240)


def test_colours_of_an_animation_are_256_of_three_bytes():
    assert len(_palette()) == 3 * 256
    assert (min(_palette()), max(_palette())) == (0, 255)


def test_thousands_of_gaps_are_one_patch() -> None:
    """Gaps of 1 and of 400 s in 20,000 s: the long one is drawn, and the axis of the values keeps its limits."""
    time_s, ax = np.arange(20_000.0), Figure().subplots()
    present = time_s % 10.0 != 0.0
    present[5000:5400] = False
    ax.plot(time_s, np.sin(time_s / 1000.0))
    limits = ax.get_ylim()
    style.shade_gaps(ax, time_s, present, "gap")
    (drawn,) = ax.collections
    assert [path.get_extents().intervalx.tolist() for path in drawn.get_paths()] == [[4999.0, 5401.0]]
    assert ax.get_ylim() == limits
