"""Long records: what a row costs does not grow with their number, and nothing is squared."""

from __future__ import annotations

import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation

from arrays.geometries import tetrahedron
from magloc.measurement.differences import predicted_channels
from magloc.readings import Readings
from magloc.tracking.results import TrackPoint
from magloc.viewer.pages.pages import _nearest_rows
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.panels.readings_plot import ALL, RAW, ReadingsPlot, residuals_of
from magloc.viewer.scene.track_glyph import linear_intensities, track_segments
from tests.waiting import wait_for

ARRAY = tetrahedron(1.5)


def rows_of(n: int, rng: np.random.Generator) -> Readings:
    return Readings(rng.normal(0.0, 1e-9, (n, ARRAY.n_channels)), time_s=rng.permutation(n) * 0.1)


@pytest.mark.parametrize("n", [1, 2, 50])
def test_nearest_rows_are_those_of_all_pairs(n: int) -> None:
    rng = np.random.default_rng(n)
    rows = rows_of(n, rng)
    wanted = np.sort(rng.uniform(-1.0, 0.1 * n + 1.0, 200))
    expected = np.abs(rows.time_s[:, None] - wanted).min(axis=0)
    found = _nearest_rows(rows, [TrackPoint(float(time)) for time in wanted])
    np.testing.assert_allclose(np.abs(rows.time_s[found] - wanted), expected, atol=1e-12)


def test_a_hundred_thousand_rows_are_no_more_segments_than_five_hundred() -> None:
    positions = np.random.default_rng(1).normal(size=(100_000, 3))
    positions[50_000:50_003] = np.nan
    ends = track_segments(positions, 0, len(positions) - 1)
    assert 450 < len(ends) <= 500
    assert np.isfinite(positions[ends]).all()
    assert not ((ends[:, 0] < 50_000) & (ends[:, 1] > 50_002)).any()  # none leads over the gap
    assert ends[0, 0] == 0
    assert ends[-1, 1] == len(positions) - 1


def test_linear_colours_are_srgb_undone() -> None:
    """The inverse of the transfer function of IEC 61966-2-1."""
    share = linear_intensities(np.arange(256, dtype=np.uint8)) / 255.0
    back = np.where(share <= 0.0031308, 12.92 * share, 1.055 * share ** (1.0 / 2.4) - 0.055)
    np.testing.assert_allclose(255.0 * back, np.arange(256), atol=7.0)  # dark ones are rounded most


class TestPlot:
    def test_a_row_moves_the_mark_alone(self, server: viser.ViserServer) -> None:
        plot = ReadingsPlot(server, rows_of(2000, np.random.default_rng(2)), ARRAY)
        before, drawn, marks = plot._lines.cache_info().misses, plot.lines_panel.content, set()
        for row in (3, 700, 1999):
            plot.show_row(row)
            marks.add(plot.cursor_panel.content)
        assert len(marks) == 3
        assert plot.lines_panel.content is drawn
        assert plot._lines.cache_info().misses == before

    def test_sensors_are_chosen_from_a_list(self, server: viser.ViserServer) -> None:
        plot = ReadingsPlot(server, rows_of(20, np.random.default_rng(3)), ARRAY)
        set_value(plot.sensors_dropdown, ARRAY.ids[2])
        assert plot.lines(RAW).labels == ARRAY.sensors[2].channel_names
        wait_for(lambda: plot.lines_panel.content.count('stroke="#') == 3)
        set_value(plot.sensors_dropdown, ALL)
        wait_for(lambda: plot.lines_panel.content.count('stroke="#') == ARRAY.n_channels)


def test_a_source_leaves_the_noise_of_an_array_that_moves() -> None:
    """Readings are simulated in the array's frame, sources are stated in the world."""
    rng = np.random.default_rng(3)
    places, moments = rng.uniform(4.0, 6.0, (20, 3)), rng.normal(size=(20, 3))
    origins, R = rng.normal(size=(20, 3)), Rotation.random(20, random_state=4)
    noise = rng.normal(0.0, 1e-9, (20, ARRAY.n_channels))
    seen = predicted_channels(ARRAY, R.inv().apply(places - origins), R.inv().apply(moments))
    rows = Readings(seen + noise, time_s=np.arange(20.0), array_position_m=origins, array_rotation=R)
    places[7] = np.nan
    left = residuals_of(ARRAY, rows, places, moments)
    np.testing.assert_allclose(np.delete(left, 7, axis=0), np.delete(noise, 7, axis=0), atol=1e-18)
    assert np.isnan(left[7]).all()
