"""Doubts about a compensation: units, axes, lags, magnets that were switched, attitudes that were not flown."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.stats import chi2

from arrays.typing import FloatArray
from magloc.compensation.figure_of_merit import BAND_S, HEADINGS
from magloc.compensation.fit import FEWEST_ROWS, Background, PlatformFit
from magloc.compensation.log import PlatformLog
from magloc.compensation.results import SensorCompensation
from magloc.compensation.signals import band_passed
from magloc.measurement.plausibility import EARTH_T, robust_sigma
from magloc.surveying.preparation import field_moduli

_LATE_SIGMAS, _LATE_S = 4.0, 0.02
_TURNED_DEG = 5.0
_FALSE_ALARM = 1e-4
_OUTLIER = 5.0  # standard deviations
_CANDIDATES = 40
_NOISE_RATIO = 5.0
_UNSURE_T = 1e-10
_SLOPE_WITHIN, _SLOPE_SIGMAS = 0.2, 4.0  # of a log beside its correction


def log_doubts(log: PlatformLog) -> Iterator[str]:
    """Yield doubts about the readings of a log."""
    for name, factor in log.factors.items():
        if factor != 1.0:
            yield (
                f"unit: sensor {name} reads {factor:.3g} times the modulus of the scalar sensors: are both in nT? Only"
                " its direction is used"
            )
    for name, signal in log.signals.items():
        modulus = float(np.median(np.linalg.norm(signal.samples()[1], axis=1))) if signal.stretches else np.nan
        if not EARTH_T[0] < modulus < EARTH_T[1]:
            yield f"unit: sensor {name} reads {1e9 * modulus:.4g} nT, expected the Earth's field of 20,000 to 70,000 nT"
    for name, (stuck, wild) in log.left_out.items():
        for count, what in ((stuck, "stuck"), (wild, "wild")):
            if count:
                yield f"{what}: {count} of {len(log.readings)} readings of sensor {name} are {what} and are ignored"
    yield from _axes_doubts(log)


def _axes_doubts(log: PlatformLog) -> Iterator[str]:
    """Yield a doubt about axes if a vector sensor's field turns in the world of the pose."""
    rotation, compass = log.readings.array_rotation, log.compass
    if rotation is None or compass is None:
        return
    fields = log.array.calibrated_field(log.readings.values_T)[:, log.array.ids.index(compass.id)]
    good = np.isfinite(fields).all(axis=1)
    if not good.any():
        return
    world = rotation[np.flatnonzero(good)].apply(fields[good] / np.linalg.norm(fields[good], axis=1, keepdims=True))
    mean = world.mean(axis=0)
    cosine = world @ mean / np.linalg.norm(mean)
    turned = float(np.rad2deg(np.sqrt(np.mean(np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2))))
    if turned > _TURNED_DEG:
        yield (
            f"axes: the field of sensor {compass.id} turns by {turned:.2g}° in the world of the pose, expected less"
            f" than {_TURNED_DEG:g}°: are the axes of the sensor or of the pose wrong?"
        )


def fit_doubts(of: SensorCompensation, log: PlatformLog) -> Iterator[str]:
    """Yield doubts about the platform at one sensor."""
    fit = of.fit
    if abs(fit.lag_s) > max(_LATE_SIGMAS * fit.lag_sigma_s, _LATE_S):
        yield (
            f"lag: the attitude is {fit.lag_s:.3g} ± {fit.lag_sigma_s:.2g} s later than the readings of {of.sensor};"
            " it is corrected"
        )
    if (changed := _change(fit)) is not None:
        time_s, size_T = changed
        yield (
            f"change: the permanent field at {of.sensor} changes by about {1e9 * size_T:.2g} nT near {time_s:.5g} s:"
            " was a magnet or a load switched?"
        )
    stated = fit.rows.noise_T
    if 1e-9 * fit.background.noise_nT > _NOISE_RATIO * stated:
        yield (
            f"noise: {of.sensor} leaves {fit.background.noise_nT:.2g} nT, expected {1e9 * stated:.2g} nT from its"
            " noise: the terms do not explain the readings"
        )
    found = of.manoeuvres.n_found
    if found < 3 * HEADINGS:
        yield f"manoeuvres: {of.sensor} has {found} of {3 * HEADINGS}, of pitch, roll and yaw on four headings"


def correction_doubts(of: SensorCompensation, sigma_T: FloatArray) -> Iterator[str]:
    """Yield doubts about a sensor's correction in the log, with its standard deviation (n,)."""
    known = np.isfinite(sigma_T)
    if not known.all():
        yield f"gap: {(~known).sum()} of {len(known)} rows have no correction of {of.sensor}: its attitude is unknown"
    unsure = float(np.quantile(sigma_T[known], 0.95)) if known.any() else 0.0
    if unsure > max(_UNSURE_T, of.after_T):
        yield (
            f"attitude: the correction of {of.sensor} is uncertain by {1e9 * unsure:.2g} nT at attitudes of the log"
            " that the calibration does not show"
        )


def mismatch_doubts(sensor: str, log: PlatformLog, corrected_T: FloatArray) -> Iterator[str]:
    """Yield a doubt if the fast changes of a log (n, C) do not follow those of its correction.

    Their slope is 1 for the right correction, and below a half it adds more than it removes. Anomalies of the ground
    are independent of it.
    """
    which = log.array.ids.index(sensor)
    read, after = (field_moduli(log.array, values)[:, which] for values in (log.readings.values_T, corrected_T))
    known = np.isfinite(read) & np.isfinite(after)
    if known.sum() < FEWEST_ROWS:
        return
    time_s = log.readings.time_s[known]
    fast = band_passed(time_s, np.stack([read, read - after], axis=1)[known], BAND_S)
    size = float(np.sum(fast[:, 1] ** 2))
    if not size:
        return
    slope = float(fast[:, 0] @ fast[:, 1]) / size
    independent = max(float(np.ptp(time_s)) / BAND_S, 1.0)
    sigma = float(np.linalg.norm(fast[:, 0] - slope * fast[:, 1])) / np.sqrt(size * independent)
    if abs(slope - 1.0) > _SLOPE_WITHIN + _SLOPE_SIGMAS * sigma:
        yield (
            f"mismatch: fast changes of {sensor} in the log are {slope:.2g} ± {sigma:.1g} times those of its"
            " correction, expected 1: is the calibration of another platform, or do the axes differ?"
        )


def _change(fit: PlatformFit) -> tuple[float, float] | None:
    """Return the time and size of the most significant step of the permanent field; None without one.

    A score test: residuals against three components from each of some times on, with all coefficients estimated. The
    background is the likeliest one, so that the residuals are white and the score has the distribution of χ². If it
    is larger than the usual one, as a step makes it, the usual one is taken. Outliers are ignored: a jump of the
    background is no step of the platform's field, which varies with the attitude. Residuals are divided by their own
    size, because in a survey they exceed the noise.
    """
    usual, likeliest = Background.usual(fit.rows.noise_T), fit.background
    is_calm = likeliest.walk_nT_rts <= usual.walk_nT_rts and likeliest.bend_nT_s15 <= usual.bend_nT_s15
    background = likeliest if is_calm else usual
    solved = fit.problem.solve(background)
    good = np.abs(solved.innovations) <= _OUTLIER * robust_sigma(solved.innovations)
    A, r, rows = solved.columns[good], solved.innovations[good], len(good)
    white = background.whitening(fit.rows.time_s)
    unit = fit.field_T / np.linalg.norm(fit.field_T, axis=1, keepdims=True)
    begins = np.linspace(0, rows, _CANDIDATES + 2)[1:-1].astype(np.intp)
    steps = np.concatenate([np.where(np.arange(rows)[:, None] >= k, unit, 0.0) for k in begins], axis=1)
    S = np.ascontiguousarray(steps[:, None] / background.noise_nT)
    white.whiten(S, np.arange(rows))
    S = S[good, 0]
    inverse, across = np.linalg.inv(A.T @ A + np.eye(A.shape[1])), S.T @ A
    scores = S.T @ r - across @ inverse @ (A.T @ r - solved.mean)
    prior = np.diag((1e9 * fit.terms.sigma[:3]) ** -2.0)
    best, begin, step_nT = 0.0, 0, np.zeros(3)
    for k, first in enumerate(begins):
        own = slice(3 * k, 3 * k + 3)
        information = S[:, own].T @ S[:, own] - across[own] @ inverse @ across[own].T
        estimate = np.linalg.solve(information + prior, scores[own])
        score = float(scores[own] @ estimate)
        if score > best:
            best, begin, step_nT = score, int(first), np.asarray(estimate)
    is_sure = best > float(chi2.isf(_FALSE_ALARM / _CANDIDATES, 3)) * float(r @ r) / len(r)
    is_small = bool((np.abs(step_nT) < 1e9 * fit.sigma[:3]).all())  # within the uncertainty of the permanent field
    return (float(fit.rows.time_s[begin]), 1e-9 * float(np.linalg.norm(step_nT))) if is_sure and not is_small else None
