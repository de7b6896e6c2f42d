"""``adcs run`` of satellites with Kalman filters and ``adcs compare``: numbers, files, warnings, refusals.

Limits are those of the acceptance table for ten seeds, 0 to 9, which were not chosen.
"""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest
import xarray as xr
from matplotlib import image

from adcs import quaternion
from adcs.io.scenario_files import read_scenario, scenario_text
from sims.experiments.attitude import parts_of, run_scenario
from tests.adcs.refusals import assert_refused
from tests.command_line import refuse_constant

KEYS = [
    "angle_rms_deg",
    "rate_rms_deg_s",
    "gyro_bias_rms_deg_s",
    "field_bias_rms_nT",
    "disturbance_rms_s2",
    "field_model_rms_nT",
    "dipole_error_Am2",
    "field_gain_rms_percent",
    "nees_per_dimension",
    "diverged_runs",
    "runs",
    "worst_deg",
    "rejected",
    "rejected_good",
    "tuned_disturbance_s2",
    "unseen_torque_100s_Nm",
    "unseen_torque_300s_Nm",
    "unseen_torque_1000s_Nm",
]


def numbers(outcome):
    assert outcome.status == 0, outcome.err
    found = json.loads(outcome.out, parse_constant=refuse_constant)
    assert list(found) == KEYS
    return found


class TestNumbers:
    def test_keys_and_nulls(self, adcs):
        found = numbers(adcs("run", "tabletsat", "--json", "--seeds", "2", "--sensors", "st"))
        assert [key for key in KEYS if found[key] is None] == [*KEYS[2:8], "worst_deg", "tuned_disturbance_s2"]
        assert (found["runs"], found["diverged_runs"]) == (2, 0)

    def test_text_tells_every_number_that_there_is(self, adcs):
        arguments = ("run", "tabletsat", "--seeds", "1", "--sensors", "st+gyro", "--states", "gyro-bias")
        found, text = numbers(adcs(*arguments, "--json")), adcs(*arguments).out
        for key in ("angle_rms_deg", "rate_rms_deg_s", "gyro_bias_rms_deg_s"):
            assert f"{found[key]:.3g} °" in text

    def test_runs_is_seeds_and_they_count_from_seed(self, adcs):
        def angle(*arguments):
            return numbers(adcs("run", "tabletsat", "--json", "--sensors", "st", *arguments))["rate_rms_deg_s"]

        assert angle("--runs", "2", "--seed", "4") == angle("--seeds", "2", "--seed", "4")
        assert angle("--seeds", "1", "--seed", "4") != angle("--seeds", "1", "--seed", "5")

    def test_order_of_names_does_not_matter(self, adcs):
        first = adcs("run", "tabletsat", "--json", "--seeds", "1", "--sensors", "sun+gyro+mag")
        second = adcs("run", "tabletsat", "--json", "--seeds", "1", "--sensors", "mag+sun+gyro", "--threads", "1")
        assert first.out == second.out

    @pytest.mark.parametrize(
        ("arguments", "most"),
        [
            ("st --star-noise paper", {"angle_rms_deg": 1.9e-3, "rate_rms_deg_s": 1.1e-3}),
            # Twice what the source's table has.
            ("mag+sun+gyro --states gyro-bias --process-noise paper --duration 300", {"gyro_bias_rms_deg_s": 1e-3}),
            (
                "st --filter parallel-disturbance --states disturbance",
                {"angle_rms_deg": 6e-4, "rate_rms_deg_s": 3e-5, "disturbance_rms_s2": 1e-8},
            ),
            ("mag+sun+gyro --filter smoother", {"angle_rms_deg": 4e-2}),
            ("mag+sun+gyro --start any", {"angle_rms_deg": 4e-2}),
            ("mag+sun+gyro --start vectors", {"angle_rms_deg": 4e-2}),
        ],
    )
    def test_acceptance(self, adcs, arguments, most):
        """Those of the plain sets are in tests/adcs/kalman: test_mekf, variants."""
        found = numbers(adcs("run", "tabletsat", "--json", "--quiet", "--sensors", *arguments.split()))
        assert found["diverged_runs"] == 0
        for key, limit in most.items():
            assert found[key] <= limit, key

    def test_paper_jacobian_is_overconfident(self, adcs):
        """closed_loop_F takes the feedback for dynamics: with two vectors the spec's NEES rose from 3/6 to 49/6."""
        arguments = ("run", "tabletsat", "--json", "--quiet", "--sensors", "mag+sun", "--seeds", "3")
        ours, theirs = numbers(adcs(*arguments)), numbers(adcs(*arguments, "--closed-loop-F"))
        assert theirs["nees_per_dimension"] > 3.0 * ours["nees_per_dimension"]
        assert theirs["angle_rms_deg"] > 1.5 * ours["angle_rms_deg"]

    def test_agree_with_the_library(self):
        """What is put together from parts of the runs is what the library says of all of them."""
        file = read_scenario("tabletsat").changed({"estimate": {"sensors": "st+gyro", "states": ["gyro-bias"]}})
        estimate = file.estimator("x")
        (part,) = parts_of(file, estimate, range(3))
        runs, estimates = part.runs, part.estimates
        late, true_bias = slice(-60, None), runs.prepared.gyro_bias_rad_s
        angle = 2.0 * quaternion.error_vector(estimates.q, runs.q)
        differences = angle, runs.w - estimates.w, true_bias - estimates.optional["gyro-bias"]
        worst = [np.degrees(np.sqrt(np.mean(one[:, late] ** 2, axis=1)).mean(axis=0).max()) for one in differences]
        whole = np.concatenate([0.5 * angle, *differences[1:]], axis=-1)[:, late, :, None]
        nees = (whole.mT @ np.linalg.inv(estimates.covariance[:, late]) @ whole).mean() / 9.0
        frequency = 2.0 * np.pi / np.array([100.0, 300.0, 1000.0])
        star, gyro = 2.0 * runs.satellite.star_tracker.sigma_rad, runs.satellite.gyro.sigma_rad_s
        largest = np.linalg.eigvalsh(runs.satellite.body.inertia_kgm2)[-1]
        unseen = 0.7 * largest * frequency**2 / np.sqrt(star**-2 + (frequency / gyro) ** 2)
        expected = {
            "angle_rms_deg": worst[0],
            "rate_rms_deg_s": worst[1],
            "gyro_bias_rms_deg_s": worst[2],
            "field_bias_rms_nT": None,
            "disturbance_rms_s2": None,
            "field_model_rms_nT": None,
            "dipole_error_Am2": None,
            "field_gain_rms_percent": None,
            "nees_per_dimension": nees,
            "diverged_runs": 0,
            "runs": 3,
            "worst_deg": None,
            "rejected": 0,
            "rejected_good": 0,
            "tuned_disturbance_s2": None,
            "unseen_torque_100s_Nm": unseen[0],
            "unseen_torque_300s_Nm": unseen[1],
            "unseen_torque_1000s_Nm": unseen[2],
        }
        found = run_scenario(file, estimate, range(3)).numbers()
        assert list(found) == list(expected)
        for key, value in expected.items():
            assert found[key] == (value if value is None else pytest.approx(value)), key

    def test_the_last_minute_alone_has_the_same_numbers(self):
        file = read_scenario("tabletsat").changed({"duration_s": 150.0})
        estimate = file.estimator("tabletsat")
        whole, late = (run_scenario(file, estimate, range(2), through_time=kept) for kept in (True, False))
        expected, found = ({k: v for k, v in one.numbers().items() if v is not None} for one in (whole, late))
        assert found == pytest.approx(expected, rel=1e-12)
        np.testing.assert_array_equal(late.nis, whole.nis[:, whole.late])
        assert late.nis.base is None  # what is not kept is let go
        assert late.nees.shape == late.error_deg.shape == (2, 60)

    def test_parts_do_not_change_the_result(self, monkeypatch):
        from sims.experiments import attitude as attitude_runs

        file = read_scenario("field-error")
        estimate = file.estimator("x")
        whole = run_scenario(file, estimate, range(3))
        monkeypatch.setattr(attitude_runs, "_NUMBERS_AT_ONCE", 1)
        finished = []
        parts = run_scenario(file, estimate, range(3), advance=finished.append)
        assert finished == [1, 1, 1]
        assert parts.numbers() == pytest.approx(whole.numbers())
        assert parts.warning_lines() == whole.warning_lines()


class TestNamedProblems:
    """Each says in its result what is wrong, without being told the truth."""

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(
        ("name", "words"),
        [
            ("collinearity", "Sun and field on one line"),
            ("one-vector", "one direction and a gyro"),
            ("eclipse", "eclipse: no Sun for 18"),
            ("star-blinded", "star tracker over-rate"),
            ("star-blinded", "star tracker blinded"),
            ("field-error", "field differs from its model"),
            ("outliers", "contradict the rest and are not used"),
        ],
    )
    def test_warning(self, adcs, name, words):
        outcome = adcs("run", name, "--seeds", "4")
        assert outcome.status == 0
        assert any(line.startswith("adcs: warning: ") and words in line for line in outcome.err.splitlines())
        assert "warning" not in outcome.out
        assert adcs("run", name, "--seeds", "4", "--quiet").err == ""

    def test_the_worst_is_told(self, adcs):
        """The last minute comes long after the problem: 0.273° and 0.015° in the shadow and after it."""
        found = numbers(adcs("run", "eclipse", "--json", "--quiet", "--seeds", "5"))
        file = read_scenario("eclipse")
        outcome = run_scenario(file, file.estimator("x"), range(5))
        (part,) = parts_of(file, file.estimator("x"), range(5))
        dark = ~part.runs.readings.seen["sun"]
        assert found["worst_deg"] == pytest.approx(outcome.error_deg[dark].max())
        assert found["worst_deg"] > 5.0 * found["angle_rms_deg"]

    def test_wild_readings_are_counted(self, adcs):
        found = numbers(adcs("run", "outliers", "--json", "--quiet", "--seeds", "2", "--share", "0.1"))
        file = read_scenario("outliers").changed({"disturbance": {"wild_share": 0.1}})
        (part,) = parts_of(file, file.estimator("x"), range(2))
        wild = np.stack(list(part.runs.prepared.wild.values()), axis=-1) & np.isfinite(part.estimates.nis)
        assert wild.sum() > 300
        assert found["rejected_good"] == 0
        assert found["rejected"] == wild.sum()

    @pytest.mark.parametrize(
        ("sensors", "states"), [("mag+sun+gyro", "gyro-bias, disturbance"), ("mag+sun", "disturbance")]
    )
    def test_other_sensors_leave_the_states(self, adcs, sensors, states):
        """The states of the scenario stay, but for the bias of a sensor that is gone."""
        outcome = adcs("run", "eclipse", "--seeds", "1", "--duration", "700", "--sensors", sensors)
        assert f", estimating {states}; filter mekf" in outcome.out
        rows = json.loads(
            adcs("compare", "eclipse", "--seeds", "1", "--duration", "700", "--sensors", sensors, "--json").out
        )["rows"]
        assert rows[0]["states"] == states.split(", ")

    def test_states_that_are_named_are_all(self, adcs):
        outcome = adcs(
            "run", "eclipse", "--seeds", "1", "--duration", "700", "--sensors", "mag+sun", "--states", "none"
        )
        assert "gyro+mag+sun" not in outcome.out
        assert "estimating" not in outcome.out

    def test_nothing_to_warn_of(self, adcs):
        assert adcs("run", "tabletsat", "--seeds", "4").err == ""

    def test_field_error_is_seen_in_the_nees(self, adcs):
        found = numbers(
            adcs("run", "tabletsat", "--sensors", "mag+sun+gyro", "--field-error-nT", "400", "--json", "--quiet")
        )
        assert found["nees_per_dimension"] > 5.0
        assert found == numbers(adcs("run", "field-error", "--json", "--quiet"))

    def test_eclipse(self, adcs):
        """Largest error of the median run in the shadow and after, and from 240 s after it: 0.25° and 0.06°."""
        arguments = ("--sensors", "mag+sun+gyro", "--states", "gyro-bias,disturbance", "--eclipse")
        assert numbers(adcs("run", "tabletsat", "--json", "--quiet", *arguments))["angle_rms_deg"] < 0.06
        file = read_scenario("eclipse")
        outcome = run_scenario(file, file.estimator("x"), range(10))
        assert np.median(outcome.error_deg[:, 600:].max(axis=1)) < 0.25
        assert np.median(outcome.error_deg[:, 2690:].max(axis=1)) < 0.06


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    from adcs.cli.app import main

    out = tmp_path_factory.mktemp("run") / "new"
    arguments = ["--sensors", "mag+sun+gyro", "--states", "gyro-bias,disturbance", "--seeds", "3"]
    assert main(["run", "tabletsat", *arguments, "--out", str(out), "--quiet"]) == 0
    return out


class TestFiles:
    def test_names(self, folder):
        assert sorted(path.name for path in folder.iterdir()) == [
            "scenario.toml",
            "tabletsat-consistency.png",
            "tabletsat-errors.png",
            "tabletsat-runs.csv",
            "tabletsat.csv",
            "tabletsat.nc",
            "telemetry.csv",
            "truth.csv",
        ]

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ["errors", "consistency"])
    def test_pictures(self, folder, name):
        picture = image.imread(folder / f"tabletsat-{name}.png")
        assert picture.shape[0] > 700
        assert len(np.unique(picture[..., :3].reshape(-1, 3), axis=0)) > 100

    def test_data_behind_the_picture(self, folder, adcs):
        with (folder / "tabletsat-runs.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert [row["seed"] for row in rows] == ["0", "1", "2"]
        arguments = ("--sensors", "mag+sun+gyro", "--states", "gyro-bias,disturbance", "--seeds", "3", "--json")
        found = numbers(adcs("run", "tabletsat", *arguments))
        angles = np.array([[float(row[f"rms_attitude_{axis}_deg"]) for axis in "xyz"] for row in rows])
        assert angles.mean(axis=0).max() == pytest.approx(found["angle_rms_deg"])
        with (folder / "tabletsat.csv").open() as file:
            steps = list(csv.DictReader(file))
        assert len(steps) == 201
        late = np.array([float(row["error_attitude_x_deg"]) for row in steps[-60:]])
        assert np.sqrt(np.mean(late**2)) == pytest.approx(angles[0, 0])
        assert "error_field_bias_x_nT" not in steps[0]

    def test_dataset(self, folder):
        with xr.open_dataset(folder / "tabletsat.nc") as dataset:
            assert dict(dataset.sizes) == {"run": 3, "time": 201, "axis": 3, "component": 4, "sensor": 4}
            assert dataset["run"].values.tolist() == [0, 1, 2]
            assert all("units" in dataset[name].attrs for name in dataset.data_vars)
            assert "field_bias" not in dataset
            assert dataset.attrs["Conventions"].startswith("CF-")

    def test_a_file_in_place_of_the_folder(self, adcs, tmp_path):
        (tmp_path / "out").write_text("")
        assert_refused(adcs("run", "tabletsat", "--out", tmp_path / "out"), "--out", "found a file, expected a folder")


class TestOwnScenario:
    def test_file(self, adcs, tmp_path):
        path = tmp_path / "mine.toml"
        changes = {"name": "mine", "satellite": {"inertia_kgm2": [[2.0, 0, 0], [0, 3.0, 0], [0, 0, 4.0]]}}
        path.write_text(scenario_text(read_scenario("tabletsat").changed(changes)))
        outcome = adcs("run", path, "--seeds", "2")
        assert outcome.status == 0
        assert outcome.out.startswith("mine: 2 runs of 200 s; st+gyro+mag+sun; filter mekf")

    @pytest.mark.parametrize(
        ("old", "new", "fragments"),
        [
            ("0.71]]", "7.1]]", ["triangle inequality"]),
            ('start = "2014', 'start = "2034', ["2034", "2030"]),
            ("inertia_kgm2", "inertia_kgm", ["inertia_kgm", "inertia_kgm2"]),
            ("least_separation_deg = 45.0", "least_separation_deg = 89.9", ["conditions"]),
        ],
    )
    def test_bad_files(self, adcs, tmp_path, old, new, fragments):
        path = tmp_path / "mine.toml"
        text = scenario_text(read_scenario("tabletsat"))
        assert old in text
        path.write_text(text.replace(old, new))
        assert_refused(adcs("run", path), str(path), *fragments)

    @pytest.mark.parametrize(
        ("arguments", "fragments"),
        [
            (["--sensors", "sun+gyro"], ["--sensors", "must observe attitude", "Add a star tracker"]),
            (["--sensors", "st", "--states", "gyro-bias"], ["without a gyro"]),
            (["--states", "wind"], ["wind", "gyro-bias"]),
            (["--start-error-deg", "-1"], ["--start-error-deg"]),
            (["--field-error-nT", "-1"], ["--field-error-nT"]),
            (["--share", "1.5"], ["--share", "0 to less than 1"]),
            (["--share", "nan"], ["--share"]),
            (["--duration", "-5"], ["--duration"]),
            (["--duration", "nan"], ["--duration"]),
        ],
    )
    def test_bad_options(self, adcs, arguments, fragments):
        assert_refused(adcs("run", "tabletsat", *arguments), *fragments)


class TestCompare:
    def test_json(self, adcs):
        outcome = adcs("compare", "tabletsat", "field-error", "--seeds", "2", "--json")
        assert outcome.status == 0
        rows = json.loads(outcome.out, parse_constant=refuse_constant)["rows"]
        assert [row["scenario"] for row in rows] == ["tabletsat", "field-error"]
        alone = numbers(adcs("run", "field-error", "--seeds", "2", "--json"))
        assert {key: rows[1][key] for key in KEYS} == alone
        assert any("field differs" in line for line in rows[1]["warnings"])

    @pytest.mark.slow
    def test_lists_and_files(self, adcs, tmp_path):
        arguments = ("--sensors", "st,mag+sun", "--states", "none,disturbance", "--filter", "mekf,smoother")
        outcome = adcs("compare", "tabletsat", *arguments, "--seeds", "1", "--out", tmp_path)
        assert outcome.status == 0
        assert len(outcome.out.splitlines()) == 1 + 8
        with (tmp_path / "compare.csv").open() as file:
            rows = list(csv.DictReader(file))
        assert len(rows) == 8
        by_name = {row["row"]: float(row["angle_rms_deg"]) for row in rows}
        assert by_name["tabletsat mag+sun disturbance smoother"] < by_name["tabletsat mag+sun disturbance"]
        assert image.imread(tmp_path / "compare.png").shape[0] > 700

    @pytest.mark.parametrize(
        ("arguments", "fragment"),
        [
            (["tabletsat", "--filter", "mekf,ukf"], "ukf"),
            (["tabletsat", "--sensors", "st,sun"], "must observe attitude"),
            (["nowhere.toml"], "nowhere.toml does not exist"),
        ],
    )
    def test_refusals(self, adcs, arguments, fragment):
        assert_refused(adcs("compare", *arguments), fragment)
