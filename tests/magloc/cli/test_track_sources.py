"""``magloc track --sources``: what it prints of several magnets, its stream, and how it refuses bad input."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import arrays
from magloc.readings import Readings, write_readings
from magloc.tracking.results import TrackResult
from magloc.truth import read_truth
from magloc.viewer.pages.open_result import read_result
from tests.command_line import Run, assert_refused
from tests.moving_magnets import RATE_HZ, Magnets, board

KEYS = {"id", "position_m", "moment_Am2", "covariance", "weight", "merged", "range_observable", "range_interval95_m"}
N_ROWS = 30


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Readings of two magnets over a board, and the board."""
    rng = np.random.default_rng(1)
    truth = Magnets.drawn(2, N_ROWS, 0.03, rng)
    readings = Readings(truth.readings_T(board(), rng), time_s=np.arange(N_ROWS) / RATE_HZ)
    write_readings(tmp_path / "two.csv", readings, board())
    arrays.write_array(tmp_path / "board.toml", board())
    return tmp_path / "two.csv", tmp_path / "board.toml"


class TestOutput:
    def test_json(self, run: Run, files: tuple[Path, Path]) -> None:
        outcome = run("track", files[0], "--array", files[1], "--sources", "auto", "--json")
        assert outcome.status == 0
        entries = json.loads(outcome.out)["results"]
        assert len(entries) == N_ROWS
        for entry in entries:
            assert entry["status"] == "tracked"
            assert [track["id"] for track in entry["tracks"]] == [1, 2]
            assert all(set(track) == KEYS and np.shape(track["covariance"]) == (6, 6) for track in entry["tracks"])
            assert "position_m" not in entry

    def test_lines_are_those_of_json(self, run: Run, files: tuple[Path, Path]) -> None:
        whole = run("track", files[0], "--array", files[1], "--sources", 2, "--json")
        lines = run("track", files[0], "--array", files[1], "--sources", 2, "--jsonl")
        assert [json.loads(line) for line in lines.out.splitlines()] == json.loads(whole.out)["results"]

    def test_one_source_has_the_keys_of_one(self, run: Run, files: tuple[Path, Path], tmp_path: Path) -> None:
        rng = np.random.default_rng(2)
        one = Magnets.drawn(1, 12, 0.0, rng)
        write_readings(tmp_path / "one.csv", Readings(one.readings_T(board(), rng), time_s=np.arange(12.0)), board())
        outcome = run("track", tmp_path / "one.csv", "--array", files[1], "--sources", 1, "--json")
        for entry in json.loads(outcome.out)["results"]:
            assert entry["position_m"] == entry["tracks"][0]["position_m"]
            assert {"estimability", "nis", "range_observable", "gaussian", "weight"} <= set(entry)

    def test_table(self, run: Run, files: tuple[Path, Path]) -> None:
        outcome = run("track", files[0], "--array", files[1], "--sources", 2)
        lines = outcome.out.splitlines()
        assert " ".join(lines[0].split()) == "time_s id x_m y_m z_m s_x_m s_y_m s_z_m m_Am2 s_m status"
        assert len(lines) == 1 + 2 * N_ROWS
        assert f"{N_ROWS} of {N_ROWS} rows with a source, 2 sources in all" in outcome.err

    def test_folder_and_page(self, run: Run, files: tuple[Path, Path], tmp_path: Path) -> None:
        """The folder's file has a row for every source in every row, and a page is made of what is printed."""
        found = run("track", files[0], "--array", files[1], "--sources", 2, "--json", "--out", tmp_path / "out")
        rows = (tmp_path / "out" / "track.csv").read_text().splitlines()
        assert [row.split(",")[1] for row in rows] == ["id"] + N_ROWS * ["1", "2"]
        entry = json.loads(found.out)["results"][-1]["tracks"][1]
        assert [float(cell) for cell in rows[-1].split(",")[2:8]] == entry["position_m"] + entry["moment_Am2"]
        assert (tmp_path / "out" / "track.png").read_bytes().startswith(b"\x89PNG")
        (tmp_path / "track.json").write_text(found.out)
        result = read_result(tmp_path / "track.json")
        assert isinstance(result, TrackResult)
        assert result.ids == (1, 2)
        assert [track[-1].status for track in result.tracks] == ["tracked", "tracked"]
        assert run("view", tmp_path / "track.json", "--html", tmp_path / "a.html").status == 0
        assert "source 2, with 95 % ellipsoids" in (tmp_path / "a.html").read_text()

    @pytest.mark.parametrize("tracks", ['{"id": 1}', "[1]", '[{"id": "a"}]', '[{"id": 1, "position_m": [1, 2]}]'])
    def test_a_page_of_something_else(self, run: Run, tmp_path: Path, tracks: str) -> None:
        (tmp_path / "track.json").write_text(f'{{"results": [{{"time_s": 0, "tracks": {tracks}}}]}}')
        outcome = run("view", tmp_path / "track.json", "--html", tmp_path / "a.html")
        assert_refused(outcome, "track.json, result 1, key ", "expected")

    def test_stream(self, run: Run, files: tuple[Path, Path]) -> None:
        command = [sys.executable, "-m", "magloc.cli", "track", "-", "--array", files[1], "--sources", "2", "--jsonl"]
        with files[0].open() as readings:
            streamed = subprocess.run(command, stdin=readings, capture_output=True, text=True, check=True)
        lines = run("track", files[0], "--array", files[1], "--sources", 2, "--jsonl")
        assert streamed.stdout == lines.out

    def test_a_scenario(self, run: Run, tmp_path: Path) -> None:
        """The third magnet has rows of truth only while it is there, and so has its track, but for ten rows."""
        assert run("simulate", "three-magnets", "--out", tmp_path / "three.csv").status == 0
        truth = read_truth(tmp_path / "three-truth-3.csv")
        assert (truth.time_s[0], truth.time_s[-1]) == (3.0, 8.0)
        rows = (tmp_path / "three.csv").read_text().splitlines()
        (tmp_path / "part.csv").write_text("\n".join([rows[0], *rows[281:331]]) + "\n")
        outcome = run(
            "track", tmp_path / "part.csv", "--array", tmp_path / "three-array.toml", "--sources", 3, "--json"
        )
        counts = [len(entry["tracks"]) for entry in json.loads(outcome.out)["results"]]
        assert counts == [2] * 29 + [3] * 21


class TestBadInput:
    @pytest.mark.parametrize("option", [("--smooth",), ("--truth", "t.csv"), ("--position", 0, 0, 1)])
    def test_what_several_sources_do_not_have(
        self, run: Run, files: tuple[Path, Path], option: tuple[object, ...]
    ) -> None:
        outcome = run("track", files[0], "--array", files[1], "--sources", 2, *option)
        assert_refused(outcome, str(option[0]), "together with --sources")

    def test_a_motion(self, run: Run, files: tuple[Path, Path]) -> None:
        outcome = run("track", files[0], "--array", files[1], "--sources", 2, "--motion", "turn")
        assert_refused(outcome, "--motion", "together with --sources")

    @pytest.mark.parametrize(("number", "said"), [("0", "between 1 and 14"), ("15", "between 1 and 14"), ("x", "auto")])
    def test_a_number(self, run: Run, files: tuple[Path, Path], number: str, said: str) -> None:
        assert_refused(run("track", files[0], "--array", files[1], "--sources", number), "--sources", said)

    def test_a_background(self, run: Run, files: tuple[Path, Path]) -> None:
        outcome = run("track", files[0], "--array", files[1], "--sources", 2, "--detrend")
        assert_refused(outcome, "--detrend", "expected one of them")

    def test_measured_velocities(self, run: Run, files: tuple[Path, Path], tmp_path: Path) -> None:
        lines = files[0].read_text().splitlines()
        header = f"{lines[0]},array_vx_m_s,array_vy_m_s,array_vz_m_s"
        (tmp_path / "moving.csv").write_text("\n".join([header, *(f"{line},0,0,0" for line in lines[1:])]) + "\n")
        outcome = run("track", tmp_path / "moving.csv", "--array", files[1], "--sources", 2)
        assert_refused(outcome, "moving.csv", "measured velocities")

    def test_noise_alone(self, run: Run, files: tuple[Path, Path], tmp_path: Path) -> None:
        noise = Readings(5e-7 * np.random.default_rng(0).normal(size=(5, 90)), time_s=np.arange(5.0))
        write_readings(tmp_path / "noise.csv", noise, board())
        outcome = run("track", tmp_path / "noise.csv", "--array", files[1], "--sources", "auto")
        assert_refused(outcome, "found no row where a source can be tracked", "no source")
