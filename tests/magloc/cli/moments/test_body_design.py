"""``magloc design --body``: files, the JSON that is documented, and bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import arrays
from magloc.bodies.body import PoseLimits
from magloc.bodies.body_file import read_body, write_body
from magloc.cli.app import main
from tests.magloc.bodies.devices import hall_ring, knob

MAGNETS = "[magnets]\nleast_spacing_m = 0.004\n"
VOLUME = '[volume]\nshape = "cylinder"\nradius_m = 0.008\nheight_m = 0.0\n'
SENSORS = '[sensors]\nleast_spacing_m = 0.004\n[sensor_volume]\nshape = "box"\nsize_m = [0.03, 0.03, 0.0]\n'
QUICK = "[search]\nstarts = 1\nrefined = 1\nposes = 64\niterations = 3\n"
GIVEN = "--array a.toml --body b.toml"


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    arrays.write_array("a.toml", hall_ring(4))
    write_body("b.toml", knob())
    write_body("free.toml", replace(knob(), limits=PoseLimits()))
    for name, text in (
        ("t", MAGNETS + VOLUME + QUICK),
        ("both", MAGNETS + VOLUME + SENSORS + QUICK),
        ("half", MAGNETS + VOLUME + SENSORS.split("[sensor_volume]")[0]),
        ("odd", MAGNETS + VOLUME + "[search]\nposes = 100\n"),
        ("touching", MAGNETS.replace("0.004", "0.0") + VOLUME),
    ):
        Path(f"{name}.toml").write_text(text, encoding="utf-8")
    return tmp_path


def test_writes_the_body(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["design", "t.toml", *GIVEN.split(), "--out-body", "o.toml", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    body = read_body("o.toml")
    np.testing.assert_array_equal(body.positions_m, result["positions_m"])
    np.testing.assert_array_equal(body.moments_Am2, result["moments_Am2"])
    assert (body.ids, body.limits.high_m) == (knob().ids, knob().limits.high_m)
    assert result["criterion_after_m"] < result["criterion_before_m"]
    assert result["lever_m"] == 0.008
    assert main(["bounds", "--array", "a.toml", "--body", "o.toml", "--json"]) == 0
    bounds = json.loads(capsys.readouterr().out)
    assert {key: result["after"][key] for key in ("poses", "sigma_position_m", "sigma_rotation_deg")} == {
        key: bounds[key] for key in ("poses", "sigma_position_m", "sigma_rotation_deg")
    }


def test_writes_the_array_of_sensors_that_move(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["design", "both.toml", *GIVEN.split()]) == 0
    printed = capsys.readouterr()
    assert "q95 of position and 8 mm × rotation" in printed.out
    assert "wrote design-both-body.toml and design-both.toml" in printed.err
    assert np.abs(arrays.read_array("design-both.toml").positions - hall_ring(4).positions).max() > 1e-5


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("t.toml --body b.toml", "--body: found no --array"),
        (GIVEN, "--body: found no task file"),
        ("t.toml --array a.toml", "--array: found no --body"),
        ("t.toml --out-body o.toml", "--out-body: found no --body"),
        (f"t.toml {GIVEN} --counts 4", "--counts: found together with --body"),
        (f"t.toml {GIVEN} --out o.toml", "--out: found it with a fixed array"),
        (f"both.toml {GIVEN} --out o.toml --out-body o.toml", "--out-body"),
        (f"half.toml {GIVEN}", "found table sensors without sensor_volume"),
        (f"odd.toml {GIVEN}", "poses: found 100, expected a power of two"),
        (f"touching.toml {GIVEN}", "least_spacing_m"),
        ("t.toml --array a.toml --body free.toml", "limits of its position"),
        (f"none.toml {GIVEN}", "none.toml does not exist"),
    ],
)
def test_bad_input_is_one_sentence(line: str, sentence: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(folder.iterdir())
    assert main(["design", *line.split()]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert len(error.strip().splitlines()) == 1
    assert sorted(folder.iterdir()) == before
