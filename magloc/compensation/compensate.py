"""Compensation of a log: the order of the steps."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline

from arrays.array import SensorArray
from arrays.sensor import Sensor
from arrays.typing import FloatArray
from magloc.compensation.attitude import Attitude, ambient_at, attitude_effects, currents_at, platform_moduli
from magloc.compensation.doubts import correction_doubts, fit_doubts, log_doubts, mismatch_doubts
from magloc.compensation.fit import PlatformFit, fit_platform
from magloc.compensation.log import PlatformLog, columns_of
from magloc.compensation.results import Compensation, SensorCompensation
from magloc.compensation.terms import CURRENT_T, PlatformTerms
from magloc.readings import Readings

_STEP_S = 0.05  # longest step between times at which the correction is computed; between them it is interpolated


def compensate(
    array: SensorArray,
    readings: Readings,
    *,
    calibration: Readings | None = None,
    currents: Mapping[str, ArrayLike] | None = None,
    calibration_currents: Mapping[str, ArrayLike] | None = None,
    current_sigma_T: float = CURRENT_T,
) -> Compensation:
    """Remove the field of the platform from the readings of sensors that move with it.

    The platform adds a permanent field, an induced field, and fields of eddy currents and measured currents (Tolles
    and Lawson). Their coefficients at each sensor are fitted to the modulus of the field, together with a slow
    background. Their priors are ``offset_uncertainty_T``, ``induced_uncertainty`` and ``eddy_uncertainty_s`` of the
    sensor, or wide ones if all are zero.

    Parameters
    ----------
    array : SensorArray
        Sensors with their noise and the priors of their platform.
    readings : Readings
        Log to correct. The attitude is by the vector sensor with the least noise, or by the pose, which needs the
        ambient field of every row.
    calibration : Readings, optional
        Log of a calibration flight that the coefficients are fitted to; by default the log itself.
    currents : mapping of str to array-like of shape (n,), optional
        Currents of loads in every row of the log, by name, in any unit.
    calibration_currents : mapping of str to array-like, optional
        The same for the calibration.
    current_sigma_T : float
        Prior standard deviation of each component of the field per unit of a current [T].

    Returns
    -------
    Compensation
        Coefficients with σ, figures of merit, flags, and corrected readings.

    Raises
    ------
    ValueError
        The readings are too few, not in order of time, or do not determine the attitude.

    Examples
    --------
    >>> import magloc
    >>> drone = magloc.datasets.load("drone")
    >>> found = magloc.compensate(drone.array, drone.readings)
    >>> found.values_T.shape == drone.readings.values_T.shape
    True
    """
    names = tuple(currents or ())
    is_same = calibration is None
    flown = readings if calibration is None else calibration
    own = columns_of(currents if is_same else calibration_currents, names, len(flown))
    mean = np.nan_to_num(own).sum(axis=0) / np.maximum(np.isfinite(own).sum(axis=0), 1)
    log = PlatformLog.of(array, flown, own - mean)
    terms = {sensor.id: PlatformTerms.of(sensor, names, current_sigma_T) for sensor in array.sensors}
    fits = _fit_all(log, terms)
    sensors = tuple(SensorCompensation.of(name, fit, log.turning_at(fit.rows.time_s)) for name, fit in fits.items())
    flags = [*log_doubts(log), *(doubt for of in sensors for doubt in fit_doubts(of, log))]
    if not is_same:
        log = PlatformLog.of(array, readings, columns_of(currents, names, len(readings)) - mean)
        flags += [f"{doubt} (log)" for doubt in log_doubts(log)]
    values, sigma = _corrected(log, fits)
    for of in sensors:
        flags += correction_doubts(of, sigma[:, array.ids.index(of.sensor)])
        flags += mismatch_doubts(of.sensor, log, values)
    return Compensation(array, sensors, readings.time_s, values, sigma, tuple(flags))


def _fit_all(log: PlatformLog, terms: Mapping[str, PlatformTerms]) -> dict[str, PlatformFit]:
    """Return the fits of all sensors, in their order; vector sensors first, because one of them gives the attitude."""
    fits = {}
    for sensor in log.array.sensors:
        if sensor.kind == "vector" and log.signals[sensor.id].stretches:
            fits[sensor.id] = fit_platform(log.rows_of(sensor, log.attitude_of(sensor)), terms[sensor.id])
    if log.array.channel_is_scalar.any():
        attitude = _attitude(log, fits)
        for sensor in log.array.sensors:
            if sensor.kind == "scalar":
                fits[sensor.id] = fit_platform(log.rows_of(sensor, attitude), terms[sensor.id])
    return {name: fits[name] for name in log.array.ids if name in fits}


def _attitude(log: PlatformLog, fits: Mapping[str, PlatformFit]) -> Attitude:
    """Return the attitude for scalar sensors, without the platform's field at the vector sensor that gives it."""
    compass = log.compass
    if compass is None:
        return log.attitude_of_pose()
    fit = fits[compass.id]
    return log.attitude_of(compass).without(fit.terms, fit.coefficients, log.currents, fit.covariance)


def _corrected(log: PlatformLog, fits: Mapping[str, PlatformFit]) -> tuple[FloatArray, FloatArray]:
    """Return corrected readings (n, C), and the standard deviations (n, N) of the changes of the correction."""
    array, time_s = log.array, log.readings.time_s
    values, sigma = np.full_like(log.readings.values_T, np.nan), np.full((len(time_s), array.n_sensors), np.nan)
    attitude = _attitude(log, fits) if array.channel_is_scalar.any() else None
    step = max(1, int(_STEP_S / float(np.median(np.diff(time_s)))))
    coarse_s = time_s[::step]
    for i, sensor in enumerate(array.sensors):
        fit = fits.get(sensor.id)
        if fit is None or not log.signals[sensor.id].stretches:
            continue
        channels = np.flatnonzero(array.channel_sensor == i)
        gain = array.channel_gain[channels]
        if sensor.kind == "vector":
            used = log.attitude_of(sensor).without(fit.terms, fit.coefficients, log.currents)
        else:
            assert attitude is not None
            used = attitude
        coarse = np.column_stack(_correction(log, sensor, fit, used, coarse_s))
        h, along, effect, deviation = np.split(_between(coarse_s, coarse, time_s), [3, 6, 7], axis=1)
        jumps = log.jumps @ fit.terms.current_fields(fit.coefficients)
        if sensor.kind == "vector":
            change = log.factors[sensor.id] * (h + jumps) @ gain.T
        else:
            change = (effect + np.sum(along * jumps, axis=1, keepdims=True)) * gain[:, :1].T
        values[:, channels] = log.readings.values_T[:, channels] - change
        sigma[:, i] = deviation[:, 0]
    return values, sigma


def _correction(
    log: PlatformLog, sensor: Sensor, fit: PlatformFit, attitude: Attitude, time_s: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the platform's field and the unit vector of the total (n, 3), the effect on the modulus, and its σ (n,).

    A fast change of a current changes the modulus by its component along the total field.
    """
    sampled_s, samples = log.signals[sensor.id].samples()
    known = np.isfinite(attitude.at(sampled_s + fit.lag_s)[0]).all(axis=1)
    known &= np.isfinite(currents_at(log.currents, sampled_s)).all(axis=1)
    if known.sum() < 2:
        nothing = np.full((len(time_s), 3), np.nan)
        return nothing, nothing, nothing[:, 0], nothing[:, 0]
    sampled_s, read = sampled_s[known], np.linalg.norm(samples[known], axis=1)
    flowing, modulus = currents_at(log.currents, sampled_s), read
    for _ in range(2):
        field, rate = ambient_at(attitude, sampled_s, modulus, fit.lag_s)
        modulus = read - platform_moduli(fit.terms, fit.coefficients, field, rate, flowing)[0]
    unit, turning = attitude.at(time_s + fit.lag_s)
    size = np.interp(time_s, sampled_s, np.linalg.norm(field, axis=1))[:, None]
    field, rate, currents = unit * size, turning * size, currents_at(log.currents, time_s)
    own = time_s if sensor.kind == "vector" else None
    effect, columns = platform_moduli(fit.terms, fit.coefficients, field, rate, currents, own)
    errors = attitude_effects(attitude, time_s, fit.terms, fit.coefficients, field, rate, currents)
    effect = effect + errors @ fit.mean[len(fit.coefficients) :]
    columns = np.column_stack([columns, errors])
    changes = columns - np.nanmean(columns, axis=0)
    variance = np.einsum("nq,qr,nr->n", changes, fit.joint_covariance, changes)
    h = fit.terms.fields(field, rate, currents) @ fit.coefficients
    total = field + h
    along = total / np.linalg.norm(total, axis=1, keepdims=True)
    return h, along, effect, np.sqrt(np.maximum(variance, 0.0))


def _between(coarse_s: FloatArray, values: FloatArray, time_s: FloatArray) -> FloatArray:
    """Return values (k, m) at some times, interpolated to others; NaN for unknown ones."""
    if len(coarse_s) == len(time_s):
        return values
    known = np.isfinite(values).all(axis=1)
    if known.sum() < 2:
        return np.full((len(time_s), values.shape[1]), np.nan)
    out = CubicSpline(coarse_s[known], values[known])(time_s)
    near = np.interp(time_s, coarse_s, known.astype(np.float64))
    out[(near < 1.0) | (time_s > coarse_s[known][-1])] = np.nan
    return np.asarray(out)
