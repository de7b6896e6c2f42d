"""Tests of ``adcs run mockup``: what it prints and writes, and what it refuses.

===========================  =====================================================
what                         checked against
===========================  =====================================================
numbers that are printed     ``summary()`` of the runners, and the files' columns
frames from files            the poses that the same frames were rendered at
methods' order, false fixes  the order that section 9 of our summary asks
===========================  =====================================================
"""

from __future__ import annotations

import csv
import json
import math
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from adcs.io.frame_files import write_frame
from adcs.mockup.vision.sky import led_sky, write_sky
from sims.experiments.mockup_vision import SkySetup, random_frame
from tests.adcs.refusals import assert_refused

SKY_KEYS = [
    *("poses", "success", "false_fixes", "position_rms_mm", "heading_rms_deg"),
    *("identify_ms_median", "frame_ms_median"),
]
FUSION_KEYS = {"position_rms_mm", "position_max_mm", "velocity_rms_mm_s", "heading_rms_deg"}
ZEROS_KEYS = {"position_rms_mm", "zero_error_m_s2"}
SHORT = ("--part", "fusion", "--seeds", "1", "--duration", "20")


@pytest.fixture
def printed(adcs):
    """What ``--json`` prints."""

    def run(*arguments):
        outcome = adcs("run", "mockup", "--json", *arguments)
        assert outcome.status == 0, outcome.err
        assert outcome.err == ""
        assert outcome.out.count("\n") == 1
        return json.loads(outcome.out)

    return run


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def without_times(result):
    return {key: value for key, value in result.items() if not key.endswith("_ms_median")}


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def assert_is_picture(path: Path) -> None:
    picture = Image.open(path).convert("RGB")
    assert picture.height > 500
    colours = picture.getcolors(maxcolors=1 << 20)
    assert colours is not None
    assert len(colours) > 50


class TestSky:
    def test_keys_and_numbers(self, printed):
        result = printed("--poses", "10")
        assert list(result) == SKY_KEYS
        assert (result["poses"], result["success"], result["false_fixes"]) == (10, 1.0, 0)
        assert result["position_rms_mm"] < 0.1
        assert result["heading_rms_deg"] < 0.02
        assert result["frame_ms_median"] > result["identify_ms_median"] > 0.0

    def test_sky_is_the_part_by_default(self, printed):
        arguments = ("--poses", "4", "--seed", "3")
        assert without_times(printed(*arguments)) == without_times(printed("--part", "sky", *arguments))

    def test_runs_are_pooled(self, printed):
        damage = ("--poses", "6", "--lost", "0.4", "--spurious", "6")
        both = printed(*damage, "--runs", "2", "--seed", "5")
        each = [printed(*damage, "--seed", seed) for seed in ("5", "6")]
        assert both["poses"] == 12
        assert both["success"] == pytest.approx(np.mean([one["success"] for one in each]))

    def test_better_matchers_find_more_in_damaged_frames(self, printed):
        damage = ("--poses", "25", "--lost", "0.4", "--spurious", "6")
        success = [printed(*damage, "--matcher", name)["success"] for name in ("paper", "robust", "odds")]
        assert success[0] < success[2]
        assert success[1] < success[2]

    def test_what_is_believed_of_the_lens_counts(self, printed):
        lens = ("--poses", "10", "--k1", "-0.05")
        known, unknown = printed(*lens, "--believed-k1", "-0.05"), printed(*lens)
        assert known["position_rms_mm"] < 0.1 < unknown["position_rms_mm"]

    def test_finders(self, printed):
        fast = ("--poses", "12", "--speed-m-s", "1.0", "--turn-deg-s", "57")
        assert printed(*fast, "--stars", "faint")["success"] > printed(*fast)["success"]
        # One hot pixel hides all stars from the level between the extremes: peaks of smeared lights are below it.
        hot = (*fast, "--hot-pixels", "3")
        assert printed(*hot, "--stars", "level")["success"] == 0.0

    def test_no_fix_at_all_has_no_errors(self, printed):
        result = printed("--poses", "2", "--lost", "1", "--seed", "1")
        assert (result["success"], result["position_rms_mm"], result["heading_rms_deg"]) == (0.0, None, None)

    def test_text(self, adcs):
        outcome = adcs("run", "mockup", "--poses", "3", "--lost", "0.1", "--noise-dn", "6", "--turn-deg-s", "20")
        assert outcome.status == 0
        lines = outcome.out.splitlines()
        assert lines[0] == "3 frames 0.9 m wide, matcher robust"
        assert lines[1] == "noise 6 DN, 10 % of the lights lost, 20 °/s"
        assert len(lines) == 8

    @pytest.mark.slow
    def test_files_can_be_read_again(self, adcs, tmp_path):
        out, again = tmp_path / "new" / "folder", tmp_path / "again"
        outcome = adcs("run", "mockup", "--poses", "6", "--seeds", "2", "--lost", "0.3", "--json", "--out", out)
        assert outcome.status == 0, outcome.err
        pictures = {"mockup-sky.png", "mockup-frame.png", "mockup-drive.png"}
        assert names_in(out) == {*pictures, "mockup-sky.csv", "sky.toml", "frame.png"}
        assert outcome.err.startswith("adcs: wrote mockup-sky.png, ")
        for name in pictures:
            assert_is_picture(out / name)
        rows, result = rows_of(out / "mockup-sky.csv"), json.loads(outcome.out)
        assert [(row["seed"], row["pose"]) for row in rows] == [(s, p) for s in "01" for p in "012345"]
        good = [row for row in rows if row["good"] == "1"]
        assert len(good) == round(12 * result["success"])
        errors = [float(row["position_error_mm"]) for row in good]
        assert math.sqrt(np.mean(np.square(errors))) == pytest.approx(result["position_rms_mm"])
        for row in rows:
            assert (row["x_m"] == "") == (row["reason"] != "")
        # The frame that was written is the first one with a good fix.
        files = ("--frames", out / "frame.png", "--sky", out / "sky.toml")
        outcome = adcs("run", "mockup", *files, "--out", again)
        assert outcome.status == 0, outcome.err
        assert outcome.out.splitlines()[1].startswith("frame.png")
        assert names_in(again) == {"frame-stars.png", "mockup-frames.csv"}
        assert_is_picture(again / "frame-stars.png")
        (fix,) = rows_of(again / "mockup-frames.csv")
        assert float(fix["x_m"]) == pytest.approx(float(good[0]["x_m"]), abs=1e-12)


class TestFrames:
    """Frames in PNG files, with the sky that belongs to them."""

    @pytest.fixture
    def sky_file(self, tmp_path):
        write_sky(led_sky(), tmp_path / "sky.toml")
        return tmp_path / "sky.toml"

    @pytest.fixture
    def folder(self, tmp_path):
        (tmp_path / "frames").mkdir()
        return tmp_path / "frames"

    def test_fixes_of_a_folder(self, printed, folder, sky_file):
        poses = []
        for row in range(3):
            pose, frame = random_frame(led_sky(), SkySetup(), 7, row)
            write_frame(frame.image, folder / f"{row}.png")
            poses.append(pose)
        dark = np.random.default_rng(0).integers(10, 20, (480, 640), dtype=np.uint8)
        write_frame(dark, folder / "no-lights.png")
        result = printed("--frames", folder, "--sky", sky_file)
        assert result["identified"] == 3
        assert [entry["file"] for entry in result["frames"]] == ["0.png", "1.png", "2.png", "no-lights.png"]
        for entry, pose in zip(result["frames"], poses, strict=False):
            assert entry["position_m"] == pytest.approx([pose.x_m, pose.y_m], abs=2e-4)
            assert math.remainder(entry["heading_deg"] - math.degrees(pose.heading_rad), 360.0) == pytest.approx(
                0.0, abs=0.03
            )
            assert entry["matched"] <= entry["stars"]
        assert result["frames"][-1] == {
            "file": "no-lights.png",
            "stars": 0,
            "position_m": None,
            "reason": "0 stars, 5 needed",
        }

    @pytest.mark.parametrize(
        ("picture", "sentence"),
        [
            (np.zeros((480, 640), np.uint8), "black"),
            (np.full((480, 640), 255, np.uint8), "saturated"),
            (np.full((480, 640), 9, np.uint8), "9 in all pixels"),
            (np.full((240, 320), 9, np.uint8), "found 320 × 240 pixels, expected 640 × 480"),
            (np.zeros((480, 640, 3), np.uint8), "colours"),
        ],
    )
    def test_frames_that_are_none(self, adcs, folder, sky_file, picture, sentence):
        Image.fromarray(picture).save(folder / "bad.png")
        outcome = adcs("run", "mockup", "--frames", folder, "--sky", sky_file, "--out", folder / "out")
        assert_refused(outcome, "bad.png", sentence)
        assert not (folder / "out").exists()

    def test_files_that_are_none(self, adcs, folder, sky_file):
        (folder / "bad.png").write_text("no image")
        assert_refused(adcs("run", "mockup", "--frames", folder, "--sky", sky_file), "bad.png", "no PNG image")
        (folder / "bad.png").unlink()
        assert_refused(adcs("run", "mockup", "--frames", folder, "--sky", sky_file), "found no file *.png")
        missing = folder / "x.png"
        assert_refused(adcs("run", "mockup", "--frames", missing, "--sky", sky_file), "x.png", "does not exist")

    def test_skies_that_are_none(self, adcs, tmp_path):
        sky = tmp_path / "few.toml"
        assert_refused(adcs("run", "mockup", "--sky", sky), "few.toml", "does not exist")
        sky.write_text("positions_m = [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]\n")
        assert_refused(adcs("run", "mockup", "--sky", sky), "few.toml", "at least 4 lights", "received 3")

    @pytest.mark.parametrize("unit", [1e3, 1e-3])
    def test_a_sky_in_another_unit(self, adcs, tmp_path, unit):
        positions = (unit * led_sky().positions_m).tolist()
        (tmp_path / "unit.toml").write_text(f"positions_m = {positions}\n")
        assert_refused(adcs("run", "mockup", "--sky", tmp_path / "unit.toml"), "unit.toml", "m apart", "the metre")

    @pytest.mark.filterwarnings("always::UserWarning")
    def test_a_regular_grid_is_warned_of(self, adcs, tmp_path):
        points = [[0.2 * x, 0.2 * y] for x in range(-6, 7) for y in range(-5, 6)]
        (tmp_path / "grid.toml").write_text(f"positions_m = {points}\n")
        outcome = adcs("run", "mockup", "--sky", tmp_path / "grid.toml", "--poses", "3", "--json")
        assert outcome.status == 0
        assert json.loads(outcome.out)["poses"] == 3
        assert outcome.err.startswith("adcs: warning: The Delaunay triangles of the 143 lights are not unique")
        assert outcome.err.count("\n") == 1


class TestFusion:
    def test_keys_and_order(self, printed):
        every = printed(*SHORT, "--fusion", "all")
        assert list(every) == ["paper", "velocity-corrected", "ekf", "camera", "imu"]
        for result in every.values():
            assert result.keys() >= FUSION_KEYS
        one = printed(*SHORT)
        assert one == every["ekf"]
        assert one["position_rms_mm"] < every["paper"]["position_rms_mm"] < every["camera"]["position_rms_mm"]

    def test_with_the_fixes_of_rendered_frames(self, printed):
        whole = ("--part", "all", "--seeds", "1", "--duration", "20", "--delay-s", "0.1")
        result = printed(*whole)
        assert result.keys() == printed(*SHORT).keys()
        assert result["delay_ms_median"] == pytest.approx(100.0)
        assert result["false_fixes"] == 0 < result["used_fixes"] == result["fixes"]
        assert result["position_rms_mm"] < 5.0
        assert printed(*whole, "--fusion", "all")["ekf"] == result
        assert printed(*whole, "--lost", "0.9")["fixes"] < result["fixes"]

    def test_a_method_alone(self, printed):
        assert printed(*SHORT, "--fusion", "camera", "--seed", "2")["heading_rms_deg"] > 5.0

    def test_false_fixes_are_rejected_by_the_filter_alone(self, printed):
        false = ("--part", "fusion", "--seeds", "1", "--duration", "40", "--false-fixes", "0.1")
        filtered, source = printed(*false), printed(*false, "--fusion", "paper")
        assert filtered["rejected_fixes"] == filtered["false_fixes"] > 0
        assert filtered["position_rms_mm"] < 10.0 < 50.0 < source["position_rms_mm"]

    def test_worse_cameras(self, printed):
        usual = printed(*SHORT)
        assert printed(*SHORT, "--failed", "0.9")["fixes"] < usual["fixes"]
        assert printed(*SHORT, "--outage", "5", "15")["fixes"] < usual["fixes"]
        assert printed(*SHORT, "--repeated", "1")["fixes"] > usual["fixes"]
        later = printed(*SHORT, "--delay-s", "2", "--fusion", "camera")
        assert later["position_rms_mm"] > printed(*SHORT, "--fusion", "camera")["position_rms_mm"]
        assert printed(*SHORT, "--overtaken", "0.5")["position_rms_mm"] != usual["position_rms_mm"]

    def test_text(self, adcs):
        outcome = adcs("run", "mockup", *SHORT)
        assert outcome.out.startswith("1 run of 20 s, fusion ekf, errors after 10 s:\nposition, rms / 95 % / largest")
        table = adcs("run", "mockup", *SHORT, "--fusion", "all").out.splitlines()
        assert len(table) == 7
        assert table[2].startswith("paper")

    def test_files(self, adcs, tmp_path):
        outcome = adcs("run", "mockup", *SHORT[:2], "--seeds", "2", "--duration", "20", "--out", tmp_path, "--json")
        assert outcome.status == 0, outcome.err
        pictures = {"mockup-fusion.png", "mockup-fusion-errors.png"}
        assert names_in(tmp_path) == {*pictures, "mockup-fusion.csv", "mockup-fusion-runs.csv", "mockup-fixes.csv"}
        for name in pictures:
            assert_is_picture(tmp_path / name)
        runs = rows_of(tmp_path / "mockup-fusion-runs.csv")
        assert [row["seed"] for row in runs] == ["0", "1"]
        mean = np.mean([float(row["position_rms_mm"]) for row in runs])
        assert mean == pytest.approx(json.loads(outcome.out)["position_rms_mm"], rel=1e-6)
        samples = np.genfromtxt(tmp_path / "mockup-fusion.csv", delimiter=",", names=True)
        late = samples["time_s"] >= 10.0
        apart = np.hypot(samples["x_m"] - samples["true_x_m"], samples["y_m"] - samples["true_y_m"])[late]
        assert 1e3 * math.sqrt(np.mean(apart**2)) == pytest.approx(float(runs[0]["position_rms_mm"]), rel=1e-4)
        fixes = rows_of(tmp_path / "mockup-fixes.csv")
        assert {row["used"] for row in fixes} == {"1"}
        assert all(float(row["arrival_s"]) > float(row["exposure_s"]) for row in fixes)

    def test_files_of_all_methods(self, adcs, tmp_path):
        outcome = adcs("run", "mockup", *SHORT, "--fusion", "all", "--out", tmp_path, "--quiet")
        assert (outcome.status, outcome.err) == (0, "")
        assert_is_picture(tmp_path / "mockup-methods.png")
        methods = [row["fusion"] for row in rows_of(tmp_path / "mockup-methods.csv")]
        assert methods == ["paper", "velocity-corrected", "ekf", "camera", "imu"]


class TestZeros:
    def test_acceptance_of_the_default(self, printed):
        """Section 9, figure 8: at most 3 mm and 0.0005 m/s² with six unknowns; the default has them."""
        result = printed("--part", "zeros")
        assert result.keys() >= ZEROS_KEYS
        assert result["position_rms_mm"] <= 3.0
        assert result["zero_error_m_s2"] <= 0.0005

    def test_unknowns(self, printed):
        short = ("--part", "zeros", "--seeds", "2", "--seed", "4")
        two, six = printed(*short, "--unknowns", "two"), printed(*short, "--unknowns", "six")
        assert six == printed(*short)
        assert six["position_rms_mm"] < two["position_rms_mm"] < two["position_before_rms_mm"]
        sources = printed(*short, "--unknowns", "two", "--start-fixes", "2")
        assert sources["position_rms_mm"] > two["position_rms_mm"]

    def test_text_and_files(self, adcs, tmp_path):
        outcome = adcs("run", "mockup", "--part", "zeros", "--runs", "2", "--out", tmp_path)
        assert outcome.out.startswith("2 runs of 15 s, unknowns six:\n")
        files = {"mockup-zeros.png", "mockup-zeros.csv", "mockup-zeros-runs.csv", "mockup-fixes.csv"}
        assert names_in(tmp_path) == files
        assert_is_picture(tmp_path / "mockup-zeros.png")
        runs = rows_of(tmp_path / "mockup-zeros-runs.csv")
        assert float(runs[0]["zero_x_m_s2"]) == pytest.approx(0.005, abs=0.001)
        samples = np.genfromtxt(tmp_path / "mockup-zeros.csv", delimiter=",", names=True)
        apart = np.hypot(samples["after_x_m"] - samples["true_x_m"], samples["after_y_m"] - samples["true_y_m"])
        assert 1e3 * math.sqrt(np.mean(apart**2)) == pytest.approx(float(runs[0]["after_rms_mm"]), rel=1e-4)


class TestReplay:
    """What the pages show is tested in test_mockup_replay, and in a browser in tests/browser."""

    def test_html(self, adcs, tmp_path):
        page = tmp_path / "drive.html"
        outcome = adcs(
            "run", "mockup", "--part", "fusion", "--seeds", "1", "--duration", "12", "--html", page, "--json"
        )
        assert outcome.status == 0, outcome.err
        assert json.loads(outcome.out).keys() >= FUSION_KEYS
        assert outcome.err == f"adcs: wrote {page}\n"
        assert "Table-top satellite: delayed filter" in page.read_text(encoding="utf-8")

    @pytest.mark.slow
    def test_the_server_runs_until_it_is_interrupted(self):
        command = [sys.executable, "-m", "adcs.cli", "run", "mockup", *SHORT, "--view", "--port", "0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                lines = [process.stdout.readline() for _ in range(7)]
                assert lines[0].startswith("1 run of 20 s")
                address = lines[-1].strip()
                assert address.startswith("http://127.0.0.1:")
                with urllib.request.urlopen(address, timeout=20.0) as answer:
                    assert answer.status == 200
                process.send_signal(signal.SIGINT)
                _, err = process.communicate(timeout=30.0)
            finally:
                process.kill()
        assert process.returncode == 0, err
        assert err.count("\n") == 1
        assert "Ctrl-C ends the viewer" in err


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (
            ("--part", "fusion", "--lost", "0.2"),
            "--lost: found with --part fusion, expected with --part sky or --part all.",
        ),
        (("--part", "zeros", "--fusion", "ekf"), "--fusion: found with --part zeros, expected with"),
        (
            ("--duration", "20"),
            "--duration: found with --part sky, expected with --part fusion or --part zeros or --part all.",
        ),
        (("--lost", "1.5"), "--lost: found 1.5, expected a fraction between 0 and 1."),
        (("--lost", "nan"), "--lost: found nan, expected a fraction between 0 and 1."),
        (("--noise-dn", "-1"), "--noise-dn: found -1, expected 0 or more."),
        (("--speed-m-s", "inf"), "--speed-m-s: found inf, expected 0 or more."),
        (("--footprint-m", "0"), "--footprint-m: found 0, expected 0.01 to 100 m."),
        (("--k1", "-3"), "--k1: k1 must leave each pixel its own place"),
        (("--believed-k1", "nan"), "--believed-k1: k1 must leave each pixel its own place"),
        (("--poses", "0"), "--poses"),
        (("--poses", "1.5"), "found '1.5', expected a whole number"),
        (("--spurious", "-1"), "--spurious"),
        (("--hot-pixels", "400000"), "--hot-pixels: found 400000, expected 0 to 307200, all pixels of the frame."),
        (("--part", "zeros", "--unknowns", "two", "--start-fixes", "60"), "--start-fixes: found 60, expected 2 to "),
        (("--matcher", "best"), "--matcher"),
        (("--seeds", "0"), "--seeds"),
        (("--seed", "-1"), "--seed"),
        (("--frames", "x.png"), "--frames x.png: found no --sky"),
        (("--frames", "x", "--sky", "y", "--poses", "3"), "--poses: found with --frames, expected with"),
        (("--part", "fusion", "--duration", "5"), "--duration: found 5 s, expected more than 10 and up to 10000 s."),
        (("--part", "zeros", "--duration", "nan"), "--duration: found nan s, expected more than 10"),
        (("--part", "fusion", "--false-fixes", "2"), "--false-fixes: found 2, expected a fraction between 0 and 1."),
        (("--part", "fusion", "--delay-s", "11"), "--delay-s: found 11, expected 0 to 10 s"),
        (("--part", "fusion", "--outage", "9", "3"), "--outage: found 9 to 3 s, expected a time and a later one."),
        (("--part", "zeros", "--start-fixes", "3"), "--start-fixes: found without --unknowns two"),
        (("--part", "sky", "--view"), "--view: found with --part sky, expected with --part fusion or all."),
        (("--part", "fusion", "--at", "3"), "--at: found without a replay, expected --view, --html or --png too."),
        (("--part", "fusion", "--port", "3"), "--port: found without a replay, expected --view"),
        (("--part", "fusion", "--html", "x", "--at", "181"), "--at: found 181 s, expected 0 to 180 s."),
        (("--part", "fusion", "--html", "x", "--view"), "--view: found with --html or --png, expected one"),
        (("--part", "fusion", "--png", "x", "--fusion", "all"), "--png: found with --fusion all, expected one"),
        (("--part", "fusion", "--view", "--json"), "--view: found with --json, expected one or the other"),
        (("--part", "fusion", "--html", "no/such/folder/x"), "--html no/such/folder/x: found no folder"),
    ],
)  # fmt: skip
def test_bad_options(adcs, arguments, sentence):
    assert_refused(adcs("run", "mockup", *arguments), sentence)


def test_a_file_in_place_of_the_folder(adcs, tmp_path):
    (tmp_path / "out").write_text("")
    for part in ("sky", "fusion", "zeros"):
        outcome = adcs("run", "mockup", "--part", part, "--out", tmp_path / "out")
        assert_refused(outcome, "found a file, expected a folder")


def test_every_option_has_its_own_help(adcs):
    """What a group of options is called is not the help of one of them."""
    text = adcs("run", "mockup", "--help").out
    assert "What is run." not in text
    assert text.count("CSV file") == 2
