"""What the figure of the complementary filters shows of the step and the outage."""

from __future__ import annotations

import numpy as np
import pytest

from adcs.plots.complementary import ComplementaryPicture, complementary_figure

ORBITS = np.linspace(0.0, 2.0, 50)


def picture(step_orbits: float, outage_orbits: float | None = None) -> ComplementaryPicture:
    errors = {name: np.full((50, 3), 0.1) for name in ("explicit", "adaptive")}
    return ComplementaryPicture("title", ORBITS, errors, step_orbits, outage_orbits)


@pytest.mark.parametrize(("step_orbits", "is_drawn"), [(0.5, True), (3.0, False), (2.0, False)])
def test_a_step_is_marked_where_it_is_shown(step_orbits: float, is_drawn: bool) -> None:
    for ax in complementary_figure(picture(step_orbits)).axes:
        upright = [line for line in ax.get_lines() if np.all(np.asarray(line.get_xdata()) == step_orbits)]
        assert len(upright) == is_drawn


@pytest.mark.parametrize("outage_orbits", [None, 1.5])
def test_an_outage_is_shaded_from_its_begin_to_the_end(outage_orbits: float | None) -> None:
    for ax in complementary_figure(picture(0.5, outage_orbits)).axes:
        shaded = [patch.get_extents().transformed(ax.transData.inverted()) for patch in ax.patches]
        edges = [edge for box in shaded for edge in (box.x0, box.x1)]
        assert edges == pytest.approx([] if outage_orbits is None else [1.5, 2.0], rel=1e-12)


def test_errors_are_drawn_by_axis_and_by_their_length() -> None:
    errors = {"explicit": np.tile([3.0, 4.0, 12.0], (50, 1))}
    axes = complementary_figure(ComplementaryPicture("title", ORBITS, errors, 9.0)).axes
    assert [np.unique(ax.get_lines()[0].get_ydata()).tolist() for ax in axes] == [[3.0], [4.0], [12.0], [13.0]]


def test_words() -> None:
    figure = complementary_figure(picture(0.5, 1.5))
    assert figure.get_suptitle() == "title"
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["explicit", "adaptive error-state"]
    assert [(text.get_text(), text.get_position()[0]) for text in figure.axes[0].texts] == [
        ("bias steps by 0.02 °/s", 0.5),
        ("without Sun sensor", 1.75),
    ]
