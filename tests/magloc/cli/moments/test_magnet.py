"""The options --magnet and --size-m of ``magloc locate``, ``track`` and ``live``."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import arrays
from magloc.fields.shapes import Shape
from tests.command_line import Run, assert_refused, results_of
from tests.magloc.localization.test_magnet_fit import board, poses, simulate

SHAPE = Shape("cylinder", (0.012, 0.004))
OPTIONS = ("--magnet", "cylinder", "--size-m", "0.012", "0.004")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    array = board()
    _, values = simulate(array, SHAPE, poses(array, SHAPE, (1.0, 1.1), 1, 51) * 8, 52)
    arrays.write_array(tmp_path / "array.toml", array)
    header = ",".join(["time_s", *(f"{name}_nT" for name in array.channel_names)])
    rows = [",".join(map(repr, [0.1 * i, *(1e9 * row).tolist()])) for i, row in enumerate(values)]
    (tmp_path / "readings.csv").write_text("\n".join([header, *rows, ""]), encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    return tmp_path


TRUE_M = poses(board(), SHAPE, (1.0, 1.1), 1, 51)[0][0]


class TestPlaces:
    @pytest.mark.parametrize("command", ["locate", "track"])
    def test_of_a_file(self, folder: Path, run: Run, command: str) -> None:
        found = results_of(run(command, "readings.csv", "--array", "array.toml", *OPTIONS, "--json"))
        best = found[-1]["solutions"][0] if command == "locate" else found[-1]
        assert np.linalg.norm(best["position_m"] - TRUE_M) < 0.05e-3

    def test_of_a_stream(self, folder: Path, run: Run) -> None:
        source = ("--from", "replay:readings.csv", "--replay-speed", "1e6")
        outcome = run("live", "--array", "array.toml", *source, "--speed-m-s", "0.001", *OPTIONS)
        last = json.loads(outcome.out.splitlines()[-1])
        assert np.linalg.norm(last["position_m"] - TRUE_M) < 0.05e-3


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "message"),
        [
            (("--magnet", "cylinder"), "--magnet: found no --size-m, expected both."),
            (("--size-m", "0.01"), "--size-m: found no --magnet, expected both."),
            (("--magnet", "cylinder", "--size-m", "0.01"), "--size-m: found [0.01], expected the diameter, height"),
            (("--magnet", "sphere", "--size-m", "0"), "--size-m: found [0.0], expected positive and finite."),
            (("--magnet", "cylinder", "--size-m", "10", "10"), "--size-m: found 10, expected at most 0.5 m; 10 mm are"),
            (
                ("--magnet", "ring", "--size-m", "0.02", "0.01", "0.01"),
                "expected those of a ring with an inner diameter below",
            ),
            (
                ("--magnet", "cuboid", "--size-m", "0.02", "0.01", "0.01"),
                "expected edges of which the first two are equal",
            ),
            (
                (*OPTIONS, "--position", "0", "0", "1"),
                "--position: found together with --magnet, expected one of them.",
            ),
        ],
    )
    @pytest.mark.parametrize("command", ["locate", "track"])
    def test_of_both_commands(
        self, folder: Path, run: Run, command: str, options: tuple[str, ...], message: str
    ) -> None:
        assert_refused(run(command, "readings.csv", "--array", "array.toml", *options), message)

    @pytest.mark.parametrize(
        ("command", "options", "message"),
        [
            ("locate", (*OPTIONS, "--body-length-m", "0.01"), "--body-length-m: found together with --magnet"),
            ("locate", (*OPTIONS, "--sources", "auto"), "sources"),
            ("track", (*OPTIONS, "--sources", "2"), "--sources: found together with --magnet"),
            ("track", ("--magnet", "cuboid", "--size-m", "0.01", "0.01", "0.01"), "a ring or a sphere in a track"),
            ("locate", ("--magnet", "sphere", "--size-m", "0.4"), "put a sensor inside the magnet"),
        ],
    )
    def test_of_one_command(self, folder: Path, run: Run, command: str, options: tuple[str, ...], message: str) -> None:
        assert_refused(run(command, "readings.csv", "--array", "array.toml", *options), message)
