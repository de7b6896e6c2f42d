"""Lines as rows: those of a readings file with the same lines, whatever stands between them."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
from arrays.columns import LogColumns
from arrays.io.errors import InputError
from magloc.live.rows import RowParser
from magloc.live.tally import Tally
from magloc.readings import Readings, read_readings, write_readings
from tests.passing_source import ARRAY, moving_source, readings_of

N_ROWS = 60
HEADER = ",".join(["time_s", *(f"{name}_nT" for name in ARRAY.channel_names)])


@pytest.fixture(scope="module")
def lines(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A readings file with some missing readings."""
    time_s, p, m = moving_source(N_ROWS)
    values = readings_of(ARRAY, p, m)
    values[7, 3] = values[20, 0] = math.nan
    path = tmp_path_factory.mktemp("rows") / "rows.csv"
    write_readings(path, Readings(values, time_s=time_s), ARRAY)
    return path.read_text().splitlines()


def parsed(pieces: Sequence[Sequence[str | bytes]], sensors: Sequence[str] | None = None) -> tuple[Readings, Tally]:
    """All rows of some batches of lines."""
    tally = Tally()
    parser = RowParser(ARRAY, "the stream", tally, sensors)
    rows = [
        readings
        for piece in pieces
        for readings in parser.parse([line.encode() if isinstance(line, str) else line for line in piece])
    ]
    return joined(rows), tally


def joined(rows: Sequence[Readings]) -> Readings:
    return Readings(np.vstack([r.values_T for r in rows]), time_s=np.concatenate([r.time_s for r in rows]))


def assert_same(found: Readings, expected: Readings) -> None:
    np.testing.assert_array_equal(found.time_s, expected.time_s)
    np.testing.assert_array_equal(found.values_T, expected.values_T)


class TestGoodLines:
    @pytest.mark.parametrize("size", [1, 2, 7, 100])
    @pytest.mark.parametrize("end", ["", "\r"])
    def test_are_those_of_the_file(self, lines: list[str], tmp_path: Path, size: int, end: str) -> None:
        (tmp_path / "rows.csv").write_text("\n".join(lines))
        sent = [line + end for line in lines]
        found, tally = parsed([sent[i : i + size] for i in range(0, len(sent), size)])
        assert_same(found, read_readings(tmp_path / "rows.csv", ARRAY))
        assert tally == Tally()

    def test_json_objects_are_the_same(self, lines: list[str]) -> None:
        names = lines[0].split(",")
        objects = []
        for i, line in enumerate(lines[1:]):
            cells = {name: float(cell) if cell else None for name, cell in zip(names, line.split(","), strict=True)}
            # What is missing may be left out but in the first row, and the order of the names is free.
            kept = {name: cells[name] for name in sorted(cells) if not i or cells[name] is not None}
            objects.append(json.dumps(kept))
        assert_same(parsed([objects])[0], parsed([lines])[0])

    def test_a_header_that_comes_again(self, lines: list[str]) -> None:
        again = [text for line in lines[1:] for text in (lines[0], line)]
        found, tally = parsed([again])
        assert_same(found, parsed([lines])[0])
        assert not tally.faults

    def test_another_header_counts_from_there_on(self, lines: list[str]) -> None:
        turned = [",".join(reversed(line.split(","))) for line in lines]
        found, tally = parsed([[*lines[:30], turned[0], *turned[30:]]])
        assert_same(found, parsed([lines])[0])
        assert not tally.faults

    def test_columns_of_others_are_ignored_where_sensors_are_chosen(self, lines: list[str]) -> None:
        found, _ = parsed([lines], sensors=["s1", "s2"])
        assert found.values_T.shape == (N_ROWS, 6)


def garbled(line: str, rng: random.Random) -> bytes:
    """A line after one of the accidents of a cable or a radio; never a row of the same number of cells again."""
    at = rng.randrange(1, len(line) - 1)
    cut = line[:at].rsplit(",", 1)[0] if "," in line[:at] else line[:at]
    return rng.choice(
        [
            cut.encode(),
            (line + "," + line).encode(),
            line.replace(",", ";").encode(),
            b"\xff\xfe" + line.encode(),
            line.encode().replace(b".", b"\x00", 1),
            (line.rsplit(",", 1)[0] + ",4_2").encode(),
            (line.rsplit(",", 1)[0] + ',"').encode(),
            (line + "\r" + line).encode(),
            b'{"time_s": 1.0',
            b'{"noise": 1.0}',
            b'{"time_s": 1.0, "x": 2.0}',
            (line.split(",", 1)[1] + ",inf").encode(),
        ]
    )


class TestGarbledLines:
    @pytest.mark.parametrize("seed", range(20))
    def test_are_counted_and_cost_no_other(self, lines: list[str], seed: int) -> None:
        rng = random.Random(seed)
        sent: list[bytes] = [lines[0].encode()]
        n_garbled = 0
        for line in lines[1:]:
            if rng.random() < 0.3:
                sent.append(garbled(line, rng))
                n_garbled += 1
            sent.append(line.encode())
        size = rng.randrange(1, 30)
        found, tally = parsed([sent[i : i + size] for i in range(0, len(sent), size)])
        assert_same(found, parsed([lines])[0])
        assert tally.garbled == tally.faults == n_garbled

    def test_are_named_by_line_and_column(self, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level("INFO")
        bad = lines[3].rsplit(",", 1)[0] + ",much"
        parsed([[*lines[:3], "", bad, *lines[3:]]])
        assert caplog.messages == [
            "garbled: the stream, line 5, column s4_z_nT: found 'much', expected a number or an empty cell."
        ]

    def test_named_are_the_first_ones(self, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
        caplog.set_level("INFO")
        parsed([[*lines, *["x"] * 100]])
        assert len(caplog.messages) == 5
        assert "only counted" in caplog.messages[-1]


class TestHeader:
    def test_lines_before_it_are_garbled(self, lines: list[str]) -> None:
        """As where a cable is plugged in while the sender runs."""
        found, tally = parsed([[lines[5][10:], *lines]])
        assert len(found) == N_ROWS
        assert tally.garbled == 1

    def test_of_another_array_waits_for_a_right_one(self, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
        """A warning names it once; of a file it is refused, where no other one comes."""
        other = lines[0].replace("s4_", "s5_")
        found, tally = parsed([[other, lines[1], other, *lines]])
        assert_same(found, parsed([lines])[0])
        assert tally.garbled == 3
        assert [record.levelname for record in caplog.records if "found no such column" in record.message] == [
            "WARNING"
        ]
        with pytest.raises(InputError, match=r"the stream, line 1, column s4_x_nT: found no"):
            list(RowParser(ARRAY, "the stream", Tally(), is_file=True).parse([other.encode()]))

    @pytest.mark.parametrize("foreign", ["hello", '{"time_s": 1.0, "s1_x_nT": 2.0}', "time_s,a\n1,2"])
    def test_foreign_senders_cost_no_row(self, lines: list[str], foreign: str) -> None:
        """Whatever they send, before the header and later, and the good sender speaks CSV or JSON."""
        names = lines[0].split(",")
        objects = [
            json.dumps({name: float(cell) if cell else None for name, cell in zip(names, line.split(","), strict=True)})
            for line in lines[1:]
        ]
        strange = [line.encode() for line in foreign.split("\n")]
        for good in (lines, objects):
            tally = Tally()
            parser = RowParser(ARRAY, "the stream", tally)
            found: list[Readings] = []
            for line in good:
                assert not list(parser.parse(strange, "foreign"))
                found += parser.parse([line.encode()], "good")
            assert_same(joined(found), parsed([lines])[0])
            assert tally.garbled == len(good) * len(strange)

    def test_is_that_of_its_sender(self, lines: list[str]) -> None:
        """Another order of columns counts for who sends it; others have the first."""
        turned = [",".join(reversed(line.split(","))) for line in lines]
        names = lines[0].split(",")
        parser = RowParser(ARRAY, "the stream", Tally())
        found: list[Readings] = list(parser.parse([lines[0].encode()], 0))
        for i, line in enumerate(lines[1:]):
            cells = [float(cell) if cell else None for cell in line.split(",")]
            of_json = dict(zip(reversed(names), reversed(cells), strict=True))
            sent = [[line], [turned[0], turned[1 + i]], [json.dumps(of_json)], [line]][i % 4]
            found += parser.parse([each.encode() for each in sent], i % 4)
        assert_same(joined(found), parsed([lines])[0])

    def test_of_another_array_later_is_garbled(self, lines: list[str]) -> None:
        found, tally = parsed([[*lines[:9], lines[0].replace("s4_", "s5_"), *lines[9:]]])
        assert len(found) == N_ROWS
        assert tally.garbled == 1

    def test_whose_poses_are_late_is_refused(self) -> None:
        """The pose of a row comes after it."""
        array = replace(ARRAY, columns=LogColumns(position=("E", "N", "U"), pose_latency_s=0.1))
        with pytest.raises(InputError, match=r"found columns\.pose_latency_s"):
            RowParser(array, "the stream", Tally())

    def test_that_is_late(self, lines: list[str], caplog: pytest.LogCaptureFixture) -> None:
        found, tally = parsed([lines[1:2] * 200, lines])
        assert_same(found, parsed([lines])[0])
        assert tally.garbled == 200
        (warning,) = (record.message for record in caplog.records if record.levelname == "WARNING")
        assert "found no header in 100 lines" in warning


class TestColumnsOfAnotherProgram:
    """Rows are those of a file of the same lines."""

    ARRAY = replace(
        ARRAY,
        columns=LogColumns(
            separator="semicolon",
            decimal=",",
            time="T",
            time_unit="iso",
            unit="uT",
            sensors={"s1": ("Ax", "Ay", "Az")},
            position=("E", "N", "U"),
        ),
    )
    NAMES = ("T", "Ax", "Ay", "Az", *(f"{name}_nT" for name in ARRAY.channel_names[3:]), "E", "N", "U", "battery")
    TEXT = ";".join(NAMES)

    def rows(self, n: int) -> list[str]:
        rng = np.random.default_rng(3)
        cells = rng.normal(size=(n, len(self.NAMES) - 2)).round(3).astype(str)
        return [
            ";".join([f"2026-11-21T12:00:{i:02}.5", *(cell.replace(".", ",") for cell in row), "full"])
            for i, row in enumerate(cells)
        ]

    def parsed(self, lines: Sequence[str]) -> tuple[Readings, Tally]:
        tally = Tally()
        parser = RowParser(self.ARRAY, "the stream", tally)
        pieces = [piece for line in lines for piece in parser.parse([line.encode()])]
        names = ("values_T", "time_s", "array_position_m")
        values, time_s, place = (np.concatenate([getattr(piece, name) for piece in pieces]) for name in names)
        turns = Rotation.concatenate([piece.array_rotation for piece in pieces if piece.array_rotation is not None])
        return Readings(values, time_s=time_s, array_position_m=place, array_rotation=turns), tally

    def test_as_of_a_file(self, tmp_path: Path) -> None:
        rows = self.rows(12)
        (tmp_path / "log.csv").write_text("\n".join([self.TEXT, *rows]) + "\n", encoding="utf-8")
        whole = read_readings(tmp_path / "log.csv", self.ARRAY)
        found, tally = self.parsed([self.TEXT, *rows])
        np.testing.assert_array_equal(found.values_T, whole.values_T)
        np.testing.assert_array_equal(found.time_s, whole.time_s)
        np.testing.assert_array_equal(found.array_position_m, whole.array_position_m)
        assert tally.garbled == 0

    def test_garbled_and_repeated_lines(self, caplog: pytest.LogCaptureFixture) -> None:
        """A header that is sent again changes nothing, and a line that is none is named by the log's own columns."""
        rows = self.rows(6)
        bad = rows[2].replace("2026-11-21T12:00:02.5", "noon")
        with caplog.at_level("INFO"):
            found, tally = self.parsed([self.TEXT, *rows[:2], bad, self.TEXT, *rows[3:]])
        assert len(found) == 5
        assert tally.garbled == 1
        assert "line 4, column T: found 'noon'" in caplog.text

    def test_a_tab_before_a_missing_cell(self) -> None:
        """At either end of a row it is a separator, not what stands around it."""
        array = replace(ARRAY, columns=LogColumns(separator="tab"))
        names = [f"{name}_nT" for name in ARRAY.channel_names]
        parser = RowParser(array, "the stream", tally := Tally())
        rows = ["\t".join([*map(str, range(11)), "", "0.5"]), "\t".join(["", *map(str, range(11)), "1"])]
        lines = ["\t".join([*names, "time_s"]), *rows, "\t".join(map(str, range(13))) + "\r"]
        (found,) = parser.parse([line.encode() for line in lines])
        assert tally.garbled == 0
        assert np.argwhere(np.isnan(found.values_T)).tolist() == [[0, 11], [1, 0]]

    def test_objects(self) -> None:
        rows = self.rows(4)
        objects = []
        for row in rows:
            time, *cells, battery = row.split(";")
            numbers = (float(cell.replace(",", ".")) for cell in cells)
            objects.append(json.dumps(dict(zip(self.NAMES, (time, *numbers, battery), strict=True))))
        found, _ = self.parsed(objects)
        expected, _ = self.parsed([self.TEXT, *rows])
        np.testing.assert_array_equal(found.values_T, expected.values_T)

    def test_a_header_without_a_sensor(self) -> None:
        parser = RowParser(self.ARRAY, "the stream", Tally())
        assert not list(parser.parse([self.TEXT.replace("Ay", "By").encode(), *map(str.encode, self.rows(2))]))
        assert "line 1, column Ay: found no such column" in parser.fault


class TestDummies:
    def test_they_are_counted_and_missing(self) -> None:
        """A known number at once, zero after ten rows that are far from it."""
        array, tally = arrays.axial(1.0, "scalar"), Tally()
        parser = RowParser(array, "the rows", tally)
        good = [f"{i},{48e3 + i},{48e3 - i}" for i in range(1, 12)]
        lines = ["time_s,s1_nT,s2_nT", "0,-99999,48000", *good, "12,0,48000"]
        rows = [row for line in lines for row in parser.parse([line.encode()])]
        assert [i for i, row in enumerate(rows) if np.isnan(row.values_T[0, 0])] == [0, 12]
        assert not any(np.isnan(row.values_T[0, 1]) for row in rows)
        assert tally.dummies == 2
