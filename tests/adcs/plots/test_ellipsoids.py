"""What the figure of the roll/yaw satellite shows of sets, jump and time, drawn from sets that are known."""

from __future__ import annotations

import numpy as np
import pytest

from adcs.ellipsoids.roll_yaw import YAW, KalmanTrack, SetTrack
from adcs.plots.ellipsoids import RollYawPicture, ellipse_outline, roll_yaw_figure

TIME_S = np.linspace(0.0, 40.0, 21)
N = TIME_S.size


def picture(*, n_runs: int = 2, in_loop: bool = False, jump_s: float | None = None) -> RollYawPicture:
    rng = np.random.default_rng(3)
    states = 1e-3 * rng.standard_normal((n_runs, N, 2))
    shapes = np.tile(np.diag([1e-4, 4e-4]), (n_runs, N, 1, 1)) / np.linspace(1.0, 9.0, N)[:, None, None]
    track = SetTrack(states + 1e-3, shapes, np.full((n_runs, N), 2e-3), np.zeros((n_runs, N), dtype=np.int64))
    kalman = KalmanTrack(states[0] - 1e-3, shapes[0] / 9.0)
    return RollYawPicture("title", TIME_S, states, track, kalman, in_loop, jump_s)


@pytest.mark.parametrize("in_loop", [False, True])
class TestTime:
    def test_is_shown_from_begin_to_end(self, in_loop: bool) -> None:
        for ax in roll_yaw_figure(picture(in_loop=in_loop)).axes[1:]:
            assert ax.get_xlim() == (TIME_S[0], TIME_S[-1])

    @pytest.mark.parametrize("jump_s", [None, 12.0])
    def test_a_jump_is_marked(self, in_loop: bool, jump_s: float | None) -> None:
        for ax in roll_yaw_figure(picture(in_loop=in_loop, jump_s=jump_s)).axes[1:]:
            upright = [line for line in ax.get_lines() if np.array_equal(line.get_xdata(), [12.0, 12.0])]
            assert len(upright) == (jump_s is not None)


def test_words() -> None:
    figure = roll_yaw_figure(picture())
    assert figure.get_suptitle() == "title"
    legend = figure.axes[0].get_legend()
    assert legend is not None
    words = [text.get_text() for text in legend.get_texts()]
    assert words == ["0 s", "10 s", "20 s", "30 s", "40 s", "Kalman filter (white noise), 3σ", "truth"]


def test_the_roll_panel_is_not_scaled_to_the_first_set() -> None:
    """Its first set has 0.57°, the bound is 0.11° and the later sets have less than 0.3°."""
    assert 0.2 < roll_yaw_figure(picture()).axes[3].get_ylim()[1] < 0.6


def test_what_is_labelled_is_in_a_legend() -> None:
    for ax in roll_yaw_figure(picture()).axes:
        if ax.get_legend_handles_labels()[1]:
            assert ax.get_legend() is not None


def test_the_truth_is_at_the_origin_of_the_plane() -> None:
    plane = roll_yaw_figure(picture()).axes[0]
    (truth,) = (line for line in plane.get_lines() if line.get_marker() == "+")
    np.testing.assert_array_equal(truth.get_xydata(), [[0.0, 0.0]])


class TestSets:
    def test_an_outline_is_the_edge_of_the_set(self) -> None:
        root = np.random.default_rng(0).standard_normal((2, 2))
        centre, shape = np.array([3.0, -1.0]), root @ root.T
        away = ellipse_outline(centre, shape) - centre
        np.testing.assert_allclose(np.einsum("ni,ij,nj->n", away, np.linalg.inv(shape), away), 1.0, rtol=1e-9)
        np.testing.assert_allclose(ellipse_outline(centre, np.zeros((2, 2))), np.tile(centre, (181, 1)))

    def test_are_drawn_about_the_truth_at_five_instants(self) -> None:
        shown = picture()
        plane = roll_yaw_figure(shown).axes[0]
        closed = [line.get_xydata() for line in plane.get_lines() if len(line.get_xdata()) > 100]
        assert len(closed) == 10
        for j, i in enumerate((0, 5, 10, 15, 20)):
            for drawn, centre, shape in (
                (closed[2 * j], shown.track.centres[0, i], shown.track.shapes[0, i]),
                (closed[2 * j + 1], shown.kalman.means[i], 9.0 * shown.kalman.covariances[i]),
            ):
                away = np.radians(drawn) - (centre - shown.states_rad[0, i])
                norm = np.einsum("ni,ij,nj->n", away, np.linalg.inv(shape), away)
                np.testing.assert_allclose(norm, 1.0, rtol=1e-9)

    def test_runs_are_summed_up_by_largest_percentile_and_mean(self) -> None:
        shown = picture(n_runs=7)
        error = np.degrees(np.abs(shown.track.centres - shown.states_rad)[..., YAW])
        lines = roll_yaw_figure(shown).axes[2].get_lines()
        for line, wanted in zip(
            lines,
            (
                np.degrees(np.sqrt(shown.track.shapes[..., YAW, YAW])).mean(axis=0),
                error.max(axis=0),
                np.percentile(error, 95.0, axis=0),
                error.mean(axis=0),
            ),
            strict=True,
        ):
            np.testing.assert_allclose(line.get_ydata(), wanted)

    def test_the_truth_beyond_the_kalman_filter_is_counted(self) -> None:
        shown = picture()
        shown.kalman.means[:5, YAW] = shown.states_rad[0, :5, YAW] + 1.0
        title = roll_yaw_figure(shown).axes[1].get_title()
        assert title.endswith(f"{5 / N:.0%} of the time")
