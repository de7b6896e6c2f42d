"""Fixes as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magloc.localization.fit.results import Fix, JointFix, Solution, Source
from magloc.localization.uncertainty.covariance import is_misfit
from magloc.tracking.consistency import Consistency
from magloc.tracking.results import TrackPoint

if TYPE_CHECKING:
    pass


_WIDTH = 100
_MILLIMETRES_BELOW_M = 1.0


def fix_table(times_s: Sequence[float], fixes: Sequence[Fix | JointFix], near: Sequence[bool]) -> list[str]:
    """Lines of a table: a header, then one line for every source of the best solution of every fix.

    Parameters
    ----------
    times_s : sequence of float
        Times of the rows [s].
    fixes : sequence of Fix or JointFix
    near : sequence of bool
        Whether the source is too near for a dipole.

    Returns
    -------
    list of str
        Aligned columns separated by spaces. Lengths are in mm if most of the positions are within a metre, else in m.
    """
    joint = any(isinstance(fix, JointFix) for fix in fixes)
    sources = [_sources(fix) for fix in fixes]
    distances = [float(np.linalg.norm(source.position_m)) for of_row in sources for source in of_row]
    in_mm = bool(distances) and float(np.median(distances)) < _MILLIMETRES_BELOW_M
    unit, per_m, decimals = ("mm", 1e3, 2) if in_mm else ("m", 1.0, 3)

    lengths = [f"{name}_{unit}" for name in ("x", "y", "z", "s_x", "s_y", "s_z", "range95")]
    header = [
        "time_s",
        *(["source"] if joint else []),
        *lengths[:6],
        "m_Am2",
        *([] if joint else ["s_m"]),
        "chi2/dof",
        lengths[6],
        "flags",
    ]
    rows, reasons = [header], [""]
    for time, fix, of_row, too_near in zip(times_s, fixes, sources, near, strict=True):
        if not of_row:
            rows.append([f"{time:.10g}"])
            reasons.append(fix.reason)
        for k, source in enumerate(of_row):
            cells = _cells(fix, source, per_m, decimals, too_near=too_near)
            rows.append([f"{time:.10g}", *([str(k + 1)] if joint else []), *cells])
            reasons.append("")
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(header) - 1)]
    lines = []
    for row, reason in zip(rows, reasons, strict=True):
        aligned = [cell.rjust(width) for cell, width in zip(row, widths, strict=False)]
        solved = len(row) == len(header)
        lines.append(
            "  ".join([*aligned, row[-1]]).rstrip() if solved else f"{aligned[0]}  not solved: {reason}"[:_WIDTH]
        )
    return lines


def _sources(fix: Fix | JointFix) -> tuple[Solution | Source, ...]:
    """Sources of the best solution of a fix."""
    if not fix.solutions:
        return ()
    best = fix.solutions[0]
    return (best,) if isinstance(best, Solution) else best.sources


def _cells(fix: Fix | JointFix, source: Solution | Source, per_m: float, decimals: int, *, too_near: bool) -> list[str]:
    best, others = fix.solutions[0], len(fix.solutions) - 1
    deviations = np.sqrt(np.diagonal(source.covariance))
    of_position = deviations[:3] if deviations.size == 6 else np.zeros(3)
    flags = [
        *(_of_uncertainty(source, misfit=is_misfit(fix)) if fix.detected else ["weak"]),
        *([f"+{others}({100.0 * best.weight:.0f}%)"] if others else []),
        *(["misfit"] if is_misfit(fix) else []),
        *(["merged"] if isinstance(source, Source) and source.merged else []),
        *(["near"] if too_near else []),
        *(f"-{name}" for name in fix.dropped),
    ]
    strength = float(np.linalg.norm(source.moment_Am2))
    along = source.moment_Am2 / strength if strength else np.zeros(3)
    of_strength = float(np.sqrt(along @ source.covariance[-3:, -3:] @ along))
    return [
        *(f"{value * per_m:.{decimals}f}" for value in source.position_m),
        *(_two_digits(value * per_m) for value in of_position),
        f"{strength:.4g}",
        *([] if isinstance(source, Source) else [_two_digits(of_strength)]),
        f"{best.chi2:.1f}/{best.dof}",
        _intervals(source.range_interval95_m, per_m),
        ",".join(flags),
    ]


def _of_uncertainty(source: Solution | Source, *, misfit: bool) -> list[str]:
    """What has to be said of the standard deviations; of a misfit that alone."""
    if not source.range_observable:
        return ["range?"]
    return [] if source.gaussian or misfit else ["bent"]


def _two_digits(value: float) -> str:
    """Two significant digits, without an exponent where that is short."""
    if value == 0.0:
        return "0"
    if not 1e-3 <= value < 1e5:
        return f"{value:.1e}"
    return np.format_float_positional(value, precision=2, unique=False, fractional=False, trim="-")


def _intervals(intervals: Sequence[tuple[float, float | None]], per_m: float) -> str:
    return ",".join(f"{low * per_m:.4g}.." + ("" if high is None else f"{high * per_m:.4g}") for low, high in intervals)


def track_table(points: Sequence[TrackPoint]) -> list[str]:
    """Aligned lines: a header, then one for every row."""
    header = ["time_s", "x_m", "y_m", "z_m", "s_x_m", "s_y_m", "s_z_m", "m_Am2", "nis", "status"]
    rows = [header]
    for point in points:
        if point.position_m is None or point.moment_Am2 is None or point.covariance is None:
            rows.append([f"{point.time_s:.10g}", *["-"] * 8, point.status])
            continue
        deviations = np.sqrt(np.diagonal(point.covariance)[:3])
        rows.append(
            [
                f"{point.time_s:.10g}",
                *(f"{value:.3f}" for value in point.position_m),
                *(f"{value:.2g}" for value in deviations),
                f"{np.linalg.norm(point.moment_Am2):.4g}",
                f"{point.nis:.1f}/{point.nis_dof}" if np.isfinite(point.nis) else "-",
                point.status if point.range_observable or point.centroid_m is None else f"{point.status}, range?",
            ]
        )
    widths = [max(len(row[i]) for row in rows) for i in range(len(header) - 1)]
    return [
        "  ".join([*(cell.rjust(width) for cell, width in zip(row, widths, strict=False)), row[-1]]) for row in rows
    ]


def report(result: Consistency) -> list[str]:
    """Errors against the truth, and what they should be."""
    lines = [
        f"against the truth, {result.tracked_rows} of {result.rows} rows tracked:",
        f"  position rms {result.position_rms_m:.4g} m",
    ]
    if np.isfinite(result.position_bound_m):
        ratio = result.position_rms_m / result.position_bound_m
        lines[-1] += (
            f", least possible {result.position_bound_m:.4g} m on average over such motions (posterior Cramér-Rao"
            f" bound), ratio {ratio:.2f}"
        )
    for name, value, (low, high) in (
        ("NEES", result.nees_per_dimension, result.nees_bounds),
        ("NIS", result.nis_per_dimension, result.nis_bounds),
    ):
        lines.append(f"  {name} per dimension {value:.3f}, 99 % bounds for independent rows {low:.3f} to {high:.3f}")
    return lines
