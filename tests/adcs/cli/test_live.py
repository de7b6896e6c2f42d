"""``adcs live``: its lines are those of the filter, and bad lines end nothing."""

from __future__ import annotations

import io
import json
import sys

import numpy as np
import pytest

import adcs as package
from adcs.io.imu_streams import ImuStream
from adcs.viewer.live_attitude import LiveAttitudeView
from tests.adcs.refusals import assert_refused
from tests.command_line import Run

IMU = package.datasets.load("imu")
LINES = IMU.path.read_text(encoding="utf-8").splitlines()[:401]


def expected() -> list[package.AttitudeEstimate]:
    readings = (values[: len(LINES) - 1] for values in (IMU.time_s, IMU.gyro_rad_s, IMU.acceleration_m_s2, IMU.field_T))
    board = package.AttitudeFilter()
    return [board.update(*row) for row in zip(*readings, strict=True)]


def objects() -> list[str]:
    header = LINES[0].split(",")
    return [json.dumps(dict(zip(header, map(float, line.split(",")), strict=True))) for line in LINES[1:]]


def shifted(line: str, by_s: float) -> str:
    """Row with another time."""
    time_s, rest = line.split(",", 1)
    return f"{float(time_s) + by_s!r},{rest}"


class TestStream:
    @pytest.mark.parametrize("form", ["csv", "json"])
    def test_the_filters_numbers(self, form: str) -> None:
        lines = [line.encode() for line in (LINES if form == "csv" else objects())]
        found = list(ImuStream().parse(lines, "lines"))
        np.testing.assert_allclose([one.q for one in found], [one.q for one in expected()], rtol=0, atol=1e-9)
        assert [one.flags for one in found] == [one.flags for one in expected()]

    def test_bad_lines_end_nothing(self) -> None:
        late, cut = shifted(LINES[150], 0.001), LINES[300][:20]
        lines = [*LINES[:200], "hello", late, LINES[150], "{", "[1]", "\xff", cut, LINES[0], *LINES[200:]]
        stream = ImuStream()
        found = list(stream.parse([line.encode("latin-1") for line in lines], "lines"))
        np.testing.assert_allclose(found[-1].q, expected()[-1].q, rtol=0, atol=1e-9)
        assert (stream.tally.rows, stream.tally.late, stream.tally.garbled) == (len(LINES) - 1, 1, 5)
        assert stream.tally.doubled == 1

    def test_a_wrong_time_costs_a_row(self) -> None:
        lines = [*LINES[:200], shifted(LINES[200], 1e6), *LINES[201:]]
        stream = ImuStream()
        found = list(stream.parse([line.encode() for line in lines], "lines"))
        assert (len(found), stream.tally.rows, stream.tally.garbled) == (len(LINES) - 2, len(LINES) - 2, 1)
        others = [line.encode() for line in [*LINES[:200], *LINES[201:]]]
        np.testing.assert_array_equal(found[-1].q, [*ImuStream().parse(others, "lines")][-1].q)

    def test_a_clock_that_is_set_back(self) -> None:
        """The filter starts anew with the tenth row."""
        stream = ImuStream()
        lines = [*LINES[:200], *(shifted(line, -1e3) for line in LINES[1:])]
        found = list(stream.parse([line.encode() for line in lines], "lines"))
        assert (stream.tally.rows, stream.tally.late, stream.tally.restarts) == (len(lines) - 10, 9, 1)
        anew = [line.encode() for line in [LINES[0], *lines[209:]]]
        np.testing.assert_array_equal(found[-1].q, [*ImuStream().parse(anew, "lines")][-1].q)

    def test_a_row_that_the_filter_refuses(self) -> None:
        """A field of zero is no reading."""
        stream = ImuStream()
        zero = ",".join([*LINES[200].split(",")[:7], "0", "0", "0"])
        assert len(list(stream.parse([line.encode() for line in [*LINES[:200], zero]], "lines"))) == 199
        assert (stream.tally.rows, stream.tally.garbled) == (199, 1)


class TestCommand:
    def test_replay(self, adcs: Run, tmp_path) -> None:  # type: ignore[no-untyped-def]
        (tmp_path / "log.csv").write_text("\n".join(LINES), encoding="utf-8")
        outcome = adcs("live", "--from", f"replay:{tmp_path / 'log.csv'}", "--replay-speed", "1e9")
        assert outcome.status == 0, outcome.err
        rows = [json.loads(line) for line in outcome.out.splitlines()]
        assert [*rows[0]] == [
            *("time_s", "qw", "qx", "qy", "qz", "sigma_tilt_deg", "sigma_heading_deg", "disturbed", "flags")
        ]
        q = [[row[name] for name in ("qw", "qx", "qy", "qz")] for row in rows]
        np.testing.assert_allclose(q, [one.q for one in expected()], rtol=0, atol=1e-9)
        assert "400 rows, 0 late, 0 garbled" in outcome.err

    def test_a_page(self, adcs: Run, tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
        """It stays after the last row until Ctrl-C."""
        shown = []
        monkeypatch.setattr(LiveAttitudeView, "update", lambda _, estimate, tally: shown.append(estimate.time_s))
        monkeypatch.setattr(LiveAttitudeView, "wait", lambda _: shown.append("waits"))
        (tmp_path / "log.csv").write_text("\n".join(LINES), encoding="utf-8")
        outcome = adcs("live", "--from", f"replay:{tmp_path / 'log.csv'}", "--replay-speed", "1e9", "--view")
        assert outcome.status == 0, outcome.err
        assert "open http://" in outcome.err
        assert shown == [*(one.time_s for one in expected()), "waits"]

    def test_refusals(self, adcs: Run, monkeypatch: pytest.MonkeyPatch) -> None:
        assert_refused(adcs("live", "--lag-s", "1"), "--lag-s: found 1 s, expected 0 to 0.04 s")
        monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"hello\n")))
        outcome = adcs("live", "--from", "-")
        assert outcome.status == 2
        assert "standard input: found only garbled lines (1; " in outcome.err.splitlines()[-1]
