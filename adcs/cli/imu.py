"""``adcs imu``: attitude from a log of gyro, accelerometer and magnetometer."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import adcs
from adcs.cli.options import ReportOptions
from adcs.complementary.names import Magnet
from arrays.io.errors import InputError, naming
from magloc.cli.framework import Flag, warn

if TYPE_CHECKING:
    from adcs.io.imu_files import ImuLog

MAGNETS: dict[str, Magnet] = {"auto": "auto", "plain": "kept", "reject": "rejected", "subtract": "subtracted"}


def imu(
    log: Path,
    /,
    *,
    config: Path | None = None,
    calibration: Path | None = None,
    method: Literal["auto", "plain", "reject", "subtract"] = "auto",
    offline: Flag = False,
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Estimate the attitude of an inertial unit, with or without iron and magnets near its magnetometer.

    The unit should be at rest during the first second; its field then defines north, the magnetic
    one. Without a magnetometer the heading
    is relative to the first row. During gaps σ grows, and the gaps are reported. A log with wrong units or axes is
    refused. --out writes attitude.csv and attitude.png.

    The method follows D. Laidig and T. Seel (VQF, Information Fusion 91, 2023), with a Kalman filter of the heading
    that models disturbances of the field.

    Parameters
    ----------
    log : Path
        CSV file with time_s, gyro_x_rad_s or gyro_x_deg_s, acceleration_x_m_s2 and, with a magnetometer, field_x_nT,
        each with y and z; if known the truth qw, qx, qy, qz (east, north, up from body) and moving (1 where errors
        count). Empty cells are missing readings. Or a MAT file of the BROAD benchmark. Or the log of an autopilot or
        robot (PX4 ULog, ArduPilot DataFlash, ROS bag): its sensors are found by their names, in its body axes, and the
        attitude is compared with its own.
    config : Path, optional
        TOML file whose table log states other names of columns, units and mountings.
    calibration : Path, optional
        Array file of the magnetometer, such as from ``adcs calibrate-log --out mag.toml``: the field is corrected by
        its scale and offset, in body axes.
    method : str
        Treatment of a field that contradicts the filter: rejected until the motion shows that it moves with the sensor,
        then subtracted ("auto"); rejected ("reject"); subtracted, as the field of a magnet that moves with
        the sensor ("subtract"); used as it is ("plain").
    offline : bool
        Use the whole log for every row (smoothing).
    report : ReportOptions
        Outputs.
    """
    from adcs.io.imu_results import attitude_columns, imu_summary, summary_words

    report.check()
    data = adcs.read_imu(log, config)
    if calibration is not None:
        data = _calibrated(data, calibration)
    began = time.perf_counter()
    track = inertial_attitude(log, data, MAGNETS[method], offline=offline)
    summary: dict[str, Any] = {**imu_summary(track, data), "seconds": time.perf_counter() - began}
    warn(track.warnings)
    if report.out is not None:
        from adcs.plots.inertial import inertial_figure

        if data.q_true is None and data.q_autopilot is not None:
            from adcs.complementary.orientation_errors import without_heading_offset

            own = without_heading_offset(track.q, data.q_autopilot)[0]
            picture = inertial_figure(track, log.stem, own, "difference from the autopilot")
        else:
            picture = inertial_figure(track, log.stem, data.q_true)
        report.write([("attitude.csv", attitude_columns(track)), ("attitude.png", picture)])
    report.print(summary, summary_words(summary))


def _calibrated(data: ImuLog, path: Path) -> ImuLog:
    """Return a log with its field corrected by the array file of its magnetometer."""
    from dataclasses import replace

    from arrays.array_file import read_array

    array = read_array(path)
    if len(array.sensors) != 1 or array.sensors[0].kind != "vector":
        found = ", ".join(f"{sensor.id} ({sensor.kind})" for sensor in array.sensors)
        raise InputError(f"{path}: found sensors {found}, expected one vector sensor (--calibration).")
    field_T = array.calibrated_field(data.record.field_T)[:, 0]
    return replace(data, record=replace(data.record, field_T=field_T))


def inertial_attitude(log: Path, data: ImuLog, magnet: Magnet = "auto", *, offline: bool = False) -> adcs.AttitudeTrack:
    """Return the attitude of a log; errors name its file."""
    record = data.record
    readings = (record.time_s, record.rate_rad_s, record.acceleration_m_s2, record.field_T)
    with naming(str(log)):
        return adcs.inertial_magnetic_filter(
            *readings, magnet=magnet, gyro_samples=record.gyro_samples, offline=offline
        )
