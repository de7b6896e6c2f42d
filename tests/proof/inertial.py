"""Attitude of inertial units near magnets, against optical truth."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

import adcs
from adcs import quaternion
from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from adcs.complementary.orientation_errors import error_angles
from adcs.io.imu_files import ImuLog
from arrays.typing import FloatArray
from tests.bench.inertial import in_axes_of_vqf, madgwick, offline_vqf, ours, vqf_online
from tests.proof import Part, Row, Size, run_command, with_nees

WRONG_DEG = 10.0
MOST_JITTER = 0.01
G_M_S2 = 9.80665
FROM_NORTH = quaternion.exp([0.0, 0.0, 0.5 * np.pi])
"""Turns an attitude whose first axis is north into one whose first axis is east."""
Attitude = Callable[[InertialMagneticRecord], FloatArray]


def fit_heading(q: FloatArray, log: ImuLog) -> FloatArray:
    """Return attitudes turned about the vertical by the constant that fits the truth best."""
    assert log.q_true is not None
    known = log.moving & np.isfinite(log.q_true).all(axis=1)
    w, _, _, z = quaternion.multiply(q[known], quaternion.conjugate(log.q_true[known])).T
    angle = np.angle(np.sum((w + 1j * z) ** 2))
    return quaternion.multiply(quaternion.exp([0.0, 0.0, -angle]), q)


def errors_deg(q: FloatArray, log: ImuLog) -> tuple[FloatArray, FloatArray]:
    """Return total and heading errors of the moving part."""
    assert log.q_true is not None
    known = log.moving & np.isfinite(log.q_true).all(axis=1)
    total, heading, _ = error_angles(q[known], log.q_true[known])
    return np.degrees(total), np.degrees(heading)


def _row(
    case: str, tool: str, needs: str, took: float, errors: Sequence[FloatArray], squares: Sequence[FloatArray] = ()
) -> Row:
    """Return the row of several recordings, whose rms is the mean of theirs."""
    error = np.concatenate(errors)
    rms = float(np.mean([np.sqrt(np.mean(np.square(one))) for one in errors]))
    row = Row(case, tool, needs, error, float(np.mean(error > WRONG_DEG)), took, rms=rms)
    if not squares:
        return row
    return replace(with_nees(row, np.concatenate(squares)), nees=float(np.mean([np.mean(one) for one in squares])))


def our_attitudes(case: str, paths: Sequence[Path]) -> Iterator[Row]:
    """Rows of ``adcs imu`` in real time and offline; the time is that of the filter alone."""
    for offline in (False, True):
        errors, squares, took = [], [], 0.0
        for path in paths:
            log = adcs.read_imu(path)
            with TemporaryDirectory() as folder:
                run_command("adcs", "imu", path, "--out", folder, "--json", *(["--offline"] if offline else []), runs=1)
                table = pd.read_csv(Path(folder) / "attitude.csv")
            total, heading = errors_deg(table[["qw", "qx", "qy", "qz"]].to_numpy(), log)
            assert log.q_true is not None
            known = log.moving & np.isfinite(log.q_true).all(axis=1)
            errors.append(total)
            squares.append(np.square(heading / table["sigma_heading_deg"].to_numpy()[known]))
            began = time.process_time()
            ours(log.record, offline=offline)
            took += time.process_time() - began
        tool = "`adcs imu --offline`" if offline else "`adcs imu`"
        yield _row(f"{case}, offline" if offline else case, tool, "log", took / len(paths), errors, squares)


def on_even_times(record: InertialMagneticRecord, solve: Attitude) -> FloatArray:
    """Return the attitudes of a filter that needs one rate, of readings and attitudes interpolated linearly."""
    if np.std(record.dt_s) < MOST_JITTER * np.mean(record.dt_s):
        return solve(record)
    even_s = np.linspace(record.time_s[0], record.time_s[-1], len(record.time_s))

    def at(times: FloatArray, known: FloatArray, values: FloatArray) -> FloatArray:
        return np.stack([np.interp(times, known, column) for column in values.T], axis=1)

    readings = (record.rate_rad_s, record.acceleration_m_s2, record.field_T)
    q = solve(InertialMagneticRecord(even_s, *(at(even_s, record.time_s, one) for one in readings)))
    signs = np.cumprod(np.concatenate([[1.0], np.where(np.vecdot(q[1:], q[:-1]) < 0.0, -1.0, 1.0)]))
    return quaternion.normalised(at(record.time_s, even_s, signs[:, None] * q))


def peer_attitudes(
    case: str, paths: Sequence[Path], tool: str, needs: str, solve: Attitude, *, fitted: bool
) -> Iterator[Row]:
    """Row of another filter; where its north is free, or not that of the truth, the best constant is taken off."""
    errors, took = [], 0.0
    for path in paths:
        log = adcs.read_imu(path)
        began = time.process_time()
        q = on_even_times(log.record, solve)
        took += time.process_time() - began
        errors.append(errors_deg(fit_heading(q, log) if fitted else q, log)[0])
    yield _row(case, tool, needs + (", true constant of heading" if fitted else ""), took / len(paths), errors)


def vqf_inclination(record: InertialMagneticRecord) -> FloatArray:
    """Attitude by gyro and accelerometer alone."""
    import vqf

    return np.asarray(vqf.VQF(float(np.median(record.dt_s))).updateBatch(*in_axes_of_vqf(record))["quat6D"])


def mahony(record: InertialMagneticRecord) -> FloatArray:
    """Mahony's filter with the gains of ahrs; its first axis is east."""
    from ahrs.filters import Mahony

    readings = {"gyr": record.rate_rad_s, "acc": record.acceleration_m_s2, "mag": 1e9 * record.field_T}
    return np.asarray(Mahony(**readings, frequency=1.0 / float(np.median(record.dt_s))).Q)


def fusion(record: InertialMagneticRecord) -> FloatArray:
    """Filter of imufusion with the settings of its example: gain 0.5, rejection 10°, timeout 5 s."""
    import imufusion

    dt_s = float(np.median(record.dt_s))
    filter_ = imufusion.Ahrs()
    filter_.set_settings(
        imufusion.AhrsSettings(
            sample_rate=1.0 / dt_s,
            convention=imufusion.CONVENTION_NWU,
            gain=0.5,
            gyroscope_range=2000.0,
            acceleration_rejection=10.0,
            magnetic_rejection=10.0,
            rejection_timeout=5.0,
        )
    )
    q = np.empty((len(record.time_s), 4))
    rates, accelerations = np.degrees(record.rate_rad_s), record.acceleration_m_s2 / G_M_S2
    for i, (rate, acceleration, field) in enumerate(zip(rates, accelerations, 1e6 * record.field_T, strict=True)):
        filter_.update(rate, acceleration, field)
        q[i] = filter_.get_quaternion()
    return quaternion.multiply(FROM_NORTH, q)


def _part(name: str, paths_of: Callable[[Path, Size], Sequence[tuple[str, Sequence[Path]]]], *, fitted: bool) -> Part:
    """Return a part with all filters; a constant of the heading is fitted where the truth has another north."""

    def ours_(data: Path, size: Size) -> Iterator[Row]:
        for case, paths in paths_of(data, size):
            yield from our_attitudes(case, paths)

    def peers(filters: Sequence[tuple[str, Attitude, bool]], data: Path, size: Size) -> Iterator[Row]:
        for case, paths in paths_of(data, size):
            for tool, solve, free in filters:
                of = f"{case}, offline" if "offline" in tool else case
                yield from peer_attitudes(of, paths, tool, "log, rate", solve, fitted=fitted or free)

    filters = {
        "vqf": [("VQF", vqf_online, False), ("VQF, 6D", vqf_inclination, True), ("VQF, offline", offline_vqf, False)],
        "imufusion": [("imufusion", fusion, False)],
        "ahrs": [("ahrs, Madgwick", madgwick, False), ("ahrs, Mahony", mahony, False)],
    }
    return Part(name, "°", "beyond 10°", ours_, {package: partial(peers, some) for package, some in filters.items()})


def _trials(data: Path, size: Size) -> list[tuple[str, list[Path]]]:
    return [("nine trials", sorted((data / "broad").glob("*.mat"))[:: size.every])]


def _recordings(data: Path, _: Size) -> list[tuple[str, list[Path]]]:
    return [(name, [data / "imu-optitrack" / f"{name}.csv"]) for name in ("rec11", "rec14")]


BROAD = _part("broad", _trials, fitted=False)
OPTITRACK = _part("imu-optitrack", _recordings, fitted=True)
