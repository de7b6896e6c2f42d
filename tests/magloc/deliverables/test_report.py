"""The report of a survey."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from matplotlib.figure import Figure

import magloc
from magloc.deliverables.map_frame import MapFrame
from magloc.deliverables.report import report_html
from tests.hills import hills, terrain_of

BLANK = (Figure(figsize=(1.0, 1.0)), Figure(figsize=(1.0, 1.0)))


@pytest.fixture(scope="module")
def page(survey: magloc.Survey, frame: MapFrame, figures: tuple[Figure, Figure]) -> str:
    return report_html(survey, frame, "Meadow <1>", {"size": "0 m"}, figures)


class TestReportHtml:
    def test_has_all_targets_with_their_places(self, survey: magloc.Survey, frame: MapFrame, page: str) -> None:
        cells = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in re.findall(r"<tr>.*?</tr>", page)]
        found = {row[0]: row for row in cells if row and re.fullmatch(r"t\d", row[0])}
        digits = 7 if frame.is_geographic else 2
        for target, (x, y) in zip(survey, frame.project(survey.position_m), strict=True):
            assert found[target.id][1:4] == [f"{x:.{digits}f}", f"{y:.{digits}f}", f"{target.depth_m:.2f}"]
        assert "<title>Meadow &lt;1&gt;</title>" in page
        assert ["size", "0 m"] in cells

    def test_needs_no_other_file(self, page: str) -> None:
        assert re.findall(r'(?:src|href)="(?!data:)', page) == []
        assert page.count("<img alt=") == 2

    def test_words_of_flags_that_occur(self, survey: magloc.Survey, frame: MapFrame) -> None:
        weak = replace(survey, targets=(replace(survey[0], flags=("weak",)), *survey[1:]))
        page = report_html(weak, frame, "Meadow", {}, BLANK)
        assert "<b>weak</b>: trust the depth interval" in page
        assert "<b>merged</b>" not in page

    def test_the_ground_is_below_the_origin(self, survey: magloc.Survey, frame: MapFrame) -> None:
        page = report_html(replace(survey, terrain=magloc.Terrain(-1.6)), frame, "Meadow", {}, BLANK)
        assert "<td>origin</td><td>latitude 52.4100000, longitude 13.1200000, height 41.00 m</td>" in page
        assert "<td>ground</td><td>flat, 1.6 m below the origin</td>" in page

    def test_heights_of_a_map_are_those_of_the_ground(self, survey: magloc.Survey, frame: MapFrame) -> None:
        page = report_html(replace(survey, terrain=terrain_of(hills)), frame, "Meadow", {}, BLANK)
        (words,) = re.findall("<td>ground</td><td>([^<]*)</td>", page)
        assert "at heights of " in words

    def test_a_single_line_has_no_spacing(self, survey: magloc.Survey, frame: MapFrame, page: str) -> None:
        """Six lines, and the first of them alone."""
        first = type(survey.rows)(*(column[:240] for column in survey.rows))
        alone = report_html(replace(survey, rows=first), frame, "Meadow", {}, BLANK)
        assert ["m apart" in one for one in (page, alone)] == [True, False]
