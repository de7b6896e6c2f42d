"""``magloc columns``: a proposal is printed, or written and used."""

from __future__ import annotations

from pathlib import Path

import pytest

import arrays
from magloc.cli.app import main

LOG = "logger 7\ntime_s;Mag;East;North;Height\n" + "".join(f"{k};48000;{k};0;1\n" for k in range(5))


class TestColumns:
    def test_is_printed_or_written(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "log.csv").write_text(LOG, encoding="utf-8")
        assert main(["columns", str(tmp_path / "log.csv")]) == 0
        printed = capsys.readouterr().out
        assert main(["columns", str(tmp_path / "log.csv"), "--out", str(tmp_path / "array.toml")]) == 0
        said = capsys.readouterr()
        assert said.out == ""
        assert "asked: are the readings in nT?" in said.err
        assert (tmp_path / "array.toml").read_text(encoding="utf-8") == printed
        columns = arrays.read_sensors(tmp_path / "array.toml").columns
        assert columns is not None
        assert columns.position == ("East", "North", "Height")

    def test_a_picture_is_refused(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        (tmp_path / "log.csv").write_bytes(b"\x89PNG\r\n\x1a\n\0\0")
        assert main(["columns", str(tmp_path / "log.csv"), "--out", str(tmp_path / "array.toml")]) == 2
        assert "expected" in capsys.readouterr().err
        assert not (tmp_path / "array.toml").exists()
