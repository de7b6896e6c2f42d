"""Output of an inertial unit's attitude: columns, and a summary."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from adcs.complementary.filters import DOUBTED, LEFT_OUT, LOST, SUBTRACTED
from adcs.complementary.orientation_errors import error_angles, orientation_errors, without_heading_offset
from adcs.io.imu_files import ImuLog
from adcs.satellite.attitude_track import AttitudeTrack


def attitude_columns(track: AttitudeTrack) -> dict[str, Any]:
    """Return the columns (n,) of attitude.csv: east, north, up from body.

    ``sigma_tilt_deg`` is the standard deviation of the angle between up and its estimate, ``sigma_heading_deg`` that of
    the angle about the vertical.
    """
    east, north, up = np.degrees(track.sigma["level"]).T
    return {
        "time_s": track.time_s,
        **dict(zip(("qw", "qx", "qy", "qz"), track.q.T, strict=True)),
        "sigma_tilt_deg": np.hypot(east, north),
        "sigma_heading_deg": up,
        "disturbed": track.degraded[LEFT_OUT] | track.degraded[SUBTRACTED],
    }


def imu_summary(track: AttitudeTrack, log: ImuLog) -> dict[str, Any]:
    """Return totals of a track, and its errors if the log has a truth."""
    left_out, subtracted = track.degraded[LEFT_OUT], track.degraded[SUBTRACTED]
    flags = {"field-left-out": left_out, "magnet-subtracted": subtracted, "heading-lost": track.degraded[LOST]}
    flags["heading-doubtful"] = track.degraded[DOUBTED]
    relative = "magnetometer" not in track.used
    used = "subtract" if subtracted.any() else "reject" if left_out.any() else "plain"
    summary: dict[str, Any] = {
        "rows": len(track),
        "method": "six-axes" if relative else used,
        "disturbed_fraction": float((left_out | subtracted).mean()),
        "flags": [*(["heading-relative"] if relative else []), *(name for name, there in flags.items() if there.any())],
    }
    if log.q_true is not None and (log.moving & np.isfinite(log.q_true).all(axis=1)).any():
        errors = orientation_errors(track.q, log.q_true, log.moving)
        for name in ("inclination",) if relative else ("total", "heading", "inclination"):
            summary[f"{name}_rms_deg"] = float(np.degrees(getattr(errors, name)))
    if log.q_autopilot is not None and np.isfinite(log.q_autopilot).all(axis=1).any():
        own, offset = without_heading_offset(track.q, log.q_autopilot)
        for name, angle in zip(("total", "heading", "tilt"), error_angles(track.q, own), strict=True):
            short = np.abs((angle + math.pi) % (2.0 * math.pi) - math.pi)
            summary[f"autopilot_{name}_median_deg"] = float(np.degrees(np.nanmedian(short)))
        summary["autopilot_heading_offset_deg"] = math.degrees(offset)
    if log.magnetometer_lag_s is not None:
        names = ("magnetometer_lag_s", "magnetometer_lag_sigma_s")
        summary |= {name: of for name, of in zip(names, log.magnetometer_lag_s, strict=True) if math.isfinite(of)}
    return summary


def summary_words(summary: dict[str, Any]) -> list[str]:
    """Return the totals as text."""
    used = {
        "plain": "the field was used as it is",
        "reject": "the field was ignored where it contradicts",
        "subtract": "a magnet that moves with the sensor was subtracted",
        "six-axes": "there is no field: the heading is relative to the first row",
    }
    lines = [f"{summary['rows']} rows; {used[summary['method']]}; disturbed in {summary['disturbed_fraction']:.1%}"]
    if "total_rms_deg" in summary:
        total, heading, tilt = (summary[f"{name}_rms_deg"] for name in ("total", "heading", "inclination"))
        lines.append(f"rms while it moved: {total:.2f}° in all, heading {heading:.2f}°, inclination {tilt:.2f}°")
    elif "inclination_rms_deg" in summary:
        lines.append(f"rms while it moved: inclination {summary['inclination_rms_deg']:.2f}°")
    if "autopilot_total_median_deg" in summary:
        total, heading, tilt = (summary[f"autopilot_{name}_median_deg"] for name in ("total", "heading", "tilt"))
        offset = f"after a constant {summary['autopilot_heading_offset_deg']:.1f}° of heading"
        words = f"{total:.2f}° in all, heading {heading:.2f}°, tilt {tilt:.2f}°"
        lines.append(f"median difference from the autopilot: {words}, {offset}")
    if "magnetometer_lag_sigma_s" in summary:
        lag_s, sigma_s = summary["magnetometer_lag_s"], summary["magnetometer_lag_sigma_s"]
        lines.append(f"lag of the magnetometer behind the gyro: {1e3 * lag_s:.1f} ms, σ {1e3 * sigma_s:.1f} ms")
    return lines
