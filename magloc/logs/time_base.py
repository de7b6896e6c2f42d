"""One time base for sensors with other rates and clocks, and the lag between two of them."""

from __future__ import annotations

import numpy as np

from arrays.typing import FloatArray

GAP_STEPS = 2.5
"""Length of a gap in usual steps of a sensor; nothing is interpolated across a gap."""
_LAGS = 61
_LEAST_CHI2 = 30.0  # by which the best lag explains more than others, or the sensor hardly turns


def resample(time_s: FloatArray, sample_s: FloatArray, values: FloatArray, *, sparse: bool = False) -> FloatArray:
    """Return values (n, k) at times (n,) by linear interpolation between samples (m, k); NaN in gaps and outside.

    Parameters
    ----------
    time_s : ndarray, shape (n,)
        Ascending times.
    sample_s : ndarray, shape (m,)
        Ascending times of the samples, by the same clock.
    values : ndarray, shape (m, k)
        Samples; a row with NaN counts as missing.
    sparse : bool
        Fill only the rows that are nearest to a sample, so that each sample counts once.
    """
    known = np.isfinite(values).all(axis=1)
    sample_s, values = sample_s[known], values[known]
    found = np.full((len(time_s), values.shape[1]), np.nan)
    if len(sample_s) < 2:
        return found
    longest_s = GAP_STEPS * float(np.median(np.diff(sample_s)))
    after = np.clip(np.searchsorted(sample_s, time_s), 1, len(sample_s) - 1)
    inside = (time_s >= sample_s[0]) & (time_s <= sample_s[-1])
    inside &= np.diff(sample_s)[after - 1] <= longest_s
    if sparse:
        right = np.clip(np.searchsorted(time_s, sample_s), 1, len(time_s) - 1)
        nearest = right - (sample_s - time_s[right - 1] < time_s[right] - sample_s)
        inside &= np.isin(np.arange(len(time_s)), nearest)
    columns = [np.interp(time_s[inside], sample_s, column) for column in values.T]
    found[inside] = np.column_stack(columns)
    return found


def magnetometer_lag(
    gyro_s: FloatArray,
    rate_rad_s: FloatArray,
    field_s: FloatArray,
    field_T: FloatArray,
    *,
    longest_s: float = 0.3,
) -> tuple[float, float]:
    """Return the time by which the stamps of a magnetometer are late behind those of a gyro, and its σ [s].

    In a constant ambient field the change of the reading between two samples is the turn by the gyro times the field
    without the sensor's offset. The lag has the smallest sum of squares; the offset and the gyro's bias are estimated
    with it. The deviation is infinite for a sensor that does not turn.

    Parameters
    ----------
    gyro_s, field_s : ndarray, shapes (n,) and (m,)
        Ascending times.
    rate_rad_s, field_T : ndarray, shapes (n, 3) and (m, 3)
        Readings in the same axes.
    longest_s : float
        Largest modulus of the lag.
    """
    from scipy.optimize import minimize_scalar

    steps_s = np.diff(gyro_s)
    turn_rad = np.concatenate(
        [np.zeros((1, 3)), np.cumsum(0.5 * (rate_rad_s[1:] + rate_rad_s[:-1]) * steps_s[:, None], 0)]
    )
    usable = (field_s > gyro_s[0] + longest_s) & (field_s < gyro_s[-1] - longest_s) & np.isfinite(field_T).all(axis=1)
    time_s, field = field_s[usable], field_T[usable]
    if len(time_s) < 10:
        return 0.0, np.inf
    usual = np.diff(time_s) <= GAP_STEPS * np.median(np.diff(time_s))
    change, middle = np.diff(field, axis=0)[usual], (0.5 * (field[1:] + field[:-1]))[usual]

    step_of_field_s = np.diff(time_s)[usual, None, None]
    of_bias = np.concatenate([np.cross(np.eye(3), middle[:, None]), np.tile(np.eye(3), (len(middle), 1, 1))], axis=1)
    of_bias *= step_of_field_s  # and of the product of bias and offset

    def residuals(lag_s: float) -> FloatArray:
        """Return the part of the change (m, 3) that neither the turn nor offset and bias explain."""
        at = np.column_stack([np.interp(time_s - lag_s, gyro_s, axis) for axis in turn_rad.T])
        step = np.diff(at, axis=0)[usual]
        rest = change + np.cross(step, middle)
        columns = (
            np.concatenate([np.cross(step[:, None], np.eye(3)), of_bias], axis=1).transpose(0, 2, 1).reshape(-1, 9)
        )
        fitted = np.linalg.lstsq(columns.T @ columns, columns.T @ rest.ravel(), rcond=1e-12)[0]
        return np.asarray(rest - (columns @ fitted).reshape(rest.shape))

    def loss(lag_s: float) -> float:
        return float(np.sum(residuals(lag_s) ** 2))

    lags = np.linspace(-longest_s, longest_s, _LAGS)
    sums = np.array([loss(lag_s) for lag_s in lags])
    if np.median(sums) - sums.min() < _LEAST_CHI2 * sums.min() / change.size:
        return 0.0, np.inf
    coarse_s = float(lags[int(np.argmin(sums))])
    spacing_s = float(lags[1] - lags[0])
    fine = minimize_scalar(loss, bounds=(coarse_s - spacing_s, coarse_s + spacing_s), method="bounded")
    lag_s, step_s = float(fine.x), float(np.median(steps_s))
    slope = (residuals(lag_s + step_s) - residuals(lag_s - step_s)) / (2.0 * step_s)
    information = float(np.sum(slope**2))
    if not information > 0.0:
        return 0.0, np.inf
    # The errors of two changes that share a sample are not independent.
    noise_T = np.sqrt(0.5 * np.mean(residuals(lag_s) ** 2))
    of_samples = np.diff(slope, axis=0, prepend=0.0, append=0.0)
    return lag_s, float(noise_T * np.linalg.norm(of_samples) / information)
