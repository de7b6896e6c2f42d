"""Tests of adcs.SatelliteFilter. The oracle is the batch on the same log, with field and Sun at every instant."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import adcs
import sims
from adcs.environment import environment
from adcs.kalman.satellite_filter import SatelliteEstimate
from adcs.satellite.sensors import SENSORS
from tests.adcs.filter_runs import GYRO_BIAS_RAD_S, tabletsat
from tests.adcs.kalman.test_gate import CONDITIONS

Array = NDArray[np.float64]
READINGS = ("star", "gyro_rad_s", "field_T", "sun", "wheels_Nms", "torquers_Am2", "star_covariance_rad2")
SCENARIO = replace(tabletsat(240.0), gyro_bias_rad_s=GYRO_BIAS_RAD_S, conditions=CONDITIONS, wild_share=0.05)
SATELLITE = SCENARIO.satellite


@cache
def simulated() -> adcs.Telemetry:
    return adcs.Telemetry.of(sims.simulate(SCENARIO, 3), SATELLITE.start)


def log_of(rows: Array | slice = slice(None), shift_s: Array | float = 0.0, **changes: Array) -> adcs.Telemetry:
    """Rows of a simulated log with wild readings, missing readings, commands and the covariance of some fixes."""
    whole = simulated()
    n, rng = len(whole.time_s), np.random.default_rng(4)
    values: dict[str, Any] = {name: np.array(getattr(whole, name)) for name in READINGS}
    for name in READINGS[:4]:
        values[name][rng.random(n) < 0.2] = np.nan
    values["torquers_Am2"] = np.where(rng.random((n, 1)) < 0.1, 1e-3 * rng.standard_normal((n, 3)), np.nan)
    values["star_covariance_rad2"][::3] = np.diag([1e-9, 2e-9, 4e-8])
    values["star_covariance_rad2"][np.isnan(values["star"][:, 0])] = np.nan
    values |= changes
    times = whole.time_s + shift_s
    return adcs.Telemetry(times[rows], **{name: each[rows] for name, each in values.items()}, step_s=1.0)


def log_with_a_turned_star_tracker() -> adcs.Telemetry:
    """From the 60th second on the frame of the star tracker is turned by 2°."""
    scenario = replace(SCENARIO, duration_s=420.0, wild_share=0.0)
    log = adcs.Telemetry.of(sims.simulate(scenario, 3), SATELLITE.start)
    star = np.array(log.star)
    star[60:] = (Rotation.from_rotvec([0.0, math.radians(2.0), 0.0]) * Rotation.from_quat(star[60:])).as_quat()
    names = READINGS[1:5]
    return adcs.Telemetry(log.time_s, star=star, **{name: getattr(log, name) for name in names}, step_s=1.0)


def updates(
    filter_: adcs.SatelliteFilter, log: adcs.Telemetry, rows: Iterable[int] | None = None
) -> list[SatelliteEstimate]:
    """Estimates of single rows, with None for a missing reading."""
    found = []
    for row in range(len(log.time_s)) if rows is None else rows:
        values = {name: getattr(log, name)[row] for name in READINGS}
        given = {name: None if np.isnan(each).any() else each for name, each in values.items()}
        found.append(filter_.update(log.time_s[row], **given))
    return found


def filter_of(sensors: str, states: tuple[str, ...]) -> adcs.SatelliteFilter:
    return adcs.SatelliteFilter(SATELLITE, sensors=sensors, states=states, step_s=1.0)


def assert_as_batch(found: list[SatelliteEstimate], batch: adcs.AttitudeTrack) -> None:
    """Every number and every decision of the gate, to 1e-12 of what it may be."""
    started = [one for one in found if "starting" not in one.flags]
    rows = batch.rows
    assert len(started) == len(rows)
    np.testing.assert_array_equal([one.time_s for one in started], batch.time_s[rows])
    np.testing.assert_allclose([one.q for one in started], batch.q[rows], rtol=0, atol=1e-12)
    np.testing.assert_allclose([one.rate_rad_s for one in started], batch.states["rate"][rows], rtol=0, atol=1e-12)
    for name in started[0].states:
        scale = batch.sigma[name].max()
        each = [one.states[name] for one in started]
        np.testing.assert_allclose(each, batch.states[name][rows], rtol=0, atol=1e-12 * max(scale, 1.0))
    for name, sigma in batch.sigma.items():
        np.testing.assert_allclose([one.sigma[name] for one in started], sigma[rows], rtol=1e-12)
    for name in SENSORS:
        np.testing.assert_allclose([one.nis[name] for one in started], batch.nis[name][rows], rtol=1e-9, atol=1e-9)
        rejected = [f"{name}-rejected" in one.flags for one in started]
        np.testing.assert_array_equal(rejected, batch.gated[name][rows])
    for one in started:
        deviations = np.sqrt(np.diagonal(one.covariance))
        np.testing.assert_allclose(deviations, np.concatenate([*one.sigma.values()]), rtol=1e-14)


@pytest.fixture
def _exact_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the batch compute field and Sun at every instant too, in place of knots."""
    monkeypatch.setattr(environment, "KNOTS_S", 1e-3)


SETS = [
    ("st+gyro", ("gyro-bias",)),
    ("st+gyro+mag+sun", ("gyro-bias",)),
    ("mag+sun+gyro", ("gyro-bias", "field-bias")),
    ("st+mag", ("disturbance", "dipole", "field-gain")),
]


@pytest.mark.usefixtures("_exact_environment")
class TestAsTheBatch:
    @pytest.mark.parametrize(
        ("sensors", "states"),
        # In `make test` the other sets are tried at any times.
        [pytest.param(*one, marks=[pytest.mark.slow] if one in SETS[:2] else []) for one in SETS],
    )
    def test_with_missing_and_wild_readings(self, sensors: str, states: tuple[str, ...]) -> None:
        log = log_of()
        batch = adcs.estimate(log, SATELLITE, sensors=sensors, states=states)
        assert sum(rejected.sum() for rejected in batch.gated.values()) > 5
        assert_as_batch(updates(filter_of(sensors, states), log), batch)

    def test_where_a_second_hypothesis_wins(self) -> None:
        """The star tracker's frame turns by 2° and stays so: the filter rejects its fixes, and then believes them."""
        log = log_with_a_turned_star_tracker()
        batch = adcs.estimate(log, SATELLITE, sensors="st+gyro", states=["gyro-bias"])
        assert batch.gated["st"][60:100].all()
        assert not batch.gated["st"][-50:].any()
        assert_as_batch(updates(filter_of("st+gyro", ("gyro-bias",)), log), batch)

    @pytest.mark.parametrize(("sensors", "states"), SETS[:2])
    def test_at_any_times(self, sensors: str, states: tuple[str, ...]) -> None:
        """Rows are missing, and the others are not on a grid."""
        rng = np.random.default_rng(5)
        rows = np.flatnonzero(rng.random(241) < 0.7)
        log = log_of(rows, 0.3 * rng.random(241))
        batch = adcs.estimate(log, SATELLITE, sensors=sensors, states=states)
        assert_as_batch(updates(filter_of(sensors, states), log), batch)

    def test_restarts_after_a_long_gap(self) -> None:
        """600 s are bridged; after more the filter starts anew."""
        shift_s = np.where(np.arange(241) < 120, 0.0, 700.0)
        log = log_of(slice(None), shift_s)
        found = updates(filter_of("st+gyro", ("gyro-bias",)), log)
        assert [i for i, one in enumerate(found) if "restarted" in one.flags or "starting" in one.flags][-1] >= 120
        pieces = log.pieces(600.0)
        assert len(pieces) == 2
        for piece, part in zip(pieces, (found[:120], found[120:]), strict=True):
            batch = adcs.estimate(piece, SATELLITE, sensors="st+gyro", states=["gyro-bias"])
            assert_as_batch(part, batch)


def test_with_the_interpolated_field_of_the_batch() -> None:
    """The splines of the batch move field and Sun by less than 0.05 nT and 1e-7 rad, and the attitude by about that."""
    log = log_of()
    batch = adcs.estimate(log, SATELLITE, sensors="mag+sun+gyro", states=["gyro-bias"])
    found = [one for one in updates(filter_of("mag+sun+gyro", ("gyro-bias",)), log) if "starting" not in one.flags]
    apart = [(one.rotation * other.inv()).magnitude() for one, other in zip(found, batch.rotation, strict=True)]
    assert max(apart) < 1e-6


BEGINS = (0, 1, 40, 80)


@cache
def whole_run() -> tuple[list[SatelliteEstimate], dict[int, dict[str, Any]]]:
    """Return the estimates of 100 rows, and the states before some of them."""
    log, filter_ = log_of(slice(100)), filter_of(*SETS[1])
    states, found = {}, []
    for begin, end in zip(BEGINS, (*BEGINS[1:], 100), strict=True):
        states[begin] = filter_.state()
        found += updates(filter_, log, range(begin, end))
    return found, states


class TestState:
    @pytest.mark.parametrize("begin", BEGINS)
    def test_resumes_bit_for_bit(self, begin: int) -> None:
        """Through a JSON file."""
        whole, states = whole_run()
        resumed = adcs.SatelliteFilter.from_state(json.loads(json.dumps(states[begin])), SATELLITE)
        for one, other in zip(updates(resumed, log_of(slice(100)), range(begin, 100)), whole[begin:], strict=True):
            assert one.flags == other.flags
            for name in ("q", "rate_rad_s", "covariance"):
                np.testing.assert_array_equal(getattr(one, name), getattr(other, name))

    def test_refusals(self) -> None:
        filter_ = filter_of(*SETS[0])
        updates(filter_, log_of(slice(3)))
        state = filter_.state()
        for change, words in (
            ({"version": 2}, "must have version 1; instead received 2"),
            ({"crc32": 7}, "its checksum differs"),
            ({"content": "?"}, r"must be one of SatelliteFilter.state\(\)"),
            ({"settings": {"sensors": {}}}, r"must be one of SatelliteFilter.state\(\)"),
            ({"content": "", "crc32": 0}, r"must be one of SatelliteFilter.state\(\)"),
            (adcs.AttitudeFilter().state(), r"must be one of SatelliteFilter.state\(\)"),
        ):
            with pytest.raises(ValueError, match=words):
                adcs.SatelliteFilter.from_state({**state, **change}, SATELLITE)


@cache
def used_state() -> dict[str, Any]:
    """Return the state of a filter without a gate, so that it uses wild readings, after 50 rows."""
    chosen = adcs.EstimatorSettings.of("st+gyro+mag+sun")
    chosen = replace(chosen, settings=replace(chosen.settings, gate=0.0))
    filter_ = adcs.SatelliteFilter(SATELLITE, sensors=chosen, step_s=1.0)
    updates(filter_, log_of(slice(50)))
    return filter_.state()


class TestLateReadings:
    def test_are_as_in_time(self) -> None:
        """Star fixes arrive 1 to 5 s late, in any order, some of them at times without other readings."""
        rng, n = np.random.default_rng(6), 60
        log, (sensors, states) = log_of(slice(n), np.where(np.arange(241) % 7 == 3, 0.4, 0.0)), SETS[1]
        in_time = updates(filter_of(sensors, states), log)
        board = adcs.SatelliteFilter(SATELLITE, sensors=sensors, states=states, step_s=1.0, horizon_s=6.0)
        due = np.argsort(log.time_s + np.where(rng.random(n) < 0.7, rng.uniform(1.0, 5.0, n), 0.0), kind="stable")
        alone = np.arange(n) % 7 == 3  # all readings of these times arrive with the star fix
        arrivals = [(log.time_s[row], row, "others") for row in range(n) if not alone[row]]
        arrivals += [(log.time_s[row] + rng.uniform(1.0, 5.0), row, "all" if alone[row] else "star") for row in due]
        for _, row, part in sorted(arrivals):
            of_star = ("star", "star_covariance_rad2")
            names = {"star": of_star, "all": READINGS, "others": [name for name in READINGS if name not in of_star]}[
                part
            ]
            latest = board.update(log.time_s[row], **{name: getattr(log, name)[row] for name in names})
        assert latest.time_s == in_time[-1].time_s
        assert latest.flags == in_time[-1].flags
        for name in ("q", "rate_rad_s", "covariance"):
            np.testing.assert_allclose(getattr(latest, name), getattr(in_time[-1], name), rtol=0, atol=1e-12)

    def test_before_the_horizon_are_refused(self) -> None:
        log = log_of(slice(30))
        board = adcs.SatelliteFilter(SATELLITE, sensors="st+gyro", step_s=1.0, horizon_s=5.0)
        updates(board, log)
        state, last_s = board.state(), log.time_s[-1]
        for time_s in (last_s - 6.0, math.nan):
            with pytest.raises(ValueError, match="must ascend and be finite"):
                board.update(time_s, gyro_rad_s=[0.0, 1e-3, 0.0])
        with pytest.raises(ValueError, match="no infinity"):
            board.update(last_s - 2.0, gyro_rad_s=[math.inf, 0.0, 0.0])
        assert board.state() == state
        board.update(last_s - 5.0, gyro_rad_s=[0.0, 1e-3, 0.0])
        resumed = adcs.SatelliteFilter.from_state(json.loads(json.dumps(board.state())), SATELLITE)
        assert resumed.horizon_s == 5.0
        with pytest.raises(ValueError, match="must ascend and be finite; instead received"):
            resumed.update(last_s - 2.0)
        resumed.update(last_s + 1.0)
        resumed.update(last_s + 0.5, gyro_rad_s=[0.0, 1e-3, 0.0])


class TestInput:
    @pytest.mark.parametrize(
        ("step_s", "readings", "words"),
        [
            (math.nan, {}, "time_s must ascend and be finite; instead received nan s after"),
            (0.0, {}, "time_s must ascend"),
            (-math.inf, {}, "must ascend and be finite"),
            (1.0, {"gyro_rad_s": [math.inf, 0.0, 0.0]}, "no infinity"),
            (1.0, {"field_T": [1e-5, 2e-5]}, r"field_T must have shape \(3,\); instead received \(2,\)"),
            (1.0, {"sun": [0.0, 0.0, 0.0]}, "sun must have a direction"),
            (1.0, {"star": [0.0, 0.0, 0.0, 1.0], "star_covariance_rad2": -np.eye(3)}, "positive definite"),
            (1.0, {"star": [0.0, 0.0, 0.0, 1.0], "star_covariance_rad2": [1e-9] * 3}, r"must have shape \(3, 3\)"),
            (1.0, {"field_T": [2e4, 1e4, 3e4]}, "field_T must be at most 1 T; instead received .* Convert it to tesla"),
            (1.0, {"gyro_rad_s": [1e200, 0.0, 0.0]}, "instead the filter diverges"),
        ],
    )
    def test_a_refused_update_changes_nothing(self, step_s: float, readings: dict[str, Any], words: str) -> None:
        filter_ = adcs.SatelliteFilter.from_state(used_state(), SATELLITE)
        before = filter_.state()
        with np.errstate(all="ignore"), pytest.raises(ValueError, match=words):
            filter_.update(simulated().time_s[49] + step_s, **readings)
        assert filter_.state() == before

    def test_a_silent_sensor_has_a_flag(self) -> None:
        log, filter_ = log_of(slice(10)), filter_of("st+gyro", ("gyro-bias",))
        known = updates(filter_, log)[-1]
        for second in range(1, 290):
            one = filter_.update(known.time_s + second, gyro_rad_s=[0.0, 1e-3, 0.0])
        assert one.flags == ("st-silent",)
        assert (one.sigma["attitude"] > 2.0 * known.sigma["attitude"]).all()

    def test_a_missing_momentum_keeps_the_value_before(self) -> None:
        one, other = filter_of("st", ()), filter_of("st", ())
        star, wheels = [0.0, 0.0, 0.0, 1.0], [1e-3, 2e-3, 0.0]
        one.update(0.0, star=star, wheels_Nms=wheels)
        other.update(0.0, star=Rotation.from_quat(star), wheels_Nms=wheels)
        kept, repeated = one.update(1.0), other.update(1.0, wheels_Nms=wheels)
        np.testing.assert_array_equal(kept.q, repeated.q)

    def test_what_determines_no_attitude(self) -> None:
        with pytest.raises(ValueError, match="must be st or mag\\+sun, or more; instead received gyro\\+mag"):
            filter_of("mag+gyro", ())
        smoother = adcs.EstimatorSettings.of("st", filter="smoother")
        with pytest.raises(ValueError, match="settings of the filter mekf; instead received smoother"):
            adcs.SatelliteFilter(SATELLITE, sensors=smoother, step_s=1.0)
        with pytest.raises(ValueError, match="step_s"):
            adcs.SatelliteFilter(SATELLITE, sensors="st", step_s=0.0)
        assert filter_of("mag+sun", ()).update(0.0, sun=[1.0, 0.0, 0.0]).flags == ("starting",)
