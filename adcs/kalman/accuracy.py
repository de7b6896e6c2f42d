"""How accurate estimates are against the truth of a simulation, in the numbers that ``adcs run --json`` prints."""

from __future__ import annotations

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import AttitudeTracks
from adcs.satellite.telemetry import TrueRecord
from arrays.typing import FloatArray

LAST_S = 60.0
"""Errors are those of the last minute."""
DIVERGED_RAD = np.radians(10.0)
"""A run whose attitude is farther off than this in the last minute has diverged."""


def errors(record: TrueRecord, estimates: AttitudeTracks) -> FloatArray:
    """Error state of truth against estimate, shape (runs, n, N)."""
    true = {
        "field-bias": (record.prepared.field_bias_T, estimates.field_bias_T),
        "gyro-bias": (record.prepared.gyro_bias_rad_s, estimates.gyro_bias_rad_s),
        "disturbance": (record.acceleration_s2, estimates.disturbance_s2),
    }
    parts = [quaternion.error_vector(estimates.q, record.q), record.w - estimates.w]
    parts += [true[state][0] - true[state][1] for state in estimates.settings.sensors.states]
    return np.concatenate(parts, axis=-1)


def normalised_error_squared(record: TrueRecord, estimates: AttitudeTracks) -> FloatArray:
    """NEES, shape (runs, n): χ² of N numbers where the filter is consistent."""
    error = errors(record, estimates)
    # States of mixed units: solve with the correlations.
    scale = estimates.sigma
    correlation = estimates.covariance / (scale[..., :, None] * scale[..., None, :])
    scaled = error / scale
    return np.sum(scaled * np.linalg.solve(correlation, scaled[..., None])[..., 0], axis=-1)


def axis_rms(record: TrueRecord, estimates: AttitudeTracks) -> FloatArray:
    """Rms of every component of the error state over the last minute, shape (runs, N); δq is half of the angle."""
    return np.sqrt(np.mean(errors(record, estimates)[:, last_rows(record)] ** 2, axis=1))


def evaluate(record: TrueRecord, estimates: AttitudeTracks) -> dict[str, float | int | None]:
    """Accuracy over the last minute: every axis' rms, its mean over the runs, and of these the worst axis.

    Returns: ``angle_rms_deg``, ``rate_rms_deg_s``, ``gyro_bias_rms_deg_s``, ``field_bias_rms_nT``,
    ``disturbance_rms_s2`` (None where the filter has no such state), ``nees_per_dimension``, ``diverged_runs``,
    ``runs``.
    """
    used = estimates.settings.sensors
    mean = axis_rms(record, estimates).mean(axis=0)

    def worst(first: int, scale: float) -> float | None:
        return None if first < 0 else float(scale * mean[first : first + 3].max())

    late = last_rows(record)
    near = quaternion.angle_between(estimates.q[:, late], record.q[:, late]) <= DIVERGED_RAD
    return {
        "angle_rms_deg": worst(0, float(np.degrees(2.0))),
        "rate_rms_deg_s": worst(3, float(np.degrees(1.0))),
        "gyro_bias_rms_deg_s": worst(used.first_of("gyro-bias"), float(np.degrees(1.0))),
        "field_bias_rms_nT": worst(used.first_of("field-bias"), 1e9),
        "disturbance_rms_s2": worst(used.first_of("disturbance"), 1.0),
        "nees_per_dimension": float(normalised_error_squared(record, estimates)[:, late].mean() / used.size),
        "diverged_runs": int((~near.all(axis=-1)).sum()),
        "runs": len(near),
    }


def last_rows(record: TrueRecord) -> slice:
    """Instants of the last minute."""
    return slice(-max(1, round(LAST_S / record.dt_s)), None)


def error_norm_deg(record: TrueRecord, estimates: AttitudeTracks) -> FloatArray:
    """Length of the error's rotation vector, shape (runs, n) [°]."""
    return np.degrees(quaternion.angle_between(estimates.q, record.q))
