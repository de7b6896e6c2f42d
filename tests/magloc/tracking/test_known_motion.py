"""Tracks whose readings have measured velocities and rates: columns, frames, and what they gain.

====================================  ==================================================================================
what                                  who checks it
====================================  ==================================================================================
an array that turns and moves         the source that made the readings, at rest in a world that the track never sees
errors of the measurements            NEES over many seeds
columns                               what was written; sentences
====================================  ==================================================================================
"""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import arrays
import magloc
from arrays.columns import POSITION_COLUMNS, ROTATION_COLUMNS
from arrays.io.errors import InputError
from magloc.chi_square import mean_bounds, normalised_square
from magloc.navigation.measured_motion import MOTION_COLUMNS
from magloc.readings import write_readings
from magloc.tracking.results import TrackPoint
from tests.command_line import Run
from tests.passing_source import ARRAY, MOMENT, readings_of

FloatArray = NDArray[np.float64]
DT_S, N_ROWS = 0.5, 40
RATE_RAD_S, SPEED_M_S = np.array([0.0, 0.02, 0.08]), np.array([0.12, -0.05, 0.02])
SOURCE_M = np.array([4.0, 1.5, 0.8])
UNKNOWN = magloc.RandomWalk(0.01, 0.002)


def seen_from_a_moving_array(
    seed: int, velocity_sigma_m_s: float = 0.0, rate_sigma_rad_s: float = 0.0
) -> tuple[magloc.Readings, FloatArray, FloatArray]:
    """Readings of a source at rest, and its positions and moments in the array's axes, steps exact to fourth order."""
    rng = np.random.default_rng(seed)
    t = DT_S * np.arange(N_ROWS)
    turn = Rotation.from_rotvec(np.outer(t, RATE_RAD_S))
    # The velocity is constant in the array's axes: its origin is the integral of the turned one.
    fine = np.linspace(0.0, t[-1], 40 * N_ROWS)
    velocity = Rotation.from_rotvec(np.outer(fine, RATE_RAD_S)).apply(SPEED_M_S)
    steps = 0.5 * (velocity[1:] + velocity[:-1]) * np.diff(fine)[:, None]
    way = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    origin = np.stack([np.interp(t, fine, axis) for axis in way.T], axis=-1)
    p, m = turn.inv().apply(SOURCE_M - origin), turn.inv().apply(np.tile(MOMENT, (N_ROWS, 1)))
    velocities, rates = np.zeros((2, N_ROWS, 2, 3))
    velocities[:, 0] = SPEED_M_S + velocity_sigma_m_s * rng.normal(size=(N_ROWS, 3))
    rates[:, 0] = RATE_RAD_S + rate_sigma_rad_s * rng.normal(size=(N_ROWS, 3))
    sigmas = np.zeros((2, N_ROWS, 2))
    sigmas[0, :, 0], sigmas[1, :, 0] = velocity_sigma_m_s, rate_sigma_rad_s
    motion = magloc.MeasuredMotion(velocities, rates, *sigmas)
    return magloc.Readings(readings_of(ARRAY, p, m, seed), time_s=t, motion=motion), p, m


class TestTrack:
    def test_it_is_in_the_axes_of_the_array(self) -> None:
        readings, p, m = seen_from_a_moving_array(1)
        track = magloc.track(ARRAY, readings, motion=UNKNOWN)
        assert track.frame == "array"
        assert track.tracked[-20:].all()
        sigma = np.sqrt(np.diagonal(track.covariance[-20:], axis1=1, axis2=2))
        assert np.abs((track.position_m[-20:] - p[-20:]) / sigma[:, :3]).max() < 5.0
        assert np.abs((track.moment_Am2[-20:] - m[-20:]) / sigma[:, 3:]).max() < 5.0

    def test_what_is_measured_is_needed(self) -> None:
        """The same slow random walk without the columns is contradicted by the rows."""
        readings, _, _ = seen_from_a_moving_array(2)
        known = magloc.track(ARRAY, readings, motion=UNKNOWN)
        assert "outlier" not in known.status
        assert "outlier" in magloc.track(ARRAY, replace(readings, motion=None), motion=UNKNOWN).status

    @pytest.mark.slow
    def test_nees_of_wrong_measurements(self) -> None:
        """Of the last row over 30 seeds, a log wrong by 1 cm/s and a gyroscope by 0.2°/s: one false alarm in 100."""
        squares = []
        for seed in range(30):
            readings, p, m = seen_from_a_moving_array(100 + seed, 0.01, 0.003)
            track = magloc.track(ARRAY, readings, motion=magloc.RandomWalk(1e-3, 1e-3))
            error = np.concatenate([track.position_m[-1] - p[-1], track.moment_Am2[-1] - m[-1]])
            squares.append(float(normalised_square(error, track.covariance[-1])))
        low, high = mean_bounds(180)
        assert low < np.sum(squares) / 180 < high

    def test_another_model_is_refused(self) -> None:
        readings, *_ = seen_from_a_moving_array(1)
        with pytest.raises(ValueError, match="Input motion must be a RandomWalk"):
            magloc.track(ARRAY, readings, motion=magloc.CoordinatedTurn(1.0, 0.1))

    def test_rows_are_reported_as_soon_as_they_are_known(self) -> None:
        """What is reported row by row, without knowing the rows to come, is the track itself."""
        readings, _, _ = seen_from_a_moving_array(1)
        reported: list[TrackPoint] = []
        track = magloc.track(ARRAY, readings, motion=UNKNOWN, told=reported.append)
        assert tuple(reported) == track.points
        np.testing.assert_array_equal(track.position_m, magloc.track(ARRAY, readings, motion=UNKNOWN).position_m)

    def test_lines_are_those_of_json(self, run: Run, tmp_path: Path) -> None:
        """Measured motion counts also where the command prints each row at once."""
        readings, _, _ = seen_from_a_moving_array(1)
        write_readings(tmp_path / "rows.csv", readings, ARRAY)
        arrays.write_array(tmp_path / "array.toml", ARRAY)
        options = (tmp_path / "rows.csv", "--array", tmp_path / "array.toml", "--speed-m-s", 0.01, "--turn-deg-s", 0.1)
        whole = json.loads(run("track", *options, "--json").out)["results"]
        lines = [json.loads(line) for line in run("track", *options, "--jsonl").out.splitlines()]
        assert lines == whole
        assert [row["status"] for row in whole].count("tracked") > N_ROWS - 5

    def test_the_moment_alone(self) -> None:
        """Equation (29): at a known place in the array's axes, such as of a towed body, the moment turns with them."""
        readings, _, _ = seen_from_a_moving_array(3)
        place = np.array([4.0, 1.0, 0.5])
        turn = Rotation.from_rotvec(np.outer(readings.time_s, RATE_RAD_S))
        m = turn.inv().apply(np.tile(MOMENT, (N_ROWS, 1)))
        values = readings_of(ARRAY, np.tile(place, (N_ROWS, 1)), m, 4)
        track = magloc.track_moment(ARRAY, replace(readings, values_T=values), place, turn_rad_s=0.0)
        sigma = np.sqrt(np.diagonal(track.covariance, axis1=1, axis2=2))[:, 3:]
        assert np.abs((track.moment_Am2 - m) / sigma).max() < 5.0
        assert not track.misfit


class TestColumns:
    def test_what_is_written_is_read(self, tmp_path: Path) -> None:
        readings, *_ = seen_from_a_moving_array(1, 0.03, 0.01)
        write_readings(tmp_path / "log.csv", readings, ARRAY)
        read = magloc.read_readings(tmp_path / "log.csv", ARRAY)
        assert read.motion is not None
        assert readings.motion is not None
        for name in ("velocity_m_s", "rate_rad_s", "velocity_sigma_m_s", "rate_sigma_rad_s"):
            np.testing.assert_allclose(getattr(read.motion, name), getattr(readings.motion, name), rtol=1e-14)
        np.testing.assert_array_equal(read[3:5].motion.velocity_m_s, read.motion.velocity_m_s[3:5])  # type: ignore[union-attr]

    def test_a_rate_in_degrees_alone(self) -> None:
        columns = {name: np.zeros(2) for name in ("time_s", *(f"{c}_nT" for c in ARRAY.channel_names))}
        columns |= {"time_s": np.arange(2.0), "object_wx_deg_s": np.full(2, 90.0)}
        columns |= {"object_wy_deg_s": np.zeros(2), "object_wz_deg_s": np.zeros(2)}
        motion = magloc.Readings.from_columns(columns, ARRAY).motion
        assert motion is not None
        np.testing.assert_allclose(motion.rate_rad_s[:, 1], [[math.pi / 2, 0.0, 0.0]] * 2)
        assert not motion.velocity_m_s.any()
        assert not motion.rate_sigma_rad_s.any()

    @pytest.mark.parametrize(
        ("columns", "expected"),
        [
            (("array_vx_m_s",), "column array_vy_m_s: found array_vx_m_s without it"),
            (("array_v_sigma_m_s",), "column array_vx_m_s: found array_v_sigma_m_s without it"),
            (("array_vx_ms",), "column array_vx_ms: found an unknown column"),
            (
                (*MOTION_COLUMNS[8:11], *POSITION_COLUMNS, *ROTATION_COLUMNS),
                "column array_wx_deg_s: found together with the array's pose",
            ),
        ],
    )
    def test_what_is_no_motion(self, columns: tuple[str, ...], expected: str) -> None:
        given = {name: np.ones(2) for name in (f"{c}_nT" for c in ARRAY.channel_names)}
        given |= {"time_s": np.arange(2.0)} | {name: np.full(2, 0.5) for name in columns}
        with pytest.raises(InputError, match=expected):
            magloc.Readings.from_columns(given, ARRAY)

    def test_a_sigma_below_zero(self) -> None:
        given = {name: np.ones(2) for name in (f"{c}_nT" for c in ARRAY.channel_names)} | {"time_s": np.arange(2.0)}
        given |= {name: np.full(2, -0.5) for name in MOTION_COLUMNS[:4]}
        with pytest.raises(InputError, match="column array_v_sigma_m_s: found a number below zero"):
            magloc.Readings.from_columns(given, ARRAY)

    def test_shapes(self) -> None:
        sigma = np.zeros((3, 2))
        with pytest.raises(ValueError, match=r"Input rate_rad_s must have shape \(3, 2, 3\)"):
            magloc.MeasuredMotion(np.zeros((3, 2, 3)), np.zeros((3, 3)), sigma, sigma)
        motion = magloc.MeasuredMotion(np.zeros((3, 2, 3)), np.zeros((3, 2, 3)), sigma, sigma)
        with pytest.raises(ValueError, match="Input motion must have 4 rows; instead received 3"):
            magloc.Readings(np.zeros((4, 12)), motion=motion)
