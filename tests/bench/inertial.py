"""Attitude of an inertial unit on trials of the BROAD benchmark, beside VQF and Madgwick's filter of ahrs."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import adcs
from adcs import quaternion
from adcs.complementary.inertial_magnetic import InertialMagneticRecord
from adcs.complementary.orientation_errors import orientation_errors
from adcs.io.imu_files import ImuLog
from arrays.typing import FloatArray
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, Timing, installed, interleaved

TITLE = "inertial unit near magnets: a trial of BROAD, three minutes, 1 thread"

Solver = Callable[[InertialMagneticRecord], FloatArray]


def rows(size: Size) -> Iterator[Row]:
    """Errors in all and of inclination, the mean of the trials; skipped with a notice if they are not there."""
    files = sorted((Path(os.environ.get("MAGLOC_DATA", "../shared/data")) / "broad").glob("*.mat"))[: size.problems]
    if not files:
        yield Row("a trial", note="skipped: the recording is not there (set MAGLOC_DATA)")
        return
    logs = [adcs.read_imu(path) for path in files]
    for what, solvers in (
        ("in real time", {"ours": ours, "vqf": vqf_online}),
        ("offline", {"ours": partial(ours, offline=True), "vqf": offline_vqf}),
    ):
        if not installed("vqf"):
            del solvers["vqf"]
        timings = interleaved(
            {name: Contestant(partial(solve, logs[0].record)) for name, solve in solvers.items()}, size.rounds
        )
        said = {name: _errors([solve(log.record) for log in logs], logs) for name, solve in solvers.items()}
        note = said["ours"] + (f"; peer {said['vqf']}" if "vqf" in said else "")
        yield Row(f"a trial, {what}", timings["ours"], "vqf", timings.get("vqf"), note)
        if what == "in real time" and installed("ahrs"):
            # Seconds a trial: once is enough, and of a few of them.
            few = logs[:3]
            began = time.perf_counter()
            found = [madgwick(log.record) for log in few]
            once = Timing(((time.perf_counter() - began) / len(few),))
            own = _errors([ours(log.record) for log in few], few)
            note = f"{own} in {len(few)} trials; peer {_errors(found, few)}"
            yield Row("the same", Timing(timings["ours"].seconds[:1]), "ahrs, Madgwick", once, note)


def _errors(found: list[FloatArray], logs: list[ImuLog]) -> str:
    """Root mean squares, the mean of the trials."""
    errors = []
    for q, log in zip(found, logs, strict=True):
        assert log.q_true is not None
        rms = orientation_errors(q, log.q_true, log.moving)
        errors.append([rms.total, rms.inclination])
    total, inclination = np.degrees(np.mean(errors, axis=0))
    return f"{total:.2f}°, {inclination:.2f}°"


def ours(record: InertialMagneticRecord, *, offline: bool = False) -> FloatArray:
    """Return the attitudes of our filter."""
    readings = record.rate_rad_s, record.acceleration_m_s2, record.field_T
    return adcs.inertial_magnetic_filter(record.time_s, *readings, offline=offline).q


def in_axes_of_vqf(record: InertialMagneticRecord) -> tuple[Any, ...]:
    """Return the readings as VQF takes them: field in microteslas."""
    values = record.rate_rad_s, record.acceleration_m_s2, 1e6 * record.field_T
    return tuple(np.ascontiguousarray(one) for one in values)


def vqf_online(record: InertialMagneticRecord) -> FloatArray:
    import vqf

    return np.asarray(vqf.VQF(float(np.median(record.dt_s))).updateBatch(*in_axes_of_vqf(record))["quat9D"])


def offline_vqf(record: InertialMagneticRecord) -> FloatArray:
    import vqf

    return np.asarray(vqf.offlineVQF(*in_axes_of_vqf(record), float(np.median(record.dt_s)))["quat9D"])


def madgwick(record: InertialMagneticRecord) -> FloatArray:
    """With the gain of ahrs; its first axis is north."""
    from ahrs.filters import Madgwick

    readings = {"gyr": record.rate_rad_s, "acc": record.acceleration_m_s2, "mag": 1e9 * record.field_T}
    q = Madgwick(**readings, frequency=1.0 / float(np.median(record.dt_s))).Q
    return quaternion.multiply(quaternion.exp([0.0, 0.0, 0.5 * np.pi]), q)
