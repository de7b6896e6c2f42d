"""The command line: what ``magloc simulate`` writes and prints, and how it refuses bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arrays.array_file import read_array
from magloc.readings import read_readings
from magloc.truth import read_truth
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import simulate
from tests.command_line import Run, assert_refused

TWO_SOURCES = """
duration_s = 5
rate_Hz = 2
[array]
geometry = "tetrahedron"
edge_m = 1
kind = "vector"
noise_nT = 1
[[source]]
path = { kind = "fixed", position_m = [3, 0, 0] }
moment_Am2 = [1, 2, 3]
[[source]]
path = { kind = "line", start_m = [0, 4, 0], course_deg = 90, speed_m_s = 0.5 }
moment_Am2 = [4, 5, 6]
"""


class TestFiles:
    def test_readings_truth_and_array(self, run: Run, tmp_path: Path) -> None:
        outcome = run("simulate", "weaving", "--out", tmp_path / "run.csv", "--seed", 4)
        assert outcome.status == 0
        assert outcome.out == ""
        assert "321 rows" in outcome.err
        for name in ("run.csv", "run-truth.csv", "run-array.toml"):
            assert str(tmp_path / name) in outcome.err
        expected = simulate(read_scenario("weaving"), 4)
        array = read_array(tmp_path / "run-array.toml")
        assert array == expected.array
        readings = read_readings(tmp_path / "run.csv", array)
        np.testing.assert_allclose(readings.values_T, expected.readings.values_T, rtol=1e-14)
        np.testing.assert_array_equal(read_truth(tmp_path / "run-truth.csv").moment_Am2, expected.truth.moment_Am2)

    def test_every_source_has_a_truth(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "two.toml").write_text(TWO_SOURCES)
        outcome = run("simulate", tmp_path / "two.toml", "--out", tmp_path / "run.csv", "--json")
        assert outcome.status == 0
        assert outcome.err == ""
        report = json.loads(outcome.out)
        assert (report["scenario"], report["rows"], report["channels"], report["seed"]) == ("two", 11, 12, 0)
        assert report["truths"] == [str(tmp_path / "run-truth.csv"), str(tmp_path / "run-truth-2.csv")]
        assert report["readings"] == str(tmp_path / "run.csv")
        assert report["array"] == str(tmp_path / "run-array.toml")
        second = read_truth(tmp_path / "run-truth-2.csv")
        np.testing.assert_allclose(second.position_m[-1], [2.5, 4.0, 0.0], atol=1e-12)

    def test_bodies(self, run: Run, tmp_path: Path) -> None:
        for name, options in (("point", ()), ("bar", ("--body-length-m", "0.5"))):
            (tmp_path / name).mkdir()
            assert run("simulate", "weaving", "--out", tmp_path / name / "run.csv", *options).status == 0
        point, bar = ((tmp_path / name / "run.csv").read_text() for name in ("point", "bar"))
        assert point != bar
        bodies = read_scenario("weaving")
        bodies = replace(bodies, sources=tuple(replace(source, body_length_m=0.5) for source in bodies.sources))
        array = read_array(tmp_path / "bar" / "run-array.toml")
        found = read_readings(tmp_path / "bar" / "run.csv", array).values_T
        np.testing.assert_allclose(found, simulate(bodies, 0).readings.values_T, rtol=1e-14)
        truths = [(tmp_path / name / "run-truth.csv").read_text() for name in ("point", "bar")]
        assert truths[0] == truths[1]

    def test_the_seed_makes_the_noise(self, run: Run, tmp_path: Path) -> None:
        texts = []
        for i, seed in enumerate((1, 1, 2)):
            assert run("simulate", "paper", "--out", tmp_path / f"{i}.csv", "--seed", seed, "--quiet").err == ""
            texts.append((tmp_path / f"{i}.csv").read_text())
        assert texts[0] == texts[1] != texts[2]

    def test_existing_files_are_replaced(self, run: Run, tmp_path: Path) -> None:
        for name in ("run.csv", "run-truth.csv", "run-array.toml"):
            (tmp_path / name).write_text("old")
        assert run("simulate", "paper", "--out", tmp_path / "run.csv").status == 0
        assert all(path.read_text() != "old" for path in tmp_path.iterdir())

    @pytest.mark.parametrize("name", ["weaving", "hand-magnet"])
    def test_locate_reads_them(self, run: Run, tmp_path: Path, name: str) -> None:
        assert run("simulate", name, "--out", tmp_path / "run.csv").status == 0
        outcome = run("locate", tmp_path / "run.csv", "--array", tmp_path / "run-array.toml", "--json")
        assert outcome.status == 0
        truth = read_truth(tmp_path / "run-truth.csv").position_m
        best = [row["solutions"][0] for row in json.loads(outcome.out)["results"]]
        error = np.array([solution["position_m"] for solution in best]) - truth
        sigma = np.sqrt([np.diag(solution["covariance"])[:3] for solution in best])
        assert np.median(np.abs(error) / sigma) < 1.0  # 0.67 of a normal error


class TestBadInput:
    def test_an_unknown_scenario(self, run: Run, tmp_path: Path) -> None:
        outcome = run("simulate", "submarine", "--out", tmp_path / "run.csv")
        assert_refused(
            outcome,
            "submarine",
            "diver, drone, hand-magnet, paper, ship, ship-headings, survey-cart, survey-diver, survey-drone,"
            " three-magnets, weaving",
        )
        assert not list(tmp_path.iterdir())

    def test_an_unknown_key(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "two.toml").write_text(TWO_SOURCES.replace("rate_Hz", "rate_Hertz"))
        assert_refused(run("simulate", tmp_path / "two.toml", "--out", tmp_path / "run.csv"), "rate_Hertz", "rate_Hz")

    def test_bodies_where_there_are_none(self, run: Run, tmp_path: Path) -> None:
        command = ("simulate", "paper", "--out", tmp_path / "run.csv", "--body-length-m")
        assert_refused(run(*command, "-1"), "--body-length-m", "-1")
        no_source = TWO_SOURCES[: TWO_SOURCES.index("[[source]]")]
        (tmp_path / "none.toml").write_text(no_source)
        assert_refused(run("simulate", tmp_path / "none.toml", *command[2:], "1"), "--body-length-m", "a source")

    def test_an_array_inside_the_source(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "two.toml").write_text(f"{TWO_SOURCES}radius_m = 4\n")
        outcome = run("simulate", tmp_path / "two.toml", "--out", tmp_path / "run.csv")
        assert_refused(outcome, "two.toml", "source 2", "4 m")
        assert [path.name for path in tmp_path.iterdir()] == ["two.toml"]

    def test_a_folder_that_is_not_there(self, run: Run, tmp_path: Path) -> None:
        assert_refused(run("simulate", "paper", "--out", tmp_path / "none" / "run.csv"), "none")

    def test_a_folder_where_a_file_should_be(self, run: Run, tmp_path: Path) -> None:
        (tmp_path / "run-truth.csv").mkdir()
        assert_refused(
            run("simulate", "paper", "--out", tmp_path / "run.csv"), "--out", "run-truth.csv", "found a folder"
        )
        assert [path.name for path in tmp_path.iterdir()] == ["run-truth.csv"]

    def test_a_folder_where_nothing_can_be_made(self, run: Run) -> None:
        outcome = run("simulate", "paper", "--out", "/proc/x.csv")
        assert_refused(outcome, "--out /proc/x.csv", "no file can be made in /proc")
        assert ".magloc-" not in outcome.err

    def test_no_out(self, run: Run) -> None:
        assert_refused(run("simulate", "paper"), "--out")

    def test_a_fault_while_writing_leaves_nothing(
        self, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def full(*_: object) -> None:
            raise OSError(28, "No space left on device", "run-truth.csv")

        (tmp_path / "run.csv").write_text("old")
        monkeypatch.setattr("sims.magnetics.files.write_truth", full)
        assert_refused(run("simulate", "paper", "--out", tmp_path / "run.csv"), "No space left")
        assert [path.name for path in tmp_path.iterdir()] == ["run.csv"]
        assert (tmp_path / "run.csv").read_text() == "old"
