"""Errors of an array's pose: what they do to readings, and how they last.

| what | who checks it |
|---|---|
| a source in the axes of an array whose pose errs | the sensors put where they truly are, magpylib's field there |
| derivatives | scipy.differentiate of the exact model |
| rates | a path of constant velocity and turn rate |
| how errors last | their covariance, by the exponential |
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays import geometries
from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from magloc.bounds.crlb import cramer_rao_bounds
from magloc.measurement.pose import (
    ArrayPose,
    PoseErrors,
    pose_errors_at_rest,
    rates_of,
    with_stated_pose,
)
from magloc.readings import Readings
from magloc.tracking.motion import RandomWalk
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from tests.oracles import derivative, magpylib_field

FloatArray = NDArray[np.float64]
R = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
POSE = ArrayPose(
    np.array([0.5, -0.2, 0.1]), R, np.array([0.4, -0.3, 0.1]), np.array([0.05, 0.2, -0.1]), np.array([0.1, 0.3, -0.2])
)
SOURCE = np.array([3.0, 1.5, 0.8, 120.0, -150.0, 160.0])
ERROR = np.array([0.02, -0.03, 0.05, 0.1, -0.2, 0.05, 0.03, 0.02, -0.06])
UNIT = np.repeat([1.0, 100.0], 3)
AMBIENT_T = np.array([2e-6, 20e-6, -43e-6])
STATED = PoseUncertainty(0.02, math.radians(0.3), 0.02, 10.0, 0.05, math.radians(0.5), 0.01, (0.1, 0.3, -0.2))


ALONG = AMBIENT_T / np.linalg.norm(AMBIENT_T)
ACROSS = np.linalg.svd(AMBIENT_T[None])[2][1:].T


def uncertain(kind: str, noise_T: float = 1e-11) -> SensorArray:
    """Whose pose errs, and whose ambient field too, by 200 nT and by 100 nT more that are new in every row."""
    array = geometries.tetrahedron(1.5, kind, noise_T)  # type: ignore[arg-type]
    return replace(array, pose=STATED, ambient_uncertainty_T=2e-7, ambient_uncertainty_white_T=1e-7)


def row_of(array: SensorArray, pose: ArrayPose = POSE) -> Row:
    return Row(
        0.0,
        np.zeros(array.n_channels),
        pose.origin_m,
        pose.R_world_from_array,
        pose.R_world_from_array.T @ AMBIENT_T,
        pose.velocity_m_s,
        pose.rate_rad_s,
    )


class TestTrueReadings:
    """Of sensors that stand where an erring pose truly has them, in the ambient field that there truly is."""

    @pytest.mark.parametrize("kind", ["vector", "scalar"])
    def test_are_predicted_by_the_state_that_holds_the_errors(self, kind: str) -> None:
        array = uncertain(kind)
        measurement = Tracker(array, RandomWalk(1e-9, 1e-9)).measurements.of(row_of(array))
        n = measurement.pose_effect.shape[1]
        assert n == (20 if kind == "scalar" else 14)
        u = np.random.default_rng(0).normal(size=n)
        sigma = np.repeat(
            [STATED.attitude_rad, 0.02, 0.02, STATED.attitude_constant_rad, 0.05, 0.01], [3, 3, 1, 3, 3, 1]
        )
        turn, shift, late, mount, lever, clock = np.split(u[:14] * sigma, [3, 6, 7, 10, 13])
        off_T = (2e-7 * u[14:17] + 1e-7 * u[17:] if n == 20 else np.zeros(3)) @ np.column_stack([ALONG, ACROSS])
        longer, turned_T = float(off_T[0]), off_T[1:] @ ACROSS.T
        angle = math.atan(np.linalg.norm(turned_T) / np.linalg.norm(AMBIENT_T))
        turned = math.cos(angle) * ALONG + math.sin(angle) * turned_T / max(np.linalg.norm(turned_T), 1e-30)
        ambient_T = (np.linalg.norm(AMBIENT_T) + longer) * turned
        late_s = float(late[0] + clock[0])
        # The pose is where the array was late_s ago, to first order of its motion.
        true_R = R @ Rotation.from_rotvec(turn + mount + late_s * POSE.rate_rad_s).as_matrix()
        velocity = POSE.velocity_m_s - R @ np.cross(POSE.rate_rad_s, POSE.lever_arm_m)
        reference = POSE.origin_m - R @ POSE.lever_arm_m + shift + late_s * velocity
        sensors = reference + (POSE.lever_arm_m + lever + array.positions) @ true_R.T
        fields = magpylib_field(sensors, SOURCE[:3], SOURCE[3:]) + ambient_T
        readings = array.readings_of(fields @ true_R)
        expected = measurement.model.measured(readings)
        found = measurement.predict(np.concatenate([SOURCE, u]))
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-7 * float(np.abs(expected).max()))


class TestDerivatives:
    """To 1e-6 of the largest entry in a column."""

    def agree(self, J: FloatArray, expected: FloatArray) -> None:
        scale = np.maximum(np.abs(expected).max(axis=0), 1e-30)
        np.testing.assert_allclose(J / scale, expected / scale, atol=1e-6)

    def test_of_the_source_in_the_array(self) -> None:
        expected = derivative(
            lambda y: np.apply_along_axis(lambda e: POSE.to_array(SOURCE, e) / UNIT, -1, y), ERROR, 1e-2, 1e-9
        )
        J = POSE.error_jacobian(POSE.to_array(SOURCE, ERROR), ERROR)
        self.agree(J[:, :9] / UNIT[:, None], expected)
        assert not np.any(J[:, 9:])

    def test_of_the_source_in_the_world(self) -> None:
        """Of what the array knows: where in_array gives the same again."""
        in_array = POSE.to_array(SOURCE, np.zeros(9))

        def world(error: FloatArray) -> FloatArray:
            turned = POSE.true_attitude(error)
            arm = in_array[:3] + POSE.lever_arm_m + error[6:9]
            return np.concatenate([POSE.reference_m + error[3:6] + turned @ arm, turned @ in_array[3:]])

        np.testing.assert_allclose(POSE.to_array(world(ERROR), ERROR), in_array, rtol=1e-12)
        expected = derivative(lambda y: np.apply_along_axis(lambda e: world(e) / UNIT, -1, y), np.zeros(9), 1e-2, 1e-9)
        self.agree(POSE.world_jacobian(in_array)[:, :9] / UNIT[:, None], expected)

    @pytest.mark.parametrize("kind", ["vector", "scalar"])
    def test_of_the_readings(self, kind: str) -> None:
        array = uncertain(kind, 1e-9)
        measurement = Tracker(array, RandomWalk(1e-9, 1e-9)).measurements.of(row_of(array))
        n = measurement.pose_effect.shape[1]
        unit = np.concatenate([UNIT, np.ones(n)])
        state = np.concatenate([SOURCE, np.random.default_rng(1).normal(size=n)])
        expected = derivative(
            lambda y: np.apply_along_axis(lambda x: measurement.predict(x * unit), -1, y), state / unit, 1e-2, 1e-7
        )
        self.agree(measurement.jacobian(state) * unit, expected)

    def test_of_the_coordinates(self) -> None:
        array = replace(geometries.tetrahedron(1.5, "vector", 1e-9), pose=STATED)
        measurement = Tracker(array, RandomWalk(1e-9, 1e-9)).measurements.of(row_of(array))
        unit = np.concatenate([UNIT, np.ones(14)])
        state = np.concatenate([SOURCE, np.zeros(14)])
        elsewhere = np.concatenate([SOURCE * 1.02, np.random.default_rng(2).normal(size=14)])
        for of_readings in (True, False):
            coordinates = measurement.coordinates(state, 0.1 * UNIT, of_readings=of_readings)
            np.testing.assert_allclose(coordinates.J[:, :6] * UNIT / UNIT[:, None], np.eye(6), atol=1e-9)
            expected = derivative(
                lambda y, c=coordinates: np.apply_along_axis(lambda x: c.at(x * unit)[0] / UNIT, -1, y),
                elsewhere / unit,
                1e-2,
                1e-9,
            )
            self.agree(coordinates.at(elsewhere)[1] * unit / UNIT[:, None], expected)


class TestErrors:
    def test_last_as_stated(self) -> None:
        """Covariance of a changing one after a step: exp(-Δt/τ); a constant one keeps it; its variance stays."""
        errors = PoseErrors.of(STATED)
        kept, added = errors.step(3.0)
        np.testing.assert_allclose(kept, np.repeat([math.exp(-0.3), 1.0], 7))
        np.testing.assert_allclose(kept**2 + added**2, 1.0)
        kept, added = PoseErrors.of(replace(STATED, correlation_s=0.0)).step(3.0)
        np.testing.assert_array_equal(kept, np.repeat([0.0, 1.0], 7))
        np.testing.assert_array_equal(added, np.repeat([1.0, 0.0], 7))

    def test_of_several_rows_have_their_covariance(self) -> None:
        errors, time_s = PoseErrors.of(STATED), np.array([0.0, 1.0, 7.0])
        array = geometries.tetrahedron(1.5)
        rows = errors.over_rows(array, time_s, [POSE] * 3, [None] * 3)
        assert rows is not None
        own = errors.effect(POSE)
        changing, constant = own[:, errors.is_changing], own[:, ~errors.is_changing]
        for i in range(3):
            for j in range(3):
                share = math.exp(-abs(time_s[i] - time_s[j]) / 10.0)
                expected = share * changing @ changing.T + constant @ constant.T
                np.testing.assert_allclose(rows.effects[i] @ rows.effects[j].T, expected, rtol=1e-9, atol=1e-18)

    def test_of_the_ambient_field_are_constant_or_new_in_every_row(self) -> None:
        errors = PoseErrors.of_array(replace(uncertain("scalar"), pose=None))
        np.testing.assert_array_equal(errors.step(3.0)[0], np.repeat([1.0, 0.0], 3))
        rows = errors.over_rows(uncertain("scalar"), np.arange(2.0), [POSE] * 2, [None] * 2)
        assert rows is not None
        first, second = rows.effects
        np.testing.assert_allclose((first @ first.T)[9:, 9:], (2e-7**2 + 1e-7**2) * np.eye(3), rtol=1e-9, atol=1e-30)
        np.testing.assert_allclose((first @ second.T)[9:, 9:], 2e-7**2 * np.eye(3), rtol=1e-9, atol=1e-30)
        assert not PoseErrors.of_array(replace(uncertain("vector"), pose=None)).n_states

    def test_a_row_states_its_own(self) -> None:
        effect = PoseErrors.of(STATED).effect(POSE, np.array([0.5, 0.1]))
        np.testing.assert_allclose(effect[:6, :6], np.diag(np.repeat([0.1, 0.5], 3)))

    def test_rates_of_a_steady_motion(self) -> None:
        time_s = np.array([0.0, 0.4, 1.0, 1.1])
        rate, velocity = np.array([0.3, -0.5, 0.9]), np.array([1.0, 2.0, -0.5])
        turns = (Rotation.from_matrix(R) * Rotation.from_rotvec(time_s[:, None] * rate)).as_matrix()
        found = rates_of(time_s, time_s[:, None] * velocity, turns)
        np.testing.assert_allclose(found[0], np.broadcast_to(velocity, (4, 3)))
        np.testing.assert_allclose(found[1], np.broadcast_to(rate, (4, 3)))
        assert not np.any(rates_of(time_s[:1], np.ones((1, 3)), turns[:1]))

    def test_counts_where_readings_have_a_pose(self) -> None:
        array = replace(geometries.tetrahedron(1.5), pose=STATED)
        still = Readings(np.zeros((2, 12)))
        posed = replace(still, array_position_m=np.zeros((2, 3)), array_rotation=Rotation.identity(2))
        assert with_stated_pose(array, still).pose is None
        assert with_stated_pose(array, posed).pose is STATED
        of_rows = replace(posed, pose_sigma=np.full((2, 2), 0.01))
        assert with_stated_pose(replace(array, pose=None), of_rows).pose == PoseUncertainty()


class TestBounds:
    def test_of_alike_sensors_is_that_of_the_array_and_what_the_pose_adds(self) -> None:
        """Their differences do not see the ambient field turn: P + J Σ Jᵀ of one row."""
        array = geometries.tetrahedron(1.5, "vector", 1e-9)
        place, moment = np.array([3.0, 1.0, 0.5]), np.array([50.0, -20.0, 90.0])
        exact = cramer_rao_bounds(array, place, moment).covariance
        found = cramer_rao_bounds(replace(array, pose=STATED), place, moment).covariance
        at_rest = ArrayPose(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), POSE.lever_arm_m)
        root = at_rest.world_jacobian(np.concatenate([place, moment])) @ PoseErrors.of(STATED).effect(at_rest)
        added = root @ root.T
        np.testing.assert_allclose(found / np.outer(UNIT, UNIT), (exact + added) / np.outer(UNIT, UNIT), rtol=1e-6)

    def test_columns_are_those_of_a_row(self) -> None:
        array = replace(geometries.tetrahedron(1.5, "scalar", 1e-9), ambient_T=tuple(AMBIENT_T.tolist()), pose=STATED)
        columns = pose_errors_at_rest(array, STATED, SOURCE[:3], SOURCE[3:])
        row = Row(0.0, np.zeros(4))
        measurement = Tracker(array, RandomWalk(1e-9, 1e-9)).measurements.of(row)
        expected = measurement.jacobian(np.concatenate([SOURCE, np.zeros(14)]))[:, 6:]
        np.testing.assert_allclose(measurement.model.differences.transform @ columns, expected, rtol=1e-9, atol=1e-24)
