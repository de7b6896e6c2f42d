"""Paths and attitudes: where they lead, how fast, and how they are turned."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from sims.magnetics.paths import Attitude, Lawnmower, Path, Steered, Waypoints, circle

FloatArray = NDArray[np.float64]
POINTS = ((0.0, 0.0, 1.0), (3.0, 4.0, 1.0), (3.0, 4.0, 3.0), (-9.0, -1.0, 3.0))
PATHS: list[Path] = [
    Steered((1.0, 2.0, 3.0), 0.4, 1.5, turn_rad_s=-0.07, climb_m_s=0.3),
    Steered((1.0, 2.0, 3.0), -2.0, 0.7, 0.01, 0.6, 20.0),
    circle((1.0, -2.0, 5.0), 4.0, 1.2, 0.3, clockwise=False),
    Lawnmower((1.0, 2.0, 3.0), 0.8, 10.0, 3.0, 4, 1.7),
    Waypoints(POINTS, 0.8),
]


class TestEveryPath:
    @pytest.mark.parametrize("path", PATHS)
    def test_velocity_is_the_derivative_of_the_position(self, path: Path) -> None:
        time = np.random.default_rng(1).uniform(0.1, 40.0, 200)
        step = 1e-5
        before, at, after = path.at(time - step), path.at(time), path.at(time + step)
        # Where a corner lies within the step the difference is between both sides.
        smooth = np.linalg.norm(after.velocity_m_s - before.velocity_m_s, axis=1) < 1e-3
        assert smooth.sum() > 190
        difference = (after.position_m - before.position_m) / (2 * step)
        np.testing.assert_allclose(difference[smooth], at.velocity_m_s[smooth], atol=1e-7)

    @pytest.mark.parametrize("path", PATHS)
    def test_course_is_the_direction_of_the_velocity(self, path: Path) -> None:
        motion = path.at(np.linspace(0.0, 40.0, 401))
        speed = np.hypot(motion.velocity_m_s[:, 0], motion.velocity_m_s[:, 1])
        moving = speed > 0.0
        direction = np.stack([np.sin(motion.course_rad), np.cos(motion.course_rad)], axis=-1)
        np.testing.assert_allclose(direction[moving] * speed[moving, None], motion.velocity_m_s[moving, :2], atol=1e-12)
        assert moving.sum() > 100


class TestSteered:
    @settings(deadline=None)  # the integrator takes its time
    @given(
        course=st.floats(-4.0, 4.0),
        turn=st.one_of(st.just(0.0), st.floats(-0.5, 0.5)),
        weave=st.one_of(st.just(0.0), st.floats(0.0, 3.0)),
        period=st.floats(2.0, 100.0),
    )
    def test_position_is_the_integral_of_the_course(
        self, course: float, turn: float, weave: float, period: float
    ) -> None:
        path = Steered((1.0, 2.0, 3.0), course, 2.0, turn, weave, period)

        def velocity(t: float, _: FloatArray) -> list[float]:
            psi = course + turn * t + weave * math.sin(2 * math.pi * t / period)
            return [2.0 * math.sin(psi), 2.0 * math.cos(psi)]

        time = np.array([0.0, 3.0, 11.0])
        expected = solve_ivp(velocity, (0.0, 11.0), [1.0, 2.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=0.3).y.T
        np.testing.assert_allclose(path.at(time).position_m[:, :2], expected, atol=1e-6)

    def test_a_weave_in_resonance_with_the_turn_does_not_divide_by_zero(self) -> None:
        period = 10.0
        path = Steered(speed_m_s=1.0, turn_rad_s=2 * math.pi / period, weave_rad=1.0, weave_period_s=period)
        assert np.isfinite(path.at(np.linspace(0.0, 50.0, 20)).position_m).all()

    def test_speed_and_turn_rate(self) -> None:
        motion = Steered((0.0, 0.0, 0.0), 0.2, 1.3, turn_rad_s=0.05).at(np.arange(50.0))
        np.testing.assert_allclose(np.linalg.norm(motion.velocity_m_s, axis=1), 1.3)
        np.testing.assert_allclose(np.diff(motion.course_rad), 0.05)

    def test_north_and_east(self) -> None:
        north, east = (Steered(course_rad=math.radians(c), speed_m_s=2.0).at([3.0]).position_m[0] for c in (0.0, 90.0))
        np.testing.assert_allclose(north, [0.0, 6.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(east, [6.0, 0.0, 0.0], atol=1e-12)

    @pytest.mark.parametrize("clockwise", [True, False])
    def test_a_circle(self, clockwise: bool) -> None:
        path = circle((1.0, 2.0, 3.0), 5.0, 2.0, math.radians(90.0), clockwise=clockwise)
        offset = path.at(np.linspace(0.0, 30.0, 100)).position_m - np.array([1.0, 2.0, 3.0])
        np.testing.assert_allclose(np.linalg.norm(offset, axis=1), 5.0)
        np.testing.assert_allclose(offset[0], [5.0, 0.0, 0.0], atol=1e-12)
        quarter = path.at([math.pi * 5.0 / 2 / 2.0]).position_m[0] - np.array([1.0, 2.0, 3.0])
        np.testing.assert_allclose(quarter, [0.0, -5.0 if clockwise else 5.0, 0.0], atol=1e-12)


class TestWaypoints:
    def test_it_reaches_every_point_in_time(self) -> None:
        lengths = np.linalg.norm(np.diff(POINTS, axis=0), axis=1)
        times = np.concatenate([[0.0], np.cumsum(lengths)]) / 0.8
        np.testing.assert_allclose(Waypoints(POINTS, 0.8).at(times).position_m, POINTS, atol=1e-12)

    def test_speed_is_constant_until_the_last_point(self) -> None:
        end = 20.0 / 0.8
        motion = Waypoints(POINTS, 0.8).at(np.array([0.0, 5.0, 9.0, end - 0.01, end + 0.01, 100.0]))
        np.testing.assert_allclose(np.linalg.norm(motion.velocity_m_s, axis=1), [0.8, 0.8, 0.8, 0.8, 0.0, 0.0])
        np.testing.assert_allclose(motion.position_m[-1], POINTS[-1])

    def test_a_vertical_leg_keeps_the_course(self) -> None:
        motion = Waypoints(POINTS, 1.0).at(np.array([4.0, 6.0]))
        assert motion.course_rad[0] == motion.course_rad[1] == pytest.approx(math.atan2(3.0, 4.0))

    @pytest.mark.parametrize(
        ("points", "speed", "what"),
        [(POINTS[:1], 1.0, "points_m"), ((POINTS[0], POINTS[0]), 1.0, "points_m"), (POINTS, 0.0, "speed_m_s")],
    )
    def test_what_is_no_path_is_refused(self, points: tuple[tuple[float, float, float], ...], speed: float, what: str):
        with pytest.raises(ValueError, match=what):
            Waypoints(points, speed)


class TestLawnmower:
    PATH = Lawnmower((1.0, 2.0, 3.0), math.radians(90.0), 10.0, 4.0, 3, 2.0)
    TURN_S = math.pi * 2.0 / 2.0

    def test_lines_start_and_end_where_they_should(self) -> None:
        line = 10.0 / 2.0
        starts = [0.0, line + self.TURN_S, 2 * (line + self.TURN_S)]
        times = np.array([time for start in starts for time in (start, start + line)])
        # To the east; the next line lies to the right, which is south.
        expected = [[1, 2, 3], [11, 2, 3], [11, -2, 3], [1, -2, 3], [1, -6, 3], [11, -6, 3]]
        np.testing.assert_allclose(self.PATH.at(times).position_m, expected, atol=1e-12)

    def test_speed_is_constant_and_turns_are_half_circles(self) -> None:
        end = 3 * 5.0 + 2 * self.TURN_S
        time = np.linspace(0.0, end - 1e-6, 400)
        motion = self.PATH.at(time)
        np.testing.assert_allclose(np.linalg.norm(motion.velocity_m_s, axis=1), 2.0)
        in_turn = (time > 5.0) & (time < 5.0 + self.TURN_S)
        centre = np.array([11.0, 0.0, 3.0])
        np.testing.assert_allclose(np.linalg.norm(motion.position_m[in_turn] - centre, axis=1), 2.0)

    def test_it_rests_at_the_end(self) -> None:
        motion = self.PATH.at(np.array([100.0]))
        np.testing.assert_allclose(motion.position_m, [[11.0, -6.0, 3.0]])
        assert not motion.velocity_m_s.any()


class TestAttitude:
    TIME = np.linspace(0.0, 60.0, 6001)
    PHASE = np.array([0.3, 1.1, 2.0])

    def test_forward_is_along_the_course(self) -> None:
        motion = PATHS[1].at(self.TIME)
        turned = Attitude(follows_course=True).at(self.TIME, motion.course_rad, self.PHASE)
        forward, up = turned.apply([1.0, 0.0, 0.0]), turned.apply([0.0, 0.0, 1.0])
        np.testing.assert_allclose(forward * 0.7, motion.velocity_m_s, atol=1e-12)
        np.testing.assert_allclose(up, np.tile([0.0, 0.0, 1.0], (6001, 1)), atol=1e-12)

    def test_quaternions_have_norm_one(self) -> None:
        attitude = Attitude(True, (0.5, 0.5, 0.5, 0.5), (0.1, 0.2, 0.3), (0.1, 0.2, 0.3), (3.0, 4.0, 5.0))
        quaternions = attitude.at(self.TIME, PATHS[1].at(self.TIME).course_rad, self.PHASE).as_quat()
        np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1.0, rtol=1e-14)

    @pytest.mark.parametrize("axis", [0, 1, 2])
    def test_wobble_has_its_amplitude_and_period(self, axis: int) -> None:
        amplitude, period = np.zeros(3), np.array([3.0, 4.0, 5.0])
        amplitude[axis] = 0.2
        attitude = Attitude(wobble_rad=tuple(amplitude), wobble_period_s=tuple(period))
        angle = attitude.at(self.TIME, np.zeros_like(self.TIME), self.PHASE).as_rotvec()
        expected = 0.2 * np.sin(2 * np.pi * self.TIME / period[axis] + self.PHASE[axis])
        np.testing.assert_allclose(angle[:, axis], expected, atol=1e-12)
        assert angle[:, axis].max() == pytest.approx(0.2, rel=1e-4)
        assert not np.delete(angle, axis, axis=1).any()

    def test_roll_comes_before_pitch_before_yaw(self) -> None:
        attitude = Attitude(wobble_rad=(0.3, 0.4, 0.5), wobble_period_s=(4.0, 4.0, 4.0))
        found = attitude.at(np.array([1.0]), np.zeros(1), np.zeros(3)).as_matrix()[0]  # all at their amplitude
        roll, pitch, yaw = (Rotation.from_rotvec(0.1 * (3 + i) * np.eye(3)[i]).as_matrix() for i in range(3))
        np.testing.assert_allclose(found, yaw @ pitch @ roll, atol=1e-14)

    def test_tumbling_is_a_constant_rate_in_body_axes(self) -> None:
        rate = np.array([0.05, -0.02, 0.08])
        mount = Rotation.from_rotvec([0.3, -0.8, 0.5])
        turned = Attitude(mount_xyzw=tuple(mount.as_quat()), rate_rad_s=tuple(rate)).at(
            self.TIME, np.zeros_like(self.TIME), self.PHASE
        )
        step = turned[:-1].inv() * turned[1:]
        np.testing.assert_allclose(step.as_rotvec() / 0.01, np.tile(rate, (6000, 1)), atol=1e-11)
        np.testing.assert_allclose(turned[0].as_matrix(), mount.as_matrix(), atol=1e-14)
