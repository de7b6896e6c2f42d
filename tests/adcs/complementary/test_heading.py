"""Tests of the heading's filter: against filterpy and numerical derivatives, and on made-up rooms."""

import math
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter, KalmanFilter
from scipy.differentiate import jacobian
from scipy.stats import chi2

from adcs import quaternion
from adcs.complementary.heading import (
    HeadingModel,
    _blocks,
    heading_track,
    rotate_to_north,
    run_heading_filter,
    transitions,
)

MODEL = HeadingModel()
STEP_S, FIELD_T = 0.02, np.array([0.0, 18e-6, -45e-6])
TOLD = (0, 5, 6, 7)  # heading and offset, of the state


def expected_field(x, i, blocks):
    """Field in the level frame (3,) that a state (14,) makes expect in a block, and its derivative (3, 14)."""
    c, s = np.cos(x[0]), np.sin(x[0])
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    level, R = turn @ (blocks.start_T + x[8:11] + x[11:14]), blocks.R_level[i]
    of_heading = np.array([[-level[1]], [level[0]], [0.0]])
    return level + R @ x[5:8], np.hstack([of_heading, np.zeros((3, 4)), R, turn, turn])


def transition_matrices(blocks, model):
    """Φ and Q (m, 14, 14) of all blocks."""
    turn, kept, growth = transitions(blocks, model)
    Phi, Q = np.zeros((2, len(kept), 14, 14))
    for i in range(14):
        Phi[:, i, i], Q[:, i, i] = kept[:, i], growth[:, i]
    Phi[:, 0, 1:5] = turn
    return Phi, Q


def room(seconds=60.0, seed=0, turning=1.0, **changes):
    """A sensor that lies for five seconds, then turns: truth of heading, and readings drawn from the filter's model.

    While it lies the room's field is that of the start.

    ``magnet``: field of what moves with it from 20 s on. ``standing``: change of the room's from then on.
    """
    rng = np.random.default_rng(seed)
    n = round(seconds / STEP_S)
    time_s = STEP_S * np.arange(n)
    moving = time_s >= 5.0
    rate = np.where(moving[:, None], np.sin(np.outer(time_s, [0.9, 1.3, 0.7])) * [1.2, 0.9, 1.5], 0.0) * turning
    true_rate = rate * (1.0 + MODEL.gyro_scale * rng.standard_normal(3))
    q = [quaternion.IDENTITY]
    for w in true_rate[1:]:
        q.append(quaternion.normalised(quaternion.multiply(q[-1], quaternion.exp(w * STEP_S))))
    q = np.array(q)
    drift, slow, quick, drifts = 0.0, np.zeros(3), np.zeros(3), np.zeros((n, 7))
    for i in range(1, n):
        keeps = np.exp(-STEP_S / np.array([MODEL.gyro_drift_s, MODEL.room_s, MODEL.local_s]))
        keeps = np.where(moving[i], keeps, 1.0)
        new = np.sqrt(1.0 - keeps**2)
        drift = keeps[0] * drift + MODEL.gyro_drift_rad_s * new[0] * rng.standard_normal()
        slow = keeps[1] * slow + MODEL.room_T * new[1] * rng.standard_normal(3)
        quick = keeps[2] * quick + MODEL.local_T * np.array([1.0, 1.0, 0.5]) * new[2] * rng.standard_normal(3)
        drifts[i] = drifts[i - 1, 0] + drift * STEP_S * moving[i], *slow, *quick
    standing = np.where(time_s[:, None] >= 20.0, changes.get("standing", np.zeros(3)), 0.0)
    field = quaternion.rotate_back(q, FIELD_T + drifts[:, 1:4] + drifts[:, 4:7] + standing)
    field += np.where(time_s[:, None] >= 20.0, changes.get("magnet", np.zeros(3)), 0.0)
    field += MODEL.noise_T * rng.standard_normal((n, 3))
    # What the gyro makes of it: level, with a heading of its own.
    scaled = np.cumsum(np.sum((rate - true_rate) * quaternion.matrix(q)[:, 2], axis=1)) * STEP_S
    q_level = rotate_to_north(q, -(scaled + drifts[:, 0]))
    return time_s, rate, q_level, field, scaled + drifts[:, 0]


class TestParts:
    @pytest.mark.usefixtures("instruction_set")
    def test_against_filterpy(self):
        """Filter and smoother of a record without anything wrong."""
        model = replace(MODEL, noise_T=1e-6, room_s=40.0, gate=math.inf, mean_nis=math.inf, evidence=math.inf)
        time_s, rate, q_level, field, _ = room(10.0)
        blocks, _ = _blocks(time_s, rate, q_level, field, MODEL)
        x, P = 1e-3 * np.arange(14.0) * [1, 1, 1, 1, 1, *[1e-4] * 9], np.diag(MODEL.deviations() ** 2)
        other = ExtendedKalmanFilter(14, 3)
        other.x, other.P, other.R = x.copy(), P.copy(), model.noise_T**2 * np.eye(3)
        ours = [run_heading_filter(x, P, blocks, model, offline=offline)[:2] for offline in (False, True)]
        theirs = []
        for i, (Phi, Q) in enumerate(zip(*transition_matrices(blocks, model), strict=True)):
            other.F, other.Q = Phi, Q
            other.predict()
            other.update(
                blocks.field_T[i],
                lambda state, i=i: expected_field(state, i, blocks)[1],
                lambda state, i=i: expected_field(state, i, blocks)[0],
            )
            theirs.append((other.x, other.P, other.F, other.Q))
        xs, Ps, *system = (np.array(column) for column in zip(*theirs, strict=True))
        smoothed, covariances, *_ = KalmanFilter(14, 3).rts_smoother(xs, Ps, *system)
        for (told, variances), states, matrices in zip(ours, (xs, smoothed), (Ps, covariances), strict=True):
            np.testing.assert_allclose(told, states[:, TOLD], rtol=1e-5, atol=1e-9)
            np.testing.assert_allclose(variances, np.diagonal(matrices, 0, 1, 2)[:, TOLD], rtol=1e-4)

    def test_derivatives(self):
        time_s, rate, q_level, field, _ = room(8.0)
        blocks, _ = _blocks(time_s, rate, q_level, field, MODEL)
        x = np.array([0.4, *[0.0] * 4, *[1e-6] * 9])

        def expected(states):
            found = [expected_field(state, 150, blocks)[0] for state in states.reshape(14, -1).T]
            return np.array(found).T.reshape(3, *states.shape[1:])

        scale = np.array([1.0] * 5 + [1e-6] * 9)
        numerical = jacobian(lambda z: expected(z * scale.reshape(14, *[1] * (z.ndim - 1))), x / scale).df
        np.testing.assert_allclose(numerical, expected_field(x, 150, blocks)[1] * scale, atol=1e-11)

    def test_the_gyros_scale_turns_the_heading(self):
        """Φ against a rotation by quaternions with gains that are wrong."""
        time_s, rate, q_level, field, _ = room(8.0)
        blocks, _ = _blocks(time_s, rate, q_level, field, MODEL)
        x = np.zeros(14)
        x[2:5] = 0.01, -0.02, 0.03
        after = transition_matrices(blocks, MODEL)[0][160] @ x
        h = blocks.dt_s[160]
        R = blocks.R_level[160]
        extra = R @ (x[2:5] * blocks.rate_rad_s[160]) * h
        assert after[0] == pytest.approx(extra[2], rel=1e-9)


class TestRooms:
    @pytest.mark.slow
    def test_honest(self):
        """NEES of the heading, filtered and smoothed, over 16 rooms drawn from the model: false alarms 1 in 1,000."""
        squares = []
        for seed in range(16):
            time_s, rate, q_level, field, true = room(40.0, seed)
            found = [heading_track(time_s, rate, q_level, field, offline=offline) for offline in (False, True)]
            rows = np.searchsorted(time_s, [10.0, 20.0, 30.0, 39.0])
            squares.append([((f.heading_rad - true) / f.sigma_rad)[rows] ** 2 for f in found])
            assert found[0].changes.size == 0
            assert found[0].left_out.mean() < 0.01
        means = np.mean(squares, axis=(0, 2))
        # The four instants of a room are not independent: 16 numbers at the least.
        assert (means > 0.25).all()
        assert (means < 2.45).all()

    @pytest.mark.parametrize("seed", range(5))
    def test_a_magnet_on_the_sensor(self, seed):
        magnet = np.array([6e-6, -4e-6, 19e-6])
        time_s, rate, q_level, field, true = room(40.0, seed, magnet=magnet)
        found = heading_track(time_s, rate, q_level, field)
        (change,) = found.changes
        assert 20.0 <= time_s[change] < 21.5
        np.testing.assert_allclose(found.offset_T[-1], magnet, atol=1e-6)
        assert abs(found.heading_rad - true)[-1] < 4.0 * found.sigma_rad[-1]

    @pytest.mark.parametrize("seed", range(5))
    def test_a_magnet_in_the_room_is_left_out(self, seed):
        standing = np.array([6e-6, -4e-6, 19e-6])
        time_s, rate, q_level, field, true = room(40.0, seed, standing=standing)
        found = heading_track(time_s, rate, q_level, field)
        assert found.changes.size == 0
        assert found.left_out[time_s > 22.0].mean() > 0.9
        assert abs(found.heading_rad - true)[-1] < 4.0 * found.sigma_rad[-1]

    def test_without_turns_it_cannot_be_told_and_is_not(self):
        """A sensor that hardly turns: a magnet on it and one beside it are the same, and the gyro goes on."""
        magnet = np.array([6e-6, -4e-6, 19e-6])
        for where in ("magnet", "standing"):
            time_s, rate, q_level, field, _ = room(40.0, 1, turning=0.02, **{where: magnet})
            found = heading_track(time_s, rate, q_level, field)
            assert found.changes.size == 0
            assert found.left_out[time_s > 22.0].all()

    def test_sigma_grows_while_the_gyro_is_alone(self):
        """Without what the gyro's scale makes of turns, which goes as they are turned back."""
        standing = np.array([6e-6, -4e-6, 19e-6])
        time_s, rate, q_level, field, _ = room(60.0, 2, standing=standing)
        found = heading_track(time_s, rate, q_level, field, replace(MODEL, gyro_scale=1e-6))
        at = np.searchsorted(time_s, [22.0, 40.0, 59.0])
        assert (np.diff(found.sigma_rad[at]) > 0.03 * found.sigma_rad[at[0]]).all()

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("offline", [False, True])
    def test_sigma_grows_after_the_last_reading(self, offline):
        """By 0.023 rad in 45 s, of 0.0007 rad/s that are forgotten in 20 s; false alarms of χ² 1 in 1,000."""
        square = 0.0
        for seed in range(12):
            time_s, rate, q_level, field, truth = room(60.0, seed)
            field[time_s > 15.0] = np.nan
            track = heading_track(time_s, rate, q_level, field, offline=offline)
            variance = np.square(track.sigma_rad)
            assert math.sqrt(variance[-1] - variance[time_s < 15.0][-1]) == pytest.approx(0.023, rel=0.1)
            square += float(np.square((track.heading_rad - truth)[-1] / track.sigma_rad[-1]))
        assert square < chi2(12).isf(1e-3)

    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("offline", [True, False])
    def test_an_unnoticed_magnet(self, offline):
        """It turns the heading of a sensor that hardly turns: the track says so, and σ holds; else it is quiet."""
        squares, wrong = [], 0
        for seed, size_T in product(range(6), (9e-6, 12e-6)):
            time_s, rate, q_level, field, true = room(80.0, seed, turning=0.05, magnet=np.array([size_T, 0.0, 0.0]))
            found = heading_track(time_s, rate, q_level, field, offline=offline)
            late = time_s > 30.0
            if math.sqrt(np.mean(np.square(found.heading_rad - true)[late])) > math.radians(6.0):
                wrong += 1
                assert found.doubted.any()
            squares.append(np.mean(np.square((found.heading_rad - true) / found.sigma_rad)[late]))
        for seed in range(6):
            assert not heading_track(*room(80.0, seed)[:4], offline=offline).doubted.any()
        assert wrong > 4
        assert np.mean(squares) < 3.0

    def test_nothing_is_used_before_it_is_read(self):
        time_s, rate, q_level, field, _ = room(20.0)
        changed = field.copy()
        changed[time_s > 12.0] *= 1.02
        found, other = (heading_track(time_s, rate, q_level, values) for values in (field, changed))
        early = time_s <= 12.0
        np.testing.assert_array_equal(found.heading_rad[early], other.heading_rad[early])
        assert not np.array_equal(found.heading_rad, other.heading_rad)

    def test_a_magnetometer_with_a_rate_of_its_own(self):
        """Every fifth row has a field: a tenth of a second apart."""
        time_s, rate, q_level, field, true = room(40.0)
        seldom = np.where(np.arange(len(time_s))[:, None] % 5 == 0, field, np.nan)
        found = heading_track(time_s, rate, q_level, seldom)
        assert abs(found.heading_rad - true)[-1] < 4.0 * found.sigma_rad[-1]
        assert found.left_out.mean() < 0.01

    def test_what_is_kept(self):
        time_s, rate, q_level, field, _ = room(40.0, standing=np.array([6e-6, -4e-6, 19e-6]))
        found = heading_track(time_s, rate, q_level, field, replace(MODEL, gate=math.inf, mean_nis=math.inf))
        assert not found.left_out.any()
