"""The log of decisions, and the polygons in it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.path import Path as Polygon

from arrays.io.errors import InputError
from magloc.surveying.review.decisions import Add, Drop, Exclude, Refit, Split, decision_lines, read_decisions
from magloc.surveying.review.edits import inside_polygon


class TestLog:
    def test_is_read_as_it_was_written(self, tmp_path: Path) -> None:
        decisions = [
            Drop(target="t3", when="2026-11-29T03:50:00Z", numbers={"significance": 41.5, "flags": ["weak"]}),
            Split(target="t1"),
            Split(target="t2", places_m=[[0.0, 1.0], [0.5, 1.0, -0.4]]),
            Add(place_m=[1.0, 2.0]),
            Exclude(polygon_m=[[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]),
            Exclude(from_s=3.0, to_s=4.5),
            Refit(),
        ]
        path = tmp_path / "decisions.jsonl"
        path.write_text(decision_lines(decisions))
        assert read_decisions(path) == decisions

    @pytest.mark.parametrize(
        ("line", "words"),
        [
            ('{"action": "burn"}', "burn"),
            ('{"action": "drop"}', "target"),
            ('{"action": "drop", "target": 3}', "str"),
            ('{"action": "drop", "target": "t1", "reason": "car"}', "reason"),
            ('{"action": "drop", "target": "t1", "numbers": {"position_m": "here"}}', "3 finite numbers"),
            ('{"action": "split", "target": "t1", "numbers": {"position_m": [1]}}', "3 finite numbers"),
            ('{"action": "split", "target": "t1", "places_m": [[0, 1]]}', "two places or none"),
            ('{"action": "add", "place_m": [1]}', "2 or 3 finite numbers"),
            ('{"action": "exclude"}', "either polygon_m"),
            ('{"action": "exclude", "polygon_m": [[0, 0], [1, 0]]}', "three corners"),
            ('{"action": "exclude", "from_s": 5, "to_s": 4}', "from_s <= to_s"),
            ("drop t1", "JSON"),
        ],
    )
    def test_a_wrong_line_is_named(self, line: str, words: str, tmp_path: Path) -> None:
        path = tmp_path / "decisions.jsonl"
        path.write_text(f'{{"action": "refit"}}\n\n{line}\n')
        with pytest.raises(InputError, match=r"decisions\.jsonl, line 3: .*expected a decision such as") as error:
            read_decisions(path)
        assert words in str(error.value)


def test_inside_a_polygon() -> None:
    """Matplotlib decides the same for triangles and for a concave one."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        corners = rng.normal(size=(3, 2))
        points = rng.normal(size=(500, 2))
        np.testing.assert_array_equal(inside_polygon(points, corners), Polygon(corners).contains_points(points))
    concave = np.array([[0.0, 0.0], [4.0, 0.0], [4.0, 3.0], [2.0, 1.0], [0.0, 3.0]])
    points = rng.uniform(-1.0, 5.0, size=(2000, 2))
    np.testing.assert_array_equal(inside_polygon(points, concave), Polygon(concave).contains_points(points))
