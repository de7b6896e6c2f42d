"""Result of a calibration of a body and an array, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.typing import BoolArray, FloatArray
from magloc.bodies.body import MagnetBody
from magloc.calibration.results import Calibration

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of rows that were held out of a calibration and located with it.

    Attributes
    ----------
    chi2, dof : float
        χ² of these rows with the calibration of the other rows, only their poses being fitted.
    error_m, error_rad : ndarray, shape (n,)
        Distance and angle between the poses found and the known ones [m], [rad]; empty without known poses.
    """

    chi2: float
    dof: float
    error_m: FloatArray
    error_rad: FloatArray

    @property
    def json(self) -> dict[str, Any]:
        """Entries of ``magloc calibrate --json``."""
        report: dict[str, Any] = {"chi2": self.chi2, "dof": self.dof, "rows": len(self.error_m)}
        for name, errors in (("m", self.error_m), ("rad", self.error_rad)):
            values = np.quantile(errors, (0.5, 0.9, 1.0)).tolist() if len(errors) else (None,) * 3
            report |= dict(zip((f"median_{name}", f"p90_{name}", f"worst_{name}"), values, strict=True))
        return report


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyCalibration(Calibration):
    """A calibration of an array's sensors and a body's magnets together.

    The standard deviations include directions that the readings cannot show (`unobservable`), with the prior's values.
    The calibrated array and body state smaller ones, without these directions, because a common change of array and
    body has no effect on the readings.

    Attributes
    ----------
    nominal_body, body : MagnetBody
        Body before and after.
    magnet_change, magnet_sigma : ndarray, shape (K, 6)
        Estimated change of every magnet and its posterior standard deviation: position x y z [m] in the body's frame,
        relative strength, rotation [rad] about two axes across the moment.
    iterations : int
        Linearisations of the last and finest fit.
    rows : ndarray of bool, shape (n,)
        Rows that were used.
    chi2_before, dof_before : float
        The same with the nominal array and body, only the poses being fitted.
    rms_T : tuple of two ndarrays, shape (N,)
        Root mean square of every sensor's residuals before and after [T].
    estimated : ndarray of bool, shape (N, 15)
        True for the sensors' unknowns that were estimated.
    covariance : ndarray, shape (F + 6 K, F + 6 K)
        Posterior covariance of ``change[estimated]`` and `magnet_change`.
    position_m, rotation : ndarray, shape (T, 3), Rotation of T
        Poses of the body in the array's frame, in the rows that were used.
    far_from_prior : tuple of str
        Sensors and magnets whose change is beyond five standard deviations of the prior: dead, exchanged, or reversed.
    cross_validation : PoseErrors, optional
        Errors in rows that the calibration did not use; None where rows are too few.
    """

    nominal_body: MagnetBody
    body: MagnetBody
    magnet_change: FloatArray
    magnet_sigma: FloatArray
    iterations: int
    rows: BoolArray
    chi2_before: float
    dof_before: float
    rms_T: tuple[FloatArray, FloatArray]
    estimated: BoolArray
    covariance: FloatArray
    position_m: FloatArray
    rotation: Rotation
    far_from_prior: tuple[str, ...]
    cross_validation: PoseErrors | None = None

    @property
    def residual_rms_T(self) -> FloatArray:
        """Root mean square of every sensor's residuals with the calibrated array and body (N,) [T]."""
        return self.rms_T[1]
