"""What ``adcs`` does with bad input."""

from __future__ import annotations

from tests.command_line import Outcome


def assert_refused(outcome: Outcome, *fragments: str) -> None:
    """Exit status 2, nothing on stdout, and one line on stderr that says what and where."""
    assert outcome.status == 2
    assert outcome.out == ""
    lines = outcome.err.splitlines()
    assert len(lines) == 1, outcome.err
    assert lines[0].startswith("adcs: ")
    assert "Traceback" not in outcome.err
    for fragment in fragments:
        assert fragment in lines[0]
