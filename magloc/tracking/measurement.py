r"""What one row measures of a tracked source, and the coordinates in which a prediction of it is Gaussian.

What earlier rows told of a source is nearly Gaussian in what they measured, not in position and moment: of a weak
source the direction and the moment are known only together, along a curve. Far rows measure nearly the same functions
of the source as the present one, so the prediction is taken to be Gaussian in

.. math:: c(x) = M (h(x) - h(x_0)), \qquad M H(x_0) = I

with the predicted differences h of the source in units of their noise, their Jacobian H, and the predicted state
:math:`x_0`: to first order c is position and moment, and to second order it bends as the readings do. A filter in
Cartesian coordinates believes itself too much while it learns of a source at rest: every row is linearised elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.differences import Differences, decorrelated_differences
from arrays.noise import reading_covariance
from arrays.typing import FloatArray
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.nuisances import SensorErrors, without_lasting_errors
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import Row

LEAST_SINGULAR = 1e-6
"""A row has no coordinates of its own if a column of its Jacobian, in units of what is known, is so near to others."""


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
        States of the motion; behind them stand the sensors' errors.
    effect : ndarray, shape (k, n_errors)
        Of the sensors' errors on the differences, in units of their noise.
    """

    model: DifferenceMeasurement
    sigma: FloatArray
    row: Row
    n_motion: int
    effect: FloatArray

    @cached_property
    def z(self) -> FloatArray:
        """Measured differences, shape (k,)."""
        return self.model.measured(self.row.readings_T) / self.sigma

    def of_source(self, source: FloatArray) -> FloatArray:
        """Predicted differences (k,) of a source (6,), all sensors being without errors."""
        return self.model.predicted(*self._in_array(source)) / self.sigma

    def source_jacobian(self, source: FloatArray) -> FloatArray:
        """Their Jacobian (k, 6)."""
        H = self.model.jacobian(*self._in_array(source)) / self.sigma[:, None]
        R = self.row.R_world_from_array
        return np.concatenate([H[:, :3] @ R.T, H[:, 3:] @ R.T], axis=1)

    def predicted(self, state: FloatArray) -> FloatArray:
        """Predicted differences (k,) of a state (n,)."""
        return self.of_source(state[:N_SOURCE]) + self.effect @ state[self.n_motion :]

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Their Jacobian (k, n)."""
        full = np.zeros((len(self.sigma), state.size))
        full[:, :N_SOURCE] = self.source_jacobian(state[:N_SOURCE])
        full[:, self.n_motion :] = self.effect
        return full

    def coordinates(self, source: FloatArray, unit: FloatArray) -> Coordinates:
        """Coordinates about a source (6,), where `unit` (6,) is what is known of its components."""
        H = self.source_jacobian(source)
        M: FloatArray | None = None
        if len(H) >= N_SOURCE:
            Q, R = np.linalg.qr(H * unit)
            diagonal = np.abs(np.diagonal(R))
            if diagonal.min() > LEAST_SINGULAR * diagonal.max():
                M = unit[:, None] * np.linalg.solve(R, Q.T)
        return Coordinates(self, source, M)

    def curved_prior(self, x: FloatArray, S: FloatArray) -> Callable[[FloatArray], tuple[FloatArray, FloatArray]]:
        """A prediction (x, S) that is Gaussian in the coordinates about it.

        It gives, of a state, mean (n,) and square root (n, n) of the Gaussian that looks there as the prediction does.
        """
        source = slice(0, N_SOURCE)
        coordinates = self.coordinates(x[source], np.linalg.norm(S[source], axis=1))

        def prior(state: FloatArray) -> tuple[FloatArray, FloatArray]:
            c, J = coordinates.at(state[source])
            mean, root = x.copy(), S.copy()
            try:
                mean[source] = state[source] - np.linalg.solve(J, c)
                root[source] = np.linalg.solve(J, S[source])
            except np.linalg.LinAlgError:
                return x, S
            return mean, root

        return prior

    def _in_array(self, source: FloatArray) -> tuple[FloatArray, FloatArray]:
        R = self.row.R_world_from_array
        return R.T @ (source[:3] - self.row.origin_m), R.T @ source[3:]


class RowMeasurements:
    """What the rows of an array measure, without the noise that lasts: that is the states behind those of the motion.

    Parameters
    ----------
    array : SensorArray
    n_motion : int
        States of the motion.

    Attributes
    ----------
    errors : SensorErrors
        The lasting errors of the array's sensors.
    """

    def __init__(self, array: SensorArray, n_motion: int) -> None:
        self.errors = SensorErrors.of(array)
        self._array = without_lasting_errors(array)
        self._n_motion = n_motion
        self._differences: dict[bytes, Differences] = {}

    def of(self, row: Row) -> RowMeasurement:
        """What a row's readings say of the state."""
        array = self._array
        if row.ambient_T is not None:
            x, y, z = row.ambient_T.tolist()
            array = replace(array, ambient_T=(x, y, z))
        differences = self.differences(row)
        sigma = np.sqrt(differences.variance)
        effect = differences.transform @ self.errors.effect(array, row.readings_T) / sigma[:, None]
        return RowMeasurement(DifferenceMeasurement(array, differences), sigma, row, self._n_motion, effect)

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


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Coordinates of a source in which the readings of a row are linear.

    Attributes
    ----------
    measurement : RowMeasurement
    centre : ndarray, shape (6,)
        The source that they are counted from.
    M : ndarray, shape (6, k), optional
        None: the row does not determine a source, and they are position and moment.
    """

    measurement: RowMeasurement
    centre: FloatArray
    M: FloatArray | None

    def at(self, source: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Coordinates (6,) of a source (6,), and their derivative (6, 6)."""
        if self.M is None or np.array_equal(source, self.centre):
            return source - self.centre, np.eye(N_SOURCE)
        difference = self.measurement.of_source(source) - self.measurement.of_source(self.centre)
        return self.M @ difference, self.M @ self.measurement.source_jacobian(source)
