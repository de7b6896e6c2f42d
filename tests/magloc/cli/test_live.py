"""The command line: what ``magloc live`` prints, how it ends, and how it refuses bad input."""

from __future__ import annotations

import io
import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arrays.array_file import write_array
from arrays.geometries import tetrahedron
from magloc.readings import Readings, write_readings
from tests.command_line import Run, assert_refused, refuse_constant
from tests.passing_source import ARRAY, moving_source, readings_of
from tests.waiting import WAIT_S

N_ROWS = 40
MOTION = ("--speed-m-s", "0.1", "--turn-deg-s", "1.2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An array, and readings of a source that passes it."""
    folder = tmp_path_factory.mktemp("live")
    time_s, p, m = moving_source(N_ROWS)
    write_array(folder / "array.toml", ARRAY)
    write_readings(folder / "rows.csv", Readings(readings_of(ARRAY, p, m), time_s=time_s), ARRAY)
    return folder


def entries(out: str) -> list[dict[str, Any]]:
    return [json.loads(line, parse_constant=refuse_constant) for line in out.splitlines()]


class TestLines:
    def test_are_those_of_track_with_a_latency(self, folder: Path, run: Run) -> None:
        options = ("--array", folder / "array.toml", *MOTION)
        expected = entries(run("track", folder / "rows.csv", *options, "--jsonl").out)
        outcome = run("live", "--from", f"replay:{folder / 'rows.csv'}", "--replay-speed", "1000", *options)
        found = entries(outcome.out)
        assert outcome.status == 0
        assert all(0.0 < entry.pop("latency_ms") < 1e6 for entry in found)
        assert [entry["status"] for entry in found] == [entry["status"] for entry in expected]
        for a, b in zip(found, expected, strict=True):
            assert set(a) == set(b)
            np.testing.assert_allclose(a["position_m"], b["position_m"], rtol=0.0, atol=1e-9)
        (summary,) = outcome.err.splitlines()
        assert f"magloc: {N_ROWS} rows, {N_ROWS} tracked, 0 late, 0 lost, 0 doubled, 0 garbled; latency" in summary

    def test_of_several_sources(self, folder: Path, run: Run) -> None:
        options = ("--array", folder / "array.toml", *MOTION, "--sources", "1")
        expected = entries(run("track", folder / "rows.csv", *options, "--jsonl").out)
        source = f"replay:{folder / 'rows.csv'}"
        found = entries(run("live", "--from", source, "--replay-speed", "1000", *options).out)
        assert all(0.0 < entry.pop("latency_ms") < 1e6 for entry in found)
        assert found == expected
        assert [track["id"] for track in found[-1]["tracks"]] == [1]

    def test_standard_input_in_json(self, folder: Path, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
        names, *rows = [line.split(",") for line in (folder / "rows.csv").read_text().splitlines()]
        objects = [json.dumps(dict(zip(names, map(float, row), strict=True))) for row in rows]
        monkeypatch.setattr("sys.stdin", io.StringIO("\n".join([objects[0], "noise", *objects[1:]])))
        outcome = run("live", "--array", folder / "array.toml", *MOTION)
        assert outcome.status == 0
        assert entries(outcome.out)[-1]["status"] == "tracked"
        assert "1 garbled" in outcome.err

    @pytest.mark.slow
    def test_a_rest_is_answered_without_a_source(self, folder: Path, run: Run) -> None:
        source = f"replay:{folder / 'rows.csv'}"
        outcome = run(
            "live", "--array", folder / "array.toml", "--from", source, "--replay-speed", "1000", "--rest-s", "5"
        )
        found = entries(outcome.out)
        assert [entry["status"].startswith("rest") for entry in found] == [True] * 10 + [False] * (N_ROWS - 10)
        assert "the background is taken from 10 rows" in outcome.err
        assert "expected an array that does not move" in outcome.err  # a source passes

    def test_table_has_the_columns_of_track(self, folder: Path, run: Run, tmp_path: Path) -> None:
        options = ("--array", folder / "array.toml", *MOTION)
        run("track", folder / "rows.csv", *options, "--out", tmp_path)
        expected = (tmp_path / "track.csv").read_text().splitlines()
        source = f"replay:{folder / 'rows.csv'}"
        run("live", "--from", source, "--replay-speed", "1000", *options, "--out", tmp_path / "live.csv")
        found = (tmp_path / "live.csv").read_text().splitlines()
        assert found[0] == expected[0]
        assert len(found) == len(expected)
        for one, other in zip(found[1:], expected[1:], strict=True):
            (*numbers, status), (*expected_numbers, expected_status) = one.split(","), other.split(",")
            assert status == expected_status
            np.testing.assert_allclose(
                [float(n or "nan") for n in numbers],
                [float(n or "nan") for n in expected_numbers],
                rtol=1e-6,
                atol=1e-9,
            )

    def test_table_of_several_sources(self, folder: Path, run: Run, tmp_path: Path) -> None:
        options = ("--array", folder / "array.toml", *MOTION, "--sources", "1")
        source = f"replay:{folder / 'rows.csv'}"
        out = run("live", "--from", source, "--replay-speed", "1000", *options, "--out", tmp_path / "live.csv").out
        header, *rows = (tmp_path / "live.csv").read_text().splitlines()
        assert header.startswith("time_s,id,x_m,y_m,z_m,")
        tracks = [(entry["time_s"], track) for entry in entries(out) for track in entry["tracks"]]
        assert [float(row.split(",")[2]) for row in rows] == [track["position_m"][0] for _, track in tracks]
        assert [row.split(",")[:2] for row in rows] == [[str(time_s), str(track["id"])] for time_s, track in tracks]

    def test_quiet(self, folder: Path, run: Run) -> None:
        source = f"replay:{folder / 'rows.csv'}"
        options = ("--replay-speed", "1000", "--quiet")
        assert run("live", "--array", folder / "array.toml", "--from", source, *options).err == ""


class TestBadInput:
    @pytest.mark.parametrize(
        ("words", "fragments"),
        [
            ("--from nowhere", ("nowhere: found no such kind of source", "expected -, tcp://HOST:PORT")),
            ("--from replay:nowhere.csv", ("nowhere.csv does not exist",)),
            ("--from serial:/dev/nothing@9600", ("/dev/nothing",)),
            ("--rest-s -1", ("--rest-s: found -1",)),
            ("--replay-speed 0", ("--replay-speed: found 0",)),
            ("--speed-m-s 0", ("--speed-m-s",)),
            ("--sensors s9", ("--sensors: found 's9'",)),
            ("--out out.txt", ("--out out.txt: found a name that ends with '.txt', expected .csv",)),
            ("--out nowhere/out.csv", ("--out nowhere/out.csv: found no folder",)),
        ],
    )
    def test_options(self, folder: Path, run: Run, words: str, fragments: tuple[str, ...]) -> None:
        assert_refused(run("live", "--array", folder / "array.toml", *words.split()), *fragments)

    def test_a_board_with_other_columns(self, folder: Path, run: Run, tmp_path: Path) -> None:
        (tmp_path / "rows.csv").write_text((folder / "rows.csv").read_text().replace("s4_", "s5_"))
        outcome = run("live", "--array", folder / "array.toml", "--from", f"replay:{tmp_path / 'rows.csv'}")
        assert_refused(outcome, "line 1, column s4_x_nT: found no such column (the nearest is s5_x_nT)")

    def test_a_rest_of_scalar_sensors(self, run: Run, tmp_path: Path) -> None:
        write_array(tmp_path / "array.toml", tetrahedron(1.0, "scalar"))
        assert_refused(run("live", "--array", tmp_path / "array.toml", "--rest-s", "1"), "a rest", "scalar sensor s1")


@contextmanager
def followed(folder: Path, *options: str) -> Iterator[tuple[subprocess.Popen[str], socket.socket]]:
    """The command in a process of its own, and the socket that it reads."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(WAIT_S)
        address = f"tcp://127.0.0.1:{server.getsockname()[1]}"
        command = [sys.executable, "-m", "magloc.cli", "live", "--array", str(folder / "array.toml"), "--from", address]
        pipe = subprocess.PIPE
        with subprocess.Popen([*command, *MOTION, *options], stdout=pipe, stderr=pipe, text=True) as process:
            try:
                peer, _ = server.accept()
                with peer:
                    yield process, peer
            finally:
                process.kill()


class TestSocket:
    @pytest.mark.parametrize(
        ("number", "status", "word"), [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")]
    )
    def test_every_row_is_answered_until_a_signal(
        self, folder: Path, tmp_path: Path, number: signal.Signals, status: int, word: str
    ) -> None:
        """By whole lines, though nobody reads them for a while and the pipe is full; the table has whole rows too."""
        header, *rows = (folder / "rows.csv").read_text().splitlines()
        with followed(folder, "--out", str(tmp_path / "out.csv")) as (process, peer):
            assert process.stdout is not None
            assert process.stderr is not None
            peer.sendall(f"{header}\n".encode())
            for row in rows[:5]:
                peer.sendall(f"{row}\n".encode())
                answer = json.loads(process.stdout.readline())
                assert answer["time_s"] == float(row.split(",")[0])
            assert len((tmp_path / "out.csv").read_text().splitlines()) >= 5
            for i in range(500):  # far more than a pipe holds
                peer.sendall(f"{1000.0 + i},{rows[0].partition(',')[2]}\n".encode())
            process.send_signal(number)
            out, err = process.communicate(timeout=WAIT_S)
        assert process.returncode == status
        assert all(json.loads(line) for line in out.splitlines())
        assert out.endswith("\n") or not out
        names, *table = (tmp_path / "out.csv").read_text().split("\n")
        assert table.pop() == ""
        assert {line.count(",") for line in table} == {names.count(",")}
        *_, summary, last = err.splitlines()
        assert "rows, " in summary
        assert last == f"magloc: {word}"

    def test_the_end_of_the_connection_is_the_end(self, folder: Path) -> None:
        with followed(folder) as (process, peer):
            peer.sendall((folder / "rows.csv").read_bytes())
            peer.close()
            out, err = process.communicate(timeout=WAIT_S)
        assert process.returncode == 0
        assert len(out.splitlines()) == N_ROWS
        assert f"magloc: {N_ROWS} rows" in err
