r"""Errors of an array's pose: what they do to its readings, and how they last from row to row.

With the true attitude :math:`R e^{[θ]_×}`, the true place of the pose's reference point moved by δx in the world, and
the lever arm l from there to the array's origin wrong by δl, a source at p with the moment m stands in the array's axes
at

.. math:: p_a = e^{-[θ]_×} R^T (p - x - δx) - l - δl, \qquad m_a = e^{-[θ]_×} R^T m

and an ambient field that is known through the attitude turns as m does. An error δt of the clock moves and turns with
the array's own motion: :math:`δx = \dot x δt`, :math:`θ = ω δt`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.pose import PoseUncertainty
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.measurement.differences import channel_jacobian, turn_jacobian
from magloc.navigation.rotations import cross_matrix, rotation_matrix, turn_of_change
from magloc.readings import Readings

N_POSE = 9
"""Numbers of an error of a pose: θ [rad], δx [m], δl [m]."""
TURN, SHIFT, LEVER = slice(0, 3), slice(3, 6), slice(6, 9)
_N_CLOCK = 1
_NO_ERROR = np.zeros(N_POSE)


@dataclass(frozen=True, eq=False)
class ArrayPose:
    """Where an array is, how it is turned and how it moves, as its readings state it.

    Attributes
    ----------
    origin_m, R_world_from_array : ndarray, shapes (3,) and (3, 3)
    velocity_m_s, rate_rad_s : ndarray, shape (3,)
        Of the origin in the world, and of the array about its own axes.
    lever_arm_m : ndarray, shape (3,)
        From the pose's reference point to the origin, in the array's axes.
    """

    origin_m: FloatArray
    R_world_from_array: FloatArray
    velocity_m_s: FloatArray
    rate_rad_s: FloatArray
    lever_arm_m: FloatArray

    @cached_property
    def reference_m(self) -> FloatArray:
        """The pose's reference point in the world."""
        return self.origin_m - self.R_world_from_array @ self.lever_arm_m

    @cached_property
    def reference_velocity_m_s(self) -> FloatArray:
        """Velocity of the reference point in the world."""
        return self.velocity_m_s - self.R_world_from_array @ np.cross(self.rate_rad_s, self.lever_arm_m)

    def turned(self, error: FloatArray | None = None) -> FloatArray:
        """True attitude, array to world (..., 3, 3), where the pose has errors (..., 9)."""
        R = self.R_world_from_array
        return R if error is None else R @ rotation_matrix(error[..., TURN])

    def in_array(self, source: FloatArray, error: FloatArray | None = None) -> FloatArray:
        """Position and moment (..., 6) of sources (..., 6) of the world, in the true axes of the array."""
        if error is None:
            R = self.R_world_from_array
            return np.concatenate([(source[..., :3] - self.origin_m) @ R, source[..., 3:6] @ R], axis=-1)
        R = self.turned(error)
        offset = source[..., :3] - self.reference_m - error[..., SHIFT]
        position = (offset[..., None, :] @ R)[..., 0, :] - self.lever_arm_m - error[..., LEVER]
        return np.concatenate([position, (source[..., None, 3:6] @ R)[..., 0, :]], axis=-1)

    def error_jacobian(self, in_array: FloatArray, error: FloatArray) -> FloatArray:
        """Derivative (..., 6, 9) of :meth:`in_array`, which is given, by the errors."""
        right = turn_of_change(-error[..., TURN])
        D = np.zeros((*in_array.shape, N_POSE))
        D[..., :3, TURN] = cross_matrix(in_array[..., :3] + self.lever_arm_m + error[..., LEVER]) @ right
        D[..., :3, SHIFT] = -np.swapaxes(self.turned(error), -1, -2)
        D[..., :3, LEVER] = -np.eye(3)
        D[..., 3:, TURN] = cross_matrix(in_array[..., 3:]) @ right
        return D

    def world_jacobian(self, in_array: FloatArray) -> FloatArray:
        """Derivative (6, 9) by the error at zero of a source of the world that is known in the array's axes, (6,)."""
        R = self.R_world_from_array
        J = np.zeros((6, N_POSE))
        J[:3, TURN] = -R @ cross_matrix(in_array[:3] + self.lever_arm_m)
        J[:3, SHIFT] = np.eye(3)
        J[:3, LEVER] = R
        J[3:, TURN] = -R @ cross_matrix(in_array[3:])
        return J


@dataclass(frozen=True, eq=False)
class PosesOfRows:
    """The poses of several rows of one array, and what errors of unit variance do to each of them.

    Attributes
    ----------
    array : SensorArray
    poses : sequence of ArrayPose
    effects : list of ndarray, shape (9, n)
    """

    array: SensorArray
    poses: Sequence[ArrayPose]
    effects: Sequence[FloatArray]

    def channel_errors(self, source: FloatArray, ambient_T: FloatArray) -> list[FloatArray]:
        """What they add to the channels (C, n) of every row [T], of a source (6,) and ambient fields (rows, N, 3)."""
        rows = zip(self.poses, self.effects, ambient_T, strict=True)
        return [channel_errors(self.array, pose, source, effect, field) for pose, effect, field in rows]


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """The errors of an array's poses, as states of unit variance.

    Attributes
    ----------
    uncertainty : PoseUncertainty
    of_pose : ndarray of int, shape (n,)
        What each of the n states is of: a component of the error (0 to 8), or 9, the clock.
    changes : ndarray of bool, shape (n,)
        Whether it changes; else it is constant.
    """

    uncertainty: PoseUncertainty
    of_pose: IntArray
    changes: BoolArray

    @classmethod
    def of(cls, uncertainty: PoseUncertainty | None) -> PoseErrors:
        """All errors that are stated; what changes of place and attitude always is, a row may say how much."""
        if uncertainty is None:
            return cls(PoseUncertainty(), np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.bool_))
        turn, shift, lever, clock = list(range(3)), list(range(3, 6)), list(range(6, 9)), [N_POSE]
        changing = turn + shift + (clock if uncertainty.time_s else [])
        constant = [
            *(turn if uncertainty.attitude_constant_rad else []),
            *(lever if uncertainty.position_constant_m else []),
            *(clock if uncertainty.time_constant_s else []),
        ]
        of_pose = np.array(changing + constant, dtype=np.intp)
        return cls(uncertainty, of_pose, np.arange(of_pose.size) < len(changing))

    @property
    def n_states(self) -> int:
        """Number of errors."""
        return self.of_pose.size

    def step(self, dt_s: float | FloatArray) -> tuple[FloatArray, FloatArray]:
        """What remains of every error after steps (...), and the standard deviation of what is added: (..., n) each."""
        lasts_s = self.uncertainty.correlation_s
        share = np.exp(-np.asarray(dt_s) / lasts_s) if lasts_s else np.zeros(np.shape(dt_s))
        kept = np.where(self.changes, share[..., None], 1.0)
        return kept, np.sqrt(1.0 - kept**2)

    def effect(self, pose: ArrayPose, sigma: FloatArray | None = None) -> FloatArray:
        """The error (9, n) of a pose by every state; `sigma` (2,) of place and attitude stands for the array's own."""
        if not self.n_states:
            return np.zeros((N_POSE, 0))
        return self.effects(pose.rate_rad_s, pose.reference_velocity_m_s, sigma)

    def effects(self, rate_rad_s: FloatArray, velocity_m_s: FloatArray, sigma: FloatArray | None = None) -> FloatArray:
        """Those (..., 9, n) of arrays that turn and whose reference points move so, (..., 3) each."""
        known, rows = self.uncertainty, rate_rad_s.shape[:-1]
        stated = np.array([known.position_m, known.attitude_rad]) if sigma is None else sigma
        unit = np.zeros((*rows, N_POSE, N_POSE + _N_CLOCK))
        unit[..., :N_POSE] = np.eye(N_POSE)
        unit[..., TURN, N_POSE], unit[..., SHIFT, N_POSE] = rate_rad_s, velocity_m_s
        changing = np.zeros((*rows, N_POSE + _N_CLOCK))
        changing[..., TURN], changing[..., SHIFT] = stated[..., 1:], stated[..., :1]
        changing[..., N_POSE] = known.time_s
        constant = np.repeat(
            [known.attitude_constant_rad, 0.0, known.position_constant_m, known.time_constant_s], [3, 3, 3, 1]
        )
        size = np.where(self.changes, changing[..., self.of_pose], constant[self.of_pose])
        return unit[..., self.of_pose] * size[..., None, :]

    def of_rows(
        self, array: SensorArray, time_s: FloatArray, poses: Sequence[ArrayPose], sigmas: Sequence[FloatArray | None]
    ) -> PosesOfRows | None:
        """Errors of several rows together, as they last between these; None where there are none."""
        if not self.n_states:
            return None
        lasts_s = self.uncertainty.correlation_s
        apart_s = np.abs(time_s[:, None] - time_s)
        share = np.linalg.cholesky(np.exp(-apart_s / lasts_s) if lasts_s else np.eye(len(time_s)))
        effects = []
        for i, (pose, sigma) in enumerate(zip(poses, sigmas, strict=True)):
            own = self.effect(pose, sigma)
            effects.append(np.hstack([np.kron(share[i], own[:, self.changes]), own[:, ~self.changes]]))
        return PosesOfRows(array, poses, effects)


def pose_covariance(errors: PoseErrors, pose: ArrayPose, in_array: FloatArray, sigma: FloatArray | None) -> FloatArray:
    """What errors of the pose add to the covariance (6, 6) of a source of the world that the array knows, (6,)."""
    J = pose.world_jacobian(in_array) @ errors.effect(pose, sigma)
    return J @ J.T


def channel_errors(
    array: SensorArray, pose: ArrayPose, source: FloatArray, effect: FloatArray, ambient_T: FloatArray
) -> FloatArray:
    """Derivative (C, n) of the channels by errors of the pose, of some effect (9, n) on it, at zero [T].

    The source (6,) stands in the world, the ambient field (N, 3) in the array's axes.
    """
    in_array = pose.in_array(source)
    position, moment = in_array[:3], in_array[3:]
    H = channel_jacobian(array, position, moment, ambient_T) @ pose.error_jacobian(in_array, _NO_ERROR)
    H[:, TURN] += turn_jacobian(array, position, moment, ambient_T)
    return H @ effect


def pose_errors_at_rest(
    array: SensorArray, uncertainty: PoseUncertainty, position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """What errors of unit variance of the pose of an array at rest add to its channels (..., C, n) [T].

    Of sources (..., 3) in the axes of the stated pose.
    """
    lever_arm_m = np.array(uncertainty.lever_arm_m)
    pose = ArrayPose(np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3), lever_arm_m)
    D = np.zeros((*position_m.shape[:-1], 6, N_POSE))
    D[..., :3, TURN] = cross_matrix(position_m + lever_arm_m)
    D[..., :3, SHIFT] = D[..., :3, LEVER] = -np.eye(3)
    D[..., 3:, TURN] = cross_matrix(moment_Am2)
    columns = channel_jacobian(array, position_m, moment_Am2) @ D
    columns[..., TURN] += turn_jacobian(array, position_m, moment_Am2, array.ambient_fields)
    return columns @ PoseErrors.of(uncertainty).effect(pose)


def with_stated_pose(array: SensorArray, readings: Readings) -> SensorArray:
    """The array with the uncertainty of the pose that counts for some readings: none where they have no pose."""
    if readings.pose is None:
        return array if array.pose is None else replace(array, pose=None)
    if readings.pose_sigma is None or array.pose is not None:
        return array
    return replace(array, pose=PoseUncertainty())


def rates_of(time_s: FloatArray, position_m: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Velocities (n, 3) in the world and rates (n, 3) in the array's axes, from the rows about each; zero of one."""
    n = len(time_s)
    before, after = np.maximum(np.arange(n) - 1, 0), np.minimum(np.arange(n) + 1, n - 1)
    dt = (time_s[after] - time_s[before])[:, None]
    moving = dt > 0.0
    velocity = np.divide(position_m[after] - position_m[before], dt, out=np.zeros_like(position_m), where=moving)
    turns = np.swapaxes(R[before], 1, 2) @ R[after]
    # The turn between two rows as a vector, from the skew part of its matrix and its trace.
    skew = 0.5 * np.stack(
        [turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0], turns[:, 1, 0] - turns[:, 0, 1]], axis=1
    )
    sine = np.linalg.norm(skew, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(turns, axis1=1, axis2=2) - 1.0))
    scale = np.divide(angle, sine, out=np.ones(n), where=sine > 0.0)[:, None]
    return velocity, np.divide(scale * skew, dt, out=np.zeros_like(skew), where=moving)
