"""The stored page of walks is what a debugger shows today."""

from __future__ import annotations

import re

from tests.walks import PAGE, page


class TestPage:
    def test_is_up_to_date(self) -> None:
        """Counts of switches depend on the version of Python: comprehensions are functions of their own before 3.12."""
        counts = re.compile(r"\d+ switches")
        stored = PAGE.read_text("utf-8")
        assert counts.sub("", page()) == counts.sub("", stored), "write it anew: python -m tests.walks"
