r"""Measurement model of one row, and coordinates in which its posterior is Gaussian.

The posterior of a source is nearly Gaussian in the predicted readings, not in position and moment: direction and moment
of a weak source are correlated along a curve. Errors are counted in the coordinates

.. math:: c(x) = M (h(x) - h(x_0)), \qquad M H(x_0) = I

with the predicted differences h of the source in units of their noise, their Jacobian H, and the estimate
:math:`x_0`. To first order c is position and moment; to second order it is as nonlinear as the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.noise import mean_of_finite, reading_covariance
from arrays.typing import FloatArray
from magloc.chi_square import energy_threshold
from magloc.fields import dipole
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.magnet import source_field
from magloc.measurement.nuisances import BackgroundDrift, SensorErrors, without_lasting_errors
from magloc.measurement.pose import N_POSE, ArrayPose, PoseErrors
from magloc.state_space import MeasurementFunction
from magloc.tracking.coordinates import Chart
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.rows import Row, Rows

LEAST_SINGULAR = 1e-6
"""Least ratio of the diagonal of R of a scaled Jacobian (QR) for which a row determines coordinates."""


def whitening(effect: FloatArray) -> FloatArray:
    r"""Return the matrix (k, k) that whitens unit noise plus errors with an effect (k, n).

    With the effect :math:`\Phi` it is :math:`L^{-1}`, where :math:`L L^T = 1 + \Phi \Phi^T`.
    """
    return np.linalg.inv(np.linalg.cholesky(np.eye(len(effect)) + effect @ effect.T))


@dataclass(frozen=True, eq=False)
class RowMeasurement:
    """Model of one row's whitened differences for states (..., n) in the world frame.

    A state has the states of the motion first, then errors of the pose and of the ambient field, then errors of the
    sensors, in which readings are linear. The first two have coordinates in a chart.

    Attributes
    ----------
    model : DifferenceMeasurement
        Model in the array's frame, of differences in units of their noise.
    row : Row
    n_motion : int
        Number of states of the motion.
    effect : ndarray, shape (k, n_errors)
        Effect of the sensors' errors on the differences, in units of their noise.
    pose : ArrayPose
        Pose that the row states.
    pose_effect : ndarray, shape (12, n_pose)
        Effect of the errors of the pose and of the ambient field on the pose.
    """

    model: DifferenceMeasurement
    row: Row
    n_motion: int
    effect: FloatArray
    pose: ArrayPose
    pose_effect: FloatArray

    @cached_property
    def z(self) -> FloatArray:
        """Measured differences, shape (k,)."""
        return self.model.measured(self.row.readings_T)

    @property
    def n_differences(self) -> int:
        """Number of differences k."""
        return self.model.differences.n_differences

    @property
    def n_pose(self) -> int:
        """Number of errors of the pose."""
        return self.pose_effect.shape[1]

    @property
    def n_charted(self) -> int:
        """Number of states with coordinates in a chart: those of the motion and errors of the pose."""
        return self.n_motion + self.n_pose

    @property
    def n_states(self) -> int:
        """Number of states: motion, errors of the pose, errors of the sensors."""
        return self.n_charted + self.effect.shape[1]

    @property
    def transform(self) -> FloatArray:
        """Matrix (k, C) from channels to differences."""
        return self.model.differences.transform

    @cached_property
    def centroid_m(self) -> FloatArray:
        """Centroid of the sensors in the world frame, shape (3,)."""
        return self.row.origin_m + self.row.R_world_from_array @ self.model.array.centroid

    @property
    def radius_m(self) -> float:
        """Largest distance of a sensor from the centroid."""
        return self.model.array.circumradius

    @cached_property
    def kernel_rows(self) -> Rows:
        """The row as an argument of kernels."""
        return stack_rows([self])

    def __getstate__(self) -> dict[str, Any]:
        """Return what is saved: all but the kernels' argument, which holds addresses."""
        return {name: value for name, value in vars(self).items() if name != "kernel_rows"}

    def chart(self, x: FloatArray) -> Chart:
        """Return the charts about states (..., n_charted)."""
        return Chart.at(x, self.centroid_m, self.radius_m, self.n_pose)

    def pad(self, k: int) -> RowMeasurement:
        """Return the row padded to k differences by zeros that do not depend on the source."""
        more = ((0, k - self.n_differences), (0, 0))
        padded = self._with_transform(np.pad(self.transform, more), np.pad(self.effect, more))
        return self if k == self.n_differences else padded

    def _with_transform(self, transform: FloatArray, effect: FloatArray) -> RowMeasurement:
        """Return the row with another matrix from channels to differences of unit noise."""
        differences = Differences(transform, np.ones(len(transform)))
        return replace(self, model=replace(self.model, differences=differences), effect=effect)

    def with_errors_as_noise(self, sigma: FloatArray) -> RowMeasurement:
        """Return the row with the sensors' errors, of σ (n_errors,), as part of its noise."""
        if not sigma.size:
            return self
        return self._with_transform(whitening(self.effect * sigma) @ self.transform, self.effect[:, :0])

    def predict_source(self, state: FloatArray, others_T: FloatArray | None = None) -> FloatArray:
        """Return the differences (..., k) of sources or states, without errors of sensors.

        `others_T` (N, 3) is the field of other sources at the sensors.
        """
        error = self._pose_error(state)
        in_array = self.pose.to_array(state[..., :N_SOURCE], error)
        return self.model.predicted(in_array[..., :3], in_array[..., 3:], self._ambient_T(error, others_T))

    def directional_derivative(
        self, state: FloatArray, directions: FloatArray, others_T: FloatArray | None = None
    ) -> FloatArray:
        """Return the derivative (..., k, m) of :meth:`predict_source` along directions (..., n, m)."""
        error = self._pose_error(state)
        in_array = self.pose.to_array(state[..., :N_SOURCE], error)
        H = self.model.jacobian(in_array[..., :3], in_array[..., 3:], self._ambient_T(error, others_T))
        of_source = self._by_source(H, error) @ directions[..., :N_SOURCE, :]
        if error is None:
            return np.asarray(of_source)
        of_pose = self._by_pose(H, in_array, error) @ directions[..., self.n_motion : self.n_charted, :]
        return np.asarray(of_source + of_pose)

    def moment_columns(self, position_m: FloatArray) -> FloatArray:
        """Return the derivative (..., k, 3) by the moment of a weak source at (..., 3)."""
        array, R = self.model.array, self.row.R_world_from_array
        matrix = dipole.field_matrix(array.positions, ((position_m - self.row.origin_m) @ R)[..., None, :])
        of_sensors = self.transform[:, :, None] * array.linear_gain(array.ambient_fields)
        sensors = array.channel_sensor == np.arange(array.n_sensors)[:, None]
        of_fields = (sensors @ of_sensors).reshape(self.n_differences, -1)
        return np.asarray(of_fields @ matrix.reshape(*matrix.shape[:-3], -1, 3) @ R.T)

    def field_T(self, source: FloatArray) -> FloatArray:
        """Return the field (N, 3) of a source (6,) at the sensors, in the array's axes."""
        in_array = self.pose.to_array(source)
        return source_field(self.model.array, in_array[:3], in_array[3:])

    def predict(self, state: FloatArray) -> FloatArray:
        """Return the predicted differences (k,) of a state (n,), with its errors of sensors."""
        return self.predict_source(state) + self.effect @ state[self.n_charted :]

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Return the Jacobian (k, n) of the predicted differences."""
        return np.concatenate([self.directional_derivative(state, np.eye(self.n_charted)), self.effect], axis=1)

    def without_errors(self, source: FloatArray) -> FloatArray:
        """Return the state (n,) of a source (6,) at rest, with all errors zero."""
        return np.concatenate([source, np.zeros(self.n_states - N_SOURCE)])

    @cached_property
    def without_source(self) -> FloatArray:
        """Measured differences (k,) minus those of the ambient field."""
        array = self.model.array
        ambient = array.readings_of(array.ambient_fields) - array.channel_offset_T
        return self.z - self.transform @ ambient

    @cached_property
    def whitening(self) -> FloatArray:
        """``C^{-1/2}`` (k, k) of a row without a source, with errors of the pose as noise."""
        if not self.n_pose:
            return np.eye(self.n_differences)
        # Without a moment the rest is the ambient field, rotated by the errors of the pose.
        nowhere = self.pose.to_array(np.zeros(N_SOURCE))
        return whitening(
            zero_if_nan(self._by_pose(np.zeros((self.n_differences, N_SOURCE)), nowhere, np.zeros(N_POSE)))
        )

    def is_detected(self, sigma_errors: FloatArray) -> bool:
        """Return True if the differences exceed noise and the effects of errors of sensors and pose."""
        if not self.z.size:
            return False
        alone = self.with_errors_as_noise(sigma_errors)
        left = alone.whitening @ alone.without_source
        return bool(left @ left > energy_threshold(left.size))

    def coordinates(self, state: FloatArray, unit: FloatArray, *, of_readings: bool = True) -> Coordinates:
        """Return coordinates about a state (n,); `unit` (6,) are σ of position and moment.

        They are as nonlinear as the readings, if these determine a source. Otherwise, or if not `of_readings`, they are
        as nonlinear as position and moment in the array's axes are in the errors of the pose.
        """
        if of_readings and self.n_differences >= N_SOURCE:
            G = self.jacobian(state)
            Q, R = np.linalg.qr(G[:, :N_SOURCE] * unit)
            diagonal = np.abs(np.diagonal(R))
            if diagonal.min() > LEAST_SINGULAR * diagonal.max():
                M = unit[:, None] * np.linalg.solve(R, Q.T)
                return Coordinates(state, self.predict, self.jacobian, M, self.predict(state), M @ G)
        G = self._in_array_jacobian(state)
        M = G[:, :N_SOURCE].T
        return Coordinates(state, self._in_array, self._in_array_jacobian, M, self._in_array(state), M @ G)

    def place_in_array(self, state: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the source's offset (3,) from the centroid in array axes, and its root (3, n).

        An error of the pose moves the source in the world, not relative to the array.
        """
        return self._in_array(state)[:3] - self.model.array.centroid, (self._in_array_jacobian(state) @ S)[:3]

    def _in_array(self, state: FloatArray) -> FloatArray:
        """Return position and moment (6,) of a state in the true axes of the array."""
        return self.pose.to_array(state[:N_SOURCE], self._pose_error(state))

    def _in_array_jacobian(self, state: FloatArray) -> FloatArray:
        """Return the Jacobian (6, n) of position and moment in the true axes of the array."""
        error = self._pose_error(state)
        full = np.zeros((N_SOURCE, state.size))
        full[:, :N_SOURCE] = self._by_source(np.eye(N_SOURCE), error)
        if error is not None:
            of_errors = self.pose.error_jacobian(self._in_array(state), error)
            full[:, self.n_motion : self.n_charted] = of_errors @ self.pose_effect
        return full

    def _pose_error(self, state: FloatArray) -> FloatArray | None:
        """Return the errors (..., 12) of the pose in states, or None if these are of a source alone."""
        if not self.n_pose or state.shape[-1] == N_SOURCE:
            return None
        return np.asarray(state[..., self.n_motion : self.n_charted] @ self.pose_effect.T)

    def _by_source(self, H: FloatArray, error: FloatArray | None) -> FloatArray:
        """Return the Jacobian (..., k, 6) by sources in the world, from that in the array's axes."""
        RT = np.swapaxes(self.pose.true_attitude(error), -1, -2)
        return np.concatenate([H[..., :3] @ RT, H[..., 3:] @ RT], axis=-1)

    def _by_pose(self, H: FloatArray, in_array: FloatArray, error: FloatArray) -> FloatArray:
        """Return the Jacobian (..., k, n_pose) by the errors of the pose."""
        array = self.model.array
        by_error = H @ self.pose.error_jacobian(in_array, error)
        by_error += self.transform @ self.pose.ambient_jacobian(array, in_array, error, array.ambient_fields)
        return np.asarray(by_error @ self.pose_effect)

    def _ambient_T(self, error: FloatArray | None, others_T: FloatArray | None) -> FloatArray | None:
        """Return the field (..., N, 3) without the source, or None for the array's own one."""
        if error is None:
            return None if others_T is None else self.model.array.ambient_fields + others_T
        ambient_T = self.pose.ambient(self.model.array.ambient_fields, error)
        return ambient_T if others_T is None else ambient_T + others_T


def stack_rows(rows: Sequence[RowMeasurement]) -> Rows:
    """Return rows of one array as an argument of kernels."""
    counts = np.array([row.n_differences for row in rows])
    padded = [row.pad(counts.max()) for row in rows]
    ambients_T = np.stack([row.model.array.ambient_fields for row in rows])
    return replace(
        Rows.stack(rows[0].model.array, padded, ambients_T),
        counts=counts,
        pose_effects=np.stack([row.pose_effect for row in rows]) if rows[0].n_pose else None,
        lever_arm_m=tuple(rows[0].pose.lever_arm_m.tolist()),
    )


def zero_if_nan(derivative: FloatArray) -> FloatArray:
    """Return a derivative with zeros instead of NaN.

    Moduli without an ambient field have no derivative at a moment of zero.
    """
    return np.where(np.isnan(derivative), 0.0, derivative)


class RowMeasurements:
    """Measurement models of an array's rows, with lasting errors as states.

    Parameters
    ----------
    array : SensorArray
    n_motion : int
        Number of states of the motion.
    background : Drift, optional
        Drift of every channel.

    Attributes
    ----------
    errors : SensorErrors
        Lasting errors of the array's sensors, and the background: the last states.
    pose_errors : PoseErrors
        Errors of the pose and of the ambient field: the states before `errors`.
    """

    def __init__(self, array: SensorArray, n_motion: int, background: BackgroundDrift | None = None) -> None:
        self.errors = SensorErrors.of(array, background)
        self.pose_errors = PoseErrors.of_array(array)
        self._lever_arm_m = np.array(self.pose_errors.uncertainty.lever_arm_m)
        self._array = without_lasting_errors(array)
        self._noise_varies = self._array.noise_depends_on_reading
        self._n_motion = n_motion
        self._differences: dict[bytes, Differences] = {}

    def of(self, row: Row, source: FloatArray | None = None) -> RowMeasurement:
        """Return the measurement model of a row.

        Errors of gains and axes act on the field of a source (6,), by default on the readings. With the readings, noise
        would look like a field with another gain in each row, and σ of the gains would become too small.
        """
        array = self._array
        if row.ambient_T is not None:
            array = array.in_ambient_field(row.ambient_T)
        differences, pose = self.differences(row), row.pose(self._lever_arm_m)
        readings_T = row.readings_T
        if source is not None and self.errors.depends_on_field:
            readings_T = _readings_of(array, readings_T, pose.to_array(source))
        of_errors = self.errors.effect(array, readings_T, row.time_s, pose.rate_rad_s)
        of_pose = self.pose_errors.effect(pose, row.pose_sigma)
        model, effect = DifferenceMeasurement(array, differences), differences.transform @ of_errors
        return RowMeasurement(model, row, self._n_motion, effect, pose, of_pose)

    def differences(self, row: Row) -> Differences:
        """Return the independent differences of a row's readings, in units of their noise."""
        available = np.isfinite(row.readings_T)
        if self._noise_varies:
            covariance = reading_covariance(self._array, row.readings_T)
            return decorrelated_differences(self._array, available, covariance_T2=covariance).whitened
        key = available.tobytes()
        if key not in self._differences:
            self._differences[key] = decorrelated_differences(self._array, available).whitened
        return self._differences[key]


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Six coordinates of a state: to first order its position and moment.

    Attributes
    ----------
    centre : ndarray, shape (n,)
        State at the origin of the coordinates.
    function, jacobian : callable
        Function (n,) -> (k,) that is as nonlinear as the coordinates, and its derivative (k, n).
    M : ndarray, shape (6, k)
        The coordinates are M times the change of the function.
    value, J : ndarray, shapes (k,) and (6, n)
        Value of the function at the centre, and derivative of the coordinates there.
    """

    centre: FloatArray
    function: MeasurementFunction
    jacobian: MeasurementFunction
    M: FloatArray
    value: FloatArray
    J: FloatArray

    def at(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the coordinates (6,) of a state (n,), and their derivative (6, n)."""
        if np.array_equal(state, self.centre):
            return np.zeros(N_SOURCE), self.J
        return self.M @ (self.function(state) - self.value), self.M @ self.jacobian(state)


def _readings_of(array: SensorArray, readings_T: FloatArray, source: FloatArray) -> FloatArray:
    """Return readings (C,) of a source in the array's frame and of the common field that measured ones (C,) leave."""
    fields_T = source_field(array, source[:3], source[3:]) + array.ambient_fields
    if array.ambient_T is None:
        fields_T = fields_T + mean_of_finite(array.calibrated_field(readings_T) - fields_T, axis=-2)
    return array.readings_of(fields_T)


def step_of_errors(pose_errors: PoseErrors, errors: SensorErrors, dt_s: float) -> tuple[FloatArray, FloatArray]:
    """Return the decay factor (n,) of each error of pose and sensors, and σ (n,) of its noise."""
    of_errors = zip(pose_errors.step(dt_s), errors.step(dt_s), strict=True)
    decay, noise = (np.concatenate(parts) for parts in of_errors)
    return decay, noise
