"""Surveys of known instruments in one line, with positions of their own or of another file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from magloc.cli.app import main

LINE = ["survey", "magarrow.csv", "--instrument", "magarrow", "--place", "48", "11", "500", "--json"]


class TestInstrument:
    @pytest.mark.usefixtures("without_lag")
    def test_finds_the_target_of_the_same_survey(
        self, files: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        """The log has the readings of ground.csv, whose truth is known; the date of the log gives the ambient field."""
        pytest.importorskip("pymap3d")
        monkeypatch.chdir(files)
        truth = np.genfromtxt("ground-targets.csv", delimiter=",", names=True)
        for more in ([], ["--positions", "magarrow.pos"]):
            assert main([*LINE, *more]) == 0
            (target,) = json.loads(capsys.readouterr().out)["targets"]
            np.testing.assert_allclose(target["position_m"][:2], [truth["x_m"], truth["y_m"]], atol=0.15)

    def test_an_unknown_one_lists_all(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["survey", "log.csv", "--instrument", "compass"]) == 2
        said = capsys.readouterr().err
        assert "--instrument: found 'compass', expected one of aerosmartmag, " in said
        assert "magarrow" in said

    def test_neither_array_nor_instrument(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert main(["survey", "log.csv"]) == 2
        assert "--array: found neither --array nor --instrument" in capsys.readouterr().err


class TestColumns:
    def test_writes_the_template(self, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        log, out = str(files / "magarrow.csv"), tmp_path / "array.toml"
        assert main(["columns", log, "--instrument", "magarrow"]) == 0
        printed = capsys.readouterr().out
        assert main(["columns", log, "--instrument", "magarrow", "--out", str(out)]) == 0
        assert out.read_text(encoding="utf-8") == printed
        assert 'mag" = "Mag"' in printed
