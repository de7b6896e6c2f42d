"""A tracker that is saved and resumed."""

from __future__ import annotations

import json
import pickle
import zlib
from base64 import b64encode
from functools import cache
from typing import Any

import numpy as np
import pytest

import magloc
from magloc.tracking.results import TrackPoint


def points(tracker: magloc.Tracker, readings: magloc.Readings) -> list[TrackPoint]:
    return [tracker.update(row) for row in readings]


def tracker_of(diver: Any) -> magloc.Tracker:
    return magloc.Tracker(diver.array, magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.01))


BEGINS = (20, 35, 93)


@cache
def whole_track() -> tuple[list[TrackPoint], dict[int, dict[str, Any]]]:
    """Return the points of all rows, and the states before some of them."""
    diver = magloc.datasets.load("diver")
    tracker = tracker_of(diver)
    states, found = {}, []
    for i, row in enumerate(diver.readings):
        if i in BEGINS:
            states[i] = tracker.state()
        found.append(tracker.update(row))
    return found, states


@pytest.mark.parametrize("begin", BEGINS)
def test_resumes_bit_for_bit(begin: int) -> None:
    """Before a track, while it is young, and settled; through a JSON file."""
    whole, states = whole_track()
    resumed = magloc.Tracker.from_state(json.loads(json.dumps(states[begin])))
    found = points(resumed, magloc.datasets.load("diver").readings[begin:])
    assert [one.status for one in found] == [one.status for one in whole[begin:]]
    for one, other in zip(found, whole[begin:], strict=True):
        for name in ("position_m", "moment_Am2", "covariance", "nis"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


class Foreign:
    """What a state must not call."""

    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return print, ("called",)


def test_refusals(capsys: pytest.CaptureFixture[str]) -> None:
    state = tracker_of(magloc.datasets.load("diver")).state()
    foreign = zlib.compress(pickle.dumps({"array": Foreign()}))
    for change, words in (
        ({"version": 2}, "must have version 1; instead received 2"),
        ({"crc32": 1}, "its checksum differs"),
        ({"content": "?"}, r"must be one of Tracker.state\(\)"),
        ({"content": b64encode(foreign).decode(), "crc32": zlib.crc32(foreign)}, "found builtins.print"),
    ):
        with pytest.raises(ValueError, match=words):
            magloc.Tracker.from_state({**state, **change})
    assert capsys.readouterr().out == ""
