"""Named problems of attitude determination, found in a record and what a filter made of it.

Each is one sentence that says what is degraded or cannot be observed, and for how long. The covariance of the estimates
tells how much, except where the model itself is wrong: there the readings must be compared with it.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.stats import chi2

from adcs.kalman.error_state import AttitudeTracks, SensorSet
from adcs.kalman.mekf import deviations
from adcs.satellite.sensors import NIS_SIZES
from adcs.satellite.telemetry import Record, is_read
from arrays.typing import BoolArray

COLLINEAR_RAD = math.radians(20.0)
"""Sun and field nearer to one line than this leave the turn about it badly known: its noise is three times as large."""
FALSE_ALARM = 1e-6
"""Probability with which readings that fit their model are called wrong."""


def warnings_of(record: Record, estimates: AttitudeTracks) -> tuple[tuple[str, ...], ...]:
    """Sentences about every run, in the order of the list below; none where nothing is wrong.

    - eclipse, no star tracker reading (over-rate or blinded),
    - Sun and field on one line,
    - one direction with a biased gyro,
    - a field that does not fit its model: an error of the model, or the satellite's own field,
    - innovations that the covariance does not explain.
    """
    used = estimates.settings.sensors
    return tuple(
        (
            *_lost_sun(record, used, run),
            *_lost_stars(record, estimates, run),
            *_collinear(record, used, run),
            *_one_vector(record, used, run),
            *_field_model(record, estimates, run),
            *_innovations(estimates, run),
        )
        for run in range(len(estimates.q))
    )


def _lost_sun(record: Record, used: SensorSet, run: int) -> list[str]:
    if not used.sun:
        return []
    missing = ~is_read(record.readings.sun[run])
    dark = missing & ~record.environment.sunlit[run]
    sentences = []
    if dark.any():
        sentences.append(f"eclipse: no Sun for {_seconds(dark, record)}; attitude is degraded")
    if (missing & ~dark).any():
        sentences.append(f"Sun outside of all heads' fields for {_seconds(missing & ~dark, record)}")
    return sentences


def _lost_stars(record: Record, estimates: AttitudeTracks, run: int) -> list[str]:
    if not estimates.settings.sensors.star:
        return []
    missing = ~is_read(record.readings.star[run])
    limit = record.satellite.star_tracker.rate_limit_rad_s
    fast = missing & (np.linalg.norm(estimates.w[run], axis=-1) > limit)
    sentences = []
    if fast.any():
        sentences.append(f"star tracker over-rate: above {math.degrees(limit):g}°/s for {_seconds(fast, record)}")
    if (missing & ~fast).any():
        sentences.append(f"star tracker blinded by Sun or Earth for {_seconds(missing & ~fast, record)}")
    return sentences


def _collinear(record: Record, used: SensorSet, run: int) -> list[str]:
    if used.star or not (used.magnetometer and used.sun):
        return []
    separation_rad = record.environment.separation_rad[run]
    near = (separation_rad < COLLINEAR_RAD) & is_read(record.readings.sun[run])
    if not near.any():
        return []
    least = math.degrees(float(separation_rad[near].min()))
    return [
        f"Sun and field on one line within {least:.0f}° for {_seconds(near, record)}: the turn about it is "
        + ("known by the gyro only" if used.gyro else "not observable there")
    ]


def _one_vector(record: Record, used: SensorSet, run: int) -> list[str]:
    if used.star or not used.gyro:
        return []
    readings = record.readings
    seen = np.zeros(readings.sun.shape[1], dtype=np.int64)
    if used.magnetometer:
        seen += is_read(readings.field_T[run])
    if used.sun:
        seen += is_read(readings.sun[run])
    alone = seen < 2
    if not alone.any():
        return []
    cannot = "its bias about that direction is not observable" if used.gyro_bias else "a bias is not in the state"
    return [f"one direction and a gyro for {_seconds(alone, record)}: {cannot}, the error accumulates"]


def _field_model(record: Record, estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare what does not depend on the attitude: the field's modulus, and its angle with the Sun."""
    settings = estimates.settings
    used = settings.sensors
    if not used.magnetometer or used.field_bias:
        return []
    around, readings = record.environment, record.readings
    sigma = deviations(record, settings)
    b, model = readings.field_T[run], around.b_orbital_T[run]
    length_T = np.linalg.norm(model, axis=-1)
    checks = [(np.linalg.norm(b, axis=-1) - length_T, np.full(len(b), sigma[2]))]
    if used.sun:
        along = np.sum(model * around.sun_orbital[run], axis=-1)
        across_T = np.sqrt(np.maximum(length_T**2 - along**2, 0.0))
        checks.append((np.sum(b * readings.sun[run], axis=-1) - along, np.hypot(sigma[2], sigma[3] * across_T)))
    total, numbers, largest_T = 0.0, 0, 0.0
    for residual, deviation in checks:
        seen = np.isfinite(residual)
        if seen.any():
            mean_T = float(residual[seen].mean())
            total += mean_T**2 / float(np.mean(deviation[seen] ** 2)) * int(seen.sum())
            numbers += 1
            largest_T = max(largest_T, abs(mean_T))
    if numbers == 0 or total <= chi2.isf(FALSE_ALARM, numbers):
        return []
    effect = "the star tracker keeps the attitude" if used.star else "attitude is degraded"
    return [
        f"field differs from its model by {1e9 * largest_T:.0f} nT in modulus or angle with the Sun: error of the "
        f"model, bias or the satellite's own field; {effect}"
    ]


def _innovations(estimates: AttitudeTracks, run: int) -> list[str]:
    """Compare the sum of NIS over the second half of the run, after the start, with its χ²."""
    nis = estimates.nis[run, estimates.nis.shape[1] // 2 :]
    numbers = int((np.isfinite(nis) * list(NIS_SIZES.values())).sum())
    total = float(np.nansum(nis))
    if numbers == 0 or total <= chi2.isf(FALSE_ALARM, numbers):
        return []
    return [f"innovations are {math.sqrt(total / numbers):.1f} times what the covariance explains: the model is wrong"]


def _seconds(rows: BoolArray, record: Record) -> str:
    return f"{rows.sum() * record.dt_s:.0f} s"
