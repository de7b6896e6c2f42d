"""The attitude filter for one reading at a time: against the function for whole logs, resumed, and with bad input."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import adcs
from adcs import quaternion
from adcs.complementary.attitude_filter import FLAGS, AttitudeFilter
from adcs.complementary.heading import HeadingModel, heading_track, rotate_to_north
from adcs.complementary.inertial_magnetic import InertialMagneticRecord, prepare
from adcs.complementary.names import MAGNETS
from adcs.complementary.orientation_errors import orientation_errors
from adcs.io.imu_files import read_imu
from magloc import core
from tests.adcs.complementary.inertial.units import unit_log
from tests.adcs.complementary.test_imu_recordings import BROAD
from tests.sanitized import check_random_updates

Array = NDArray[np.float64]
HEADERS = core.include_dir() / "adcs"
COMPILER = shutil.which(os.environ.get("CXX", "g++"))
Log = tuple[Array, Array, Array, Array, Array]


def thin(log: Log, seed: int) -> Log:
    """A log in irregular steps, with gaps of rows and of sensors."""
    rng = np.random.default_rng(seed)
    time_s, *readings, q = log
    missing = (rng.random((3, len(time_s))) < 0.15) & (time_s > 0.1)
    for values, gone, begin in zip(readings, missing, (11.0, 15.0, 19.0), strict=True):
        values[gone | ((time_s > begin) & (time_s < begin + 2.0))] = np.nan
    rows = (rng.random(len(time_s)) > 0.1) & ((time_s < 23.0) | (time_s > 24.5))
    rows[:3] = True
    return (time_s[rows], *(values[rows] for values in readings), q[rows])


def estimates(filter_: AttitudeFilter, log: Log, rows: slice = slice(None)) -> Array:
    """Estimates (n, 16) of the filter as numbers: q, sigmas, rate, bias, offset and flags."""
    found = [filter_.update(*row) for row in zip(*(values[rows] for values in log[:4]), strict=True)]
    return np.array(
        [
            [
                *one.q,
                one.sigma_tilt_rad,
                one.sigma_heading_rad,
                *one.rate_rad_s,
                *one.bias_rad_s,
                *one.offset_T,
                one.bits,
            ]
            for one in found
        ]
    )


def broad_log(folder: Path, name: str) -> tuple[Log, Array, NDArray[np.bool_]]:
    log = read_imu(folder / "broad" / f"{name}.mat")
    record = log.record
    assert log.q_true is not None
    return (
        (record.time_s, record.rate_rad_s, record.acceleration_m_s2, record.field_T, log.q_true),
        log.q_true,
        log.moving,
    )


def compare(found: Array, log: Log, **options: object) -> None:
    """The batch function has the same numbers, to 1e-12."""
    track = adcs.inertial_magnetic_filter(*log[:4], **options)  # type: ignore[arg-type]
    east, north, up = track.sigma["level"].T
    of_track = [track.q, np.stack([np.hypot(east, north), up], axis=1), track.states["rate"], track.states["gyro-bias"]]
    np.testing.assert_allclose(found[:, :12], np.concatenate(of_track, axis=1), rtol=1e-12, atol=1e-12)
    disturbed = track.degraded["field left out"] | track.degraded["magnet subtracted"]
    np.testing.assert_array_equal((found[:, 15].astype(int) & 6) > 0, disturbed)


class TestBatch:
    @pytest.mark.usefixtures("instruction_set")
    @pytest.mark.parametrize("magnet", MAGNETS)
    def test_a_log_with_gaps(self, magnet: str) -> None:
        log = thin(unit_log(4), 4)
        config = adcs.AttitudeConfig.from_log(*log[:4], magnet=magnet)  # type: ignore[arg-type]
        compare(estimates(AttitudeFilter(config), log), log, magnet=magnet)

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("name", BROAD)
    def test_recordings(self, data_folder: Path, name: str) -> None:
        """Sample by sample: the numbers of the batch, and so its figures."""
        log, q_true, moving = broad_log(data_folder, name)
        found = estimates(AttitudeFilter(adcs.AttitudeConfig.from_log(*log[:4])), log)
        compare(found, log)
        assert math.degrees(orientation_errors(found[:, :4], q_true, moving).total) < 2.1

    def test_none_is_missing(self) -> None:
        log = thin(unit_log(5), 5)
        one, other = AttitudeFilter(), AttitudeFilter()
        for time_s, *readings in zip(*log[:4], strict=True):
            none = (None if np.isnan(values).any() else values for values in readings)
            np.testing.assert_array_equal(one.update(time_s, *readings).q, other.update(time_s, *none).q)


class TestReference:
    @pytest.mark.parametrize("seed", [30, 31])
    @pytest.mark.parametrize("kind", ["plain", "magnet", "room", "gaps"])
    def test_the_filter_in_numpy(self, kind: str, seed: int) -> None:
        """From 2 s on the attitudes agree within a tenth of σ, σ to 2 %, and the same fields are ignored.

        The filter in NumPy knows the usual steps from the start, and the filter for one reading learns them.
        """
        time_s, rate, acceleration, field_T, q = unit_log(seed, seconds=40.0)
        late, magnet = time_s > 15.0, np.array([6e-6, -4e-6, 19e-6])
        if kind == "magnet":
            field_T[late] += magnet
        elif kind == "room":
            field_T[late] += quaternion.rotate_back(q[late], magnet)
        elif kind == "gaps":
            field_T[late & (time_s < 25.0)] = np.nan
            acceleration[(time_s > 28.0) & (time_s < 30.0)] = np.nan
        ready = prepare(InertialMagneticRecord(time_s, rate, acceleration, field_T))
        heading = heading_track(
            time_s,
            ready.rate_rad_s,
            ready.q_level,
            ready.field_T,
            hidden_rad2=ready.hidden_rad2,
            start_tilt_rad=ready.start_tilt_rad,
        )
        filter_ = AttitudeFilter(adcs.AttitudeConfig(lag_s=ready.lag_s))
        found = estimates(filter_, (time_s, rate, acceleration, field_T, q))[time_s > 2.0]
        expected, tilt, of_heading, left_out = (
            values[time_s > 2.0]
            for values in (
                rotate_to_north(ready.q_level, heading.heading_rad),
                ready.tilt_sigma_rad,
                heading.sigma_rad,
                heading.left_out,
            )
        )
        apart = quaternion.angle_between(found[:, :4], expected)
        assert (apart < 0.1 * np.hypot(tilt, of_heading)).all()
        np.testing.assert_allclose(found[:, 4:6], np.stack([tilt, of_heading], axis=1), rtol=0.02)
        np.testing.assert_array_equal(found[:, 15].astype(int) >> FLAGS.index("field-left-out") & 1, left_out)
        assert left_out.any() == (kind in ("magnet", "room"))


class TestState:
    @pytest.mark.parametrize("begin", [0, 1, 10, 40, 250, 400, 500])
    def test_resumes_bit_for_bit(self, begin: int) -> None:
        """At the start, in the first second, in gaps, and beside a magnet: through a JSON file."""
        log = thin(unit_log(6), 6)
        log[3][log[0] > 9.0] += [6e-6, -4e-6, 19e-6]
        whole = estimates(AttitudeFilter(), log)
        first = AttitudeFilter()
        for row in zip(*(values[:begin] for values in log[:4]), strict=True):
            first.update(*row)
        resumed = AttitudeFilter.from_state(json.loads(json.dumps(first.state())))
        np.testing.assert_array_equal(estimates(resumed, log, slice(begin, None)), whole[begin:])

    def test_refusals(self) -> None:
        state = AttitudeFilter().state()
        for change, words in (
            ({"version": 2}, "must have version 1; instead received 2"),
            ({"crc32": 7}, "its checksum differs"),
            ({"content": state["content"][:80]}, "its checksum differs"),
            ({"content": "?"}, r"must be one of AttitudeFilter.state\(\)"),
            ({"config": {"magnet": "left", "model": {}}}, r"must be one of AttitudeFilter.state\(\)"),
        ):
            with pytest.raises(ValueError, match=words):
                AttitudeFilter.from_state({**state, **change})
        with pytest.raises(ValueError, match=r"must be one of AttitudeFilter.state\(\); instead received a list"):
            AttitudeFilter.from_state([state])  # type: ignore[arg-type]


class TestInput:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({0: 1.0}, "time_s must ascend and be finite; instead received 1 s after 3"),
            ({0: math.nan}, "time_s must ascend and be finite; instead received nan"),
            ({0: math.inf}, "time_s must ascend and be finite; instead received inf"),
            ({1: [0.0, math.inf, 0.0]}, "gyro_rad_s must be at most 1e4"),
            ({2: [0.0, 0.0, 0.0]}, "acceleration_m_s2 must have a length"),
            ({3: [0.0, 0.0, 50.0]}, "field_T must have a length, at most 1 T"),
            ({1: [0.0, 0.0]}, r"gyro_rad_s must have shape \(3,\); instead received \(2,\)"),
            ({2: 9.8}, r"acceleration_m_s2 must have shape \(3,\); instead received \(\)"),
        ],
    )
    def test_bad_input_changes_nothing(self, change: dict[int, object], words: str) -> None:
        log = unit_log(7, seconds=4.0)
        filter_ = AttitudeFilter()
        estimates(filter_, log, slice(80))
        before = filter_.state()
        row = [*(values[80] for values in log[:4])]
        for place, value in change.items():
            row[place] = value  # type: ignore[assignment]
        with pytest.raises(ValueError, match=words):
            filter_.update(*row)
        assert filter_.state() == before

    @pytest.mark.parametrize(("sensor", "name"), [(1, "gyro"), (2, "accelerometer"), (3, "magnetometer")])
    def test_a_sensor_silent_for_minutes(self, sensor: int, name: str) -> None:
        """A flag names it, σ grows, errors stay within 4 σ, and the heading is right within 30 s after it."""
        log = unit_log(8, seconds=300.0)
        time_s, q = log[0], log[4]
        log[sensor][(time_s > 60.0) & (time_s < 240.0)] = np.nan
        found = estimates(AttitudeFilter(), log)
        flags = found[:, 15].astype(int)
        silent = flags >> FLAGS.index(f"{name}-silent") & 1
        assert silent[(time_s > 62.0) & (time_s < 240.0)].all()
        assert not silent[(time_s < 60.0) | (time_s > 241.0)].any()
        column = {1: 5, 2: 4, 3: 5}[sensor]
        grown = found[np.searchsorted(time_s, [59.0, 239.0]), column]
        assert grown[1] > 1.5 * grown[0]
        tilt, heading = errors(found[:, :4], q)
        assert (np.abs(tilt) < 4.0 * found[:, 4]).mean() > 0.97
        assert (np.abs(heading) < 4.0 * found[:, 5]).mean() > 0.97
        assert np.degrees(np.abs(heading[time_s > 270.0])).max() < 8.0

    def test_a_start_in_motion(self) -> None:
        log = unit_log(9, shaken_s=3.0)
        found = estimates(AttitudeFilter(), log)
        later = log[0] > 8.0
        assert (found[later, 15].astype(int) >> FLAGS.index("moving-start") & 1).all()
        tilt, heading = errors(found[:, :4], log[4])
        assert (np.abs(tilt[later]) < 4.0 * found[later, 4]).mean() > 0.95
        assert (np.abs(heading[later]) < 4.0 * found[later, 5]).mean() > 0.95

    def test_without_a_magnetometer_the_heading_is_relative(self) -> None:
        log = unit_log(10)
        found = AttitudeFilter()
        for time_s, gyro, acceleration in zip(*log[:3], strict=True):
            estimate = found.update(time_s, gyro, acceleration, None)
        assert "heading-relative" in estimate.flags
        assert not estimate.disturbed
        assert estimate.rotation.magnitude() == pytest.approx(2.0 * math.acos(abs(estimate.q[0])), abs=1e-9)


def errors(q: Array, q_true: Array) -> tuple[Array, Array]:
    """Errors of tilt and heading (n,) [rad]; the heading relative to that of the first second."""
    error = quaternion.multiply(q, quaternion.conjugate(q_true))
    heading = 2.0 * np.arctan2(error[:, 3], error[:, 0])
    tilt = 2.0 * np.arctan2(np.hypot(error[:, 1], error[:, 2]), np.hypot(error[:, 0], error[:, 3]))
    return tilt, np.angle(np.exp(1j * heading))


class TestConfig:
    def test_defaults_are_those_of_the_header(self) -> None:
        """In name, order and value: the kernel copies them as they lie."""
        text = (HEADERS / "field_heading.hpp").read_text(encoding="utf-8")
        of_state = (HEADERS / "attitude_filter.hpp").read_text(encoding="utf-8")
        assert f"uint32_t version = {AttitudeFilter().state()['version']};" in of_state
        struct = re.search(r"struct HeadingParameters \{(.*?)\};", text, re.DOTALL)
        assert struct is not None
        found = {name: float(value) for name, value in re.findall(r"(\w+) = Real\(([-\d.e]+)\)", struct[1])}
        model = HeadingModel()
        assert list(found) == [one.name for one in fields(model)]
        assert found == {name: pytest.approx(getattr(model, name), rel=1e-15) for name in found}

    def test_lag_of_a_log(self) -> None:
        """The magnetometer is two samples late: the lag is found, and the filter that knows it is better."""
        time_s, gyro, acceleration, field_T, q = unit_log(11, seconds=60.0, dt=0.01, rate=3.0)
        log = time_s, gyro, acceleration, np.concatenate([field_T[:2], field_T[:-2]]), q
        config = adcs.AttitudeConfig.from_log(*log[:4])
        assert config.lag_s == pytest.approx(0.02, abs=0.003)
        moving = time_s > 5.0
        totals = [
            orientation_errors(estimates(AttitudeFilter(one), log)[:, :4], q, moving).heading
            for one in (config, replace(config, lag_s=0.0))
        ]
        assert totals[0] < totals[1]

    def test_a_log_with_wrong_axes(self) -> None:
        time_s, gyro, acceleration, field_T, _ = unit_log(11, seconds=60.0)
        with pytest.raises(ValueError, match=r"field_T must turn as the other sensors do.*its axes x and y exchanged"):
            adcs.AttitudeConfig.from_log(time_s, gyro, acceleration, field_T[:, [1, 0, 2]])

    def test_refusals(self) -> None:
        with pytest.raises(ValueError, match=r"lag_s must be within 0 and 0\.04 s; instead received 1\.0"):
            adcs.AttitudeConfig(lag_s=1.0)
        with pytest.raises(ValueError, match="magnet must be one of"):
            adcs.AttitudeConfig(magnet="left")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("count", "flags"), [(20_000, ["-DQUICK"]), pytest.param(1_000_000, [], marks=pytest.mark.slow)]
)
def test_random_updates_never_crash(count: int, flags: list[str], tmp_path: Path) -> None:
    """NaN, infinities, numbers of any size and times that go back, in float; the slow size also in double."""
    check_random_updates(Path(__file__).with_name("random_updates.cpp"), count, tmp_path, "-O0", *flags)
