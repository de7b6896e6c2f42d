"""The map of a survey: where the reach has something to draw, and scales of anomalies."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.collections import TriMesh

import arrays
import magloc
from arrays.typing import FloatArray
from magloc.surveying.results import Reach, SurveyRows, linear_and_most

ONE = arrays.SensorArray((arrays.Sensor("s", "scalar", (0.0, 0.0, 0.0), 1e-10),))
TIME_S = np.arange(10.0)
FLOWN_M = np.column_stack([TIME_S, TIME_S, np.ones(10)])


def surfaces(places_m: FloatArray, anomaly_T: FloatArray | None = None) -> list[TriMesh]:
    """Drawn of the reach of a survey without targets, at two depths of which both are one."""
    anomaly = np.zeros(10) if anomaly_T is None else anomaly_T
    reach = Reach(places_m, np.geomspace(0.1, 10.0, len(places_m)))
    rows = SurveyRows(TIME_S, FLOWN_M, anomaly, anomaly)
    figure = magloc.plots.survey(magloc.Survey((), ONE, rows, reach, magloc.Terrain(), 25.0, 1.0, False, 0.0, 1.0))
    return [shown for ax in figure.axes for shown in ax.collections if isinstance(shown, TriMesh)]


class TestReach:
    @pytest.mark.parametrize("n", [0, 1, 2, 12])
    def test_one_line_has_no_surface(self, n: int) -> None:
        along = np.arange(n) / 3.0
        assert surfaces(np.column_stack([along, 0.7 * along, np.full(n, -0.5)])) == []

    def test_nothing_across_a_gap(self) -> None:
        """Two fields of places, 1 m apart from each other, with 20 m between the fields."""
        x, y = (each.ravel() for each in np.meshgrid([0.0, 1.0, 2.0, 22.0, 23.0, 24.0], np.arange(4.0)))
        for surface in surfaces(np.column_stack([x, y, np.full(24, -0.5)])):
            triangles = [path.vertices for path in surface.get_paths()]
            assert len(triangles) == 2 * 2 * (2 * 3)
            assert max(np.ptp(each[:, 0]) for each in triangles) == 1.0


class TestProfiles:
    """Two lines, there and back 2 m beside, over a target below the first one."""

    WAY = np.concatenate([np.arange(-20.0, 21.0), np.arange(20.0, -21.0, -1.0)])
    PLACES = np.column_stack([WAY, np.repeat([0.0, 2.0], 41), np.ones(82)])

    def axes(self, number: int) -> list[Axes]:
        covariance, interval = np.eye(6) * 1e-4, (0.9, 1.1)
        target = magloc.Target("t1", np.array([18.0, 0.0, -1.0]), np.ones(3), covariance, 1.0, interval, 99.0)
        rows = SurveyRows(np.arange(82.0), self.PLACES, 1e-9 * self.WAY, np.full(82, 5e-9))
        reach = Reach(np.zeros((0, 3)), np.zeros(0))
        found = magloc.Survey((target,) * number, ONE, rows, reach, magloc.Terrain(), 25.0, 1.0, False, 0.0, 1.0)
        return magloc.plots.survey_profiles(found).axes

    def test_a_line_ends_where_it_turns(self) -> None:
        """Rows of the way there, 4 distances of 2 m before it, and none of the way back."""
        measured, targets = self.axes(1)[0].lines
        np.testing.assert_allclose(measured.get_xdata(), np.arange(-8.0, 2.0))
        np.testing.assert_allclose(measured.get_ydata(), np.arange(10.0, 20.0))
        np.testing.assert_allclose(targets.get_ydata(), measured.get_ydata())

    @pytest.mark.parametrize(("number", "drawn"), [(0, 0), (20, 12)])
    def test_as_many_as_a_page_holds(self, number: int, drawn: int) -> None:
        assert sum(bool(ax.lines) for ax in self.axes(number)) == drawn


class TestScale:
    def test_it_is_linear_where_most_values_are(self) -> None:
        values = np.array([-1.0, 1.0, -2.0, 2.0, 3.0, -3.0, 4.0, 4.0, 4.0, 4.0, -500.0])
        assert linear_and_most(values) == (4.0, 500.0)

    def test_of_nothing(self) -> None:
        linear, most = linear_and_most(np.zeros(5))
        assert 0.0 < linear < most
