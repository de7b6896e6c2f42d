"""``magloc bounds``, as a user types it."""

from __future__ import annotations

import json
import re
from functools import partial, partialmethod

import numpy as np
import pytest
import xarray as xr
from PIL import Image

from arrays.array import SensorArray
from arrays.array_file import write_array
from arrays.geometries import grid, tetrahedron
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.cli.app import main
from magloc.grids.store import Sweep, open_map
from magloc.plots import style
from tests.command_line import assert_refused

KEYS = [
    "position_m",
    "moment_Am2",
    "range_m",
    "rank",
    "sigma_position_m",
    "sigma_moment_Am2",
    "sigma_range_m",
    "sigma_bearing_deg",
    "over_moments",
    "accuracy_m",
    "accuracy_range_m",
    "detection",
    "detection_range_m",
    "grid",
    "moments",
    "points",
    "accurate_fraction",
    "seconds",
    "out",
]
SPREAD = ["mean", "median", "q95", "worst_sampled"]
QUICK = ["--grid", "3", "--moments", "5"]
PNG = b"\x89PNG"


def run_json(*arguments, capsys):
    assert main(["bounds", *map(str, arguments), *QUICK, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.fixture
def coarse(monkeypatch):
    """Slices and spheres of few points, and little noise for thresholds and probabilities of detection."""
    from magloc.detection.matched_filter import MatchedFilterDetector

    rough = partial(MatchedFilterDetector.of, false_alarm_rate=1e-2, n_draws=2_000)
    required = partialmethod(MatchedFilterDetector.required_energy, n_draws=200)
    monkeypatch.setattr(MatchedFilterDetector, "of", lambda array, *_, **__: rough(array))
    monkeypatch.setattr(MatchedFilterDetector, "required_energy", required)
    for name, value in (("_SLICE_GRID", 15), ("_STEP_DEG", 30.0), ("_FRAMES", 3)):
        monkeypatch.setattr(f"magloc.cli.bounds.{name}", value)


@pytest.fixture
def plain_pictures(coarse, monkeypatch):
    """Pictures without contents, which take no time."""
    for name in ("bound_slices", "bound_sphere", "bound_reach"):
        monkeypatch.setattr(f"magloc.plots.{name}", lambda *_: style.new_figure(1.0))


with_plain_pictures = pytest.mark.usefixtures("plain_pictures")


class TestResult:
    @with_plain_pictures
    def test_json_of_the_reference_problem(self, tmp_path, capsys):
        result = run_json("--moment-Am2", 0, 0, 100, "--out", tmp_path / "out", capsys=capsys)
        assert list(result) == KEYS
        assert np.round(result["sigma_position_m"], 3).tolist() == [0.289, 0.082, 0.076]
        assert np.round(result["sigma_moment_Am2"], 1).tolist()[1:] == [1.7, 23.6]
        direct = cramer_rao_bounds(tetrahedron(1.5), (5.0, 0.0, 0.306), (0.0, 0.0, 100.0))
        assert result["sigma_range_m"] == pytest.approx(float(direct.sigma_range_m))
        assert result["sigma_bearing_deg"] == pytest.approx(float(np.degrees(direct.sigma_bearing_rad)))
        assert result["rank"] == 6
        assert (result["grid"], result["moments"], result["points"]) == (3, 5, 26)  # the centroid has no bound
        for spread in result["over_moments"].values():
            assert list(spread) == SPREAD
            assert spread["median"] <= spread["q95"] <= spread["worst_sampled"]
        assert list(result["accuracy_range_m"]) == ["moment", *SPREAD[1:]]
        for reach in result["accuracy_range_m"].values():
            assert 0.0 < reach["least"] <= reach["median"] <= reach["greatest"] < 10.0
        assert result["detection"]["probability"] == 0.9
        for reach, found in zip(result["accuracy_range_m"].values(), result["detection_range_m"].values(), strict=True):
            assert found["least"] > reach["least"]  # a source is found farther away than its range is known

    @pytest.mark.usefixtures("coarse")
    def test_files_and_table(self, tmp_path, capsys):
        out = tmp_path / "out"
        assert main(["bounds", "wide", *QUICK, "--gif", "--out", str(out), "--quiet"]) == 0
        names = sorted(path.name for path in out.iterdir())
        assert names == [
            "bounds-reach.png",
            "bounds-slices.png",
            "bounds-sphere.png",
            "bounds.gif",
            "map.zarr",
            "slices.nc",
            "spheres.nc",
        ]
        assert all((out / name).read_bytes().startswith(PNG) for name in names[:3])
        with Image.open(out / "bounds.gif") as picture:
            assert picture.format == "GIF"
            assert picture.n_frames == 3
        with xr.open_dataset(out / "spheres.nc") as spheres, xr.open_dataset(out / "slices.nc") as slices:
            assert spheres.sizes["range"] == 3  # the middle one is that of the picture
            assert slices.sizes["plane"] == 3
            assert float(slices.across.max()) == pytest.approx(2.0 * np.hypot(5.0, 0.306))
        with open_map(out / "map.zarr") as cube:
            assert cube.sizes == {"x": 3, "y": 3, "z": 3}
        text, err = capsys.readouterr()
        assert err == ""
        assert re.search(r"position \[m\] +0\.1335 +0\.2297 +0\.2543", text)
        assert re.search(r"σ of range ≤ 0.5 m up to +least +median +greatest", text)
        assert re.search(r"found with 90 % up to +least +median +greatest", text)

    @pytest.mark.slow
    @with_plain_pictures
    def test_a_body_is_taken_as_locate_takes_it(self, tmp_path, capsys):
        array = tmp_path / "board.toml"
        board, place, moment = grid(6, 5, 0.1), (0.02, 0.03, 0.05), (0.1, 0.0, 0.2)
        near_m = 0.25 * np.linalg.norm(board.positions - place, axis=1).min()
        write_array(array, board)
        command = ["--array", array, "--position", *place, "--moment-Am2", *moment]
        for i, (options, length_m) in enumerate(
            (([], near_m), (["--body-length-m", 0.05], 0.05), (["--body-length-m", 0], 0))
        ):
            result = run_json(*command, *options, "--out", tmp_path / str(i), capsys=capsys)
            assert result.get("body_length_m", 0.0) == pytest.approx(length_m)
            expected = cramer_rao_bounds(board, place, moment, body_length_m=length_m)
            assert result["sigma_range_m"] == pytest.approx(float(expected.sigma_range_m), rel=1e-9)
            with open_map(tmp_path / str(i) / "map.zarr") as cube:
                assert ("body_length_m" in cube.attrs) == bool(options)
        assert main(["bounds", *QUICK, "--body-length-m", "-1", "--out", str(tmp_path / "no")]) == 2
        assert "--body-length-m: found -1, expected from 0 to 10000 m" in capsys.readouterr().err

    @with_plain_pictures
    def test_the_same_again_computes_nothing_anew_and_something_else_is_refused(self, tmp_path, capsys):
        first = run_json("--out", tmp_path, capsys=capsys)
        again = run_json("--out", tmp_path, capsys=capsys)
        assert first == again  # the seconds too
        assert main(["bounds", *QUICK, "--accuracy-m", "1", "--out", str(tmp_path)]) == 2
        assert "found another map, with accuracy_m 0.5 instead of 1.0" in capsys.readouterr().err

    @pytest.mark.slow
    @with_plain_pictures
    def test_default_folder(self, tmp_path, capsys, monkeypatch):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "mine.toml").write_text('geometry = "cube"\nedge_m = 1.0\nkind = "vector"\nnoise_nT = 1.0\n')
        for options in ([], ["--array", "mine.toml"], ["--moment-Am2", "0", "-0.5", "3"]):
            assert main(["bounds", *QUICK, "--quiet", *options]) == 0
        found = {path.name for path in tmp_path.iterdir()}
        assert found == {"bounds-wide-3", "bounds-mine-3", "bounds-wide-3-0_-0.5_3", "mine.toml"}


class TestArrays:
    @pytest.mark.slow
    @pytest.mark.usefixtures("coarse")
    def test_too_few_sensors_are_said_to_be_too_few(self, tmp_path, capsys):
        array = tmp_path / "four.toml"
        array.write_text(
            'geometry = "tetrahedron"\nedge_m = 1.5\nkind = "scalar"\nnoise_nT = 0.01\nambient_nT = [2e4, 0, 4e4]\n'
        )
        options = ["--array", array, "--out", tmp_path / "out"]
        result = run_json(*options, capsys=capsys)
        assert result["rank"] == 3
        assert result["sigma_range_m"] is None
        assert result["over_moments"]["sigma_range_m"]["median"] is None
        assert result["accuracy_range_m"]["median"]["greatest"] == 0.0
        assert result["detection"] is result["detection_range_m"] is None
        assert main(["bounds", *map(str, options), *QUICK]) == 0
        out, err = capsys.readouterr()
        assert "Only 3 of the six combinations" in out
        assert "no detection range: array must give at least 6 independent differences" in err

    @with_plain_pictures
    def test_scalar_sensors_without_an_ambient_field_are_warned_of(self, tmp_path, capsys):
        array = tmp_path / "eight.toml"
        array.write_text('geometry = "cube"\nedge_m = 1.5\nkind = "scalar"\nnoise_nT = 0.01\n')
        assert main(["bounds", *QUICK, "--array", str(array), "--out", str(tmp_path / "out"), "--json"]) == 0
        assert "no ambient_nT" in capsys.readouterr().err

    @with_plain_pictures
    def test_an_uncertain_ambient_field_makes_bounds_larger(self, tmp_path, capsys):
        array = tmp_path / "eight.toml"
        array.write_text(
            'geometry = "cube"\nedge_m = 1.5\nkind = "scalar"\nnoise_nT = 0.01\nambient_nT = [2e4, 0, 4e4]\n'
        )
        known, uncertain = (
            run_json(
                "--array",
                array,
                "--ambient-uncertainty-nT",
                value,
                "--position",
                3,
                2,
                1.5,
                "--moment-Am2",
                50,
                60,
                70,
                "--out",
                tmp_path / str(value),
                capsys=capsys,
            )
            for value in (0, 300)
        )
        assert uncertain["sigma_range_m"] > known["sigma_range_m"]

    @with_plain_pictures
    def test_position_and_range(self, tmp_path, capsys):
        result = run_json(
            "--position", 0, -3, 1, "--range-m", 2.5, "--half-width-m", 4, "--out", tmp_path, capsys=capsys
        )
        assert result["position_m"] == [0.0, -3.0, 1.0]
        with xr.open_dataset(tmp_path / "spheres.nc") as spheres:
            assert spheres.range.to_numpy().tolist() == [2.5]
        with open_map(tmp_path / "map.zarr") as cube:
            assert cube.x.to_numpy().tolist() == [-4.0, 0.0, 4.0]


class TestBadInput:
    @pytest.mark.parametrize(
        ("options", "expected"),
        [
            (["nowhere.toml"], "nowhere.toml"),
            (["--array", "nowhere.toml"], "nowhere.toml"),
            (
                ["--moment-Am2", "0", "0", "0"],
                "--moment-Am2: found (0, 0, 0), expected three finite numbers, not all zero",
            ),
            (["--moment-Am2", "1e300", "0", "0"], "--moment-Am2: found (1e+300, 0, 0), expected"),
            (["--moment-Am2", "1", "2"], "--moment-Am2"),
            (["--moment-Am2", "nan", "0", "0"], "--moment-Am2"),
            (["--position", "0", "0", "0"], "--position: found (0, 0, 0), the sensors' centroid"),
            (["--position", "0", "0", "0", "--range-m", "2"], "--position: found (0, 0, 0), the sensors' centroid"),
            (["--position", "0", "0", "0.91855865"], "--position: found (0, 0, 0.918559), at sensor s4"),
            (["--position", "1e10", "0", "0"], "--position: found (1e+10, 0, 0), expected a place within 9.19e+05 m"),
            (["--range-m", "1e10"], "--range-m: found 1e+10, expected 9.19e-05 to 9.19e+05 m"),
            (["--range-m", "1e-12"], "--range-m: found 1e-12, expected 9.19e-05 to 9.19e+05 m"),
            (["--position", "inf", "0", "0"], "--position: found (inf, 0, 0), expected three finite numbers"),
            (["--range-m", "0"], "--range-m: found 0, expected a positive length"),
            (["--range-m", "nan"], "--range-m: found nan, expected a positive length"),
            (["--accuracy-m", "-1"], "--accuracy-m: found -1, expected a positive length"),
            (["--half-width-m", "inf"], "--half-width-m: found inf, expected a positive length"),
            (["--ambient-uncertainty-nT", "-1"], "--ambient-uncertainty-nT: found -1, expected zero or more"),
            (["--probability", "1"], "--probability: found 1, expected more than the false-alarm rate and less than 1"),
            (["--false-alarm-rate", "0"], "--false-alarm-rate: found 0, expected 0.0001 or more"),
            (["--grid", "1"], "--grid"),
            (["--grid", "2.5"], "--grid"),
            (["--grid", "100000"], "--grid"),
            (["--moments", "0"], "--moments"),
            (["--moments", "10000000"], "--moments"),
            (["--nonsense"], "--nonsense"),
        ],
    )
    def test_is_one_line_and_writes_nothing(self, options, expected, tmp_path, run, monkeypatch):
        monkeypatch.chdir(tmp_path)
        outcome = run("bounds", *options, "--out", tmp_path / "out")
        assert outcome.out == ""
        assert_refused(outcome, expected)
        assert not list(tmp_path.iterdir())

    def test_a_sensor_alone_knows_no_place(self, tmp_path, run):
        path = tmp_path / "one.toml"
        write_array(path, SensorArray(tetrahedron(1.0).sensors[:1], common_field_T=1e-9))
        outcome = run("bounds", "--array", path, "--out", tmp_path / "out")
        assert_refused(outcome, "received 1, which cannot locate a source: magloc locate --position")

    @with_plain_pictures
    def test_an_interruption_says_what_is_done(self, tmp_path, capsys, monkeypatch):
        def interrupted(*_):
            raise KeyboardInterrupt

        monkeypatch.setattr(Sweep, "write", interrupted)
        assert main(["bounds", *QUICK, "--out", str(tmp_path)]) == 130
        assert "0 of 1 chunks are done, the same command goes on" in capsys.readouterr().err

    def test_a_file_in_place_of_the_folder(self, tmp_path, run):
        path = tmp_path / "file"
        path.write_text("mine")
        assert_refused(run("bounds", *QUICK, "--out", path), "found a file, expected a folder")
        assert path.read_text() == "mine"
