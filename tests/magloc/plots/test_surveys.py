"""The map of a survey: where the reach has something to draw, and scales of anomalies."""

from __future__ import annotations

import numpy as np
import pytest
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
    figure = magloc.plots.survey(magloc.Survey((), ONE, rows, reach, 0.0, 25.0, 1.0, False, 0.0, 1.0))
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


class TestScale:
    def test_it_is_linear_where_most_values_are(self) -> None:
        values = np.array([-1.0, 1.0, -2.0, 2.0, 3.0, -3.0, 4.0, 4.0, 4.0, 4.0, -500.0])
        assert linear_and_most(values) == (4.0, 500.0)

    def test_of_nothing(self) -> None:
        linear, most = linear_and_most(np.zeros(5))
        assert 0.0 < linear < most
