"""The stored page of walks is what a debugger shows today."""

from __future__ import annotations

import re
import subprocess
import sys

from tests.walks import PAGE, ROOT


class TestPage:
    def test_is_up_to_date(self) -> None:
        """In a process of its own, whose caches no other test has filled.

        Counts of switches depend on the version of Python: comprehensions are functions of their own before 3.12.
        """
        command = [sys.executable, "-m", "tests.walks", "--print"]
        page = subprocess.run(command, cwd=ROOT, capture_output=True, check=True).stdout.decode("utf-8")
        counts = re.compile(r"\d+ switches")
        assert counts.sub("", page) == counts.sub("", PAGE.read_text("utf-8")), "write it anew: python -m tests.walks"
