"""What one row measures of tracked sources."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.noise import reading_covariance
from arrays.typing import FloatArray
from magloc.chi_square import energy_threshold
from magloc.measurement.differences import DifferenceMeasurement, turn_jacobian
from magloc.measurement.nuisances import SensorErrors, without_lasting_errors
from magloc.measurement.pose import N_POSE, TURN, ArrayPose, PoseErrors
from magloc.navigation.rotations import rotation_matrix, turn_of_change
from magloc.tracking.chart.coordinates import Chart
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row


@dataclass(frozen=True, eq=False)
class RowMeasurement:
    """Differences of one row, in units of their noise, as a function of states in the world frame.

    Attributes
    ----------
    model : DifferenceMeasurement
        In the array's frame.
    sigma : ndarray, shape (k,)
        Standard deviations of the differences [T].
    row : Row
    n_motion : int
        States of the motion, the last of them errors of the pose; behind them stand the sensors' errors.
    channel_effect : ndarray, shape (C, n_errors)
        Of the sensors' errors on the channels [T].
    pose : ArrayPose
        As the row states it.
    pose_effect : ndarray, shape (9, n_pose)
        Of the pose's errors on it.
    """

    model: DifferenceMeasurement
    sigma: FloatArray
    row: Row
    n_motion: int
    channel_effect: FloatArray
    pose: ArrayPose
    pose_effect: FloatArray

    @cached_property
    def z(self) -> FloatArray:
        """Measured differences, shape (k,)."""
        return self.model.measured(self.row.readings_T) / self.sigma

    @cached_property
    def centroid_m(self) -> FloatArray:
        """Of the sensors in the world frame, shape (3,)."""
        return self.row.origin_m + self.row.R_world_from_array @ self.model.array.centroid

    @property
    def radius_m(self) -> float:
        """Largest distance of a sensor from it."""
        return self.model.array.circumradius

    @property
    def n_pose(self) -> int:
        """Number of the pose's errors."""
        return self.pose_effect.shape[1]

    def chart(self, x: FloatArray) -> Chart:
        """About states (..., n) of the motion."""
        return Chart.at(x, self.centroid_m, self.radius_m, self.n_pose)

    @cached_property
    def effect(self) -> FloatArray:
        """Of the sensors' errors on the differences, in units of their noise: (k, n_errors)."""
        return (self.model.differences.transform / self.sigma[:, None]) @ self.channel_effect

    def effect_on(self, roots: FloatArray) -> FloatArray:
        """Products ``effect @ roots`` (K, k, m) with matrices (K, n_errors, m): every channel has a few errors only."""
        from scipy.sparse import csr_array

        sparse, transform = csr_array(self.channel_effect), self.model.differences.transform / self.sigma[:, None]
        return np.stack([transform @ (sparse @ root) for root in roots])

    def of_source(self, state: FloatArray) -> FloatArray:
        """Predicted differences (..., k) of sources (..., 6) or states of the motion, sensors being without errors."""
        error = self._pose_error(state)
        in_array = self.pose.in_array(state[..., :N_SOURCE], error)
        return self.model.predicted(in_array[..., :3], in_array[..., 3:], self._ambient_T(error)) / self.sigma

    def source_jacobian(self, state: FloatArray) -> FloatArray:
        """Their Jacobian (..., k, 6) by position and moment."""
        error = self._pose_error(state)
        return self._by_source(self._by_array(self.pose.in_array(state[..., :N_SOURCE], error), error), error)

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """Their derivative (..., k, m) along directions (..., n, m) in states of the motion."""
        error = self._pose_error(state)
        if error is None:
            return np.asarray(self.source_jacobian(state) @ directions[..., :N_SOURCE, :])
        in_array = self.pose.in_array(state[..., :N_SOURCE], error)
        H = self._by_array(in_array, error)
        by_pose = self._by_pose(H, in_array, error) @ directions[..., self.n_motion - self.n_pose : self.n_motion, :]
        return np.asarray(self._by_source(H, error) @ directions[..., :N_SOURCE, :] + by_pose)

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Jacobian (k, N) of all differences by a Cartesian state (N,) with the sensors' errors."""
        full = np.zeros((len(self.sigma), state.size))
        full[:, : self.n_motion] = self.along(state[: self.n_motion], np.eye(self.n_motion))
        full[:, self.n_motion :] = self.effect
        return full

    def with_lasting_errors(self, lasting: FloatArray) -> RowMeasurement:
        """The row where only some shares (n_pose,) of the pose's errors have an effect."""
        return replace(self, pose_effect=self.pose_effect * lasting) if self.n_pose else self

    @cached_property
    def without_source(self) -> FloatArray:
        """What is left of the measured differences (k,) when the ambient field's own are taken out."""
        array = self.model.array
        ambient = array.readings_of(array.ambient_fields) - array.channel_offset_T
        return self.z - (self.model.differences.transform @ ambient) / self.sigma

    def whitening(self, sigma_errors: FloatArray) -> FloatArray | None:
        """``C^{-1/2}`` (k, k) of a row without a source, its sensors' errors known by their σ (n_errors,) alone."""
        if not sigma_errors.size + self.n_pose:
            return None
        # Sources without a moment: what is left is the ambient field, turned by the pose's errors.
        nowhere = self.pose.in_array(np.zeros(N_SOURCE))
        by_pose = self._by_pose(np.zeros((len(self.sigma), N_SOURCE)), nowhere, np.zeros(N_POSE))
        lasting = np.concatenate([self.effect * sigma_errors, by_pose], axis=1)
        return np.linalg.inv(np.linalg.cholesky(np.eye(len(lasting)) + lasting @ lasting.T))

    def is_detected(self, sigma_errors: FloatArray) -> bool:
        """Whether the differences stand out of noise and of what the errors of sensors and pose may make of them."""
        if not self.z.size:
            return False
        whiten = self.whitening(sigma_errors)
        left = self.without_source if whiten is None else whiten @ self.without_source
        return bool(left @ left > energy_threshold(left.size))

    def _pose_error(self, state: FloatArray) -> FloatArray | None:
        """Errors (..., 9) of the pose that states of the motion stand for, None where they are of a source alone."""
        if not self.n_pose or state.shape[-1] == N_SOURCE:
            return None
        return np.asarray(state[..., self.n_motion - self.n_pose : self.n_motion] @ self.pose_effect.T)

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
        turned = turn_jacobian(self.model.array, in_array[..., :3], in_array[..., 3:], self._ambient_T(error))
        by_error = H @ self.pose.error_jacobian(in_array, error)
        of_ambient = self.model.differences.transform @ turned / self.sigma[:, None]
        by_error[..., TURN] += of_ambient @ turn_of_change(-error[..., TURN])
        return np.asarray(by_error @ self.pose_effect)

    def _ambient_T(self, error: FloatArray | None) -> FloatArray | None:
        """Ambient fields at the sensors (..., N, 3) where the pose is turned by errors; None: the array's own."""
        return None if error is None else self.model.array.ambient_fields @ rotation_matrix(error[..., TURN])


class RowMeasurements:
    """What the rows of an array measure, without the noise that lasts: that is the states behind those of the motion.

    Parameters
    ----------
    array : SensorArray
    n_motion : int
        States of the motion, without errors of the pose.

    Attributes
    ----------
    errors : SensorErrors
        The lasting errors of the array's sensors.
    pose_errors : PoseErrors
        Those of its pose.
    n_differences : int
        Independent differences of a row whose readings are all there.
    """

    def __init__(self, array: SensorArray, n_motion: int) -> None:
        self.errors = SensorErrors.of(array)
        self.pose_errors = PoseErrors.of(array.pose)
        self._lever_arm_m = np.array(self.pose_errors.uncertainty.lever_arm_m)
        self.n_differences = decorrelated_differences(array).n_differences
        self._array = without_lasting_errors(array)
        self._n_motion = n_motion + self.pose_errors.n_states
        self._differences: dict[bytes, Differences] = {}

    def of(self, row: Row) -> RowMeasurement:
        """What a row's readings say of the state."""
        array = self._array
        if row.ambient_T is not None:
            x, y, z = row.ambient_T.tolist()
            array = replace(array, ambient_T=(x, y, z))
        differences = self.differences(row)
        sigma = np.sqrt(differences.variance)
        effect = self.errors.effect(array, row.readings_T)
        pose = row.pose(self._lever_arm_m)
        of_pose = self.pose_errors.effect(pose, row.pose_sigma)
        model = DifferenceMeasurement(array, differences)
        return RowMeasurement(model, sigma, row, self._n_motion, effect, pose, of_pose)

    def differences(self, row: Row) -> Differences:
        """The independent differences that a row's readings give."""
        available = np.isfinite(row.readings_T)
        if self._array.noise_depends_on_reading:
            covariance = reading_covariance(self._array, row.readings_T)
            return decorrelated_differences(self._array, available, covariance_T2=covariance)
        key = available.tobytes()
        if key not in self._differences:
            self._differences[key] = decorrelated_differences(self._array, available)
        return self._differences[key]
