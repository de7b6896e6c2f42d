"""Scenario files: what the built-in ones say, and what is refused with its place."""

from __future__ import annotations

import math
import re
from importlib.resources import files

import numpy as np
import pytest

from adcs.environment.orbit import CircularOrbit, Sgp4Orbit
from adcs.io.scenario_files import built_in_scenarios, read_scenario, scenario_text
from adcs.kalman.error_state import ProcessNoise
from adcs.kalman.process_noise import paper_noise, tuned_noise
from arrays.io.errors import InputError
from sims.attitude.files import simulation_of
from tests.adcs.filter_runs import tabletsat

MINIMAL = """
[satellite]
inertia_kgm2 = [[0.519, 0.002, 0.005], [0.002, 0.579, 0.009], [0.005, 0.009, 0.71]]

[orbit]
start = "2014-09-01"
altitude_km = 600.0
inclination_deg = 97.8
local_time_h = 15.0
"""
# ISS, 2008-09-20: the example of the Wikipedia article on two-line elements.
ISS = (
    "1 25544U 98067A   08264.51782528 -.00002182  00000-0 -11606-4 0  2927",
    "2 25544  51.6416 247.4627 0006703 130.5360 325.0288 15.72125391563537",
)


@pytest.fixture
def file(tmp_path):
    """Write a scenario file and give its path."""

    def write(text):
        path = tmp_path / "mine.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    return write


class TestBuiltIn:
    def test_names(self):
        assert built_in_scenarios() == (
            "collinearity",
            "eclipse",
            "field-error",
            "one-vector",
            "outliers",
            "residual-dipole",
            "star-blinded",
            "tabletsat",
            "uncalibrated-magnetometer",
        )

    @pytest.mark.parametrize("name", built_in_scenarios())
    def test_each_can_be_read(self, name):
        file = read_scenario(name)
        assert file.name == name
        assert file.estimator(file.path).settings.sensors.sensors

    def test_tabletsat_is_that_of_the_simulation(self):
        """Every number of the file against the scenario that sims builds."""
        ours, theirs = simulation_of(read_scenario("tabletsat")), tabletsat()
        of_file, of_sims = ours.satellite, theirs.satellite
        np.testing.assert_allclose(of_file.body.inertia_kgm2, of_sims.body.inertia_kgm2)
        np.testing.assert_allclose(of_file.control.attitude_gain_Nm, of_sims.control.attitude_gain_Nm)
        np.testing.assert_allclose(of_file.control.rate_gain_Nms, of_sims.control.rate_gain_Nms)
        assert isinstance(of_file.orbit, CircularOrbit)
        assert isinstance(of_sims.orbit, CircularOrbit)
        for name in ("altitude_m", "inclination_rad", "node_rad", "latitude_argument_rad"):
            assert getattr(of_file.orbit, name) == pytest.approx(getattr(of_sims.orbit, name))
        assert (of_file.start, ours.duration_s, ours.dt_s) == (of_sims.start, theirs.duration_s, theirs.dt_s)
        for name in ("sigma_rad", "rate_limit_rad_s", "sun_exclusion_rad", "earth_exclusion_rad"):
            assert getattr(of_file.star_tracker, name) == pytest.approx(getattr(of_sims.star_tracker, name))
        for name in ("sigma_rad_s", "range_rad_s", "bias_walk_rad_s"):
            assert getattr(of_file.gyro, name) == pytest.approx(getattr(of_sims.gyro, name))
        for name in ("sigma_T", "range_T", "bias_walk_T"):
            assert getattr(of_file.magnetometer, name) == pytest.approx(getattr(of_sims.magnetometer, name))
        for name in ("sigma_rad", "half_field_rad"):
            assert getattr(of_file.sun_sensor, name) == pytest.approx(getattr(of_sims.sun_sensor, name))
        np.testing.assert_allclose(of_file.sun_sensor.heads_body, of_sims.sun_sensor.heads_body)
        for name in ("least_separation_rad", "most_separation_rad", "least_field_T"):
            assert getattr(ours.conditions, name) == pytest.approx(getattr(theirs.conditions, name))
        for name in ("torque_Nm", "torque_period_s", "gyro_bias_rad_s", "field_bias_T", "field_error_T"):
            assert getattr(ours, name) == pytest.approx(getattr(theirs, name))
        for name in ("start_attitude_rad", "start_rate_rad_s"):
            assert getattr(ours, name) == pytest.approx(getattr(theirs, name))

    def test_what_a_file_leaves_out_is_what_tabletsat_says(self, file):
        """The documented file and the defaults of the tables cannot drift apart."""
        short, long = read_scenario(file(MINIMAL)), read_scenario("tabletsat")
        assert short.start == long.start
        assert short.disturbance == long.disturbance
        assert short.estimate == long.estimate
        for name in ("star_tracker", "gyro", "magnetometer", "sun_sensor"):
            for key, value in vars(getattr(long.satellite, name)).items():
                np.testing.assert_allclose(getattr(getattr(short.satellite, name), key), value, err_msg=f"{name}.{key}")

    def test_tabletsat_documents_every_key(self):
        from adcs.io import scenario_tables as module

        text = (files("adcs") / "scenarios" / "tabletsat.toml").read_text(encoding="utf-8")
        for table in (
            module.FileTable,
            module.SatelliteTable,
            module.OrbitTable,
            module.StartTable,
            module.DisturbanceTable,
            module.StarTrackerTable,
            module.GyroTable,
            module.MagnetometerTable,
            module.SunSensorTable,
            module.EstimateTable,
            module.ProcessNoiseTable,
        ):
            for key in table.__struct_fields__:
                assert re.search(rf"\b{key}\b", text), f"{table.__name__}.{key}"


class TestChanges:
    def test_text_and_back(self, file):
        wanted = read_scenario("eclipse").changed({"duration_s": 77.0, "estimate": {"sensors": "st", "states": []}})
        again = read_scenario(file(scenario_text(wanted)))
        assert (again.duration_s, again.start, again.estimate) == (77.0, wanted.start, wanted.estimate)

    def test_infinite_and_nested(self, file):
        again = read_scenario(file(scenario_text(read_scenario("tabletsat"))))
        assert again.disturbance.torque_period_s == math.inf
        default = read_scenario("tabletsat").satellite
        np.testing.assert_allclose(again.satellite.sun_sensor.heads_body, default.sun_sensor.heads_body)


class TestOrbit:
    def test_elements(self, file):
        text = MINIMAL[: MINIMAL.index("altitude_km")]
        text += f'elements = ["{ISS[0]}", "{ISS[1]}"]\n'
        text = text.replace('"2014-09-01"', '"2008-09-21"')
        orbit = read_scenario(file(text)).satellite.orbit
        assert isinstance(orbit, Sgp4Orbit)
        assert orbit.epoch == np.datetime64("2008-09-20T12:25:40.104192")

    @pytest.mark.parametrize("start", ["2008-08-10", "2008-11-01", "2014-09-01"])
    def test_old_elements(self, file, start):
        """Refused, before and after their epoch, unless that is allowed; a changed or written scenario keeps that."""
        text = MINIMAL[: MINIMAL.index("altitude_km")].replace('"2014-09-01"', f'"{start}"')
        path = file(text + f'elements = ["{ISS[0]}", "{ISS[1]}"]\n')
        with pytest.raises(InputError, match=r"key elements: utc must be less than 30 days .* \d+\.\d days from"):
            read_scenario(path)
        allowed = read_scenario(path, allow_old_elements=True)
        (text,) = allowed.changed({"duration_s": 7.0}).warnings
        assert "days from the epoch 2008-09-20T12:25:40" in text
        assert read_scenario(file(scenario_text(allowed))).warnings == (text,)

    @pytest.mark.parametrize("start", ["2014-09-01", '"2014-09-01T00:00:00"', '"2014-09-01T02:00:00+02:00"'])
    def test_start(self, file, start):
        text = MINIMAL.replace('"2014-09-01"', start)
        assert read_scenario(file(text)).satellite.start == np.datetime64("2014-09-01T00:00:00")


class TestNoise:
    def estimate(self, **keys):
        return read_scenario("tabletsat").changed({"estimate": keys}).estimator("x").settings

    def test_tuned_and_paper(self):
        tuned = self.estimate(sensors="mag+sun")
        assert tuned.noise == tuned_noise(tuned.sensors)
        paper = self.estimate(sensors="mag+sun", process_noise="paper")
        assert paper.noise == paper_noise(paper.sensors)

    def test_table(self):
        noise = self.estimate(sensors="st", process_noise={"half_angle_rad": 1e-7, "field_bias_nT": 2.0}).noise
        assert noise == ProcessNoise(1e-7, 1.5e-6, field_bias_T=2e-9)

    def test_filters_bring_their_states(self):
        assert self.estimate(sensors="st", filter="parallel-disturbance").sensors.states == ("disturbance",)
        named = self.estimate(sensors="st", states=["disturbance"], filter="parallel-disturbance")
        assert named.sensors.states == ("disturbance",)
        assert self.estimate(sensors="st+gyro", filter="reduced").sensors.states == ("gyro-bias",)


@pytest.mark.parametrize(
    ("old", "new", "fragments"),
    [
        ("0.519", "-0.519", ["table satellite", "inertia_kgm2", "positive definite"]),
        ("0.71", "7.1", ["table satellite", "triangle inequality"]),
        ("[0.002, 0.579, 0.009]", "[0.9, 0.579, 0.009]", ["table satellite", "symmetric"]),
        ("inertia_kgm2", "inertia", ["table satellite", "key inertia", "nearest is inertia_kgm2"]),
        ("[satellite]", "[sattelite]", ["key sattelite", "nearest is satellite"]),
        ("altitude_km = 600.0", "altitude_km = -1.0", ["altitude_km", "positive"]),
        ("altitude_km = 600.0\n", "", ["altitude_km"]),
        ("local_time_h = 15.0", "", ["neither local_time_h nor node_deg"]),
        ('"2014-09-01"', '"soon"', ["key start", "soon", "2014-09-01T12:00:00"]),
        ("local_time_h = 15.0", 'local_time_h = 15.0\nfield_model = "IGRF"', ["field_model", "IGRF-14", "WMM2025"]),
        ("local_time_h = 15.0", f'elements = ["{ISS[0]}", "{ISS[1]}"]', ["elements and a circle"]),
        ("local_time_h = 15.0", "local_time_h = 15.0\n[sensors.horizon]", ["horizon", "star_tracker"]),
        ("local_time_h = 15.0", "local_time_h = 15.0\n[sensors.gyro]\nnoise_deg_s = 0.0", ["noise_deg_s", "positive"]),
        ("local_time_h = 15.0", "local_time_h = 15.0\n[start]\nleast_separation_deg = 91", ["0 to 90"]),
        ("[satellite]", "format_version = 2\n[satellite]", ["format_version", "expected 1"]),
        ("[satellite]", "duration_s = 0.5\n[satellite]", ["duration_s"]),
        ("[satellite]", "duration_s = 1e6\n[satellite]", ["duration_s", "200000 steps"]),
        ("[satellite]", "name = 'a/b'\n[satellite]", ["key name", "a/b"]),
        ("[satellite]", "duration_s = 'long'\n[satellite]", ["duration_s", "a number"]),
    ],
)
def test_bad_files(file, old, new, fragments):
    assert old in MINIMAL
    path = file(MINIMAL.replace(old, new))
    with pytest.raises(InputError) as refused:
        read_scenario(path)
    assert str(refused.value).startswith(path)
    for fragment in fragments:
        assert fragment in str(refused.value)


@pytest.mark.parametrize(
    ("keys", "fragments"),
    [
        ({"sensors": "sun+gyro"}, ["rotation about the Sun", "Add a star tracker (st) or a magnetometer"]),
        ({"sensors": "gyro"}, ["no sensor measures attitude", "Add a star tracker"]),
        ({"sensors": "st+radar"}, ["st+radar"]),
        ({"sensors": "st", "states": ["gyro-bias"]}, ["without a gyro"]),
        ({"filter": "ukf"}, ["ukf", "mekf"]),
        ({"start": "there"}, ["there", "near"]),
        ({"process_noise": "best"}, ["best", "tuned"]),
        ({"process_noise": {"rate": 1.0}}, ["key rate", "nearest is rate_rad_s"]),
        ({"sensors": "st+sun", "process_noise": "paper"}, ["source's tables"]),
        ({"forgetting": 1.5}, ["forgetting"]),
        ({"closed_loop_F": True, "filter": "smoother"}, ["closed_loop_F"]),
    ],
)
def test_bad_estimates(keys, fragments):
    with pytest.raises(InputError) as refused:
        read_scenario("tabletsat").changed({"estimate": keys}).estimator("here")
    assert str(refused.value).startswith("here")
    for fragment in fragments:
        assert fragment in str(refused.value)
