"""``magloc track`` with ``--position`` and ``--object-path``: what it prints, writes and refuses."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from magloc.readings import write_readings
from magloc.signature.path import write_object_path
from tests.command_line import Run, assert_refused, refuse_constant
from tests.passing_ship import ARRAY, PERMANENT_AM2, readings_of, shifted, straight_pass

PASS = straight_pass(70.0)
CONSTANT = np.tile(PERMANENT_AM2, (len(PASS.time_s), 1))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with array.toml, ship.csv, path.csv, wrong.csv and truth.csv."""
    arrays.write_array(tmp_path / "array.toml", ARRAY)
    write_readings(tmp_path / "ship.csv", readings_of(PASS, CONSTANT, seed=1), ARRAY)
    path = magloc.ObjectPath(PASS.time_s, PASS.position_m)
    write_object_path(tmp_path / "path.csv", path)
    write_object_path(tmp_path / "wrong.csv", shifted(path, np.array([0.0, 3.0, 0.0])))
    lines = ["time_s,x_m,y_m,z_m,mx_Am2,my_Am2,mz_Am2"]
    for t, p, m in zip(PASS.time_s, PASS.position_m, CONSTANT, strict=True):
        lines.append(",".join(map(repr, [float(t), *map(float, p), *map(float, m)])))
    (tmp_path / "truth.csv").write_text("\n".join([*lines, ""]), encoding="utf-8")
    return tmp_path


def arguments(files: Path, path: str = "path.csv") -> list[object]:
    return ["track", files / "ship.csv", "--array", files / "array.toml", "--object-path", files / path]


class TestOutput:
    def test_json_is_what_python_gives(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files), "--turn-deg-s", 0.1, "--json", "--truth", files / "truth.csv")
        assert outcome.status == 0, outcome.err
        found = json.loads(outcome.out, parse_constant=refuse_constant)
        assert list(found) == ["results", "chi2", "dof", "misfit", "consistency", "warnings"]
        readings = magloc.read_readings(files / "ship.csv", ARRAY)
        path = magloc.read_object_path(files / "path.csv")
        track = magloc.track_moment(ARRAY, readings, path, turn_rad_s=np.radians(0.1))
        np.testing.assert_allclose([row["moment_Am2"] for row in found["results"]], track.moment_Am2, rtol=1e-9)
        np.testing.assert_allclose([row["position_m"] for row in found["results"]], PASS.position_m)
        assert np.shape([row["covariance"] for row in found["results"]]) == (len(CONSTANT), 6, 6)
        assert found["consistency"]["rows"] == len(CONSTANT)
        assert found["misfit"] is False

    def test_table_and_truth(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files), "--smooth", "--truth", files / "truth.csv")
        lines = outcome.out.splitlines()
        assert lines[0].split()[0] == "time_s"
        assert len(lines) == 1 + len(CONSTANT) + 4
        assert "NEES per dimension" in outcome.out
        assert f"{len(CONSTANT)} of {len(CONSTANT)} rows with a moment" in outcome.err

    def test_a_line_for_every_row(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files), "--jsonl")
        entries = [json.loads(line, parse_constant=refuse_constant) for line in outcome.out.splitlines()]
        assert [entry["status"] for entry in entries] == ["tracked"] * len(CONSTANT)

    def test_at_rest(self, run: Run, files: Path) -> None:
        place = (3.0, 4.0, 9.0)
        at_rest = [np.tile(place, (5, 1)), np.tile(PERMANENT_AM2, (5, 1))]
        fields = magloc.dipole.field(ARRAY.positions, at_rest[0][:, None], at_rest[1][:, None])
        write_readings(files / "rest.csv", magloc.Readings(ARRAY.readings_of(fields)), ARRAY)
        outcome = run("track", files / "rest.csv", "--array", files / "array.toml", "--position", *place, "--json")
        np.testing.assert_allclose(json.loads(outcome.out)["results"][-1]["moment_Am2"], PERMANENT_AM2, rtol=1e-6)

    def test_files(self, run: Run, files: Path) -> None:
        place = ("--place", 54.4, 10.2, 0.0)
        outcome = run(*arguments(files), "--geojson", files / "track.geojson", "--out", files / "out", *place)
        assert outcome.status == 0, outcome.err
        assert json.loads((files / "track.geojson").read_text())["features"][0]["geometry"]["type"] == "LineString"
        assert {path.name for path in (files / "out").iterdir()} == {"track.png", "consistency.png", "track.csv"}

    def test_a_wrong_path_is_said(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files, "wrong.csv"), "--turn-deg-s", 0.1)
        assert outcome.status == 0
        assert "misfit" in outcome.err
        stated = run(*arguments(files, "wrong.csv"), "--turn-deg-s", 0.1, "--path-sigma-m", 3, "--smooth")
        assert "misfit" not in stated.err


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            (("--position", 1, 2, 3), "--position: found together with --object-path"),
            (("--region", "z>0"), "--region: found together with a known position"),
            (("--max-moment-Am2", 5), "--max-moment-Am2: found together with a known position"),
            (("--motion", "turn"), "--motion: found turn with a known position"),
            (("--path-sigma-m", -1), "--path-sigma-m: found -1"),
            (("--path-correlation-s", 5), "--path-correlation-s: found no --path-sigma-m"),
            (("--attitude-correlation-s", 5), "--attitude-correlation-s: found no --attitude-sigma-deg"),
        ],
    )
    def test_options(self, run: Run, files: Path, options: tuple[object, ...], expected: str) -> None:
        assert_refused(run(*arguments(files), *options), expected)

    def test_an_error_of_no_path(self, run: Run, files: Path) -> None:
        outcome = run("track", files / "ship.csv", "--array", files / "array.toml", "--path-sigma-m", 1)
        assert_refused(outcome, "--path-sigma-m: found neither --position nor --object-path")

    def test_a_stream(self, run: Run, files: Path) -> None:
        outcome = run("track", "-", "--array", files / "array.toml", "--position", 1, 2, 3)
        assert_refused(outcome, "found an option that needs the whole record")

    def test_a_path_of_another_time(self, run: Run, files: Path) -> None:
        write_object_path(files / "later.csv", magloc.ObjectPath(PASS.time_s + 1e4, PASS.position_m))
        assert_refused(run(*arguments(files, "later.csv")), "later.csv: found none of the times of the readings")

    def test_the_place_of_a_sensor(self, run: Run, files: Path) -> None:
        place = map(float, ARRAY.positions[0])
        outcome = run("track", files / "ship.csv", "--array", files / "array.toml", "--position", *place)
        assert_refused(outcome, "must not pass through a sensor")


class TestSeveralPlaces:
    """--position more than once, of fixes and of tracks."""

    PLACES = ("--position", "0", "0", "0.1", "--position", "0.1", "0.05", "0.12")

    @pytest.fixture
    def cells(self, tmp_path: Path) -> tuple[Path, Path]:
        """A readings file and its array's: two cells below a board."""
        array = arrays.grid(3, 3, 0.1, noise_T=1e-9)
        pairs = (([0.0, 0.0, 0.1], [0.1, 0.2, -0.3]), ([0.1, 0.05, 0.12], [0.3, 0.1, 0.2]))
        clean = array.readings_of(sum(magloc.dipole.field(array.positions, *pair) for pair in pairs))
        values_T = clean + 1e-9 * np.random.default_rng(4).normal(size=(6, clean.size))
        arrays.write_array(tmp_path / "board.toml", array)
        write_readings(tmp_path / "cells.csv", magloc.Readings(values_T), array)
        return tmp_path / "cells.csv", tmp_path / "board.toml"

    @pytest.mark.parametrize("command", ["locate", "track"])
    def test_json_lists_sources(self, run: Run, cells: tuple[Path, Path], command: str) -> None:
        outcome = run(command, cells[0], "--array", cells[1], *self.PLACES, "--json")
        assert outcome.status == 0, outcome.err
        last = json.loads(outcome.out, parse_constant=refuse_constant)["results"][-1]
        sources = last["solutions"][0]["sources"] if command == "locate" else last["sources"]
        np.testing.assert_allclose([s["position_m"] for s in sources], [[0, 0, 0.1], [0.1, 0.05, 0.12]], atol=1e-12)
        np.testing.assert_allclose([s["moment_Am2"] for s in sources], [[0.1, 0.2, -0.3], [0.3, 0.1, 0.2]], atol=1e-2)

    def test_tables_and_lines(self, run: Run, cells: tuple[Path, Path]) -> None:
        outcome = run("locate", cells[0], "--array", cells[1], *self.PLACES)
        of_table = [float(line.split()[9]) for line in outcome.out.splitlines()[1:]]
        array = arrays.read_array(cells[1])
        places = [[0, 0, 0.1], [0.1, 0.05, 0.12]]
        fixes = magloc.locate(array, magloc.read_readings(cells[0], array), position_m=places)
        expected = [
            np.sqrt(s.moment_Am2 @ s.covariance @ s.moment_Am2) / np.linalg.norm(s.moment_Am2)
            for fix in fixes
            for s in fix.best.sources
        ]
        np.testing.assert_allclose(of_table, expected, rtol=0.05)
        outcome = run("track", cells[0], "--array", cells[1], *self.PLACES)
        assert outcome.status == 0, outcome.err
        assert [line for line in outcome.out.splitlines() if line.startswith("source")] == ["source 1", "source 2"]
        assert "6 of 6 rows with a moment" in outcome.err
        lines = run("track", cells[0], "--array", cells[1], *self.PLACES, "--jsonl").out.splitlines()
        assert [len(json.loads(line)["sources"]) for line in lines] == [2] * 6

    @pytest.mark.parametrize(
        ("more", "said"),
        [(("--path-sigma-m", "1"), "--path-sigma-m"), (("--out", "folder"), "--out: found several places")],
    )
    def test_refused(self, run: Run, cells: tuple[Path, Path], more: tuple[str, ...], said: str) -> None:
        assert_refused(run("track", cells[0], "--array", cells[1], *self.PLACES, *more), said)
