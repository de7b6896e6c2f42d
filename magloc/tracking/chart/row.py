"""What one row measures of states that stand side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.differences import Differences
from arrays.typing import FloatArray, IntArray
from magloc import core
from magloc.chi_square import energy_threshold
from magloc.fields import dipole
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.pose import N_POSE, ArrayPose
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.measurement import RowMeasurement, whitening
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of an array's readings.

    Attributes
    ----------
    array : SensorArray
    readings : ndarray, shape (n, k)
        Differences in units of their noise, zero behind the last one of a row.
    counts : ndarray of int, shape (n,)
        Number of differences of each row.
    transforms, transform_of_row : ndarray, shapes (m, k, n_channels) and (n,)
        From channels to differences.
    effects : ndarray, shape (n or 1, k, n_nuisances)
        Effects of nuisances on the readings.
    origins_m, rotations : ndarray, shapes (n, 3) and (n, 3, 3)
        Pose of the array.
    ambients_T : ndarray, shape (n or 1, n_sensors, 3)
        Field at the sensors without a source.
    pose_effects : ndarray, shape (n, 12, n_pose), optional
        Effects on the pose and the ambient field of errors of theirs.
    lever_arm_m : tuple of 3 floats
        From the pose's reference point to the array's origin, in the array's axes.
    """

    array: SensorArray
    readings: FloatArray
    counts: IntArray
    transforms: FloatArray
    transform_of_row: IntArray
    effects: FloatArray
    origins_m: FloatArray
    rotations: FloatArray
    ambients_T: FloatArray
    pose_effects: FloatArray | None = None
    lever_arm_m: tuple[float, ...] = (0.0, 0.0, 0.0)

    @property
    def n_pose(self) -> int:
        """Number of errors of the pose and of the ambient field."""
        return 0 if self.pose_effects is None else self.pose_effects.shape[2]

    @cached_property
    def problem(self) -> core.Problem:
        """Return the arguments of kernels."""
        array, order = self.array, np.arange(len(self.readings))
        return core.problem(
            "rows",
            n_sensors=array.n_sensors,
            n_channels=array.n_channels,
            n_readings=self.readings.shape[1],
            n_nuisances=self.effects.shape[2],
            n_pose=self.n_pose,
            sensors=array.positions,
            array_centroid=tuple(array.centroid),
            radius=array.circumradius,
            sensor=np.ascontiguousarray(array.channel_sensor, dtype=np.int64),
            gain=array.channel_gain,
            is_modulus=array.channel_is_scalar.astype(np.uint8),
            readings=np.ascontiguousarray(self.readings),
            counts=np.ascontiguousarray(self.counts, dtype=np.int64),
            transforms=np.ascontiguousarray(self.transforms),
            transform_of_row=np.ascontiguousarray(self.transform_of_row, dtype=np.int64),
            effects=np.ascontiguousarray(self.effects),
            effect_of_row=order if len(self.effects) > 1 else np.zeros_like(order),
            origins=np.ascontiguousarray(self.origins_m),
            rotations=np.ascontiguousarray(self.rotations),
            ambients=np.ascontiguousarray(self.ambients_T),
            ambient_of_row=order if len(self.ambients_T) > 1 else np.zeros_like(order),
            pose_effects=None if self.pose_effects is None else np.ascontiguousarray(self.pose_effects),
            lever_arm=self.lever_arm_m,
        )


@dataclass(frozen=True, eq=False)
class ChartRow:
    """Differences of one row, in units of their noise, as a function of states (..., n) in the world frame.

    A state is that of the motion, and behind it errors of the pose and of the ambient field: a prediction of it bends
    as a whole. Errors of sensors are no part of it; they only add `effect` to the differences.

    Attributes
    ----------
    measurement : RowMeasurement
    pose_effect : ndarray, shape (12, n_pose)
        Of the pose's errors on it.
    """

    measurement: RowMeasurement
    pose_effect: FloatArray

    @classmethod
    def of(cls, measurement: RowMeasurement) -> ChartRow:
        """As a row is measured."""
        return cls(measurement, measurement.pose_effect)

    @property
    def row(self) -> Row:
        """Its readings."""
        return self.measurement.row

    @property
    def z(self) -> FloatArray:
        """Measured differences, shape (k,)."""
        return self.measurement.z

    @property
    def n_differences(self) -> int:
        """Number of differences k."""
        return self.z.size

    @property
    def model(self) -> DifferenceMeasurement:
        """In the array's frame."""
        return self.measurement.model

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the differences [T], shape (k,)."""
        return self.measurement.sigma

    @property
    def effect(self) -> FloatArray:
        """Of the sensors' errors on the differences, in units of their noise: (k, n_errors)."""
        return self.measurement.effect

    @property
    def pose(self) -> ArrayPose:
        """As the row states it."""
        return self.measurement.pose

    @property
    def n_pose(self) -> int:
        """Number of the pose's errors."""
        return self.pose_effect.shape[1]

    @property
    def n_motion(self) -> int:
        """States of the motion and errors of the pose."""
        return self.measurement.n_motion + self.n_pose

    @cached_property
    def centroid_m(self) -> FloatArray:
        """Of the sensors in the world frame, shape (3,)."""
        return self.row.origin_m + self.row.R_world_from_array @ self.model.array.centroid

    @cached_property
    def radius_m(self) -> float:
        """Largest distance of a sensor from it."""
        return self.model.array.circumradius

    @cached_property
    def compiled(self) -> Rows:
        """The row as kernels take it."""
        return stacked([self])

    def chart(self, x: FloatArray) -> Chart:
        """About states (..., n)."""
        return Chart.at(x, self.centroid_m, self.radius_m, self.n_pose)

    def padded(self, k: int) -> ChartRow:
        """Return the row with k differences: those behind its own are zero, of unit noise, and see no source."""
        own, more = self.measurement, k - self.n_differences
        differences = Differences(
            np.pad(own.model.differences.transform, ((0, more), (0, 0))),
            np.pad(own.model.differences.variance, (0, more), constant_values=1.0),
        )
        padded = replace(
            own,
            model=replace(own.model, differences=differences),
            sigma=np.pad(own.sigma, (0, more), constant_values=1.0),
            effect=np.pad(own.effect, ((0, more), (0, 0))),
        )
        return replace(self, measurement=padded) if more else self

    def with_errors_as_noise(self, sigma: FloatArray) -> ChartRow:
        """The row alone: its sensors' errors, known by their σ (n_errors,), are noise."""
        return replace(self, measurement=self.measurement.with_errors_as_noise(sigma)) if sigma.size else self

    def of_source(self, state: FloatArray) -> FloatArray:
        """Predicted differences (..., k) of sources (..., 6) or states, sensors being without errors."""
        error = self._pose_error(state)
        in_array = self.pose.in_array(state[..., :N_SOURCE], error)
        return self.model.predicted(in_array[..., :3], in_array[..., 3:], self._ambient_T(error)) / self.sigma

    def moment_columns(self, position_m: FloatArray) -> FloatArray:
        """Return the derivative (..., k, 3) of the differences by the moment of a weak source at (..., 3)."""
        array, R = self.model.array, self.row.R_world_from_array
        matrix = dipole.field_matrix(array.positions, ((position_m - self.row.origin_m) @ R)[..., None, :])
        of_channels = self.model.differences.transform / self.sigma[:, None]
        of_sensors = of_channels[:, :, None] * array.linear_gain(array.ambient_fields)
        sensors = array.channel_sensor == np.arange(array.n_sensors)[:, None]
        of_fields = (sensors @ of_sensors).reshape(self.n_differences, -1)
        return np.asarray(of_fields @ matrix.reshape(*matrix.shape[:-3], -1, 3) @ R.T)

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Their derivative (..., k, m) along directions (..., n, m) in states."""
        error = self._pose_error(state)
        in_array = self.pose.in_array(state[..., :N_SOURCE], error)
        H = self._by_array(in_array, error)
        of_source = self._by_source(H, error) @ directions[..., :N_SOURCE, :]
        if error is None:
            return np.asarray(of_source)
        first = self.measurement.n_motion
        return np.asarray(of_source + self._by_pose(H, in_array, error) @ directions[..., first : self.n_motion, :])

    @cached_property
    def without_source(self) -> FloatArray:
        """What is left of the measured differences (k,) when the ambient field's own are taken out."""
        array = self.model.array
        ambient = array.readings_of(array.ambient_fields) - array.channel_offset_T
        return self.z - (self.model.differences.transform @ ambient) / self.sigma

    @cached_property
    def whitening(self) -> FloatArray:
        """``C^{-1/2}`` (k, k) of a row without a source: what its pose's errors make of the ambient field is noise."""
        if not self.n_pose:
            return np.eye(len(self.sigma))
        # Sources without a moment: what is left is the ambient field, turned by the pose's errors.
        nowhere = self.pose.in_array(np.zeros(N_SOURCE))
        by_pose = where_smooth(self._by_pose(np.zeros((len(self.sigma), N_SOURCE)), nowhere, np.zeros(N_POSE)))
        return whitening(by_pose)

    def is_detected(self, sigma_errors: FloatArray) -> bool:
        """Whether the differences stand out of noise and of what the errors of sensors and pose may make of them."""
        if not self.z.size:
            return False
        alone = self.with_errors_as_noise(sigma_errors)
        left = alone.whitening @ alone.without_source
        return bool(left @ left > energy_threshold(left.size))

    def _pose_error(self, state: FloatArray) -> FloatArray | None:
        """Errors (..., 12) of the pose that states stand for, None where they are of a source alone."""
        if not self.n_pose or state.shape[-1] == N_SOURCE:
            return None
        return np.asarray(state[..., self.measurement.n_motion : self.n_motion] @ self.pose_effect.T)

    def _by_array(self, in_array: FloatArray, error: FloatArray | None) -> FloatArray:
        """Jacobian (..., k, 6) by a source in the array's axes."""
        H = self.model.jacobian(in_array[..., :3], in_array[..., 3:], self._ambient_T(error))
        return np.asarray(H / self.sigma[:, None])

    def _by_source(self, H: FloatArray, error: FloatArray | None) -> FloatArray:
        """That by a source of the world."""
        RT = np.swapaxes(self.pose.turned(error), -1, -2)
        return np.concatenate([H[..., :3] @ RT, H[..., 3:] @ RT], axis=-1)

    def _by_pose(self, H: FloatArray, in_array: FloatArray, error: FloatArray) -> FloatArray:
        """That (..., k, n_pose) by the pose's errors."""
        array, whiten = self.model.array, self.model.differences.transform / self.sigma[:, None]
        by_error = H @ self.pose.error_jacobian(in_array, error)
        by_error += whiten @ self.pose.ambient_jacobian(array, in_array, error, array.ambient_fields)
        return np.asarray(by_error @ self.pose_effect)

    def _ambient_T(self, error: FloatArray | None) -> FloatArray | None:
        """Ambient fields at the sensors (..., N, 3) that errors make of the array's own, which is meant by None."""
        return None if error is None else self.pose.ambient(self.model.array.ambient_fields, error)


def stacked(rows: Sequence[ChartRow]) -> Rows:
    """Return rows of one array as kernels take them."""
    k = max(row.n_differences for row in rows)
    padded = [row.padded(k) for row in rows]
    return Rows(
        rows[0].model.array,
        np.stack([row.z for row in padded]),
        np.array([row.n_differences for row in rows]),
        np.stack([row.model.differences.transform / row.sigma[:, None] for row in padded]),
        np.arange(len(rows)),
        np.stack([row.effect for row in padded]),
        np.stack([row.row.origin_m for row in rows]),
        np.stack([row.row.R_world_from_array for row in rows]),
        np.stack([row.model.array.ambient_fields for row in rows]),
        np.stack([row.pose_effect for row in rows]) if rows[0].n_pose else None,
        tuple(rows[0].pose.lever_arm_m.tolist()),
    )


def where_smooth(derivative: FloatArray) -> FloatArray:
    """Zero in place of NaN: differences of moduli in no ambient field, which have a corner where the source is none."""
    return np.where(np.isnan(derivative), 0.0, derivative)
