"""Work of surveys that most tests spare: each has tests that do it."""

from __future__ import annotations

import math

import pytest

from magloc.surveying.clock import ClockLag


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write blank pictures, and start no browser to print the report."""
    monkeypatch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)
    monkeypatch.setattr("magloc.deliverables.files._print_report", lambda path: None)


@pytest.fixture
def without_lag(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimate no lag of the clock, which takes most of the time of a short survey."""
    monkeypatch.setattr(
        "magloc.surveying.tiled.TiledSurvey.correct_lag", lambda tiled, *_: (tiled, ClockLag(0.0, math.inf))
    )
