"""The command line: what ``magloc track`` prints and writes, its stream, and how it refuses bad input."""

from __future__ import annotations

import csv
import io
import json
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pymap3d
import pytest
from numpy.typing import NDArray

from arrays import geometries
from arrays.array_file import read_array
from magloc.readings import Readings, read_readings
from magloc.tracking.motion import OrnsteinUhlenbeck, RandomWalk
from magloc.tracking.rows import rows_of
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from magloc.tracking.whole_records.smoother import smooth_points
from magloc.truth import Truth, truth_of_rows
from tests.command_line import Outcome, Run, assert_refused, refuse_constant, results_of
from tests.oracles import magpylib_field
from tests.passing_source import followed

FloatArray = NDArray[np.float64]
SENSORS = geometries.tetrahedron(1.5).positions
HEADER = ",".join(["time_s", *(f"s{i}_{axis}_nT" for i in range(1, 5) for axis in "xyz")])
NOISE_NT = 0.2
N_ROWS = 24
N_EMPTY = 3
KEYS = {"time_s", "position_m", "moment_Am2", "covariance", "estimability", "iterations", "nis"}
MOTION = ("--speed-m-s", 0.1, "--turn-deg-s", 1.2)


def array_text(kind: str = "vector") -> str:
    sensors = (
        f'[[sensor]]\nid = "s{i}"\nkind = "{kind}"\nposition_m = {position.tolist()}\nnoise_nT = {NOISE_NT}\n'
        for i, position in enumerate(SENSORS, start=1)
    )
    return "\n".join(['name = "four"', *sensors])


def source(n: int = N_ROWS) -> tuple[FloatArray, FloatArray, FloatArray]:
    t = np.arange(n, dtype=np.float64) * 0.5
    return t, np.array([3.0, 1.5, 0.8]) + np.outer(t, [-0.08, 0.02, 0.0]), np.tile([120.0, -150.0, 160.0], (n, 1))


def row_texts(n: int = N_ROWS) -> list[str]:
    """Rows of a readings file by magpylib; in the first three the source is too far away to be found."""
    rng = np.random.default_rng(6)
    texts = []
    for i, (time, p, m) in enumerate(zip(*source(n), strict=True)):
        fields = magpylib_field(SENSORS, p if i >= N_EMPTY else 100.0 * p, m).ravel() * 1e9
        values = fields + NOISE_NT * rng.normal(size=12)
        texts.append(",".join([repr(float(time)), *(repr(float(value)) for value in values)]))
    return texts


def write(path: Path, lines: Sequence[str]) -> Path:
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")
    return path


@pytest.fixture
def array(tmp_path: Path) -> Path:
    return write(tmp_path / "array.toml", [array_text()])


@pytest.fixture
def readings(tmp_path: Path) -> Path:
    return write(tmp_path / "readings.csv", [HEADER, *row_texts()])


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    names = "time_s,x_m,y_m,z_m,mx_Am2,my_Am2,mz_Am2"
    lines = (",".join(map(repr, [float(t), *map(float, p), *map(float, m)])) for t, p, m in zip(*source(), strict=True))
    return write(tmp_path / "truth.csv", [names, *lines])


def lines_of(outcome: Outcome) -> list[dict[str, Any]]:
    assert outcome.status == 0, outcome.err
    return [json.loads(line, parse_constant=refuse_constant) for line in outcome.out.splitlines()]


class TestJson:
    """One object, one entry for every row in order; null where the source is not acquired."""

    def test_entries(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("track", readings, "--array", array, "--json", *MOTION)
        results = results_of(outcome)
        assert [entry["time_s"] for entry in results] == [0.5 * i for i in range(N_ROWS)]
        for entry in results:
            assert set(entry) >= KEYS
        for entry in results[:N_EMPTY]:
            assert all(entry[key] is None for key in KEYS - {"time_s"})
            assert entry["status"].startswith("not acquired: ")
        for entry, p in zip(results[N_EMPTY:], source()[1][N_EMPTY:], strict=True):
            assert np.linalg.norm(np.array(entry["position_m"]) - p) < 0.3
            assert np.shape(entry["moment_Am2"]) == (3,)
            covariance = np.array(entry["covariance"])
            assert covariance.shape == (6, 6)
            deviation = np.sqrt(np.diagonal(covariance))
            assert np.linalg.eigvalsh(covariance / np.outer(deviation, deviation)).min() > 0.0
            assert len(entry["estimability"]) == 6
            assert all(0.0 <= value <= 1.0 for value in entry["estimability"])
            assert isinstance(entry["iterations"], int)
        assert results[N_EMPTY]["nis"] is None  # the track started from this row: nothing was predicted
        assert all(entry["nis"] > 0.0 for entry in results[N_EMPTY + 1 :])

    def test_what_is_known_of_the_range(self, run: Run, array: Path, readings: Path) -> None:
        """Of a track by its covariance; without one by the row alone, whose solutions are listed."""
        results = results_of(run("track", readings, "--array", array, "--json", *MOTION))
        for entry in results[:N_EMPTY]:
            assert entry["range_observable"] is False
            assert entry["range_interval95_m"][-1][1] is None
            assert entry["weight"] is None
            assert sum(rival["weight"] for rival in entry["rivals"]) == pytest.approx(1.0 if entry["rivals"] else 0.0)
        for entry, p in zip(results[N_EMPTY:], source()[1][N_EMPTY:], strict=True):
            ((low, high),) = entry["range_interval95_m"]
            assert 0.9 * low < np.linalg.norm(p) < 1.1 * high
            assert entry["range_observable"] is True
            assert 0.9 < entry["weight"] <= 1.0
            assert isinstance(entry["gaussian"], bool)

    def test_covariance_is_of_six_numbers_for_a_larger_state(self, run: Run, array: Path, readings: Path) -> None:
        for motion in ("wandering", "turn"):
            results = results_of(run("track", readings, "--array", array, "--json", *MOTION, "--motion", motion))
            assert np.shape(results[-1]["covariance"]) == (6, 6)
            assert len(results[-1]["estimability"]) == 6

    def test_are_the_librarys(self, run: Run, array: Path, readings: Path) -> None:
        results = results_of(run("track", readings, "--array", array, "--json", *MOTION))
        tracker = Tracker(read_array(array), RandomWalk(0.1, float(np.deg2rad(1.2))))
        table = read_readings(readings, tracker.array)
        points = followed(tracker, list(rows_of(table)))
        for entry, point in zip(results, points, strict=True):
            expected = None if point.position_m is None else point.position_m.tolist()
            assert entry["position_m"] == expected

    def test_default_motion(self, run: Run, array: Path, readings: Path) -> None:
        """0.5 m/s and 5 degrees a second, wider than it has to be here."""
        by_default = results_of(run("track", readings, "--array", array, "--json"))
        named = results_of(
            run(
                "track",
                readings,
                "--array",
                array,
                "--json",
                "--speed-m-s",
                0.5,
                "--turn-deg-s",
                5,
                "--motion",
                "unknown",
            )
        )
        assert by_default == named


class TestJsonLines:
    def test_one_line_for_every_row(self, run: Run, array: Path, readings: Path) -> None:
        """The same entries as --json; readable and compiled steps round differently."""
        lines = lines_of(run("track", readings, "--array", array, "--jsonl", *MOTION))
        results = results_of(run("track", readings, "--array", array, "--json", *MOTION))
        assert len(lines) == N_ROWS
        for line, entry in zip(lines, results, strict=True):
            assert set(line) == set(entry)
            assert line["status"] == entry["status"]
            if entry["position_m"] is not None:
                np.testing.assert_allclose(line["position_m"], entry["position_m"], rtol=0.0, atol=1e-9)

    def test_smoothed(self, run: Run, array: Path, readings: Path) -> None:
        lines = lines_of(run("track", readings, "--array", array, "--jsonl", "--smooth", *MOTION))
        assert lines == results_of(run("track", readings, "--array", array, "--json", "--smooth", *MOTION))


class TestTable:
    def test_a_line_for_every_row(self, run: Run, array: Path, readings: Path) -> None:
        outcome = run("track", readings, "--array", array, *MOTION)
        assert outcome.status == 0
        *lines, caution = outcome.out.splitlines()
        assert caution.startswith("the source counts as a point")
        assert len(lines) == 1 + N_ROWS
        assert lines[0].split()[:4] == ["time_s", "x_m", "y_m", "z_m"]
        assert lines[1].split()[1] == "-"
        assert lines[1 + N_EMPTY].endswith("acquired")
        assert lines[-1].endswith("tracked")
        assert f"{N_ROWS - N_EMPTY} of {N_ROWS} rows tracked" in outcome.err

    def test_quiet(self, run: Run, array: Path, readings: Path) -> None:
        assert run("track", readings, "--array", array, "--quiet").err == ""


class TestSmooth:
    def test_is_the_librarys_smoother_of_a_wandering_motion(self, run: Run, array: Path, readings: Path) -> None:
        results = results_of(run("track", readings, "--array", array, "--json", "--smooth", *MOTION))
        tracker = Tracker(read_array(array), OrnsteinUhlenbeck(0.1, float(np.deg2rad(1.2))), keep_steps=True)
        table = read_readings(readings, tracker.array)
        points = followed(tracker, list(rows_of(table)))
        for entry, point in zip(results, smooth_points(points, tracker.steps), strict=True):
            assert entry["position_m"] == (None if point.position_m is None else point.position_m.tolist())


class TestTruth:
    def test_report(self, run: Run, array: Path, readings: Path, truth: Path) -> None:
        outcome = run("track", readings, "--array", array, "--truth", truth, *MOTION)
        assert outcome.status == 0
        report = outcome.out.splitlines()[2 + N_ROWS :]  # what the table may hide stands above
        assert f"{N_ROWS - N_EMPTY} of {N_ROWS} rows" in report[0]
        for line, words in zip(
            report[1:], (("rms", "Cramér-Rao", "ratio"), ("NEES", "many records"), ("NIS", "99 %")), strict=True
        ):
            assert all(word in line for word in words)

    def test_numbers(self, run: Run, array: Path, readings: Path, truth: Path) -> None:
        outcome = run("track", readings, "--array", array, "--truth", truth, "--json", *MOTION)
        parsed = json.loads(outcome.out, parse_constant=refuse_constant)
        assert list(parsed) == ["results", "consistency", "innovations", "warnings"]
        tracked = [entry for entry in parsed["results"] if entry["position_m"] is not None]
        errors = np.array([entry["position_m"] for entry in tracked]) - source()[1][N_EMPTY:]
        result = parsed["consistency"]
        assert result["position_rms_m"] == pytest.approx(np.sqrt(np.mean(np.sum(errors**2, axis=1))))
        nis = [entry["nis"] for entry in tracked if entry["nis"] is not None]
        assert result["nis_per_dimension"] == pytest.approx(np.sum(nis) / (9 * len(nis)))
        assert (result["rows"], result["tracked_rows"]) == (N_ROWS, N_ROWS - N_EMPTY)

    def test_bound_of_a_smoothed_track_is_that_of_a_smoother(
        self, run: Run, array: Path, readings: Path, truth: Path
    ) -> None:
        """Later rows make less error possible: a filter's bound would be beaten."""
        outcome = run("track", readings, "--array", array, "--truth", truth, "--json", "--smooth", *MOTION)
        found = json.loads(outcome.out)["consistency"]["position_bound_m"]
        tracker = Tracker(read_array(array), OrnsteinUhlenbeck(0.1, float(np.deg2rad(1.2))))
        table, (_, p, m) = read_readings(readings, tracker.array), source()
        rows = list(rows_of(table))
        of_smoother, of_filter = (
            float(np.sqrt(np.mean(posterior_bound(tracker, rows, p, m, smooth=smooth)[N_EMPTY:] ** 2)))
            for smooth in (True, False)
        )
        assert found == pytest.approx(of_smoother, rel=1e-9)
        assert of_smoother < 0.9 * of_filter

    def test_goes_to_stderr_beside_json_lines(self, run: Run, array: Path, readings: Path, truth: Path) -> None:
        outcome = run("track", readings, "--array", array, "--truth", truth, "--jsonl", *MOTION)
        assert len(lines_of(outcome)) == N_ROWS
        assert "NEES per dimension" in outcome.err
        assert all(line.startswith("magloc: ") for line in outcome.err.splitlines())

    def test_without_moment_and_height(self, run: Run, array: Path, readings: Path, tmp_path: Path) -> None:
        t, p, _ = source()
        lines = [f"{time},{x},{y}" for time, (x, y, _) in zip(t, p, strict=True)]
        flat = write(tmp_path / "flat.csv", ["time_s,x_m,y_m", *lines])
        outcome = run("track", readings, "--array", array, "--truth", flat, "--json", *MOTION)
        result = json.loads(outcome.out, parse_constant=refuse_constant)["consistency"]
        assert result["position_bound_m"] is None
        assert result["nees_per_dimension"] > 0.0

    def test_of_other_times(self, run: Run, array: Path, readings: Path, tmp_path: Path) -> None:
        late = write(tmp_path / "late.csv", ["time_s,x_m,y_m,z_m", "1000,1,2,3", "1001,1,2,3"])
        assert_refused(
            run("track", readings, "--array", array, "--truth", late),
            str(late),
            "none of the times",
            "by the same clock",
        )


class TestTruthBetweenItsRows:
    def test_is_interpolated_but_not_over_a_gap(self) -> None:
        truth = Truth(np.array([0.0, 1.0, 2.0, 10.0, 11.0]), np.arange(15.0).reshape(5, 3), None)
        time = np.array([0.0, 0.5, 2.0, 5.0, 10.25, 12.0])
        found = truth_of_rows(Readings(np.zeros((6, 1)), time_s=time), truth)
        assert found.moment_Am2 is None
        np.testing.assert_allclose(found.position_m[:, 0], [0.0, 1.5, 6.0, np.nan, 9.75, np.nan])


class TestGeojson:
    PLACE = (59.95, 30.3, 12.0)

    def test_round_trip(self, run: Run, array: Path, readings: Path, tmp_path: Path) -> None:
        """pymap3d takes the coordinates back to east, north, up."""
        path = tmp_path / "track.geojson"
        outcome = run("track", readings, "--array", array, "--json", *MOTION, "--place", *self.PLACE, "--geojson", path)
        tracked = [entry for entry in results_of(outcome) if entry["position_m"] is not None]
        collection = json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse_constant)
        assert collection["type"] == "FeatureCollection"
        line, *points = collection["features"]
        assert line["geometry"]["type"] == "LineString"
        assert line["geometry"]["coordinates"] == [point["geometry"]["coordinates"] for point in points]
        for feature, entry in zip(points, tracked, strict=True):
            assert feature["type"] == "Feature"
            assert feature["geometry"]["type"] == "Point"
            longitude, latitude, height = feature["geometry"]["coordinates"]
            enu = pymap3d.geodetic2enu(latitude, longitude, height, *self.PLACE)
            np.testing.assert_allclose(enu, entry["position_m"], atol=1e-6)
            assert feature["properties"]["time_s"] == entry["time_s"]
            deviation = np.sqrt(np.diagonal(entry["covariance"]))
            assert feature["properties"]["sigma_east_m"] == pytest.approx(deviation[0])
            assert feature["properties"]["sigma_up_m"] == pytest.approx(deviation[2])

    def test_kml(self, run: Run, array: Path, readings: Path, tmp_path: Path) -> None:
        path = tmp_path / "track.kml"
        outcome = run("track", readings, "--array", array, *MOTION, "--place", *self.PLACE, "--kml", path)
        assert outcome.status == 0
        root = ElementTree.parse(path).getroot()
        assert len(root.findall(".//{*}LineString")) == 1

    @pytest.mark.parametrize("option", ["--geojson", "--kml"])
    def test_needs_a_place(self, run: Run, array: Path, readings: Path, tmp_path: Path, option: str) -> None:
        path = tmp_path / "track.map"
        assert_refused(run("track", readings, "--array", array, option, path), option, "no --place")
        assert not path.exists()

    def test_of_a_folder_that_is_not_there(self, run: Run, array: Path, readings: Path, tmp_path: Path) -> None:
        path = tmp_path / "none" / "track.geojson"
        assert_refused(
            run("track", readings, "--array", array, "--place", *self.PLACE, "--geojson", path), str(tmp_path / "none")
        )

    def test_what_cannot_be_written_is_found_before_the_readings(self, run: Run, array: Path, tmp_path: Path) -> None:
        """The readings are not there: who looks at the output first says so first."""
        absent = ("track", tmp_path / "absent.csv", "--array", array, "--place", *self.PLACE)
        path = tmp_path / "none" / "track.geojson"
        assert_refused(run(*absent, "--geojson", path), f"--geojson {path}", "found no folder")
        assert_refused(run(*absent, "--geojson", tmp_path), f"--geojson {tmp_path}", "found a folder")
        same = tmp_path / "same"
        assert_refused(run(*absent, "--out", same, "--geojson", same), "--geojson", "--out")
        assert_refused(run(*absent, "--out", "/proc/x"), "--out /proc/x", "no file can be made")


class TestOut:
    @pytest.mark.slow
    def test_picture_and_table(self, run: Run, array: Path, readings: Path, truth: Path, tmp_path: Path) -> None:
        folder = tmp_path / "new" / "folder"
        outcome = run("track", readings, "--array", array, "--truth", truth, "--json", *MOTION, "--out", folder)
        entries = json.loads(outcome.out)["results"]
        assert (folder / "track.png").read_bytes().startswith(b"\x89PNG")
        with (folder / "track.csv").open(encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == N_ROWS
        for row, entry in zip(rows, entries, strict=True):
            assert float(row["time_s"]) == entry["time_s"]
            assert row["status"] == entry["status"]
            if entry["position_m"] is None:
                assert row["x_m"] == ""
            else:
                assert float(row["x_m"]) == pytest.approx(entry["position_m"][0], rel=1e-8)
                assert float(row["s_mz_Am2"]) == pytest.approx(np.sqrt(entry["covariance"][5][5]), rel=1e-8)


class TestConditioning:
    def test_windows(self, run: Run, array: Path, readings: Path) -> None:
        """Means of two rows: half of the rows, each at the middle of its window."""
        results = results_of(run("track", readings, "--array", array, "--json", *MOTION, "--window-s", 1))
        assert [entry["time_s"] for entry in results] == [0.25 + i for i in range(N_ROWS // 2)]
        error = np.array(results[-1]["position_m"]) - source()[1][-2:].mean(axis=0)
        assert np.linalg.norm(error) < 0.2

    @pytest.mark.parametrize("window", ["0", "-1", "inf", "nan"])
    def test_refuses_a_window(self, run: Run, array: Path, readings: Path, window: str) -> None:
        assert_refused(run("track", readings, "--array", array, f"--window-s={window}"), "--window-s", "positive")

    @pytest.mark.parametrize(
        "option",
        ["--mains-hz=50", "--high-pass-hz=1", "--high-pass-hz=-1", "--mains-hz=1e-30", "--high-pass-hz=1e-30"],
    )
    def test_refuses_frequencies_that_the_rate_does_not_show(
        self, run: Run, array: Path, readings: Path, option: str
    ) -> None:
        assert_refused(run("track", readings, "--array", array, option), str(readings), "2 Hz")

    def test_refuses_missing_readings_for_a_filter(self, run: Run, array: Path, tmp_path: Path) -> None:
        rows = row_texts()
        rows[5] = ",".join([*rows[5].split(",")[:-1], ""])
        path = write(tmp_path / "gaps.csv", [HEADER, *rows])
        outcome = run("track", path, "--array", array, "--high-pass-hz", 0.1)
        assert_refused(outcome, str(path), "missing readings")


class Stream:
    """``magloc track -`` as a process of its own, which is ended after a minute whatever happens."""

    def __init__(self, array: Path, *options: str) -> None:
        command = [sys.executable, "-m", "magloc.cli", "track", "-", "--array", str(array), *options]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)
        self._timer = threading.Timer(60.0, self.process.kill)
        self._timer.start()

    def send(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def answer(self) -> dict[str, Any]:
        """The next line; an empty one, when the process has ended, is not JSON."""
        assert self.process.stdout is not None
        parsed: dict[str, Any] = json.loads(self.process.stdout.readline(), parse_constant=refuse_constant)
        return parsed

    def finish(self) -> Outcome:
        out, err = self.process.communicate()
        self._timer.cancel()
        return Outcome(self.process.returncode, out, err)


@pytest.fixture
def stream(array: Path) -> Iterator[Stream]:
    process = Stream(array, "--jsonl", "--speed-m-s", "0.1", "--turn-deg-s", "1.2")
    yield process
    process.process.kill()
    process.finish()


class TestStream:
    def test_every_row_is_answered_before_the_next(self, stream: Stream, run: Run, array: Path, readings: Path) -> None:
        """And by the same lines as those of the file."""
        expected = lines_of(run("track", readings, "--array", array, "--jsonl", *MOTION))
        stream.send(HEADER)
        for row, entry in zip(row_texts(), expected, strict=True):
            stream.send(row)
            assert stream.answer() == entry
        outcome = stream.finish()
        assert outcome.status == 0
        assert outcome.out == ""
        assert outcome.err == ""

    def test_rows_that_are_wrong_are_named_and_end_nothing(
        self, stream: Stream, run: Run, array: Path, readings: Path
    ) -> None:
        expected = lines_of(run("track", readings, "--array", array, "--jsonl", *MOTION))
        stream.send(HEADER)
        for i, (row, entry) in enumerate(zip(row_texts(), expected, strict=True)):
            if i == 5:
                stream.send(row.rsplit(",", 1)[0] + ",much")
                stream.send(row_texts()[3])
            stream.send(row)
            assert stream.answer() == entry
        outcome = stream.finish()
        assert (outcome.status, outcome.out) == (0, "")
        garbled, doubled, summary = outcome.err.splitlines()
        assert "garbled: standard input, line 7, column s4_z_nT: found 'much'" in garbled
        assert "doubled: the row of 1.5 s" in doubled
        assert f"{N_ROWS} rows, {N_ROWS - N_EMPTY} tracked, 0 late, 0 lost, 1 doubled, 1 garbled" in summary

    def test_nothing_that_can_be_tracked(
        self, run: Run, array: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        """The rows stay as they were answered; at their end the status is that of the file with the same rows."""
        lines = [HEADER, *row_texts(N_EMPTY)]
        monkeypatch.setattr("sys.stdin", io.StringIO("\n".join([*lines, ""])))
        outcome = run("track", "-", "--array", array)
        assert_refused(outcome, "standard input: found no row", "not acquired")
        assert [json.loads(line)["time_s"] for line in outcome.out.splitlines()] == [0.5 * i for i in range(N_EMPTY)]
        of_file = run("track", write(tmp_path / "empty.csv", lines), "--array", array, "--jsonl")
        assert (of_file.status, of_file.out) == (outcome.status, outcome.out)

    def test_a_header_alone(self, run: Run, array: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("sys.stdin", io.StringIO(HEADER + "\n"))
        assert_refused(run("track", "-", "--array", array), "standard input, line 1", "without rows")

    @pytest.mark.parametrize(
        ("data", "fragments"),
        [
            (
                f"{HEADER}\n0,1,2,\xff".encode("latin-1"),
                ("garbled", "line 2", "0xff is not UTF-8", "only garbled lines (1)"),
            ),
            (f"\ufeff{HEADER}\n".encode(), ("standard input, line 1", "without rows")),
        ],
    )
    def test_bytes(
        self, run: Run, array: Path, monkeypatch: pytest.MonkeyPatch, data: bytes, fragments: Sequence[str]
    ) -> None:
        monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(data), encoding="utf-8"))
        outcome = run("track", "-", "--array", array)
        assert outcome.status == 2
        assert all(fragment in outcome.err for fragment in fragments)

    def test_nothing_on_standard_input(self, stream: Stream) -> None:
        assert_refused(stream.finish(), "standard input: found nothing")

    @pytest.mark.parametrize(
        "options",
        [
            ("--smooth",),
            ("--json",),
            ("--truth", "truth.csv"),
            ("--out", "folder"),
            ("--geojson", "a.geojson", "--place", "1", "2", "3"),
        ],
    )
    def test_refuses_what_needs_the_whole_record(self, run: Run, array: Path, options: tuple[str, ...]) -> None:
        assert_refused(run("track", "-", "--array", array, *options), "READINGS -", "whole record")

    @pytest.mark.parametrize(
        "option", [("--detrend",), ("--window-s", "1"), ("--mains-hz", "50"), ("--high-pass-hz", "1")]
    )
    def test_refuses_conditioning(self, run: Run, array: Path, option: tuple[str, ...]) -> None:
        assert_refused(run("track", "-", "--array", array, *option), "READINGS -", "whole record")


class TestBadInput:
    """Exit status 2 and one line that says what and where."""

    def test_time_going_backwards(self, run: Run, array: Path, tmp_path: Path) -> None:
        rows = row_texts()
        rows[7], rows[8] = rows[8], rows[7]
        path = write(tmp_path / "back.csv", [HEADER, *rows])
        for option in ((), ("--json",), ("--jsonl",), ("--smooth",)):
            outcome = run("track", path, "--array", array, *option)
            assert_refused(outcome, f"{path}, line 10, column time_s", "found 3.5 after 4", "increase")
            assert outcome.out == ""

    @pytest.mark.parametrize("option", ["--speed-m-s", "--turn-deg-s", "--correlation-s"])
    @pytest.mark.parametrize("value", ["0", "-1", "nan", "inf"])
    def test_motion_that_is_not_positive(self, run: Run, array: Path, readings: Path, option: str, value: str) -> None:
        assert_refused(run("track", readings, "--array", array, f"{option}={value}"), option, "positive number")

    def test_unknown_motion(self, run: Run, array: Path, readings: Path) -> None:
        assert_refused(
            run("track", readings, "--array", array, "--motion", "straight"), "--motion", "straight", "wandering"
        )

    def test_two_kinds_of_json(self, run: Run, array: Path, readings: Path) -> None:
        assert_refused(run("track", readings, "--array", array, "--json", "--jsonl"), "--json", "--jsonl")

    def test_unknown_option(self, run: Run, array: Path, readings: Path) -> None:
        assert_refused(run("track", readings, "--array", array, "--smoothe"), "--smoothe")

    @pytest.mark.parametrize("missing", ["readings", "array", "truth"])
    def test_files_that_are_not_there(
        self, run: Run, array: Path, readings: Path, tmp_path: Path, missing: str
    ) -> None:
        absent = tmp_path / "absent"
        paths = {"readings": readings, "array": array, "truth": absent, missing: absent}
        truth = ("--truth", absent) if missing == "truth" else ()
        assert_refused(run("track", paths["readings"], "--array", paths["array"], *truth), str(absent))

    def test_a_pose_that_is_incomplete(self, run: Run, array: Path, tmp_path: Path) -> None:
        path = write(tmp_path / "pose.csv", [HEADER + ",array_x_m", *(f"{row},0" for row in row_texts())])
        assert_refused(run("track", path, "--array", array), str(path), "array_")

    def test_a_quaternion_that_is_not_of_unit_length(self, run: Run, array: Path, tmp_path: Path) -> None:
        pose = "array_x_m,array_y_m,array_z_m,array_qx,array_qy,array_qz,array_qw"
        rows = [f"{row},0,0,0,0,0,0,1.1" for row in row_texts()]
        path = write(tmp_path / "pose.csv", [f"{HEADER},{pose}", *rows])
        assert_refused(run("track", path, "--array", array), str(path), "line 2")

    def test_no_source(self, run: Run, array: Path, tmp_path: Path) -> None:
        path = write(tmp_path / "empty.csv", [HEADER, *row_texts(N_EMPTY)])
        assert_refused(run("track", path, "--array", array, "--json"), str(path), "no row", "not acquired")

    @pytest.mark.parametrize("options", [("--json",), ("--jsonl",), ("--jsonl", "--smooth"), ("--json", "--smooth")])
    def test_no_source_and_why_in_every_row(
        self, run: Run, array: Path, tmp_path: Path, options: tuple[str, ...]
    ) -> None:
        path = write(tmp_path / "empty.csv", [HEADER, *row_texts(N_EMPTY)])
        outcome = run("track", path, "--array", array, *options)
        assert_refused(outcome, str(path), "no row")
        entries = (
            json.loads(outcome.out)["results"]
            if "--json" in options
            else [json.loads(line) for line in outcome.out.splitlines()]
        )
        assert [entry["position_m"] for entry in entries] == [None] * N_EMPTY
        assert all(entry["status"].startswith("not acquired: ") for entry in entries)

    def test_a_place_alone_is_for_geojson_only(self, run: Run, array: Path, readings: Path) -> None:
        assert_refused(run("track", readings, "--array", array, "--date", "2026-11-21"), "--date", "no --place")

    def test_sensors_that_are_not_in_the_array(self, run: Run, array: Path, readings: Path) -> None:
        assert_refused(run("track", readings, "--array", array, "--sensors", "s1,s2,s9"), "s9")
