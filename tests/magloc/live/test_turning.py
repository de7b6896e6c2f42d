"""Calibration of turned sensors while their rows come: what is covered, what is missing, when it is enough."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import arrays
from arrays.array import SensorArray
from arrays.sensor import Calibration, Sensor
from magloc.cli.app import main
from magloc.live.turning import TurningCalibrator
from magloc.readings import Readings, write_readings

FIELD_T = 48e-6
NOISE_T = 20e-9
TRUE = [
    Calibration.of(
        "vector", np.diag([1.06, 0.97, 1.02]) + 0.02 * (np.eye(3, k=1) + np.eye(3, k=-1)), [8e-6, -3e-6, 5e-6]
    ),
    Calibration.of("vector", np.diag([0.95, 1.01, 1.04]), [-2e-6, 6e-6, 1e-6]),
]


def board():
    sensors = [Sensor(f"s{i}", "vector", (0.05 * i, 0.0, 0.0), noise_T=NOISE_T) for i in range(2)]
    return SensorArray(tuple(sensors), name="board")


def turned(n=400, seed=0, tilt=math.pi, magnet=slice(0, 0), begin_s=0.0):
    """Rows of a board that is turned slowly by hand at 10 Hz; its axis stays within a tilt from the vertical."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, n)
    R = Rotation.from_euler("zyx", np.stack([40.0 * t, tilt * np.sin(7.3 * t), 2.0 * tilt * np.sin(3.1 * t)], axis=1))
    field = R.inv().apply(FIELD_T * np.array([0.352, 0.0, -0.936]))
    field[magnet] += [30e-6, 0.0, 0.0]
    values = np.concatenate([field @ np.asarray(c.scale).T + np.asarray(c.offset_T) for c in TRUE], axis=1)
    return Readings(values + NOISE_T * rng.standard_normal(values.shape), time_s=begin_s + 0.1 * np.arange(n))


class TestProgress:
    def test_enough_gives_the_true_calibration(self):
        """Offsets, within 4.5 σ (1e-4 false alarms), and the part P of the scale matrices P Q."""
        calibrator = TurningCalibrator(board(), FIELD_T)
        progress = calibrator.add(turned())
        assert progress.enough
        assert not progress.flags
        for sensor, true, found in zip(progress.sensors, TRUE, calibrator.array().sensors, strict=True):
            off_T = np.asarray(found.calibration.offset_T) - np.asarray(true.offset_T)
            assert np.abs(off_T).max() < 4.5 * sensor.offset_sigma_T < 4.5 * progress.goal_T
            S = np.asarray(true.scale)
            np.testing.assert_allclose(
                np.asarray(found.calibration.scale) @ np.asarray(found.calibration.scale).T, S @ S.T, atol=2e-3
            )

    def test_unknown_modulus_keeps_the_mean_gain(self):
        calibrator = TurningCalibrator(board())
        progress = calibrator.add(turned())
        assert progress.enough
        gains = [np.linalg.det(np.asarray(s.calibration.scale)) for s in calibrator.array().sensors]
        assert np.prod(gains) == pytest.approx(1.0, abs=1e-3)
        assert progress.modulus_T == pytest.approx(
            FIELD_T * np.prod([np.linalg.det(np.asarray(c.scale)) for c in TRUE]) ** (1.0 / 6.0), rel=1e-3
        )

    def test_a_board_that_is_not_tilted_is_not_enough(self):
        """The missing turn is named: the field never points along an axis of the sensor."""
        calibrator = TurningCalibrator(board(), FIELD_T)
        progress = calibrator.add(turned(200, tilt=0.3))
        assert not progress.enough
        least = progress.sensors[0]
        assert least.coverage < 0.7
        assert (least.directions @ least.missing).max() < math.cos(math.radians(30.0))
        assert progress.advice.startswith("turn until the field points along ")

    def test_rest_adds_nothing(self):
        calibrator = TurningCalibrator(board(), FIELD_T)
        rows = turned(20)
        resting = Readings(np.repeat(rows.values_T[:1], 500, axis=0), time_s=0.1 * np.arange(500))
        assert calibrator.add(resting) is None
        assert calibrator.fit() is None

    def test_a_magnet_nearby_is_flagged_until_it_is_gone(self):
        """Rows with the magnet are excluded; the calibration is that of the others."""
        calibrator = TurningCalibrator(board(), FIELD_T)
        calibrator.add(turned(200))
        during = calibrator.add(turned(80, magnet=slice(0, 80), begin_s=100.0))
        assert any("a magnet or iron is near" in flag for flag in during.flags)
        assert not during.enough
        after = calibrator.add(turned(begin_s=200.0))
        assert after.enough
        for true, found in zip(TRUE, calibrator.array().sensors, strict=True):
            np.testing.assert_allclose(found.calibration.offset_T, true.offset_T, atol=5.0 * after.goal_T)

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("broken", ["dead", "stuck", "dead axis"])
    def test_a_broken_sensor_is_named(self, broken):
        """The other one is calibrated; without a name the user would turn for ever."""
        values = turned().values_T
        if broken == "dead axis":
            values[:, 4] = 0.0
        else:
            values[:, 3:] = np.nan if broken == "dead" else 1e-6
        progress = TurningCalibrator(board(), FIELD_T).add(replace(turned(), values_T=values))
        assert progress.advice.startswith("sensor s1 cannot be calibrated, although the directions are covered: ")
        assert progress.sensors[0].fit.converged
        assert not progress.enough

    def test_wild_readings_are_left_out(self):
        values = turned().values_T
        values[::37, 0] = 1e-2
        calibrator = TurningCalibrator(board(), FIELD_T)
        progress = calibrator.add(replace(turned(), values_T=values))
        assert progress.enough
        assert progress.sensors[0].disturbed.sum() > 5
        np.testing.assert_allclose(calibrator.array().sensors[0].calibration.offset_T, TRUE[0].offset_T, atol=20e-9)

    @pytest.mark.parametrize(
        ("change", "said"), [({"modulus_T": 0.0}, "modulus_T"), ({"goal_T": -1.0}, "goal_T"), ({}, "vector sensor")]
    )
    def test_refusals(self, change, said):
        scalar = SensorArray((Sensor("a", "scalar", (0.0, 0.0, 0.0), noise_T=1e-9),))
        with pytest.raises(ValueError, match=said):
            TurningCalibrator(board() if change else scalar, **change)


class TestCommand:
    @pytest.fixture
    def files(self, tmp_path):
        arrays.write_array(tmp_path / "board.toml", board())
        write_readings(tmp_path / "turned.csv", turned(), board())
        write_readings(tmp_path / "flat.csv", turned(100, tilt=0.2), board())
        return tmp_path

    def options(self, files, log, *more):
        given = ["--array", f"{files / 'board.toml'}", "--from", f"replay:{files / log}", "--replay-speed", "1e9"]
        return ["live", "--calibrate", *given, "--out-array", f"{files / 'out.toml'}", *more]

    def test_lines_until_it_is_enough(self, files, capsys):
        assert main(self.options(files, "turned.csv", "--modulus-nT", "48000", "--quiet")) == 0
        *_, last = entries = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert [entry["enough"] for entry in entries] == [False] * (len(entries) - 1) + [True]
        assert last["sensors"][0]["coverage"] >= 0.9
        for true, found in zip(TRUE, arrays.read_array(files / "out.toml").sensors, strict=True):
            np.testing.assert_allclose(found.calibration.offset_T, true.offset_T, atol=4.5 * 48e-9)

    def test_place_and_date_give_the_modulus(self, files, capsys):
        place = ["--place", "52.0", "13.0", "100", "--date", "2026-06-01"]
        assert main(self.options(files, "flat.csv", *place, "--quiet")) == 2
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["modulus_nT"] == pytest.approx(49_900.0, abs=500.0)

    @pytest.mark.parametrize(
        ("log", "more", "said"),
        [
            ("flat.csv", [], "the rows ended before the calibration was enough: "),
            ("turned.csv", ["--rest-s", "3"], "--rest-s: found together with --calibrate, expected one of them"),
            ("turned.csv", ["--goal-nT", "0"], "goal"),
            ("turned.csv", ["--modulus-nT", "480000"], "found 480000, which makes the gains of sensor s0 0.1"),
        ],
    )
    def test_refusals(self, files, capsys, log, more, said):
        assert main(self.options(files, log, *more)) == 2
        assert said in capsys.readouterr().err
        assert not (files / "out.toml").exists()

    def test_options_without_calibrate(self, files, capsys):
        command = self.options(files, "turned.csv")
        command.remove("--calibrate")
        assert main(command) == 2
        assert "--out-array: found without --calibrate, expected both" in capsys.readouterr().err
