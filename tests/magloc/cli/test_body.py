"""``--body`` of locate, track, live and bounds: the JSON that is documented, and bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
from magloc.bodies.body_file import write_body
from magloc.cli.app import main
from magloc.readings import write_readings
from tests.fuzz.runner import LONGEST_SENTENCE
from tests.magloc.bodies.devices import hall_ring, knob
from tests.magloc.bodies.test_filter import record

GIVEN = "--array a.toml --body b.toml"


@pytest.fixture
def truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[np.ndarray, np.ndarray]:
    monkeypatch.chdir(tmp_path)
    array, body = hall_ring(4), knob()
    readings, position_m, R = record(array, body, 30, 60_40)
    arrays.write_array("a.toml", array)
    write_body("b.toml", body)
    write_readings("r.csv", readings, array)
    return position_m, R


@pytest.mark.parametrize("line", ["locate r.csv", "track r.csv"])
def test_json_has_the_poses(
    line: str, truth: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*line.split(), *GIVEN.split(), "--json"]) == 0
    results = json.loads(capsys.readouterr().out)["results"]
    assert [entry["time_s"] for entry in results] == [i / 200.0 for i in range(30)]
    for entry, x, R in zip(results, *truth, strict=True):
        (pose,) = entry["poses"]
        assert set(pose) == {"position_m", "quaternion_xyzw", "covariance", "chi2", "dof"}
        sigma = np.sqrt(np.diagonal(pose["covariance"]))
        assert (np.abs(pose["position_m"] - x) < 6.0 * sigma[:3]).all()
        turn = (Rotation.from_quat(pose["quaternion_xyzw"]).inv() * Rotation.from_matrix(R)).as_rotvec()
        assert (np.abs(turn) < 6.0 * sigma[3:]).all()


def test_a_stream_and_a_file_have_one_track(
    truth: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["track", "r.csv", *GIVEN.split(), "--jsonl"]) == 0
    from_file = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert main(["live", *GIVEN.split(), "--from", "replay:r.csv", "--replay-speed", "1e6"]) == 0
    from_stream = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(from_file) == len(from_stream) == len(truth[0])
    for one, other in zip(from_file, from_stream, strict=True):
        np.testing.assert_allclose(one["poses"][0]["position_m"], other["poses"][0]["position_m"], atol=1e-9)
        assert other["latency_ms"] > 0.0


def test_a_stream_is_written_row_by_row(
    truth: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    line = ["live", *GIVEN.split(), "--from", "replay:r.csv", "--replay-speed", "1e6", "--out", "poses.csv"]
    assert main(line) == 0
    printed = [json.loads(line)["poses"][0]["position_m"] for line in capsys.readouterr().out.splitlines()]
    rows = list(csv.DictReader(Path("poses.csv").read_text(encoding="utf-8").splitlines()))
    np.testing.assert_allclose([[float(row[f"{axis}_m"]) for axis in "xyz"] for row in rows], printed, rtol=1e-9)
    assert {row["status"] for row in rows} == {"tracked"}


def test_bounds_are_those_of_the_range(
    truth: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bounds", *GIVEN.split(), "--json"]) == 0
    bounds = json.loads(capsys.readouterr().out)
    assert bounds["determined_fraction"] == 1.0
    assert 0.0 < bounds["sigma_position_m"]["median"] < 1e-3


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        (f"locate r.csv {GIVEN} --sources 2", "--sources: found together with --body"),
        (f"locate r.csv {GIVEN} --region z>0", "--region: found together"),
        (f"track r.csv {GIVEN} --smooth", "--smooth: found together with --body"),
        (f"track r.csv {GIVEN} --sources 2", "--sources: found together with --body"),
        (f"live {GIVEN} --from replay:r.csv --sources 2", "--sources: found together with --body"),
        (f"live {GIVEN} --from replay:r.csv --rest-s 1", "found no row in which the body can be tracked"),
        ("bounds --body b.toml", "--body: found no --array"),
        ("locate r.csv --array a.toml --body none.toml", "none.toml does not exist"),
    ],
)
def test_bad_input_is_one_sentence(
    line: str, sentence: str, truth: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(line.split()) == 2
    assert sentence in capsys.readouterr().err


def test_readings_of_no_body_end_in_a_reason(
    truth: tuple[np.ndarray, np.ndarray], capsys: pytest.CaptureFixture[str]
) -> None:
    lines = Path("r.csv").read_text(encoding="utf-8").splitlines()
    noise = np.random.default_rng(60_41).normal(0.0, 1e3, (30, 12))
    rows = [
        ",".join([row.split(",")[0], *map(repr, map(float, values))])
        for row, values in zip(lines[1:], noise, strict=True)
    ]
    Path("n.csv").write_text("\n".join([lines[0], *rows, ""]), encoding="utf-8")
    for command in ("locate", "track"):
        assert main([command, "n.csv", *GIVEN.split(), "--out", "poses"]) == 2
        err = capsys.readouterr().err
        assert "found no row with a pose of the body" in err
        assert len(err.splitlines()[-1]) <= LONGEST_SENTENCE
        assert not Path("poses").exists()
