"""``magloc signature``: what it prints and refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arrays
import magloc
from magloc.readings import write_readings
from magloc.signature.path import write_object_path
from tests.command_line import Run, assert_refused, refuse_constant
from tests.passing_ship import ARRAY, PERMANENT_AM2, POLARISABILITY_M3, four_passes, moments, readings_of, shifted

DIAGONAL = np.diag(np.diag(POLARISABILITY_M3))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """A folder with array.toml, and east.csv, north.csv, west.csv, south.csv with their paths."""
    arrays.write_array(tmp_path / "array.toml", ARRAY)
    for name, of_pass in zip(("east", "north", "west", "south"), four_passes(roll_deg=5.0), strict=True):
        write_readings(tmp_path / f"{name}.csv", readings_of(of_pass, moments(of_pass, DIAGONAL), 3), ARRAY)
        write_object_path(tmp_path / f"{name}-path.csv", of_pass.path)
    return tmp_path


def arguments(files: Path, *names: str) -> list[object]:
    readings = [files / f"{name}.csv" for name in names]
    paths = [files / f"{name}-path.csv" for name in names]
    return ["signature", *readings, "--array", files / "array.toml", "--object-path", *paths]


class TestOutput:
    def test_four_passes(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files, "east", "north", "west", "south"), "--depth-m", 9, 36, "--json")
        assert outcome.status == 0, outcome.err
        found = json.loads(outcome.out, parse_constant=refuse_constant)
        np.testing.assert_allclose(found["permanent_Am2"], PERMANENT_AM2, rtol=0.01)
        np.testing.assert_allclose(found["polarisability_m3"], DIAGONAL, rtol=0.01, atol=1e-9)
        assert found["undetermined"] == []
        assert found["misfit"] is False
        assert [(p["depth_m"], p["heading_deg"]) for p in found["predicted"]][:2] == [(9.0, 0.0), (9.0, 90.0)]
        assert np.shape(found["predicted"][7]["field_nT"]) == (61, 3)

    def test_one_pass_says_what_it_leaves_open(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files, "east"))
        assert outcome.status == 0, outcome.err
        assert "not determined by these headings: " in outcome.out
        found = json.loads(run(*arguments(files, "east"), "--json").out, parse_constant=refuse_constant)
        assert None in found["permanent_Am2"]
        assert found["undetermined"]

    def test_the_field_below(self, run: Run, files: Path) -> None:
        """The largest modulus along the keel, on the table as in JSON."""
        outcome = run(*arguments(files, "east", "north", "west", "south"), "--depth-m", 12)
        row = next(line.split() for line in outcome.out.splitlines() if line.split()[:2] == ["12", "north"])
        found = json.loads(run(*arguments(files, "east", "north", "west", "south"), "--depth-m", 12, "--json").out)
        of_north = found["predicted"][0]
        modulus = np.linalg.norm(of_north["field_nT"], axis=1)
        assert float(row[2]) == pytest.approx(modulus.max(), abs=0.06)
        assert float(row[4]) == pytest.approx(of_north["forward_m"][int(np.argmax(modulus))], abs=0.06)

    def test_a_wrong_path_is_said(self, run: Run, files: Path) -> None:
        path = magloc.read_object_path(files / "east-path.csv")
        write_object_path(files / "east-path.csv", shifted(path, np.array([0.0, 3.0, 0.0])))
        outcome = run(*arguments(files, "east", "north"))
        assert "misfit" in outcome.err
        assert "misfit" in outcome.out


class TestBadInput:
    def test_as_many_paths_as_passes(self, run: Run, files: Path) -> None:
        outcome = run(*arguments(files, "east", "north", "west")[:-1])
        assert_refused(outcome, "--object-path: found 2 files, expected one, or 3")

    def test_no_readings(self, run: Run, files: Path) -> None:
        path, array = files / "east-path.csv", files / "array.toml"
        assert_refused(run("signature", "--array", array, "--object-path", path), "READINGS is missing")

    def test_no_ambient_field(self, run: Run, files: Path) -> None:
        readings = magloc.read_readings(files / "east.csv", ARRAY)
        write_readings(files / "east.csv", replace(readings, ambient_T=None), ARRAY)
        assert_refused(run(*arguments(files, "east")), "east.csv: found no ambient field", "--induced none")
        assert run(*arguments(files, "east"), "--place", 54.4, 10.2, 0, "--date", "2026-11-21").status == 0
        assert run(*arguments(files, "east"), "--induced", "none").status == 0

    def test_passes_in_another_order(self, run: Run, files: Path) -> None:
        assert_refused(run(*arguments(files, "north", "east")), "time_s must increase from row to row")

    def test_a_depth_that_is_none(self, run: Run, files: Path) -> None:
        assert_refused(run(*arguments(files, "east"), "--depth-m", 0), "--depth-m: found 0")
