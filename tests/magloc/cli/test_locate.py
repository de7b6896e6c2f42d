"""The command line: what ``magloc locate`` prints, and how every command refuses bad input."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from magloc.truth import read_truth
from tests.command_line import Outcome, Run, assert_refused, refuse_constant, results_of
from tests.oracles import magpylib_field

FloatArray = NDArray[np.float64]
NOISE_nT = 1.0
SENSORS = np.array([[0.9, 0.0, -0.3], [-0.4, 0.8, -0.3], [-0.4, -0.8, -0.3], [0.0, 0.0, 0.9], [0.3, 0.5, 0.6]])
SOURCE = np.array([2.0, 1.0, 0.5])
MOMENT = np.array([60.0, 50.0, 60.0])
COLUMNS = [f"s{i}_{axis}_nT" for i in range(1, len(SENSORS) + 1) for axis in "xyz"]
HEADER = ",".join(["time_s", *COLUMNS])


def run_process(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "magloc.cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, **options)


def array_text(kind: str = "vector", noise_nT: float = NOISE_nT) -> str:
    sensors = (
        f'[[sensor]]\nid = "s{i}"\nkind = "{kind}"\nposition_m = {position.tolist()}\nnoise_nT = {noise_nT}\n'
        for i, position in enumerate(SENSORS, start=1)
    )
    return "\n".join(['name = "five"', *sensors])


def fields_nT(source: FloatArray = SOURCE, moment: FloatArray = MOMENT) -> FloatArray:
    """Noise-free readings in channel order, by magpylib."""
    return magpylib_field(SENSORS, source, moment).ravel() * 1e9


def table(rows: Sequence[FloatArray], header: str = HEADER) -> str:
    """A readings file with the times 0, 1, 2, …; NaN becomes an empty cell."""
    lines = (
        ",".join([str(time), *("" if np.isnan(value) else repr(float(value)) for value in row)])
        for time, row in enumerate(rows)
    )
    return "\n".join([header, *lines, ""])


@pytest.fixture
def array(tmp_path: Path) -> Path:
    path = tmp_path / "array.toml"
    path.write_text(array_text(), encoding="utf-8")
    return path


@pytest.fixture
def readings(tmp_path: Path) -> Path:
    """Three rows: the source, the source with a sensor's reading missing, and too little to solve."""
    path = tmp_path / "readings.csv"
    rows = np.tile(fields_nT(), (3, 1))
    rows[1, 3:5] = np.nan
    rows[2, 5:] = np.nan
    path.write_text(table(list(rows)), encoding="utf-8")
    return path


class TestJson:
    """One object, one entry for every row in order, every number valid JSON."""

    def test_entries(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("locate", readings, "--array", array, "--json", "--body-length-m", 0)
        results = results_of(outcome)
        assert outcome.err == ""
        assert [entry["time_s"] for entry in results] == [0.0, 1.0, 2.0]
        assert [set(entry) for entry in results[:2]] == [{"time_s", "detected", "solutions"}] * 2
        assert set(results[2]) == {"time_s", "detected", "solutions", "reason"}
        assert [entry["detected"] for entry in results] == [True, True, False]
        assert results[2]["solutions"] == []
        assert results[2]["reason"]

    def test_solution(self, run: Run, array: Path, readings: Path) -> None:
        full, gaps, _ = results_of(run("locate", readings, "--array", array, "--json"))
        for entry, dof in ((full, 15 - 3 - 6), (gaps, 13 - 3 - 6)):
            solution = entry["solutions"][0]
            assert set(solution) == {
                "position_m",
                "moment_Am2",
                "covariance",
                "chi2",
                "dof",
                "iterations",
                "converged",
                "range_observable",
                "range_interval95_m",
                "gaussian",
                "weight",
            }
            np.testing.assert_allclose(solution["position_m"], SOURCE, rtol=1e-5)
            np.testing.assert_allclose(solution["moment_Am2"], MOMENT, rtol=1e-4)
            covariance = np.array(solution["covariance"])
            assert covariance.shape == (6, 6)
            assert np.linalg.eigvalsh(covariance / np.outer(*[np.sqrt(np.diag(covariance))] * 2)).min() > 0.0
            assert solution["dof"] == dof
            assert 0.0 <= solution["chi2"] < 1e-3
            assert isinstance(solution["iterations"], int)
            assert solution["converged"] is True
            assert solution["range_observable"] is True
            ((low, high),) = solution["range_interval95_m"]
            assert low < np.linalg.norm(SOURCE - SENSORS.mean(axis=0)) < high

    def test_weak_signal(self, run: Run, array: Path, tmp_path: Path) -> None:
        """Several solutions fit almost alike and nothing bounds the range: all are ranked, an open end is null."""
        path = tmp_path / "weak.csv"
        path.write_text(table([fields_nT(5.0 * SOURCE)]), encoding="utf-8")
        (entry,) = results_of(run("locate", path, "--array", array, "--json"))
        chi2 = [solution["chi2"] for solution in entry["solutions"]]
        assert len(chi2) > 1
        assert chi2 == sorted(chi2)
        assert entry["solutions"][0]["range_observable"] is False
        assert entry["solutions"][0]["range_interval95_m"][-1][1] is None

    def test_noise_alone(self, run: Run, array: Path, tmp_path: Path) -> None:
        """Nothing is detected: every range is possible, and so say JSON, table and a note."""
        path = tmp_path / "noise.csv"
        noise = np.random.default_rng(1).normal(size=(3, 15))
        path.write_text(table(list(noise)), encoding="utf-8")
        for entry in results_of(run("locate", path, "--array", array, "--json", "--quiet")):
            assert entry["detected"] is False
            assert sum(solution["weight"] for solution in entry["solutions"]) == pytest.approx(1.0)
            for solution in entry["solutions"]:
                assert solution["range_interval95_m"] == [[0.0, None]]
                assert solution["range_observable"] is False
                assert solution["gaussian"] is False
        outcome = run("locate", path, "--array", array)
        assert all("weak" in line for line in outcome.out.splitlines()[1:])
        assert "in 3 of 3 rows nothing stands out of the noise" in outcome.err


class TestTable:
    """A line for every row, aligned, not wider than 100 characters."""

    def test_lines(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("locate", readings, "--array", array)
        assert outcome.status == 0
        header, *lines = outcome.out.splitlines()
        assert header.split()[:4] == ["time_s", "x_m", "y_m", "z_m"]
        assert len(lines) == 3
        assert [float(cell) for cell in lines[0].split()[:4]] == [0.0, 2.0, 1.0, 0.5]
        assert len(lines[0].split("/")[0]) == len(lines[1].split("/")[0])
        assert "not solved" in lines[2]
        assert max(map(len, [header, *lines])) <= 100

    def test_small_scale_in_millimetres(self, run: Run, tmp_path: Path) -> None:
        array, path = tmp_path / "small.toml", tmp_path / "small.csv"
        scale = 0.01
        sensors = (
            f'[[sensor]]\nid = "s{i}"\nkind = "vector"\nposition_m = {(scale * position).tolist()}\nnoise_nT = 1.0\n'
            for i, position in enumerate(SENSORS, start=1)
        )
        array.write_text("\n".join(sensors), encoding="utf-8")
        path.write_text(table([fields_nT()]), encoding="utf-8")  # a moment smaller by scale³ gives the same field
        outcome = run("locate", path, "--array", array)
        header, line = outcome.out.splitlines()
        assert header.split()[:4] == ["time_s", "x_mm", "y_mm", "z_mm"]
        assert [float(cell) for cell in line.split()[:4]] == [0.0, 20.0, 10.0, 5.0]

    def test_summary(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("locate", readings, "--array", array, "--body-length-m", 0)
        assert outcome.err.startswith("magloc: 2 of 3 rows solved; not solved: 1 row: ")
        assert len(outcome.err.splitlines()) == 1

    def test_what_a_body_would_do(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("locate", readings, "--array", array, "--json")
        factor = results_of(outcome)[0]["body_factor"]
        assert (
            "note: in 2 of 3 rows the source counts as a point: for a body as long as a quarter of its distance"
            in outcome.err
        )
        assert factor > 1.5

    def test_quiet(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("locate", readings, "--array", array, "--quiet")
        assert outcome.status == 0
        assert outcome.err == ""


class TestOptions:
    """Subsets, averages and moving arrays."""

    def test_sensors(self, run: Run, array: Path, readings: Path) -> None:
        (entry, *_) = results_of(run("locate", readings, "--array", array, "--sensors", "s1, s2,s4,s5", "--json"))
        assert entry["solutions"][0]["dof"] == 12 - 3 - 6
        np.testing.assert_allclose(entry["solutions"][0]["position_m"], SOURCE, rtol=1e-4)

    def test_average(self, run: Run, array: Path, tmp_path: Path) -> None:
        """Of rows that scatter symmetrically around the truth; the covariance is that of a mean of four."""
        path = tmp_path / "scattered.csv"
        scatter = np.linspace(-300.0, 300.0, 15)
        rows = [fields_nT() + sign * scatter for sign in (1.0, -1.0, 1.0, -1.0)]
        path.write_text(table(rows), encoding="utf-8")
        (mean,) = results_of(run("locate", path, "--array", array, "--average", "--json"))
        path.write_text(table([fields_nT()]), encoding="utf-8")
        (single,) = results_of(run("locate", path, "--array", array, "--json"))
        assert mean["time_s"] == 1.5
        np.testing.assert_allclose(mean["solutions"][0]["position_m"], SOURCE, rtol=1e-5)
        np.testing.assert_allclose(
            np.array(mean["solutions"][0]["covariance"]) * 4.0, single["solutions"][0]["covariance"], rtol=1e-4
        )

    def test_pose_gives_world_frame(self, run: Run, array: Path, tmp_path: Path) -> None:
        """A source that rests in the world, seen by an array that moves and turns."""
        header = f"{HEADER},array_x_m,array_y_m,array_z_m,array_qx,array_qy,array_qz,array_qw"
        source, moment = np.array([12.0, -7.0, 3.0]), MOMENT
        rows = []
        for angle in (0.3, 1.9):
            world_from_array = Rotation.from_rotvec([0.2, -angle, 2.0 * angle])
            origin = source - world_from_array.apply(SOURCE + angle * 0.2)
            seen = world_from_array.inv().apply([source - origin, moment])
            rows.append(np.concatenate([fields_nT(*seen), origin, world_from_array.as_quat()]))
        path = tmp_path / "moving.csv"
        path.write_text(table(rows, header), encoding="utf-8")
        results = results_of(run("locate", path, "--array", array, "--json"))
        for entry in results:
            np.testing.assert_allclose(entry["solutions"][0]["position_m"], source, rtol=1e-5)
            np.testing.assert_allclose(entry["solutions"][0]["moment_Am2"], moment, rtol=1e-4)
        assert_refused(run("locate", path, "--array", array, "--average"), "moving.csv", "lines 2 and 3")

    def test_covariance_turns_with_the_pose(self, run: Run, array: Path, tmp_path: Path) -> None:
        path = tmp_path / "turned.csv"
        path.write_text(table([fields_nT()]), encoding="utf-8")
        (plain,) = results_of(run("locate", path, "--array", array, "--json"))
        header = f"{HEADER},array_x_m,array_y_m,array_z_m,array_qx,array_qy,array_qz,array_qw"
        turn = Rotation.from_rotvec([0.5, -1.0, 0.7])
        path.write_text(
            table([np.concatenate([fields_nT(), [1.0, 2.0, 3.0], turn.as_quat()])], header), encoding="utf-8"
        )
        (turned,) = results_of(run("locate", path, "--array", array, "--json"))
        R = np.kron(np.eye(2), turn.as_matrix())
        expected = R @ np.array(plain["solutions"][0]["covariance"]) @ R.T
        scale = np.sqrt(np.diag(expected))
        np.testing.assert_allclose(
            np.array(turned["solutions"][0]["covariance"]) / np.outer(scale, scale),
            expected / np.outer(scale, scale),
            atol=1e-9,
        )


class TestBadInput:
    """Exit status 2, one line that names file and place, never a traceback."""

    @pytest.mark.parametrize(
        ("content", "fragments"),
        [
            ("", ["readings.csv", "empty"]),
            (f"{HEADER}\n", ["readings.csv", "line 1", "without rows"]),
            (table([fields_nT()]) + "x" + ",1" * 15, ["readings.csv", "line 3", "time_s", "'x'"]),
        ],
        ids=["empty", "no rows", "text"],
    )
    def test_readings(self, run: Run, array: Path, readings: Path, content: str, fragments: list[str]) -> None:
        readings.write_text(content, encoding="utf-8")
        assert_refused(run("locate", readings, "--array", array), *fragments)
        assert_refused(run("locate", readings, "--array", array, "--json", "--quiet"), *fragments)

    def test_missing_readings(self, run: Run, array: Path, tmp_path: Path) -> None:
        assert_refused(run("locate", tmp_path / "none.csv", "--array", array), "none.csv", "does not exist")
        assert_refused(run("locate", tmp_path, "--array", array), tmp_path.name, "is a directory")

    @pytest.mark.parametrize("content", ["", "name = ", 'geometry = "tetrahedron"\nedge_m = "wide"', "\x00\xff"])
    def test_array(self, run: Run, array: Path, readings: Path, content: str) -> None:
        array.write_bytes(content.encode("latin-1"))
        assert_refused(run("locate", readings, "--array", array), "array.toml")

    def test_missing_array(self, run: Run, readings: Path, tmp_path: Path) -> None:
        assert_refused(run("locate", readings, "--array", tmp_path / "none.toml"), "none.toml")
        assert_refused(run("locate", readings, "--array", tmp_path), tmp_path.name)

    def test_scalar_sensors(self, run: Run, array: Path, readings: Path) -> None:
        array.write_text(array_text("scalar"), encoding="utf-8")
        assert_refused(run("locate", readings, "--array", array), "readings.csv", "scalar", "s1")

    @pytest.mark.parametrize(
        ("ids", "fragment"), [("s1,s7,s2", "'s7'"), ("", "''"), ("s1,,s2", "''"), ("s1", "s1"), ("s1,s1,s2", "s1")]
    )
    def test_sensors(self, run: Run, array: Path, readings: Path, ids: str, fragment: str) -> None:
        assert_refused(run("locate", readings, "--array", array, "--sensors", ids), "--sensors", fragment)

    @pytest.mark.parametrize(
        ("arguments", "fragment"),
        [
            (["locate"], "READINGS"),
            (["locate", "readings.csv"], "--array"),
            (["locate", "readings.csv", "--array"], "--array"),
            (["locate", "readings.csv", "--array", "a.toml", "--sauces", "2"], "--sauces"),
            (["locate", "readings.csv", "more.csv", "--array", "a.toml"], "more.csv"),
            (["locate", "readings.csv", "--array", "a.toml", "--threads", "0"], "--threads"),
            (["locate", "readings.csv", "--array", "a.toml", "--threads", "-3"], "--threads"),
            (["locate", "readings.csv", "--array", "a.toml", "--threads", "two"], "--threads"),
            (["locate", "readings.csv", "--array", "a.toml", "--threads", "1.5"], "--threads"),
            (["locate", "readings.csv", "--array", "a.toml", "--seed", "-1"], "--seed"),
            (["locate", "readings.csv", "--array", "a.toml", "--seed", "1.5"], "--seed"),
            (["dislocate"], "dislocate"),
            (["--sauces"], "--sauces"),
        ],
    )
    def test_usage(self, run: Run, arguments: list[str], fragment: str) -> None:
        outcome = run(*arguments)
        assert_refused(outcome, fragment)
        assert outcome.out == ""

    @pytest.mark.parametrize("number", ["2", "0"])
    def test_an_array_that_can_tell_one_source_only(self, run: Run, array: Path, readings: Path, number: str) -> None:
        """Four sensors: nine differences, of which two sources would leave none to judge them by."""
        outcome = run("locate", readings, "--array", array, "--sensors", "s1,s2,s3,s4", "--sources", number)
        assert_refused(outcome, f"--sources {number}: ", "must be 1: 9 independent differences", "determine no more")
        assert "between" not in outcome.err

    @pytest.mark.parametrize("far", ["1e300", "-1e300", "1.1e6", "inf"])
    def test_a_place_that_is_out_of_reach(self, run: Run, array: Path, readings: Path, far: str) -> None:
        outcome = run("locate", readings, "--array", array, "--position", "0", far, "0")
        assert_refused(outcome, "--position: found a place", "from the array", "within 1e+06 m")

    def test_a_place_counts_from_an_array_that_is_far_from_the_origin(
        self, run: Run, array: Path, tmp_path: Path
    ) -> None:
        header = f"{HEADER},array_x_m,array_y_m,array_z_m,array_qx,array_qy,array_qz,array_qw"
        origin = np.array([0.0, 5.4e6, 0.0])  # a northing
        path = tmp_path / "north.csv"
        path.write_text(table([np.concatenate([fields_nT(), origin, [0.0, 0.0, 0.0, 1.0]])], header), encoding="utf-8")
        command = ("locate", path, "--array", array, "--json", "--position")
        (entry,) = results_of(run(*command, *map(str, origin + SOURCE)))
        np.testing.assert_allclose(entry["solutions"][0]["moment_Am2"], MOMENT, rtol=1e-4)
        assert_refused(run(*command, *map(str, SOURCE)), "--position: found a place 5.4e+06 m from the array")

    def test_a_folder_that_cannot_be_written(self, run: Run, array: Path, tmp_path: Path) -> None:
        """Found before the readings are looked for."""
        outcome = run("locate", tmp_path / "absent.csv", "--array", array, "--out", "/proc/x")
        assert_refused(outcome, "--out /proc/x", "no file can be made in /proc")

    def test_no_row_solvable(self, run: Run, array: Path, readings: Path) -> None:
        rows = np.tile(fields_nT(), (2, 1))
        rows[:, 6:] = np.nan
        readings.write_text(table(list(rows)), encoding="utf-8")
        outcome = run("locate", readings, "--array", array)
        assert_refused(outcome, "readings.csv", "no row", "2 rows: ")
        outcome = run("locate", readings, "--array", array, "--json")
        assert_refused(outcome, "readings.csv", "no row", "2 rows: ")
        results = json.loads(outcome.out, parse_constant=refuse_constant)["results"]
        assert [entry["solutions"] for entry in results] == [[], []]
        assert all(entry["reason"] for entry in results)


class TestProcess:
    """The same from a shell."""

    def test_help(self) -> None:
        of_all, of_locate, of_none = (run_process(*arguments) for arguments in (["--help"], ["locate", "--help"], []))
        for done in (of_all, of_locate, of_none):
            assert done.returncode == 0
            assert done.stderr == ""
        assert "locate" in of_all.stdout
        for option in ("READINGS", "--array", "--sensors", "--average", "--json", "--seed", "--threads", "--quiet"):
            assert option in of_locate.stdout

    def test_version(self) -> None:
        done = run_process("--version")
        assert done.returncode == 0
        assert len(done.stdout.splitlines()) == 1

    def test_bad_input(self, array: Path, tmp_path: Path) -> None:
        done = run_process("locate", tmp_path / "none.csv", "--array", array)
        assert_refused(Outcome(done.returncode, done.stdout, done.stderr), "none.csv")
        assert done.stdout == ""

    @pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX")
    def test_reader_of_the_output_is_gone(self, array: Path, readings: Path) -> None:
        command: list[str | Path] = [
            sys.executable,
            "-m",
            "magloc.cli",
            "locate",
            readings,
            "--array",
            array,
            "--quiet",
        ]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            process.stdout.close()
            assert process.stderr.read() == ""
            assert process.wait(timeout=120) == 128 + signal.SIGPIPE

    def test_interrupted(self, run: Run, array: Path, readings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def interrupt(*_: object, **__: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("magloc.localization.locator.Locator.fit_rows", interrupt)
        outcome = run("locate", readings, "--array", array)
        assert outcome.status == 130
        assert outcome.err == "magloc: interrupted\n"


class TestRecording:
    """30 magnetometers under a magnet that a robot moves, with the arm's commanded positions as truth."""

    def test_positions(self, run: Run, data_folder: Path) -> None:
        folder = data_folder / "magnet-array"
        if not folder.is_dir():
            pytest.skip("needs the recording magnet-array")
        outcome = run("locate", folder / "readings.csv", "--array", folder / "array.toml", "--json")
        results = results_of(outcome)
        truth = read_truth(folder / "truth.csv")
        assert [entry["time_s"] for entry in results] == truth.time_s.tolist()
        best = np.array([entry["solutions"][0]["position_m"] for entry in results])
        error_m = np.linalg.norm(best[:, :2] - truth.position_m[:, :2], axis=1)
        assert np.median(error_m) <= 0.6e-3
        assert np.mean(error_m > 5e-3) <= 0.005


class TestKnowledge:
    def test_region_and_largest_moment_rule_solutions_out(self, run: Run, array: Path, readings: Path) -> None:
        inside = results_of(run("locate", readings, "--array", array, "--region", "-3<y<3, x>0", "--json"))
        assert np.allclose(inside[0]["solutions"][0]["position_m"], SOURCE, atol=1e-3)
        for option, value in (("--region", "x<-1"), ("--max-moment-Am2", "1e-6")):
            outcome = run("locate", readings, "--array", array, option, value)
            assert outcome.status == 2
            assert "no solution lies within the known region and largest moment" in outcome.err

    @pytest.mark.parametrize(
        ("option", "value", "fragment"),
        [
            ("--region", "q>1", "found 'q>1'"),
            ("--region", "z>1,z<0", "room along z"),
            ("--region", "x>1e9", "excludes all of them"),
            ("--region", "z>a", "found 'z>a'"),
            ("--max-moment-Am2", "-1", "expected a positive number"),
            ("--max-moment-Am2", "nan", "expected a positive number"),
        ],
    )
    def test_refused(self, run: Run, array: Path, readings: Path, option: str, value: str, fragment: str) -> None:
        assert_refused(run("locate", readings, "--array", array, option, value), option, fragment)
