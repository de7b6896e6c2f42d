"""Surveys that the simulator flew: what is found, what is not, and how well it is known."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import arrays
import magloc
import sims
from arrays.columns import POSITION_COLUMNS
from arrays.typing import FloatArray
from magloc.readings import write_readings
from sims.magnetics.paths import Lawnmower, Steered
from sims.magnetics.scenario import Carrier, Platform, Source
from sims.magnetics.simulation import Simulation

# A tenth of the built-in fields: 10 m × 10 m.
PLOT_M = 5.0


@cache
def simulated(name: str, seed: int, number: int = 2) -> Simulation:
    """A piece of a built-in survey."""
    whole = sims.read_scenario(name)
    path = whole.carrier.path
    assert isinstance(path, Lawnmower)
    path = replace(path, start_m=(-PLOT_M, PLOT_M, path.start_m[2]), length_m=2.0 * PLOT_M, lines=11, spacing_m=1.0)
    rectangle = (-PLOT_M + 1.0, PLOT_M - 1.0)
    targets = None
    if number:
        targets = replace(whole.targets, number=number, x_m=rectangle, y_m=rectangle, gap_m=4.0, moment_Am2=(1.0, 20.0))
    carrier = replace(whole.carrier, path=path)
    way = 11 * 2.0 * PLOT_M + 10 * np.pi / 2.0
    return sims.simulate(replace(whole, carrier=carrier, targets=targets, duration_s=way / path.speed_m_s), rng=seed)


@cache
def surveyed(name: str, seed: int, number: int = 2) -> magloc.Survey:
    field = simulated(name, seed, number)
    return magloc.survey(field.array, field.readings)


def nearest(found: magloc.Survey, position_m: FloatArray) -> magloc.Target:
    return min(found, key=lambda target: float(np.linalg.norm(target.position_m - position_m)))


def nearest_truth(field: Simulation, target: magloc.Target) -> FloatArray:
    apart = np.linalg.norm(field.target_position_m - target.position_m, axis=1)
    return np.asarray(field.target_position_m[apart.argmin()])


class TestTargets:
    """Strong ones, each in its own place; seeds that nothing was tuned on."""

    @pytest.mark.parametrize(
        ("name", "seed"),
        [("survey-drone", 901), pytest.param("survey-cart", 902, marks=pytest.mark.slow), ("survey-diver", 903)],
    )
    def test_all_are_found_and_no_other(self, name: str, seed: int) -> None:
        field, found = simulated(name, seed), surveyed(name, seed)
        assert len(found) == 2
        for position in field.target_position_m:
            target = nearest(found, position)
            error = target.position_m - position
            assert np.linalg.norm(error) < 0.25
            # χ² of three: 1 in 10,000 right ones is beyond 21.
            assert error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0
        assert 0.85 < found.chi2_per_dof < 1.15

    @pytest.mark.parametrize("size", [1e-4, pytest.param(5e-4, marks=pytest.mark.slow)])
    def test_what_the_ambient_field_induces_in_the_carrier(self, size: float) -> None:
        """Terms of 5 and of 25 nT, stated: both targets and no other. What errors of the attitude leave counts too."""
        scenario = simulated("survey-drone", 901).scenario
        field = sims.simulate(replace(scenario, platform=Platform(induced=size, eddy_s=size)), rng=901)
        found = magloc.survey(field.array, field.readings)
        assert len(found) == 2
        for position in field.target_position_m:
            target = nearest(found, position)
            error = target.position_m - position
            assert error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0
        assert 0.85 < found.chi2_per_dof < 1.35

    def test_moments(self) -> None:
        field, found = simulated("survey-drone", 901), surveyed("survey-drone", 901)
        for position, moment in zip(field.target_position_m, field.target_moment_Am2, strict=True):
            target = nearest(found, position)
            error = np.concatenate([target.position_m - position, target.moment_Am2 - moment])
            # χ² of six: 1 in 10,000 is beyond 28.
            assert error @ np.linalg.solve(target.covariance, error) < 28.0

    def test_what_is_left_is_the_ground(self) -> None:
        found = surveyed("survey-drone", 901)
        assert np.abs(found.rows.residual_T).max() < 0.3 * np.abs(found.rows.anomaly_T).max()


class TestEmptyField:
    def test_geology_is_no_target(self) -> None:
        """One in a million such plots has a false target at the threshold that promises 0.1 in a hectare."""
        assert len(surveyed("survey-drone", 904, 0)) == 0


class TestPair:
    def test_two_beside_each_other(self) -> None:
        """1.6 m apart: their fields overlap, and each is in the other's tangent space."""
        whole = simulated("survey-drone", 905, 0)
        scenario = whole.scenario
        sources = tuple(
            Source(Carrier(Steered(place)), moment)
            for place, moment in (((0.0, 0.0, -0.5), (3.0, 1.0, -6.0)), ((1.2, 1.0, -0.6), (-4.0, 5.0, 2.0)))
        )
        field = sims.simulate(replace(scenario, sources=sources), rng=905)
        found = magloc.survey(field.array, field.readings)
        assert len(found) == 2
        for truth in field.truths:
            assert np.linalg.norm(nearest(found, truth.position_m[0]).position_m - truth.position_m[0]) < 0.15


class TestHostileWorld:
    """What a survey is told is wrong: the targets are still right within what they claim, or they are flagged."""

    @staticmethod
    def check(readings: magloc.Readings, caplog: pytest.LogCaptureFixture, word: str) -> magloc.Survey:
        field = simulated("survey-drone", 901)
        with caplog.at_level(logging.WARNING):
            found = magloc.survey(field.array, readings)
        assert word in caplog.text
        for target in found:
            error = target.position_m - nearest_truth(field, target)
            # χ² of three: 1 in 10,000 right ones is beyond 21.
            assert "misfit" in target.flags or error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0
        return found

    @pytest.mark.parametrize("lag_s", [-0.1, pytest.param(0.3, marks=pytest.mark.slow)])
    def test_readings_that_are_late(self, lag_s: float, caplog: pytest.LogCaptureFixture) -> None:
        readings = simulated("survey-drone", 901).readings
        earlier = readings.time_s - lag_s
        late = np.stack([np.interp(earlier, readings.time_s, channel) for channel in readings.values_T.T], axis=1)
        found = self.check(replace(readings, values_T=late), caplog, "later than their poses")
        assert len(found) == 2
        assert found.lag_s == pytest.approx(lag_s, abs=0.02)  # five standard deviations

    def test_a_clock_that_leaps(self, caplog: pytest.LogCaptureFixture) -> None:
        """From the time since the start to that since 1970: nothing is known of the ambient field after the leap."""
        readings = simulated("survey-drone", 901).readings
        time_s = readings.time_s + np.where(np.arange(len(readings)) < len(readings) // 2, 0.0, 1.7e9)
        assert len(self.check(replace(readings, time_s=time_s), caplog, "")) == 2

    @pytest.mark.parametrize("since", [0, 500])
    def test_a_sensor_that_sticks(self, since: int, caplog: pytest.LogCaptureFixture) -> None:
        readings = simulated("survey-drone", 901).readings
        values = readings.values_T.copy()
        values[since:, 1] = values[since, 1]
        found = self.check(replace(readings, values_T=values), caplog, "high is stuck in")
        assert (len(found), found.array.ids) == (2, ("low",))

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("share", [0.001, 0.01])
    def test_wild_readings(self, share: float, caplog: pytest.LogCaptureFixture) -> None:
        readings, rng = simulated("survey-drone", 901).readings, np.random.default_rng(11)
        values = readings.values_T
        wild = np.where(rng.random(values.shape) < share, 1e-6 * rng.standard_normal(values.shape), 0.0)
        assert len(self.check(replace(readings, values_T=values + wild), caplog, "spikes in the readings")) == 2

    def test_one_gap_in_the_places(self, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
        """6 s around the last turn without a position: the interpolated places cut the corner."""
        field, path = simulated("survey-drone", 901), tmp_path / "log.csv"
        write_readings(path, field.readings, field.array)
        table = pd.read_csv(path)
        x_m = table["array_x_m"].to_numpy()
        turn = int(np.flatnonzero(np.diff(np.sign(np.diff(x_m))))[-1])
        table.loc[(table["time_s"] - table["time_s"][turn]).abs() < 3.0, list(POSITION_COLUMNS)] = np.nan
        table.to_csv(path, index=False)
        assert len(self.check(magloc.read_readings(path, field.array), caplog, "have no complete place")) == 2

    @pytest.mark.slow
    def test_more_noise_than_is_stated(self, caplog: pytest.LogCaptureFixture) -> None:
        field, rng = simulated("survey-drone", 901), np.random.default_rng(12)
        noise = 20.0 * field.array.channel_noise_T * rng.standard_normal(field.readings.values_T.shape)
        self.check(replace(field.readings, values_T=field.readings.values_T + noise), caplog, "times the stated noise")

    def test_another_unit(self, caplog: pytest.LogCaptureFixture) -> None:
        readings = simulated("survey-drone", 901).readings
        found = self.check(replace(readings, values_T=readings.values_T / 1000.0), caplog, "are they in nT")
        assert not len(found)

    @pytest.mark.slow
    def test_a_heading_error(self, caplog: pytest.LogCaptureFixture) -> None:
        """5 nT that go with the course, the upper sensor's a half more."""
        readings = simulated("survey-drone", 901).readings
        assert readings.array_rotation is not None
        heading = readings.array_rotation.as_euler("ZYX")[:, 0]
        error = 5e-9 * np.outer(np.cos(heading), [1.0, 0.5])
        self.check(replace(readings, values_T=readings.values_T + error), caplog, "offset_uncertainty_nT")

    @pytest.mark.slow
    def test_poses_that_are_worse_than_is_stated(self, caplog: pytest.LogCaptureFixture) -> None:
        readings, rng = simulated("survey-drone", 901).readings, np.random.default_rng(13)
        assert readings.array_position_m is not None
        moved = readings.array_position_m + 0.2 * rng.standard_normal((len(readings), 3))
        self.check(replace(readings, array_position_m=moved), caplog, "χ² per reading")

    @pytest.mark.slow
    @pytest.mark.parametrize("seed", [901, 920])
    def test_a_target_that_moves_to_and_fro(self, seed: int) -> None:
        """By 0.3 m in 20 s; the one beside it is as right as it says, or flagged."""
        field = simulated("survey-drone", seed)
        readings, place = field.readings, field.target_position_m[0]
        turn, origin, ambient = readings.array_rotation, readings.array_position_m, readings.ambient_T
        assert turn is not None
        assert origin is not None
        assert ambient is not None
        sensors = origin[:, None] + np.einsum("nab,sb->nsa", turn.as_matrix(), field.array.positions)
        moved = place + 0.3 * np.outer(np.sin(2.0 * np.pi * readings.time_s / 20.0), [1.0, 0.0, 0.0])
        still, swung = (
            np.linalg.norm(
                turn.apply(ambient)[:, None] + magloc.dipole.field(sensors, at, field.target_moment_Am2[0]), axis=-1
            )
            for at in (place, moved[:, None])
        )
        found = magloc.survey(field.array, replace(readings, values_T=readings.values_T + swung - still))
        assert "misfit" in nearest(found, place).flags
        for target in found:
            error = target.position_m - nearest_truth(field, target)
            assert "misfit" in target.flags or error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0


class TestBadInput:
    ROWS = 60

    def refused(self, match: str, **changes: object) -> None:
        field = simulated("survey-drone", 904, 0)
        with pytest.raises(ValueError, match=match):
            magloc.survey(field.array, replace(field.readings[: self.ROWS], **changes))

    def test_no_pose(self) -> None:
        self.refused("pose", array_position_m=None, array_rotation=None)

    def test_no_ambient_field(self) -> None:
        self.refused("ambient field", ambient_T=None)

    def test_time_that_goes_back(self) -> None:
        self.refused("order of time", time_s=np.arange(60.0)[::-1])

    def test_no_field(self) -> None:
        self.refused("ambient field in every row", ambient_T=np.zeros((60, 3)))

    def test_too_large(self) -> None:
        """Geology of centimetres would need millions of poles."""
        field = simulated("survey-drone", 904, 0)
        with pytest.raises(ValueError, match="smaller pieces"):
            magloc.survey(field.array, field.readings, shortest_geology_m=0.1)

    def test_a_row_far_away(self, caplog: pytest.LogCaptureFixture) -> None:
        """One row that is a thousand kilometres away is ignored."""
        field = simulated("survey-drone", 904, 0)
        places = field.readings.array_position_m
        assert places is not None
        wild = places + np.outer(np.arange(len(places)) == 30, [1e6, 1e6, 0.0])
        with caplog.at_level(logging.WARNING):
            found = magloc.survey(field.array, replace(field.readings, array_position_m=wild))
        assert "spikes in the positions: 1" in caplog.text
        assert (len(found), len(found.rows.time_s)) == (0, len(places) - 1)

    def test_few_rows(self) -> None:
        self.refused("20 whole rows", values_T=np.full((60, 2), np.nan))

    def test_below_the_ground(self) -> None:
        field = simulated("survey-drone", 904, 0)
        with pytest.raises(ValueError, match="ground_m"):
            magloc.survey(field.array, field.readings[: self.ROWS], ground_m=10.0)

    @pytest.mark.parametrize("name", ["false_per_hectare", "shortest_geology_m"])
    def test_not_positive(self, name: str) -> None:
        field = simulated("survey-drone", 904, 0)
        with pytest.raises(ValueError, match=name):
            magloc.survey(field.array, field.readings[: self.ROWS], **{name: 0.0})


class TestOutputs:
    def test_table_has_a_line_for_each(self) -> None:
        found = surveyed("survey-drone", 901)
        assert len(found.table().splitlines()) == 2 + len(found)
        assert repr(found) == f"Survey: 2 targets, {len(found.rows.time_s)} rows"

    def test_geojson_is_where_it_is(self) -> None:
        pytest.importorskip("pymap3d")
        from pymap3d import geodetic2enu

        found = surveyed("survey-drone", 901)
        feature = found.to_geojson((48.1, 11.6, 520.0))["features"][0]
        longitude, latitude, height = feature["geometry"]["coordinates"]
        back = geodetic2enu(latitude, longitude, height, 48.1, 11.6, 520.0)
        np.testing.assert_allclose(back, found[0].position_m, atol=1e-6)
        assert found.to_kml((48.1, 11.6, 520.0)).count("<Placemark>") == len(found)

    def test_iron(self) -> None:
        target = surveyed("survey-drone", 901)[0]
        least, most = target.iron_kg
        assert least == pytest.approx(target.strength_Am2 / 0.3)
        assert most == pytest.approx(target.strength_Am2 / 0.05)

    @pytest.mark.slow
    def test_unstated_pose_is_said(self) -> None:
        field = simulated("survey-drone", 901)
        found = magloc.survey(arrays.SensorArray(field.array.sensors), field.readings)
        assert found.pose_assumed
        assert found.array.pose is not None
        # 2.4 cm that last 10 s; two targets tell it by a factor of two or so.
        assert found.array.pose.position_m in (0.01, 0.02, 0.04)
        assert found.array.pose.correlation_s >= 2.0
