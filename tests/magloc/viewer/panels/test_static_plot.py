"""The readings of a page without a server: what is drawn, and the numbers at the cursor."""

from __future__ import annotations

import json
import re

import numpy as np

from arrays.geometries import tetrahedron
from magloc.readings import Readings
from magloc.viewer.panels.readings_plot import ReadingsPlot
from magloc.viewer.panels.static_plot import _path, static_plot
from magloc.viewer.server import opened

ARRAY = tetrahedron(1.0)


class TestPath:
    def test_is_broken_where_a_value_is_missing(self) -> None:
        x = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.0])
        assert _path(x, np.array([7.0, 8.0, np.nan, 9.0, np.nan, np.nan])) == "M0 7h0L1 8M3 9h0"


class TestCursor:
    def test_numbers_are_those_of_the_rows_that_are_played(self) -> None:
        rng = np.random.default_rng(4)
        time_s = rng.permutation(1000) * 0.25
        rows = Readings(rng.normal(0.0, 1e-7, (1000, ARRAY.n_channels)), time_s=time_s)
        played = [999, 3, 500]
        with opened(0, "test") as server:
            html = static_plot(ReadingsPlot(server, rows, ARRAY), played, 2.0, 0.5)
        found = re.search(r"= (\{.*\});", html)
        assert found
        cursor = json.loads(found[1])
        np.testing.assert_allclose(np.array(cursor["values"][0], dtype=float), 1e9 * rows.values_T[played], rtol=1e-4)
        places, times = np.array(cursor["x"]), rows.time_s[played]
        slope = (places[1] - places[0]) / (times[1] - times[0])
        np.testing.assert_allclose(places - places[0], slope * (times - times[0]), atol=0.02)
