"""Tests of ``adcs run complementary``: what it prints and writes, and what it refuses."""

import csv
import json
import math

import numpy as np
import pytest
from matplotlib import image

from arrays.io.errors import InputError
from sims.cli.run_complementary import ComplementaryOptions, run_complementary, summary_lines
from tests.adcs.refusals import assert_refused

KEYS = ["rms_deg", "steady_rms_deg", "peak_deg", "outage_max_deg"]


class TestResult:
    @pytest.mark.parametrize("name", ["explicit", "gauss-newton"])
    def test_best_gains(self, name):
        result = run_complementary(ComplementaryOptions(name, kp=0.02, ki=1e-4))
        assert list(result) == KEYS
        assert json.loads(json.dumps(result)) == result
        assert result["rms_deg"] <= 0.25
        assert result["peak_deg"] <= 1.6
        assert result["outage_max_deg"] is None
        assert run_complementary(ComplementaryOptions(name)) == result

    def test_adaptive(self):
        result = run_complementary(ComplementaryOptions("adaptive", seeds=2))
        assert result["rms_deg"] <= 0.06
        assert result["peak_deg"] <= 1.1
        outage = run_complementary(ComplementaryOptions("adaptive", outage="magnetometer-only"))
        assert max(outage["outage_max_deg"]) <= 0.1

    @pytest.mark.parametrize("rule", ["transported", "magnetometer-only"])
    def test_outage(self, rule):
        result = run_complementary(ComplementaryOptions(outage=rule, kp=0.005))
        assert max(result["outage_max_deg"]) <= 0.8
        assert run_complementary(ComplementaryOptions(outage=rule)) == result

    def test_outage_with_raw_delay_is_the_median(self):
        alone = [run_complementary(ComplementaryOptions(outage="raw", kp=0.01, seed=seed)) for seed in range(3)]
        together = run_complementary(ComplementaryOptions(outage="raw", kp=0.01, seeds=3))
        np.testing.assert_allclose(together["outage_max_deg"], np.median([r["outage_max_deg"] for r in alone], axis=0))
        assert together["rms_deg"] == pytest.approx(np.mean([r["rms_deg"] for r in alone]))

    def test_a_short_run_has_no_peak(self):
        options = ComplementaryOptions(duration=4000.0)
        result = run_complementary(options)
        assert result["peak_deg"] is None
        assert any("none" in line for line in summary_lines(options, result))

    def test_many_runs_in_parts(self):
        """More runs than are held at once, and the progress of them."""
        finished = []
        parts = run_complementary(ComplementaryOptions(seeds=21, duration=3000.0), progress=finished.append)
        assert finished == [20, 1]
        alone = [run_complementary(ComplementaryOptions(seed=s, duration=3000.0))["rms_deg"] for s in range(21)]
        assert parts["rms_deg"] == pytest.approx(np.mean(alone), rel=1e-12)

    def test_gains_of_an_outage(self):
        assert ComplementaryOptions(outage="raw", kp=0.001).gains.ki_per_s2 == 2e-6
        assert ComplementaryOptions(outage="raw", kp=0.01).gains.ki_per_s2 == pytest.approx(2.5e-5)
        assert ComplementaryOptions(outage="raw").gains.outage_ki_per_s2 == 0.0


class TestCommand:
    def test_json(self, adcs):
        arguments = ("--json", "--filter", "gauss-newton", "--kp", "0.01", "--ki", "1e-5", "--sigma-nT", "500")
        more = ("--runs", "2", "--seed", "3", "--amplitude-deg", "8", "--outage", "transported")
        _, out, err = adcs("run", "complementary", *arguments, *more)
        options = ComplementaryOptions("gauss-newton", 0.01, 1e-5, 500.0, "transported", 8.0, seeds=2, seed=3)
        assert json.loads(out) == run_complementary(options)
        assert err == ""

    def test_text_and_files(self, adcs, tmp_path):
        _, out, err = adcs("run", "complementary", "--duration", "3000", "--out", str(tmp_path))
        assert out.startswith("explicit filter, K_P 1/(50 s), K_I 1/(100 s)²\nmagnetometer 1000 nT")
        assert "wrote complementary.png" in err
        assert adcs("run", "complementary", "--duration", "3000", "--out", str(tmp_path), "--quiet").err == ""

    def test_a_gain_close_to_the_limit(self, adcs):
        err = adcs("run", "complementary", "--duration", "3000", "--kp", "0.95", "--ki", "0").err
        assert err == (
            "adcs: warning: K_P = 0.95 1/s is close to 1 1/s, where a filter with steps of 1 s becomes unstable: it "
            "amplifies noise.\n"
        )

    @pytest.mark.parametrize("arguments", [("--filter", "best"), ("--outage", "sun")])
    def test_unknown_names(self, adcs, arguments):
        assert_refused(adcs("run", "complementary", *arguments), arguments[0])


class TestFiles:
    @pytest.mark.slow
    @pytest.mark.parametrize("outage", ["raw", pytest.param(None, marks=pytest.mark.slow)])
    def test_picture_and_data(self, tmp_path, outage):
        options = ComplementaryOptions(seeds=2, outage=outage)
        result = run_complementary(options, tmp_path / "new")
        assert sorted(path.name for path in (tmp_path / "new").iterdir()) == [
            "complementary-runs.csv",
            "complementary.csv",
            "complementary.png",
        ]
        picture = image.imread(tmp_path / "new" / "complementary.png")
        assert picture.shape[0] > 800
        assert len(np.unique(picture[..., :3].reshape(-1, 3), axis=0)) > 100
        with (tmp_path / "new" / "complementary-runs.csv").open() as file:
            runs = list(csv.DictReader(file))
        assert [row["seed"] for row in runs] == ["0", "1"]
        assert np.mean([float(row["rms_deg"]) for row in runs]) == pytest.approx(result["rms_deg"], rel=1e-6)
        assert (runs[0]["outage_max_yaw_deg"] == "") == (outage is None)
        table = np.genfromtxt(tmp_path / "new" / "complementary.csv", delimiter=",", names=True)
        used = (table["orbits"] >= 0.5) & (table["orbits"] < 3.0)
        errors = np.stack([table[f"explicit_{axis}_deg"][used] for axis in ("roll", "pitch", "yaw")])
        assert math.sqrt(np.mean(errors**2)) == pytest.approx(float(runs[0]["rms_deg"]), rel=1e-6)

    def test_a_file_in_place_of_the_folder(self, tmp_path):
        (tmp_path / "out").write_text("")
        with pytest.raises(InputError, match="found a file, expected a folder"):
            run_complementary(ComplementaryOptions(), tmp_path / "out")


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ({"kp": 1.01}, "--kp: found 1.01 1/s, expected 1 1/s at most: with steps of 1 s the filter becomes unstable"),
        ({"kp": -0.1}, "--kp: found -0.1, expected 0 or more."),
        ({"ki": math.nan}, "--ki: found nan, expected 0 or more."),
        ({"ki": math.inf}, "--ki: found inf, expected 0 or more."),
        ({"filter": "adaptive", "kp": 0.1}, "--kp: found 0.1, expected no gain: --filter adaptive has none."),
        ({"sigma_nT": 0.0}, "--sigma-nT: found 0, expected a positive number."),
        ({"amplitude_deg": 90.0}, "--amplitude-deg: found 90, expected 0 to less than 90."),
        ({"duration": 100.0}, "--duration: found 100 s, expected 29"),
        ({"duration": math.nan}, "--duration: found nan s, expected 29"),
        ({"duration": 8000.0, "outage": "raw"}, "--duration: found 8000 s, expected 117"),
    ],
)
def test_bad_options(options, sentence):
    with pytest.raises(InputError, match=sentence.replace(".", r"\.")):
        run_complementary(ComplementaryOptions(**options))
