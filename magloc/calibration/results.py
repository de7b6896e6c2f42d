"""Results of a calibration, with their uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from arrays.array import SensorArray
from arrays.io.results import Drawn
from arrays.typing import BoolArray, FloatArray
from magloc.calibration.modulus import EllipsoidCalibration
from magloc.calibration.observability import Unobservable
from magloc.fields import dipole


@dataclass(frozen=True, eq=False, kw_only=True)
class Calibration(Drawn):
    """A calibrated array, with its uncertainty.

    Attributes
    ----------
    nominal, array : SensorArray
        Array before and after; the latter has the estimated positions, scale matrices and offsets.
    converged : bool
        True if the iteration ended at an optimum. Otherwise no number here is a result.
    change, sigma : ndarray, shape (N, 15)
        Estimated change of the nominal array, and its posterior standard deviation: position x y z [m], relative gain
        of channel x y z, axes [rad] (x towards y, x towards z, y towards x, …), offset x y z [T]. The standard
        deviation is 0 for quantities that are not estimated, and infinite if the readings do not determine a sensor.
    chi2, dof : float
        Σ ((reading - prediction)/noise)² with the calibrated sensors, and the number of readings minus that of the
        unknowns that they determine.
    unobservable : tuple of Unobservable
        Directions that the readings do not determine; there the estimate is the nominal array.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> from scipy.spatial.transform import Rotation
    >>> sensor = arrays.SensorArray([arrays.Sensor("s1", "vector", (0.0, 0.0, 0.0), 1e-9)])
    >>> turned = magloc.Readings(1.02 * Rotation.random(100, 0).apply([0.0, 20e-6, -43e-6]))
    >>> calibration = magloc.calibrate(sensor, turned, modulus_T=47.424e-6)
    >>> calibration.converged, round(calibration.array.sensors[0].calibration.scale[0][0], 3)
    (True, 1.02)
    """

    figure = "magloc.plots.calibrations:calibration"

    nominal: SensorArray
    array: SensorArray
    converged: bool
    change: FloatArray
    sigma: FloatArray
    chi2: float
    dof: float
    unobservable: tuple[Unobservable, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class SourceCalibration(Calibration):
    """A calibration by a source that moves past the array.

    Attributes
    ----------
    iterations : int
        Linearisations of the last and finest fit.
    rows : ndarray of bool, shape (n,)
        Rows that were used.
    chi2_before, dof_before : float
        The same for the nominal sensors, with the source fitted again and the noise of the calibrated array. Both χ²
        include the prior of ``common_field_T``. In `dof` an unknown of a sensor counts by the share that the readings,
        not the prior, determine.
    residual_rms_T : ndarray, shape (N,)
        Root mean square of every sensor's residuals with the calibrated array [T].
    estimated : ndarray of bool, shape (N, 15)
        True for the unknowns that were estimated.
    covariance : ndarray, shape (F, F)
        Posterior covariance of ``change[estimated]``.
    position_m, moment_Am2 : ndarray, shape (T, 3)
        Position of the source in the array's frame, and its moment in the world frame, in the rows that were used.
    readings_T, world_from_array : ndarray, shape (T, C), (T, 3, 3)
        Readings of these rows [T], and the array's attitude.
    """

    iterations: int
    rows: BoolArray
    chi2_before: float
    dof_before: float
    residual_rms_T: FloatArray
    estimated: BoolArray
    covariance: FloatArray
    position_m: FloatArray
    moment_Am2: FloatArray
    readings_T: FloatArray
    world_from_array: FloatArray

    @cached_property
    def rms_T(self) -> tuple[FloatArray, FloatArray]:
        """Residual RMS (N,) of the sensors before and after [T], with the best common field."""
        attitude = self.world_from_array
        moment = np.einsum("tba,tb->ta", attitude, np.broadcast_to(self.moment_Am2, (len(attitude), 3)))
        before, after = (
            residual_rms(array, self.readings_T, self.position_m, moment) for array in (self.nominal, self.array)
        )
        return before, after


@dataclass(frozen=True, eq=False, kw_only=True)
class TurningCalibration(Calibration):
    """A calibration of sensors that were turned in a field of known modulus.

    Attributes
    ----------
    fits : dict
        Fits of the vector sensors, by their ids.
    time_s, readings_T : ndarray, shape (n,), (n, C)
        Times [s] and readings [T] of the rows.
    modulus_T : float or ndarray, shape (n,)
        Modulus of the field.
    """

    fits: dict[str, EllipsoidCalibration]
    time_s: FloatArray
    readings_T: FloatArray
    modulus_T: float | FloatArray

    @cached_property
    def moduli_T(self) -> tuple[FloatArray, FloatArray]:
        """Moduli that the vector sensors read, shape (n, V), before and after [T]."""
        vector = [i for i, sensor in enumerate(self.nominal.sensors) if sensor.kind == "vector"]
        before, after = (
            np.linalg.norm(array.calibrated_field(self.readings_T)[:, vector], axis=-1)
            for array in (self.nominal, self.array)
        )
        return before, after


def residual_rms(
    array: SensorArray, readings_T: FloatArray, position_m: FloatArray, moment_Am2: FloatArray
) -> FloatArray:
    """Return the residual RMS (N,) of the sensors [T].

    The residuals are from a known source and the common field that fits best.
    """
    fields = dipole.field(array.positions, position_m[:, None], moment_Am2[:, None])
    residual = readings_T - array.readings_of(fields)
    noise, gain = array.channel_noise_T, array.channel_gain
    for i, of_row in enumerate(residual):
        known = np.isfinite(of_row)
        common, *_ = np.linalg.lstsq(gain[known] / noise[known, None], of_row[known] / noise[known], rcond=None)
        residual[i] = of_row - gain @ common
    squares = (residual**2).reshape(len(residual), -1, 3)
    counts = np.isfinite(squares).sum(axis=(0, 2))
    return np.sqrt(np.nansum(squares, axis=(0, 2)) / np.maximum(counts, 1))
