"""``magloc calibrate --body``: what it writes and prints, and how it refuses bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arrays.array_file import read_array, write_array
from magloc.bodies.body_file import read_body, write_body
from magloc.readings import write_readings
from sims.magnetics import joystick
from sims.magnetics.files import write_truth
from tests.command_line import Run, assert_refused


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of a joystick in 60 poses of a jig."""
    folder = tmp_path_factory.mktemp("joystick")
    rng = np.random.default_rng(21)
    device, poses = joystick.draw_joystick(rng), joystick.random_poses(rng, 60)
    readings = device.read(*poses, rng)
    write_array(folder / "array.toml", joystick.nominal_array())
    write_body(folder / "knob.toml", joystick.nominal_knob())
    write_readings(folder / "readings.csv", readings, joystick.nominal_array())
    write_truth(joystick.jig_truth(readings, *poses, rng), folder / "truth.csv")
    return folder


@pytest.fixture
def options(folder: Path) -> list[str]:
    names = {"--array": "array.toml", "--body": "knob.toml", "--truth": "truth.csv"}
    return [str(folder / "readings.csv"), *(word for k, v in names.items() for word in (k, str(folder / v)))]


class TestOutputs:
    def test_files_and_json(self, run: Run, options: list[str], tmp_path: Path) -> None:
        array, body = tmp_path / "array.toml", tmp_path / "knob.toml"
        done = run("calibrate", *options, "--out-array", str(array), "--out-body", str(body), "--json")
        report = json.loads(done.out)
        assert report["converged"]
        assert [each["name"] for each in report["unobservable"]] == ["common gain against the strength of the magnets"]
        assert report["cross_validation"]["rows"] == 60
        assert report["chi2_after"] < 0.05 * report["chi2_before"]
        assert report["magnets"][1]["position_m"] == pytest.approx(read_body(body).magnets[1].position_m)
        assert report["sensors"][2]["position_m"] == pytest.approx(read_array(array).sensors[2].position_m)

    def test_either_file_may_be_left_out(self, run: Run, options: list[str], tmp_path: Path) -> None:
        done = run("calibrate", *options, "--out-body", str(tmp_path / "knob.toml"))
        assert done.status == 0
        assert list(tmp_path.iterdir()) == [tmp_path / "knob.toml"]
        assert "magnet" in done.out
        assert "m3" in done.out
        assert "cross-validation: rows held out" in done.err
        assert "the calibrated array is not written; array and body belong together: add --out-array FILE" in done.err

    def test_the_figure(self, run: Run, options: list[str], tmp_path: Path) -> None:
        done = run("calibrate", *options, "--figures", str(tmp_path))
        assert "no file is written; --out-array FILE and --out-body FILE write" in done.err
        assert {path.name for path in tmp_path.iterdir()} == {"calibration.png", "calibration.csv"}


class TestRefusals:
    def test_a_body_with_one_magnet(self, run: Run, options: list[str], tmp_path: Path) -> None:
        text = (Path(options[4])).read_text(encoding="utf-8")
        (tmp_path / "one.toml").write_text(
            text[: text.index("[[magnet]]", text.index("[[magnet]]") + 1)], encoding="utf-8"
        )
        options[4] = str(tmp_path / "one.toml")
        assert_refused(run("calibrate", *options), "one.toml", "at least 2; instead received 1")

    def test_readings_of_another_array(self, run: Run, options: list[str], tmp_path: Path) -> None:
        other = [replace(sensor, id=f"t{i}") for i, sensor in enumerate(joystick.nominal_array().sensors)]
        write_array(tmp_path / "other.toml", replace(joystick.nominal_array(), sensors=tuple(other)))
        options[2] = str(tmp_path / "other.toml")
        assert_refused(run("calibrate", *options), "readings.csv", "t0_x")

    def test_a_truth_in_millimetres(self, run: Run, options: list[str], tmp_path: Path) -> None:
        lines = Path(options[6]).read_text(encoding="utf-8").splitlines()
        wrong = [lines[0]]
        for line in lines[1:]:
            cells = line.split(",")
            wrong.append(",".join([cells[0], *(str(1e3 * float(cell)) for cell in cells[1:4]), *cells[4:]]))
        (tmp_path / "mm.csv").write_text("\n".join(wrong) + "\n", encoding="utf-8")
        options[6] = str(tmp_path / "mm.csv")
        assert_refused(run("calibrate", *options), "mm.csv", "positions in metres")

    def test_a_quaternion_that_is_not_one(self, run: Run, options: list[str], tmp_path: Path) -> None:
        lines = Path(options[6]).read_text(encoding="utf-8").splitlines()
        cells = lines[3].split(",")
        lines[3] = ",".join([*cells[:4], "90", *cells[5:]])
        (tmp_path / "degrees.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
        options[6] = str(tmp_path / "degrees.csv")
        assert_refused(run("calibrate", *options), "degrees.csv", "quaternion of norm")

    @pytest.mark.parametrize(
        ("words", "expected"),
        [
            (("--free-rows",), "--body: found none"),
            (("--body", "knob.toml", "--moment", "free"), "--body: found together with"),
            (("--body", "knob.toml", "--free-rows"), "--free-rows: found no --truth"),
            (
                ("--body", "knob.toml", "--out", "new.toml", "--out-body", "new.toml"),
                "--out-body new.toml: found the file of",
            ),
            (("--body", "knob.toml", "--magnet-position-prior-mm", "0"), "--magnet-position-prior-mm: found 0"),
            ((), "--out: found none, expected the array file to write"),
        ],
    )
    def test_options_that_do_not_go_together(
        self, run: Run, folder: Path, words: tuple[str, ...], expected: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(folder)
        assert_refused(run("calibrate", "readings.csv", "--array", "array.toml", *words), expected)

    def test_a_quaternion_in_the_wrong_order_is_refused(self, run: Run, options: list[str], tmp_path: Path) -> None:
        lines = Path(options[6]).read_text(encoding="utf-8").splitlines()
        swapped = [line.split(",") for line in lines]
        text = [",".join([*c[:4], c[7], *c[4:7], *c[8:]]) if i else lines[0] for i, c in enumerate(swapped)]
        (tmp_path / "wxyz.csv").write_text("\n".join(text) + "\n", encoding="utf-8")
        options[6] = str(tmp_path / "wxyz.csv")
        done = run("calibrate", *options)
        assert done.status == 2
        assert "the order qx, qy, qz, qw" in done.err
