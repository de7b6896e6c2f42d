"""A tracker that is saved and resumed."""

from __future__ import annotations

import json
import pickle
import zlib
from base64 import b64encode
from typing import Any

import numpy as np
import pytest

import magloc
from magloc.tracking.results import TrackPoint


def points(tracker: magloc.Tracker, readings: magloc.Readings) -> list[TrackPoint]:
    return [tracker.update(row) for row in readings]


def tracker_of(diver: Any) -> magloc.Tracker:
    return magloc.Tracker(diver.array, magloc.RandomWalk(speed_m_s=0.1, turn_rad_s=0.01))


@pytest.mark.parametrize("begin", [20, 35, 93])
def test_resumes_bit_for_bit(begin: int) -> None:
    """Before a track, while it is young, and settled; through a JSON file."""
    diver = magloc.datasets.load("diver")
    whole = points(tracker_of(diver), diver.readings)
    first = tracker_of(diver)
    points(first, diver.readings[:begin])
    resumed = magloc.Tracker.from_state(json.loads(json.dumps(first.state())))
    found = points(resumed, diver.readings[begin:])
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
