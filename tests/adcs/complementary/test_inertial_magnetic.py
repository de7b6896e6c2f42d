"""Tests of the filter on Earth: its parts on made-up motions, the whole on three trials of the BROAD benchmark."""

import math

import numpy as np
import pytest
from scipy import signal
from scipy.spatial.transform import Rotation

from adcs import quaternion
from adcs.complementary.filters import inertial_magnetic_filter
from adcs.complementary.inertial_magnetic import (
    InertialMagneticRecord,
    inertial_magnetic_track,
    prepare,
    rest_bias,
    sensor_fixed_field,
    turned_back,
    undisturbed,
)
from adcs.complementary.inertial_magnetic_compiled import low_pass, without_turns
from tests.adcs.attitudes import random_attitudes
from tests.adcs.broad import orientation_errors, read_broad

DT = 0.01
FIELD_T = np.array([0.0, 18e-6, -45e-6])
BIAS = np.radians([0.3, -0.2, 0.1])
DISTURBED = ("30_disturbed_stationary_magnet_C", "34_disturbed_attached_magnet_3cm")


def motion(seconds=60.0, seed=0, lag=0, magnet=None):
    """Ten seconds of rest, then turns about all axes; truth, and readings with a little noise."""
    rng = np.random.default_rng(seed)
    n = round(seconds / DT)
    t = DT * np.arange(n)
    moving = t >= 10.0
    rate = np.where(moving[:, None], np.sin(np.outer(t - 10.0, [0.9, 1.3, 0.7])) * [1.2, 0.9, 1.5], 0.0)
    q = [quaternion.exp([0.1, -0.2, 0.7])]
    for w in rate[:-1]:
        q.append(quaternion.normalised(quaternion.multiply(q[-1], quaternion.exp(w * DT))))
    q = np.array(q)
    at_magnetometer = q[np.maximum(np.arange(n) - lag, 0)]
    field = quaternion.rotate_back(at_magnetometer, FIELD_T) + 0.1e-6 * rng.standard_normal((n, 3))
    if magnet is not None:
        field[t >= 20.0] += magnet
    record = InertialMagneticRecord(
        t,
        np.concatenate([rate[:1], rate[:-1]]) + BIAS + 1e-3 * rng.standard_normal((n, 3)),
        quaternion.rotate_back(q, [0.0, 0.0, 9.81]) + 0.02 * rng.standard_normal((n, 3)),
        field,
    )
    return record, q, moving


class TestParts:
    def test_bias_at_rest(self):
        record, _, _ = motion()
        np.testing.assert_allclose(rest_bias(record)[-1], BIAS, atol=5e-4)

    def test_bias_without_a_rest(self):
        record, _, moving = motion()
        moved = InertialMagneticRecord(
            record.time_s[moving], record.rate_rad_s[moving], record.acceleration_m_s2[moving], record.field_T[moving]
        )
        assert np.abs(rest_bias(moved)).max() == 0.0

    def test_a_sensor_that_is_shaken_without_turning_does_not_rest(self):
        record, _, _ = motion()
        shaken = record.acceleration_m_s2 + np.sin(20.0 * record.time_s)[:, None]
        moved = InertialMagneticRecord(record.time_s, record.rate_rad_s, shaken, record.field_T)
        assert np.abs(rest_bias(moved)).max() == 0.0

    def test_a_rest_is_known_at_its_end(self):
        record, _, _ = motion()
        changed = record.rate_rad_s.copy()
        changed[600:750] += 0.1
        other = InertialMagneticRecord(record.time_s, changed, record.acceleration_m_s2, record.field_T)
        np.testing.assert_array_equal(rest_bias(other)[:600], rest_bias(record)[:600])

    @pytest.mark.parametrize("lag", [1, 3])
    def test_lag(self, lag):
        record, _, _ = motion(lag=lag)
        prepared = prepare(record)
        assert prepared.lag_s == pytest.approx(lag * DT, abs=0.2 * DT)

    def test_up(self):
        record, q, _ = motion()
        np.testing.assert_allclose(prepare(record).up, quaternion.rotate_back(q, [0.0, 0.0, 1.0]), atol=0.02)

    def test_clean_motion(self):
        record, q, moving = motion()
        prepared = prepare(record)
        errors = orientation_errors(inertial_magnetic_track(prepared, prepared.field_T), q, moving)
        assert math.degrees(errors.total) < 0.5

    def test_magnet_on_the_sensor(self):
        """Its field is found, and the heading keeps right: far better than with rejection, which has no compass."""
        magnet = np.array([6e-6, -4e-6, 9e-6])
        record, q, moving = motion(magnet=magnet)
        prepared = prepare(record)
        offset = sensor_fixed_field(prepared)
        np.testing.assert_allclose(offset[-1], magnet, atol=0.5e-6)
        assert np.abs(offset[: round(19.0 / DT)]).max() < 1e-6
        totals = [
            orientation_errors(inertial_magnetic_track(prepared, field), q, moving).total
            for field in (prepared.field_T, prepared.field_T - offset)
        ]
        assert totals[1] < 0.2 * totals[0]
        assert math.degrees(totals[1]) < 1.0

    def test_rejection(self):
        record, _, _ = motion(magnet=np.array([0.0, 0.0, 30e-6]))
        left_out = np.isnan(undisturbed(prepare(record))[:, 0])
        assert left_out[: round(20.0 / DT)].mean() < 0.01
        assert left_out[round(20.0 / DT) :].mean() > 0.7


class TestCompiled:
    def test_turns_undone(self):
        rng = np.random.default_rng(0)
        time_s = np.cumsum(rng.uniform(0.005, 0.015, 200))
        q = quaternion.exp(np.cumsum(0.05 * rng.standard_normal((200, 3)), axis=0))
        rows, field = np.arange(0, 200, 3), rng.standard_normal((200, 3))
        for lag_s in (0.0, 0.013, 0.3):
            args = q, time_s, rows, field, lag_s
            np.testing.assert_allclose(without_turns(*args), turned_back(*args), atol=1e-12)

    def test_low_pass_is_scipys_butterworth(self):
        """On equal steps, against the bilinear transform, whose error falls with the square of the step."""
        values = np.random.default_rng(1).standard_normal((4000, 3)).cumsum(axis=0)
        cutoff_Hz = math.sqrt(2.0) / (2.0 * math.pi * 2.0)
        sections = signal.butter(2, 2.0 * DT * cutoff_Hz, output="sos")
        start = signal.sosfilt_zi(sections)[..., None] * values[0]
        expected, _ = signal.sosfilt(sections, values, axis=0, zi=start)
        found = low_pass(values, np.full(4000, DT), 2.0, values[0])
        np.testing.assert_allclose(found, expected, atol=0.01 * np.ptp(values))

    def test_low_pass_in_any_steps(self):
        """SciPy's simulation of the same equation, the input on straight lines, and NaN as the value before."""
        rng = np.random.default_rng(2)
        time_s = np.concatenate([[0.0], np.cumsum(rng.uniform(0.002, 0.02, 2000))])
        values = np.stack([np.sin(f * time_s) for f in (0.5, 1.0, 3.0)], axis=1)
        s = 1.0 / 3.0
        found = low_pass(values, np.diff(time_s, prepend=-0.01), 3.0, values[0])
        fine = np.linspace(0.0, time_s[-1], 40_001)
        for axis, f in enumerate((0.5, 1.0, 3.0)):
            _, expected, _ = signal.lsim(([2.0 * s * s], [1.0, 2.0 * s, 2.0 * s * s]), np.sin(f * fine), fine)
            np.testing.assert_allclose(found[:, axis], np.interp(time_s, fine, expected), atol=2e-4)
        missing = values.copy()
        missing[5:9], values[5:9] = np.nan, values[4]
        steps = np.diff(time_s, prepend=-0.01)
        np.testing.assert_array_equal(low_pass(missing, steps, 3.0, values[0]), low_pass(values, steps, 3.0, values[0]))


class TestDoor:
    def test_is_made_of_the_parts(self):
        record, _, _ = motion(magnet=np.array([0.0, 0.0, 30e-6]))
        prepared = prepare(record)
        time_s = 5.0 + DT * np.arange(len(record))
        readings = record.rate_rad_s, record.acceleration_m_s2, record.field_T
        for magnet, field in (
            ("kept", prepared.field_T),
            ("rejected", undisturbed(prepared)),
            ("subtracted", prepared.field_T - sensor_fixed_field(prepared)),
        ):
            track = inertial_magnetic_filter(time_s, *readings, magnet=magnet)
            np.testing.assert_allclose(track.q, inertial_magnetic_track(prepared, field), atol=1e-9)
            np.testing.assert_allclose(track.states["rate"] + track.states["gyro-bias"], record.rate_rad_s, atol=1e-12)
            assert np.array_equal(track.seen["magnetometer"], np.isfinite(field).all(axis=1))
            assert np.array_equal(track.time_s, time_s)

    def test_refusals(self):
        time_s, ones = DT * np.arange(200), np.ones((200, 3))
        with pytest.raises(ValueError, match=r"magnet must be one of .*; instead received 'left'"):
            inertial_magnetic_filter(time_s, ones, ones, ones, magnet="left")
        with pytest.raises(ValueError, match="time_s must ascend"):
            inertial_magnetic_filter(-time_s, ones, ones, ones)


class TestErrors:
    def test_parts_of_a_turn(self):
        """Around the vertical all of it is heading, around a horizontal axis all of it inclination."""
        rng = np.random.default_rng(0)
        q = random_attitudes(100, rng)
        counted = np.ones(100, dtype=bool)
        for axis, expected in (([0.0, 0.0, 0.3], (0.3, 0.3, 0.0)), ([0.2, 0.0, 0.0], (0.2, 0.0, 0.2))):
            errors = orientation_errors(quaternion.multiply(quaternion.exp(axis), q), q, counted)
            assert (errors.total, errors.heading, errors.inclination) == pytest.approx(expected, abs=1e-7)

    def test_total_against_scipy(self):
        rng = np.random.default_rng(1)
        p, q = random_attitudes(50, rng), random_attitudes(50, rng)
        q[:5] = np.nan
        counted = np.arange(50) < 40
        turns = Rotation.from_quat(p[5:40], scalar_first=True) * Rotation.from_quat(q[5:40], scalar_first=True).inv()
        expected = math.sqrt(np.mean(turns.magnitude() ** 2))
        assert orientation_errors(p, q, counted).total == pytest.approx(expected, rel=1e-9)


@pytest.fixture(scope="module")
def totals(data_folder):
    """[°] with the field as it is, rejected where it is wrong, and with the sensor-fixed part subtracted."""
    found = {}
    for name in ("01_undisturbed_slow_rotation_A", *DISTURBED):
        trial = read_broad(data_folder / "broad" / f"{name}.mat")
        prepared = prepare(trial.record)
        fields = (prepared.field_T, undisturbed(prepared), prepared.field_T - sensor_fixed_field(prepared))
        found[name[:2]] = [
            math.degrees(orientation_errors(inertial_magnetic_track(prepared, field), trial.q_true, trial.moving).total)
            for field in fields
        ]
    return found


class TestBroad:
    """Three trials of the BROAD benchmark; VQF has 2.43° over all of its 30 undisturbed and disturbed ones."""

    def test_below_vqf(self, totals):
        assert np.mean([of_trial[2] for of_trial in totals.values()]) < 2.43
        assert totals["01"][2] < 2.0
        assert totals["34"][2] < 2.0

    def test_subtraction_against_rejection(self, totals):
        """A magnet on the sensor: from 1.9° to 1.0°. A standing one that is passed twice for a second: a loss."""
        assert totals["34"][0] > 5.0
        assert totals["34"][2] < 0.7 * totals["34"][1]
        assert totals["30"][1] < 2.43

    def test_the_magnet(self, data_folder):
        """It came and went: some 13 µT, and nothing before and after but the sensor's own offset."""
        trial = read_broad(data_folder / "broad" / f"{DISTURBED[1]}.mat")
        offset = np.linalg.norm(sensor_fixed_field(prepare(trial.record)), axis=1)
        instant = 1.0 / trial.record.dt_s[0]
        assert offset[int(40.0 * instant)] < 1e-6
        assert offset[int(80.0 * instant)] == pytest.approx(13.5e-6, abs=1.5e-6)
        assert offset[-1] < 2e-6


class TestInput:
    def test_record(self):
        good, time_s = np.ones((200, 3)), DT * np.arange(200)
        with pytest.raises(ValueError, match="time_s must ascend, two instants or more"):
            InertialMagneticRecord(0.0 * time_s, good, good, good)
        with pytest.raises(ValueError, match="time_s must last a second at least"):
            InertialMagneticRecord(time_s[:50], good[:50], good[:50], good[:50])
        with pytest.raises(ValueError, match="field_T must be finite, of shape"):
            InertialMagneticRecord(time_s, good, good, np.full((200, 3), np.inf))
        with pytest.raises(ValueError, match="field_T must have a reading within the first second"):
            InertialMagneticRecord(time_s, good, good, np.full((200, 3), np.nan))
        with pytest.raises(ValueError, match="acceleration_m_s2 must have a length"):
            InertialMagneticRecord(time_s, good, np.zeros((200, 3)), good)

    def test_no_field(self):
        record, _, _ = motion(15.0)
        prepared = prepare(record)
        with pytest.raises(ValueError, match="within the first second"):
            inertial_magnetic_track(prepared, np.full_like(prepared.field_T, np.nan))
