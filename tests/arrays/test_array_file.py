"""The TOML file of an array: what is read, that writing loses nothing, and how each refusal reads."""

from __future__ import annotations

import math
import os
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.array_file import array_of_table, array_toml, read_array, write_array
from arrays.geometries import GEOMETRIES, tetrahedron
from arrays.io.errors import InputError
from arrays.pose import PoseUncertainty
from arrays.sensor import Calibration, Sensor
from tests.written import WriteFile, writer

GEOMETRY = """\
geometry = "tetrahedron"
edge_m = 1.5
kind = "vector"
noise_nT = 1.0
"""
SENSORS = """\
[[sensor]]
id = "s1"
kind = "vector"
position_m = [0.0, 0.0, 0.918]
noise_nT = 1.0

[[sensor]]
id = "s2"
kind = "scalar"
position_m = [1, 0, 0]
noise_nT = 2
"""
QUALITY = """\
saturation_nT = 100_000
misalignment_mrad = 0.1
gain_uncertainty = 0.003
offset_uncertainty_nT = 0.5
flicker_nT = 0.01
drift_nT_rth = 20
induced_uncertainty = 2e-4
eddy_uncertainty_s = 3e-4
"""
LASTING = {
    "offset_uncertainty_T": 5e-10,
    "flicker_T": 1e-11,
    "drift_T_rth": 2e-8,
    "induced_uncertainty": 2e-4,
    "eddy_uncertainty_s": 3e-4,
}


write = writer("array.toml")


def changed(text: str, old: str, new: str) -> str:
    """The text with one place changed."""
    assert old in text
    return text.replace(old, new, 1)


finite = st.floats(-1e6, 1e6)
positive = st.floats(min_value=0.0, exclude_min=True, allow_infinity=False)
below_one = st.floats(0.0, 1.0, exclude_max=True)
names = st.text(st.characters(codec="utf-8", categories=("L", "N", "P", "S"), exclude_characters=',"'), min_size=1)


@st.composite
def calibrations(draw: st.DrawFn, kind: str) -> Calibration:
    n = 3 if kind == "vector" else 1
    factors = draw(st.lists(st.floats(0.5, 2.0), min_size=n, max_size=n))
    matrix = np.diag(factors)
    if draw(st.booleans()) and n == 3:
        matrix[0, 1] = draw(st.floats(-0.1, 0.1))
    return Calibration.of(kind, matrix, draw(st.lists(finite, min_size=n, max_size=n)))


@st.composite
def sensors(draw: st.DrawFn, name: str) -> Sensor:
    kind = draw(st.sampled_from(["vector", "scalar"]))
    q = np.array([0.0, 0.0, 0.0, 1.5]) + draw(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
    return Sensor(
        name,
        kind,
        draw(st.tuples(finite, finite, finite)),
        draw(positive),
        q / np.linalg.norm(q),
        draw(st.none() | calibrations(kind)),
        draw(st.none() | positive),
        draw(below_one) if kind == "vector" else 0.0,
        draw(below_one),
        *draw(st.tuples(*[st.just(0.0) | positive] * 3)),
    )


@st.composite
def gradients(draw: st.DrawFn) -> list[list[float]]:
    a, b, d, e, f = draw(st.tuples(finite, finite, finite, finite, finite))
    return [[a, d, e], [d, b, f], [e, f, -a - b]]


@st.composite
def any_arrays(draw: st.DrawFn) -> SensorArray:
    """Arrays with everything that an array can have."""
    ids = draw(st.lists(names, min_size=1, max_size=3, unique=True))
    members = [draw(sensors(f"{i}{name}")) for i, name in enumerate(ids)]
    return SensorArray(
        (*members, Sensor("far", "vector", (1e7, 0.0, 0.0), draw(positive))),
        draw(st.just("") | names),
        draw(st.floats(0.0, 1.0)),
        draw(st.none() | st.floats(0.0, 1e-3)),
        draw(st.none() | st.tuples(finite, finite, finite)),
        draw(st.none() | gradients()),
    )


class TestGeometryForm:
    """A geometry by its name."""

    def test_tetrahedron(self, write: WriteFile) -> None:
        assert read_array(write(GEOMETRY)) == tetrahedron(1.5)

    @pytest.mark.parametrize("name", GEOMETRIES)
    def test_every_geometry(self, write: WriteFile, name: str) -> None:
        make, size_key = GEOMETRIES[name]
        text = f'geometry = "{name}"\n{size_key} = 2\nkind = "scalar"\nnoise_nT = 0.1\n'
        assert read_array(write(text)) == make(2.0, "scalar", 1e-10)

    def test_header(self, write: WriteFile) -> None:
        header = 'name = "Turm №1"\nnoise_fraction = 0.01\ncommon_field_nT = 50\nambient_nT = [1, 2.5, -3]\n'
        header += "ambient_gradient_nT_m = [[1, 2, 0], [2, -1.5, 0.3], [0, 0.3, 0.5]]\nambient_uncertainty_nT = 50.0\n"
        assert read_array(write(f"format_version = 1\n{header}{GEOMETRY}")) == replace(
            tetrahedron(1.5),
            name="Turm №1",
            noise_fraction=0.01,
            common_field_T=5e-8,
            ambient_T=(1e-9, 2.5e-9, -3e-9),
            ambient_gradient_T_m=((1e-9, 2e-9, 0.0), (2e-9, -1.5e-9, 0.3e-9), (0.0, 0.3e-9, 0.5e-9)),
            ambient_uncertainty_T=5e-8,
        )

    def test_field_of_the_world_and_its_white_error(self, write: WriteFile) -> None:
        header = "ambient_world_nT = [1, 2.5, -3]\nambient_uncertainty_white_nT = 20\n"
        expected = replace(
            tetrahedron(1.5), name="", ambient_world_T=(1e-9, 2.5e-9, -3e-9), ambient_uncertainty_white_T=2e-8
        )
        assert read_array(write(f'name = ""\n{header}{GEOMETRY}')) == expected
        assert read_array(write(array_toml(expected))) == expected

    def test_proportional_noise_of_one_sensor(self, write: WriteFile) -> None:
        """Its own stands in place of that of the defaults, and that in place of the array's."""
        text = changed(SENSORS, 'id = "s2"', 'id = "s2"\nnoise_fraction = 0.02')
        text = f"noise_fraction = 0.5\n{text}"
        array = read_array(write(text))
        assert array.noise_fractions.tolist() == [0.5, 0.02, *[0.5] * (array.n_sensors - 2)]
        assert read_array(write(array_toml(array))) == array
        defaults = read_array(write(f"{text}\n[defaults]\nnoise_fraction = 0\n"))
        assert defaults.noise_fractions.tolist() == [0.0, 0.02, *[0.0] * (array.n_sensors - 2)]

    def test_one_sensor_in_a_common_field(self, write: WriteFile) -> None:
        array = read_array(write("common_field_nT = 5\n" + SENSORS[: SENSORS.rindex("[[sensor]]")]))
        assert array.ids == ("s1",)
        assert array.subset(["s1"]) == array

    def test_subtracted_background(self, write: WriteFile) -> None:
        array = read_array(write(f'background = "subtracted"\n{GEOMETRY}'))
        assert array == replace(tetrahedron(1.5), common_field_T=3e-7)
        assert read_array(write(array_toml(array))) == array

    def test_pose(self, write: WriteFile) -> None:
        """Constants that are left out are those of an ordinary mounting; writing and reading lose nothing."""
        table = "[pose]\nposition_m = 0.02\nattitude_deg = 0.3\ntime_s = 0.01\nlever_arm_m = [0.1, 0, -2]\n"
        array = read_array(write(GEOMETRY + table))
        assert array.pose == PoseUncertainty(0.02, math.radians(0.3), 0.01, lever_arm_m=(0.1, 0.0, -2.0))
        assert read_array(write(array_toml(replace(array, name="")))).pose == array.pose

    @pytest.mark.parametrize(
        ("line", "said"),
        [
            ("position_m = -1", "position_m: found -1"),
            ("attitude_deg = 30", "attitude_deg: found 30"),
            ("sigma_m = 1", "sigma_m: found an unknown key"),
        ],
    )
    def test_a_pose_that_is_none_is_refused(self, write: WriteFile, line: str, said: str) -> None:
        with pytest.raises(InputError, match=said):
            read_array(write(f"{GEOMETRY}[pose]\n{line}\n"))

    def test_quality_of_all_sensors(self, write: WriteFile) -> None:
        assert read_array(write(GEOMETRY + QUALITY)).sensors == tuple(
            replace(sensor, saturation_T=1e-4, misalignment_rad=1e-4, gain_uncertainty=0.003, **LASTING)
            for sensor in tetrahedron(1.5).sensors
        )

    @pytest.mark.parametrize("text", [b"\xef\xbb\xbf" + GEOMETRY.encode(), GEOMETRY.replace("\n", "\r\n")])
    def test_byte_order_mark_and_line_ends(self, write: WriteFile, text: str | bytes) -> None:
        assert read_array(write(text)) == tetrahedron(1.5)


class TestSensorsForm:
    """Sensors one by one."""

    def test_sensors(self, write: WriteFile) -> None:
        first = Sensor("s1", "vector", (0.0, 0.0, 0.918), 1e-9)
        second = Sensor("s2", "scalar", (1.0, 0.0, 0.0), 2e-9)
        assert read_array(write(SENSORS)) == SensorArray((first, second))

    def test_quality_of_one_sensor(self, write: WriteFile) -> None:
        first, second = read_array(write(changed(SENSORS, "noise_nT = 1.0\n", f"noise_nT = 1.0\n{QUALITY}"))).sensors
        assert (first.saturation_T, first.misalignment_rad, first.gain_uncertainty) == (1e-4, 1e-4, 0.003)
        assert (second.saturation_T, second.misalignment_rad, second.gain_uncertainty) == (None, 0.0, 0.0)
        assert {name: getattr(first, name) for name in LASTING} == LASTING
        assert {name: getattr(second, name) for name in LASTING} == dict.fromkeys(LASTING, 0.0)

    def test_rotation(self, write: WriteFile) -> None:
        array = read_array(write(f"{SENSORS}rotation_xyzw = [0.5, 0.5, 0.5, 0.5]\n"))
        np.testing.assert_allclose(array.rotation_matrices[1], [[0, 0, 1], [1, 0, 0], [0, 1, 0]], atol=1e-15)

    @pytest.mark.parametrize(
        ("scale", "matrix"),
        [
            ("2", [[2, 0, 0], [0, 2, 0], [0, 0, 2]]),
            ("[1, 2.0, 3]", [[1, 0, 0], [0, 2, 0], [0, 0, 3]]),
            ("[[1, 0.1, 0], [0, 1, 0], [0.5, 0, 1]]", [[1, 0.1, 0], [0, 1, 0], [0.5, 0, 1]]),
        ],
    )
    def test_calibration(self, write: WriteFile, scale: str, matrix: list[list[float]]) -> None:
        text = (
            f"{changed(SENSORS, 'scalar', 'vector')}[sensor.calibration]\nscale = {scale}\noffset_nT = [1, -2.5, 0]\n"
        )
        array = read_array(write(text))
        assert array.sensors[0].calibration == Calibration.of("vector")
        assert array.sensors[1].calibration == Calibration.of("vector", matrix, (1e-9, -2.5e-9, 0.0))

    @pytest.mark.parametrize("offset", ["3", "[3.0]"])
    def test_calibration_of_a_scalar_sensor(self, write: WriteFile, offset: str) -> None:
        array = read_array(write(f"{SENSORS}[sensor.calibration]\nscale = 2.0\noffset_nT = {offset}\n"))
        assert array.sensors[1].calibration == Calibration.of("scalar", 2.0, 3e-9)

    def test_recorded_array(self, data_folder: Path) -> None:
        path = data_folder / "magnet-array" / "array.toml"
        array = read_array(path)
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        assert array.n_sensors == 30
        assert array.name == table["name"]
        np.testing.assert_array_equal(array.positions, [sensor["position_m"] for sensor in table["sensor"]])
        scale = np.array([sensor["calibration"]["scale"] for sensor in table["sensor"]])
        np.testing.assert_allclose(array.channel_gain, np.kron(scale[:, None], np.eye(3)), rtol=1e-15)


class TestUnits:
    """nT become T by their decimals, so that what is written is what is meant."""

    @pytest.mark.parametrize(
        ("literal", "tesla"),
        [
            ("1", 1e-9),
            ("0.1", 0.1e-9),
            ("0.3", 0.3e-9),
            ("1e3", 1e-6),
            ("15_000.0", 15e-6),
            ("123456.789", 123456.789e-9),
            ("4.35", 4.35e-9),
            ("1.7e-290", 1.7e-299),
        ],
    )
    def test_noise(self, write: WriteFile, literal: str, tesla: float) -> None:
        assert read_array(write(changed(GEOMETRY, "1.0", literal))).sensors[0].noise_T == tesla

    def test_written_as_a_person_would(self) -> None:
        table = tomllib.loads(array_toml(tetrahedron(1.5, noise_T=1.5e-8)))
        assert [sensor["noise_nT"] for sensor in table["sensor"]] == [15.0] * 4
        assert "noise_nT = 15.0\n" in array_toml(tetrahedron(1.5, noise_T=1.5e-8))
        assert "noise_nT = 1.0\n" in array_toml(tetrahedron(1.5, noise_T=1e-9))
        assert "noise_nT = 50000.0\n" in array_toml(tetrahedron(1.5, noise_T=5e-5))


class TestRoundTrip:
    """What is written is read back, equal to the last digit."""

    @given(any_arrays())
    def test_any_array(self, tmp_path_factory: pytest.TempPathFactory, array: SensorArray) -> None:
        path = tmp_path_factory.getbasetemp() / "any.toml"
        write_array(path, array)
        assert read_array(path) == array

    def test_defaults_are_left_out(self) -> None:
        assert set(tomllib.loads(array_toml(tetrahedron(1.5)))) == {"format_version", "name", "sensor"}
        keys = {"id", "kind", "position_m", "noise_nT"}
        assert [set(sensor) for sensor in tomllib.loads(array_toml(tetrahedron(1.5)))["sensor"]] == [keys] * 4


class TestWriting:
    """A file is replaced as a whole or not at all."""

    def test_replaces(self, tmp_path: Path) -> None:
        path = tmp_path / "array.toml"
        path.write_text("old", encoding="utf-8")
        write_array(path, tetrahedron(1.5))
        assert path.read_text(encoding="utf-8") == array_toml(tetrahedron(1.5))
        assert os.listdir(tmp_path) == ["array.toml"]

    def test_through_a_link(self, tmp_path: Path) -> None:
        (tmp_path / "link.toml").symlink_to(tmp_path / "array.toml")
        write_array(tmp_path / "link.toml", tetrahedron(1.5))
        assert (tmp_path / "link.toml").is_symlink()
        assert read_array(tmp_path / "array.toml") == tetrahedron(1.5)

    def test_failure_leaves_the_old_file(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def no_space(*_: object) -> None:
            raise OSError(28, "No space left on device", "temporary")

        path = tmp_path / "array.toml"
        path.write_text("old", encoding="utf-8")
        monkeypatch.setattr(os, "replace", no_space)
        with pytest.raises(OSError, match="No space left on device") as error:
            write_array(path, tetrahedron(1.5))
        assert error.value.filename == str(path)
        assert path.read_text(encoding="utf-8") == "old"
        assert os.listdir(tmp_path) == ["array.toml"]

    def test_no_such_folder(self, tmp_path: Path) -> None:
        with pytest.raises(FileNotFoundError) as error:
            write_array(tmp_path / "none" / "array.toml", tetrahedron(1.5))
        assert error.value.filename == str(tmp_path / "none" / "array.toml")

    def test_a_folder(self, tmp_path: Path) -> None:
        with pytest.raises(IsADirectoryError):
            write_array(tmp_path, tetrahedron(1.5))


def assert_refused(path: Path, *parts: str) -> None:
    """One sentence that begins with the file and has all parts."""
    with pytest.raises(InputError) as error:
        read_array(path)
    text = str(error.value)
    assert text.startswith(str(path))
    assert text.endswith(".")
    assert "\n" not in text
    assert ". " not in text.removeprefix(str(path))
    for part in parts:
        assert part in text


class TestUnreadable:
    """Files that are no text, or no TOML."""

    def test_missing(self, tmp_path: Path) -> None:
        assert_refused(tmp_path / "none.toml", "does not exist")

    def test_directory(self, tmp_path: Path) -> None:
        assert_refused(tmp_path, "is a directory")

    @pytest.mark.parametrize("text", ["", "\n\n", "# nothing here\n"])
    def test_empty(self, write: WriteFile, text: str) -> None:
        assert_refused(write(text), "is empty")

    def test_not_utf8(self, write: WriteFile) -> None:
        assert_refused(write(b'name = "a"\nname = "\xff"\n'), "line 2", "0xff", "UTF-8")

    @pytest.mark.parametrize(
        ("text", "line"),
        [
            ("edge_m 1.5\n", 1),
            (changed(GEOMETRY, "= 1.5", "="), 2),
            (changed(GEOMETRY, '"vector"', "vector"), 3),
            (changed(GEOMETRY, "1.0\n", "1.0.0"), 4),
            (changed(GEOMETRY, "1.0\n", "["), 4),
            (GEOMETRY + "edge_m = 2\n", 5),
        ],
    )
    def test_broken_toml(self, write: WriteFile, text: str, line: int) -> None:
        assert_refused(write(text), f"line {line}: ", "found what is not TOML")

    @pytest.mark.parametrize("value", ["1e" + "9" * 30, "1" * 5000])
    def test_number_out_of_range(self, write: WriteFile, value: str) -> None:
        assert_refused(write(changed(GEOMETRY, "1.5", value)), "found a number out of range")

    def test_nested_too_deeply(self, write: WriteFile) -> None:
        assert_refused(write(f"name = {'[' * 5000}"), "nested too deeply")


class TestRefused:
    """TOML that is no array."""

    @pytest.mark.parametrize(
        ("old", "new", "parts"),
        [
            ('"tetrahedron"', '"tetraeder"', ("key geometry", "'tetraeder'", *GEOMETRIES)),
            ('"tetrahedron"', "4", ("key geometry", "found 4", "tetrahedron")),
            ("geometry", "geometrie", ("key geometrie", "unknown key", "nearest is geometry")),
            ("edge_m = 1.5", "", ("found no key edge_m", "the size of the tetrahedron")),
            ("edge_m", "arm_m", ("key arm_m", "the size of another geometry", "expected edge_m")),
            ("edge_m", "edge_cm", ("key edge_cm", "unknown key", "nearest is edge_m")),
            ("edge_m = 1.5", "edge_m = 0", ("edge_m must be a positive finite number", "received 0.0")),
            ("edge_m = 1.5", 'edge_m = "1.5"', ("key edge_m", "found text, expected a number")),
            ("edge_m = 1.5", "edge_m = true", ("key edge_m", "found a truth value, expected a number")),
            ('kind = "vector"', 'kind = "vektor"', ("kind must be 'vector' or 'scalar'", "'vektor'")),
            ('kind = "vector"', "", ("found no key kind",)),
            ("noise_nT = 1.0", "", ("found no key noise_nT",)),
            ("noise_nT", "noise_T", ("key noise_T", "nearest is noise_nT")),
            ("noise_nT = 1.0", "noise_nT = 0.0", ("key noise_nT", "found 0.0, expected a positive number")),
            ("noise_nT = 1.0", "noise_nT = inf", ("key noise_nT", "expected a finite number")),
            ("noise_nT = 1.0", 'noise_nT = "1"', ("key noise_nT", "found text, expected a number")),
            ("noise_nT = 1.0", "noise_nT = 1.0\nname = 1", ("key name", "found a whole number, expected text")),
            ("noise_nT = 1.0", 'noise_nT = 1.0\nname = "a\\nb"', ("name must be one line", "'a\\nb'")),
            ("noise_nT = 1.0", "noise_nT = 1.0\nformat_version = 2", ("key format_version", "found 2, expected 1")),
            ("noise_nT = 1.0", "noise_nT = 1.0\nnoise_fraction = -0.1", ("noise_fraction must not be negative",)),
            ("noise_nT = 1.0", "noise_nT = 1.0\ncommon_field_nT = -1", ("key common_field_nT", "not negative")),
            ("noise_nT = 1.0", 'noise_nT = 1.0\nbackground = "no"', ("key background", "'no'", "one of subtracted")),
            (
                "noise_nT = 1.0",
                'noise_nT = 1.0\ncommon_field_nT = 1\nbackground = "subtracted"',
                ("key background: found it together with common_field_nT",),
            ),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\nambient_nT = 5",
                ("key ambient_nT", "found a whole number, expected a list"),
            ),
            ("noise_nT = 1.0", "noise_nT = 1.0\nambient_nT = [1, 2]", ("key ambient_nT", "length 2", "length 3")),
            ("noise_nT = 1.0", "noise_nT = 1.0\nambient_nT = [1, 2, nan]", ("key ambient_nT", "finite")),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\nambient_gradient_nT_m = [[1, 0, 0], [0, 1, 0], [0, 0, 1]]",
                ("ambient_gradient_T_m must be traceless",),
            ),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\nambient_gradient_nT_m = [[0, 1], [1, 0]]",
                ("key ambient_gradient_nT_m", "length 2", "length 3"),
            ),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\nambient_gradient_nT_m = [[0, inf, 0], [0, 0, 0], [0, 0, 0]]",
                ("key ambient_gradient_nT_m", "finite"),
            ),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\nsaturation_nT = 0",
                ("key saturation_nT", "expected a positive number"),
            ),
            ("noise_nT = 1.0", "noise_nT = 1.0\nsaturation_nT = 'x'", ("key saturation_nT", "found text")),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\nmisalignment_mrad = 1000",
                ("key misalignment_mrad", "found 1000, expected a number from 0 to below 1000"),
            ),
            (
                "noise_nT = 1.0",
                "noise_nT = 1.0\noffset_uncertainty_nT = -0.5",
                ("key offset_uncertainty_nT", "found -0.5, expected a number that is not negative"),
            ),
            ("noise_nT = 1.0", "noise_nT = 1.0\nflicker_nT = -1", ("key flicker_nT", "found -1")),
            ("noise_nT = 1.0", "noise_nT = 1.0\ndrift_nT_rth = inf", ("key drift_nT_rth", "finite")),
            ("noise_nT = 1.0", "noise_nT = 1.0\ngain_uncertainty = 2", ("gain_uncertainty must be from 0 to below 1",)),
            ("noise_nT = 1.0", "noise_nT = 1.0\n[[sensor]]", ("keys geometry and sensor", "found both")),
        ],
    )
    def test_geometry_form(self, write: WriteFile, old: str, new: str, parts: tuple[str, ...]) -> None:
        assert_refused(write(changed(GEOMETRY, old, new)), *parts)

    @pytest.mark.parametrize(
        ("old", "new", "parts"),
        [
            ('id = "s1"', "", ("sensor number 1", "found no key id")),
            ('id = "s1"', 'id = "a\\nb"', ("sensor number 1", "id must be printable text", "'a\\nb'")),
            ('id = "s1"', "id = 1", ("sensor number 1", "key id", "found a whole number, expected text")),
            ('id = "s1"', 'id = "s2"', ("sensors must have different ids", "'s2' 2 times")),
            ('id = "s2"', 'id = "s1_x"', ("sensors must have different columns", "s1_x_nT")),
            ('kind = "vector"', 'kind = "tensor"', ("sensor s1", "kind must be 'vector' or 'scalar'", "'tensor'")),
            ('kind = "vector"', "", ("sensor s1", "found no key kind")),
            ("[0.0, 0.0, 0.918]", "[0.0, 0.918]", ("sensor s1, key position_m", "length 2", "length 3")),
            ("[0.0, 0.0, 0.918]", "0.918", ("sensor s1, key position_m", "found a number, expected a list")),
            ("[0.0, 0.0, 0.918]", '[0.0, 0.0, "up"]', ("sensor s1, key position_m[2]", "found text")),
            ("[0.0, 0.0, 0.918]", "[0.0, 0.0, 1e300]", ("sensor s1", "position_m must be 1e+30 at most")),
            ("[0.0, 0.0, 0.918]", "[0.0, 0.0, 2e9]", ("sensors must stand within 1e+09 m",)),
            ("noise_nT = 1.0", "noise_nT = 0", ("sensor s1, key noise_nT", "expected a positive number")),
            ("noise_nT = 1.0", "nose_nT = 1.0", ("sensor s1, key nose_nT", "nearest is noise_nT")),
            ("[[sensor]]", "kind = 'vector'\n[[sensor]]", ("key kind", "found at the top", "each [[sensor]]")),
            ("[[sensor]]", "nmae = 'x'\n[[sensor]]", ("key nmae", "unknown key", "nearest is name")),
            (SENSORS, "name = 'x'", ("found neither the key geometry nor [[sensor]] tables",)),
            (SENSORS, "sensor = []", ("sensors must be at least 1; instead received 0",)),
            (SENSORS, "sensor = 5", ("key sensor", "found a whole number, expected a list")),
            (SENSORS, "sensor = [5, 6]", ("sensor number 1", "found a whole number, expected a table")),
            (SENSORS, "[sensor]\nid = 's1'", ("key sensor", "found a table, expected a list")),
            (
                SENSORS,
                SENSORS[: SENSORS.rindex("[[sensor]]")],
                ("sensors must be at least 2, or 1 with a common_field_nT; instead received 1",),
            ),
        ],
    )
    def test_sensors_form(self, write: WriteFile, old: str, new: str, parts: tuple[str, ...]) -> None:
        assert_refused(write(changed(SENSORS, old, new)), *parts)

    @pytest.mark.parametrize(
        ("kind", "line", "parts"),
        [
            ("vector", "rotation_xyzw = [0, 0, 0, 2]", ("rotation_xyzw must be a quaternion of norm 1", "norm 2")),
            ("vector", "rotation_xyzw = [0, 0, 1]", ("key rotation_xyzw", "length 3", "length 4")),
            ("scalar", "misalignment_mrad = 1.0", ("misalignment_rad must be 0 for a scalar sensor",)),
            ("vector", "saturation_nT = -5", ("key saturation_nT", "found -5, expected a positive number")),
            ("vector", "calibration = 2.0", ("key calibration", "found a number, expected a table")),
            ("vector", "calibration.scal = 1", ("key calibration.scal", "nearest is calibration.scale")),
            ("vector", "calibration.scale = 'x'", ("key calibration.scale", "expected a number or a list")),
            ("vector", "calibration.scale = 0", ("scale must be a regular matrix",)),
            (
                "vector",
                "calibration.offset_nT = 1",
                ("key calibration.offset_nT", "found 1 number, expected 3 numbers"),
            ),
            ("vector", "calibration.offset_nT = [1, 2]", ("found 2 numbers, expected 3 numbers for a vector sensor",)),
            (
                "scalar",
                "calibration.offset_nT = [1, 2, 3]",
                ("found 3 numbers, expected 1 number for a scalar sensor",),
            ),
            ("vector", "calibration.offset_nT = [1, 2, inf]", ("key calibration.offset_nT", "finite")),
            ("vector", "calibration.offset_nT = [1, 2, 'x']", ("key calibration.offset_nT[2]", "found text")),
        ],
    )
    def test_second_sensor(self, write: WriteFile, kind: str, line: str, parts: tuple[str, ...]) -> None:
        assert_refused(write(changed(SENSORS, '"scalar"', f'"{kind}"') + line), "sensor s2", *parts)


class TestDefaults:
    BOARD = """
[defaults]
kind = "vector"
noise_nT = 15
ypr_deg = [90, 0, 0]
[[sensor]]
id = "s1"
position_m = [0, 0, 0]
[[sensor]]
id = "s2"
kind = "scalar"
position_m = [1, 0, 0]
noise_nT = 0.1
[[sensor]]
id = "s3"
position_m = [0, 1, 0]
rotation_xyzw = [1, 0, 0, 0]
"""

    def test_hold_where_a_sensor_says_nothing(self, write: WriteFile) -> None:
        array = read_array(write(self.BOARD))
        assert [sensor.kind for sensor in array.sensors] == ["vector", "scalar", "vector"]
        assert [sensor.noise_T for sensor in array.sensors] == [15e-9, 1e-10, 15e-9]
        np.testing.assert_allclose(array.sensors[0].rotation_xyzw, [0, 0, np.sqrt(0.5), np.sqrt(0.5)], rtol=1e-15)
        assert array.sensors[2].rotation_xyzw == (1.0, 0.0, 0.0, 0.0)

    @pytest.mark.parametrize(
        ("old", "new", "fragments"),
        [
            ("noise_nT = 15", "noise_T = 15", ("table defaults", "key noise_T", "nearest is noise_nT")),
            ("noise_nT = 15", 'id = "s1"', ("table defaults", "key id", "unknown")),
            ("[defaults]", "defaults = 1\n[other]", ("key defaults", "expected a table")),
            ("noise_nT = 15", 'noise_nT = "15"', ("sensor s1", "key noise_nT")),
            ("rotation_xyzw = [1, 0, 0, 0]", "rotation_xyzw = [1, 0, 0, 0]\nypr_deg = [0, 0, 0]", ("one of them",)),
            ("ypr_deg = [90, 0, 0]", "ypr_deg = [inf, 0, 0]", ("sensor s1", "ypr_deg", "finite")),
            ("ypr_deg = [90, 0, 0]", "ypr_deg = [90, 0]", ("sensor s1", "ypr_deg")),
        ],
    )
    def test_refused(self, old: str, new: str, fragments: tuple[str, ...], write: WriteFile) -> None:
        with pytest.raises(InputError) as error:
            read_array(write(self.BOARD.replace(old, new)))
        assert all(fragment in str(error.value) for fragment in fragments)


@given(st.tuples(*[st.floats(-360.0, 360.0)] * 3))
def test_yaw_pitch_and_roll_are_those_of_scipy(ypr_deg: tuple[float, float, float]) -> None:
    sensor = {"id": "s1", "kind": "vector", "position_m": [0, 0, 0], "noise_nT": 1, "ypr_deg": list(ypr_deg)}
    array = array_of_table("test", {"sensor": [sensor, {**sensor, "id": "s2", "position_m": [1, 0, 0]}]})
    found = Rotation.from_quat(array.sensors[0].rotation_xyzw)
    assert (found * Rotation.from_euler("ZYX", ypr_deg, degrees=True).inv()).magnitude() < 1e-12
