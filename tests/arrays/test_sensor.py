"""Sensors and arrays: what they read, and what they refuse.

| what | who checks it |
|---|---|
| readings of turned sensors | magpylib's sensors, and a quarter turn by hand |
| rotation matrices, calibration | scipy's Rotation applied vector by vector |
| calibrated_field | the fields that went into readings_of |
"""

from __future__ import annotations

import copy
import pickle
from dataclasses import FrozenInstanceError, replace
from functools import cached_property

import magpylib
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.io.errors import InputError
from arrays.sensor import Calibration, Sensor

SEEDS = st.integers(0, 2**32 - 1)
QUARTER_TURN_Z = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))
GRADIENT = ((1e-9, 2e-9, 3e-9), (2e-9, -5e-9, 6e-9), (3e-9, 6e-9, 4e-9))
ARRAY_PROPERTIES = (
    "positions",
    "centroid",
    "rotation_matrices",
    "channel_sensor",
    "channel_is_scalar",
    "channel_noise_T",
    "channel_offset_T",
    "channel_gain",
    "channel_saturation_T",
    "sensor_channels",
    "ambient_fields",
)


def random_array(seed: int, kinds: tuple[str, ...] = ("vector", "scalar", "vector")) -> SensorArray:
    """Sensors anywhere, turned anyhow, badly calibrated."""
    rng = np.random.default_rng(seed)
    sensors = []
    for i, kind in enumerate(kinds):
        n = 3 if kind == "vector" else 1
        calibration = Calibration.of(kind, np.eye(n) + 0.1 * rng.uniform(-1, 1, (n, n)), 1e-6 * rng.normal(size=n))
        rotation = Rotation.random(rng=rng).as_quat()
        sensors.append(Sensor(f"s{i}", kind, rng.normal(size=3), 1e-9, rotation, calibration))
    return SensorArray(tuple(sensors))


@pytest.fixture
def mixed() -> SensorArray:
    return SensorArray(
        (
            Sensor("a", "vector", (0.0, 0.0, 1.0), 1e-9, QUARTER_TURN_Z, saturation_T=1e-4, misalignment_rad=1e-3),
            Sensor("b", "scalar", (0.0, 3.0, 0.0), 2e-9, calibration=Calibration.of("scalar", 2.0, 5e-9)),
            Sensor(
                "c", "vector", (0.0, 0.0, -1.0), 3e-9, calibration=Calibration.of("vector", (1, 2, 3), (0, 0, 7e-9))
            ),
        ),
        name="mixed",
        noise_fraction=0.01,
        common_field_T=5e-8,
        ambient_T=(1e-5, 0.0, 4e-5),
        ambient_gradient_T_m=GRADIENT,
    )


class TestReadings:
    """reading = scale @ (field in sensor axes) + offset."""

    def test_quarter_turn(self, mixed: SensorArray) -> None:
        # a's x axis points along y of the array, and its y axis along -x.
        field = np.array([1e-6, 2e-6, 3e-6])
        readings = mixed.readings_of(np.tile(field, (3, 1)))
        assert_allclose(readings[:3], [2e-6, -1e-6, 3e-6], rtol=1e-15)
        assert_allclose(readings[3], 2.0 * np.sqrt(14e-12) + 5e-9, rtol=1e-15)
        assert_allclose(readings[4:], [1e-6, 4e-6, 9e-6 + 7e-9], rtol=1e-15)

    def test_of_magpylib(self) -> None:
        dipole = magpylib.misc.Dipole(moment=(30.0, -50.0, 80.0), position=(4.0, 1.0, -2.0))
        rng = np.random.default_rng(7)
        rotations = Rotation.random(5, rng=rng)
        positions = rng.normal(size=(5, 3))
        pairs = zip(positions, rotations, strict=True)
        array = SensorArray(tuple(Sensor(f"s{i}", "vector", p, 1e-9, r.as_quat()) for i, (p, r) in enumerate(pairs)))
        peers = [magpylib.Sensor(position=p, orientation=r) for p, r in zip(positions, rotations, strict=True)]
        seen = dipole.getB(peers)
        readings = array.readings_of(dipole.getB(positions))
        assert_allclose(readings, seen.ravel(), rtol=0.0, atol=1e-14 * np.abs(seen).max())

    @given(SEEDS)
    def test_of_scipy_rotations(self, seed: int) -> None:
        array = random_array(seed)
        fields = 5e-5 * np.random.default_rng(seed).normal(size=(array.n_sensors, 3))
        expected = []
        for sensor, field in zip(array.sensors, fields, strict=True):
            in_axes = Rotation.from_quat(sensor.rotation_xyzw).inv().apply(field)
            seen = in_axes if sensor.kind == "vector" else [np.linalg.norm(field)]
            expected.extend(np.array(sensor.calibration.scale) @ seen + sensor.calibration.offset_T)
        assert_allclose(array.readings_of(fields), expected, rtol=0.0, atol=1e-18)

    @pytest.mark.parametrize("batch", [(), (4,), (2, 3), (0,), (2, 0)])
    def test_batches(self, mixed: SensorArray, batch: tuple[int, ...]) -> None:
        fields = np.random.default_rng(1).normal(size=(*batch, 3, 3))
        readings = mixed.readings_of(fields)
        assert readings.shape == (*batch, 7)
        for index in np.ndindex(batch):
            assert_array_equal(readings[index], mixed.readings_of(fields[index]))

    def test_nan_stays_in_its_sensor(self, mixed: SensorArray) -> None:
        fields = np.ones((3, 3))
        fields[0, 1] = np.nan
        assert_array_equal(np.isnan(mixed.readings_of(fields)), [True] * 3 + [False] * 4)

    @pytest.mark.parametrize("shape", [(3,), (2, 3), (3, 2), (3, 3, 1)])
    def test_wrong_shape(self, mixed: SensorArray, shape: tuple[int, ...]) -> None:
        with pytest.raises(ValueError, match=r"Input fields must have shape \(\.\.\., 3, 3\); instead received"):
            mixed.readings_of(np.zeros(shape))


class TestCalibratedField:
    """The inverse of readings_of, for vector sensors."""

    @given(SEEDS, st.sampled_from([(), (3,), (2, 2), (0,)]))
    def test_inverse(self, seed: int, batch: tuple[int, ...]) -> None:
        array = random_array(seed)
        fields = 5e-5 * np.random.default_rng(seed).normal(size=(*batch, 3, 3))
        back = array.calibrated_field(array.readings_of(fields))
        assert_allclose(back[..., [0, 2], :], fields[..., [0, 2], :], rtol=0.0, atol=1e-18)
        assert np.isnan(back[..., 1, :]).all()

    @pytest.mark.parametrize("channel", [0, 1, 2, 4, 5, 6])
    def test_missing_channel(self, mixed: SensorArray, channel: int) -> None:
        fields = np.ones((3, 3))
        readings = mixed.readings_of(fields)
        readings[channel] = np.nan
        missing = mixed.channel_sensor[channel]
        back = mixed.calibrated_field(readings)
        assert np.isnan(back[missing]).all()
        assert_allclose(back[2 - missing], fields[0], rtol=1e-15)

    @pytest.mark.parametrize("batch", [(), (2,), (0,)])
    def test_scalar_sensors_alone(self, batch: tuple[int, ...]) -> None:
        array = random_array(3, ("scalar", "scalar"))
        result = array.calibrated_field(np.ones((*batch, 2)))
        assert result.shape == (*batch, 2, 3)
        assert np.isnan(result).all()

    def test_wrong_shape(self, mixed: SensorArray) -> None:
        with pytest.raises(ValueError, match=r"Input readings must have shape \(\.\.\., 7\); instead received \(3,\)"):
            mixed.calibrated_field(np.zeros(3))


class TestCalibration:
    """Short forms of a calibration mean the same as the long one."""

    def test_identity(self) -> None:
        assert Calibration.of("vector").scale == ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
        assert Calibration.of("vector").offset_T == (0.0, 0.0, 0.0)
        assert Calibration.of("scalar") == Calibration(((1.0,),), (0.0,))

    @pytest.mark.parametrize("scale", [2, 2.0, [2, 2, 2], np.full(3, 2.0), 2 * np.eye(3), np.float32(2)])
    def test_scale_forms(self, scale: object) -> None:
        long = Calibration(((2.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.0)), (1e-9, 1e-9, 1e-9))
        assert Calibration.of("vector", scale, 1e-9) == long

    @pytest.mark.parametrize("scale", [3.0, [3.0], [[3.0]]])
    def test_scalar_forms(self, scale: object) -> None:
        assert Calibration.of("scalar", scale, [2e-9]) == Calibration(((3.0,),), (2e-9,))

    @pytest.mark.parametrize(
        ("kind", "scale", "offset", "text"),
        [
            ("vector", 0.0, 0.0, "Input scale must be a regular matrix"),
            ("vector", [[1, 2, 3], [2, 4, 6], [0, 0, 1]], 0.0, "Input scale must be a regular matrix"),
            ("scalar", 0.0, 0.0, "Input scale must be a regular matrix"),
            ("vector", [1.0, 2.0], 0.0, "Input scale must be a number, 3 numbers or a 3×3 matrix; instead"),
            ("scalar", [1.0, 2.0, 3.0], 0.0, "Input scale must be a number; instead"),
            ("vector", [[1, 2, 3], [1, 2]], 0.0, "Input scale must be an array of numbers; instead"),
            ("vector", np.nan, 0.0, "Input scale must be finite; instead"),
            ("vector", 1.0, [0.0, np.inf, 0.0], "Input offset_T must be finite; instead"),
            ("vector", 1.0, [0.0, 0.0], "Input offset_T must be a number or 3 numbers; instead"),
            ("scalar", 1.0, [0.0, 0.0, 0.0], "Input offset_T must be a number; instead"),
            ("gradient", 1.0, 0.0, "Input kind must be 'vector' or 'scalar'; instead received 'gradient'"),
        ],
    )
    def test_refused(self, kind: str, scale: object, offset: object, text: str) -> None:
        with pytest.raises(ValueError, match=text):
            Calibration.of(kind, scale, offset)

    @pytest.mark.parametrize("exponent", [-12, 12])
    def test_small_is_not_singular(self, exponent: int) -> None:
        assert Calibration.of("vector", 10.0**exponent).scale[1][1] == 10.0**exponent

    def test_offset_of_two_channels(self) -> None:
        with pytest.raises(ValueError, match="Input offset_T must have 3 numbers, or 1 for a scalar sensor"):
            Calibration(((1.0, 0.0), (0.0, 1.0)), (0.0, 0.0))


class TestSensor:
    """One sensor, validated when it is made."""

    def test_array_likes_become_tuples(self) -> None:
        plain = Sensor("s1", "vector", (1.0, 2.0, 3.0), 1e-9, (0.0, 1.0, 0.0, 0.0), Calibration.of("vector"))
        arrays = Sensor("s1", "vector", np.array([1, 2, 3]), np.float64(1e-9), np.array([0, 1, 0, 0]))
        assert arrays == plain
        assert hash(arrays) == hash(plain)
        assert all(type(x) is float for x in (*arrays.position_m, *arrays.rotation_xyzw, arrays.noise_T))

    def test_frozen(self) -> None:
        sensor = Sensor("s1", "vector", (1.0, 2.0, 3.0), 1e-9)
        with pytest.raises(FrozenInstanceError):
            sensor.noise_T = 2e-9

    @pytest.mark.parametrize(("kind", "n"), [("vector", 3), ("scalar", 1)])
    def test_channels(self, kind: str, n: int) -> None:
        sensor = Sensor("s1", kind, (0, 0, 0), 1e-9)
        assert sensor.n_channels == n == len(sensor.channel_names) == len(sensor.calibration.offset_T)

    @given(SEEDS)
    def test_quaternion_is_normalised_once(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        q = rng.normal(size=4)
        q *= (1.0 + rng.uniform(-0.9e-6, 0.9e-6)) / np.linalg.norm(q)
        once = Sensor("s1", "vector", (0, 0, 0), 1e-9, q)
        assert_allclose(np.linalg.norm(once.rotation_xyzw), 1.0, rtol=0.0, atol=1e-15)
        assert_allclose(np.cross(once.rotation_xyzw[:3], q[:3]), 0.0, atol=1e-15)
        assert replace(once, noise_T=1.0).rotation_xyzw == once.rotation_xyzw

    @pytest.mark.parametrize(
        ("change", "text"),
        [
            ({"id": ""}, "Input id must be printable text"),
            ({"id": "a,b"}, "Input id must be printable text without commas"),
            ({"id": 'a"b'}, "Input id must be printable text"),
            ({"id": " a"}, "Input id must be printable text"),
            ({"id": "a\nb"}, "Input id must be printable text"),
            ({"id": 3}, "Input id must be printable text"),
            ({"kind": "tensor"}, "Input kind must be 'vector' or 'scalar'; instead received 'tensor'"),
            ({"position_m": [1, 2]}, r"Input position_m must have shape \(3,\); instead received \[1, 2\]"),
            ({"position_m": (0, 0, np.nan)}, "Input position_m must be finite; instead received"),
            ({"position_m": "here"}, "Input position_m must be an array of numbers; instead received here"),
            ({"noise_T": 0.0}, r"Input noise_T must be positive; instead received 0\.0"),
            ({"noise_T": -1e-9}, "Input noise_T must be positive; instead received -1e-09"),
            ({"noise_T": np.inf}, "Input noise_T must be finite; instead received inf"),
            ({"noise_T": [1e-9]}, r"Input noise_T must be one number; instead received \[1e-09\]"),
            ({"rotation_xyzw": (0, 0, 0, 1 + 2e-6)}, "Input rotation_xyzw must be a quaternion of norm 1; instead"),
            ({"rotation_xyzw": (0, 0, 0, 0)}, "Input rotation_xyzw must be a quaternion of norm 1; instead"),
            ({"rotation_xyzw": (0, 0, 1)}, r"Input rotation_xyzw must have shape \(4,\); instead"),
            ({"calibration": Calibration.of("scalar")}, "Input calibration must have 3 channels for a vector sensor"),
            ({"saturation_T": 0.0}, r"Input saturation_T must be positive; instead received 0\.0"),
            ({"saturation_T": np.nan}, "Input saturation_T must be finite; instead received nan"),
            (
                {"misalignment_rad": -1e-3},
                r"Input misalignment_rad must be from 0 to below 1; instead received -0\.001",
            ),
            ({"misalignment_rad": 1.0}, r"Input misalignment_rad must be from 0 to below 1; instead received 1\.0"),
            ({"misalignment_rad": np.inf}, "Input misalignment_rad must be finite; instead received inf"),
            ({"gain_uncertainty": -0.1}, r"Input gain_uncertainty must be from 0 to below 1; instead received -0\.1"),
            ({"gain_uncertainty": [0.1]}, r"Input gain_uncertainty must be one number; instead received \[0\.1\]"),
            (
                {"eddy_uncertainty_s": -1e-4},
                r"Input eddy_uncertainty_s must not be negative; instead received -0.0001",
            ),
            (
                {"offset_uncertainty_T": -1e-9},
                r"Input offset_uncertainty_T must not be negative; instead received -1e-09",
            ),
            ({"flicker_T": -1e-12}, r"Input flicker_T must not be negative; instead received -1e-12"),
            ({"drift_T_rth": -1e-9}, r"Input drift_T_rth must not be negative; instead received -1e-09"),
            ({"drift_T_rth": np.nan}, "Input drift_T_rth must be finite; instead received nan"),
            ({"flicker_T": [1.0, 2.0]}, r"Input flicker_T must be one number; instead received \[1.0, 2.0\]"),
            ({"kind": "scalar", "misalignment_rad": 1e-3}, "Input misalignment_rad must be 0 for a scalar sensor"),
        ],
    )
    def test_refused(self, change: dict[str, object], text: str) -> None:
        good = {"id": "s1", "kind": "vector", "position_m": (0, 0, 0), "noise_T": 1e-9}
        with pytest.raises(ValueError, match=text) as error:
            Sensor(**(good | change))
        assert not isinstance(error.value, InputError)
        assert str(error.value).endswith(".")

    def test_noise_of_one_row_counts_what_lasts(self) -> None:
        """1/f noise in three decades; drift has not begun, and errors of axes and gains depend on the reading."""
        quiet = Sensor("s1", "scalar", (0, 0, 0), 3e-9)
        assert quiet.row_noise_T == 3e-9
        lasting = replace(quiet, offset_uncertainty_T=4e-9, flicker_T=2e-9, drift_T_rth=1e-6, gain_uncertainty=0.1)
        assert lasting.row_noise_T == pytest.approx((9e-18 + 16e-18 + 3 * 4e-18) ** 0.5)
        array = SensorArray((lasting, Sensor("s2", "vector", (1, 0, 0), 1e-9)))
        np.testing.assert_allclose(array.channel_noise_T, [lasting.row_noise_T, 1e-9, 1e-9, 1e-9])


class TestSensorArray:
    """Arrays: what they know of their channels, by value, read-only."""

    def test_channels(self, mixed: SensorArray) -> None:
        assert mixed.ids == ("a", "b", "c")
        assert (mixed.n_sensors, mixed.n_channels) == (3, 7)
        assert mixed.channel_names == ("a_x", "a_y", "a_z", "b", "c_x", "c_y", "c_z")
        assert_array_equal(mixed.channel_sensor, [0, 0, 0, 1, 2, 2, 2])
        assert_array_equal(mixed.channel_is_scalar, [0, 0, 0, 1, 0, 0, 0])
        assert_array_equal(mixed.channel_noise_T, [1e-9] * 3 + [2e-9] + [3e-9] * 3)
        assert_array_equal(mixed.channel_offset_T, [0, 0, 0, 5e-9, 0, 0, 7e-9])
        assert_array_equal(mixed.channel_saturation_T, [1e-4] * 3 + [np.inf] * 4)
        assert_array_equal(mixed.sensor_channels, [[0, 1, 2], [3, -1, -1], [4, 5, 6]])

    def test_ambient_field_of_every_sensor(self, mixed: SensorArray) -> None:
        expected = np.array([[3e-9, 6e-9, 4e-9], [6e-9, -15e-9, 18e-9], [-3e-9, -6e-9, -4e-9]])
        assert_allclose(mixed.ambient_fields - mixed.ambient_T, expected, rtol=0.0, atol=1e-20)
        assert_allclose(replace(mixed, ambient_T=None).ambient_fields, expected, rtol=1e-15)
        assert_array_equal(replace(mixed, ambient_gradient_T_m=None).ambient_fields, [mixed.ambient_T] * 3)
        assert_array_equal(replace(mixed, ambient_T=None, ambient_gradient_T_m=None).ambient_fields, np.zeros((3, 3)))

    @pytest.mark.parametrize(
        ("fraction", "change", "depends"),
        [
            (0.0, {}, False),
            (0.01, {}, True),
            (0.0, {"misalignment_rad": 1e-4}, True),
            (0.0, {"gain_uncertainty": 1e-4}, True),
            (0.0, {"saturation_T": 1e-4}, False),
            (0.0, {"offset_uncertainty_T": 1e-9, "flicker_T": 1e-9, "drift_T_rth": 1e-9}, False),
        ],
    )
    def test_noise_that_depends_on_the_reading(
        self, mixed: SensorArray, fraction: float, change: dict[str, float], depends: bool
    ) -> None:
        sensors = (replace(mixed.sensors[2], **change), Sensor("d", "scalar", (0, 0, 0), 1e-9))
        assert SensorArray(sensors, noise_fraction=fraction).noise_depends_on_reading is depends

    def test_size(self, mixed: SensorArray) -> None:
        assert_array_equal(mixed.positions, [[0, 0, 1], [0, 3, 0], [0, 0, -1]])
        assert_array_equal(mixed.centroid, [0, 1, 0])
        assert mixed.circumradius == 2.0

    def test_gain_is_the_response_to_unit_fields(self, mixed: SensorArray) -> None:
        vector = ~mixed.channel_is_scalar
        for axis, unit in enumerate(np.eye(3)):
            response = mixed.readings_of(np.tile(unit, (3, 1))) - mixed.channel_offset_T
            assert_allclose(mixed.channel_gain[vector, axis], response[vector], rtol=0.0, atol=1e-15)
            assert_allclose(mixed.channel_gain[3, 0], response[3], rtol=1e-15)
        assert_array_equal(mixed.channel_gain[3, 1:], 0.0)

    @pytest.mark.parametrize("name", ARRAY_PROPERTIES)
    def test_read_only(self, mixed: SensorArray, name: str) -> None:
        value: NDArray[np.float64] = getattr(mixed, name)
        assert value is getattr(mixed, name)
        with pytest.raises(ValueError, match="read-only"):
            value[...] = 0

    @pytest.mark.parametrize("duplicate", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy])
    def test_copies(self, mixed: SensorArray, duplicate: object) -> None:
        for name in ARRAY_PROPERTIES:
            getattr(mixed, name)
        twin = duplicate(mixed)
        assert twin == mixed
        assert hash(twin) == hash(mixed)
        for name in ARRAY_PROPERTIES:
            assert_array_equal(getattr(twin, name), getattr(mixed, name))
            assert not getattr(twin, name).flags.writeable

    def test_sensors_of_any_iterable(self, mixed: SensorArray) -> None:
        assert SensorArray(list(mixed.sensors)).sensors == mixed.sensors
        assert SensorArray(sensor for sensor in mixed.sensors).sensors == mixed.sensors

    def test_in_another_ambient_field_it_is_as_made_there(self, mixed: SensorArray) -> None:
        """Whatever it has computed of itself before."""
        mixed = replace(mixed, ambient_T=(1e-6, 0.0, 0.0), ambient_gradient_T_m=np.diag([1e-9, 1e-9, -2e-9]).tolist())
        cached = [name for name, value in vars(SensorArray).items() if isinstance(value, cached_property)]
        for name in cached:
            getattr(mixed, name)
        field_T = np.array([2e-5, -1e-5, 4e-5])
        other, made = mixed.in_ambient_field(field_T), replace(mixed, ambient_T=tuple(field_T.tolist()))
        assert other == made == pickle.loads(pickle.dumps(other))
        assert other != mixed
        for name in cached:
            assert_array_equal(getattr(other, name), getattr(made, name), err_msg=name)
        with pytest.raises(ValueError, match="ambient_T"):
            mixed.in_ambient_field([np.nan, 0.0, 0.0])

    def test_subset(self, mixed: SensorArray) -> None:
        pair = mixed.subset(["c", "a"])
        assert pair == replace(mixed, sensors=(mixed.sensors[2], mixed.sensors[0]))

    @pytest.mark.parametrize(
        ("ids", "text"),
        [
            (["a", "x9"], "Input ids must be ids of sensors of the array; instead received 'x9'"),
            ([], "Input sensors must be at least 1; instead received 0"),
            (["a", "a", "b"], "Input sensors must have different ids; instead received 'a' 2 times"),
        ],
    )
    def test_subset_refused(self, mixed: SensorArray, ids: list[str], text: str) -> None:
        with pytest.raises(ValueError, match=text):
            mixed.subset(ids)

    def test_a_subset_of_one_needs_a_common_field(self, mixed: SensorArray) -> None:
        assert mixed.subset(["a"]).ids == ("a",)
        with pytest.raises(ValueError, match="at least 2 where no common field is known; instead received 1"):
            replace(mixed, common_field_T=None).subset(["a"])

    @pytest.mark.parametrize(
        ("change", "text"),
        [
            ({"name": "two\nlines"}, "Input name must be one line of printable text"),
            ({"noise_fraction": -0.1}, r"Input noise_fraction must not be negative; instead received -0\.1"),
            ({"noise_fraction": np.nan}, "Input noise_fraction must be finite"),
            ({"common_field_T": -1e-9}, "Input common_field_T must not be negative"),
            ({"common_field_T": np.inf}, "Input common_field_T must be finite"),
            ({"ambient_T": (1e-5, 0.0)}, r"Input ambient_T must have shape \(3,\)"),
            ({"ambient_T": (1e-5, 0.0, np.nan)}, "Input ambient_T must be finite"),
            ({"ambient_gradient_T_m": (1e-9, 0.0, 0.0)}, r"Input ambient_gradient_T_m must have shape \(3, 3\)"),
            ({"ambient_gradient_T_m": np.full((3, 3), np.nan)}, "Input ambient_gradient_T_m must be finite"),
            (
                {"ambient_gradient_T_m": ((0, 1e-9, 0), (1.00001e-9, 0, 0), (0, 0, 0))},
                "Input ambient_gradient_T_m must be symmetric to 1e-06 of its largest entry; instead received",
            ),
            (
                {"ambient_gradient_T_m": 1e-9 * np.diag([1.0, 1.0, -2.00001])},
                "Input ambient_gradient_T_m must be traceless to 1e-06 of its largest entry; instead received",
            ),
        ],
    )
    def test_refused(self, mixed: SensorArray, change: dict[str, object], text: str) -> None:
        with pytest.raises(ValueError, match=text):
            replace(mixed, **change)

    @pytest.mark.parametrize("at", [0.0, 1.0, 1e6])
    def test_one_place(self, at: float) -> None:
        position = (at, -at, at)
        nearby = tuple(np.nextafter(position, np.inf))
        with pytest.raises(ValueError, match="Input sensors must stand in two places at least; instead received 2"):
            SensorArray((Sensor("a", "vector", position, 1e-9), Sensor("b", "vector", nearby, 1e-9)))

    @pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
    def test_any_size_is_more_than_one_place(self, size: float) -> None:
        array = SensorArray((Sensor("a", "vector", (0, 0, 0), 1e-9), Sensor("b", "vector", (0, 0, size), 1e-9)))
        assert array.circumradius == size / 2

    @pytest.mark.parametrize(
        ("first", "second"),
        [
            (("a", "vector"), ("a_y", "scalar")),
            (("a_z", "scalar"), ("a", "vector")),
            (("ambient", "vector"), ("b", "vector")),
            (("b", "vector"), ("ambient_x", "scalar")),
        ],
    )
    def test_ids_that_name_one_column_twice(self, first: tuple[str, str], second: tuple[str, str]) -> None:
        sensors = [Sensor(name, kind, (i, 0, 0), 1e-9) for i, (name, kind) in enumerate((first, second))]
        with pytest.raises(
            ValueError, match=r"Input sensors must have different columns; .* the column a.*_[xyz]_nT\."
        ):
            SensorArray(sensors)

    def test_similar_ids_that_differ(self) -> None:
        names = [("a", "vector"), ("a_x", "vector"), ("b_x", "scalar"), ("b", "scalar"), ("ambient", "scalar")]
        array = SensorArray(tuple(Sensor(name, kind, (i, 0, 0), 1e-9) for i, (name, kind) in enumerate(names)))
        assert len(set(array.channel_names)) == array.n_channels == 9
