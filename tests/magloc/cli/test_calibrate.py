"""The command line: what ``magloc calibrate`` writes and prints, and how it refuses bad input."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.array_file import read_array, read_sensors, write_array
from arrays.sensor import Calibration, Sensor
from magloc.calibration import calibrate as calibration
from magloc.readings import Readings, read_readings, write_readings
from tests.command_line import Outcome, Run, assert_refused, refuse_constant
from tests.oracles import magpylib_field

FloatArray = NDArray[np.float64]
NOISE_T = 1e-9
MOMENT = np.array([0.5, -0.3, 0.8])
PLACES = 0.1 * np.array([[1, 0, 0], [-1, 0, 0.2], [0, 1, -0.1], [0.1, -1, 0], [0, 0.2, 1], [0.2, 0.1, -1]])


@dataclass(frozen=True)
class Files:
    """A nominal array and readings of the true one."""

    folder: Path
    true: SensorArray
    position_m: FloatArray
    origin_m: FloatArray
    world_from_array: FloatArray

    @property
    def array(self) -> Path:
        return self.folder / "array.toml"

    @property
    def readings(self) -> Path:
        return self.folder / "readings.csv"

    @property
    def out(self) -> Path:
        return self.folder / "out.toml"

    def truth(self, columns: str = "xyz", *, moment: bool = False, shift_s: float = 0.0) -> Path:
        """A truth file in the world frame, last row first."""
        path = self.folder / "truth.csv"
        world = self.origin_m + np.einsum("tab,tb->ta", self.world_from_array, self.position_m)
        names = ["time_s", *(f"{axis}_m" for axis in columns), *(["mx_Am2", "my_Am2", "mz_Am2"] if moment else [])]
        lines = [",".join(names)]
        for time, place in reversed(list(enumerate(world))):
            numbers = [time + shift_s, *place["xyz".index(columns[0]) :][: len(columns)], *(MOMENT if moment else [])]
            lines.append(",".join(repr(float(number)) for number in numbers))
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return path


def made(folder: Path, *, n: int = 40, posed: bool = False) -> Files:
    rng = np.random.default_rng(1)
    true = SensorArray(
        tuple(
            Sensor(
                id=f"s{i}",
                kind="vector",
                position_m=tuple(place.tolist()),
                noise_T=NOISE_T,
                calibration=Calibration.of("vector", np.eye(3) + rng.normal(0, 0.02, (3, 3)), rng.normal(0, 1e-6, 3)),
            )
            for i, place in enumerate(PLACES, start=1)
        ),
        common_field_T=1e-12,
    )
    nominal = replace(
        true,
        sensors=tuple(
            replace(s, position_m=np.array(s.position_m) + rng.normal(0, 1e-3, 3), calibration=None)
            for s in true.sensors
        ),
    )
    direction = rng.normal(size=(n, 3))
    position = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(0.2, 0.3, (n, 1))
    rotation = Rotation.random(n, rng=rng) if posed else Rotation.from_quat(np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)))
    attitude = rotation.as_matrix()
    origin = rng.normal(size=(n, 3)) if posed else np.zeros((n, 3))
    moments = np.swapaxes(attitude, -1, -2) @ MOMENT
    fields = np.stack([magpylib_field(true.positions, p, m) for p, m in zip(position, moments, strict=True)])
    values = true.readings_of(fields) + NOISE_T * rng.normal(size=(n, true.n_channels))
    files = Files(folder, true, position, origin, attitude)
    write_array(files.array, nominal)
    pose = {"array_position_m": origin, "array_rotation": rotation} if posed else {}
    write_readings(files.readings, Readings(values, **pose), nominal)
    return files


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return made(tmp_path)


def assert_recovered(files: Files, *, but_gain: bool = False, within_m: float = 2e-5) -> None:
    """Within a few standard deviations; an unknown moment leaves a common factor of the gains."""
    found, true = read_array(files.out), files.true
    np.testing.assert_allclose(found.positions, true.positions, rtol=0, atol=within_m)
    np.testing.assert_allclose(found.channel_offset_T, true.channel_offset_T, rtol=0, atol=2e-8)
    factor = np.vdot(found.channel_gain, true.channel_gain) / np.vdot(true.channel_gain, true.channel_gain)
    assert abs(factor - 1.0) < (0.1 if but_gain else 1e-3)
    np.testing.assert_allclose(found.channel_gain / factor, true.channel_gain, rtol=0, atol=2e-3)


def calibrate(run: Run, files: Files, *flags: str, **options: str | Path) -> Outcome:
    """Run the command with the files and with further options."""
    given: dict[str, str | Path] = {"array": files.array, "out": files.out, **options}
    return run("calibrate", files.readings, *(word for name in given for word in (f"--{name}", given[name])), *flags)


def calibrated(run: Run, files: Files, *flags: str, **options: str | Path) -> Outcome:
    """Run it where it must not fail."""
    outcome = calibrate(run, files, *flags, **options)
    assert outcome.status == 0, outcome.err
    return outcome


def assert_nothing_written(outcome: Outcome, files: Files, *fragments: str) -> None:
    """Refused, and no array file nor a part of one."""
    assert_refused(outcome, *fragments)
    assert {path.name for path in files.folder.iterdir()} <= {"array.toml", "readings.csv", "truth.csv"}


class TestArrayFile:
    def test_known_path(self, run: Run, files: Files) -> None:
        outcome = calibrated(run, files, truth=files.truth())
        assert_recovered(files, but_gain=True)
        assert outcome.out.splitlines()[0].split()[:2] == ["sensor", "position"]
        assert len(outcome.out.splitlines()) == 7
        assert "40 of 40 rows used" in outcome.err
        assert "not determined by the readings" in outcome.err
        assert "common gain against the moment" in outcome.err

    @pytest.mark.parametrize("posed", [False, True])
    def test_known_moment(self, run: Run, tmp_path: Path, posed: bool) -> None:
        """By an array that stands, and by one that moves."""
        files = made(tmp_path, posed=posed)
        outcome = calibrated(run, files, truth=files.truth(moment=True))
        assert_recovered(files)
        assert "not determined" not in outcome.err

    def test_self_calibration_with_trusted_sensors(self, run: Run, files: Files) -> None:
        nominal = read_array(files.array)
        trusted = ("s1", "s2", "s3")
        sensors = [
            replace(
                s,
                position_m=t.position_m if t.id in trusted else s.position_m,
                calibration=t.calibration if t.id == "s4" else s.calibration,
            )
            for s, t in zip(nominal.sensors, files.true.sensors, strict=True)
        ]
        write_array(files.array, replace(nominal, sensors=tuple(sensors)))
        options = {"trust-position": ",".join(trusted), "trust-scale": "s4"}
        assert calibrated(run, files, "--quiet", **options).err == ""
        assert_recovered(files)
        written = read_array(files.out)
        assert [s.position_m for s in written.sensors[:3]] == [s.position_m for s in files.true.sensors[:3]]
        assert written.sensors[3].calibration.scale == files.true.sensors[3].calibration.scale

    def test_a_source_that_turned(self, run: Run, tmp_path: Path) -> None:
        """With poses the readings are of one moment in the world; without them it turns in every row."""
        posed = made(tmp_path, posed=True)
        nominal = read_array(posed.array)
        write_readings(posed.readings, Readings(read_readings(posed.readings, nominal).values_T), nominal)
        truth = replace(posed, origin_m=0.0 * posed.origin_m, world_from_array=np.broadcast_to(np.eye(3), (40, 3, 3)))
        words = "If the source turned, take --moment free"
        assert words in calibrated(run, posed, truth=truth.truth()).err
        free = calibrated(run, posed, "--moment", "free", truth=truth.truth())
        assert words not in free.err
        assert_recovered(posed, but_gain=True)

    def test_rows_are_matched_by_time(self, run: Run, files: Files) -> None:
        """Rows without truth are ignored, in whatever order the truth is."""
        truth = files.truth()
        lines = truth.read_text(encoding="utf-8").splitlines()
        truth.write_text("\n".join([lines[0], *lines[6:], "1000.5,0,0,0", ""]), encoding="utf-8")
        assert json.loads(calibrated(run, files, "--json", truth=truth).out)["rows_used"] == 35
        assert_recovered(files, but_gain=True)

    def test_height(self, run: Run, files: Files) -> None:
        """A truth file without z: one unknown height for all rows, or the one that is given."""
        flat = replace(files, position_m=files.position_m * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.25])
        rng = np.random.default_rng(2)
        fields = np.stack([magpylib_field(files.true.positions, p, MOMENT) for p in flat.position_m])
        values = files.true.readings_of(fields) + NOISE_T * rng.normal(size=(40, 18))
        write_readings(files.readings, Readings(values), files.true)
        truth = flat.truth("xy")
        assert "translation along z" in calibrated(run, files, truth=truth).err
        assert "translation along z" not in calibrated(run, files, truth=truth, **{"height-m": "0.25"}).err
        assert_recovered(files, but_gain=True, within_m=2e-4)

    def test_estimate(self, run: Run, files: Files) -> None:
        calibrated(run, files, truth=files.truth(), estimate="gains, offsets")
        before, after = read_array(files.array), read_array(files.out)
        np.testing.assert_array_equal(after.positions, before.positions)
        scales = np.array([sensor.calibration.scale for sensor in after.sensors])
        np.testing.assert_array_equal(scales, scales * np.eye(3))


class TestJson:
    def test_keys(self, run: Run, files: Files) -> None:
        outcome = calibrated(run, files, "--json", truth=files.truth())
        assert outcome.err == ""
        report: dict[str, Any] = json.loads(outcome.out, parse_constant=refuse_constant)
        assert set(report) == {
            "out", "rows", "rows_used", "chi2_before", "dof_before", "chi2_after", "dof_after", "iterations",
            "converged", "moment_Am2", "sensors", "unobservable", "cross_validation",
        }  # fmt: skip
        validation = report["cross_validation"]
        assert validation["folds"] == 5
        assert validation["rows"] == 40
        assert validation["background"] is None  # common_field_nT is stated
        assert 0.0 < validation["median_m"] <= validation["p90_m"] <= validation["worst_m"] < 1e-3
        assert report["converged"] is True
        assert report["chi2_before"] > 100 * report["dof_before"]
        # χ² of 40 rows of 18 readings less what is estimated: its mean ± five standard deviations.
        assert abs(report["chi2_after"] - report["dof_after"]) < 5 * np.sqrt(2 * report["dof_after"])
        assert [u["name"] for u in report["unobservable"]] == ["common gain against the moment"]
        written = read_array(files.out)
        for sensor, entry in zip(written.sensors, report["sensors"], strict=True):
            assert set(entry) == {
                "id", "position_m", "position_sd_m", "scale", "gain_sd", "axes_sd_rad", "offset_nT", "offset_sd_nT",
                "residual_rms_nT",
            }  # fmt: skip
            np.testing.assert_allclose(entry["position_m"], sensor.position_m, rtol=0, atol=1e-12)
            np.testing.assert_allclose(entry["scale"], sensor.calibration.scale, rtol=1e-9)
            assert 0.5 < entry["residual_rms_nT"] < 1.5


class TestRefusals:
    @pytest.mark.parametrize(
        ("option", "value", "message"),
        [
            ("trust-position", "s1,s7", "--trust-position: found 's7', expected ids of sensors in"),
            ("trust-scale", "s0", "--trust-scale: found 's0'"),
            ("estimate", "positions,colour", "--estimate: found 'colour', expected some of positions, gains, axes"),
            ("estimate", "", "--estimate: found ''"),
            ("gain-prior", "0", "--gain-prior: found 0, expected a positive number"),
            ("position-prior-mm", "-1", "--position-prior-mm: found -1"),
            ("height-m", "0.1", "--height-m: found no --truth"),
            ("moment", "turning", "turning"),
        ],
    )
    def test_options(self, run: Run, files: Files, option: str, value: str, message: str) -> None:
        assert_nothing_written(calibrate(run, files, **{option: value}), files, message)

    def test_height_twice(self, run: Run, files: Files) -> None:
        truth = files.truth()
        outcome = calibrate(run, files, truth=truth, **{"height-m": "0.1"})
        assert_nothing_written(outcome, files, "--height-m: found z_m in", "expected a truth file without it")

    def test_times_that_do_not_match(self, run: Run, files: Files) -> None:
        truth = files.truth(shift_s=0.5)
        outcome = calibrate(run, files, truth=truth)
        assert_nothing_written(outcome, files, "truth.csv: found none of the times of", "0 s to 39 s")

    @pytest.mark.parametrize("with_truth", [False, True])
    def test_too_few_rows(self, run: Run, tmp_path: Path, with_truth: bool) -> None:
        files = made(tmp_path, n=4)
        extra = {"truth": files.truth()} if with_truth else {}
        assert_nothing_written(calibrate(run, files, **extra), files, "readings.csv", "more readings than unknowns")

    def test_no_folder(self, run: Run, files: Files) -> None:
        outcome = calibrate(run, files, out=files.folder / "nowhere" / "out.toml")
        assert_nothing_written(outcome, files, "nowhere", "found no folder")

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_folder_that_cannot_be_written(self, run: Run, files: Files) -> None:
        files.folder.chmod(0o500)
        try:
            outcome = calibrate(run, files)
        finally:
            files.folder.chmod(0o700)
        assert_nothing_written(outcome, files, "out.toml: Permission denied")

    def test_out_is_a_folder(self, run: Run, files: Files, tmp_path_factory: pytest.TempPathFactory) -> None:
        folder = tmp_path_factory.mktemp("taken")
        assert_nothing_written(calibrate(run, files, truth=files.truth(), out=folder), files, f"{folder}: ")
        assert list(folder.iterdir()) == []

    def test_scalar_sensors(self, run: Run, files: Files) -> None:
        sensors = [Sensor(f"s{i}", "scalar", (float(i), 0.0, 0.0), 1e-9) for i in range(3)]
        array = SensorArray(tuple(sensors))
        write_array(files.array, array)
        write_readings(files.readings, Readings(np.ones((4, 3))), array)
        assert_nothing_written(calibrate(run, files), files, "must have vector sensors only")

    def test_what_does_not_converge_is_not_written(
        self, run: Run, files: Files, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        honest = calibration.self_calibrate
        monkeypatch.setattr(
            calibration, "self_calibrate", lambda *args, **options: replace(honest(*args, **options), converged=False)
        )
        assert_nothing_written(
            calibrate(run, files), files, "the calibration did not converge within", "is not written"
        )


class TestTurnedInAKnownModulus:
    """--modulus-nT: no source, a sensor turned by hand in a uniform field."""

    SCALE = np.array([[1.05, 0.02, -0.01], [0.0, 0.97, 0.03], [0.0, 0.0, 1.01]])
    OFFSET_T = np.array([300e-9, -150e-9, 80e-9])

    @staticmethod
    def directions(n: int) -> np.ndarray:
        directions = np.random.default_rng(1).normal(size=(n, 3))
        return directions / np.linalg.norm(directions, axis=1, keepdims=True)

    def write(self, folder: Path, directions: np.ndarray) -> tuple[str, ...]:
        (folder / "one.toml").write_text(
            '[[sensor]]\nid = "m"\nkind = "vector"\nposition_m = [0.0, 0.0, 0.0]\nnoise_nT = 5.0\n', encoding="utf-8"
        )
        noise = 5e-9 * np.random.default_rng(3).normal(size=(len(directions), 3))
        values_nT = 1e9 * (48e-6 * directions @ self.SCALE.T + self.OFFSET_T + noise)
        rows = [",".join(map(repr, [float(i), *row])) for i, row in enumerate(values_nT.tolist())]
        (folder / "turned.csv").write_text("\n".join(["time_s,m_x_nT,m_y_nT,m_z_nT", *rows, ""]), encoding="utf-8")
        return (
            "calibrate", str(folder / "turned.csv"), "--array", str(folder / "one.toml"), "--out",
            str(folder / "out.toml"), "--modulus-nT", "48000",
        )  # fmt: skip

    def test_single_sensor(self, run: Run, tmp_path: Path) -> None:
        outcome = run(*self.write(tmp_path, self.directions(400)), "--json")
        assert outcome.status == 0, outcome.err
        (sensor,) = read_sensors(tmp_path / "out.toml").sensors
        np.testing.assert_allclose(sensor.calibration.offset_T, self.OFFSET_T, atol=3e-9)
        scale = np.array(sensor.calibration.scale)
        # The modulus tells S Sᵀ, not the rotation between S and the field.
        np.testing.assert_allclose(scale @ scale.T, self.SCALE @ self.SCALE.T, atol=2e-4)
        (entry,) = json.loads(outcome.out)["sensors"]
        assert entry["converged"]
        assert entry["dof"] == 400 - 9

    def changing(self, folder: Path) -> tuple[tuple[str, ...], np.ndarray]:
        """A record in a field that changes, and its modulus."""
        modulus = 48e3 + 300.0 * np.sin(np.arange(400) / 40.0)
        return self.write(folder, self.directions(400) * modulus[:, None] / 48e3), modulus

    def test_modulus_through_time(self, run: Run, tmp_path: Path) -> None:
        command, modulus = self.changing(tmp_path)
        rows = [f"{time},{value}" for time, value in enumerate(modulus)]
        (tmp_path / "base.csv").write_text("\n".join(["time_s,modulus_nT", *rows, ""]), encoding="utf-8")
        outcome = run(*command[:-1], str(tmp_path / "base.csv"), "--json")
        assert outcome.status == 0, outcome.err
        (sensor,) = read_sensors(tmp_path / "out.toml").sensors
        np.testing.assert_allclose(sensor.calibration.offset_T, self.OFFSET_T, atol=3e-9)
        assert not json.loads(outcome.out)["sensors"][0]["misfit"]

    def test_modulus_that_is_not_constant_is_warned_of(self, run: Run, tmp_path: Path) -> None:
        outcome = run(*self.changing(tmp_path)[0])
        assert outcome.status == 0
        assert "warning: sensor m does not fit" in outcome.err

    @pytest.mark.parametrize(
        ("lines", "word"),
        [
            ("time_s,modulus_nT\n0,48000\n10,48000\n", "for all readings"),
            ("time_s,modulus_nT\n0,48000\n0,48000\n", "time_s"),
            ("time_s,modulus_nT\n0,48000\n500,-1\n", "positive"),
            ("time_s,modulus_nT\n0,48000\n500,\n", "modulus_nT"),
            ("time_s,b_nT\n0,48000\n", "modulus_nT"),
        ],
    )
    def test_bad_moduli(self, lines: str, word: str, run: Run, tmp_path: Path) -> None:
        command, _ = self.changing(tmp_path)
        (tmp_path / "base.csv").write_text(lines, encoding="utf-8")
        assert_refused(run(*command[:-1], str(tmp_path / "base.csv")), "base.csv", word)
        assert not (tmp_path / "out.toml").exists()

    def test_turned_about_one_axis_only(self, run: Run, tmp_path: Path) -> None:
        angle = np.linspace(0.0, 6.0, 100)
        directions = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        assert_refused(run(*self.write(tmp_path, directions)), "turned.csv", "sensor m", "not written")
        assert not (tmp_path / "out.toml").exists()

    def test_modulus_in_another_unit(self, run: Run, tmp_path: Path) -> None:
        command = self.write(tmp_path, self.directions(100))
        assert_refused(run(*command[:-1], "48"), "--modulus-nT", "in nT", "not written")
        assert not (tmp_path / "out.toml").exists()

    def test_options_of_the_other_calibration(self, run: Run, tmp_path: Path) -> None:
        assert_refused(run(*self.write(tmp_path, np.eye(3)), "--height-m", "3"), "--modulus-nT")
        assert_refused(run(*self.write(tmp_path, np.eye(3)), "--estimate", "gains"), "--modulus-nT")

    def test_bad_modulus(self, run: Run, tmp_path: Path) -> None:
        command = self.write(tmp_path, np.eye(3))
        assert_refused(run(*command[:-1], "-5"), "--modulus-nT")
        assert_refused(run(*command, "--truth", tmp_path / "truth.csv"), "--modulus-nT", "--truth")

    def test_other_commands_need_two_sensors(self, run: Run, tmp_path: Path) -> None:
        self.write(tmp_path, np.eye(3))
        outcome = run("locate", tmp_path / "turned.csv", "--array", tmp_path / "one.toml")
        assert_refused(outcome, "one.toml", "at least 2")
