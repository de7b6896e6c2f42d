"""Logs of other programs: what is read is what a readings file of the same rows has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.array_file import array_toml
from arrays.logs.format import LogFormat

HEADER = '[[sensor]]\nid = "low"\nkind = "scalar"\nposition_m = [0.0, 0.0, 0.0]\nnoise_nT = 0.1\n'
SECOND = '[[sensor]]\nid = "high"\nkind = "{}"\nposition_m = [0.0, 0.0, 1.0]\nnoise_nT = 0.1\n'


def array_of(folder: Path, columns: str, kind: str = "scalar") -> arrays.SensorArray:
    path = folder / "array.toml"
    path.write_text(f"{columns}\n{HEADER}{SECOND.format(kind)}", encoding="utf-8")
    return arrays.read_array(path)


def read(folder: Path, array: arrays.SensorArray, text: str) -> magloc.Readings:
    path = folder / "log.csv"
    path.write_text(text, encoding="utf-8")
    return magloc.read_readings(path, array)


class TestMissing:
    """What stands for no reading: what is declared, and what pandas takes for it."""

    LOG = "time_s,low_nT,high_nT,MagValid\n0,{},2,1\n1,3,4,0\n2,5,6,1\n"

    @pytest.mark.parametrize("cell", ["", "NA", "N/A", "null", "None", "<NA>", "#N/A", "-nan", "*", "7777", "---"])
    def test_cells(self, cell: str, tmp_path: Path) -> None:
        array = array_of(tmp_path, '[columns]\ndummy = [7777, "---"]\n')
        found = read(tmp_path, array, self.LOG.format(cell))
        np.testing.assert_allclose(1e9 * found.values_T, [[np.nan, 2.0], [3.0, 4.0], [5.0, 6.0]])

    def test_rows_that_are_not_valid(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        array = array_of(tmp_path, '[columns]\nvalid = {column = "MagValid", equals = [1]}\n')
        found = read(tmp_path, array, self.LOG.format(1))
        np.testing.assert_allclose(1e9 * found.values_T, [[1.0, 2.0], [np.nan, np.nan], [5.0, 6.0]])
        assert "the readings of 1 rows have MagValid that is not 1 and are left out" in caplog.text

    def test_they_are_counted_and_named(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        array = array_of(tmp_path, '[columns]\ndummy = [7777]\nunit = "uT"\n')
        read(tmp_path, array, "time_s,low_nT,high_nT\n0,7777,2\n1,3,-99999\n2,7777,*\n")
        each = "2 of sensor low (7777000), 2 of sensor high (-99999000, *)"
        assert f"dummy values are left out: 4 in all, {each}" in caplog.text

    def test_the_array_file_keeps_them(self, tmp_path: Path) -> None:
        columns = '[columns]\ndummy = [-7.5, "*"]\nvalid = {column = "V", equals = [1, 4]}\ncomment = ["#", "/"]\n'
        columns += 'skip = "Line"\ndate = "2026-05-12"\nday_first = true\nencoding = "windows-1252"\n'
        array = array_of(tmp_path, columns)
        arrays.write_array(tmp_path / "again.toml", array)
        assert arrays.read_array(tmp_path / "again.toml").columns == array.columns


class TestValues:
    def test_names_units_and_times(self, tmp_path: Path) -> None:
        array = array_of(
            tmp_path,
            '[columns]\nseparator = "semicolon"\ndecimal = ","\ntime = "Clock"\ntime_unit = "ms"\nunit = "uT"\n'
            '[columns.sensors]\nlow = "Mag 1"\nhigh = "Mag 2"\n',
        )
        found = read(tmp_path, array, "Clock;Mag 1;Mag 2;Comment\n0;48,5;48,6;start\n500;48,7;;\n")
        assert found.time_s.tolist() == [0.0, 0.5]
        np.testing.assert_allclose(found.values_T, [[48.5e-6, 48.6e-6], [48.7e-6, np.nan]], rtol=1e-14)

    def test_counts_of_a_vector_sensor(self, tmp_path: Path) -> None:
        columns = '[columns]\nunit = 0.5\n[columns.sensors]\nlow = "T"\nhigh = ["X", "Y", "Z"]\n'
        found = read(
            tmp_path, array_of(tmp_path, columns, "vector"), "time_s,T,X,Y,Z\n0,100000,1,2,3\n1,100000,4,5,6\n"
        )
        np.testing.assert_allclose(found.values_T[0], [5e-5, 0.5e-9, 1e-9, 1.5e-9], rtol=1e-14)

    def test_instants(self, tmp_path: Path) -> None:
        columns = '[columns]\ntime = "UTC"\ntime_unit = "iso"\n'
        text = "UTC,low_nT,high_nT\n2026-11-21T12:00:00,1,2\n2026-11-21T12:00:01.25Z,1,2\n"
        found = read(tmp_path, array_of(tmp_path, columns), text)
        assert np.diff(found.time_s).tolist() == [1.25]

    @pytest.mark.parametrize("decimal", [".", ","])
    def test_date_and_time(self, decimal: str, tmp_path: Path) -> None:
        """In two columns, in any order, as some loggers write them."""
        columns = f'[columns]\nseparator = "semicolon"\ndecimal = "{decimal}"\ntime = ["D", "T"]\ntime_unit = "iso"\n'
        text = "T;D;low_nT;high_nT\n7:59:59.5;2026/11/21;1;2\n08:00:00.75;2026-11-21;1;2\n"
        array = array_of(tmp_path, columns)
        found = read(tmp_path, array, text)
        assert found.time_s.tolist() == [1795247999.5, 1795248000.75]
        with pytest.raises(arrays.InputError, match=r"line 2, column D, T: found 'todayT7:59:59.5', expected a time"):
            read(tmp_path, array, text.replace("2026/11/21", "today"))

    @pytest.mark.parametrize(("unit", "of_nT"), [("nT", 1e-9), ("µT", 1e-6), ("mG", 1e-7), ("G", 1e-4), ("T", 1.0)])
    def test_units(self, unit: str, of_nT: float, tmp_path: Path) -> None:
        found = read(
            tmp_path, array_of(tmp_path, f'[columns]\nunit = "{unit}"\n'), "time_s,low_nT,high_nT\n0,3,4\n1,3,4\n"
        )
        np.testing.assert_allclose(found.values_T[0], np.array([3.0, 4.0]) * of_nT, rtol=1e-14)

    def test_other_columns_of_a_readings_file(self, tmp_path: Path) -> None:
        """What the table does not name keeps its name: the ambient field, standard deviations of the pose, motion."""
        columns = '[columns]\nunit = "uT"\nposition = ["E", "N", "U"]\n'
        header = "time_s,low_nT,high_nT,E,N,U,array_sigma_m,array_sigma_deg,ambient_x_nT,ambient_y_nT,ambient_z_nT"
        found = read(tmp_path, array_of(tmp_path, columns), f"{header}\n0,1,2,0,0,1,0.02,0.3,100,200,300\n")
        assert found.pose_sigma is not None
        assert found.ambient_T is not None
        np.testing.assert_allclose(found.pose_sigma, [[0.02, np.radians(0.3)]])
        np.testing.assert_allclose(found.ambient_T, [[1e-7, 2e-7, 3e-7]])
        with pytest.raises(arrays.InputError, match="array_sigma_deg"):
            read(tmp_path, array_of(tmp_path, columns), "time_s,low_nT,high_nT,E,N,U,array_sigma_m\n0,1,2,0,0,1,0.02\n")

    def test_some_of_the_sensors(self, tmp_path: Path) -> None:
        """The others' columns need not be there, whatever the table calls them."""
        array = array_of(tmp_path, 'common_field_nT = 100.0\n[columns.sensors]\nlow = "A"\nhigh = "B"\n')
        (tmp_path / "log.csv").write_text("time_s,A\n0,1\n1,2\n", encoding="utf-8")
        found = magloc.read_readings(tmp_path / "log.csv", array, sensors=["low"])
        np.testing.assert_allclose(found.values_T[:, 0], [1e-9, 2e-9])
        part = magloc.read_readings(tmp_path / "log.csv", array.subset(["low"]))
        assert part.values_T.tolist() == found.values_T.tolist()


class TestPose:
    GEODETIC = '[columns]\ngeodetic = ["Lat", "Lon", "Alt"]\norigin = [50.0, 8.0, 100.0]\n'

    def test_latitude_and_longitude(self, tmp_path: Path) -> None:
        """A minute of latitude is a nautical mile of 1,852 m, by its definition, to the Earth's flattening."""
        rows = "0,1,2,50,8,100\n1,1,2,50.016666667,8,101\n2,1,2,50,8.016666667,100\n"
        found = read(tmp_path, array_of(tmp_path, self.GEODETIC), f"time_s,low_nT,high_nT,Lat,Lon,Alt\n{rows}")
        assert found.array_position_m is not None
        np.testing.assert_allclose(found.array_position_m[0], 0.0, atol=1e-6)
        east, north = found.array_position_m[2, 0], found.array_position_m[1, 1]
        assert north == pytest.approx(1852.0, rel=5e-3)
        assert east == pytest.approx(1852.0 * np.cos(np.radians(50.0)), rel=5e-3)
        assert found.array_position_m[1, 2] == pytest.approx(1.0 - 1852.0**2 / 2.0 / 6.37e6, abs=0.01)

    def test_origin(self, tmp_path: Path) -> None:
        """Logs of the same origin are of the same world, wherever they begin."""
        array, header = array_of(tmp_path, self.GEODETIC), "time_s,low_nT,high_nT,Lat,Lon,Alt"
        whole = read(tmp_path, array, f"{header}\n0,1,2,50,8,110\n1,1,2,50.001,8,110\n")
        part = read(tmp_path, array, f"{header}\n1,1,2,50.001,8,110\n")
        assert whole.array_position_m is not None
        assert part.array_position_m is not None
        np.testing.assert_allclose(whole.array_position_m[0], [0.0, 0.0, 10.0], atol=1e-6)
        assert part.array_position_m.tolist() == whole.array_position_m[1:].tolist()

    @pytest.mark.parametrize(
        ("angles", "of_row", "forward", "up"),
        [
            ('["Yaw"]', "90", [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]),  # to the east
            ('["Yaw", "Pitch", "Roll"]', "0,90,0", [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]),  # nose up
            ('["Yaw", "Pitch", "Roll"]', "0,0,90", [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]),  # right wing down
        ],
    )
    def test_angles(self, angles: str, of_row: str, forward: list[float], up: list[float], tmp_path: Path) -> None:
        columns = f'[columns]\nposition = ["E", "N", "U"]\nangles = {angles}\n'
        names = ",".join(name.strip(' "[]') for name in angles.split(","))
        rows = f"0,1,2,0,0,5,{of_row}\n1,1,2,1,2,5,{of_row}\n"
        found = read(tmp_path, array_of(tmp_path, columns), f"time_s,low_nT,high_nT,E,N,U,{names}\n{rows}")
        assert found.array_rotation is not None
        np.testing.assert_allclose(found.array_rotation[0].apply([1.0, 0.0, 0.0]), forward, atol=1e-12)
        np.testing.assert_allclose(found.array_rotation[0].apply([0.0, 0.0, 1.0]), up, atol=1e-12)

    def test_a_place_alone(self, tmp_path: Path) -> None:
        columns = '[columns]\nposition = ["E", "N", "U"]\n'
        found = read(tmp_path, array_of(tmp_path, columns), "time_s,low_nT,high_nT,E,N,U\n0,1,2,3,4,5\n1,1,2,3,4,5\n")
        assert found.array_rotation is not None
        assert found.array_rotation.magnitude().tolist() == [0.0, 0.0]

    def test_latency(self, tmp_path: Path) -> None:
        """What a row says of its pose was so half a second before: a steady motion is half a second further on."""
        columns = '[columns]\nposition = ["E", "N", "U"]\nquaternion = ["a", "b", "c", "d"]\npose_latency_s = 0.5\n'
        time_s = np.arange(10.0)
        turned = Rotation.from_euler("z", 0.1 * (time_s[:, None] - 0.5)).as_quat()
        rows = [f"{t},1,2,{3.0 * (t - 0.5)},0,1,{','.join(map(str, q))}" for t, q in zip(time_s, turned, strict=True)]
        found = read(tmp_path, array_of(tmp_path, columns), "\n".join(["time_s,low_nT,high_nT,E,N,U,a,b,c,d", *rows]))
        assert found.array_position_m is not None
        assert found.array_rotation is not None
        np.testing.assert_allclose(found.array_position_m[:-1, 0], 3.0 * time_s[:-1], atol=1e-9)
        np.testing.assert_allclose(found.array_rotation.as_euler("zyx")[:-1, 0], 0.1 * time_s[:-1], atol=1e-9)

    LATE = '[columns]\nposition = ["E", "N", "U"]\nangles = ["Yaw"]\npose_latency_s = 0.5\n'

    def test_latency_of_rows_in_any_order(self, tmp_path: Path) -> None:
        array, header = array_of(tmp_path, self.LATE), "time_s,low_nT,high_nT,E,N,U,Yaw"
        rows = [f"{t},1,2,{t},0,1,{10 * t}" for t in range(6)]
        forth, back = (read(tmp_path, array, "\n".join([header, *order])) for order in (rows, rows[::-1]))
        assert forth.array_position_m is not None
        assert back.array_position_m is not None
        assert back.array_position_m[::-1].tolist() == forth.array_position_m.tolist()
        alone = read(tmp_path, array, f"{header}\n{rows[2]}")
        assert alone.array_position_m is not None
        assert alone.array_position_m.tolist() == [[2.0, 0.0, 1.0]]

    @pytest.mark.parametrize(
        ("row", "word"),
        [
            ("0,1,2,0,0,1,0\n0,1,2,1,0,1,0", "line 3, column time_s: found 0 as on line 2"),
            (",1,2,0,0,1,0", "line 2, column time_s: found no value"),
            ("0,1,2,0,,1,0", "log.csv: found no row with a place"),
            ("0,1,2,0,0,1,", "line 2, column Yaw: found no value"),
        ],
    )
    def test_a_cell_that_is_not_there(self, row: str, word: str, tmp_path: Path) -> None:
        with pytest.raises(arrays.InputError, match=word):
            read(tmp_path, array_of(tmp_path, self.LATE), f"time_s,low_nT,high_nT,E,N,U,Yaw\n{row}\n")

    @pytest.mark.parametrize("turn", [",,,", "0,0,0,0", "0,0,0,2"])
    def test_no_quaternion(self, turn: str, tmp_path: Path) -> None:
        columns = '[columns]\nposition = ["E", "N", "U"]\nquaternion = ["a", "b", "c", "d"]\npose_latency_s = 0.5\n'
        rows = f"0,1,2,0,0,1,{turn}\n1,1,2,0,0,1,{turn}\n"
        with pytest.raises(arrays.InputError, match="line 2"):
            read(tmp_path, array_of(tmp_path, columns), f"time_s,low_nT,high_nT,E,N,U,a,b,c,d\n{rows}")


class TestFile:
    def test_written_as_read(self, tmp_path: Path) -> None:
        columns = (
            '[columns]\nseparator = "tab"\ntime = "t \\"x\\""\nunit = 0.25\ngeodetic = ["Lat", "Lon", "Höhe"]\n'
            'origin = [50.0, 8.0, 1.0]\nangles = ["Kurs"]\npose_latency_s = 0.1\n'
            '[columns.sensors]\nhigh = ["X", "Y", "Z"]\n'
        )
        array = array_of(tmp_path, columns, "vector")
        (tmp_path / "again.toml").write_text(array_toml(array), encoding="utf-8")
        assert arrays.read_array(tmp_path / "again.toml") == array
        assert hash(array) == hash(arrays.read_array(tmp_path / "array.toml"))
        assert array.columns is not None
        assert array.subset(["low", "high"]).columns == array.columns

    @pytest.mark.parametrize(
        ("columns", "word"),
        [
            ('unit = "kT"', "unit"),
            ('separator = "|"', "separator"),
            ('decimal = ","', "separator comma"),
            ('time_unit = "h"', "time_unit"),
            ('time = ["D", "T"]', "time_unit must be iso"),
            ('angles = ["Yaw"]', "position or geodetic"),
            ("height_m = 0.4", "position or geodetic"),
            ('crs = "EPSG:32633"', "position or geodetic"),
            ("antenna_m = [0.0, 0.0, 1.0]", "position or geodetic"),
            ('height_is = "sea"', "height_is"),
            ('position = ["a", "b"]', "position must have 3 names"),
            ('position = ["a", "b", "c"]\nheight_m = 0.4', "position must have 2 names"),
            ('date = "12.5.2026"', "date must be such as"),
            ('encoding = "ansi-7"', "encoding"),
            ('comment = ""', "comment and skip"),
            ('position = ["a", "b", "c"]\ngeodetic = ["a", "b", "c"]', "geodetic"),
            ('position = ["a", "b", "c"]\nangles = ["a", "b"]', "angles"),
            ('latitude = "Lat"', "latitude"),
            ('position = ["a", "b", "c"]\norigin = [1.0, 2.0, 3.0]', "geodetic or crs"),
            ("unit = 0", "unit"),
            ("unit = -2.0", "unit"),
            ("pose_latency_s = inf", "pose_latency_s"),
            ('sensors = {other = "A"}', "columns.sensors.other"),
            ('sensors = {low = ["A", "B"]}', "columns.sensors.low: found 2 names"),
        ],
    )
    def test_bad_tables(self, columns: str, word: str, tmp_path: Path) -> None:
        with pytest.raises(arrays.InputError, match=word):
            array_of(tmp_path, f"[columns]\n{columns}\n")

    def test_bad_values_in_python(self) -> None:
        with pytest.raises(ValueError, match="Input unit must be one of nT"):
            arrays.LogColumns(unit="kT")

    @pytest.mark.parametrize(
        ("columns", "header", "word"),
        [
            ('[columns.sensors]\nlow = "A"', "time_s,low_nT,high_nT", "column A"),
            ('[columns]\ntime = "UTC"', "time_s,low_nT,high_nT", "UTC"),
            ("[columns]", "time_s,low_nT,Mag2", "high_nT"),
            ("[columns]", "a,b,c", "column time_s"),
            (
                '[columns]\nseparator = "tab"',
                "time_s,low_nT,high_nT",
                "separated by commas, expected tabs as the separator",
            ),
            ('[columns]\nseparator = "semicolon"', "time_s\tlow_nT\thigh_nT", "separated by tabs, expected semicolons"),
            ("[columns]", "time_s low_nT high_nT", "separated by blanks, expected commas"),
        ],
    )
    def test_bad_logs(self, columns: str, header: str, word: str, tmp_path: Path) -> None:
        array = array_of(tmp_path, columns + "\n")
        with pytest.raises(arrays.InputError, match=word):
            read(tmp_path, array, f"{header}\n0,1,2\n1,1,2\n")

    def test_a_stream_without_a_place(self) -> None:
        columns = arrays.LogColumns(position=("E", "N", "U"))
        form = LogFormat({"low": ["low_nT"]}, columns, "a header", ())
        head = form.header("time_s,low_nT,E,N,U", "the stream", 1)
        with pytest.raises(arrays.InputError, match="line 7, column N: found no value"):
            form.table("0,1,2,,4", "the stream", first_line=7, head=head)


class TestGaps:
    """Rows without a place, between others on a way that is straight and even: they are where it was."""

    HEADER = "time_s,low_nT,high_nT,E,N,U,Fix\n"

    def test_are_filled(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        columns = '[columns]\nposition = ["E", "N", "U"]\nfix = {column = "Fix", equals = [4, 5]}\n'
        rows = [f"{t},1,2,{3 * t},{-t},{7 if t in (2, 7) else ''},{1 if t in (4, 9) else 5}" for t in range(10)]
        found = read(tmp_path, array_of(tmp_path, columns), self.HEADER + "\n".join(rows))
        time_s = np.arange(2.0, 8.0)
        np.testing.assert_allclose(found.time_s, time_s)
        assert found.array_position_m is not None
        np.testing.assert_allclose(found.array_position_m, np.stack([3 * time_s, -time_s, 7 + 0 * time_s], axis=1))
        assert "8 of 10 rows have no complete place: 4 are interpolated, 4 before" in caplog.text

    def test_have_an_error(self, tmp_path: Path) -> None:
        """At most what is known of the bend: on a circle the chord of half a turn is off by its radius."""
        columns = '[columns]\nposition = ["E", "N", "U"]\nfix = {column = "Fix", equals = [4, 5]}\n'
        angle = 0.1 * np.arange(63)
        errors = []
        for gap in (4, 8, 16):
            fix = np.where((np.arange(63) > 20) & (np.arange(63) < 20 + gap), 0, 4)
            rows = [f"{k},1,2,{np.cos(a)},{np.sin(a)},0,{f}" for k, (a, f) in enumerate(zip(angle, fix, strict=True))]
            found = read(tmp_path, array_of(tmp_path, columns), self.HEADER + "\n".join(rows))
            assert found.array_position_m is not None
            assert found.interpolated_m is not None
            assert (found.interpolated_m[fix == 4] == 0.0).all()
            off = np.linalg.norm(found.array_position_m[:, :2] - np.stack([np.cos(angle), np.sin(angle)], 1), axis=1)
            assert (off <= 1.05 * found.interpolated_m + 1e-12).all()
            errors.append(found.interpolated_m.max())
        assert errors[0] < errors[1] < errors[2]

    def test_a_constant_height_and_no_fix_at_zero(self, tmp_path: Path) -> None:
        pytest.importorskip("pymap3d")
        columns = '[columns]\ngeodetic = ["N", "E"]\norigin = [50.0, 8.0, 100.0]\nheight_m = 0.4\n'
        rows = "0,1,2,8,50,,4\n1,1,2,0,0,,4\n2,1,2,8,50.00001,,4\n"
        found = read(tmp_path, array_of(tmp_path, columns), self.HEADER + rows)
        assert found.array_position_m is not None
        np.testing.assert_allclose(found.array_position_m[:, 2], 0.4)
        np.testing.assert_allclose(found.array_position_m[1, 1], 1.112 / 2, atol=1e-3)
