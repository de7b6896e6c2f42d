"""Fixes as a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from arrays.typing import FloatArray

if TYPE_CHECKING:
    from magloc.localization.fit.fixes import Fixes
    from magloc.localization.fit.results import Fix, Source

_WIDTH = 100
_MILLIMETRES_BELOW_M = 1.0


def lines_of_fixes(fixes: Fixes, *, joint: bool | None = None, most: int | None = None) -> list[str]:
    """Aligned lines of a table: a header, then one for every source of the best solution of every fix.

    Lengths are in mm if most positions are within a metre, else in m. `joint` adds the number of the source, by default
    where some row has several; `most` keeps the first and the last rows.
    """
    shown = list(range(len(fixes)))
    if most is not None and len(shown) > most:
        shown = shown[: most // 2] + shown[-(most // 2) :]
    solved = fixes.solutions.chosen(fixes.best[fixes.solved])
    if joint is None:
        joint = bool((solved.n_sources > 1).any())
    distances = np.linalg.norm(solved.position_m, axis=-1)
    distances = distances[np.isfinite(distances)]
    in_mm = bool(distances.size) and float(np.median(distances)) < _MILLIMETRES_BELOW_M
    unit, per_m, decimals = ("mm", 1e3, 2) if in_mm else ("m", 1.0, 3)

    lengths = [f"{name}_{unit}" for name in ("x", "y", "z", "s_x", "s_y", "s_z", "range95")]
    header = [
        "time_s",
        *(["source"] if joint else []),
        *lengths[:6],
        "m_Am2",
        "s_m",
        "chi2/dof",
        lengths[6],
        "flags",
    ]
    rows, reasons, middle = [header], [""], 0
    for place, fix in enumerate(fixes[i] for i in shown):
        middle = len(rows) if place == len(shown) // 2 else middle
        sources = fix.best.sources if fix.solutions else ()
        if not sources:
            rows.append([f"{fix.time_s:.10g}"])
            reasons.append(fix.reason)
        for k, source in enumerate(sources):
            cells = _cells(fix, source, per_m, decimals)
            rows.append([f"{fix.time_s:.10g}", *([str(k + 1)] if joint else []), *cells])
            reasons.append("")
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(header) - 1)]
    lines = []
    for row, reason in zip(rows, reasons, strict=True):
        aligned = [cell.rjust(width) for cell, width in zip(row, widths, strict=False)]
        complete = len(row) == len(header)
        lines.append(
            "  ".join([*aligned, row[-1]]).rstrip() if complete else f"{aligned[0]}  not solved: {reason}"[:_WIDTH]
        )
    if len(shown) < len(fixes):
        lines.insert(middle, f"… {len(fixes)} rows")
    return lines


def _cells(fix: Fix, source: Source, per_m: float, decimals: int) -> list[str]:
    best, others = fix.best, len(fix.solutions) - 1
    covariance = np.zeros((6, 6)) if source.covariance is None else source.covariance
    deviations = np.sqrt(np.diagonal(covariance))
    of_position = deviations[:3] if deviations.size == 6 else np.zeros(3)
    flags = [
        *(_of_uncertainty(source, misfit=fix.misfit) if fix.detected else ["weak"]),
        *([f"+{others}({100.0 * best.weight:.0f}%)"] if others else []),
        *(["misfit"] if fix.misfit else []),
        *(["merged"] if source.merged else []),
        *(["near"] if fix.too_near else []),
        *(f"-{name}" for name in fix.dropped_sensors),
    ]
    return [
        *(f"{value * per_m:.{decimals}f}" for value in source.position_m),
        *(_two_digits(value * per_m) for value in of_position),
        *cells_of_strength(source.moment_Am2, covariance[-3:, -3:]),
        f"{best.chi2:.1f}/{best.dof}",
        _intervals(source.range_interval_m, per_m),
        ",".join(flags),
    ]


def cells_of_strength(moment_Am2: FloatArray, covariance: FloatArray) -> tuple[str, str]:
    """Modulus of a moment, and its standard deviation by the covariance (3, 3) of the moment."""
    strength = float(np.linalg.norm(moment_Am2))
    spread = float(np.sqrt(np.trace(covariance)))
    if strength <= 1e-6 * spread:  # the mean of two moments that differ in sign has no direction
        return "0", _two_digits(spread)
    along = moment_Am2 / strength
    return f"{strength:.4g}", _two_digits(float(np.sqrt(along @ covariance @ along)))


def _of_uncertainty(source: Source, *, misfit: bool) -> list[str]:
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
