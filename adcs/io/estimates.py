"""What is written of an estimate: columns with units."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from adcs.io.telemetry_files import TelemetryRecord
    from adcs.kalman.error_state import Estimates


def estimate_columns(record: TelemetryRecord, estimates: Estimates) -> dict[str, Any]:
    """Columns of estimates.csv, at all instants.

    Parameters
    ----------
    record : TelemetryRecord
    estimates : Estimates

    Returns
    -------
    dict of str to ndarray, shape (n,)
        ``qw`` to ``qz`` is the attitude, orbital from body, ``eci_qw`` to ``eci_qz`` inertial from body.
    """
    from adcs import quaternion
    from adcs.io.telemetry_files import orbital_from_eci
    from adcs.kalman.results import STATE_COLUMNS, sigma_in_units

    used = estimates.settings.sensors
    q = estimates.q[0]
    inertial = quaternion.multiply(quaternion.conjugate(orbital_from_eci(record.environment)[0]), q)
    columns: dict[str, Any] = {"time_s": record.time_s}
    columns |= dict(zip(("qw", "qx", "qy", "qz"), q.T, strict=True))
    columns |= dict(zip(("eci_qw", "eci_qx", "eci_qy", "eci_qz"), inertial.T, strict=True))
    values = values_in_units(estimates)[0].T
    sigma = sigma_in_units(estimates)[0].T
    there = [True, True, *(state in used.states for state in ("gyro-bias", "field-bias", "disturbance"))]
    for i, name in enumerate(STATE_COLUMNS):
        if there[i // 3]:
            if i >= 3:
                columns[name] = values[i]
            columns[f"sigma_{name}"] = sigma[i]
    for name, nis in zip(("star", "gyro", "field", "sun"), estimates.nis[0].T, strict=True):
        if not np.isnan(nis).all():
            columns[f"nis_{name}"] = nis
    return columns


def values_in_units(estimates: Estimates) -> Any:
    """Estimates (1, n, 15): attitude as rotation vector from the orbital frame [°], and the states in files' units."""
    from adcs import quaternion

    used = estimates.settings.sensors
    parts = [
        np.degrees(quaternion.log(estimates.q)),
        np.degrees(estimates.w),
        np.degrees(estimates.gyro_bias_rad_s) if used.gyro_bias else np.full_like(estimates.w, np.nan),
        1e9 * estimates.field_bias_T if used.field_bias else np.full_like(estimates.w, np.nan),
        estimates.disturbance_s2 if used.disturbance else np.full_like(estimates.w, np.nan),
    ]
    return np.concatenate(parts, axis=-1)
