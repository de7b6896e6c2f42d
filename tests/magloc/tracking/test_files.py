"""Tracks read from files: what was written comes back, and what is wrong is named with its row."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from arrays.io.errors import InputError
from magloc.tracking.files import json_of_track, read_track
from magloc.tracking.results import TrackPoint

PLACE, MOMENT = np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.1, 8.0])
POINTS = (
    TrackPoint(0.0, status="no solution"),
    TrackPoint(0.5, PLACE, MOMENT, np.diag(np.arange(1.0, 7.0)), nis=3.0, nis_dof=4, status="tracked"),
    TrackPoint(1.0, 1.1 * PLACE, MOMENT, np.eye(6), status="predicted", dropped_sensors=("s2", "s3")),
)
TABLE: dict[str, Any] = msgspec.json.decode(
    msgspec.json.encode(json_of_track(POINTS, None), enc_hook=np.ndarray.tolist)
)


def written(folder: Path, table: object) -> Path:
    path = folder / "track.json"
    path.write_bytes(msgspec.json.encode(table))
    return path


class TestReadTrack:
    def test_what_was_written_comes_back(self, tmp_path: Path) -> None:
        points = read_track(written(tmp_path, TABLE)).points
        for found, point in zip(points, POINTS, strict=True):
            for name in (
                "time_s",
                "nis",
                "nis_dof",
                "status",
                "dropped_sensors",
                "position_m",
                "moment_Am2",
                "covariance",
            ):
                np.testing.assert_equal(getattr(found, name), getattr(point, name))

    def test_rows_alone_are_as_good_as_those_of_one_source_with_an_id(self, tmp_path: Path) -> None:
        rows = [{"time_s": entry["time_s"], "tracks": [entry | {"id": 3}]} for entry in TABLE["results"]]
        alone, named = (read_track(written(tmp_path, table)) for table in (TABLE, {"results": rows}))
        assert named.ids == ()
        assert [p.time_s for p in named.points] == [p.time_s for p in alone.points]
        np.testing.assert_equal([p.covariance for p in named.points], [p.covariance for p in alone.points])

    @pytest.mark.parametrize(
        ("key", "value", "sentence"),
        [
            ("position_m", [1.0, 2.0], "found something else, expected 3 numbers or null"),
            ("position_m", [1.0, 2.0, "x"], "found something else, expected 3 numbers or null"),
            ("position_m", ["1", "2", "3"], "found something else, expected 3 numbers or null"),
            ("position_m", [1.0, True, 3.0], "found something else, expected 3 numbers or null"),
            ("moment_Am2", [1.0, 2.0, 1e300], "found something else, expected 3 numbers or null"),
            ("covariance", [[1.0] * 6] * 5, "found something else, expected 6×6 numbers or null"),
            ("covariance", (-np.eye(6)).tolist(), "found a variance below zero"),
            ("nis", "4", "found '4', expected a number"),
            ("nis_dof", True, "found True, expected a number"),
            ("dropped_sensors", [3], r"found \[3\], expected a list of names"),
            ("dropped_sensors", 3, "found 3, expected a list of names"),
            ("time_s", None, "found None, expected a number"),
            ("time_s", 0.2, "found 0.2 after 0.5, expected times in order"),
        ],
    )
    def test_what_is_wrong_is_named_with_its_row(self, tmp_path: Path, key: str, value: object, sentence: str) -> None:
        table = copy.deepcopy(TABLE)
        table["results"][2][key] = value
        with pytest.raises(InputError, match=rf"result 3, key {key}: {sentence}"):
            read_track(written(tmp_path, table))
