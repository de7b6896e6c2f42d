"""Tests of the mock-up's figures: what is drawn is what was given, axes have units, and odd runs can be drawn too."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.figure import Figure

from adcs.mockup.navigation.fixes import FixOutcome, FixRecord
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarTrack
from adcs.mockup.vision.camera import Camera
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.plots import mockup_navigation as mockup_figures
from adcs.plots.mockup_navigation import (
    FusionPicture,
    errors_figure,
    fusion_figure,
    methods_figure,
    zeros_figure,
)
from adcs.plots.mockup_vision import SkyPicture, drive_figure, frame_figure, sky_figure
from adcs.stars.identification import NoFix
from sims.cli.mockup_files import zeros_files
from sims.experiments.mockup_navigation import zeros_run

TIME_S = 0.1 * np.arange(1, 301)
LIGHTS_M = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 2))


def track(shift_m: float = 0.0) -> PlanarTrack:
    circle = np.stack([np.cos(0.1 * TIME_S), np.sin(0.1 * TIME_S)], axis=1)
    return PlanarTrack(TIME_S, circle + shift_m, 0.1 * circle[:, ::-1] * [-1.0, 1.0], 0.2 * TIME_S)


def fixes(n: int = 40) -> FixRecord:
    time_s = 0.3 + 0.6 * np.arange(n)
    place = np.stack([np.cos(0.1 * time_s), np.sin(0.1 * time_s)], axis=1)
    heading = math.pi - np.mod(math.pi - 0.2 * time_s, 2.0 * math.pi)
    return FixRecord(time_s, time_s + 0.6, place, heading)


def drawn(figure: Figure) -> Figure:
    figure.draw_without_rendering()
    return figure


def panel(figure: Figure, title: str):
    """The panel whose title begins so."""
    (found,) = [ax for ax in figure.axes if ax.get_title(loc="left").startswith(title)]
    return found


def line(ax, label: str):
    (found,) = [one for one in ax.get_lines() if one.get_label() == label]
    return found.get_xydata()


def assert_labels_have_units(figure: Figure, without=()) -> None:
    for ax in figure.axes:
        for label in (ax.get_xlabel(), ax.get_ylabel()):
            assert not label or label in without or ("[" in label and label.endswith("]")), label


class TestZeros:
    @pytest.fixture
    def figure(self):
        readings = np.stack([0.01 * np.sin(TIME_S), np.full(300, 0.02)], axis=1)
        imu = ImuRecord(0.0, TIME_S, readings, np.full(300, 0.2))
        return drawn(zeros_figure("zeros", imu, fixes(), track(0.1), track(0.001), 141.4, 1.41))

    def test_panels(self, figure):
        assert_labels_have_units(figure)
        np.testing.assert_allclose(line(panel(figure, "accelerometer"), "body y")[:, 1], 0.02)
        np.testing.assert_allclose(panel(figure, "gyro").get_lines()[0].get_ydata(), np.degrees(0.2))
        before = panel(figure, "position before the fit: 141 mm rms")
        np.testing.assert_allclose(line(before, "X, samples")[:, 1], track(0.1).position_m[:, 0])
        np.testing.assert_allclose(
            line(before, "Y, camera"), np.column_stack([fixes().time_s, fixes().position_m[:, 1]])
        )
        assert panel(figure, "position after it: 1.4 mm").get_ylim() == before.get_ylim()

    @pytest.mark.parametrize(
        ("unknowns", "words"), [("six", "0.0051, −0.0041 true on average"), ("drift", "true at first")]
    )
    def test_found_zeros_stand_beside_true_ones_of_the_same_time(self, monkeypatch, unknowns, words):
        """Slopes start at the beginning; constant zeros are those of the middle, 7.5 s of drift later."""
        titles: list[str] = []
        monkeypatch.setattr(mockup_figures, "zeros_figure", lambda title, *_: titles.append(title) or Figure())
        runs = zeros_run(unknowns, [0])
        list(zeros_files(runs))
        assert words in titles[0]
        assert (f"{runs.results[0].run.zero_m_s2[0, 0]:.4f}, " in titles[0]) == (unknowns == "drift")

    def test_the_cameras_heading_is_drawn_when_it_arrives_and_counts_full_turns(self, figure):
        seen = line(panel(figure, "heading"), "camera, on arrival")
        late = fixes().arrival_s <= 30.0
        np.testing.assert_allclose(seen[:, 0], fixes().arrival_s[late])
        np.testing.assert_allclose(seen[:, 1], np.degrees(0.2 * fixes().time_s[late]), atol=0.2)


class TestFusion:
    def picture(self, outcomes=None, *, sigma: bool = True, shift_m: float = 0.002) -> FusionPicture:
        return FusionPicture(
            "fusion",
            track(),
            track(shift_m),
            fixes(),
            (FixOutcome.USED,) * 40 if outcomes is None else outcomes,
            np.full((300, 2), 0.001) if sigma else None,
            np.full(300, 0.001) if sigma else None,
        )

    def test_differences(self):
        figure = drawn(fusion_figure(self.picture()))
        assert_labels_have_units(figure)
        apart = line(panel(figure, "fused position less"), "X")
        np.testing.assert_allclose(apart[:, 0], fixes().time_s)
        np.testing.assert_allclose(apart[:, 1], 2.0, atol=0.2)
        slower = line(panel(figure, "fused velocity less"), "Y")
        np.testing.assert_allclose(slower[:, 0], fixes().time_s[1:] - 0.3)
        np.testing.assert_allclose(slower[:, 1], 0.0, atol=0.5)

    def test_what_is_beyond_the_limits_is_counted(self):
        picture = self.picture()
        picture.fixes.position_m[:] += 0.001 * np.random.default_rng(0).standard_normal((40, 2))
        assert not panel(drawn(fusion_figure(picture)), "fused position less").texts
        picture.fixes.position_m[20] += 3.0
        figure = drawn(fusion_figure(picture))
        texts = [text.get_text() for text in panel(figure, "fused position less").texts]
        assert texts == ["1 beyond the limits, at the edge"]

    def test_rejected_fixes_are_left_out_of_the_differences(self):
        outcomes = (*(FixOutcome.USED,) * 39, FixOutcome.REJECTED)
        figure = drawn(fusion_figure(self.picture(outcomes)))
        assert len(line(panel(figure, "fused position less"), "X")) == 39

    @pytest.mark.parametrize(("n", "texts"), [(0, ["no fixes"]), (1, [])])
    def test_without_fixes_the_panels_say_so(self, n, texts):
        picture = replace(self.picture((FixOutcome.USED,) * n), fixes=fixes(n))
        figure = drawn(fusion_figure(picture))
        assert [text.get_text() for text in panel(figure, "fused position less").texts] == texts
        assert [text.get_text() for text in panel(figure, "fused velocity less").texts] == ["no two fixes"]

    def test_errors(self):
        figure = drawn(errors_figure(self.picture()))
        assert_labels_have_units(figure)
        np.testing.assert_allclose(line(panel(figure, "error of X"), "error")[:, 1], 2.0)
        np.testing.assert_allclose(line(panel(figure, "error of the heading"), "error")[:, 1], 0.0, atol=1e-9)
        low, high = panel(figure, "error of Y").get_ylim()
        assert low < -3.0 < 3.0 < high

    @pytest.mark.parametrize("outcome", [FixOutcome.REJECTED, FixOutcome.UNUSED])
    def test_all_fixes_rejected_or_unused_and_no_sigma(self, outcome):
        picture = self.picture((outcome,) * 40, sigma=False)
        drawn(fusion_figure(picture))
        labels = panel(drawn(errors_figure(picture)), "path").get_legend_handles_labels()[1]
        assert ("rejected fixes" in labels) == (outcome is FixOutcome.REJECTED)

    def test_methods(self):
        error_mm = np.where(np.arange(300) % 10 == 7, 4.0, 1.0)
        figure = drawn(methods_figure([("a", TIME_S, error_mm), ("b", TIME_S, 10.0 * error_mm)], 10.0))
        assert_labels_have_units(figure)
        np.testing.assert_allclose(line(figure.axes[0], "b")[:, 1], 40.0)
        assert figure.axes[0].get_yscale() == "log"


class TestSky:
    def frame(self, fix, n_stars=3) -> Figure:
        image = np.full((480, 640), 20, np.uint8)
        stars = np.array([[100.0, 50.0], [300.0, 200.0], [630.0, 470.0]])
        return drawn(frame_figure("frame", image, stars[:n_stars], fix, LIGHTS_M, Camera()))

    def test_frame(self):
        fix = CameraFix(np.array([0.2, -0.1]), 0.5, np.array([[0, 7], [2, 11]]), 1e-4, 2, 0.9 / 640)
        figure = self.frame(fix)
        assert_labels_have_units(figure)
        frame, ceiling = figure.axes
        np.testing.assert_allclose(line(frame, "identified"), [[100.0, 50.0], [630.0, 470.0]])
        np.testing.assert_allclose(line(frame, "not identified"), [[300.0, 200.0]])
        assert [text.get_text() for text in frame.texts] == ["7", "11"]
        assert "X 200.0 mm, Y -100.0 mm,\nheading 28.65°" in ceiling.get_title(loc="left")

    def test_frame_without_fix(self):
        figure = self.frame(NoFix("3 stars, 5 needed"))
        assert "3 stars, 5 needed" in figure.axes[1].get_title(loc="left")

    def test_frame_without_stars(self):
        dark = self.frame(NoFix("0 stars, 5 needed"), 0)
        assert "0 stars, 5 needed" in dark.axes[1].get_title(loc="left")

    @pytest.mark.parametrize("n_good", [0, 1, 12])
    def test_many_frames(self, n_good):
        good = np.arange(20) < n_good
        false = np.arange(20) >= 18
        errors_mm = np.where(good, np.linspace(0.01, 0.4, 20), np.where(false, 300.0, np.nan))
        picture = SkyPicture("sky", LIGHTS_M, np.zeros((20, 2)), errors_mm, good, false, np.arange(20) // 4)
        figure = drawn(sky_figure(picture))
        assert_labels_have_units(figure, without=("stars found in the frame", "frames"))
        labels = panel(figure, "places").get_legend_handles_labels()[1]
        assert "false fix: 2" in labels
        assert (f"good fix: {n_good}" in labels) == (n_good > 0)
        bars = panel(figure, "fixes by stars").patches
        assert sum(bar.get_height() for bar in bars) == 20

    @pytest.mark.parametrize("seen", [True, False])
    def test_drive(self, seen):
        truth = track().position_m
        fixed = truth + 1e-4 if seen else np.full_like(truth, np.nan)
        rest = np.full((5, 2), 0.2001 if seen else np.nan)
        figure = drawn(drive_figure("drive", LIGHTS_M, truth, fixed, np.arange(5.0), rest, np.full(2, 0.2)))
        assert_labels_have_units(figure)
        (apart, *_) = panel(figure, "X at rest").get_lines()
        assert np.allclose(apart.get_ydata(), 0.1) == seen or not len(apart.get_ydata())
        assert ("0.14 mm rms" in panel(figure, "perimeter drive").get_title(loc="left")) == seen
