"""``magloc locate`` with scalar sensors, known places, several sources and bad sensors, as a user types it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.array_file import write_array
from arrays.geometries import grid, tetrahedron
from arrays.sensor import Sensor
from magloc.fields.geomagnetic import field_enu
from magloc.readings import Readings, write_readings
from tests.command_line import Run, assert_refused, results_of
from tests.oracles import magpylib_field

FloatArray = NDArray[np.float64]
PLACE = np.array([5.0, 0.0, 0.306])
MOMENT = np.array([100.0, 200.0, 50.0])
AMBIENT = np.array([2e-5, 0.0, 4.5e-5])


def vector_plate(**keys: float) -> SensorArray:
    """Sixteen vector sensors on a plate of 2 m."""
    line = np.linspace(-1.0, 1.0, 4)
    places = np.stack(np.meshgrid(line, line, [0.0]), axis=-1).reshape(-1, 3)
    return SensorArray(
        tuple(Sensor(f"v{i}", "vector", tuple(place), 0.5e-9, **keys) for i, place in enumerate(places))  # type: ignore[arg-type]
    )


def scalar_cloud(n: int = 12) -> SensorArray:
    places = np.random.default_rng(4).uniform(-1.5, 1.5, (n, 3))
    return SensorArray(tuple(Sensor(f"s{i}", "scalar", tuple(place), 1e-11) for i, place in enumerate(places)))


def readings_of(
    array: SensorArray, sources: Sequence[tuple[FloatArray, FloatArray]], n: int = 3, ambient: FloatArray | float = 0.0
) -> FloatArray:
    """Noisy readings (n, C) of dipoles, by magpylib."""
    fields = np.zeros((array.n_sensors, 3)) + ambient
    for source in sources:
        fields = fields + magpylib_field(array.positions, *source)
    noise = np.random.default_rng(0).normal(size=(n, array.n_channels)) * array.channel_noise_T
    return array.readings_of(fields) + noise


class Files:
    """An array file and a readings file, ready for the command line."""

    def __init__(self, folder: Path) -> None:
        self.array, self.readings = folder / "array.toml", folder / "readings.csv"

    def write(
        self,
        array: SensorArray,
        values: FloatArray,
        *,
        ambient: FloatArray | None = None,
        pose: tuple[FloatArray, Rotation] | None = None,
    ) -> tuple[str, ...]:
        origin, rotation = pose or (None, None)
        write_array(self.array, array)
        write_readings(
            self.readings,
            Readings(values, array_position_m=origin, array_rotation=rotation, ambient_T=ambient),
            array,
        )
        return "locate", str(self.readings), "--array", str(self.array)


@pytest.fixture
def files(tmp_path: Path) -> Files:
    return Files(tmp_path)


AT_PLACE = ("--position", *map(str, PLACE))


class TestKnownPlace:
    """--position: only the moment is looked for."""

    ARRAY = tetrahedron(1.5, "scalar", 1e-10)

    def test_ambient_from_array_file(self, run: Run, files: Files) -> None:
        array = replace(self.ARRAY, ambient_T=tuple(AMBIENT))
        command = files.write(array, readings_of(array, [(PLACE, MOMENT)], ambient=AMBIENT))
        for row in results_of(run(*command, *AT_PLACE, "--json")):
            (solution,) = row["solutions"]
            assert solution["position_m"] == PLACE.tolist()
            assert np.shape(solution["covariance"]) == (3, 3)
            assert solution["dof"] == 0
            deviation = np.array(solution["moment_Am2"]) - MOMENT
            assert deviation @ np.linalg.solve(solution["covariance"], deviation) < 21.1  # χ² of 3, 1e-4

    def test_ambient_from_readings_comes_first(self, run: Run, files: Files) -> None:
        wrong = replace(self.ARRAY, ambient_T=(0.0, 5e-5, 0.0))
        values = readings_of(self.ARRAY, [(PLACE, MOMENT)], ambient=AMBIENT)
        command = files.write(wrong, values, ambient=np.tile(AMBIENT, (3, 1)))
        for row in results_of(run(*command, *AT_PLACE, "--json")):
            np.testing.assert_allclose(row["solutions"][0]["moment_Am2"], MOMENT, atol=5.0)

    def test_ambient_from_place_and_date(self, run: Run, files: Files) -> None:
        ambient = field_enu(48.1, 11.6, 520.0, np.datetime64("2026-11-21"))
        command = files.write(self.ARRAY, readings_of(self.ARRAY, [(PLACE, MOMENT)], ambient=ambient))
        where = ("--place", "48.1", "11.6", "520", "--date", "2026-11-21")
        for row in results_of(run(*command, *AT_PLACE, *where, "--json")):
            (solution,) = row["solutions"]
            deviation = np.array(solution["moment_Am2"]) - MOMENT
            assert deviation @ np.linalg.solve(solution["covariance"], deviation) < 21.1

    def test_place_of_a_turned_array(self, run: Run, files: Files) -> None:
        """The world is east-north-up; position, results and the ambient field are turned with the array's pose."""
        ambient = field_enu(-33.9, 18.4, 10.0, np.datetime64("2026-11-21"))
        turns = Rotation.random(3, random_state=1)
        origins = np.random.default_rng(2).uniform(-1.0, 1.0, (3, 3))
        values = [
            readings_of(
                self.ARRAY,
                [(turn.inv().apply(PLACE - origin), turn.inv().apply(MOMENT))],
                1,
                ambient=turn.inv().apply(ambient),
            )[0]
            for turn, origin in zip(turns, origins, strict=True)
        ]
        command = files.write(self.ARRAY, np.stack(values), pose=(origins, turns))
        where = ("--place", "-33.9", "18.4", "10", "--date", "2026-11-21")
        for row in results_of(run(*command, *AT_PLACE, *where, "--json")):
            (solution,) = row["solutions"]
            np.testing.assert_allclose(solution["position_m"], PLACE, atol=1e-9)
            deviation = np.array(solution["moment_Am2"]) - MOMENT
            assert deviation @ np.linalg.solve(solution["covariance"], deviation) < 21.1

    def test_without_ambient_field_both_signs_and_a_warning(self, run: Run, files: Files) -> None:
        quiet = replace(self.ARRAY, sensors=tuple(replace(s, noise_T=1e-11) for s in self.ARRAY.sensors))
        command = files.write(quiet, readings_of(quiet, [(PLACE, MOMENT)]))
        outcome = run(*command, *AT_PLACE, "--json")
        assert "no ambient field" in outcome.err
        for row in results_of(outcome):
            moments = np.array([solution["moment_Am2"] for solution in row["solutions"]])
            for sign in (1.0, -1.0):
                assert np.linalg.norm(moments - sign * MOMENT, axis=1).min() < 5.0

    def test_table(self, run: Run, files: Files) -> None:
        array = replace(self.ARRAY, ambient_T=tuple(AMBIENT))
        outcome = run(*files.write(array, readings_of(array, [(PLACE, MOMENT)], ambient=AMBIENT)), *AT_PLACE)
        assert outcome.status == 0
        assert "s_m" in outcome.out.splitlines()[0]
        assert len(outcome.out.splitlines()) == 4


class TestScalarSensors:
    """Position and moment from moduli."""

    def test_six_unknowns(self, run: Run, files: Files) -> None:
        array = replace(scalar_cloud(), ambient_T=tuple(AMBIENT))
        command = files.write(array, readings_of(array, [(PLACE * 0.7, MOMENT)], ambient=AMBIENT))
        for row in results_of(run(*command, "--json")):
            best = row["solutions"][0]
            np.testing.assert_allclose(best["position_m"], PLACE * 0.7, atol=5e-3)
            assert np.shape(best["covariance"]) == (6, 6)
            assert best["range_observable"]
            low, high = best["range_interval95_m"][0]
            assert low < np.linalg.norm(best["position_m"] - array.centroid) < high

    def test_four_are_too_few(self, run: Run, files: Files) -> None:
        array = replace(tetrahedron(1.5, "scalar", 1e-10), ambient_T=tuple(AMBIENT))
        outcome = run(*files.write(array, readings_of(array, [(PLACE, MOMENT)], ambient=AMBIENT)))
        assert_refused(outcome, "array.toml", "6 independent differences", "gives 3", "--position")

    def test_ambient_gradient(self, run: Run, files: Files) -> None:
        """A gradient a thousand times the Earth's, from the array file, is modelled; without it the fit is off."""
        gradient = 1e-9 * np.array([[20.0, 5.0, 0.0], [5.0, -30.0, 8.0], [0.0, 8.0, 10.0]])
        array = replace(
            scalar_cloud(), ambient_T=tuple(AMBIENT), ambient_gradient_T_m=tuple(map(tuple, gradient.tolist()))
        )
        values = readings_of(array, [(PLACE * 0.7, MOMENT)], ambient=AMBIENT + array.positions @ gradient.T)
        with_it = results_of(run(*files.write(array, values), "--json"))
        without = results_of(run(*files.write(replace(array, ambient_gradient_T_m=None), values), "--json"))
        assert with_it[0]["solutions"][0]["chi2"] < 30.0
        assert not without[0]["solutions"] or without[0]["solutions"][0]["chi2"] > 1000.0


class TestSeveralSources:
    SOURCES = (
        (np.array([0.5, 0.3, -1.2]), np.array([5.0, 5.0, 5.0])),
        (np.array([-0.5, -0.2, -1.0]), np.array([0.0, 10.0, -5.0])),
    )

    @pytest.mark.parametrize("number", ["auto", "2"])
    def test_json(self, run: Run, files: Files, number: str) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), self.SOURCES))
        for row in results_of(run(*command, "--sources", number, "--json")):
            best = row["solutions"][0]
            found = np.array([source["position_m"] for source in best["sources"]])
            assert len(found) == 2
            # The stronger one first, and in the same place in every row.
            np.testing.assert_allclose(found, [self.SOURCES[1][0], self.SOURCES[0][0]], atol=0.01)
            assert np.shape(best["covariance"]) == (12, 12)
            for k, source in enumerate(best["sources"]):
                block = np.array(best["covariance"])[6 * k : 6 * k + 6, 6 * k : 6 * k + 6]
                np.testing.assert_allclose(source["covariance"], block)
                assert source["merged"] is False

    def test_one_of_one(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), self.SOURCES[:1]))
        for row in results_of(run(*command, "--sources", "auto", "--json")):
            assert len(row["solutions"][0]["sources"]) == 1

    def test_more_than_there_are(self, run: Run, files: Files) -> None:
        outcome = run(
            *files.write(vector_plate(), readings_of(vector_plate(), self.SOURCES)), "--sources", "3", "--json"
        )
        for row in results_of(outcome):
            assert len(row["solutions"][0]["sources"]) == 2
            assert "3 were requested" in row["reason"]
        assert "3 were requested" in outcome.err

    def test_noise_alone(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), []))
        assert_refused(run(*command, "--sources", "auto", "--quiet"), "noise alone")

    def test_table(self, run: Run, files: Files) -> None:
        outcome = run(*files.write(vector_plate(), readings_of(vector_plate(), self.SOURCES)), "--sources", "auto")
        lines = outcome.out.splitlines()
        assert "source" in lines[0]
        assert len(lines) == 1 + 3 * 2

    @pytest.mark.parametrize("number", ["8", "0", "-1", "two", "1.5"])
    def test_bad_numbers(self, run: Run, files: Files, number: str) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), self.SOURCES))
        assert_refused(run(*command, "--sources", number), "--sources")

    def test_too_many_says_how_many_are_possible(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), self.SOURCES))
        assert_refused(run(*command, "--sources", "8"), "between 1 and 7", "45 independent differences")


class TestBadSensors:
    SOURCE = (np.array([0.5, 0.3, -1.2]), np.array([5.0, 5.0, 5.0]))

    def test_dead_sensor_is_named(self, run: Run, files: Files) -> None:
        values = readings_of(vector_plate(), [self.SOURCE], ambient=AMBIENT)
        values[1, :3] = 0.0
        outcome = run(*files.write(vector_plate(), values), "--json")
        rows = results_of(outcome)
        assert [row.get("dropped_sensors", []) for row in rows] == [[], ["v0"], []]
        assert "v0 (1 row)" in outcome.err
        for row in rows:
            np.testing.assert_allclose(row["solutions"][0]["position_m"], self.SOURCE[0], atol=0.01)
        kept = results_of(run(*files.write(vector_plate(), values), "--json", "--keep-sensors"))
        assert "dropped_sensors" not in kept[1]

    def test_saturated_channel_is_missing(self, run: Run, files: Files) -> None:
        array = vector_plate(saturation_T=1e-4)
        values = readings_of(array, [self.SOURCE])
        values[2, 4] = 1e-4
        outcome = run(*files.write(array, values), "--json")
        rows = results_of(outcome)
        assert [row.get("saturated_channels", []) for row in rows] == [[], [], ["v1_y"]]
        assert "v1_y" in outcome.err
        assert rows[2]["solutions"][0]["dof"] == rows[0]["solutions"][0]["dof"] - 1

    def test_one_sensor_cannot_make_a_source(self, run: Run, files: Files) -> None:
        values = readings_of(vector_plate(), TestSeveralSources.SOURCES)
        values[0, :3] = 0.0
        row = results_of(run(*files.write(vector_plate(), values), "--sources", "auto", "--json"))[0]
        assert len(row["solutions"][0]["sources"]) == 2
        assert row["dropped_sensors"] == ["v0"]


class TestMisfit:
    """Where the model is wrong no sensor is blamed, and the row says that its uncertainty is not to be trusted."""

    def test_wrong_place(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), [TestBadSensors.SOURCE]))
        outcome = run(*command, "--position", "0.6", "0.3", "-1.2", "--json")
        for row in results_of(outcome):
            assert row["misfit"]
            assert "dropped_sensors" not in row
        assert "χ² is far beyond noise" in outcome.err

    def test_moment_that_is_too_small(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), [TestBadSensors.SOURCE]))
        outcome = run(*command, "--max-moment-Am2", "2", "--json")
        assert "dropped_sensors" not in outcome.out

    def test_right_model(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), [TestBadSensors.SOURCE]))
        assert not any("misfit" in row for row in results_of(run(*command, "--json")))


class TestAverage:
    def test_changing_ambient_field(self, run: Run, files: Files) -> None:
        """The mean of moduli is not the modulus of the mean."""
        array = scalar_cloud()
        ambient = np.stack([AMBIENT, AMBIENT[[2, 1, 0]]])
        values = np.concatenate([readings_of(array, [(PLACE * 0.7, MOMENT)], 1, field) for field in ambient])
        outcome = run(*files.write(array, values, ambient=ambient), "--average")
        assert_refused(outcome, "readings.csv", "ambient field changed between lines 2 and 3")

    def test_rows_that_are_left_out_are_counted(self, run: Run, files: Files) -> None:
        values = readings_of(vector_plate(), [TestBadSensors.SOURCE], 5)
        values[1:3, 0] = np.nan
        outcome = run(*files.write(vector_plate(), values), "--average")
        assert outcome.status == 0
        assert "3 of 5 rows are averaged" in outcome.err


class TestTurningArray:
    def test_constant_ambient_field_in_its_axes(self, run: Run, files: Files) -> None:
        array = replace(scalar_cloud(), ambient_T=tuple(AMBIENT))
        turns = Rotation.from_rotvec(np.radians([[0.0, 0.0, angle] for angle in (0.0, 40.0, 80.0)]))
        values = readings_of(array, [(PLACE * 0.7, MOMENT)], ambient=AMBIENT)
        command = files.write(array, values, pose=(np.zeros((3, 3)), turns))
        assert_refused(run(*command), "ambient_nT", "rotates")


class TestTooNear:
    def test_body_length(self, run: Run, files: Files) -> None:
        command = files.write(vector_plate(), readings_of(vector_plate(), [TestBadSensors.SOURCE]))
        near = results_of(run(*command, "--json", "--body-length-m", "0.5"))
        far = results_of(run(*command, "--json", "--body-length-m", "0.2"))
        assert all(row["too_near"] for row in near)
        assert not any("too_near" in row for row in far)
        assert "too near" in run(*command, "--body-length-m", "0.5").err

    def test_a_quarter_of_the_distance_is_assumed_and_said(self, run: Run, files: Files) -> None:
        close = (np.array([0.05, 0.0, -0.3]), np.array([0.0, 0.0, 1.0]))
        board = grid(7, 7, 0.15)
        command = files.write(board, readings_of(board, [close]))
        assert all(0.07 < row["body_length_m"] < 0.08 for row in results_of(run(*command, "--json")))
        assert "a length of a quarter of its distance is assumed" in run(*command).err
        point = run(*command, "--json", "--body-length-m", "0")
        assert not any("body_length_m" in row for row in results_of(point))
        assert "assumed" not in point.err
        assert_refused(run(*command, "--body-length-m", "-1"), "--body-length-m", "-1")

    def test_pattern_of_two_poles(self, run: Run, files: Files) -> None:
        """A bar a metre long at a metre's distance, as two dipoles at its ends: no dipole, and said so."""
        ends = [(np.array([x, 0.0, -1.0]), np.array([0.0, 0.0, 10.0])) for x in (-0.5, 0.5)]
        rows = results_of(run(*files.write(vector_plate(), readings_of(vector_plate(), ends)), "--json"))
        assert all(row["too_near"] for row in rows)


class TestGeomagneticOptions:
    @pytest.mark.parametrize(
        ("options", "fragments"),
        [
            (("--place", "48", "11", "0"), ("--place", "--date")),
            (("--date", "2026-11-21"), ("--date", "--place")),
            (("--place", "48", "11", "0", "--date", "2036-11-21"), ("--date", "1900", "2030")),
            (("--place", "48", "11", "0", "--date", "yesterday"), ("--date", "yesterday")),
            (("--place", "48", "11", "0", "--date", "2026-13-41"), ("--date", "2026-13-41")),
            (("--place", "98", "11", "0", "--date", "2026-11-21"), ("--place", "latitude")),
            (
                ("--place", "48", "11", "0", "--date", "2024-11-21", "--geomagnetic-model", "WMM2025"),
                ("--date", "2025"),
            ),
            (
                ("--place", "48", "11", "0", "--date", "2026-11-21", "--geomagnetic-model", "WMM"),
                ("--geomagnetic-model", "WMM2025"),
            ),
            (("--ambient-gradient",), ("--ambient-gradient", "no place")),
            (("--position", "1", "2"), ("--position",)),
            (("--position", "1", "2", "nan"), ("--position",)),
            (("--position", "0", "0", "0.9185586535436918"), ("--position", "sensor")),
            (("--position", "1", "2", "3", "--sources", "2"), ("--position", "--sources")),
            (("--body-length-m", "-1", "--position", "1", "2", "3"), ("--body-length-m",)),
        ],
    )
    def test_refused(self, run: Run, files: Files, options: tuple[str, ...], fragments: tuple[str, ...]) -> None:
        array = replace(tetrahedron(1.5, "scalar", 1e-10), ambient_T=tuple(AMBIENT))
        command = files.write(array, readings_of(array, [(PLACE, MOMENT)], ambient=AMBIENT))
        assert_refused(run(*command, "--quiet", *options), *fragments)
