"""Fixes as a table for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from magloc.fix import Fix, Solution

_WIDTH = 100
_MILLIMETRES_BELOW_M = 1.0


def fix_table(times_s: Sequence[float], fixes: Sequence[Fix]) -> list[str]:
    """Lines of a table: a header, then one line for the best solution of every fix.

    Parameters
    ----------
    times_s : sequence of float
        Times of the rows [s].
    fixes : sequence of Fix

    Returns
    -------
    list of str
        Aligned columns separated by spaces. Lengths are in mm if most of the positions are within a metre, else in m.
    """
    best = [fix.solutions[0] if fix.solutions else None for fix in fixes]
    distances = [float(np.linalg.norm(solution.position_m)) for solution in best if solution]
    in_mm = bool(distances) and float(np.median(distances)) < _MILLIMETRES_BELOW_M
    unit, per_m, decimals = ("mm", 1e3, 2) if in_mm else ("m", 1.0, 3)

    lengths = [f"{name}_{unit}" for name in ("x", "y", "z", "s_x", "s_y", "s_z", "range95")]
    header = ["time_s", *lengths[:6], "m_Am2", "chi2/dof", lengths[6], "flags"]
    rows = [header]
    for time, fix, solution in zip(times_s, fixes, best, strict=True):
        cells = _cells(solution, per_m, decimals, others=len(fix.solutions) - 1) if solution else []
        rows.append([f"{time:.10g}", *cells])
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(header) - 1)]
    lines = []
    for row, reason in zip(rows, ["", *(fix.reason for fix in fixes)], strict=True):
        aligned = [cell.rjust(width) for cell, width in zip(row, widths, strict=False)]
        solved = len(row) == len(header)
        lines.append(
            "  ".join([*aligned, row[-1]]).rstrip() if solved else f"{aligned[0]}  not solved: {reason}"[:_WIDTH]
        )
    return lines


def _cells(solution: Solution, per_m: float, decimals: int, *, others: int) -> list[str]:
    deviations = np.sqrt(np.diagonal(solution.covariance)[:3])
    flags = [
        *([] if solution.range_observable else ["range?"]),
        *([f"+{others}"] if others else []),
    ]
    return [
        *(f"{value * per_m:.{decimals}f}" for value in solution.position_m),
        *(_two_digits(value * per_m) for value in deviations),
        f"{np.linalg.norm(solution.moment_Am2):.4g}",
        f"{solution.chi2:.1f}/{solution.dof}",
        _intervals(solution.range_interval95_m, per_m),
        ",".join(flags),
    ]


def _two_digits(value: float) -> str:
    """Two significant digits, without an exponent where that is short."""
    if not 1e-3 <= value < 1e5:
        return f"{value:.1e}"
    return np.format_float_positional(value, precision=2, unique=False, fractional=False, trim="-")


def _intervals(intervals: Sequence[tuple[float, float | None]], per_m: float) -> str:
    return ",".join(f"{low * per_m:.4g}.." + ("" if high is None else f"{high * per_m:.4g}") for low, high in intervals)
