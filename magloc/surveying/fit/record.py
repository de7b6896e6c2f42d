r"""Rows of a survey as measurements of static sources in the world frame.

A scalar sensor measures the anomaly of the modulus, without cancelling,

.. math:: |b + B| - |b| = \frac{2 b·B + B^2}{|b + B| + |b|}

Readings of vector sensors and their predictions are both rotated, row by row, so that their mean field lies along the
ambient field b: an attitude error of 0.5° would change 50,000 nT by 440 nT. The mean field across b is then zero in
both, and is projected out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.fields.multipole import finite_body_errors, finite_body_fields
from magloc.fields.points import field_at_points, gradient_at_points
from magloc.measurement.platform_field import matrix_effects
from magloc.measurement.pose import LEVER, N_POSE, SHIFT, TURN, PoseErrors, rates_of
from magloc.navigation.rotations import cross_matrix
from magloc.readings import Readings
from magloc.terrain.surface import FLAT, Terrain

_SMALL_TURN = 1e-12
_SECOND_ORDER = 2.4e-6  # field times distance⁵ over moment and squared shift, on the axis


@dataclass(frozen=True, eq=False)
class SurveyRecord:
    """Rows of moving sensors in the world frame.

    Attributes
    ----------
    array : SensorArray
    time_s : ndarray, shape (n,)
    sensors_m : ndarray, shape (n, N, 3)
        Places of the sensors.
    R_world_from_array : ndarray, shape (n, 3, 3)
        Attitude as stated.
    ambient_T : ndarray, shape (n, 3)
    values_T : ndarray, shape (n, C)
        Anomalies: calibrated readings minus those of the ambient field alone.
    pose_effects : ndarray, shape (n, 9, q)
        Effects of pose errors of unit variance on turn, shift and lever arm.
    interpolated_m : ndarray, shape (n,), optional
        Standard deviation of the shift for places that are interpolated between fixes.
    beside_T, gradient_beside_T_m : ndarray, shapes (n, N, 3) and (n, N, 3, 3), or 0
        Field of known sources and its gradient; fitted sources add to them.
    terrain : Terrain
        Ground that heights are measured from.
    """

    array: SensorArray
    time_s: FloatArray
    sensors_m: FloatArray
    R_world_from_array: FloatArray
    ambient_T: FloatArray
    values_T: FloatArray
    pose_effects: FloatArray
    interpolated_m: FloatArray | None = None
    beside_T: FloatArray | float = 0.0
    gradient_beside_T_m: FloatArray | float = 0.0
    terrain: Terrain = FLAT

    @classmethod
    def of(
        cls,
        array: SensorArray,
        readings: Readings,
        ambient_T: FloatArray,
        errors: PoseErrors,
        terrain: Terrain = FLAT,
    ) -> SurveyRecord:
        """Return the record of readings with a pose; ambient field (n, 3) in the array's frame."""
        assert readings.array_position_m is not None
        assert readings.array_rotation is not None
        R = readings.array_rotation.as_matrix()
        b = np.einsum("nij,nj->ni", R, ambient_T)
        scalar = array.channel_is_scalar
        values = np.empty_like(readings.values_T)
        moduli = (readings.values_T - array.channel_offset_T)[:, scalar] / array.channel_gain[scalar, 0]
        values[:, scalar] = moduli - np.linalg.norm(b, axis=1)[:, None]
        if not scalar.all():
            fields = array.calibrated_field(readings.values_T)[:, array.channel_sensor[~scalar][::3]]
            fields = np.einsum("nij,nsj->nsi", R, fields)
            turn = shortest_turns(fields.mean(axis=1), b)
            values[:, ~scalar] = (np.einsum("nij,nsj->nsi", turn, fields) - b[:, None]).reshape(len(R), -1)
        places = readings.array_position_m[:, None] + np.einsum("nij,sj->nsi", R, array.positions)
        velocity, rate = rates_of(readings.time_s, readings.array_position_m, R)
        arm = np.array(errors.uncertainty.lever_arm_m)
        velocity = velocity - np.einsum("nij,nj->ni", R, np.cross(rate, arm))
        effects = errors.effects(rate, velocity, readings.pose_sigma, readings.interpolated_m)
        return cls(array, readings.time_s, places, R, b, values, effects, readings.interpolated_m, terrain=terrain)

    def __len__(self) -> int:
        return len(self.time_s)

    def with_pose(self, errors: PoseErrors) -> SurveyRecord:
        """Return the record with other stated pose errors, without one of the clock."""
        still = np.zeros((len(self), 3))
        effects = errors.effects(still, still, None, self.interpolated_m)
        return replace(self, array=replace(self.array, pose=errors.uncertainty), pose_effects=effects)

    @cached_property
    def is_vector(self) -> BoolArray:
        """Channels of vector sensors, in groups of three."""
        return ~self.array.channel_is_scalar

    def beside(self, position_m: FloatArray, moment_Am2: FloatArray) -> SurveyRecord:
        """Return the record with more known sources (K, 3)."""
        field = self.fields(position_m, moment_Am2)
        return replace(self, beside_T=field, gradient_beside_T_m=self.gradients(position_m, moment_Am2))

    def fields(self, position_m: FloatArray, moment_Am2: FloatArray) -> FloatArray:
        """Return the field (n, N, 3) of sources (K, 3) and of known ones at the sensors."""
        own = field_at_points(self.sensors_m.reshape(-1, 3), position_m, moment_Am2).reshape(self.sensors_m.shape)
        return np.asarray(own + self.beside_T)

    def gradients(self, position_m: FloatArray, moment_Am2: FloatArray) -> FloatArray:
        """Return the gradients (n, N, 3, 3) of the same field."""
        own = gradient_at_points(self.sensors_m.reshape(-1, 3), position_m, moment_Am2)
        return np.asarray(own.reshape(*self.sensors_m.shape, 3) + self.gradient_beside_T_m)

    def predict(self, fields_T: FloatArray) -> FloatArray:
        """Return the anomalies (n, C) of fields (n, N, 3) that add to the ambient one."""
        b = self.ambient_T[:, None]
        out = np.empty_like(self.values_T)
        scalar = ~self.is_vector
        seen = fields_T[:, self.array.channel_sensor[scalar]]
        lengths = np.linalg.norm(b + seen, axis=-1) + np.linalg.norm(b, axis=-1)
        out[:, scalar] = np.sum((2.0 * b + seen) * seen, axis=-1) / lengths
        if self.is_vector.any():
            seen = fields_T[:, self.array.channel_sensor[self.is_vector][::3]]
            turn = shortest_turns(self.ambient_T + seen.mean(axis=1), self.ambient_T)
            turned = np.einsum("nij,nsj->nsi", turn, b + seen) - b
            out[:, self.is_vector] = turned.reshape(len(self), -1)
        return out

    @cached_property
    def middles_m(self) -> FloatArray:
        """Mean places of the sensors (n, 3)."""
        return np.asarray(self.sensors_m.mean(axis=1))

    @cached_property
    def flat_m(self) -> FloatArray:
        """Places of the sensors (n, N, 3) above a flattened ground."""
        return self.terrain.flatten(self.sensors_m)

    @cached_property
    def height_m(self) -> float:
        """Median height of the lowest sensor above a flattened ground, in the world frame."""
        return float(np.median(self.flat_m[..., 2].min(axis=1)))

    def height_above(self, position_m: FloatArray) -> FloatArray:
        """Return the height of the sensors (...,) above positions (..., 3)."""
        return np.asarray(self.height_m - self.terrain.flatten(position_m)[..., 2])

    @cached_property
    def along(self) -> FloatArray:
        """Derivative of each channel (n, C) by the ambient field along itself."""
        unit = self.ambient_T / np.linalg.norm(self.ambient_T, axis=1, keepdims=True)
        weights = np.ones_like(self.values_T)
        weights[:, self.is_vector] = np.tile(unit, (1, int(self.is_vector.sum()) // 3))
        return weights

    def along_ambient(self, channels_T: FloatArray) -> FloatArray:
        """Return the mean over the sensors (n,) of channels (n, C) along the ambient field."""
        return np.sum(self.along * channels_T, axis=1) / self.array.n_sensors

    def directions(self, fields_T: FloatArray) -> FloatArray:
        """Return the derivatives (n, C, 3) of the channels by the field at their sensors."""
        out = np.empty((*self.values_T.shape, 3))
        total = self.ambient_T[:, None] + fields_T
        unit = total / np.linalg.norm(total, axis=-1, keepdims=True)
        out[:] = unit[:, self.array.channel_sensor]
        out[:, self.is_vector] = np.tile(np.eye(3), (int(self.is_vector.sum()) // 3, 1))
        return out

    def by_sensors(self, directions: FloatArray) -> FloatArray:
        """Return the derivative (n, C, q) of the channels by sensor errors of unit variance.

        The errors are, for every sensor, stray fields that turn with the array, fields that the ambient field induces
        in its carrier, and gains and axes of vector sensors. Tolles and Lawson's terms are among them.
        """
        R, owner = self.R_world_from_array, self.array.channel_sensor
        by_field = directions @ R  # derivative by a field in the array's axes
        body = np.einsum("nji,nj->ni", R, self.ambient_T)
        rate = np.gradient(body, self.time_s, axis=0)
        columns = []
        for i, sensor in enumerate(self.array.sensors):
            own = (owner == i)[:, None]
            if sensor.offset_uncertainty_T:
                columns.append(sensor.offset_uncertainty_T * np.where(own, by_field, 0.0))
            axes = np.full((3, 3), sensor.misalignment_rad)
            np.fill_diagonal(axes, sensor.gain_uncertainty if sensor.kind == "vector" else 0.0)
            for size, field in (
                (axes, body),
                (np.full((3, 3), sensor.induced_uncertainty), body),
                (np.full((3, 3), sensor.eddy_uncertainty_s), rate),
            ):
                if size.any():
                    columns.append(np.where(own, matrix_effects(by_field, field[:, None]) * size.ravel(), 0.0))
        return np.concatenate(columns, axis=2) if columns else np.zeros((len(self), len(owner), 0))

    def by_pose(self, directions: FloatArray, fields_T: FloatArray, gradients: FloatArray) -> FloatArray:
        """Return the derivative (n, C, q) of the channels by the errors of the pose."""
        R, n = self.R_world_from_array, len(self)
        lever = np.zeros(3) if self.array.pose is None else np.array(self.array.pose.lever_arm_m)
        arms = np.einsum("nij,sj->nsi", R, self.array.positions + lever)
        moved = np.zeros((n, self.array.n_sensors, 3, N_POSE))
        moved[..., SHIFT] = np.eye(3)
        moved[..., TURN] = -cross_matrix(arms) @ R[:, None]
        moved[..., LEVER] = R[:, None]
        changed = gradients @ moved
        # For vector sensors only a turn about the ambient field remains; it turns the sources' field.
        unit = self.ambient_T / np.linalg.norm(self.ambient_T, axis=1, keepdims=True)
        about = np.einsum("ni,nj->nij", unit, np.einsum("ni,nij->nj", unit, R))
        turned = cross_matrix(fields_T) @ about[:, None]
        whole = changed[:, self.array.channel_sensor]
        whole[:, self.is_vector, :, TURN] += turned[:, self.array.channel_sensor[self.is_vector]]
        return np.einsum("nci,ncij->ncj", directions, whole) @ self.pose_effects

    def by_turned_carrier(self, errors: PoseErrors, least_T: float) -> tuple[FloatArray, FloatArray]:
        """Return the effect (n, C, q) of attitude errors on the fields of the carrier.

        Errors have unit variance. The fields of the carrier follow from the stated attitude. Each channel has one error
        with the correlation time of the attitude, and one of the eddy currents that is independent from row to row,
        because their rate is a difference of attitudes. Channels with effects below ``least_T`` have no column.
        """
        turn = np.sqrt(np.sum(self.pose_effects[:, TURN, errors.is_changing] ** 2, axis=(1, 2)) / 3.0)
        body = np.einsum("nji,nj->ni", self.R_world_from_array, self.ambient_T)
        b, rate = (np.linalg.norm(each, axis=1) for each in (body, np.gradient(body, self.time_s, axis=0)))
        dt_s = 2.0 * float(np.median(np.diff(self.time_s)))
        lasts_s = errors.uncertainty.correlation_s
        of_rate = math.sqrt(2.0 * (1.0 - math.exp(-dt_s / lasts_s) if lasts_s else 1.0)) * b / dt_s
        offset, induced, eddy = np.array(
            [(s.offset_uncertainty_T, s.induced_uncertainty, s.eddy_uncertainty_s) for s in self.array.sensors]
        ).T[..., None]
        lasting = np.sqrt(2.0 * (offset**2 + 2.0 * (induced * b) ** 2 + 2.0 * (eddy * rate) ** 2))
        parts = []
        for size in (turn * lasting, turn * math.sqrt(2.0) * eddy * of_rate):
            of_channels = size[self.array.channel_sensor].T
            columns = of_channels[:, None] * np.eye(of_channels.shape[1])
            parts.append(columns[..., of_channels.max(axis=0) > least_T])
        return parts[0], parts[1]

    def by_squared_shift(
        self, directions: FloatArray, position_m: FloatArray, moment_Am2: FloatArray, least_T: float
    ) -> FloatArray:
        r"""Return the derivative (n, C, 5) of the channels by the pose's squared shift δ.

        Components have unit variance. The effect :math:`δ^T \nabla\nabla B δ / 2` depends only on the traceless part of
        δδᵀ, whose 5 components have the variance 2σ⁴. There are no columns if it is below ``least_T`` everywhere.
        """
        variance = np.sum(self.pose_effects[:, SHIFT] ** 2, axis=(1, 2)) / 3.0
        fields = np.zeros((*self.sensors_m.shape, 5))
        for near, away, moment in self._curved_sources(position_m, moment_Am2, variance.max(initial=0.0), least_T):
            fields[near] += finite_body_fields(away, moment, 2)
        if not fields.any():
            return np.zeros((*directions.shape[:2], 0))
        at_channels = fields[:, self.array.channel_sensor]
        return np.einsum("n,nci,ncij->ncj", math.sqrt(2.0) * variance, directions, at_channels, optimize=True)

    def by_bodies(
        self, directions: FloatArray, position_m: FloatArray, moment_Am2: FloatArray, length_m: float, least_T: float
    ) -> FloatArray:
        """Return the derivative (n, C, 14 K') of the channels by the extent of bodies.

        The unit is one σ of the deviation from a dipole, for bodies of some length. K' counts the sources with a
        deviation above ``least_T`` anywhere.
        """
        columns = [np.zeros((*directions.shape[:2], 0))]
        for near, away, moment in self._curved_sources(position_m, moment_Am2, 0.05 * length_m**2, least_T):
            fields = np.zeros((*self.sensors_m.shape, 14))
            fields[near] = finite_body_errors(away, moment, length_m)
            columns.append(np.einsum("nci,ncij->ncj", directions, fields[:, self.array.channel_sensor]))
        return np.concatenate(columns, axis=2)

    def _curved_sources(
        self, position_m: FloatArray, moment_Am2: FloatArray, square_m2: float, least_T: float
    ) -> Iterator[tuple[BoolArray, FloatArray, FloatArray]]:
        """Yield sources whose second derivatives, times a square, exceed some field.

        Each has a mask (n, N) of rows and sensors, the offsets of these, and the moment.
        """
        reach_m = (_SECOND_ORDER * np.linalg.norm(moment_Am2, axis=-1) * square_m2 / least_T) ** 0.2
        felt = self.sensors_m[..., 2].min() - position_m[..., 2] < reach_m
        for position, moment, reach in zip(position_m[felt], moment_Am2[felt], reach_m[felt], strict=True):
            away = self.sensors_m - position
            near = np.linalg.norm(away, axis=-1) < reach
            if near.any():
                yield near, away[near], np.broadcast_to(moment, away[near].shape)


def shortest_turns(vectors: FloatArray, onto: FloatArray) -> FloatArray:
    """Return the smallest rotations (n, 3, 3) of vectors (n, 3) onto others.

    The others must not be opposite to them.
    """
    a, b = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (vectors, onto))
    K = cross_matrix(np.cross(a, b))
    cosine = np.sum(a * b, axis=-1)[..., None, None]
    return np.asarray(np.eye(3) + K + K @ K / np.maximum(1.0 + cosine, _SMALL_TURN))
