"""Readings files: what is read, what is refused and how the refusal reads."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import magloc
from arrays.array import SensorArray
from arrays.array_file import read_array
from arrays.io.errors import InputError
from arrays.sensor import Sensor
from magloc.readings import Readings, read_readings, without_saturated, write_readings
from tests.written import WriteFile, writer

HEADER = "time_s,s1_x_nT,s1_y_nT,s1_z_nT,s2_x_nT,s2_y_nT,s2_z_nT,s3_nT"
ROW = "0,1,2,3,4,5,6,7"
POSE = "array_x_m,array_y_m,array_z_m,array_qx,array_qy,array_qz,array_qw"
SIGMA = "array_sigma_m,array_sigma_deg"
HALF_OF_DIGIT_15 = 5e-15 + 4.0 * np.finfo(np.float64).eps  # and the rounding of nT to T and back


@pytest.fixture
def array() -> SensorArray:
    return SensorArray(
        (
            Sensor("s1", "vector", (0.0, 0.0, 0.0), 1e-9),
            Sensor("s2", "vector", (1.0, 0.0, 0.0), 2e-9),
            Sensor("s3", "scalar", (0.0, 1.0, 0.0), 4e-9),
        ),
        name="mixed",
    )


write = writer("readings.csv")


def numbers(largest: float) -> st.SearchStrategy[float]:
    """Any that are not known for dummy values."""
    return st.floats(-largest, largest).filter(lambda number: "99999" not in repr(number))


class TestValues:
    """Columns go to their channels by name, from nT to T."""

    def test_channels(self, array: SensorArray, write: WriteFile) -> None:
        readings = read_readings(write(f"{HEADER}\n{ROW}\n0.5,-1,-2e3,.5,+4,5,6,7\n"), array)
        np.testing.assert_array_equal(readings.time_s, [0.0, 0.5])
        expected_nT = [[1, 2, 3, 4, 5, 6, 7], [-1, -2000, 0.5, 4, 5, 6, 7]]
        np.testing.assert_allclose(readings.values_T, np.array(expected_nT) * 1e-9, rtol=1e-15)
        assert readings.array_position_m is None
        assert readings.ambient_T is None

    def test_columns_in_any_order(self, array: SensorArray, write: WriteFile) -> None:
        header, row = HEADER.split(","), ROW.split(",")
        straight = read_readings(write(f"{HEADER}\n{ROW}\n"), array)
        turned = read_readings(write(f"{','.join(header[::-1])}\n{','.join(row[::-1])}\n"), array)
        np.testing.assert_array_equal(turned.values_T, straight.values_T)
        np.testing.assert_array_equal(turned.time_s, straight.time_s)

    @pytest.mark.parametrize("cell", ["", "  ", "nan", "NaN"])
    def test_missing_cell(self, array: SensorArray, write: WriteFile, cell: str) -> None:
        readings = read_readings(write(f"{HEADER}\n0,1,2,{cell},4,5,6,7\n1,1,2,3,4,5,6,{cell}\n"), array)
        np.testing.assert_array_equal(np.argwhere(np.isnan(readings.values_T)), [[0, 2], [1, 6]])

    def test_pose_sigma(self, array: SensorArray, write: WriteFile, tmp_path: Path) -> None:
        """Metres and degrees; written and read again they are the same, also row by row."""
        rows = f"{ROW},1,2,3,0,0,0,1,0.1,18\n1{ROW[1:]},1,2,4,0,0,0,1,0.2,36\n"
        readings = read_readings(write(f"{HEADER},{POSE},{SIGMA}\n{rows}"), array)
        np.testing.assert_allclose(readings.pose_sigma, [[0.1, np.pi / 10.0], [0.2, np.pi / 5.0]], rtol=1e-15)
        write_readings(tmp_path / "again.csv", readings, array)
        again = read_readings(tmp_path / "again.csv", array)
        np.testing.assert_allclose(again[1].pose_sigma, readings.pose_sigma[1:], rtol=1e-15)

    def test_pose_and_ambient(self, array: SensorArray, write: WriteFile) -> None:
        header = f"{HEADER},{POSE},ambient_x_nT,ambient_y_nT,ambient_z_nT"
        half = math.sqrt(0.5)
        readings = read_readings(write(f"{header}\n{ROW},10,20,30,0,0,0.7071,0.7071,100,200,300\n"), array)
        assert readings.array_position_m is not None
        assert readings.array_rotation is not None
        assert readings.ambient_T is not None
        np.testing.assert_array_equal(readings.array_position_m, [[10.0, 20.0, 30.0]])
        np.testing.assert_allclose(readings.array_rotation.as_quat(), [[0.0, 0.0, half, half]], rtol=1e-15)
        np.testing.assert_allclose(readings.ambient_T, [[100e-9, 200e-9, 300e-9]], rtol=1e-15)

    def test_subset_ignores_columns_of_other_sensors(self, array: SensorArray, write: WriteFile) -> None:
        path = write("time_s,s9_nT,s3_nT,s2_x_nT,s2_y_nT,s2_z_nT,s8_x_nT\n0,9,7,4,5,6,text is no number\n")
        with pytest.raises(InputError, match="line 2, column s8_x_nT"):
            read_readings(path, array, sensors=["s2", "s3"])
        path = write("time_s,s9_nT,s3_nT,s2_x_nT,s2_y_nT,s2_z_nT,s8_x_nT\n0,inf,7,4,5,6,8\n")
        readings = read_readings(path, array, sensors=["s2", "s3"])
        np.testing.assert_allclose(readings.values_T, np.array([[4e-9, 5e-9, 6e-9, 7e-9]]), rtol=1e-15)

    @given(
        values=st.lists(
            st.lists(st.one_of(st.none(), numbers(1e15)), min_size=7, max_size=7),
            min_size=1,
            max_size=5,
        )
    )
    def test_any_number_as_pandas_reads_it(
        self, tmp_path_factory: pytest.TempPathFactory, values: list[list[float | None]]
    ) -> None:
        sensors = [Sensor(f"s{i}", "scalar", (float(i), 0.0, 0.0), 1e-9) for i in range(7)]
        path = tmp_path_factory.mktemp("any") / "readings.csv"
        lines = ["time_s," + ",".join(f"s{i}_nT" for i in range(7))]
        lines += [",".join([str(i), *("" if v is None else repr(v) for v in row)]) for i, row in enumerate(values)]
        path.write_text("\n".join(lines), encoding="utf-8")
        expected_nT = pd.read_csv(path, dtype=str).to_numpy(dtype=object).astype(np.float64)[:, 1:]
        readings = read_readings(path, SensorArray(tuple(sensors)))
        np.testing.assert_allclose(readings.values_T, expected_nT / 1e9, rtol=1e-15, atol=0.0)

    def test_recording_as_pandas_reads_it(self, data_folder: Path) -> None:
        folder = data_folder / "magnet-array"
        if not folder.is_dir():
            pytest.skip("needs the recording magnet-array")
        readings = read_readings(folder / "readings.csv", read_array(folder / "array.toml"))
        expected = pd.read_csv(folder / "readings.csv").to_numpy(dtype=np.float64)
        np.testing.assert_array_equal(readings.time_s, expected[:, 0])
        np.testing.assert_allclose(readings.values_T, expected[:, 1:] * 1e-9, rtol=1e-15)


class TestTolerance:
    """What editors and spreadsheets add changes nothing."""

    @pytest.mark.parametrize(
        "content",
        [
            f"\ufeff{HEADER}\n{ROW}\n",
            f"{HEADER}\r\n{ROW}\r\n",
            f"{HEADER}\r{ROW}\r",
            f"{HEADER}\n{ROW}",
            f"{HEADER}\n{ROW}\n\n  \n\r\n",
            f"{HEADER.replace(',', ' , ')} \n {ROW.replace(',', ' ,  ')}\t\n",
            ",".join(f'"{name}"' for name in HEADER.split(",")) + f"\n{ROW}\n",
            f"{HEADER}\n" + ",".join(f'"{cell}"' for cell in ROW.split(",")) + "\n",
        ],
        ids=["bom", "crlf", "cr", "no last line end", "blank lines", "spaces", "quoted names", "quoted numbers"],
    )
    def test_same_values(self, array: SensorArray, write: WriteFile, content: str) -> None:
        readings = read_readings(write(content), array)
        np.testing.assert_allclose(readings.values_T, np.arange(1.0, 8.0)[None] * 1e-9, rtol=1e-15)

    def test_line_numbers_are_those_of_an_editor(self, array: SensorArray, write: WriteFile) -> None:
        path = write(f"\r\n{HEADER}\r\n1{ROW[1:]}\r\n\r\n{ROW}\r\n")
        assert len(read_readings(path, array)) == 2
        with pytest.raises(InputError, match=r"line 5, column time_s: found 0 after 1, expected time to increase"):
            read_readings(path, array, ordered=True)

    def test_rows_that_are_to_stand_still(self, array: SensorArray, write: WriteFile) -> None:
        path = write(f"{HEADER},{POSE}\n{ROW},1,2,3,0,0,0,1\n\n1{ROW[1:]},1,2,4,0,0,0,1\n")
        assert len(read_readings(path, array)) == 2
        with pytest.raises(InputError, match=r"readings\.csv: found the array moved between lines 2 and 4, expected"):
            read_readings(path, array, still=True)


BAD_FILES = {
    "empty": ("", ["is empty", "header"]),
    "only blank lines": ("\n \n", ["is empty", "header"]),
    "header without rows": (f"{HEADER}\n\n", ["line 1", "without rows"]),
    "no header": (f"{ROW}\n{ROW}\n", ["line 1", "column 1", "'0'", "header"]),
    "semicolons": (f"{HEADER.replace(',', ';')}\n", ["line 1", "semicolons", "commas"]),
    "tabs": (HEADER.replace(",", "\t") + "\n", ["line 1", "tabs", "commas"]),
    "column without a name": (f"{HEADER},\n{ROW},\n", ["line 1", "column 9", "no name"]),
    "column twice": (f"{HEADER},s1_x_nT\n{ROW},1\n", ["line 1", "column s1_x_nT", "second time"]),
    "text": (f"{HEADER}\n{ROW}\n1,2,abc,4,5,6,7,8\n", ["line 3", "column s1_y_nT", "'abc'", "expected a number"]),
    "decimal comma": (f"{HEADER}\n0,1,2,3,4,5,6,7,5\n", ["line 2", "found 9 cells", "expected 8"]),
    "short row": (f"{HEADER}\n{ROW}\n1,2,3\n", ["line 3", "found 3 cells", "expected 8"]),
    "number with underscore": (f"{HEADER}\n0,1_000,2,3,4,5,6,7\n", ["line 2", "column s1_x_nT", "'1_000'"]),
    "digits of another script": (f"{HEADER}\n0,١٢,2,3,4,5,6,7\n", ["line 2", "column s1_x_nT", "'١٢'"]),
    "infinity": (f"{HEADER}\n{ROW}\n1,2,3,-inf,5,6,7,8\n", ["line 3", "column s1_z_nT", "infinite"]),
    "too large": (f"{HEADER}\n0,1,2,3,4,5,6,1e999\n", ["line 2", "column s3_nT", "infinite"]),
    "no field": (f"{HEADER}\n0,1,2,3,4,5,6,-2e15\n", ["line 2", "column s3_nT", "1e+15 nT"]),
    "missing time": (f"{HEADER}\n{ROW}\n,2,3,4,5,6,7,8\n", ["line 3", "column time_s", "no value"]),
    "infinite time": (f"{HEADER}\ninf{ROW[1:]}\n", ["line 2", "column time_s", "infinite"]),
    "time twice": (f"{HEADER}\n{ROW}\n1{ROW[1:]}\n\n0.0{ROW[1:]}\n", ["line 5", "column time_s", "as on line 2"]),
    "endless time": (f"{HEADER}\n{ROW}\n2e300{ROW[1:]}\n", ["line 3", "column time_s", "above 1e+30"]),
    "no time column": (f"t{HEADER[4:]}\n{ROW}\n", ["line 1", "column time_s", "t_s"]),
    "missing sensor column": (
        f"{HEADER.replace('s2_y_nT', 's2_y_T')}\n{ROW}\n",
        ["column s2_y_nT", "nearest is s2_y_T", "beside time_s, s1_x_nT"],
    ),
    "missing sensor": (
        "time_s,s1_x_nT,s1_y_nT,s1_z_nT,s3_nT\n0,1,2,3,4\n",
        ["column s2_x_nT", "no column of sensor s2", "'mixed'", "subset of it: s1, s3"],
    ),
    "vector columns of a scalar sensor": (
        f"{HEADER[:-5]}s3_x_nT,s3_y_nT,s3_z_nT\n{ROW},8,9\n",
        ["column s3_x_nT", "another kind", "expected s3_nT", "scalar"],
    ),
    "scalar column of a vector sensor": (
        "time_s,s1_nT,s2_x_nT,s2_y_nT,s2_z_nT,s3_nT\n0,1,2,3,4,5\n",
        ["column s1_nT", "another kind", "expected s1_x_nT, s1_y_nT, s1_z_nT", "vector"],
    ),
    "sensor that the array lacks": (f"{HEADER},s9_x_nT\n{ROW},1\n", ["column s9_x_nT", "sensor s9", "'mixed'"]),
    "unknown column": (f"{HEADER},comment\n{ROW},1\n", ["line 1", "column comment", "unknown"]),
    "incomplete pose": (f"{HEADER},array_x_m,array_y_m\n{ROW},1,2\n", ["column array_z_m", "array_x_m, array_y_m"]),
    "missing pose": (f"{HEADER},{POSE}\n{ROW},1,2,3,0,0,0,\n", ["line 2", "column array_qw", "no value"]),
    "quaternion not unit": (f"{HEADER},{POSE}\n{ROW},1,2,3,0,0,1,1\n", ["line 2", "array_qx", "norm 1.41421"]),
    "pose sigma without pose": (f"{HEADER},{SIGMA}\n{ROW},0.1,1\n", ["array_sigma_m", "found no pose"]),
    "negative pose sigma": (
        f"{HEADER},{POSE},{SIGMA}\n{ROW},1,2,3,0,0,0,1,0.1,-1\n",
        ["line 2", "array_sigma_deg", "standard deviation"],
    ),
    "quaternion zero": (f"{HEADER},{POSE}\n{ROW},1,2,3,0,0,0,0\n", ["line 2", "array_qx", "norm 0"]),
    "incomplete ambient field": (f"{HEADER},ambient_x_nT\n{ROW},1\n", ["column ambient_y_nT", "ambient_x_nT"]),
    "missing ambient field": (
        f"{HEADER},ambient_x_nT,ambient_y_nT,ambient_z_nT\n{ROW},1,,3\n",
        ["line 2", "column ambient_y_nT", "no value"],
    ),
    "not UTF-8": (f"{HEADER}\n{ROW}\n".encode() + b"1,\xb5,3,4,5,6,7,8\n", ["line 3", "0xb5", "UTF-8"]),
    "binary": (f"{HEADER}\n".encode() + bytes(range(128)), ["line 2", "NUL", "UTF-8"]),
    "cell without end": (f"{HEADER}\n0,{'x' * 200_000},2,3,4,5,6,7\n", ["line 2", "not CSV"]),
    "unclosed quote": (f'{HEADER}\n{ROW}\n"1{ROW[1:]}\n{ROW}\n', ["line 3", "found 1 cells"]),
}


class TestBadFiles:
    """Every fault is one sentence that names the file, the place, what was found and what was expected."""

    @pytest.mark.parametrize(("content", "fragments"), BAD_FILES.values(), ids=BAD_FILES.keys())
    def test_content(self, array: SensorArray, write: WriteFile, content: str | bytes, fragments: list[str]) -> None:
        path = write(content)
        with pytest.raises(InputError) as raised:
            read_readings(path, array)
        message = str(raised.value)
        assert message.startswith(str(path))
        assert "\n" not in message
        assert "expected" in message
        for fragment in fragments:
            assert fragment in message

    def test_missing_file(self, array: SensorArray, tmp_path: Path) -> None:
        with pytest.raises(InputError, match=r"none\.csv does not exist"):
            read_readings(tmp_path / "none.csv", array)

    def test_directory(self, array: SensorArray, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="is a directory"):
            read_readings(tmp_path, array)

    def test_unknown_column_beside_a_subset(self, array: SensorArray, write: WriteFile) -> None:
        with pytest.raises(InputError, match="column comment: found an unknown column"):
            read_readings(write(f"{HEADER},comment\n{ROW},1\n"), array, sensors=["s1", "s2"])


class TestWriting:
    """A written file reads back as what was written."""

    @given(
        readings_nT=st.lists(
            st.lists(st.one_of(st.just(math.nan), numbers(1e9)), min_size=7, max_size=7), min_size=1, max_size=4
        ),
        scale=st.floats(1e-3, 1e6),
    )
    def test_round_trip(
        self, tmp_path_factory: pytest.TempPathFactory, readings_nT: list[list[float]], scale: float
    ) -> None:
        array = SensorArray(
            (
                Sensor("a", "vector", (0.0, 0.0, 0.0), 1e-9),
                Sensor("b", "scalar", (1.0, 0.0, 0.0), 1e-9),
                Sensor("c", "vector", (0.0, 1.0, 0.0), 1e-9),
            )
        )
        n = len(readings_nT)
        written = Readings(
            np.array(readings_nT) * 1e-9,
            time_s=np.linspace(0.0, scale, n),
            array_position_m=np.full((n, 3), scale / 3.0),
            array_rotation=Rotation.from_quat(np.full((n, 4), 0.5)),
            ambient_T=np.full((n, 3), scale * 1e-9),
        )
        path = tmp_path_factory.mktemp("round") / "readings.csv"
        write_readings(path, written, array)
        read = read_readings(path, array)
        np.testing.assert_array_equal(read.time_s, written.time_s)
        assert read.array_rotation is not None
        assert written.array_rotation is not None
        np.testing.assert_array_equal(read.array_rotation.as_quat(), written.array_rotation.as_quat())
        np.testing.assert_allclose(read.values_T, written.values_T, rtol=HALF_OF_DIGIT_15, atol=0.0)
        assert read.array_position_m is not None
        assert read.ambient_T is not None
        assert written.ambient_T is not None
        np.testing.assert_array_equal(read.array_position_m, written.array_position_m)
        np.testing.assert_allclose(read.ambient_T, written.ambient_T, rtol=HALF_OF_DIGIT_15)

    def test_text_of_a_file_survives(self, array: SensorArray, write: WriteFile) -> None:
        content = f"{HEADER}\n0.1,533163,-108961.25,0.001,,5,6,49999.987\n"
        path = write(content)
        write_readings(path, read_readings(path, array), array)
        assert path.read_text(encoding="utf-8") == content

    def test_other_array(self, array: SensorArray, write: WriteFile, tmp_path: Path) -> None:
        readings = read_readings(write(f"{HEADER}\n{ROW}\n"), array)
        with pytest.raises(ValueError, match="6 channels"):
            write_readings(tmp_path / "other.csv", readings, array.subset(["s1", "s2"]))


class TestReadingsShapes:
    """Arrays that do not belong together are refused."""

    def test_shapes(self) -> None:
        with pytest.raises(ValueError, match=r"ambient_T must have shape \(2, 3\)"):
            Readings(np.zeros((2, 6)), ambient_T=np.zeros(3))
        with pytest.raises(ValueError, match=r"values_T must have shape \(n, C\)"):
            Readings(np.zeros(2))
        with pytest.raises(ValueError, match=r"time_s must have shape \(2,\); instead received \(3,\)"):
            Readings(np.zeros((2, 6)), time_s=np.arange(3.0))
        with pytest.raises(ValueError, match="must come together"):
            Readings(np.zeros((2, 6)), array_position_m=np.zeros((2, 3)))
        for turn, received in ((Rotation.identity(3), 3), (Rotation.identity(), 1)):
            with pytest.raises(ValueError, match=f"array_rotation must have 2 rotations; instead received {received}"):
                Readings(np.zeros((2, 6)), array_position_m=np.zeros((2, 3)), array_rotation=turn)

    @pytest.mark.parametrize(
        "time_s", [[0.0, np.nan], [np.inf, 0.0], [np.datetime64("NaT"), np.datetime64("2026", "s")]]
    )
    def test_times_that_are_none(self, time_s: list[object]) -> None:
        with pytest.raises(ValueError, match=r"time_s must be finite; instead row [12] has (nan|inf)"):
            Readings(np.zeros((2, 6)), time_s=time_s)

    def test_masks_and_what_no_magnet_makes_are_missing(self) -> None:
        values = np.ma.MaskedArray([[1.0, 2.0, -np.inf, 2e6]], [[True, False, False, False]])
        np.testing.assert_array_equal(Readings(values).values_T, [[np.nan, 2.0, np.nan, np.nan]])


class TestSaturation:
    """A reading at its sensor's limit, or beyond it, is no measurement."""

    @pytest.fixture
    def limited(self, array: SensorArray) -> SensorArray:
        first, second, third = array.sensors
        return replace(array, sensors=(replace(first, saturation_T=5e-9), second, replace(third, saturation_T=3.3e-9)))

    def test_only_the_saturated_channels(self, limited: SensorArray, write: WriteFile) -> None:
        # 3.3/1e9 is one rounding below 3.3e-9.
        rows = ["0,4.9,-5,7,1e6,1e6,1e6,3.2999", "1,-4.9,4.9,,0,-1e6,,3.3"]
        readings = read_readings(write("\n".join([HEADER, *rows])), limited)
        expected = readings.values_T.copy()
        expected[[0, 0, 1], [1, 2, 6]] = math.nan
        before = readings.values_T.copy()
        np.testing.assert_array_equal(without_saturated(readings, limited).values_T, expected)
        np.testing.assert_array_equal(readings.values_T, before)

    def test_everything_else_stays(self, limited: SensorArray, write: WriteFile) -> None:
        readings = read_readings(write(f"{HEADER},{POSE}\n{ROW},1,2,3,0,0,0,1\n"), limited)
        after = without_saturated(readings, limited)
        for name in ("time_s", "array_position_m", "array_rotation", "ambient_T"):
            assert getattr(after, name) is getattr(readings, name)

    def test_no_limit(self, array: SensorArray, write: WriteFile) -> None:
        readings = read_readings(write(f"{HEADER}\n0,1e15,2,,4,5,6,-1e15\n"), array)
        np.testing.assert_array_equal(without_saturated(readings, array).values_T, readings.values_T)

    def test_other_array(self, array: SensorArray, write: WriteFile) -> None:
        readings = read_readings(write(f"{HEADER}\n{ROW}\n"), array)
        with pytest.raises(ValueError, match="6 channels"):
            without_saturated(readings, array.subset(["s1", "s2"]))


class TestFromMemory:
    """My data frame, my arrays: nothing is converted by hand."""

    @staticmethod
    def columns(n: int = 3) -> dict[str, NDArray[np.float64]]:
        names = [*HEADER.split(","), *POSE.split(",")]
        columns = dict(zip(names, np.random.default_rng(1).normal(size=(len(names), n)), strict=True))
        turns = Rotation.random(n, rng=np.random.default_rng(2)).as_quat()
        return columns | {"time_s": np.arange(n) / 4.0} | dict(zip(POSE.split(",")[3:], turns.T, strict=True))

    def test_story(self, array: SensorArray) -> None:
        columns = self.columns()
        frame = pd.DataFrame(columns)
        readings = magloc.Readings.from_columns(frame, array)
        values_T = np.stack([columns[name] for name in HEADER.split(",")[1:]], axis=1) / 1e9
        t, p, q = columns["time_s"], frame[POSE.split(",")[:3]].to_numpy(), frame[POSE.split(",")[3:]].to_numpy()
        same = magloc.Readings(values_T, time_s=t, array_position_m=p, array_rotation=Rotation.from_quat(q))
        for name in ("time_s", "values_T", "array_position_m"):
            np.testing.assert_array_equal(getattr(readings, name), getattr(same, name))
        assert readings.array_rotation is not None
        assert same.array_rotation is not None
        np.testing.assert_allclose(readings.array_rotation.as_quat(), same.array_rotation.as_quat(), rtol=1e-14)

    def test_a_mapping_is_read_as_its_file(self, array: SensorArray, write: WriteFile) -> None:
        columns = self.columns()
        path = write(pd.DataFrame(columns).to_csv(index=False))
        read, made = read_readings(path, array), Readings.from_columns(columns, array)
        for name in ("time_s", "values_T", "array_position_m"):
            np.testing.assert_array_equal(getattr(read, name), getattr(made, name))

    def test_time_is_one_row_a_second(self) -> None:
        np.testing.assert_array_equal(Readings(np.zeros((3, 6))).time_s, [0.0, 1.0, 2.0])

    def test_rows(self, array: SensorArray) -> None:
        readings = Readings.from_columns(self.columns(), array)
        rows = list(readings)
        assert [len(row) for row in rows] == [1, 1, 1]
        np.testing.assert_array_equal(np.concatenate([row.values_T for row in rows]), readings.values_T)
        np.testing.assert_array_equal([row.time_s[0] for row in rows], readings.time_s)
        last = readings[-1].array_rotation
        assert last is not None
        assert readings.array_rotation is not None
        np.testing.assert_array_equal(last.as_quat(), readings.array_rotation.as_quat()[2:])
        with pytest.raises(IndexError):
            readings[3]

    @pytest.mark.parametrize(
        ("change", "sentence"),
        [
            ({"time_s": [0.0, 1.0, 1.0]}, "the readings, row 3, column time_s: found 1 as on row 2, expected every"),
            ({"s1_x_nT": [0.0, np.inf, 1.0]}, "the readings, row 2, column s1_x_nT: found an infinite number"),
            (
                {"s1_x_nT": [0.0, 1.0]},
                r"the readings: found columns of the shapes \[\(2,\), \(3,\)\], expected one length",
            ),
            (
                {"time_s": [0.0, 1.7e15, 1.0]},
                "the readings, row 2, column time_s: found the time 1.7e\\+15 s, beyond 3,000 y",
            ),
            ({"s1_x_nT": ["a", "b", "c"]}, "the readings, column s1_x_nT: found what is not a number"),
            ({"s9_nT": [1.0, 2.0, 3.0]}, "the readings, column s9_nT: found a column of sensor s9"),
            ({"array_qw": [1.0, 2.0, 3.0]}, "the readings, row 1, columns array_qx to array_qw: found a quaternion"),
        ],
    )
    def test_faults(self, array: SensorArray, change: dict[str, list[object]], sentence: str) -> None:
        with pytest.raises(InputError, match=f"^{sentence}"):
            Readings.from_columns({**self.columns(), **change}, array)
