"""``magloc qc``."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arrays import write_array
from magloc.readings import write_readings
from tests.command_line import Run, assert_refused
from tests.hills import AMBIENT_T, PAIR, plain, walk

ROWS = walk(72, plain, 4.0, 2).readings


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk with a gap within its third line, and one sensor that is five times as noisy as stated."""
    place = tmp_path_factory.mktemp("qc")
    noise = np.random.default_rng(6).normal(size=(len(ROWS), 2), scale=[0.0, 5e-10])
    kept = np.r_[:160, 185 : len(ROWS)]
    write_readings(place / "walk.csv", replace(ROWS, values_T=ROWS.values_T + noise)[kept], PAIR)
    write_array(place / "pair.toml", replace(PAIR, ambient_world_T=tuple(AMBIENT_T)))
    return place


class TestQc:
    @pytest.mark.usefixtures("without_lag")
    def test_table_and_files(self, folder: Path, tmp_path: Path, run: Run) -> None:
        done = run("qc", folder / "walk.csv", "--array", folder / "pair.toml", "--out", tmp_path / "out")
        assert done.status == 0, done.err
        assert "the carrier moved on, at" in done.out
        assert "times the stated noise" in done.out
        with (tmp_path / "out" / "qc.csv").open(encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        assert [float(row["value"]) for row in rows if row["check"] == "rows"] == [len(ROWS) - 25]
        assert (tmp_path / "out" / "qc.png").read_bytes().startswith(b"\x89PNG")

    def test_json_and_the_height_of_the_ground(self, folder: Path, run: Run) -> None:
        done = run("qc", folder / "walk.csv", "--array", folder / "pair.toml", "--ground-m", "-2", "--json")
        assert done.status == 0, done.err
        found = json.loads(done.out)
        assert {"way in a gap", "noise"} <= set(found["flags"])
        assert set(found["checks"][0]) == {"name", "sensor", "value", "unit", "remark"}
        assert set(found["lines"][0]) == {"name", "rows", "speed_m_s", "height_m"}
        longest = max(found["gaps"], key=lambda gap: gap["way_m"])
        assert longest["start_s"] == pytest.approx(ROWS.time_s[159])
        assert {check["name"]: check["value"] for check in found["checks"]}["height"] == pytest.approx(3.2, abs=0.02)

    def test_bad_input(self, folder: Path, tmp_path: Path, run: Run) -> None:
        rows = "time_s,low_nT,high_nT\n" + "\n".join(f"{t},48000,48001" for t in range(30)) + "\n"
        (tmp_path / "still.csv").write_text(rows)
        assert_refused(
            run("qc", tmp_path / "still.csv", "--array", folder / "pair.toml", "--quiet"),
            "found no pose in the readings",
        )
        assert_refused(run("qc", folder / "walk.csv", "--array", folder / "none.toml"), "none.toml does not exist")
