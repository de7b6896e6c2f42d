r"""Errors of pose and ambient field: their effect on readings and their correlation in time.

The true attitude is :math:`R e^{[θ]_×}`, and the true reference point of the pose is displaced by δx in the world. The
lever arm l from there to the array's origin has the error δl. A source at p with the moment m then has the position and
moment

.. math:: p_a = e^{-[θ]_×} R^T (p - x - δx) - l - δl, \qquad m_a = e^{-[θ]_×} R^T m

in the array's axes. An ambient field that is known in the world rotates as m does. A clock error δt acts through the
array's own motion: :math:`δx = \dot x δt`, :math:`θ = ω δt`.

An error d of the ambient field b in the world changes the modulus of b by its part along b, and the direction of b by
its part across,

.. math:: b' = (|b| + u \cdot d) \, w/|w|, \qquad w = u + (1 - u u^T) d/|b|, \qquad u = b/|b|,

because moduli determine the first part much better than the second. If d were added to b, moduli would change by the
square of the second part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.differences import channel_jacobian, fields_at_sensors
from magloc.navigation.rotations import cross_matrix, rotation_matrix, turn_of_change
from magloc.readings import Readings

N_POSE = 12
"""Number of components of a pose error: θ [rad], δx [m], δl [m], and the error d of the ambient field [T]."""
TURN, SHIFT, LEVER, FIELD = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
_N_CLOCK = 1
_NO_ERROR = np.zeros(N_POSE)


@dataclass(frozen=True, eq=False)
class ArrayPose:
    """Position, attitude and motion of an array, as stated by its readings.

    Attributes
    ----------
    origin_m, R_world_from_array : ndarray, shapes (3,) and (3, 3)
    velocity_m_s, rate_rad_s : ndarray, shape (3,)
        Velocity of the origin in the world, and rate of rotation about the array's own axes.
    lever_arm_m : ndarray, shape (3,)
        Vector from the pose's reference point to the origin, in the array's axes.
    """

    origin_m: FloatArray
    R_world_from_array: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    lever_arm_m: FloatArray

    @cached_property
    def reference_m(self) -> FloatArray:
        """Position of the pose's reference point in the world."""
        return self.origin_m - self.R_world_from_array @ self.lever_arm_m

    @cached_property
    def reference_velocity_m_s(self) -> FloatArray:
        """Velocity of the reference point in the world."""
        return self.velocity_m_s - self.R_world_from_array @ np.cross(self.rate_rad_s, self.lever_arm_m)

    def true_attitude(self, error: FloatArray | None = None) -> FloatArray:
        """Return the true attitude, array to world (..., 3, 3), for pose errors (..., 12)."""
        R = self.R_world_from_array
        return R if error is None else R @ rotation_matrix(error[..., TURN])

    def to_array(self, source: FloatArray, error: FloatArray | None = None) -> FloatArray:
        """Transform sources (..., 6) from the world to the true axes of the array."""
        if error is None:
            R = self.R_world_from_array
            return np.concatenate([(source[..., :3] - self.origin_m) @ R, source[..., 3:6] @ R], axis=-1)
        R = self.true_attitude(error)
        offset = source[..., :3] - self.reference_m - error[..., SHIFT]
        position = (offset[..., None, :] @ R)[..., 0, :] - self.lever_arm_m - error[..., LEVER]
        return np.concatenate([position, (source[..., None, 3:6] @ R)[..., 0, :]], axis=-1)

    def error_jacobian(self, in_array: FloatArray, error: FloatArray) -> FloatArray:
        """Return the derivative (..., 6, 12) of :meth:`to_array` by the errors.

        `in_array` (..., 6) is its result.
        """
        right = turn_of_change(-error[..., TURN])
        D = np.zeros((*in_array.shape, N_POSE))
        D[..., :3, TURN] = cross_matrix(in_array[..., :3] + self.lever_arm_m + error[..., LEVER]) @ right
        D[..., :3, SHIFT] = -np.swapaxes(self.true_attitude(error), -1, -2)
        D[..., :3, LEVER] = -np.eye(3)
        D[..., 3:, TURN] = cross_matrix(in_array[..., 3:]) @ right
        return D

    def world_jacobian(self, in_array: FloatArray) -> FloatArray:
        """Return the derivative (6, 12) of a source in the world by the errors, at zero.

        The source (6,) is known in the array's axes.
        """
        R = self.R_world_from_array
        J = np.zeros((6, N_POSE))
        J[:3, TURN] = -R @ cross_matrix(in_array[:3] + self.lever_arm_m)
        J[:3, SHIFT] = np.eye(3)
        J[:3, LEVER] = R
        J[3:, TURN] = -R @ cross_matrix(in_array[3:])
        return J

    def ambient(self, fields_T: FloatArray, error: FloatArray) -> FloatArray:
        """Return the ambient fields (..., N, 3) in the true axes, from stated ones (N, 3)."""
        mean_T = fields_T.mean(axis=0)
        true_T, _ = _field_with_error(mean_T, error[..., FIELD] @ self.R_world_from_array)
        return np.asarray((fields_T + (true_T - mean_T)[..., None, :]) @ rotation_matrix(error[..., TURN]))

    def ambient_jacobian(
        self, array: SensorArray, in_array: FloatArray, error: FloatArray, fields_T: FloatArray
    ) -> FloatArray:
        """Return the derivative (..., C, 12) of channels by the errors, through the ambient field.

        Ambient fields (N, 3) are the stated ones [T].

        The sources (..., 6) stay in the true axes of the array.
        """
        ambient_T = self.ambient(fields_T, error)
        rows = array.linear_gain(fields_at_sensors(array, in_array[..., :3], in_array[..., 3:], ambient_T))
        turned = np.einsum("...ci,...cij->...cj", rows, cross_matrix(ambient_T)[..., array.channel_sensor, :, :])
        R = self.R_world_from_array
        _, moved = _field_with_error(fields_T.mean(axis=0), error[..., FIELD] @ R)
        J = np.zeros((*turned.shape[:-1], N_POSE))
        J[..., TURN] = turned @ turn_of_change(-error[..., TURN])
        J[..., FIELD] = rows @ np.swapaxes(rotation_matrix(error[..., TURN]), -1, -2) @ moved @ R.T
        return J


def _field_with_error(field_T: FloatArray, error_T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a field (3,) with errors (..., 3) of modulus and direction, and its derivative (..., 3, 3) by them."""
    modulus_T, one = float(np.linalg.norm(field_T)), np.eye(3)
    if modulus_T == 0.0:
        return error_T, np.broadcast_to(one, (*error_T.shape, 3))
    unit = field_T / modulus_T
    longer_T = modulus_T + error_T @ unit
    w = unit + error_T @ (one - np.outer(unit, unit)) / modulus_T
    length = np.linalg.norm(w, axis=-1)
    direction = w / length[..., None]
    across = (one - direction[..., :, None] * direction[..., None, :]) @ (one - np.outer(unit, unit))
    share = longer_T / (length * modulus_T)
    return longer_T[..., None] * direction, direction[..., :, None] * unit + share[..., None, None] * across


@dataclass(frozen=True, eq=False)
class PosesOfRows:
    """Poses of several rows of one array, and the effects of pose errors of unit variance.

    Attributes
    ----------
    array : SensorArray
    poses : sequence of ArrayPose
    effects : list of ndarray, shape (12, n)
    """

    array: SensorArray
    poses: Sequence[ArrayPose]
    effects: Sequence[FloatArray]

    def channel_errors(self, source: FloatArray, ambient_T: FloatArray) -> list[FloatArray]:
        """Return the channel errors (C, n) [T] of every row for a source (6,) and ambient fields (rows, N, 3)."""
        rows = zip(self.poses, self.effects, ambient_T, strict=True)
        return [channel_errors(self.array, pose, source, effect, field) for pose, effect, field in rows]


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of an array's poses and of the ambient field, as states of unit variance.

    Attributes
    ----------
    uncertainty : PoseUncertainty
    of_pose : ndarray of int, shape (n,)
        Component of the pose error (0 to 11) of each state, or 12 for the clock.
    lasts_s : ndarray, shape (n,)
        Correlation time of each state: 0 if it is independent from row to row, infinite for a constant.
    ambient_T : tuple of 2 floats
        Standard deviations of the ambient field's constant error, and of its error that is independent from row to row.
    between_s : float
        Correlation time of the errors of places that were interpolated between fixes; 0 without interpolation.
    """

    uncertainty: PoseUncertainty
    of_pose: IntArray
    lasts_s: FloatArray
    ambient_T: tuple[float, float] = (0.0, 0.0)
    between_s: float = 0.0

    @classmethod
    def of(
        cls, uncertainty: PoseUncertainty | None, ambient_T: tuple[float, float] = (0.0, 0.0), between_s: float = 0.0
    ) -> PoseErrors:
        """Return all stated errors.

        Changing errors of position and attitude are always states, because a row may state their size.
        """
        turn, shift, lever, field = (list(range(N_POSE)[part]) for part in (TURN, SHIFT, LEVER, FIELD))
        clock, known = [N_POSE], uncertainty or PoseUncertainty()
        parts: list[tuple[list[int], float, float]] = []
        if uncertainty is not None:
            parts = [
                (turn + shift, known.correlation_s, 1.0),
                (clock, known.correlation_s, known.time_s),
                (turn, np.inf, known.attitude_constant_rad),
                (lever, np.inf, known.position_constant_m),
                (clock, np.inf, known.time_constant_s),
                (shift, 0.0, known.position_white_m),
            ]
        parts += [(field, np.inf, ambient_T[0]), (field, 0.0, ambient_T[1]), (shift, between_s, between_s)]
        stated = [(component, lasts_s) for of, lasts_s, size in parts if size for component in of]
        of_pose, lasts = np.array(stated, dtype=np.float64).reshape(-1, 2).T
        return cls(known, of_pose.astype(np.intp), lasts, ambient_T, between_s)

    @classmethod
    def of_array(cls, array: SensorArray) -> PoseErrors:
        """Return all errors that an array states.

        An error of the ambient field has no effect on differences of vector sensors.
        """
        moduli = bool(array.channel_is_scalar.any())
        known = (array.ambient_uncertainty_T, array.ambient_uncertainty_white_T) if moduli else (0.0, 0.0)
        return cls.of(array.pose, known)

    @property
    def n_states(self) -> int:
        """Number of error states."""
        return self.of_pose.size

    @property
    def is_changing(self) -> BoolArray:
        """Errors that change with time (n,)."""
        return np.isfinite(self.lasts_s)

    @property
    def is_of_mounting(self) -> BoolArray:
        """Errors that are constants of the mounting or of the lever arm (n,)."""
        return np.asarray(~self.is_changing & (self.of_pose < FIELD.start))

    @property
    def is_of_field(self) -> BoolArray:
        """Errors that are constants of the ambient field (n,)."""
        return np.asarray(~self.is_changing & (self.of_pose >= FIELD.start) & (self.of_pose < N_POSE))

    def step(self, dt_s: float | FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return decay factors and added standard deviations, (..., n) each, over steps (...)."""
        lasts = self.lasts_s > 0.0
        kept = np.where(lasts, np.exp(-np.asarray(dt_s)[..., None] / np.where(lasts, self.lasts_s, 1.0)), 0.0)
        return kept, np.sqrt(1.0 - kept**2)

    def effect(self, pose: ArrayPose, sigma: FloatArray | None = None) -> FloatArray:
        """Return the pose error (12, n) by every state.

        `sigma` (2,) of position and attitude replaces the array's standard deviations.
        """
        if not self.n_states:
            return np.zeros((N_POSE, 0))
        return self.effects(pose.rate_rad_s, pose.reference_velocity_m_s, sigma)

    def effects(
        self,
        rate_rad_s: FloatArray,
        velocity_m_s: FloatArray,
        sigma: FloatArray | None = None,
        between_m: FloatArray | None = None,
    ) -> FloatArray:
        """Return the pose errors (..., 12, n) by every state, for rates and velocities (..., 3).

        Interpolated places have additional errors of `between_m` (...,).
        """
        known, rows = self.uncertainty, rate_rad_s.shape[:-1]
        stated = np.array([known.position_m, known.attitude_rad]) if sigma is None else sigma
        unit = np.zeros((*rows, N_POSE, N_POSE + _N_CLOCK))
        unit[..., :N_POSE] = np.eye(N_POSE)
        unit[..., TURN, N_POSE], unit[..., SHIFT, N_POSE] = rate_rad_s, velocity_m_s
        changing = np.zeros((*rows, N_POSE + _N_CLOCK))
        changing[..., TURN], changing[..., SHIFT] = stated[..., 1:], stated[..., :1]
        changing[..., FIELD], changing[..., N_POSE] = self.ambient_T[1], known.time_s
        constant_T, arm_m = self.ambient_T[0], known.position_constant_m
        constant = np.repeat(
            [known.attitude_constant_rad, 0.0, arm_m, constant_T, known.time_constant_s], [3, 3, 3, 3, 1]
        )
        size = np.where(self.is_changing, changing[..., self.of_pose], constant[self.of_pose])
        shifts = np.flatnonzero((self.of_pose >= SHIFT.start) & (self.of_pose < SHIFT.stop))
        if known.position_white_m:
            size[..., shifts[3:6]] = known.position_white_m
        if between_m is not None:
            size[..., shifts[-3:]] = between_m[..., None]
        return unit[..., self.of_pose] * size[..., None, :]

    def over_rows(
        self, array: SensorArray, time_s: FloatArray, poses: Sequence[ArrayPose], sigmas: Sequence[FloatArray | None]
    ) -> PosesOfRows | None:
        """Return the errors of several rows, with their correlation in time; None if there are none."""
        if not self.n_states:
            return None
        apart_s = np.abs(time_s[:, None] - time_s)
        of_all = [self.effect(pose, sigma) for pose, sigma in zip(poses, sigmas, strict=True)]
        parts: list[list[FloatArray]] = [[own[:, ~self.is_changing]] for own in of_all]
        for lasts_s in np.unique(self.lasts_s[self.is_changing]).tolist():
            share = np.linalg.cholesky(np.exp(-apart_s / lasts_s) if lasts_s else np.eye(len(time_s)))
            for i, own in enumerate(of_all):
                parts[i].append(np.kron(share[i], own[:, self.lasts_s == lasts_s]))
        return PosesOfRows(array, poses, [np.hstack(part) for part in parts])


def channel_errors(
    array: SensorArray, pose: ArrayPose, source: FloatArray, effect: FloatArray, ambient_T: FloatArray
) -> FloatArray:
    """Return the errors (C, n) [T] of the channels for pose errors (12, n), at zero.

    The source (6,) is in the world frame, the ambient field (N, 3) in the array's axes.
    """
    in_array = pose.to_array(source)
    position, moment = in_array[:3], in_array[3:]
    H = channel_jacobian(array, position, moment, ambient_T) @ pose.error_jacobian(in_array, _NO_ERROR)
    return np.asarray((H + pose.ambient_jacobian(array, in_array, _NO_ERROR, ambient_T)) @ effect)


def pose_errors_at_rest(
    array: SensorArray, uncertainty: PoseUncertainty, position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Return the errors (..., C, n) [T] of the channels by pose errors of an array at rest.

    Errors have unit variance; sources (..., 3) are in the axes of the stated pose.
    """
    pose = ArrayPose(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), np.array(uncertainty.lever_arm_m))
    in_array = np.concatenate([position_m, moment_Am2], axis=-1)
    columns = channel_jacobian(array, position_m, moment_Am2) @ pose.error_jacobian(in_array, _NO_ERROR)
    columns += pose.ambient_jacobian(array, in_array, _NO_ERROR, array.ambient_fields)
    return np.asarray(columns @ PoseErrors.of(uncertainty).effect(pose))


def with_stated_pose(array: SensorArray, readings: Readings) -> SensorArray:
    """Return the array with the pose uncertainty for some readings: none if the readings have no pose."""
    if readings.pose is None:
        return array if array.pose is None else replace(array, pose=None)
    if readings.pose_sigma is None or array.pose is not None:
        return array
    return replace(array, pose=PoseUncertainty())


def rates_of(time_s: FloatArray, position_m: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return velocities in the world and rates in the array's axes, (n, 3) each.

    Both are differences of the neighbouring rows; zero for a single row.
    """
    n = len(time_s)
    before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    dt = (time_s[after] - time_s[before])[:, None]
    moving = dt > 0.0
    velocity = np.divide(position_m[after] - position_m[before], dt, out=np.zeros_like(position_m), where=moving)
    turns = np.swapaxes(R[before], 1, 2) @ R[after]
    # Rotation vector between two rows, from the skew part and the trace of the rotation matrix.
    skew = 0.5 * np.stack(
        [turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0], turns[:, 1, 0] - turns[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(skew, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1.0))
    scale = np.divide(angle, sine, out=np.ones(n), where=sine > 0.0)[:, None]
    return velocity, np.divide(scale * skew, dt, out=np.zeros_like(skew), where=moving)


def with_attitude_as_field_error(
    array: SensorArray, pose: PoseUncertainty, rows: Readings, ambient_T: FloatArray | None
) -> SensorArray:
    """Return the array with attitude errors as errors of the ambient field.

    Errors are rms over the rows; they affect only moduli.
    """
    attitude_rad = pose.attitude_rad if rows.pose_sigma is None else np.sqrt(np.mean(rows.pose_sigma[:, 1] ** 2))
    field_T = array.ambient_fields if ambient_T is None else ambient_T
    size_T = float(np.sqrt(np.mean(np.sum(field_T**2, axis=-1))))
    turned_T = float(np.hypot(attitude_rad, pose.attitude_constant_rad)) * size_T
    return replace(array, ambient_uncertainty_T=float(np.hypot(array.ambient_uncertainty_T, turned_T)))
