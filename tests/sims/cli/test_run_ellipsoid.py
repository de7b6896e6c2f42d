"""Tests of ``adcs run ellipsoid``: what it prints and writes, and what it refuses."""

import csv
import json
import math

import numpy as np
import pytest
from matplotlib import image

from arrays.io.errors import InputError
from sims.cli.run_ellipsoid import EllipsoidOptions, run_ellipsoid, summary_lines
from tests.adcs.refusals import assert_refused

KEYS = [
    "final_error_mean_deg",
    "final_error_p95_deg",
    "final_error_max_deg",
    "half_width_mean_deg",
    "containment_violations",
    "steps",
    "resets_mean",
]


class TestResult:
    def test_keys_and_types(self):
        result = run_ellipsoid(EllipsoidOptions(seeds=5, duration=400.0))
        assert list(result) == KEYS
        assert result["steps"] == 5 * 200
        assert json.loads(json.dumps(result)) == result

    def test_prototype(self):
        """The table of section 6: 1.77 / 2.82 / 3.49 and 4.3; 300 runs, seeds 0 to 299."""
        result = run_ellipsoid(EllipsoidOptions())
        assert result["final_error_mean_deg"] == pytest.approx(1.77, abs=0.1)
        assert result["final_error_p95_deg"] == pytest.approx(2.82, abs=0.2)
        assert result["half_width_mean_deg"] == pytest.approx(4.3, abs=0.1)
        assert (result["containment_violations"], result["resets_mean"]) == (0, 0.0)
        assert result["steps"] == 300 * 2839

    def test_same_seed_same_result_and_runs_are_counted_from_it(self):
        options = {"duration": 300.0, "step": "lemma"}
        whole = run_ellipsoid(EllipsoidOptions(seeds=4, seed=10, **options))
        assert run_ellipsoid(EllipsoidOptions(seeds=4, seed=10, **options)) == whole
        parts = [run_ellipsoid(EllipsoidOptions(seeds=2, seed=seed, **options)) for seed in (10, 12)]
        mean = np.mean([part["final_error_mean_deg"] for part in parts])
        assert mean == pytest.approx(whole["final_error_mean_deg"], rel=1e-12)

    def test_many_runs_in_parts(self):
        """More runs than are held at once, and the progress of them."""
        finished = []
        result = run_ellipsoid(EllipsoidOptions(seeds=501, duration=20.0), progress=finished.append)
        assert finished == [500, 1]
        assert result["steps"] == 5010

    def test_jump(self):
        result = run_ellipsoid(EllipsoidOptions(jump=True, seeds=100))
        assert 1.0 <= result["resets_mean"] <= 5.0
        assert result["containment_violations"] <= 0.01 * result["steps"]

    @pytest.mark.parametrize("jump", [False, True])
    def test_closed_loop(self, jump):
        result = run_ellipsoid(EllipsoidOptions(closed_loop=True, jump=jump, seeds=5))
        assert result["final_error_max_deg"] <= result["half_width_mean_deg"]
        assert (result["resets_mean"] > 0.0) == jump

    def test_text(self):
        options = EllipsoidOptions(seeds=3, duration=200.0)
        lines = summary_lines(options, run_ellipsoid(options))
        assert lines[0] == "3 runs of 200 s"
        assert any("0 of 300 steps" in line for line in lines)


class TestCommand:
    def test_json(self, adcs):
        arguments = ("--json", "--runs", "3", "--seed", "7", "--duration", "200", "--noise-deg", "4")
        more = ("--drift-deg-s", "0.0001", "--step", "lemma", "--closed-loop")
        _, out, err = adcs("run", "ellipsoid", *arguments, *more)
        options = EllipsoidOptions(4.0, 0.0001, "lemma", closed_loop=True, seeds=3, seed=7, duration=200.0)
        assert json.loads(out) == run_ellipsoid(options)
        assert err == ""

    def test_text_and_files(self, adcs, tmp_path):
        command = ("run", "ellipsoid", "--seeds", "2", "--duration", "100", "--out", tmp_path)
        _, out, err = adcs(*command)
        assert len(out.splitlines()) == 5
        assert "wrote ellipsoid.png" in err
        assert (
            adcs("run", "ellipsoid", "--seeds", "2", "--duration", "100", "--out", str(tmp_path), "--quiet").err == ""
        )

    @pytest.mark.parametrize(("option", "value"), [("--step", "best"), ("--seed", "-1"), ("--seeds", "0")])
    def test_a_value_that_is_none(self, adcs, option, value):
        assert_refused(adcs("run", "ellipsoid", option, value), option)


class TestFiles:
    @pytest.mark.slow
    @pytest.mark.parametrize("closed_loop", [True, pytest.param(False, marks=pytest.mark.slow)])
    def test_picture_and_data(self, tmp_path, closed_loop):
        options = EllipsoidOptions(seeds=3, duration=400.0, closed_loop=closed_loop)
        result = run_ellipsoid(options, tmp_path / "new" / "folder")
        folder = tmp_path / "new" / "folder"
        assert sorted(path.name for path in folder.iterdir()) == [
            "ellipsoid-runs.csv",
            "ellipsoid.csv",
            "ellipsoid.png",
        ]
        picture = image.imread(folder / "ellipsoid.png")
        assert picture.shape[0] > 800
        assert len(np.unique(picture[..., :3].reshape(-1, 3), axis=0)) > 100
        with (folder / "ellipsoid-runs.csv").open() as file:
            runs = list(csv.DictReader(file))
        assert [row["seed"] for row in runs] == ["0", "1", "2"]
        errors = [float(row["final_error_deg"]) for row in runs]
        assert np.mean(errors) == pytest.approx(result["final_error_mean_deg"], rel=1e-6)
        with (folder / "ellipsoid.csv").open() as file:
            steps = list(csv.DictReader(file))
        assert [float(row["time_s"]) for row in steps] == list(range(0, 402, 2))
        last = steps[-1]
        assert abs(float(last["yaw_deg"]) - float(last["true_yaw_deg"])) == pytest.approx(errors[0], rel=1e-4)
        assert math.sqrt(float(steps[0]["shape_yaw_yaw_deg2"])) == pytest.approx(3.0)

    def test_a_file_in_place_of_the_folder(self, tmp_path):
        (tmp_path / "out").write_text("")
        with pytest.raises(InputError, match="found a file, expected a folder"):
            run_ellipsoid(EllipsoidOptions(seeds=1, duration=20.0), tmp_path / "out")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"noise_deg": 0.0}, "--noise-deg: found 0, expected 1e-09 or more."),
        ({"noise_deg": 1e308}, "--noise-deg: found 1e.308, expected 1e-09 or more."),
        ({"drift_deg_s": 1e308}, "--drift-deg-s: found 1e.308, expected 1e-09 or more."),
        ({"noise_deg": -1.0}, "--noise-deg: found -1, expected 1e-09 or more."),
        ({"noise_deg": math.nan}, "--noise-deg: found nan, expected 1e-09 or more."),
        ({"drift_deg_s": 0.0}, "--drift-deg-s: found 0, expected 1e-09 or more."),
        ({"duration": 1.0}, "--duration: found 1 s, expected 2 to 1e7 s."),
        ({"jump": True, "duration": 1000.0}, "--duration: found 1000 s, expected more than the 2000 s of --jump."),
    ],
)
def test_bad_input(options, sentence):
    with pytest.raises(InputError, match=sentence):
        run_ellipsoid(EllipsoidOptions(**options))
