"""How shares of lines and branches are added up."""

from __future__ import annotations

import pytest

from tests.coverage import shares


def summary(covered_lines: int, lines: int, covered_branches: int, branches: int) -> dict[str, dict[str, int]]:
    counts = {"covered_lines": covered_lines, "num_statements": lines}
    return {"summary": counts | {"covered_branches": covered_branches, "num_branches": branches}}


def test_shares_are_of_all_lines_and_not_of_files() -> None:
    files = {
        "magloc/a.py": summary(1, 10, 0, 0),
        "magloc/b/c.py": summary(90, 90, 3, 4),
        "sims/d.py": summary(0, 100, 0, 4),
    }
    found = shares({"files": files})
    assert found["magloc"] == {"lines": 91.0, "branches": 75.0}
    assert found["sims"] == {"lines": 0.0, "branches": 0.0}
    assert found["all"] == {"lines": pytest.approx(45.5), "branches": 37.5}


def test_of_nothing_all_is_covered() -> None:
    assert shares({"files": {}}) == {"all": {"lines": 100.0, "branches": 100.0}}
