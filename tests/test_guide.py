"""Every Python block of the guide and the README runs as it stands, after what a page prepares out of sight."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib
import pytest

from tests.conftest import REPOSITORY

GUIDE = sorted((REPOSITORY / "docs" / "guide").glob("*.md"))
BLOCKS = re.compile(r"<!-- (?:before|after) the page:\n(.*?)-->|```python\n(.*?)```", re.DOTALL)


def test_the_guide_is_found() -> None:
    assert len(GUIDE) >= 10


@pytest.mark.parametrize("page", GUIDE, ids=lambda page: page.stem)
def test_page(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    matplotlib.use("agg")
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for hidden, shown in BLOCKS.findall(page.read_text(encoding="utf-8")):
        exec(compile(hidden or shown, str(page), "exec"), names)
