"""The command line: what ``magloc design`` writes and prints, task files, and how bad ones are refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from arrays.array_file import read_array
from arrays.io.errors import InputError
from magloc.cli.design import _table
from magloc.design.optimise import design_array
from magloc.design.regions import Block, Cap, Mean, Quantile
from magloc.design.task import DesignSearch, read_task
from magloc.design.volumes import Ball, BoxVolume, Cylinder
from tests.command_line import Run, assert_refused
from tests.conftest import REPOSITORY

SENSORS = '[sensors]\ncount = 4\nkind = "vector"\nnoise_nT = 1.0\n'
VOLUME = '[volume]\nshape = "ball"\nradius_m = 0.92\n'
SOURCES = '[sources]\nregion = "half-space"\ntowards = [1, 0, 0]\nnearest_m = 2\nfarthest_m = 3\nmoment_Am2 = 100\n'
QUICK = "[search]\nstarts = 3\nrefined = 1\nsources = 256\niterations = 12\njudged = 2000\n"
HULL = '[volume]\nshape = "surface"\nfile = "hull.stl"\n'


def write(folder: Path, *parts: str, name: str = "task.toml") -> Path:
    path = folder / name
    path.write_text("\n".join(parts or (SENSORS, VOLUME, SOURCES, QUICK)))
    return path


@pytest.fixture
def task(tmp_path: Path) -> Path:
    return write(tmp_path)


def reported(run: Run, *arguments: str | Path) -> dict[str, Any]:
    outcome = run("design", *arguments, "--json")
    assert outcome.status == 0, outcome.err
    result: dict[str, Any] = json.loads(outcome.out)
    return result


class TestResult:
    @pytest.mark.slow
    def test_json_and_array_file(self, run, task, tmp_path):
        out = tmp_path / "array.toml"
        result = reported(run, task, "--out", out)
        array = read_array(out)
        np.testing.assert_array_equal(array.positions, result["positions_m"])
        assert array.name == "task"
        assert {sensor.noise_T for sensor in array.sensors} == {1e-9}
        assert np.linalg.norm(array.positions, axis=1).max() <= 0.92 * (1.0 + 1e-9)
        assert result["fitted_m"] <= result["best_start_m"]
        assert result["worst_is_bounded"] is False
        names = [judged["name"] for judged in result["arrays"]]
        assert names == ["task", "best start", "tetrahedron", "cube", "cross", "even grid"]
        assert [judged["sensors"] for judged in result["arrays"]] == [4, 4, 4, 8, 4, 4]
        for judged in result["arrays"]:
            assert len(judged["sigma_range_q95_m"]) == len(judged["distance_m"])
            assert np.all(np.diff(judged["sigma_range_q95_m"]) > 0.0)

    def test_table_and_findings(self, run, task, tmp_path):
        outcome = run("design", task, "--out", tmp_path / "a.toml", "--quiet")
        assert outcome.status == 0
        assert outcome.err == ""
        head = outcome.out.splitlines()[1].split()
        assert head == ["array", "sensors", "distance_m", "q50_m", "q95_m", "mean_m", "bearing_q95_deg"]
        assert "tetrahedron (4 sensors)" in outcome.out
        assert "The worst case is infinite" in outcome.out

    def test_arrays_that_know_no_source_are_not_in_the_table(self, task):
        result = design_array(read_task(str(task)))
        blind = replace(result.judged[-1], name="blind", criterion_m=np.inf)
        assert _table(replace(result, judged=(*result.judged, blind))) == _table(result)

    def test_counts(self, run, task, tmp_path):
        """More sensors know more; an array file each, and the picture has the numbers of the table."""
        out, png = tmp_path / "a.toml", tmp_path / "a.png"
        result = reported(run, task, "--counts", 8, 4, "--out", out, "--png", png)
        few, many = result["counts"]
        assert [entry["sensors"] for entry in result["counts"]] == [4, 8]
        assert many["criterion_m"] < few["criterion_m"]
        for entry in result["counts"]:
            assert entry["design_gain"] == pytest.approx(1.0 - entry["criterion_m"] / entry["even_grid_m"])
            np.testing.assert_array_equal(read_array(entry["out"]).positions, entry["positions_m"])
        assert png.read_bytes().startswith(b"\x89PNG")
        assert_refused(run("design", task, "--counts", 4, 1, "--out", out), "n_sensors must be at least 3")

    def test_fixes_are_possible(self, run, task, tmp_path):
        """The file is one that the other commands read."""
        out = tmp_path / "array.toml"
        reported(run, task, "--out", out)
        array = read_array(out)
        readings = tmp_path / "readings.csv"
        values = ",".join(str(10.0 * np.sin(i)) for i in range(12))
        readings.write_text("time_s," + ",".join(f"{c}_nT" for c in array.channel_names) + f"\n0,{values}\n")
        assert run("locate", readings, "--array", out, "--json").status == 0

    def test_default_file_and_picture(self, run, task, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert run("design", task, "--png", "a.png").status == 0
        assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
        assert read_array(tmp_path / "design-task.toml").n_sensors == 4

    @pytest.mark.slow
    def test_seed_and_threads(self, run, task, tmp_path):
        places = [
            reported(run, task, "--out", tmp_path / f"{i}.toml", *options)["positions_m"]
            for i, options in enumerate((["--threads", "1"], ["--threads", "2"], ["--seed", "1"]))
        ]
        assert places[0] == places[1]
        assert places[0] != places[2]

    def test_surface(self, run, tmp_path):
        mesh = trimesh.creation.box(extents=[1.0, 0.6, 0.4])
        mesh.export(tmp_path / "hull.stl")
        out = tmp_path / "out.toml"
        result = reported(run, write(tmp_path, SENSORS, HULL, SOURCES, QUICK), "--out", out)
        _, distance, _ = trimesh.proximity.closest_point_naive(mesh, read_array(out).positions)
        assert distance.max() < 1e-6  # the corners of an STL file are in single precision
        assert [judged["fits_volume"] for judged in result["arrays"]] == [True, True, False, False, False, True]
        assert result["near_optimal"] == []


class TestBuiltInTasks:
    def test_all_can_be_read(self):
        names = {path.stem for path in (REPOSITORY / "magloc" / "design" / "tasks").glob("*.toml")}
        assert names == {"half-space-2m", "half-space-4m", "half-space-8m", "hull", "plate-scalar"}
        for name in names:
            assert read_task(name).name == name
            assert read_task(name).search == DesignSearch()

    def test_half_space(self):
        task = read_task("half-space-2m")
        assert task.volume == Ball((0.0, 0.0, 0.0), 0.92)
        assert task.region == Cap(2.0, 2.0, (1.0, 0.0, 0.0), 0.5 * np.pi)
        assert (task.n_sensors, task.kind, task.noise_T, task.moment_Am2) == (4, "vector", 1e-9, 100.0)
        assert task.criterion == Quantile(0.95)


class TestTaskFile:
    @pytest.mark.parametrize(
        ("text", "volume"),
        [
            ('shape = "box"\nsize_m = [2, 1, 0]\ncentre_m = [0, 0, 1]', BoxVolume((0.0, 0.0, 1.0), (2.0, 1.0, 0.0))),
            ('shape = "cylinder"\nradius_m = 1\nheight_m = 0', Cylinder((0.0, 0.0, 0.0), 1.0, 0.0)),
        ],
    )
    def test_volumes(self, tmp_path, text, volume):
        assert read_task(str(write(tmp_path, SENSORS, "[volume]", text, SOURCES))).volume == volume

    @pytest.mark.parametrize(
        ("text", "region"),
        [
            ('region = "shell"\nnearest_m = 1\nfarthest_m = 2', Cap(1.0, 2.0)),
            (
                'region = "cap"\ntowards = [0, 0, -1]\nhalf_angle_deg = 30\nnearest_m = 1\nfarthest_m = 2',
                Cap(1.0, 2.0, (0.0, 0.0, -1.0), np.radians(30.0)),
            ),
            ('region = "box"\nlow_m = [1, 2, 3]\nhigh_m = [2, 3, 4]', Block((1.0, 2.0, 3.0), (2.0, 3.0, 4.0))),
        ],
    )
    def test_regions(self, tmp_path, text, region):
        assert read_task(str(write(tmp_path, SENSORS, VOLUME, "[sources]", text, "moment_Am2 = 1"))).region == region

    def test_criterion_and_search(self, tmp_path):
        file = read_task(str(write(tmp_path, SENSORS, VOLUME, SOURCES, '[criterion]\nquantity = "mean"\n', QUICK)))
        assert file.criterion == Mean()
        assert file.search == DesignSearch(3, 1, 5, 8, 4, 12, 2000)


class TestBadInput:
    @pytest.mark.parametrize(
        ("old", "new", "fragments"),
        [
            ("count = 4", "count = 1", ["key count: found 1", "expected 3 to 64"]),
            ("count = 4", "count = 2.5", ["key count", "expected a whole number"]),
            ("count = 4", "counts = 4", ["unknown key", "count"]),
            ('kind = "vector"', 'kind = "scalar"', ["key count: found 4", "expected 7"]),
            ('count = 4\nkind = "vector"', 'count = 8\nkind = "scalar"', ["key ambient_nT"]),
            ("noise_nT = 1.0", "noise_nT = 0.0", ["key noise_nT: found 0"]),
            ("noise_nT = 1.0", "noise_nT = nan", ["key noise_nT"]),
            ("radius_m = 0.92", "radius_m = 0", ["key radius_m: found 0", "positive"]),
            ("radius_m = 0.92", "size_m = [1, 1, 1]", ["unknown key"]),
            ('shape = "ball"\nradius_m = 0.92', 'shape = "box"\nsize_m = [0, 0, 0]', ["one point only"]),
            ('shape = "ball"', 'shape = "blob"', ["key shape: found 'blob'", "expected one of ball, box"]),
            ('shape = "ball"\n', "", ["found no key shape"]),
            ('region = "half-space"', 'region = "hemisphere"', ["key region"]),
            ("towards = [1, 0, 0]", "towards = [0, 0, 0]", ["key towards: found zero"]),
            ("farthest_m = 3", "farthest_m = 1", ["key farthest_m: found 1"]),
            ("moment_Am2 = 100", "moment_Am2 = -1", ["key moment_Am2: found -1"]),
            ("sources = 256", "sources = 300", ["key sources: found 300", "power of two"]),
            ("refined = 1", "refined = 9", ["9 refined of 3 starts"]),
            ("noise_nT = 1.0", "noise_nT = 1.0\nleast_spacing_m = 9", ["must allow sensors"]),
            ("[search]", "[criterion]\nlevel = 1.0\n[search]", ["key level: found 1"]),
            ("[search]", "[surch]", ["unknown key", "search"]),
        ],
    )
    def test_task(self, run, tmp_path, old, new, fragments):
        text = "\n".join([SENSORS, VOLUME, SOURCES, QUICK])
        assert old in text
        out = tmp_path / "out.toml"
        outcome = run("design", write(tmp_path, text.replace(old, new)), "--out", out)
        assert_refused(outcome, "task.toml", *fragments)
        assert not out.exists()

    @pytest.mark.parametrize(
        ("name", "content", "fragment"),
        [
            ("hull.stl", None, "does not exist"),
            ("hull.stl", "no mesh at all", "no "),
            ("hull.ply", "ply\nformat ascii 1.0\n", "no "),
            ("hull.obj", "v 0 0 0\nv 1 0 0\n", "no "),
            ("hull.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "no triangles with an area"),
            ("hull.step", "ISO-10303-21;", "another kind of file"),
        ],
    )
    def test_mesh(self, run, tmp_path, name, content, fragment):
        if content is not None:
            (tmp_path / name).write_text(content)
        task = write(tmp_path, SENSORS, HULL.replace("hull.stl", name), SOURCES, QUICK)
        assert_refused(run("design", task, "--out", tmp_path / "out.toml"), name, fragment)

    def test_unknown_task(self, run):
        assert_refused(run("design", "half-space-3m"), "half-space-3m does not exist", "half-space-2m")

    def test_files_that_cannot_be_written(self, run, task, tmp_path):
        assert_refused(run("design", task, "--out", tmp_path), "--out", "found a folder")
        assert_refused(run("design", task, "--out", tmp_path / "none" / "a.toml"), "--out", "found no folder")
        assert_refused(run("design", task, "--out", tmp_path / "a.toml", "--png", tmp_path), "--png", "found a folder")
        assert_refused(run("design", task, "--out", "/proc/x.toml"), "--out /proc/x.toml", "no file can be made")
        assert not (tmp_path / "a.toml").exists()

    def test_picture_and_array_in_one_file(self, run, task, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        assert_refused(run("design", task, "--out", "a.png", "--png", tmp_path / "a.png"), "--png", "--out")
        assert_refused(run("design", task, "--out", "a.toml", "--png", "a.xyz"), "--png a.xyz", "expected .png")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["task.toml"]

    def test_a_missing_table(self, tmp_path):
        with pytest.raises(InputError, match="found no key volume"):
            read_task(str(write(tmp_path, SENSORS, SOURCES)))


class TestInterruption:
    @staticmethod
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    def test_best_array_so_far_is_written(self, run, task, tmp_path, monkeypatch):
        monkeypatch.setattr("magloc.design.optimise.judge", self.interrupted)
        out = tmp_path / "out.toml"
        outcome = run("design", task, "--out", out)
        assert outcome.status == 130
        assert outcome.err == f"magloc: interrupted: the best array so far is in {out}\n"
        assert np.linalg.norm(read_array(out).positions, axis=1).max() <= 0.92 * (1.0 + 1e-9)

    def test_nothing_is_written_before_the_first(self, run, task, tmp_path, monkeypatch):
        monkeypatch.setattr("magloc.design.optimise.sobol_sample", self.interrupted)
        outcome = run("design", task, "--out", tmp_path / "out.toml")
        assert outcome.status == 130
        assert "nothing is written" in outcome.err
        assert sorted(path.name for path in tmp_path.iterdir()) == ["task.toml"]
