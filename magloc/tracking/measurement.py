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
from magloc.measurement.differences import DifferenceMeasurement
from magloc.measurement.nuisances import SensorErrors, without_lasting_errors
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
        States of the motion; behind them stand the sensors' errors.
    channel_effect : ndarray, shape (C, n_errors)
        Of the sensors' errors on the channels [T].
    """

    model: DifferenceMeasurement
    sigma: FloatArray
    row: Row
    n_motion: int
    channel_effect: FloatArray

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

    @cached_property
    def effect(self) -> FloatArray:
        """Of the sensors' errors on the differences, in units of their noise: (k, n_errors)."""
        return (self.model.differences.transform / self.sigma[:, None]) @ self.channel_effect

    def effect_on(self, roots: FloatArray) -> FloatArray:
        """Products ``effect @ roots`` (K, k, m) with matrices (K, n_errors, m): every channel has a few errors only."""
        from scipy.sparse import csr_array

        sparse, transform = csr_array(self.channel_effect), self.model.differences.transform / self.sigma[:, None]
        return np.stack([transform @ (sparse @ root) for root in roots])

    def of_source(self, source: FloatArray) -> FloatArray:
        """Predicted differences (..., k) of sources (..., 6), all sensors being without errors."""
        return self.model.predicted(*self._in_array(source)) / self.sigma

    def source_jacobian(self, source: FloatArray) -> FloatArray:
        """Their Jacobian (..., k, 6)."""
        H = self.model.jacobian(*self._in_array(source)) / self.sigma[:, None]
        RT = self.row.R_world_from_array.T
        return np.concatenate([H[..., :3] @ RT, H[..., 3:] @ RT], axis=-1)

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Jacobian (k, n) of all differences by a Cartesian state (n,) with its errors."""
        full = np.zeros((len(self.sigma), state.size))
        full[:, :N_SOURCE] = self.source_jacobian(state[:N_SOURCE])
        full[:, self.n_motion :] = self.effect
        return full

    @cached_property
    def without_source(self) -> FloatArray:
        """What is left of the measured differences (k,) when the ambient field's own are taken out."""
        array = self.model.array
        ambient = array.readings_of(array.ambient_fields) - array.channel_offset_T
        return self.z - (self.model.differences.transform @ ambient) / self.sigma

    def whitening(self, sigma_errors: FloatArray) -> FloatArray | None:
        """``C^{-1/2}`` (k, k) of a row whose errors are known by their standard deviations (n_errors,) alone."""
        if not sigma_errors.size:
            return None
        lasting = self.effect * sigma_errors
        return np.linalg.inv(np.linalg.cholesky(np.eye(len(lasting)) + lasting @ lasting.T))

    def is_detected(self, sigma_errors: FloatArray) -> bool:
        """Whether the differences stand out of noise and of what the sensors' errors may make of them."""
        if not self.z.size:
            return False
        whiten = self.whitening(sigma_errors)
        left = self.without_source if whiten is None else whiten @ self.without_source
        return bool(left @ left > energy_threshold(left.size))

    def _in_array(self, source: FloatArray) -> tuple[FloatArray, FloatArray]:
        R = self.row.R_world_from_array
        return (source[..., :3] - self.row.origin_m) @ R, source[..., 3:] @ R


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
    n_differences : int
        Independent differences of a row whose readings are all there.
    """

    def __init__(self, array: SensorArray, n_motion: int) -> None:
        self.errors = SensorErrors.of(array)
        self.n_differences = decorrelated_differences(array).n_differences
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
        effect = self.errors.effect(array, row.readings_T)
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
