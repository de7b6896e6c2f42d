"""Quality of logs with known faults."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.typing import FloatArray
from tests.hills import CLEARANCE_M, PAIR, SPEED_M_S, RATE_Hz, hills, plain, terrain_of, walk

LINES = 11
ROWS = walk(71, plain, 5.0, 3).readings
PER_LINE = len(ROWS) // LINES
LINE = np.arange(len(ROWS)) // PER_LINE
AHEAD = 1.0 - 2.0 * (LINE % 2)
"""1 for lines to the east, -1 for lines to the west."""


def checked(change: Callable[[FloatArray], FloatArray] = lambda values: values) -> magloc.Quality:
    """The quality of the walk with changed readings."""
    return magloc.check_quality(PAIR, replace(ROWS, values_T=change(ROWS.values_T.copy())))


def beside_each_other() -> magloc.Readings:
    """Twenty lines of 20 m, read on the left and on the right of the way over eighty dipoles."""
    rng, time_s = np.random.default_rng(57), np.arange(0.0, 400.0, 0.25)
    line, along_m = np.divmod(time_s, 20.0)
    place_m = np.stack([np.where(line % 2, 20.0 - along_m, along_m), line, 0.0 * line + 0.6], axis=-1)
    turn = Rotation.from_rotvec(np.pi * (line % 2)[:, None] * [0.0, 0.0, 1.0])
    dipoles_m, moments_Am2 = rng.uniform([0.0, 0.0, -1.0], [20.0, 20.0, -0.3], (80, 3)), rng.standard_normal((80, 3))
    at_m = [place_m + turn.apply([0.0, y, 0.0]) for y in (0.25, -0.25)]
    fields_T = [magloc.dipole.field(at[:, None], dipoles_m, moments_Am2).sum(axis=1) for at in at_m]
    moduli = [np.linalg.norm(field_T + np.array([1e-6, 20e-6, -44e-6]), axis=1) for field_T in fields_T]
    values = np.stack(moduli, axis=1) + 1e-10 * rng.standard_normal((len(time_s), 2))
    return magloc.Readings(values, time_s=time_s, array_position_m=place_m, array_rotation=turn)


def value(quality: magloc.Quality, name: str, sensor: str = "") -> float:
    (found,) = (check.value for check in quality.checks if (check.name, check.sensor) == (name, sensor))
    return found


@pytest.fixture(scope="module")
def quality() -> magloc.Quality:
    """The walk as it is."""
    return checked()


class TestSoundLog:
    def test_way(self, quality: magloc.Quality) -> None:
        assert value(quality, "rows") == len(ROWS)
        assert value(quality, "rate") == pytest.approx(RATE_Hz)
        assert value(quality, "lines") == LINES
        assert value(quality, "speed") == pytest.approx(SPEED_M_S, rel=1e-6)
        assert value(quality, "height") == pytest.approx(CLEARANCE_M, abs=0.02)
        assert value(quality, "widest strip") == pytest.approx(1.0, abs=0.1)
        assert value(quality, "covered") == 100.0

    @pytest.mark.parametrize("sensor", ["low", "high"])
    def test_sensors(self, quality: magloc.Quality, sensor: str) -> None:
        """σ of the estimate is 2 % for 900 correlated differences; 0.1 nT is in all readings."""
        assert value(quality, "noise", sensor) == pytest.approx(0.1, rel=0.1)
        assert [value(quality, name, sensor) for name in ("missing", "stuck", "spikes")] == [0.0, 0.0, 0.0]

    def test_nothing_is_wrong(self, quality: magloc.Quality) -> None:
        assert quality.flags == []
        assert abs(value(quality, "lag")) < 5.0 * value(quality, "lag ±")

    @pytest.mark.usefixtures("without_lag")
    def test_heights_over_hills(self) -> None:
        rows = walk(71, hills, 5.0, 3).readings
        found = magloc.check_quality(PAIR, rows, ground_m=terrain_of(hills))
        assert value(found, "least height") == pytest.approx(CLEARANCE_M - 0.1, abs=0.01)
        assert value(found, "largest height") == pytest.approx(CLEARANCE_M + 0.1, abs=0.01)

    def test_outputs(self, quality: magloc.Quality) -> None:
        columns = quality.columns()
        assert list(columns) == ["check", "sensor", "value", "unit", "remark"]
        assert len({len(column) for column in columns.values()}) == 1
        assert json.loads(json.dumps(quality.entries))["flags"] == []
        assert len(quality.lines(5)) == 6
        axes = quality.plot().axes
        assert [ax.get_ylabel() for ax in axes][2:4] == ["speed [m/s]", "noise [nT]"]


class TestNoise:
    @pytest.mark.usefixtures("without_lag")
    def test_more_than_stated(self) -> None:
        rng = np.random.default_rng(3)
        quality = checked(lambda values: values + rng.normal(size=values.shape, scale=[0.0, 5e-10]))
        assert value(quality, "noise", "high") == pytest.approx(np.hypot(0.5, 0.1), rel=0.1)
        assert [check.sensor for check in quality.checks if check.name == "noise" and check.remark] == ["high"]

    @pytest.mark.usefixtures("without_lag")
    def test_a_vector_sensor(self) -> None:
        """Its modulus has the noise of one axis."""
        rng = np.random.default_rng(4)
        array = arrays.SensorArray((arrays.Sensor("v", "vector", (0.0, 0.0, 0.0), 2e-9),))
        values = ROWS.ambient_T + rng.normal(size=(len(ROWS), 3), scale=2e-9)
        quality = magloc.check_quality(array, replace(ROWS, values_T=values))
        assert value(quality, "noise", "v") == pytest.approx(2.0, rel=0.1)


class TestHeadingError:
    @pytest.mark.usefixtures("without_lag")
    @pytest.mark.parametrize("size_nT", [0.0, 10.0])
    def test_opposite_courses(self, size_nT: float) -> None:
        quality = checked(lambda values: values + 1e-9 * size_nT * AHEAD[:, None] * [1.0, 0.0])
        error, sigma = (value(quality, f"heading error{more}", "low") for more in ("", " ±"))
        assert abs(error - size_nT) < 4.0 * sigma
        assert ("heading error" in quality.flags) == (size_nT > 0.0)

    @pytest.mark.usefixtures("without_lag")
    def test_drift_is_none(self) -> None:
        """1 nT a minute, on all courses alike."""
        quality = checked(lambda values: values + 1e-9 * ROWS.time_s[:, None] / 60.0)
        assert "heading error" not in quality.flags

    @pytest.mark.usefixtures("without_lag")
    def test_one_course(self) -> None:
        rows = ROWS[np.flatnonzero(AHEAD > 0.0)]
        assert magloc.check_quality(PAIR, rows).heading == [None, None]


class TestNames:
    @pytest.mark.usefixtures("without_lag")
    def test_a_line_of_another_day(self) -> None:
        """Line 10 twice, and line 20 with a night in it."""
        time_s = ROWS.time_s + 86_400.0 * (LINE >= 7)
        starts = [time_s[k == LINE][0] for k in (0, 3, 6, 9)]
        lines = tuple(zip(starts, ("10", "20", "30", "10"), strict=True))
        quality = magloc.check_quality(PAIR, replace(ROWS, time_s=time_s, lines=lines))
        (check,) = [check for check in quality.checks if check.name == "lines"]
        assert check.value == 5.0
        assert check.remark == "flown more than once: 10, 30"
        assert "lines" in quality.flags


class TestOrder:
    @pytest.mark.usefixtures("without_lag")
    @pytest.mark.parametrize("is_exchanged", [False, True])
    def test_sensors_beside_each_other(self, is_exchanged: bool) -> None:
        """Across the way: each reads what the other one states."""
        sides = [
            replace(sensor, position_m=(0.0, y, 0.0)) for sensor, y in zip(PAIR.sensors, (0.25, -0.25), strict=True)
        ]
        rows = beside_each_other()
        rows = replace(rows, values_T=rows.values_T[:, ::-1]) if is_exchanged else rows
        quality = magloc.check_quality(replace(PAIR, sensors=tuple(sides)), rows)
        remarks = [check.remark for check in quality.checks if check.name == "anomalies"]
        assert any("appears exchanged with high" in remark for remark in remarks) == is_exchanged

    @pytest.mark.usefixtures("without_lag")
    def test_exchanged_columns(self) -> None:
        """The field of the ground decays upwards."""
        quality = checked(lambda values: values[:, ::-1])
        (check,) = [check for check in quality.checks if check.name == "anomalies" and check.remark]
        assert check.sensor == "high"
        assert check.remark == "larger than those of low below it: exchanged?"
        assert quality.anomalies_T[1] > 2.0 * quality.anomalies_T[0]


class TestLag:
    @pytest.mark.parametrize("late", [-2, 2])
    def test_readings_of_other_rows(self, late: int) -> None:
        """Two rows, 0.17 s."""
        kept = np.flatnonzero(np.abs(np.arange(len(ROWS)) % PER_LINE - 0.5 * (PER_LINE - 1)) < 0.5 * PER_LINE - 2.0)
        rows = replace(ROWS[kept], values_T=ROWS.values_T[kept - late])
        quality = magloc.check_quality(PAIR, rows)
        assert value(quality, "lag") == pytest.approx(1e3 * late / RATE_Hz, abs=4.0 * value(quality, "lag ±") + 5.0)
        assert "lag" in quality.flags

    @pytest.mark.usefixtures("without_lag")
    def test_places_by_another_clock(self) -> None:
        """The receiver's clock is 18 s ahead: a reading's place stands 18 s later in the log."""
        time_s, rng = np.arange(0.0, 400.0, 0.25), np.random.default_rng(56)

        def way(seconds: FloatArray) -> FloatArray:
            line, along_m = np.divmod(seconds, 25.0)
            return np.stack([np.where(line % 2, 25.0 - along_m, along_m), 0.5 * line, 0.0 * line + 0.6], axis=-1)

        dipoles_m = rng.uniform([0.0, 0.0, -0.6], [25.0, 8.0, -0.3], (30, 3))
        fields_T = magloc.dipole.field(way(time_s + 18.0)[:, None], dipoles_m, rng.standard_normal((30, 3))).sum(axis=1)
        rows = magloc.Readings(
            np.linalg.norm(fields_T + np.array([0.0, 0.0, 48e-6]), axis=1)[:, None]
            + 1e-10 * rng.standard_normal((1600, 1)),
            time_s=time_s,
            array_position_m=way(time_s),
            array_rotation=Rotation.identity(1600),
        )
        quality = magloc.check_quality(
            arrays.SensorArray((arrays.Sensor("m", "scalar", (0.0, 0.0, 0.0), 1e-10),)), rows
        )
        (check,) = [check for check in quality.checks if check.name == "agreement of lines"]
        assert check.remark.endswith("% with places 18 s later: GPS time?")
        assert "agreement of lines" in quality.flags

    def test_places_in_another_unit(self, caplog: pytest.LogCaptureFixture) -> None:
        """In mm: no search, a sentence, and the other checks."""
        assert ROWS.array_position_m is not None
        quality = magloc.check_quality(PAIR, replace(ROWS, array_position_m=1e3 * ROWS.array_position_m))
        assert quality.lag is None
        assert "the lag is not estimated" in caplog.text

    def test_a_place_that_leaps(self, caplog: pytest.LogCaptureFixture) -> None:
        assert ROWS.array_position_m is not None
        places = ROWS.array_position_m + 1e2 * (np.arange(len(ROWS)) > 400)[:, None] * [1.0, 0.0, 0.0]
        assert magloc.check_quality(PAIR, replace(ROWS, array_position_m=places)).lag is None
        assert "the lag is not estimated" in caplog.text

    def test_scalar_sensors_without_the_ambient_field(self) -> None:
        """Opposite lines need none; four lines of one direction show no lag."""
        quality = magloc.check_quality(PAIR, replace(ROWS, ambient_T=None))
        assert abs(value(quality, "lag")) < 5.0 * value(quality, "lag ±")
        rows = replace(ROWS, ambient_T=None)[np.flatnonzero(AHEAD > 0.0)]
        quality = magloc.check_quality(PAIR, rows)
        assert quality.lag is None
        assert np.isnan(value(quality, "lag"))
        assert "lag" not in quality.flags


class TestGaps:
    def test_rows_without_a_record(self) -> None:
        """2.5 s within a line, and the pauses of 3 s between lines, which are no fault."""
        begin = 5 * PER_LINE + 20
        quality = magloc.check_quality(PAIR, ROWS[np.flatnonzero((np.arange(len(ROWS)) - begin) // 29)])
        lost = int(np.argmax(quality.gaps.way_m))
        assert len(quality.gaps.start_s) == LINES
        assert quality.gaps.start_s[lost] == pytest.approx(ROWS.time_s[begin - 1])
        assert quality.gaps.duration_s[lost] == pytest.approx(30.0 / RATE_Hz)
        assert value(quality, "way in a gap") == pytest.approx(30.0 * SPEED_M_S / RATE_Hz, rel=1e-3)
        assert quality.flags == ["way in a gap", "widest strip"]

    @pytest.mark.usefixtures("without_lag")
    @pytest.mark.parametrize(("leap_s", "is_flagged"), [(3600.0, True), (207 * 86400.0, True), (3601.0, False)])
    def test_a_clock_that_leaps(self, leap_s: float, is_flagged: bool) -> None:
        """Summer time begins, or day and month change places; a pause ends at any time."""
        later = leap_s * (np.arange(len(ROWS)) > 5 * PER_LINE + 20)
        quality = magloc.check_quality(PAIR, replace(ROWS, time_s=ROWS.time_s + later))
        assert value(quality, "longest gap") == pytest.approx(leap_s + 1.0 / RATE_Hz)
        assert ("longest gap" in quality.flags) == is_flagged

    @pytest.mark.usefixtures("without_lag")
    def test_a_missing_line(self) -> None:
        quality = magloc.check_quality(PAIR, ROWS[np.flatnonzero(LINE != 6)])
        assert value(quality, "widest strip") == pytest.approx(2.0, abs=0.1)
        assert "widest strip" in quality.flags

    @pytest.mark.usefixtures("without_lag")
    def test_jitter(self) -> None:
        """Stamps with errors of 5 ms: intervals scatter by √2 of it, 2 % in the estimate."""
        stamps = ROWS.time_s + np.random.default_rng(5).normal(size=len(ROWS), scale=0.005)
        quality = magloc.check_quality(PAIR, replace(ROWS, time_s=stamps))
        assert value(quality, "jitter") == pytest.approx(5.0 * np.sqrt(2.0), rel=0.1)

    @pytest.mark.usefixtures("without_lag")
    def test_places_of_a_slow_receiver(self) -> None:
        assert ROWS.array_position_m is not None
        held = np.arange(len(ROWS)) // 3 * 3
        quality = magloc.check_quality(PAIR, replace(ROWS, array_position_m=ROWS.array_position_m[held]))
        assert value(quality, "held places") == pytest.approx(200.0 / 3.0, abs=1.0)


class TestFaultyReadings:
    def test_each_is_counted(self) -> None:
        def spoil(values: FloatArray) -> FloatArray:
            values[100:130, 0] = np.nan
            values[[200, 350, 500], 1] += 8e-7
            values[600:700, 1] = values[600, 1]
            return values

        quality = checked(spoil)
        assert quality.missing.sum(axis=0).tolist() == [30, 0]
        assert quality.spikes.sum(axis=0).tolist() == [0, 3]
        assert quality.stuck.sum(axis=0).tolist() == [0, 100]
        assert quality.flags == ["missing", "stuck", "spikes"]

    @pytest.mark.usefixtures("without_lag")
    def test_only_the_last_digit_changes(self) -> None:
        """100 readings of two neighbouring numbers of 0.01 nT, where the noise is 0.1 nT: of 100 none in 10²⁰ logs."""
        last = 1e-11 * np.random.default_rng(6).integers(0, 2, 100)

        def still(values: FloatArray) -> FloatArray:
            values = 1e-11 * np.round(values / 1e-11)
            values[600:700, 1] = values[600, 1] + last
            return values

        quality = checked(still)
        assert quality.stuck[:, 0].sum() == 0
        assert quality.stuck[600:700, 1].sum() > 95
        assert quality.stuck[:, 1].sum() < 120
        assert "stuck" in quality.flags

    @pytest.mark.usefixtures("without_lag")
    def test_clipped_ones(self) -> None:
        quality = checked(lambda values: np.minimum(values, np.quantile(values[:, 0], 0.97)))
        assert value(quality, "clipped", "low") == pytest.approx(3.0, abs=0.1)
        assert not quality.clipped[:, 1].any()
        assert quality.flags == ["clipped"]

    @pytest.mark.usefixtures("without_lag")
    def test_two_instruments_in_one_column(self) -> None:
        quality = checked(lambda values: values + 6e-8 * (np.arange(len(values)) % 2)[:, None])
        remarks = [check.remark for check in quality.checks if check.name == "noise"]
        assert remarks == ["two levels in turn: two instruments in one column?"] * 2

    @pytest.mark.usefixtures("without_lag")
    def test_a_block_twice(self) -> None:
        which = np.r_[:400, 300 : len(ROWS)]
        twice = replace(ROWS[which], time_s=np.arange(len(which)) / RATE_Hz)
        quality = magloc.check_quality(PAIR, twice)
        assert value(quality, "repeated rows") == 100
        assert "repeated rows" in quality.flags

    @pytest.mark.usefixtures("without_lag")
    def test_all_digits_are_coarse(self) -> None:
        """1 nT, ten times the noise: neighbouring readings are often equal, and no sensor is stuck."""
        quality = checked(lambda values: 1e-9 * np.round(values / 1e-9))
        assert not quality.stuck.any()

    @pytest.mark.parametrize(("scale", "flags"), [(1e-3, ["field"]), (1e3, ["field"]), (0.0, ["stuck"])])
    def test_all_readings_of_a_sensor(self, scale: float, flags: list[str]) -> None:
        """Readings in another unit, and one reading all the time: alone, as no other sensor says so."""
        alone = replace(ROWS, values_T=scale * ROWS.values_T[:, :1] + (5e-5 if not scale else 0.0))
        found = magloc.check_quality(replace(PAIR, sensors=PAIR.sensors[:1]), alone)
        assert set(flags) <= set(found.flags)

    def test_saturated_readings_are_missing(self) -> None:
        """Readings in another unit, beyond the range that the sensors state, do not hide the remark on the unit."""
        sensors = tuple(replace(sensor, saturation_T=1.5e-4) for sensor in PAIR.sensors)
        found = magloc.check_quality(replace(PAIR, sensors=sensors), replace(ROWS, values_T=1e3 * ROWS.values_T))
        assert found.missing.all()
        assert found.lag is None
        assert [(c.sensor, c.remark) for c in found.checks if c.name == "field"] == [
            (sensor.id, "not the Earth's field: is it nT?") for sensor in sensors
        ]

    def test_a_place_that_does_not_change(self) -> None:
        still = replace(ROWS, array_position_m=np.tile([1.0, 2.0, 0.5], (len(ROWS), 1)))
        assert "length" in magloc.check_quality(PAIR, still).flags

    def test_bad_input(self) -> None:
        with pytest.raises(ValueError, match="must have the pose"):
            magloc.check_quality(PAIR, magloc.Readings(ROWS.values_T))
        with pytest.raises(ValueError, match="order of time"):
            magloc.check_quality(PAIR, ROWS[np.arange(len(ROWS))[::-1]])
        with pytest.raises(ValueError, match="20 rows or more"):
            magloc.check_quality(PAIR, ROWS[:10])
