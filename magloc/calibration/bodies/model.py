r"""Model of the readings of an array of vector sensors near a rigid body of several magnets.

In row t sensor i reads, with the names of :mod:`magloc.calibration.model`,

.. math:: y_{ti} = (I + E_i) K_i \Big( \sum_k B_k(s_i + d_i;\, x_t, R_t) + c_t \Big) + o_i + h_i,

where magnet k stands at :math:`x_t + R_t (p_k + δp_k)` and its moment, with all of the magnet, is rotated by two small
angles across the nominal moment and changed by a fraction. The unit of the unknowns of sensors and magnets is their
prior standard deviation. A step of the pose is :math:`x + δx` and :math:`R \exp([δθ]_×)`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.typing import BoolArray, FloatArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import body_fields, magnet_fields, pose_jacobian
from magloc.calibration.sensors import (
    POSITION,
    Linearisation,
    SensorProblem,
    readings_of_fields,
    sensor_derivatives,
    whitened_responses,
)
from magloc.navigation.rotations import rotation_matrix, turn_of_change, unit_across

PER_MAGNET = 6
PLACE, STRENGTH, DIRECTION = slice(0, 3), slice(3, 4), slice(4, 6)
"""Unknowns of a magnet: displacement [m] in the body's frame, relative change of its strength, rotation [rad] about the
two axes of :func:`across`."""
_EXACT_M, _EXACT_RAD = 1e-7, 1e-6  # least standard deviations of a measured pose
_LONGEST_TURN_RAD = 0.5


@dataclass(frozen=True, eq=False)
class BodyState:
    """Values of all unknowns.

    Attributes
    ----------
    sensors : ndarray, shape (N, 15)
        As in :class:`magloc.calibration.model.CalibrationState`.
    magnets : ndarray, shape (K, 6)
        Deviations from the nominal body; see :data:`PLACE`.
    position_m, R : ndarray, shapes (T, 3), (T, 3, 3)
        Pose of the body in the array's frame.
    common_T : ndarray, shape (T, 3)
        Field common to all sensors, in the array's frame.
    """

    sensors: FloatArray
    magnets: FloatArray
    position_m: FloatArray
    R: FloatArray
    common_T: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyProblem(SensorProblem[BodyState]):
    """Readings near a body in motion, and the priors of all unknowns.

    Attributes
    ----------
    body : MagnetBody
        Nominal body.
    magnet_prior : ndarray, shape (K, 6)
        Standard deviations of the magnets' unknowns around the nominal body.
    pose_m, pose_R : ndarray, shapes (T, 3), (T, 3, 3)
        Measured poses in the array's frame; any value where unknown.
    pose_sigma : ndarray, shape (T, 2)
        Standard deviations of the measured poses, per axis [m] and [rad]; infinite where unknown.
    magnets_free : bool
        True if the magnets are estimated.
    """

    body: MagnetBody
    magnet_prior: FloatArray
    pose_m: FloatArray
    pose_R: FloatArray
    pose_sigma: FloatArray
    magnets_free: bool = True

    @property
    def has_pose(self) -> BoolArray:
        """Rows (T,) whose pose is measured."""
        return np.asarray(np.isfinite(self.pose_sigma).all(axis=1))

    @property
    def n_globals(self) -> int:
        """Number of estimated unknowns of the magnets."""
        return self.magnet_prior.size * self.magnets_free

    @property
    def n_numbers(self) -> int:
        """Number of readings and priors of the rows, minus the unknowns of the rows."""
        priors = 3 * int(np.isfinite(self.pose_sigma).sum())
        free = 6 + 3 * (self.array.common_field_T is None)
        return int(np.isfinite(self.readings_T).sum()) + priors - free * len(self.readings_T)

    @property
    def field_doubt(self) -> float:
        """Relative error of the field that the prior allows, including errors of the magnets."""
        displaced = 3.0 * self.magnet_prior[:, PLACE].max() / self.array.circumradius
        return float(np.hypot(super().field_doubt, np.hypot(displaced, self.magnet_prior[:, STRENGTH].max())))

    @cached_property
    def _row_weight(self) -> FloatArray:
        sigma_m, sigma_rad = self.pose_sigma.T
        weight = np.zeros((len(self.pose_m), 9))
        weight[:, :3] = 1.0 / np.maximum(sigma_m, _EXACT_M)[:, None]
        weight[:, 3:6] = 1.0 / np.maximum(sigma_rad, _EXACT_RAD)[:, None]
        weight[:, 6:] = self.common_weight
        return weight

    def row_priors(self, state: BodyState) -> tuple[FloatArray, FloatArray]:
        """Return 1/σ (T, 9) of pose and common field, 0 without a prior, and their deviations (T, 9) from it."""
        turned = Rotation.from_matrix(np.swapaxes(self.pose_R, -1, -2) @ state.R).as_rotvec()
        deviation = np.concatenate([state.position_m - self.pose_m, turned, state.common_T], axis=1)
        return self._row_weight, np.where(self._row_weight > 0.0, deviation, 0.0)

    def shared_deviations(self, state: BodyState) -> FloatArray:
        """Return the unknowns of sensors and magnets (P,), in standard deviations of their priors."""
        of_magnets = (state.magnets / self.magnet_prior).ravel()[: self.n_globals]
        return np.concatenate([super().shared_deviations(state), of_magnets])

    def prediction_T(self, state: BodyState) -> FloatArray:
        """Return the predicted readings, shape (T, C) [T]."""
        points = self.array.positions + state.sensors[:, POSITION]
        fields = body_fields(changed_body(self.body, state.magnets), points, state.position_m, state.R)
        return readings_of_fields(self.array, state.sensors, fields + state.common_T[:, None])

    def linearise(self, state: BodyState) -> Linearisation:
        """Return the residuals of a state and their derivatives by every unknown."""
        array, body = self.array, changed_body(self.body, state.magnets)
        shape = (len(state.position_m), array.n_channels)
        magnets = magnet_fields(body, array.positions + state.sensors[:, POSITION], state.position_m, state.R)
        fields = magnets.field_T.sum(axis=1) + state.common_T[:, None]
        response = whitened_responses(self, state.sensors)
        R = state.R[:, None, None]
        axes = across(self.body)
        # Derivative of the rotation by the two angles, in the body's frame.
        turns = turn_of_change(np.einsum("kda,kd->ka", axes, state.magnets[:, DIRECTION])) @ np.swapaxes(axes, -1, -2)
        by_magnet = np.concatenate(
            [
                magnets.by_position @ R,
                (magnets.field_T / (1.0 + state.magnets[:, STRENGTH, None]))[..., None],
                magnets.by_rotation @ R @ turns[:, None],
            ],
            axis=-1,
        )
        by_magnet = response[:, None] @ (by_magnet * self.magnet_prior[:, None, None, :])
        by_row = [response @ pose_jacobian(body, magnets, state.R), response]
        return Linearisation(
            residual=self.residuals(readings_of_fields(array, state.sensors, fields)),
            by_sensor=sensor_derivatives(self, state.sensors, fields, -magnets.by_position.sum(axis=1)),
            by_source=by_magnet.transpose(0, 2, 3, 1, 4).reshape(*shape, -1)[..., : self.n_globals],
            by_row=np.concatenate(by_row, axis=-1).reshape(*shape, 9),
        )

    def after_step(self, state: BodyState, step: FloatArray, of_rows: FloatArray) -> BodyState:
        """Return a state after a step (P,) of sensors and magnets, and (T, 9) of the rows."""
        sensors, of_magnets = self.sensors_after_step(state, step)
        magnets = state.magnets
        if self.magnets_free:
            magnets = magnets + self.magnet_prior * of_magnets.reshape(magnets.shape)
        # A body that jumps far away would not return, because its field and all derivatives vanish.
        shift = _shortened(of_rows[:, :3], self.array.circumradius)
        turn = _shortened(of_rows[:, 3:6], _LONGEST_TURN_RAD)
        return BodyState(
            sensors,
            magnets,
            state.position_m + shift,
            state.R @ rotation_matrix(turn),
            state.common_T + of_rows[:, 6:],
        )


def across(body: MagnetBody) -> FloatArray:
    """Return two unit vectors (K, 2, 3) across the moment of every magnet, in the body's frame."""
    along = body.moments_Am2 / np.linalg.norm(body.moments_Am2, axis=1, keepdims=True)
    first = unit_across(along)
    return np.stack([first, np.cross(along, first)], axis=1)


def changed_body(body: MagnetBody, magnets: FloatArray) -> MagnetBody:
    """Return the body with magnets changed by (K, 6); shapes turn with their moments."""
    turns = rotation_matrix(np.einsum("kda,kd->ka", across(body), magnets[:, DIRECTION]))
    changed = []
    for magnet, turn, change in zip(body.magnets, turns, magnets, strict=True):
        rotated = magnet.rotate(turn)
        position = tuple((np.asarray(magnet.position_m) + change[PLACE]).tolist())
        moment = tuple(((1.0 + change[STRENGTH]) * np.array(rotated.moment_Am2)).tolist())
        changed.append(replace(rotated, position_m=position, moment_Am2=moment))
    return replace(body, magnets=tuple(changed))


def _shortened(steps: FloatArray, longest: float) -> FloatArray:
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    return steps * (longest / np.maximum(length, longest))
