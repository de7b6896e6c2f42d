"""Calibration by a source on any path, or by turning in a field of known modulus."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.calibration.array import CalibrationPrior, calibrate_on_path, self_calibrate
from magloc.calibration.modulus import EllipsoidCalibration, calibrate_in_modulus, symmetric
from magloc.calibration.observability import Unobservable
from magloc.calibration.results import SourceCalibration, TurningCalibration
from magloc.calibration.sensors import GAINS, PER_SENSOR, unknowns
from magloc.measurement.plausibility import warn_of_array, warn_of_moments
from magloc.measurement.rows import check_magnitudes
from magloc.readings import Readings, without_saturated
from magloc.truth import Truth, rows_of_same_time


def calibrate(
    array: SensorArray,
    readings: Readings,
    *,
    truth: Truth | None = None,
    modulus_T: ArrayLike | None = None,
    moment: Literal["constant", "free"] | None = None,
    prior: CalibrationPrior = CalibrationPrior(),
) -> SourceCalibration | TurningCalibration:
    """Calibrate vector sensors by a moving source, or by turning them in a known modulus.

    With `truth` the path of the source is known. Without it the path is estimated with the sensors. A displacement, a
    rotation or another scale of the whole array then has no effect on the readings; there the prior or the trusted
    sensors decide. A mirror image, all sensors and the path inverted through one point, fits equally well; the nominal
    array decides between the two. With `modulus_T` there is no source: every sensor was turned in a uniform field,
    which determines its gains, the angles between its axes and its offsets, but not how it is mounted.

    Parameters
    ----------
    array : SensorArray
        Nominal array; its noise weights the readings.
    readings : Readings
        Readings that saturate do not count.
    truth : Truth, optional
        Path of the source in the readings' frame; rows of the same time are used. A missing z is one unknown height for
        all rows. Moments, where it has them, are taken as known; where it has their directions, one strength is
        estimated. Its `sigma_m` counts.
    modulus_T : array_like, shape () or (n,), optional
        Modulus of the field in which the sensors were turned [T].
    moment : {"constant", "free"}, optional
        Model of an unknown moment: one vector in the world frame (a source that does not turn), or free in every row.
        Moments of the truth are then not used. Constant by default.
    prior : CalibrationPrior
        Uncertainty of the nominal array; not used with `modulus_T`.

    Returns
    -------
    SourceCalibration or TurningCalibration
        The latter with `modulus_T`. If it did not converge, no number in it is a result.

    Raises
    ------
    ValueError
        The shapes do not agree, the array has scalar sensors (with `modulus_T`: no vector sensor), truth and readings
        have no common time, no row can be located with the nominal array, or there are fewer readings than unknowns.

    Examples
    --------
    >>> import magloc
    >>> board = magloc.datasets.load("board")
    >>> prior = magloc.CalibrationPrior(estimate=("offsets",), offset_T=1e-6)
    >>> rows = board.readings[::10]
    >>> calibration = magloc.calibrate(board.array, rows, truth=board.truth, prior=prior)
    >>> calibration.converged, calibration.sigma.shape
    (True, (30, 15))
    """
    check_magnitudes(array)
    warn_of_array(array)
    rows = without_saturated(readings, array)
    if modulus_T is not None:
        if truth is not None or moment is not None:
            raise ValueError("Input modulus_T must come without truth and moment: there is no source.")
        return _calibrate_by_turning(array, rows, np.asarray(modulus_T, dtype=np.float64))
    try:
        result = calibrate_by_source(array, rows, truth, moment, prior)
    except np.linalg.LinAlgError:
        raise ValueError(
            "Input readings must be those of a source that passes the sensors at a distance; instead the model cannot"
            " place it (on a sensor, or at infinity)."
        ) from None
    warn_of_moments(np.linalg.norm(result.position_m - result.array.centroid, axis=1), result.moment_Am2)
    return result


def calibrate_by_source(
    array: SensorArray,
    rows: Readings,
    truth: Truth | None,
    moment: Literal["constant", "free"] | None,
    prior: CalibrationPrior,
) -> SourceCalibration:
    """Calibrate by a moving source, with the parameters of :func:`calibrate` and without warnings."""
    model = moment or "constant"
    attitude = _world_from_array(rows)
    if truth is None:
        return self_calibrate(array, rows.values_T, moment=model, prior=prior, world_from_array=attitude)
    in_readings, in_truth = rows_of_same_time(rows, truth)
    if not in_readings.size:
        raise ValueError("Input truth must have times of the readings; instead it has none of them.")
    position = truth.position_m[in_truth].copy()
    unknown = np.isnan(position[:, 2])
    position[unknown, 2] = 0.0
    if rows.pose is not None:
        position = np.einsum("tba,tb->ta", attitude[in_readings], position - rows.pose[0][in_readings])
    known = moment is None
    return calibrate_on_path(
        array,
        rows.values_T[in_readings],
        position,
        position_sigma_m=None if truth.sigma_m is None else truth.sigma_m[in_truth],
        moment_Am2=truth.moment_Am2[in_truth] if known and truth.moment_Am2 is not None else None,
        axis=truth.axis[in_truth] if known and truth.axis is not None else None,
        moment=model,
        unknown_height=bool(np.isnan(truth.position_m[:, 2]).any()),
        prior=prior,
        world_from_array=attitude[in_readings],
    )


def _world_from_array(readings: Readings) -> FloatArray:
    """Return the attitude of the array in every row (n, 3, 3); identity without a pose."""
    if readings.pose is None:
        return np.broadcast_to(np.eye(3), (len(readings), 3, 3))
    return readings.pose[1].as_matrix()


def _calibrate_by_turning(nominal: SensorArray, rows: Readings, modulus_T: FloatArray) -> TurningCalibration:
    array, fits = calibrate_in_modulus(nominal, rows.values_T, modulus_T)
    change, sigma = np.zeros((2, nominal.n_sensors, PER_SENSOR))
    for i, (before, after) in enumerate(zip(nominal.sensors, array.sensors, strict=True)):
        if before.id not in fits:
            continue
        if fits[before.id].converged:
            old, new = (np.asarray(sensor.calibration.scale) for sensor in (before, after))
            offsets = np.subtract(after.calibration.offset_T, before.calibration.offset_T)
            change[i] = unknowns(1, response=new @ np.linalg.inv(old) - np.eye(3), offset=offsets)[0]
            sigma[i] = _sigma(fits[before.id], old, new)
        else:
            sigma[i, GAINS.start :] = np.inf
    return TurningCalibration(
        nominal=nominal,
        array=array,
        converged=all(fit.converged for fit in fits.values()),
        change=change,
        sigma=sigma,
        chi2=sum(fit.chi2 for fit in fits.values()),
        dof=sum(fit.dof for fit in fits.values()),
        unobservable=tuple(Unobservable(f"rotation of sensor {name}", 0.0) for name in fits),
        fits=fits,
        time_s=rows.time_s,
        readings_T=rows.values_T,
        modulus_T=modulus_T,
    )


def _sigma(fit: EllipsoidCalibration, old: FloatArray, new: FloatArray) -> FloatArray:
    """Return the standard deviations (15,) of a sensor's change.

    With S = P R the change E = S S₀⁻¹ - 1 varies by dP R S₀⁻¹.
    """
    by_entry = np.stack([symmetric(unit) for unit in np.eye(6)]) @ (np.linalg.inv(fit.scale) @ new @ np.linalg.inv(old))
    variance = np.einsum("eab,ef,fab->ab", by_entry, fit.covariance[3:, 3:], by_entry)
    return unknowns(1, response=np.sqrt(variance), offset=np.sqrt(np.diagonal(fit.covariance)[:3]))[0]
