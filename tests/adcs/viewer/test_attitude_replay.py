"""Replays of an attitude: what is enlarged, where cones point, and which rows belong together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import viser
from scipy.spatial.transform import Rotation

import adcs
from adcs.viewer.attitude_page import row_lines, strips_html
from adcs.viewer.attitude_replay import AttitudeReplay, replay_of, rows_at
from adcs.viewer.attitude_scene import AttitudeScene, _cone

N = 5
TRUTH = Rotation.from_rotvec(np.linspace([0.1, -0.2, 0.3], [0.5, 1.0, -0.7], N))
ERROR = np.radians([0.01, -0.02, 0.03])


def scalar_first(rotation: Rotation) -> np.ndarray:
    return np.roll(rotation.as_quat(), 1, axis=-1)


@pytest.fixture
def replay() -> AttitudeReplay:
    sigma = np.tile(np.radians([0.01, 0.02, 0.04]), (N, 1))
    q_true = scalar_first(TRUTH)
    q_true[-1] = np.nan
    q = scalar_first(TRUTH * Rotation.from_rotvec(ERROR))
    seen = {"gyro": np.ones(N, dtype=bool), "Sun sensor": np.arange(N) != 2}
    return AttitudeReplay("turn", ("x", "y", "z"), np.arange(float(N)), q, sigma, q_true, (), seen, {})


class TestEnlarged:
    def test_errors_are_the_turns_that_were_made(self, replay: AttitudeReplay) -> None:
        np.testing.assert_allclose(replay.errors_rad[:-1], np.tile(ERROR, (N - 1, 1)), atol=1e-12)
        assert np.isnan(replay.errors_rad[-1]).all()

    def test_drawn(self, replay: AttitudeReplay) -> None:
        turned = TRUTH[1].inv() * replay.enlarged_attitude(1, 100.0)
        np.testing.assert_allclose(turned.as_rotvec(), 100.0 * ERROR, atol=1e-10)
        np.testing.assert_allclose(scalar_first(replay.enlarged_attitude(N - 1, 100.0)), replay.q[-1], atol=1e-12)

    def test_by_as_much_as_can_be_seen(self, replay: AttitudeReplay) -> None:
        """3σ of 0.12° becomes 1.2°, and not 12°, of which 10° are let through."""
        assert replay.enlargement == 10.0
        assert replace(replay, sigma_rad=0.01 * replay.sigma_rad, q_true=np.full((N, 4), np.nan)).enlargement == 1000.0


class TestCones:
    @pytest.mark.parametrize("axis", range(3))
    def test_hold_the_axis_after_a_turn_of_three_sigma(self, replay: AttitudeReplay, axis: int) -> None:
        """The rim of each cone goes through where its axis is after a turn by 3σ about either other axis."""
        tangents = replay.cones(0, 1.0)[axis]
        rim = _cone(axis).vertices[1:] * np.roll([1.0, *tangents], axis)
        for other in ((axis + 1) % 3, (axis + 2) % 3):
            turn = Rotation.from_rotvec(3.0 * replay.sigma_rad[0, other] * np.eye(3)[other])
            tip = turn.apply(np.eye(3)[axis])
            assert np.linalg.norm(rim - tip / tip[axis], axis=1).min() < 1e-12

    def test_are_finite_whatever_sigma_is(self, replay: AttitudeReplay) -> None:
        assert (replace(replay, sigma_rad=np.full((N, 3), 1e3)).cones(0, 1e4) < 10.0).all()


class TestScene:
    def test_true_axes_are_those_of_the_row_and_hidden_where_unknown(self, replay: AttitudeReplay) -> None:
        server = viser.ViserServer("127.0.0.1", 0, verbose=False)
        try:
            scene = AttitudeScene(server.scene, replay)
            scene.show(2)
            assert scene._truth.visible
            np.testing.assert_allclose(scene._truth.wxyz, replay.q_true[2])
            scene.show(N - 1)
            assert not scene._truth.visible
        finally:
            server.stop()


class TestRows:
    def test_of_the_same_times(self) -> None:
        time_s = np.array([0.0, 1.0, 2.5, 1e6])
        assert rows_at(np.array([2.5, 1.1, 1e6 + 1e-5, -3.0]), time_s).tolist() == [2, -1, 3, -1]
        assert rows_at(np.array([7.0, 8.0]), np.array([7.0])).tolist() == [0, -1]

    def test_of_a_satellite(self) -> None:
        """What is expected of field and Sun is what was measured, in the frame that the attitude turns to."""
        log = adcs.datasets.load("satellite")
        track = adcs.estimate(log.telemetry, log.satellite, sensors="st+gyro")
        replay = replay_of(track, log.telemetry, log.satellite, None, "")
        assert [one.name for one in replay.directions] == ["field", "Sun"]
        for one in replay.directions:
            seen = np.isfinite(one.measured[:, 0])
            turned = Rotation.from_quat(np.roll(replay.q[seen], -1, axis=1)).apply(one.measured[seen])
            angle = np.degrees(np.arccos(np.clip(np.sum(turned * one.expected[seen], axis=1), -1.0, 1.0)))
            assert angle.max() < 2.0
        assert list(replay.rejected) == ["magnetometer", "Sun sensor"]
        with pytest.raises(ValueError, match="satellite must come with telemetry"):
            replay_of(track, log.telemetry, None, None, "")
        with pytest.raises(ValueError, match="truth must have shape"):
            replay_of(track, log.telemetry, log.satellite, np.zeros((3, 4)), "")


class TestWords:
    def test_of_a_row(self, replay: AttitudeReplay) -> None:
        lines = row_lines(replay, 2)
        assert "no reading of Sun sensor" in lines
        assert any("error <b>0.0374°" in line for line in lines)
        assert not any("error" in line for line in row_lines(replay, N - 1))

    def test_strips(self, replay: AttitudeReplay) -> None:
        assert "Sun sensor: 4 of 5 rows" in strips_html(replay)
        assert strips_html(replay).count("#d5d9de") == 1
