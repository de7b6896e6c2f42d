"""What a page without a server says of its rows: their readings, the numbers at the cursor, and words."""

from __future__ import annotations

import json
import re

import numpy as np

from arrays.geometries import tetrahedron
from magloc.readings import Readings
from magloc.viewer.panels.readings_plot import ReadingsPlot
from magloc.viewer.panels.static_player import static_player
from magloc.viewer.server import open_server

ARRAY = tetrahedron(1.0)


class TestCursor:
    def test_numbers_are_those_of_the_rows_that_are_played(self) -> None:
        rng = np.random.default_rng(4)
        time_s = rng.permutation(1000) * 0.25
        rows = Readings(rng.normal(0.0, 1e-7, (1000, ARRAY.n_channels)), time_s=time_s)
        played = [999, 3, 500]
        with open_server(0, "test") as server:
            plot = ReadingsPlot(server, rows, ARRAY)
            html = static_player(["<b>a</b>", "b", "c"], 2.0, 0.5, plot, played)
        found = re.search(r"= (\{.*\});", html)
        assert found
        held = json.loads(found[1])
        values = [[float(text.replace("\N{MINUS SIGN}", "-")) for text in row] for row in held["values"][0]]
        np.testing.assert_allclose(values, 1e9 * rows.values_T[played], atol=0.051)
        places, times = np.array(held["x"]), rows.time_s[played]
        slope = (places[1] - places[0]) / (times[1] - times[0])
        np.testing.assert_allclose(places - places[0], slope * (times - times[0]), atol=0.02)
        assert held["texts"] == ["<b>a</b>", "b", "c"]

    def test_no_word_ends_the_script(self) -> None:
        html = static_player(["</script>", "b"], 2.0, 0.5)
        assert html.count("</script>") == 1
        assert "<select" not in html
