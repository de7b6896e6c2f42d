"""Model of a body in a calibration: derivatives against finite differences, changed bodies against rotations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from magloc.bodies.body import MagnetBody
from magloc.calibration.array import CalibrationPrior
from magloc.calibration.bodies.calibrate import BodyPrior
from magloc.calibration.bodies.gauges import body_gauges
from magloc.calibration.bodies.model import PER_MAGNET, BodyProblem, BodyState, across, changed_body
from magloc.fields.shapes import Shape
from sims.magnetics.joystick import nominal_array, nominal_knob, random_poses

N_ROWS = 5
N_SHARED = 45 + 3 * PER_MAGNET


def problem_and_state(*, known: bool = False, shapes: bool = False) -> tuple[BodyProblem, BodyState]:
    """A device far from its nominal state, with a common field."""
    rng = np.random.default_rng(3)
    array, body = nominal_array(), nominal_knob()
    if shapes:
        magnets = [replace(magnet, shape=Shape("cylinder", (0.004, 0.006))) for magnet in body.magnets]
        body = replace(body, magnets=tuple(magnets))
    prior = CalibrationPrior(position_m=2e-4, gain=0.03, axes_rad=0.03)
    x, rotation = random_poses(rng, N_ROWS)
    problem = BodyProblem(
        array=array,
        readings_T=1e-3 * rng.normal(size=(N_ROWS, 9)),
        noise_T=np.full((N_ROWS, 9), 1e-5),
        prior=prior.deviations(3),
        free=prior.free(array),
        body=body,
        magnet_prior=BodyPrior().deviations(body),
        pose_m=x,
        pose_R=rotation.as_matrix(),
        pose_sigma=np.full((N_ROWS, 2), [1e-4, 1e-3] if known else np.inf),
    )
    sensors = problem.prior * rng.normal(size=problem.prior.shape)
    magnets = problem.magnet_prior * rng.normal(size=problem.magnet_prior.shape)
    R = (rotation * Rotation.from_rotvec([0.01, 0.02, 0.03])).as_matrix()
    return problem, BodyState(sensors, magnets, x + 1e-4, R, 1e-6 * rng.normal(size=(N_ROWS, 3)))


def residuals(problem: BodyProblem, state: BodyState) -> np.ndarray:
    return problem.residuals(problem.prediction_T(state))


class TestDerivatives:
    @pytest.mark.parametrize("shapes", [False, True])
    def test_of_sensors_and_magnets(self, shapes: bool) -> None:
        problem, state = problem_and_state(shapes=shapes)
        linear = problem.linearise(state)
        analytic = np.zeros((N_ROWS, 3, 3, 3, 15))
        for i in range(3):
            analytic[:, i, :, i] = linear.by_sensor[:, i]
        analytic = np.concatenate([analytic.reshape(N_ROWS, 9, 45), linear.by_source], axis=-1)
        none, step = np.zeros((N_ROWS, 9)), 1e-5
        for k in range(N_SHARED):
            unit = step * np.eye(N_SHARED)[k]
            both = [residuals(problem, problem.after_step(state, sign * unit, none)) for sign in (1.0, -1.0)]
            np.testing.assert_allclose(
                analytic[..., k], (both[0] - both[1]) / (2 * step), rtol=0, atol=1e-7 * np.abs(analytic).max()
            )

    def test_of_poses_and_common_field(self) -> None:
        problem, state = problem_and_state()
        linear = problem.linearise(state)
        for k, step in enumerate([1e-8] * 3 + [1e-6] * 3 + [1e-8] * 3):
            unit = np.zeros((N_ROWS, 9))
            unit[:, k] = step
            none = np.zeros(N_SHARED)
            both = [residuals(problem, problem.after_step(state, none, sign * unit)) for sign in (1.0, -1.0)]
            np.testing.assert_allclose(
                linear.by_row[..., k],
                (both[0] - both[1]) / (2 * step),
                rtol=0,
                atol=1e-6 * np.abs(linear.by_row[..., k]).max(),
            )

    def test_prior_of_a_pose(self) -> None:
        problem, state = problem_and_state(known=True)
        weight, deviation = problem.row_priors(state)
        np.testing.assert_allclose((weight * deviation)[:, :3], 1.0, rtol=1e-9)
        np.testing.assert_allclose((weight * deviation)[:, 3:6], np.tile([10.0, 20.0, 30.0], (N_ROWS, 1)), rtol=1e-6)


class TestChangedBody:
    def test_two_angles_rotate_a_magnet_and_its_shape(self) -> None:
        shape = {"shape": Shape("cylinder", (0.005, 0.0045)), "rotation_xyzw": (0, 0, 0, 1)}
        body = MagnetBody(tuple(replace(magnet, **shape) for magnet in nominal_knob().magnets))
        change = np.zeros((3, PER_MAGNET))
        change[:, 3], change[:, 4:] = 0.02, [0.05, -0.03]
        after = changed_body(body, change)
        for before, now, axes in zip(body.magnets, after.magnets, across(body), strict=True):
            turn = Rotation.from_rotvec(np.array([0.05, -0.03]) @ axes)
            np.testing.assert_allclose(now.moment_Am2, 1.02 * turn.apply(before.moment_Am2), rtol=1e-12)
            np.testing.assert_allclose(now.rotation_xyzw, turn.as_quat(), atol=1e-12)


class TestGauges:
    """A step along a gauge changes no reading, if the poses may follow; checked to second order of the step."""

    @pytest.mark.parametrize("name", sorted(body_gauges(*problem_and_state())))
    def test_of_unknown_poses(self, name: str) -> None:
        problem, state = problem_and_state()
        self.assert_free(problem, state, name)

    @pytest.mark.parametrize(
        "name", [n for n in sorted(body_gauges(*problem_and_state(known=True))) if "together" in n]
    )
    def test_of_one_known_pose(self, name: str) -> None:
        """The row of the known pose keeps its pose."""
        problem, state = problem_and_state(known=True)
        state = replace(state, position_m=problem.pose_m, R=problem.pose_R)
        of_rows = ("readings_T", "noise_T", "pose_m", "pose_R", "pose_sigma")
        first = replace(problem, **{name: getattr(problem, name)[:1] for name in of_rows})
        alone = replace(state, position_m=state.position_m[:1], R=state.R[:1], common_T=0.0 * state.common_T[:1])
        self.assert_free(first, alone, name, fixed=True)

    @staticmethod
    def assert_free(problem: BodyProblem, state: BodyState, name: str, *, fixed: bool = False) -> None:
        gauge = body_gauges(problem, state)[name]
        linear = problem.linearise(state)
        n = len(state.position_m)
        by_sensor = np.zeros((n, 3, 3, 3, 15))
        for i in range(3):
            by_sensor[:, i, :, i] = linear.by_sensor[:, i]
        shared = np.concatenate([by_sensor.reshape(n, 9, 45), linear.by_source], axis=-1)
        change = shared @ gauge
        for row in range(n):
            columns = linear.by_row[row, :, 6:] if fixed else linear.by_row[row]
            left = change[row] - columns @ np.linalg.lstsq(columns, change[row], rcond=None)[0]
            np.testing.assert_allclose(left, 0.0, rtol=0, atol=1e-7 * np.abs(shared[row] * gauge).max())
