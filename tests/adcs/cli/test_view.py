"""``adcs view``: pages of logs, and what it refuses."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import numpy as np
import pytest

import adcs as library
from tests.adcs.refusals import assert_refused


@pytest.fixture(scope="module")
def satellite() -> Path:
    return library.datasets.load("satellite").path


def config_of(path: Path) -> Path:
    return path.with_name(f"{path.stem}-scenario.toml")


class TestPage:
    def test_satellite(self, adcs, satellite, tmp_path):
        truth = satellite.with_name(f"{satellite.stem}-truth.csv")
        outcome = adcs(
            "view", satellite, "--config", config_of(satellite), "--truth", truth, "--html", tmp_path / "a.html"
        )
        assert outcome.status == 0, outcome.err
        page = (tmp_path / "a.html").read_text(encoding="utf-8")
        for words in ("true body axes", "3σ cones", "field: thick as measured", "the bar below plays the rows"):
            assert words in page

    def test_an_ephemeris_message_as_of_estimate(self, adcs, satellite, tmp_path):
        """Read as `adcs estimate` reads it: a message holds attitudes alone."""
        utc = np.datetime64("2014-09-01T00:00:00", "ms") + 1000 * np.arange(30).astype("timedelta64[ms]")
        library.write_aem(tmp_path / "a.aem", utc, np.tile([0.0, 0.0, 0.0, 1.0], (30, 1)))
        text = config_of(satellite).read_text(encoding="utf-8")
        (tmp_path / "a.toml").write_text(text.replace('"st+gyro+mag+sun"', '"st"'), encoding="utf-8")
        outcome = adcs("view", tmp_path / "a.aem", "--config", tmp_path / "a.toml", "--html", tmp_path / "a.html")
        assert outcome.status == 0, outcome.err
        assert "3σ cones" in (tmp_path / "a.html").read_text(encoding="utf-8")

    def test_inertial_unit(self, adcs, tmp_path):
        log = library.datasets.load("imu").path
        assert adcs("view", log, "--html", tmp_path / "a.html", "--quiet").err == ""
        page = (tmp_path / "a.html").read_text(encoding="utf-8")
        assert "accelerometer: thick as measured" in page
        assert "true body axes" not in page

    @pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes in the file system")
    def test_files_that_can_be_read_once(self, adcs, satellite, tmp_path):
        """Pipes, such as a shell makes of a command."""
        pipes = [tmp_path / "log", tmp_path / "config"]
        for pipe, file in zip(pipes, (satellite, config_of(satellite)), strict=True):
            os.mkfifo(pipe)
            threading.Thread(target=pipe.write_bytes, args=(file.read_bytes(),), daemon=True).start()
        outcome = adcs("view", pipes[0], "--config", pipes[1], "--html", tmp_path / "a.html")
        assert outcome.status == 0, outcome.err


class TestRefused:
    def test_truth_of_an_inertial_unit(self, adcs, tmp_path):
        log = library.datasets.load("imu").path
        assert_refused(adcs("view", log, "--truth", log, "--html", tmp_path / "a.html"), "--truth")

    def test_truth_of_another_time(self, adcs, satellite, tmp_path):
        (tmp_path / "truth.csv").write_text("time_s,qw,qx,qy,qz\n-5,1,0,0,0\n", encoding="utf-8")
        files = (satellite, "--config", config_of(satellite), "--truth", tmp_path / "truth.csv")
        assert_refused(adcs("view", *files, "--html", tmp_path / "a.html"), "none of the log's times")
        assert not (tmp_path / "a.html").exists()

    def test_a_film_of_another_kind(self, adcs, satellite):
        assert_refused(adcs("view", satellite, "--config", config_of(satellite), "--movie", "a.avi"), ".gif or .apng")

    def test_a_log_of_no_kind(self, adcs, tmp_path):
        (tmp_path / "log.csv").write_text("a,b\n1,2\n", encoding="utf-8")
        assert_refused(adcs("view", tmp_path / "log.csv", "--html", tmp_path / "a.html"), "log.csv")
