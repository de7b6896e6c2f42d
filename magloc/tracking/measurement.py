r"""What one row measures of a tracked source, and coordinates that bend as its readings do.

What rows told of a source is nearly Gaussian in what they measured, not in position and moment: of a weak source the
direction and the moment are known only together, along a curve. Errors are counted in

.. math:: c(x) = M (h(x) - h(x_0)), \qquad M H(x_0) = I

with the predicted differences h of the source in units of their noise, their Jacobian H, and the estimate
:math:`x_0`: to first order c is position and moment, and to second order it bends as the readings do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.noise import reading_covariance
from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.nuisances import Drift, SensorErrors, without_lasting_errors
from magloc.measurement.pose import ArrayPose, PoseErrors
from magloc.state_space import MeasurementFunction
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row

LEAST_SINGULAR = 1e-6
"""A row has no coordinates of its own if a column of its Jacobian, in units of what is known, is so near to others."""


def whitening(effect: FloatArray) -> FloatArray:
    r"""Matrix (k, k) that whitens unit noise and errors of unit variance with an effect :math:`\Phi` (k, n) on it.

    :math:`L^{-1}` of :math:`L L^T = 1 + \Phi \Phi^T`.
    """
    return np.linalg.inv(np.linalg.cholesky(np.eye(len(effect)) + effect @ effect.T))


@dataclass(frozen=True, eq=False)
class RowMeasurement:
    """Differences of one row, in units of their noise, as a function of the state in the world frame.

    Attributes
    ----------
    model : DifferenceMeasurement
        In the array's frame.
    sigma : ndarray, shape (k,)
        Standard deviations of the differences [T].
    row : Row
    n_motion : int
        States of the motion; behind them stand the sensors' errors, then those of the pose.
    effect : ndarray, shape (k, n_errors)
        Of the sensors' errors on the differences, in units of their noise.
    pose : ArrayPose
        As the row states it.
    pose_effect : ndarray, shape (12, n_pose)
        Of the errors of the pose and of the ambient field on it.
    """

    model: DifferenceMeasurement
    sigma: FloatArray
    row: Row
    n_motion: int
    effect: FloatArray
    pose: ArrayPose
    pose_effect: FloatArray

    @cached_property
    def z(self) -> FloatArray:
        """Measured differences, shape (k,)."""
        return self.model.measured(self.row.readings_T) / self.sigma

    def pose_error(self, state: FloatArray) -> FloatArray | None:
        """Error (12,) of the pose that a state (n,) stands for, None where none is stated."""
        states = state[self.n_motion + self.effect.shape[1] :]
        return self.pose_effect @ states if states.size else None

    def of_source(
        self, source: FloatArray, error: FloatArray | None = None, others_T: FloatArray | None = None
    ) -> FloatArray:
        """Predicted differences (k,) of a source (6,) where the pose has an error (12,) and no sensor has any.

        `others_T` (N, 3) is the field of other sources at the sensors.
        """
        in_array = self.pose.in_array(source, error)
        return self.model.predicted(in_array[:3], in_array[3:], self._ambient_T(error, others_T)) / self.sigma

    def source_jacobian(self, source: FloatArray, others_T: FloatArray | None = None) -> FloatArray:
        """Their Jacobian (k, 6) where the pose has no error."""
        return self._by_source(self._by_array(self.pose.in_array(source), others_T=others_T))

    def with_errors_as_noise(self, sigma: FloatArray) -> RowMeasurement:
        """The row alone: the sensors' errors, known by their σ (n_errors,), are part of the differences' noise."""
        lasting, k = self.effect * sigma, len(self.sigma)
        whiten = whitening(lasting)
        differences = Differences(whiten @ (self.model.differences.transform / self.sigma[:, None]), np.ones(k))
        model = replace(self.model, differences=differences)
        return replace(self, model=model, sigma=np.ones(k), effect=np.zeros((k, 0)))

    def field_T(self, source: FloatArray) -> FloatArray:
        """Field (N, 3) of a source (6,) at the sensors, in the array's axes, where the pose has no error."""
        in_array = self.pose.in_array(source)
        return dipole.field(self.model.array.positions, in_array[:3], in_array[3:])

    def predicted(self, state: FloatArray) -> FloatArray:
        """Predicted differences (k,) of a state (n,)."""
        of_source = self.of_source(state[:N_SOURCE], self.pose_error(state))
        return of_source + self.effect @ state[self.n_motion : self.n_motion + self.effect.shape[1]]

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Their Jacobian (k, n)."""
        first, behind = self.n_motion, self.n_motion + self.effect.shape[1]
        error = self.pose_error(state)
        in_array = self.pose.in_array(state[:N_SOURCE], error)
        H = self._by_array(in_array, error)
        full = np.zeros((len(self.sigma), state.size))
        full[:, :N_SOURCE] = self._by_source(H, error)
        full[:, first:behind] = self.effect
        if error is not None:
            array, whiten = self.model.array, self.model.differences.transform / self.sigma[:, None]
            by_error = H @ self.pose.error_jacobian(in_array, error)
            by_error += whiten @ self.pose.ambient_jacobian(array, in_array, error, array.ambient_fields)
            full[:, behind:] = by_error @ self.pose_effect
        return full

    @property
    def n_states(self) -> int:
        """Of the motion, of the sensors' errors and of those of the pose."""
        return self.n_motion + self.effect.shape[1] + self.pose_effect.shape[1]

    def without_errors(self, source: FloatArray) -> FloatArray:
        """The state (n,) of a source (6,) at rest where nothing has an error."""
        return np.concatenate([source, np.zeros(self.n_states - N_SOURCE)])

    def coordinates(self, state: FloatArray, unit: FloatArray, *, of_readings: bool = True) -> Coordinates:
        """Coordinates about a state (n,), where `unit` (6,) is what is known of position and moment.

        They bend as the readings do, if these determine a source; else, or if not `of_readings`, as its place in the
        array's axes does with the errors of the pose.
        """
        if of_readings and len(self.sigma) >= N_SOURCE:
            G = self.jacobian(state)
            Q, R = np.linalg.qr(G[:, :N_SOURCE] * unit)
            diagonal = np.abs(np.diagonal(R))
            if diagonal.min() > LEAST_SINGULAR * diagonal.max():
                M = unit[:, None] * np.linalg.solve(R, Q.T)
                return Coordinates(state, self.predicted, self.jacobian, M, self.predicted(state), M @ G)
        G = self._in_array_jacobian(state)
        M = G[:, :N_SOURCE].T
        return Coordinates(state, self._in_array, self._in_array_jacobian, M, self._in_array(state), M @ G)

    def place_in_array(self, state: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Offset (3,) of the source from the sensors' centroid in the array's axes, and a square root (3, n) of its P.

        An error of the pose moves the source in the world, not from the array.
        """
        return self._in_array(state)[:3] - self.model.array.centroid, (self._in_array_jacobian(state) @ S)[:3]

    def _in_array(self, state: FloatArray) -> FloatArray:
        """Position and moment (6,) of a state in the true axes of the array."""
        return self.pose.in_array(state[:N_SOURCE], self.pose_error(state))

    def _in_array_jacobian(self, state: FloatArray) -> FloatArray:
        """Their Jacobian (6, n)."""
        error = self.pose_error(state)
        full = np.zeros((N_SOURCE, state.size))
        full[:, :N_SOURCE] = self._by_source(np.eye(N_SOURCE), error)
        if error is not None:
            behind = self.n_motion + self.effect.shape[1]
            full[:, behind:] = self.pose.error_jacobian(self._in_array(state), error) @ self.pose_effect
        return full

    def _by_array(
        self, in_array: FloatArray, error: FloatArray | None = None, others_T: FloatArray | None = None
    ) -> FloatArray:
        """Jacobian (k, 6) by a source in the array's axes."""
        ambient_T = self._ambient_T(error, others_T)
        return self.model.jacobian(in_array[:3], in_array[3:], ambient_T) / self.sigma[:, None]

    def _by_source(self, H: FloatArray, error: FloatArray | None = None) -> FloatArray:
        """That by a source of the world."""
        R = self.pose.turned(error)
        return (H.reshape(-1, 2, 3) @ R.T).reshape(-1, N_SOURCE)

    def _ambient_T(self, error: FloatArray | None, others_T: FloatArray | None = None) -> FloatArray | None:
        """Field at the sensors (N, 3) besides the source's where the pose and that field have an error.

        None: the array's own ambient field, unturned.
        """
        if error is None:
            return None if others_T is None else self.model.array.ambient_fields + others_T
        ambient_T = self.pose.ambient(self.model.array.ambient_fields, error)
        return ambient_T if others_T is None else ambient_T + others_T


class RowMeasurements:
    """What the rows of an array measure, without the noise that lasts: that is the states behind those of the motion.

    Parameters
    ----------
    array : SensorArray
    n_motion : int
        States of the motion.
    background : Drift, optional
        What all channels have besides.

    Attributes
    ----------
    errors : SensorErrors
        The lasting errors of the array's sensors, and the background.
    pose_errors : PoseErrors
        Those of its pose and of the ambient field, behind them.
    """

    def __init__(self, array: SensorArray, n_motion: int, background: Drift | None = None) -> None:
        self.errors = SensorErrors.of(array, background)
        self.pose_errors = PoseErrors.of_array(array)
        self._lever_arm_m = np.array(self.pose_errors.uncertainty.lever_arm_m)
        self._array = without_lasting_errors(array)
        self._noise_varies = self._array.noise_depends_on_reading
        self._n_motion = n_motion
        self._differences: dict[bytes, Differences] = {}

    def of(self, row: Row) -> RowMeasurement:
        """What a row's readings say of the state."""
        array = self._array
        if row.ambient_T is not None:
            array = array.in_ambient_field(row.ambient_T)
        differences = self.differences(row)
        sigma = np.sqrt(differences.variance)
        pose = row.pose(self._lever_arm_m)
        of_errors = self.errors.effect(array, row.readings_T, row.time_s, pose.rate_rad_s)
        effect = differences.transform @ of_errors / sigma[:, None]
        of_pose = self.pose_errors.effect(pose, row.pose_sigma)
        model = DifferenceMeasurement(array, differences)
        return RowMeasurement(model, sigma, row, self._n_motion, effect, pose, of_pose)

    def differences(self, row: Row) -> Differences:
        """The independent differences that a row's readings give."""
        available = np.isfinite(row.readings_T)
        if self._noise_varies:
            covariance = reading_covariance(self._array, row.readings_T)
            return decorrelated_differences(self._array, available, covariance_T2=covariance)
        key = available.tobytes()
        if key not in self._differences:
            self._differences[key] = decorrelated_differences(self._array, available)
        return self._differences[key]


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Six coordinates of a state, to first order its position and moment where errors are held; the others stay.

    Attributes
    ----------
    centre : ndarray, shape (n,)
        The state that they are counted from.
    function, jacobian : callable
        What bends as they do: (n,) -> (k,), and its derivative (k, n).
    M : ndarray, shape (6, k)
        They are M times its change.
    value, J : ndarray, shapes (k,) and (6, n)
        At the centre: of the function, and the derivative of the coordinates.
    """

    centre: FloatArray
    function: MeasurementFunction
    jacobian: MeasurementFunction
    M: FloatArray
    value: FloatArray
    J: FloatArray

    def at(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coordinates (6,) of a state (n,), and their derivative (6, n)."""
        if np.array_equal(state, self.centre):
            return np.zeros(N_SOURCE), self.J
        return self.M @ (self.function(state) - self.value), self.M @ self.jacobian(state)
