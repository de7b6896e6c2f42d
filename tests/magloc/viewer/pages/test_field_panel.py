"""Fields of a row: arrows at the sensors by their readings, a slice by the field of a dipole."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib import colormaps
from scipy.spatial.transform import Rotation

from arrays.geometries import tetrahedron
from magloc.fields.dipole import field
from magloc.localization.locator import locate
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.viewer.pages.field_panel import MEASURED, NONE, RESIDUAL, FieldPanel
from magloc.viewer.pages.fixes import FixView
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.server import open_server
from tests.waiting import wait_for

ARRAY = tetrahedron(1.5)
PLACES = np.array([[-2.0, 2.0, 0.5], [2.0, 2.0, 0.5]])
MOMENT = np.array([0.0, 0.0, 80.0])
VALUES = np.array([predicted_channels(ARRAY, place, MOMENT) for place in PLACES])


@pytest.fixture(params=[False, True], ids=["at rest", "moved"])
def panel(request: pytest.FixtureRequest) -> Iterator[FieldPanel]:
    """Readings without errors; an array that is moved reads the same in its own frame."""
    pose = {}
    if request.param:
        pose = {"array_position_m": np.ones((2, 3)), "array_rotation": Rotation.from_rotvec([[0.1, 0.2, 0.3]] * 2)}
    rows = Readings(VALUES, time_s=np.arange(2.0), **pose)
    fixes = locate(ARRAY, rows)
    with open_server(0, "test") as server:
        centroids = np.tile(ARRAY.centroid, (2, 1))
        view = FixView(server, rows.time_s, fixes, centroids, size_m=0.5, reach_m=1.0, dot_m=0.01)
        view.show_row(0)
        yield FieldPanel(server, ARRAY, view, rows, 0.5)


def arrows(panel: FieldPanel) -> np.ndarray:
    points = np.asarray(panel._arrows._arrows.points)
    return points[:, 1] - points[:, 0]


class TestArrows:
    def test_measured_ones_are_the_field_beyond_its_mean(self, panel: FieldPanel) -> None:
        set_value(panel.arrows_dropdown, MEASURED)
        wait_for(lambda: "longest arrow" in panel._panel.content)
        fields = field(ARRAY.positions, PLACES[0], MOMENT)
        beyond = fields - fields.mean(axis=0)
        longest = np.linalg.norm(beyond, axis=1).max()
        np.testing.assert_allclose(arrows(panel), 0.5 * beyond / longest, atol=1e-5)
        panel._view.show_row(1)
        panel.show_row(1)
        fields = field(ARRAY.positions, PLACES[1], MOMENT)
        beyond = fields - fields.mean(axis=0)
        np.testing.assert_allclose(arrows(panel), 0.5 * beyond / np.linalg.norm(beyond, axis=1).max(), atol=1e-5)

    def test_residuals_of_an_exact_fix_are_nothing_beside_it(self, panel: FieldPanel) -> None:
        left = np.linalg.norm(panel._vectors(RESIDUAL), axis=1).max()
        assert left < 1e-3 * np.linalg.norm(panel._vectors(MEASURED), axis=1).max()

    def test_none(self, panel: FieldPanel) -> None:
        set_value(panel.arrows_dropdown, MEASURED)
        wait_for(lambda: panel._arrows._arrows.visible)
        set_value(panel.arrows_dropdown, NONE)
        wait_for(lambda: not panel._arrows._arrows.visible)
        assert panel._panel.content == ""


class TestSlice:
    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_colours_are_the_logarithm_of_the_modulus(self, panel: FieldPanel, axis: int) -> None:
        shown = panel._slice
        low, high = shown.show(PLACES[0], MOMENT, axis)
        assert high == pytest.approx(1e3 * low)
        image, n = np.asarray(shown._image.image), len(shown._image.image)
        R = Rotation.from_quat(np.roll(shown._image.wxyz, -1)).as_matrix()
        assert abs(R[axis, 2]) == pytest.approx(1.0)
        for row, column in ((3, 5), (70, 20), (20, 130)):
            offset = np.array([column + 0.5 - n / 2, row + 0.5 - n / 2, 0.0]) * shown._side_m / n
            B = np.linalg.norm(field(PLACES[0] + R @ offset, PLACES[0], MOMENT))
            expected = colormaps["viridis"](np.log10(B / low) / 3.0, bytes=True)[:3]
            assert np.abs(image[row, column, :3].astype(int) - np.array(expected, dtype=int)).max() <= 2

    def test_field_lines_are_switched(self, panel: FieldPanel) -> None:
        lines = panel._view.best.field_lines
        assert lines is not None
        set_value(panel.lines_checkbox, False)
        wait_for(lambda: not lines.visible)
