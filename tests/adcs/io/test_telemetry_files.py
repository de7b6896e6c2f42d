"""Telemetry: what a run writes is what filters read, gaps stay gaps, wrong files are refused with their place."""

from __future__ import annotations

from importlib.resources import files

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adcs import quaternion
from adcs.io.scenario_files import read_scenario
from adcs.io.telemetry_files import FIELD, GROUPS, GYRO, STAR, SUN, TIME, WHEELS, read_telemetry, telemetry_columns
from adcs.satellite.telemetry import Telemetry, part
from arrays.io.csv import write_columns
from arrays.io.errors import InputError
from sims.attitude.files import simulation_of
from sims.attitude.simulation import simulate

SCENARIO = read_scenario("tabletsat").changed({"duration_s": 20.0, "disturbance": {"gyro_bias_deg_s": 0.02}})

START = SCENARIO.satellite.start


@pytest.fixture(scope="module")
def runs():
    return simulate(simulation_of(SCENARIO), [3])


@pytest.fixture
def written(tmp_path):
    """Write columns and read them as telemetry."""

    def write_and_read(columns, scenario=SCENARIO):
        path = tmp_path / "log.csv"
        write_columns(columns, path)
        return read_telemetry(path, scenario.step_s)

    return write_and_read


class TestRoundTrip:
    def test_readings_and_wheels(self, runs, written):
        record = written(telemetry_columns(Telemetry.of(runs, START))).record(SCENARIO.satellite)
        for name in ("gyro_rad_s", "field_T", "sun"):
            np.testing.assert_allclose(getattr(record.readings, name), getattr(runs.readings, name), rtol=1e-12)
        np.testing.assert_allclose(record.momentum_Nms, runs.momentum_Nms, rtol=1e-12)
        np.testing.assert_allclose(record.wheel_torque_Nm[:, :-1], runs.wheel_torque_Nm[:, :-1], atol=1e-14)
        assert all(seen.all() for seen in record.readings.seen.values())

    def test_star_tracker_through_the_inertial_frame(self, runs, written):
        """The file has the attitude against inertial space: the rotation of the orbital frame cancels."""
        columns = telemetry_columns(Telemetry.of(runs, START))
        record = written(columns).record(SCENARIO.satellite)
        angle = quaternion.angle_between(record.readings.star, runs.readings.star)
        assert angle.max() < 1e-7
        in_file = np.stack([columns[name] for name in STAR], axis=1)
        to_first = quaternion.angle_between(in_file, in_file[:1])
        # The orbital frame turns by n = 0.062°/s, and the satellite with it.
        assert np.degrees(to_first[-1]) == pytest.approx(20.0 * 0.062, abs=0.3)

    def test_surroundings(self, runs, written):
        record = written(telemetry_columns(Telemetry.of(runs, START))).record(SCENARIO.satellite)
        np.testing.assert_allclose(record.environment.b_orbital_T, runs.environment.b_orbital_T, atol=1e-12)
        assert record.environment.utc[0, 0] == runs.environment.utc[0, 0]


class TestGaps:
    def test_rows_and_cells(self, runs, written):
        columns = {name: values.copy() for name, values in telemetry_columns(Telemetry.of(runs, START)).items()}
        columns[SUN[1]][4] = np.nan
        kept = np.delete(np.arange(21), [7, 8])
        telemetry = written({name: values[kept] for name, values in columns.items()})
        assert telemetry.instants_s.tolist() == columns[TIME].tolist()
        assert telemetry.rows.tolist() == kept.tolist()
        record = telemetry.record(SCENARIO.satellite)
        missing = np.isnan(record.readings.sun[0]).all(axis=-1)
        assert np.flatnonzero(missing).tolist() == [4, 7, 8]
        assert np.isnan(record.readings.gyro_rad_s[0, 7:9]).all()
        assert np.isfinite(record.momentum_Nms).all()

    def test_absent_sensors(self, runs, written):
        columns = telemetry_columns(Telemetry.of(runs, START))
        record = written({name: columns[name] for name in (TIME, *FIELD)}).record(SCENARIO.satellite)
        assert [name for name, seen in record.readings.seen.items() if seen.any()] == ["mag"]
        assert np.isnan(record.readings.star).all()
        assert not record.momentum_Nms.any()

    def test_later_part(self, runs, written):
        record = written(telemetry_columns(Telemetry.of(runs, START))).record(SCENARIO.satellite)
        later = part(record, np.array([0]), slice(5, None))
        assert later.environment.time_s[0] == record.environment.time_s[5]
        np.testing.assert_array_equal(later.readings.sun, record.readings.sun[:, 5:])
        np.testing.assert_array_equal(later.environment.b_orbital_T, record.environment.b_orbital_T[:, 5:])

    def test_any_length_of_directions(self, runs, written):
        columns = telemetry_columns(Telemetry.of(runs, START))
        for name in (*SUN, *STAR):
            columns[name] = 7.0 * columns[name]
        record = written(columns).record(SCENARIO.satellite)
        np.testing.assert_allclose(np.linalg.norm(record.readings.sun, axis=-1), 1.0)
        np.testing.assert_allclose(np.linalg.norm(record.readings.star, axis=-1), 1.0)


@pytest.mark.parametrize(
    ("header", "rows", "fragments"),
    [
        ("time_s,gyro_x", ["0,1"], ["line 1, column gyro_x: found an unknown column", "nearest is gyro_x_deg_s"]),
        (",".join(GYRO), ["1,2,3"], ["line 1, column time_s", "expected it beside"]),
        (f"time_s,{GYRO[0]}", ["0,1"], ["line 1", GYRO[1], "all or none"]),
        (f"time_s,{','.join(FIELD)}", ["0,1,2,3", "0,1,2,3"], ["line 3", "ascend"]),
        (f"time_s,{','.join(FIELD)}", ["0,1,2,3", "9e9,1,2,3"], ["line 3", "fewer than"]),
        (f"time_s,{','.join(FIELD)}", [",1,2,3"], ["line 2", "time_s", "no value"]),
        (f"time_s,{','.join(SUN)}", ["0,1,2,3", "1,0,0,0"], ["line 3", "sun_x", "length 0"]),
        (f"time_s,{','.join(STAR)}", ["0,0,0,0,0"], ["line 2", "star_qw", "length 0"]),
        (f"time_s,{','.join(WHEELS)}", ["0,1,2,inf"], ["line 2", "wheels_z_Nms", "infinite"]),
        ("time_s", [], ["without rows"]),
    ],
)
def test_bad_files(tmp_path, header, rows, fragments):
    path = tmp_path / "log.csv"
    path.write_text("\n".join([header, *rows, ""]))
    with pytest.raises(InputError) as refused:
        read_telemetry(path, SCENARIO.step_s)
    assert str(refused.value).startswith(str(path))
    for fragment in fragments:
        assert fragment in str(refused.value)


def test_a_date_that_no_field_model_has(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(f"time_s,{','.join(FIELD)}\n1e9,1,2,3\n")
    with pytest.raises(ValueError, match=r"2046.*2030|2030.*2046"):
        read_telemetry(path, SCENARIO.step_s).record(SCENARIO.satellite)


def test_every_column_says_its_unit_or_has_none():
    units = ("_deg_s", "_nT", "_Nms", "_Am2")
    for group in GROUPS:
        assert group in (STAR, SUN) or all(name.endswith(units) for name in group)


LAYOUT = """
[log]
time = "when"
time_format = "utc"
[log.star_tracker]
columns = ["i", "j", "k", "s"]
order = "scalar-last"
direction = "body-from-inertial"
mounting = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
[log.gyro]
columns = ["p", "q", "r"]
unit = "rad/s"
[log.magnetometer]
columns = ["bx", "by", "bz"]
unit = "uT"
mounting = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
"""


@pytest.fixture
def with_layout(tmp_path):
    """Scenario with a table of the log."""

    def read(text=LAYOUT):
        path = tmp_path / "own.toml"
        tables = (files("adcs") / "scenarios" / "tabletsat.toml").read_text()
        path.write_text(tables + text)
        return read_scenario(str(path))

    return read


class TestLayout:
    def test_columns_units_and_conventions(self, tmp_path, with_layout):
        """Each undone by hand from the readings of a log in the standard columns."""
        scenario, rng = with_layout(), np.random.default_rng(0)
        q, rate, field = rng.standard_normal((5, 4)), rng.standard_normal((5, 3)), 30.0 * rng.standard_normal((5, 3))
        seconds = np.array([0.0, 1.02, 1.97, 9.0, 9.5])
        lines = ["when,note,i,j,k,s,p,q,r,bx,by,bz"]
        for t, *cells in zip(seconds, q, rate, field, strict=True):
            moment = str(scenario.satellite.start + np.timedelta64(round(1e6 * t), "us"))
            lines.append(",".join([moment, "any text", *(repr(float(x)) for part in cells for x in part)]))
        lines[3] = lines[3].replace(f",{float(rate[2, 1])!r},", ",,")
        path = tmp_path / "own.csv"
        path.write_text("\n".join([*lines, ""]))
        log = read_telemetry(path, 1.0, layout=scenario.log)
        np.testing.assert_allclose(log.time_s, seconds, atol=2e-6)
        body_from_star = Rotation.from_matrix([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
        expected = Rotation.from_quat(q).inv() * body_from_star.inv()
        assert (Rotation.from_quat(log.star) * expected.inv()).magnitude().max() < 1e-7
        assert np.isnan(log.gyro_rad_s[2]).all()
        np.testing.assert_allclose(np.delete(log.gyro_rad_s, 2, axis=0), np.delete(rate, 2, axis=0))
        np.testing.assert_allclose(log.field_T, 1e-6 * field[:, [2, 0, 1]])

    @pytest.mark.parametrize(
        ("cell", "expected_s"),
        [("2014-09-01 00:00:10", 10.0), ("2014-09-01T02:00:10.5+02:00", 10.5), ("2014-09-01T00:00:10Z", 10.0)],
    )
    def test_instants(self, tmp_path, with_layout, cell, expected_s):
        path = tmp_path / "own.csv"
        path.write_text(f"when,p,q,r\n{cell},1,2,3\n")
        layout = with_layout('[log]\ntime = "when"\ntime_format = "utc"\n[log.gyro]\ncolumns = ["p", "q", "r"]\n').log
        assert read_telemetry(path, layout=layout).time_s.tolist() == pytest.approx([expected_s], abs=1e-6)

    @pytest.mark.parametrize(
        ("old", "new", "fragments"),
        [
            ("[1, 0, 0], [0, 0, 1]]\n[log.gyro]", "[1, 0, 0], [0, 0, -1]]\n[log.gyro]", ["mounting", "mirror"]),
            ("[[0, 0, 1], [1, 0, 0], [0, 1, 0]]", "[[0, 0, 1], [1, 0, 0], [0, 2, 0]]", ["mounting", "orthonormal"]),
            ('"uT"', '"Oe"', ["unit", "'Oe'", "nT, uT"]),
            ('"scalar-last"', '"last"', ["order", "scalar-first, scalar-last"]),
            ('"body-from-inertial"', '"inverse"', ["direction", "inertial-from-body"]),
            ('"utc"', '"gps"', ["time_format", "seconds, utc, unix"]),
        ],
    )
    def test_refusals(self, with_layout, old, new, fragments):
        with pytest.raises(InputError) as refused:
            with_layout(LAYOUT.replace(old, new))
        for fragment in fragments:
            assert fragment in str(refused.value)

    def test_refusals_of_the_log(self, tmp_path, with_layout):
        layout = with_layout('[log]\ntime = "when"\ntime_format = "utc"\n[log.gyro]\ncolumns = ["p", "q", "r"]\n').log
        path = tmp_path / "own.csv"
        for text, fragments in (
            ("when,p,q,w\n2014-09-01,1,2,3\n", ["column r: found no such column"]),
            ("when,p,q,r\n12.5.2014,1,2,3\n", ["line 2, column when", "'12.5.2014'", "2026-11-21T12:00:00.5"]),
            ("when,p,q,r\n2014-09-02,1,2,3\n2014-09-01,1,2,3\n", ["line 3, column when", "times that ascend"]),
        ):
            path.write_text(text)
            with pytest.raises(InputError) as refused:
                read_telemetry(path, layout=layout)
            for fragment in fragments:
                assert fragment in str(refused.value)
        with pytest.raises(InputError, match="table log: found no table of a sensor"):
            with_layout('[log]\ntime = "t"\n')
