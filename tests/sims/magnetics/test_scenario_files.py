"""Scenario files: the built-in ones, and how bad ones are refused."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arrays.array_file import read_sensors
from arrays.geometries import tetrahedron
from arrays.io.errors import InputError
from magloc.fields.geomagnetic import field_enu
from magloc.readings import read_readings
from magloc.truth import read_truth
from sims.magnetics import scenario_tables as tables
from sims.magnetics.files import files_beside, write_simulation
from sims.magnetics.paths import Lawnmower, Steered, Waypoints, circle
from sims.magnetics.scenario import Pulsation
from sims.magnetics.scenario_files import built_in_scenarios, read_scenario
from sims.magnetics.scenario_tables import PATH_TABLES
from sims.magnetics.sensors import SENSOR_KINDS
from sims.magnetics.simulation import simulate
from tests.conftest import REPOSITORY
from tests.sims.magnetics.white_noise import with_white_noise_only

NAMES = (
    *("diver", "drone", "hand-magnet", "paper", "ship", "ship-headings"),
    *("survey-cart", "survey-diver", "survey-drone", "three-magnets", "weaving"),
)
FILES = REPOSITORY / "sims" / "magnetics" / "scenarios"
PLAIN = """
duration_s = 10.0
rate_Hz = 2.0
[array]
geometry = "tetrahedron"
edge_m = 1.5
kind = "vector"
noise_nT = 0.2
[[source]]
path = { kind = "fixed", position_m = [5, 0, 1] }
moment_Am2 = [1, 2, 3]
"""
OF_KIND = PLAIN.replace('kind = "vector"\nnoise_nT = 0.2\n', "")


@pytest.fixture
def write(tmp_path: Path):
    def written(text: str) -> str:
        path = tmp_path / "scenario.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    return written


def with_path(keys: str) -> str:
    return PLAIN.replace('kind = "fixed", position_m = [5, 0, 1]', keys)


class TestBuiltIn:
    def test_these_are_all(self) -> None:
        assert built_in_scenarios() == NAMES

    @pytest.mark.parametrize("name", NAMES)
    def test_its_files_read_back(self, name: str, tmp_path: Path) -> None:
        simulation = simulate(read_scenario(name), 3)
        files = write_simulation(simulation, tmp_path / "run.csv")
        assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in files.all)
        array = read_sensors(files.array)
        assert array == simulation.array
        readings = read_readings(files.readings, array)
        np.testing.assert_array_equal(readings.time_s, simulation.readings.time_s)
        np.testing.assert_allclose(readings.values_T, simulation.readings.values_T, rtol=1e-14)
        for attribute in ("array_position_m", "array_rotation", "ambient_T"):
            found, expected = getattr(readings, attribute), getattr(simulation.readings, attribute)
            if attribute == "array_rotation" and expected is not None:
                found, expected = found.as_quat(), expected.as_quat()
            assert (found is None) == (expected is None)
            if expected is not None:
                np.testing.assert_allclose(found, expected, rtol=1e-13)
        for path, expected in zip(files.truths, simulation.truths, strict=True):
            truth = read_truth(path)
            np.testing.assert_array_equal(truth.position_m, expected.position_m)
            np.testing.assert_array_equal(truth.moment_Am2, expected.moment_Am2)
        for path in files.targets:
            buried = np.loadtxt(path, delimiter=",", skiprows=1)
            np.testing.assert_array_equal(buried[:, :3], simulation.target_position_m)
            np.testing.assert_array_equal(buried[:, 3:], simulation.target_moment_Am2)

    @pytest.mark.parametrize("name", NAMES)
    def test_the_source_is_seen(self, name: str) -> None:
        # Without its source the readings differ by 20 times the noise of a sample, at the best channel and time.
        wanted = with_white_noise_only(read_scenario(name))
        seen, empty = (simulate(s, 3).readings.values_T for s in (wanted, replace(wanted, sources=(), targets=None)))
        change = np.abs(np.diff(seen - empty, axis=1)) / wanted.nominal_array.channel_noise_T[1:]
        assert np.nanmax(change) > 20.0

    def test_the_paper(self) -> None:
        paper = read_scenario("paper")
        assert paper.nominal_array == replace(tetrahedron(1.5, noise_T=1e-9), name="tetrahedron-1.5")
        truth = simulate(paper, 0).truth
        np.testing.assert_array_equal(truth.position_m, np.tile([5.0, 0.0, 0.306], (61, 1)))
        np.testing.assert_array_equal(truth.moment_Am2, np.tile([100.0, 0.0, 0.0], (61, 1)))

    def test_weaving_is_the_figure_it_is_for(self) -> None:
        weaving = read_scenario("weaving")
        simulation = simulate(weaving, 0)
        truth = simulation.truth
        distance = np.linalg.norm(truth.position_m, axis=1)
        assert 4.0 <= distance.min() < 4.5
        assert 8.5 < distance.max() <= 9.0
        np.testing.assert_allclose(np.linalg.norm(truth.moment_Am2, axis=1), 250.0)
        speed = np.linalg.norm(weaving.sources[0].carrier.path.at(truth.time_s).velocity_m_s, axis=1)
        np.testing.assert_allclose(speed, 0.1)
        angle = np.unwrap(np.arctan2(truth.moment_Am2[:, 1], truth.moment_Am2[:, 0]))
        np.testing.assert_allclose(np.diff(angle) * 2.0, math.radians(1.2))
        assert {sensor.noise_T for sensor in simulation.array.sensors} == {0.2e-9}
        assert weaving.rate_Hz == 2.0

    def test_the_board_has_thirty_sensors_16_mm_apart(self) -> None:
        positions = read_scenario("hand-magnet").array.positions
        assert len(positions) == 30
        np.testing.assert_allclose(np.unique(positions[:, 0]), 0.016 * (np.arange(6) - 2.5))
        np.testing.assert_allclose(np.unique(positions[:, 1]), 0.016 * (np.arange(5) - 2.0))
        np.testing.assert_allclose(positions.mean(axis=0), 0.0, atol=1e-15)

    def test_every_key_is_documented_in_one_of_the_files(self) -> None:
        text = "\n".join((FILES / f"{name}.toml").read_text(encoding="utf-8") for name in NAMES)
        words = set(re.findall(r"\w+", text))
        structs = {value for value in vars(tables).values() if isinstance(value, type)}
        keys = {key for struct in structs for key in getattr(struct, "__struct_fields__", ())}
        assert {"duration_s", "polarisability_m3", "clockwise"} < keys
        assert keys <= words
        assert {*PATH_TABLES, *SENSOR_KINDS} <= words


class TestReading:
    @pytest.mark.parametrize(
        ("keys", "path"),
        [
            (
                'kind = "line", start_m = [1, 2, 3], course_deg = 90, speed_m_s = 2, climb_m_s = 0.5',
                Steered((1.0, 2.0, 3.0), math.pi / 2, 2.0, climb_m_s=0.5),
            ),
            (
                'kind = "course", start_m = [1, 2, 3], course_deg = 180, speed_m_s = 2, turn_deg_s = 90',
                Steered((1.0, 2.0, 3.0), math.pi, 2.0, turn_rad_s=math.pi / 2),
            ),
            (
                'kind = "course", start_m = [1, 2, 3], course_deg = 180, speed_m_s = 2',
                Steered((1.0, 2.0, 3.0), math.pi, 2.0),
            ),
            (
                'kind = "weaving", start_m = [1, 2, 3], course_deg = 0, speed_m_s = 2, weave_deg = 30, '
                "weave_period_s = 9",
                Steered((1.0, 2.0, 3.0), 0.0, 2.0, 0.0, math.radians(30), 9.0),
            ),
            (
                'kind = "circle", centre_m = [9, 2, 3], radius_m = 2, speed_m_s = 1, start_deg = 90, clockwise = false',
                circle((9.0, 2.0, 3.0), 2.0, 1.0, math.pi / 2, clockwise=False),
            ),
            (
                'kind = "waypoints", points_m = [[1, 2, 3], [4, 5, 6]], speed_m_s = 1',
                Waypoints(((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)), 1.0),
            ),
            (
                'kind = "lawnmower", start_m = [1, 2, 3], course_deg = 0, length_m = 9, spacing_m = 2, lines = 3, '
                "speed_m_s = 1",
                Lawnmower((1.0, 2.0, 3.0), 0.0, 9.0, 2.0, 3, 1.0),
            ),
        ],
    )
    def test_every_kind_of_path(self, write, keys: str, path: object) -> None:
        assert read_scenario(write(with_path(keys))).sources[0].carrier.path == path

    def test_the_array_alone_has_white_noise(self, write) -> None:
        scenario = read_scenario(write(PLAIN))
        assert scenario.name == "scenario"
        (model,) = set(scenario.models)
        assert (model.corner_Hz, model.bandwidth_Hz, model.range_T, model.resolution_T) == (
            0.0,
            math.inf,
            math.inf,
            0.0,
        )
        assert model.sigma_T(2.0) == 0.2e-9

    def test_what_the_array_states_is_simulated(self, write) -> None:
        text = PLAIN.replace(
            "noise_nT",
            "misalignment_mrad = 2\ngain_uncertainty = 0.01\nsaturation_nT = 500\n"
            "offset_uncertainty_nT = 3\nflicker_nT = 0.04\ndrift_nT_rth = 5\nnoise_nT",
        )
        scenario = read_scenario(write(text))
        assert scenario.models[0].misalignment_rad == 2e-3
        assert scenario.models[0].gain_error == 0.01
        assert scenario.models[0].range_T == pytest.approx(5e-7)
        (nominal, *_) = scenario.nominal_array.sensors
        assert nominal.misalignment_rad == 2e-3
        assert (nominal.offset_uncertainty_T, nominal.drift_T_rth) == (3e-9, 5e-9)
        assert nominal.flicker_T == pytest.approx(4e-11, rel=1e-9)

    @pytest.mark.parametrize("kind", SENSOR_KINDS)
    def test_every_kind_of_sensor(self, write, kind: str) -> None:
        scenario = read_scenario(write(f'{OF_KIND}[sensors]\nkind = "{kind}"\n'))
        assert set(scenario.models) == {SENSOR_KINDS[kind]}
        assert {sensor.kind for sensor in scenario.array.sensors} == {SENSOR_KINDS[kind].reads}

    def test_every_figure_of_a_kind_can_be_overridden(self, write) -> None:
        figures = (
            "noise_nT_rtHz = 1\ncorner_Hz = 2\nbandwidth_Hz = 3\nrange_nT = inf\nresolution_nT = 5\n"
            "misalignment_mrad = 6\ngain_error = 0.7\ndrift_nT_rth = 8\noffset_error_nT = 9\n"
        )
        model = read_scenario(write(f'{OF_KIND}[sensors]\nkind = "fluxgate"\n{figures}')).models[0]
        found = [model.noise_T_rtHz, model.corner_Hz, model.bandwidth_Hz, model.range_T, model.resolution_T]
        found += [model.misalignment_rad, model.gain_error, model.drift_T_rth, model.offset_error_T]
        np.testing.assert_allclose(found, [1e-9, 2.0, 3.0, math.inf, 5e-9, 6e-3, 0.7, 8e-9, 9e-9], rtol=1e-15)

    def test_the_noise_of_a_sample_may_be_given(self, write) -> None:
        text = f'{OF_KIND}[sensors]\nkind = "overhauser"\nresolution_nT = 0\nnoise_nT = 0.3\n'
        assert read_scenario(write(text)).nominal_array.sensors[0].noise_T == pytest.approx(0.3e-9, rel=1e-11)

    def test_one_sensor_may_differ(self, write) -> None:
        text = (
            f'{OF_KIND}[sensors]\nkind = "fluxgate"\ncorner_Hz = 3\n[sensors.of.s2]\nnoise_nT_rtHz = 1\n'
            '[sensors.of.s3]\nkind = "squid"\n'
        )
        models = read_scenario(write(text)).models
        assert [model.corner_Hz for model in models] == [3.0, 3.0, SENSOR_KINDS["squid"].corner_Hz, 3.0]
        assert models[1].noise_T_rtHz == 1e-9
        assert models[2] == SENSOR_KINDS["squid"]

    @pytest.mark.parametrize("unit", ["noise_nT", "noise_nT_rtHz"])
    def test_noise_of_one_sensor_replaces_that_of_all_in_whatever_unit(self, write, unit: str) -> None:
        (other,) = {"noise_nT", "noise_nT_rtHz"} - {unit}
        text = f'{OF_KIND}[sensors]\nkind = "overhauser"\n'
        own = f"[sensors.of.s2]\n{unit} = 1\n"
        replaced, alone = (read_scenario(write(text + common + own)) for common in (f"{other} = 7\n", ""))
        assert replaced.models[1] == alone.models[1]
        assert replaced.models[0] != alone.models[0]

    def test_vector_and_scalar_sensors_may_be_mixed(self, write) -> None:
        text = (
            'duration_s = 1\nrate_Hz = 2\n[sensors]\nkind = "fluxgate"\n[sensors.of.b]\nkind = "opm"\n'
            '[array]\nsensor = [{ id = "a", position_m = [0, 0, 0] }, { id = "b", position_m = [1, 0, 0] }]\n'
        )
        assert [sensor.kind for sensor in read_scenario(write(text)).array.sensors] == ["vector", "scalar"]

    def test_the_array_may_be_a_file_beside(self, write, tmp_path: Path) -> None:
        (tmp_path / "array.toml").write_text('geometry = "square"\nedge_m = 2\nkind = "vector"\nnoise_nT = 3\n')
        path = write('duration_s = 1\nrate_Hz = 2\narray = "array.toml"\n')
        assert read_scenario(path).nominal_array.sensors[0].noise_T == 3e-9

    def test_ambient_field_of_a_place(self, write) -> None:
        for date in ("2026-11-21", '"2026-11-21"'):
            scenario = read_scenario(write(f"{PLAIN}[ambient]\nplace = [48.1, 11.6, 520]\ndate = {date}\n"))
            expected = field_enu(48.1, 11.6, 520.0, np.datetime64("2026-11-21"))
            np.testing.assert_allclose(scenario.ambient_T, expected, rtol=1e-12)

    def test_pulsations_have_a_direction(self, write) -> None:
        text = f"{PLAIN}[[pulsation]]\namplitude_nT = 10\nperiod_s = 20\ndirection = [0, 3, 4]\n"
        (found,) = read_scenario(write(text)).pulsations
        assert found.period_s == 20.0
        np.testing.assert_allclose(found.amplitude_T, Pulsation((0.0, 6e-9, 8e-9), 20.0).amplitude_T)

    @pytest.mark.parametrize(
        ("value", "matrix"),
        [
            ("2", np.diag([2.0, 2.0, 2.0])),
            ("[1, 2, 3]", np.diag([1.0, 2.0, 3.0])),
            ("[[1, 0.5, 0], [0.5, 2, 0], [0, 0, 3]]", np.array([[1, 0.5, 0], [0.5, 2, 0], [0, 0, 3]])),
        ],
    )
    def test_polarisability(self, write, value: str, matrix: np.ndarray) -> None:
        scenario = read_scenario(write(f"{PLAIN}polarisability_m3 = {value}\n"))
        np.testing.assert_array_equal(scenario.sources[0].polarisability_m3, matrix)

    def test_files_of_several_sources(self, tmp_path: Path) -> None:
        names = [path.name for path in files_beside(tmp_path / "a.csv", 3).truths]
        assert names == ["a-truth.csv", "a-truth-2.csv", "a-truth-3.csv"]


class TestRefusal:
    @pytest.mark.parametrize(
        ("text", "fragments"),
        [
            (PLAIN.replace("rate_Hz", "rate_hz"), ["key rate_hz", "nearest is rate_Hz"]),
            (PLAIN.replace("rate_Hz = 2.0\n", ""), ["no key rate_Hz"]),
            (PLAIN.replace("rate_Hz = 2.0", "rate_Hz = -2.0"), ["key rate_Hz", "-2", "positive"]),
            (PLAIN.replace("rate_Hz = 2.0", 'rate_Hz = "2 Hz"'), ["key rate_Hz", "text", "number"]),
            (PLAIN.replace("duration_s = 10.0", "duration_s = nan"), ["key duration_s", "finite"]),
            (PLAIN.replace("duration_s = 10.0", "duration_s = 1e9"), ["rows"]),
            (PLAIN.replace("position_m", "position_cm"), ["source 1.path, key position_cm", "nearest is position_m"]),
            (PLAIN.replace("moment_Am2", "moment_Am"), ["source 1, key moment_Am", "nearest is moment_Am2"]),
            (PLAIN.replace("[1, 2, 3]", "[0, 0, 0]"), ["source 1", "moment_Am2"]),
            (PLAIN.replace("[1, 2, 3]", "[1, 2]"), ["source 1, key moment_Am2", "length 3"]),
            (PLAIN.replace("edge_m", "edge_mm"), ["table array, key edge_mm", "nearest is edge_m"]),
            (PLAIN.replace("[[source]]", "[source]"), ["key source", "list"]),
            (f"format_version = 2\n{PLAIN}", ["format_version", "2"]),
            (with_path('kind = "spiral"'), ["spiral", "lawnmower"]),
            (with_path("position_m = [1, 2, 3]"), ["no key kind", "waypoints"]),
            (with_path('kind = "line", start_m = [1, 2, 3]'), ["no key course_deg"]),
            (
                with_path('kind = "line", start_m = [1, 2, 3], course_deg = 0, speed_m_s = -1'),
                ["key speed_m_s", "-1", "not negative"],
            ),
            (with_path('kind = "waypoints", speed_m_s = 1, points_m = [[1, 2, 3]]'), ["two points"]),
            (PLAIN + 'attitude = "free"\n', ["attitude", "course"]),
            (PLAIN + "rotation_xyzw = [0, 0, 0, 2]\n", ["source 1, key rotation_xyzw", "norm 2"]),
            (PLAIN + "wobble_period_s = 0\n", ["wobble_period_s", "positive"]),
            (PLAIN + "radius_m = -1\n", ["radius_m", "not negative"]),
            (PLAIN + "polarisability_m3 = [1, 2]\n", ["polarisability_m3", "3 numbers"]),
            (PLAIN + "polarisability_m3 = [[1, 2, 3], [0, 1, 0], [0, 0, 1]]\n", ["symmetric"]),
            (PLAIN + "polarisability_m3 = [[1, 2, 3], [0, 1, 0], 1]\n", ["polarisability_m3"]),
            (PLAIN + '[sensors]\nkind = "proton"\n', ["proton", "overhauser"]),
            (PLAIN + '[sensors]\nkind = "squid"\n', ["key noise_nT", "table sensors"]),
            (
                OF_KIND.replace("edge_m", 'kind = "vector"\nedge_m') + '[sensors]\nkind = "opm"\n',
                ["array, key kind", "scalar"],
            ),
            (OF_KIND + "[sensors]\nnoise_pT = 3\n", ["noise_pT", "nearest is noise_nT"]),
            (OF_KIND, ["no key kind"]),
            (PLAIN + "[sensors]\nnoise_nT = 1\nnoise_nT_rtHz = 1\n", ["found both"]),
            (PLAIN + "[sensors]\ndrift_nT_rth = inf\n", ["drift_nT_rth", "finite"]),
            (PLAIN + "[sensors]\ngain_error = 1\n", ["gain_error", "below 1"]),
            (PLAIN + "[sensors]\nmisalignment_mrad = 1000\n", ["misalignment_mrad", "below 1000"]),
            (PLAIN + "[sensors.of.s9]\ncorner_Hz = 1\n", ["sensors.of.s9", "s1, s2, s3, s4"]),
            (PLAIN + "[ambient]\n", ["neither field_nT nor place"]),
            (PLAIN + "[ambient]\nfield_nT = [1, 2, 3]\nplace = [1, 2, 3]\n", ["both field_nT and place"]),
            (PLAIN + "[ambient]\nplace = [1, 2, 3]\n", ["date"]),
            (PLAIN + '[ambient]\nplace = [1, 2, 3]\ndate = "today"\n', ["today"]),
            (PLAIN + '[ambient]\nplace = [1, 2, 3]\ndate = "1800-01-01"\n', ["1800"]),
            (PLAIN + '[ambient]\nplace = [1, 2, 3]\ndate = 2026-01-01\nmodel = "X"\n', ["IGRF-14"]),
            (PLAIN.replace("noise_nT", "ambient_nT = [1, 2, 3]\nnoise_nT"), ["table ambient"]),
            (
                PLAIN + "[[pulsation]]\namplitude_nT = 1\nperiod_s = 0\ndirection = [1, 0, 0]\n",
                ["pulsation 1", "period_s"],
            ),
            (PLAIN + "[[pulsation]]\namplitude_nT = 1\nperiod_s = 2\ndirection = [0, 0, 0]\n", ["direction"]),
            (PLAIN + "[platform]\nnoise_nT = -1\n", ["table platform, key noise_nT"]),
            (PLAIN + "[missing]\ndropout = 1\n", ["dropout", "below 1"]),
            (PLAIN + "[missing]\ngaps_s = [[3, 2]]\n", ["gaps_s", "[3, 2]"]),
            (PLAIN + "[carrier]\nspeed = 3\n", ["table carrier, key speed"]),
            ("", ["no key duration_s"]),
        ],
    )
    def test_one_sentence_says_what_and_where(self, write, text: str, fragments: list[str]) -> None:
        with pytest.raises(InputError) as error:
            read_scenario(write(text))
        sentence = str(error.value)
        assert "scenario.toml" in sentence
        assert sentence.endswith(".")
        assert "\n" not in sentence
        for fragment in fragments:
            assert fragment in sentence

    def test_an_unknown_name_lists_the_built_in_ones(self) -> None:
        with pytest.raises(InputError, match=", ".join(NAMES)):
            read_scenario("divr")
