"""``magloc map`` and scenario files, as a user types them."""

from __future__ import annotations

import json
import re

import pytest
import xarray as xr

from magloc.cli import main
from magloc.convergence import IekfFilter, StartsScenario
from magloc.scenarios import built_in_scenarios, read_starts_scenario

SOURCE = "[source]\nposition_m = [5, 0, 0.3]\nmoment_Am2 = [100, 0, 0]\n"
ARRAY = '[array]\ngeometry = "tetrahedron"\nedge_m = 1.5\nkind = "vector"\nnoise_nT = 1.0\n'


class TestResult:
    def test_json_is_the_only_thing_on_stdout(self, tmp_path, capsys):
        assert main(["map", "--grid", "5", "--out", str(tmp_path / "out"), "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert set(result) == {
            "starts",
            "converged",
            "fraction",
            "front_fraction",
            "back_fraction",
            "median_iterations",
            "seconds",
            "iterations_total",
            "out",
        }
        assert result["starts"] == 125
        assert result["fraction"] == result["converged"] / 125
        assert result["out"] == str(tmp_path / "out")

    def test_files(self, tmp_path, capsys):
        assert main(["map", "paper", "--method", "iekf", "--grid", "5", "--out", str(tmp_path), "--quiet"]) == 0
        assert sorted(path.name for path in tmp_path.iterdir()) == ["convergence.nc", "convergence.png"]
        assert (tmp_path / "convergence.png").read_bytes().startswith(b"\x89PNG")
        with xr.open_dataset(tmp_path / "convergence.nc") as dataset:
            assert dataset.attrs["method"] == "iekf"
        out, err = capsys.readouterr()
        assert re.search(r"\d+ of 125 starts converged", out)
        assert err == ""

    def test_threads_do_not_matter(self, tmp_path, capsys):
        results = []
        for threads in ("1", "2"):
            main(["map", "--grid", "7", "--threads", threads, "--out", str(tmp_path / threads), "--json"])
            results.append(json.loads(capsys.readouterr().out))
        for result in results:
            del result["seconds"], result["out"]
        assert results[0] == results[1]

    def test_noise_is_drawn_with_the_seed(self, tmp_path, capsys):
        optima = []
        for i, options in enumerate(([], ["--noise"], ["--noise", "--seed", "1"], ["--noise", "--seed", "1"])):
            assert main(["map", "--grid", "3", "--out", str(tmp_path / str(i)), "--quiet", *options]) == 0
            with xr.open_dataset(tmp_path / str(i) / "convergence.nc") as dataset:
                optima.append(tuple(dataset.attrs["optimum_position_m"]))
        assert len(set(optima)) == 3
        assert optima[2] == optima[3]


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
    def test_scenario_files(self, text, expected, tmp_path, capsys):
        path = tmp_path / "bad.toml"
        path.write_text(text)
        out = tmp_path / "out"
        assert main(["map", str(path), "--grid", "3", "--out", str(out)]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert expected in lines[0]
        assert "bad.toml" in lines[0] or "nowhere.toml" in lines[0]
        assert not out.exists() or not any(out.iterdir())

    @pytest.mark.parametrize(
        ("arguments", "expected"),
        [
            (["nothing"], "nothing does not exist"),
            (["--grid", "1"], "--grid"),
            (["--grid", "2.5"], "--grid"),
            (["--method", "newton"], "--method"),
        ],
    )
    def test_options(self, arguments, expected, tmp_path, capsys):
        assert main(["map", *arguments]) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        assert expected in lines[0]

    def test_out_is_a_file(self, tmp_path, capsys):
        (tmp_path / "file").write_text("kept")
        assert main(["map", "--grid", "3", "--out", str(tmp_path / "file")]) == 2
        assert "found a file, expected a folder" in capsys.readouterr().err
        assert (tmp_path / "file").read_text() == "kept"
