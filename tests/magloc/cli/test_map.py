"""``magloc map`` and scenario files, as a user types them."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from magloc.cli.app import main
from magloc.cli.map import _how_done
from magloc.convergence.filters import IekfFilter
from magloc.convergence.over_sources import SourcesScenario
from magloc.convergence.over_starts import StartsScenario
from magloc.convergence.scenario_files import built_in_scenarios, read_sources_scenario, read_starts_scenario
from magloc.grids.cube import Summary
from magloc.grids.store import open_map
from magloc.plots import style
from tests.command_line import assert_refused
from tests.conftest import REPOSITORY

SOURCE = "[source]\nposition_m = [5, 0, 0.3]\nmoment_Am2 = [100, 0, 0]\n"
STARTS_KEYS = [
    "starts",
    "converged",
    "fraction",
    "front_fraction",
    "back_fraction",
    "front_within_13m_fraction",
    "beyond_20m_fraction",
    "median_iterations",
    "iterations_total",
    "seconds",
    "out",
]
ARRAY = '[array]\ngeometry = "tetrahedron"\nedge_m = 1.5\nkind = "vector"\nnoise_nT = 1.0\n'


@pytest.fixture
def plain_pictures(monkeypatch):
    """Pictures without contents, which take no time."""
    for name in ("convergence", "sources"):
        monkeypatch.setattr(f"magloc.plots.{name}", lambda *_: style.new_figure(1.0))


with_plain_pictures = pytest.mark.usefixtures("plain_pictures")


class TestResult:
    def test_json_is_the_only_thing_on_stdout(self, tmp_path, capsys):
        assert main(["map", "--grid", "5", "--out", str(tmp_path / "out"), "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert set(result) == set(STARTS_KEYS)
        assert result["starts"] == 125
        assert result["fraction"] == result["converged"] / 125
        assert result["out"] == str(tmp_path / "out")

    def test_files(self, tmp_path, capsys):
        assert (
            main(["map", "paper", "--method", "iekf", "--grid", "5", "--out", str(tmp_path), "--quiet", "--netcdf"])
            == 0
        )
        assert sorted(path.name for path in tmp_path.iterdir()) == ["convergence.nc", "convergence.png", "map.zarr"]
        assert (tmp_path / "convergence.png").read_bytes().startswith(b"\x89PNG")
        with xr.open_dataset(tmp_path / "convergence.nc") as dataset:
            assert dataset.attrs["method"] == "iekf"
        out, err = capsys.readouterr()
        assert re.search(r"\d+ of 125 starts converged", out)
        assert err == ""

    @with_plain_pictures
    def test_noise_is_drawn_with_the_seed(self, tmp_path, capsys):
        optima = []
        for i, options in enumerate(([], ["--noise"], ["--noise", "--seed", "1"], ["--noise", "--seed", "1"])):
            assert main(["map", "--grid", "3", "--out", str(tmp_path / str(i)), "--quiet", *options]) == 0
            with open_map(tmp_path / str(i) / "map.zarr") as dataset:
                optima.append(tuple(dataset.attrs["optimum_position_m"]))
        assert len(set(optima)) == 3
        assert optima[2] == optima[3]


class TestDefaultFolder:
    @with_plain_pictures
    def test_other_settings_go_to_other_folders(self, tmp_path, capsys, monkeypatch):
        monkeypatch.chdir(tmp_path)
        sources = ["--over", "sources"]
        few = ["--grid", "3"]
        for options in (
            few,
            ["--grid", "4"],
            [*few, "--noise"],
            [*few, "--noise", "--seed", "1"],
            [*few, "--method", "iekf"],
            [*few, *sources],
            [*few, *sources, "--seed", "1"],
        ):
            assert main(["map", "--quiet", *options]) == 0
        assert len(list(tmp_path.iterdir())) == 7


class TestOverSources:
    def test_json(self, tmp_path, capsys):
        assert main(["map", "--over", "sources", "--grid", "5", "--out", str(tmp_path / "out"), "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert list(result) == [*STARTS_KEYS[:-1], "truth_listed", "not_converged", "out"]
        with open_map(tmp_path / "out/map.zarr") as dataset:
            assert result["starts"] == (dataset.status != 3).sum()
            assert result["converged"] == (dataset.status == 0).sum()
        assert result["fraction"] == result["converged"] / result["starts"]
        assert [key for key in STARTS_KEYS if result[key] is None] == [key for key in STARTS_KEYS if "_fraction" in key]
        assert 0.9 < result["truth_listed"] <= 1.0
        assert (tmp_path / "out/convergence.png").read_bytes().startswith(b"\x89PNG")

    @with_plain_pictures
    def test_seed_counts_and_threads_do_not(self, tmp_path, capsys):
        chi2 = []
        for i, options in enumerate((["--threads", "1"], ["--threads", "2"], ["--seed", "1"])):
            out = tmp_path / str(i)
            assert main(["map", "--over", "sources", "--grid", "7", "--out", str(out), "--quiet", *options]) == 0
            with open_map(out / "map.zarr") as dataset:
                chi2.append(dataset.chi2.to_numpy())
        np.testing.assert_array_equal(chi2[0], chi2[1])
        assert np.nanmin(abs(chi2[0] - chi2[2])) > 0.0

    def test_sources_of_a_file(self, tmp_path, capsys):
        path = tmp_path / "mine.toml"
        path.write_text(ARRAY + "[sources]\nhalf_width_m = 3\nnearest_m = 2\nfarthest_m = 3\nmoment_Am2 = 10\n")
        scenario = read_sources_scenario(str(path), seed=4)
        assert (scenario.half_width_m, scenario.nearest_m, scenario.farthest_m) == (3.0, 2.0, 3.0)
        assert (scenario.moment_Am2, scenario.seed) == (10.0, 4)
        assert main(["map", str(path), "--over", "sources", "--grid", "3", "--out", str(tmp_path / "out")]) == 0
        assert "of 6 sources found" in capsys.readouterr().out

    @pytest.mark.slow
    @with_plain_pictures
    def test_what_is_known_of_sources(self, tmp_path):
        """The file says it, an option stands in its place."""
        path = tmp_path / "mine.toml"
        path.write_text(ARRAY + "[sources]\nknown_moment_sigma_Am2 = 30\nbody_length_m = 0.2\n")
        for name, options, length_m in (("file", [], 0.2), ("option", ["--body-length-m", "0"], 0.0)):
            out = tmp_path / name
            command = ["map", str(path), "--over", "sources", "--grid", "3", "--out", str(out), "--quiet"]
            assert main([*command, *options]) == 0
            with open_map(out / "map.zarr") as dataset:
                assert dataset.attrs["known_moment_sigma_Am2"] == 30.0
                assert dataset.attrs["body_length_m"] == length_m

    def test_starts_are_no_bodies(self, tmp_path, run):
        outcome = run("map", "--grid", "3", "--body-length-m", "1", "--out", tmp_path / "out")
        assert_refused(outcome, "--body-length-m: found 1, expected none with --over starts")

    def test_the_paper_file_has_the_defaults(self):
        default = SourcesScenario()
        paper = read_sources_scenario("paper")
        assert replace(paper, array=default.array) == default

    @pytest.mark.parametrize(
        ("text", "options", "expected"),
        [
            (ARRAY + "[sources]\nnearest_m = 13\n", [], "key sources.nearest_m: found 13"),
            (ARRAY + "[sources]\nmoment_Am2 = 0\n", [], "key sources.moment_Am2: found 0, expected a positive number"),
            (ARRAY + "[sources]\nradius = 1\n", [], "key sources.radius: found an unknown key"),
            (ARRAY.replace("vector", "scalar"), [], "3 independent differences, 6 are needed"),
            (ARRAY + "[sources]\nbody_length_m = -1\n", [], "key sources.body_length_m: found -1"),
            (ARRAY, ["--body-length-m", "-1"], "--body-length-m: found -1, expected from 0 to 10000 m"),
            (ARRAY.replace("= 1.0", "= 1e-30"), [], "must have a noise between 1e-11 and 1e12 nT"),
            (ARRAY, ["--method", "iekf"], "--method: found 'iekf', expected global"),
            (ARRAY, ["--over", "moments"], "--over"),
        ],
    )
    def test_bad_input(self, text, options, expected, tmp_path, run):
        path, out = tmp_path / "bad.toml", tmp_path / "out"
        path.write_text(text)
        assert_refused(run("map", path, "--over", "sources", "--grid", 3, "--out", out, *options), expected)
        assert not out.exists()


@pytest.fixture(scope="module")
def chunked(tmp_path_factory):
    """A command that makes 27 chunks, smaller ones than those of the built-in scenario: starts may take longer."""
    path = tmp_path_factory.mktemp("chunked") / "slow.toml"
    path.write_text(ARRAY + SOURCE + "[damped]\nmax_iterations = 3000\n")
    return "map", str(path), "--grid", "50", "--method", "damped"


@pytest.fixture(scope="module")
def whole(tmp_path_factory, chunked):
    """What the delay_signals command makes."""
    out = tmp_path_factory.mktemp("whole")
    assert main([*chunked, "--out", str(out), "--quiet"]) == 0
    return out


class TestInterrupted:
    """The command as a process of its own, with signals."""

    def started(self, chunked, out):
        process = subprocess.Popen(
            [sys.executable, "-m", "magloc.cli", *chunked, "--threads", "1", "--out", str(out)],
            cwd=REPOSITORY, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        marks = out / "map.zarr/seconds_of_chunk/c"
        while len([path for path in marks.rglob("*") if path.is_file()]) < 3:
            assert process.poll() is None
            time.sleep(0.002)
        return process

    def resumed(self, chunked, out, whole, capsys):
        """Result of the same command, compared with that of an delay_signals one, to the last bit."""
        assert main([*chunked, "--out", str(out)]) == 0
        err = capsys.readouterr().err
        assert re.search(r"\d+ of 27 chunks were there before", err)
        with (
            open_map(out / "map.zarr") as found,
            open_map(whole / "map.zarr") as expected,
        ):
            xr.testing.assert_equal(found, expected)

    @pytest.mark.slow
    def test_kill_9(self, tmp_path, chunked, whole, capsys):
        process = self.started(chunked, tmp_path / "out")
        process.kill()
        process.communicate()
        assert not (tmp_path / "out/convergence.png").exists()
        self.resumed(chunked, tmp_path / "out", whole, capsys)

    @pytest.mark.slow
    @pytest.mark.parametrize(("number", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
    def test_a_signal(self, number, word, tmp_path, chunked, whole, capsys):
        process = self.started(chunked, tmp_path / "out")
        process.send_signal(number)
        _, err = process.communicate()
        assert process.returncode == 128 + number
        (line,) = err.splitlines()
        assert re.fullmatch(
            rf"magloc: {word}: \d+ of 27 chunks are done, the same command goes on with the others", line
        )
        self.resumed(chunked, tmp_path / "out", whole, capsys)

    @with_plain_pictures
    def test_finished(self, tmp_path, capsys):
        arguments = ["map", "--grid", "5", "--out", str(tmp_path)]
        results = []
        for _ in range(2):
            assert main([*arguments, "--json"]) == 0
            results.append(json.loads(capsys.readouterr().out))
        assert results[0] == results[1]  # the seconds as well
        assert main(arguments) == 0
        assert "was complete, nothing was computed again" in capsys.readouterr().err

    def test_another_map_in_the_folder(self, tmp_path, run):
        assert run("map", "--grid", "5", "--out", tmp_path, "--quiet").status == 0
        before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
        for options in (["--grid", "6"], ["--grid", "5", "--method", "iekf"], ["--grid", "5", "--over", "sources"]):
            outcome = run("map", *options, "--out", tmp_path)
            assert outcome.out == ""
            assert_refused(outcome, "found another map, with")
        assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before

    @pytest.mark.slow
    def test_what_cannot_be_written(self, tmp_path, capsys):
        """A limit on the size of files stands for a full disk."""
        script = (
            "import resource, sys; from magloc.cli.app import main;"
            "resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000));"
            f"sys.exit(main(['map', '--grid', '51', '--out', {str(tmp_path)!r}]))"
        )
        # A tracer of lines would have to write as well.
        own = {name: value for name, value in os.environ.items() if not name.startswith("COVERAGE")}
        result = subprocess.run([sys.executable, "-c", script], cwd=REPOSITORY, env=own, capture_output=True, text=True)
        assert result.returncode == 2
        (line,) = result.stderr.splitlines()
        assert "map.zarr cannot be written (File too large); 0 of 8 chunks are done, the same command goes on" in line
        assert main(["map", "--grid", "51", "--out", str(tmp_path), "--quiet"]) == 0


class TestScenarios:
    def test_the_paper_is_built_in_and_the_default(self):
        assert "paper" in built_in_scenarios()
        paper = read_starts_scenario("paper")
        default = StartsScenario()
        assert paper.method == default.method
        assert paper.array.sensors == default.array.sensors
        assert (paper.position_m, paper.moment_Am2) == (default.position_m, default.moment_Am2)

    def test_a_file_with_an_array_file_beside_it(self, tmp_path):
        (tmp_path / "array.toml").write_text(ARRAY.removeprefix("[array]\n"))
        (tmp_path / "mine.toml").write_text(
            'array = "array.toml"\nmethod = "iekf"\n' + SOURCE + "[iekf]\nmax_iterations = 7\n"
        )
        scenario = read_starts_scenario(str(tmp_path / "mine.toml"))
        assert scenario.method == IekfFilter(max_iterations=7)
        assert scenario.array.n_sensors == 4


class TestBadInput:
    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("sourse = 1\n", "key sourse: found an unknown key"),
            (ARRAY, "found no key source"),
            (SOURCE, "found no key array"),
            (ARRAY + SOURCE + "[iekf]\nsigma = 3\n", "key iekf.sigma: found an unknown key"),
            (ARRAY + SOURCE + "[repeated]\nmax_iterations = 1.5\n", "key repeated.max_iterations"),
            (ARRAY + SOURCE + "[repeated]\nposition_step_m = 0\n", "expected a positive number"),
            ('method = "newton"\n' + ARRAY + SOURCE, "key method: found 'newton', expected one of repeated, iekf"),
            (ARRAY.replace("tetrahedron", "ring") + SOURCE, "key geometry: found 'ring'"),
            (ARRAY + SOURCE.replace("100, 0, 0", "0, 0, 0"), "found zero, expected a moment"),
            (ARRAY + SOURCE.replace("5, 0, 0.3", "5, 0"), "key source.position_m"),
            (ARRAY.replace("vector", "scalar") + SOURCE, "vector sensors only"),
            ('array = "nowhere.toml"\n' + SOURCE, "nowhere.toml does not exist"),
            ("half_width_m = -1\n" + ARRAY + SOURCE, "key half_width_m: found -1"),
            ("format_version = 2\n" + ARRAY + SOURCE, "key format_version: found 2, expected 1"),
            ("[array\n", "line 1"),
        ],
    )
    def test_scenario_files(self, text, expected, tmp_path, run):
        path, out = tmp_path / "bad.toml", tmp_path / "out"
        path.write_text(text)
        outcome = run("map", path, "--grid", "3", "--out", out)
        assert_refused(outcome, expected)
        assert "bad.toml" in outcome.err or "nowhere.toml" in outcome.err
        assert not out.exists() or not any(out.iterdir())

    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            (["nothing"], "nothing does not exist"),
            (["--grid", "1"], "--grid"),
            (["--grid", "2.5"], "--grid"),
            (["--method", "newton"], "--method"),
            (["--device", "cuda"], "--device: found cuda, expected cpu: filters no longer run on graphics processors."),
            (["--over", "sources", "--device", "cuda"], "--device: found cuda, expected cpu"),
        ],
    )
    def test_options(self, arguments, expected, tmp_path, run):
        assert_refused(run("map", *arguments, "--out", tmp_path / "out"), expected)
        assert not (tmp_path / "out").exists()

    def test_out_is_a_file(self, tmp_path, run):
        (tmp_path / "file").write_text("kept")
        assert_refused(run("map", "--grid", "3", "--out", tmp_path / "file"), "found a file, expected a folder")
        assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize(
    ("iterations", "before", "said"),
    [
        (400_000, 0, "400000 iterations in 2.00 s (5 µs each); wrote out/"),
        (400_000, 3, "400000 iterations in 2.00 s (5 µs each); wrote out/, 3 of 8 chunks were there before"),
        (400_000, 8, "out/ was complete, nothing was computed again; 400000 iterations in 2.00 s (5 µs each)"),
        (0, 0, "0 iterations in 2.00 s (2e+06 µs each); wrote out/"),
    ],
)
def test_what_was_done(iterations: int, before: int, said: str) -> None:
    counts = Summary(10, 9, 0.9, 40.0, iterations, 2.0)
    assert _how_done(before, 8, counts, Path("out")) == said
