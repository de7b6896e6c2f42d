"""Fusion of a recording without truth: ``adcs run mockup --part fusion --samples … --fixes …``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from adcs.mockup.navigation.delayed_ekf import StartSigma
from adcs.mockup.navigation.fixes import FixOutcome, FixRecord, Fused, counts_in_words, fuse, unused_counts
from adcs.mockup.navigation.strapdown import Gate, ImuRecord, PlanarState, wrapped
from arrays.io.csv import Table, read_table
from arrays.io.errors import InputError
from arrays.typing import FloatArray
from sims.experiments.mockup_navigation import fusion_of
from sims.experiments.mockup_settings import SETTLED_S, Method

SAMPLE_COLUMNS = ("time_s", "acceleration_x_m_s2", "acceleration_y_m_s2", "rate_deg_s")
FIX_COLUMNS = ("exposure_s", "arrival_s", "x_m", "y_m", "heading_deg")
_LONGEST_GAP = 100_000
"""Longest gap in samples: a quarter of an hour at 100 Hz."""
_FARTHEST_M = 100.0
"""Largest coordinate: the table and its ceiling are some metres wide."""
_MOST_DEG = 1e6
"""Largest heading, which may count full turns."""
# The velocity at the start and the calibration are unknown.
_START = StartSigma(velocity_m_s=0.2, zero_m_s2=0.01, zero_rad_s=math.radians(0.2))


@dataclass(frozen=True, eq=False)
class RecordRun:
    """A recording and its estimate."""

    method: Method
    imu: ImuRecord  # from the exposure of the first fix on, its gaps filled
    fixes: FixRecord  # after the first one, which is the start
    fused: Fused
    samples: int  # without those that fill the gaps
    early_fixes: int  # before the first one: exposed before the samples or after them
    gaps_s: FloatArray  # (k, 2): of :attr:`adcs.mockup.navigation.strapdown.ImuRecord.gaps_s`, of the whole recording
    warnings: tuple[str, ...]  # of gaps in the samples

    def summary(self) -> dict[str, Any]:
        """Return the keys of ``--json``; the difference compares fused and measured positions."""
        track, used = self.fused.track, self.fused.used
        fixes = self.fixes.rows(np.flatnonzero(used))
        late = fixes.time_s >= self.imu.begin_s + SETTLED_S
        apart_m = np.linalg.norm(track.at(fixes.time_s).position_m - fixes.position_m, axis=1)[late]
        return {
            "samples": self.samples,
            "gaps_s": self.gaps_s.tolist(),
            "fixes": len(used),
            "used_fixes": int(used.sum()),
            "rejected_fixes": self.fused.outcomes.count(FixOutcome.REJECTED),
            "unused_fixes": unused_counts(self.fused.outcomes),
            "early_fixes": self.early_fixes,
            "pending_fixes": len(self.fixes) - len(used),
            "difference_rms_mm": 1e3 * math.sqrt(np.mean(apart_m**2)) if apart_m.size else None,
            "time_s": float(track.time_s[-1]),
            "position_m": track.position_m[-1].tolist(),
            "heading_deg": math.degrees(float(wrapped(track.heading_rad[-1]))),
        }


def fused_record(samples: Path, fixes: Path, method: Method) -> RecordRun:
    """Read a recording, and fuse its samples and fixes.

    The first fix is the start, at rest.

    Parameters
    ----------
    samples, fixes : Path
        CSV files; see :func:`read_samples` and :func:`read_fixes`.
    method : {'paper', 'velocity-corrected', 'ekf', 'camera', 'imu'}

    Returns
    -------
    RecordRun
        Estimates through time, and the outcome of every fix.

    Raises
    ------
    InputError
        A file is invalid, or no fix is within the samples.

    Examples
    --------
    >>> from pathlib import Path
    >>> from sims import experiments
    >>> files = Path("samples.csv"), Path("fixes.csv")
    >>> run = experiments.fused_record(*files, "ekf")  # doctest: +SKIP
    """
    recorded, record = read_samples(samples), read_fixes(fixes)
    imu = recorded.fill_gaps()
    within = (record.time_s >= imu.begin_s) & (record.time_s < imu.end_s)
    if not within.any():
        raise InputError(
            f"{fixes}: found no exposure from {imu.begin_s:.10g} to {imu.end_s:.10g} s, the time of {samples}, "
            "expected one at least."
        )
    first = int(np.argmax(within))
    later = record.rows(np.flatnonzero(np.arange(len(record)) > first))
    start = PlanarState(record.position_m[first], np.zeros(2), float(record.heading_rad[first]))
    part = imu.between(float(record.time_s[first]), imu.end_s)
    fused = fuse(fusion_of(method, start, part.begin_s, _START), part, later)
    kept = int(np.count_nonzero(recorded.time_s > part.begin_s))
    warnings = _gap_warnings(samples, recorded, method)
    return RecordRun(method, part, later, fused, kept, first, recorded.gaps_s, warnings)


def _gap_warnings(path: Path, imu: ImuRecord, method: Method) -> tuple[str, ...]:
    """Return one sentence if samples are missing."""
    gaps = imu.gaps_s
    if not len(gaps):
        return ()
    begin_s, end_s = gaps[np.argmax(gaps[:, 1] - gaps[:, 0])]
    where = f"no samples from {begin_s:.10g} to {end_s:.10g} s"
    if len(gaps) > 1:
        where = f"{len(gaps)} gaps between samples, the longest from {begin_s:.10g} to {end_s:.10g} s"
    consequence = {
        "ekf": "acceleration and rate are unknown there, and the standard deviations grow",
        "camera": "this fusion does not use samples",
    }.get(method, "velocity and rate stay constant there, and only ekf states how wrong that is")
    return (f"{path}: found {where}, expected one every {imu.usual_step_s:.4g} s; {consequence}.",)


def read_samples(path: Path) -> ImuRecord:
    """Read samples from a CSV file with the columns of :data:`SAMPLE_COLUMNS`; others are ignored.

    A time is the end of the interval of its sample; an empty cell is a missing reading. Raises InputError if the file
    is invalid, has fewer than two rows, its times decrease, a gap is too long, or a column has no plausible reading.
    """
    table = _table_with(path, SAMPLE_COLUMNS)
    time_s = table.complete(["time_s"], math.inf)[:, 0]
    if len(time_s) < 2:
        raise InputError(f"{path}: found one row, expected two samples at least.")
    table.refuse_back("time_s", ~(np.diff(time_s) > 0.0), "times that increase")
    usual_s = float(np.median(np.diff(time_s)))
    far = np.append(False, np.diff(time_s) > _LONGEST_GAP * usual_s)
    if far.any():
        row = int(np.argmax(far))
        raise InputError(
            f"{table.place(row, 'time_s')}: found {time_s[row]:.10g} s after "
            f"{time_s[row - 1]:.10g} s, expected the next sample within {_LONGEST_GAP * usual_s:.4g} s, "
            f"{_LONGEST_GAP} usual intervals."
        )
    readings = table.finite_or_missing(list(SAMPLE_COLUMNS[1:]), math.inf)
    imu = ImuRecord(float(time_s[0]) - usual_s, time_s, readings[:, :2], np.radians(readings[:, 2]))
    gate = Gate()
    limits = [f"{gate.acceleration_m_s2:g} m/s²"] * 2 + [f"{math.degrees(gate.rate_rad_s):g} °/s"]
    believed = gate.accept(imu).any(axis=0)
    if not believed.all():
        column = int(np.argmin(believed))
        raise InputError(
            f"{table.header_place(SAMPLE_COLUMNS[1 + column])}: found no reading up to {limits[column]} in the whole "
            "column, expected some; larger ones are not believed."
        )
    return imu


def read_fixes(path: Path) -> FixRecord:
    """Read fixes from a CSV file with the columns of :data:`FIX_COLUMNS`, in order of arrival.

    Raises
    ------
    InputError
        The file is invalid, arrivals decrease, a fix arrives before its exposure, or is far from the table.
    """
    table = _table_with(path, FIX_COLUMNS)
    values = table.complete(list(FIX_COLUMNS), math.inf)
    table.refuse(
        np.abs(values[:, 2:4]) > _FARTHEST_M,
        FIX_COLUMNS[2:4],
        f"found more than {_FARTHEST_M:g} m, expected a place on the table, from -{_FARTHEST_M:g} to {_FARTHEST_M:g} m",
    )
    table.refuse(
        np.abs(values[:, 4:]) > _MOST_DEG, FIX_COLUMNS[4:], f"found more than {_MOST_DEG:g}°, expected a heading"
    )
    table.refuse_back("arrival_s", np.diff(values[:, 1]) < 0.0, "arrivals that do not go back")
    early = np.flatnonzero(values[:, 1] < values[:, 0])
    if early.size:
        exposure_s, arrival_s = values[early[0], :2]
        raise InputError(
            f"{table.place(int(early[0]), 'arrival_s')}: found {arrival_s:.6g} s for an exposure "
            f"at {exposure_s:.6g} s, expected an arrival after the exposure."
        )
    return FixRecord(values[:, 0], values[:, 1], values[:, 2:4], np.radians(values[:, 4]))


def _table_with(path: Path, columns: tuple[str, ...]) -> Table:
    table = read_table(path, f"a header with the columns {', '.join(columns)}")
    for column in columns:
        table.require(column, columns)
    return table


def record_lines(run: RecordRun) -> list[str]:
    """Return the result as text."""
    result = run.summary()
    x, y = result["position_m"]
    apart = result["difference_rms_mm"]
    outside = [(result["early_fixes"], "before the first"), (result["pending_fixes"], "after the last sample")]
    left_out = "".join(f"; {count} more {where}" for count, where in outside if count)
    return [
        f"{result['samples']} samples, {result['fixes']} fixes after the first, fusion {run.method}",
        f"fixes                              {counts_in_words(result['used_fixes'], result['unused_fixes'])}{left_out}",
        f"fused minus camera, undelayed [mm] {'none' if apart is None else f'{apart:.2f}'}",
        f"at the end, {result['time_s']:.2f} s: X {x:.4f} m, Y {y:.4f} m, heading {result['heading_deg']:.2f}°",
    ]
