"""Text tables, align, with the significant digits of their standard deviations."""

from __future__ import annotations

import math
from collections.abc import Sequence

_FINEST, _LARGEST_TENS = 9, 1e7


def by_sigma(value: float, sigma: float) -> tuple[str, str]:
    """Format a value and its standard deviation, to two significant digits of the latter.

    If it is zero, infinite or unknown, the value has six digits.

    Examples
    --------
    >>> by_sigma(0.0600123, 5.7e-05), by_sigma(-12.345, 0.31), by_sigma(12345.6, 230.0)
    (('0.060012', '0.000057'), ('-12.35', '0.31'), ('12350', '230'))
    >>> by_sigma(0.06, 0.0)
    ('0.06', '0')
    """
    if not (math.isfinite(value) and math.isfinite(sigma) and sigma > 0.0):
        return f"{value:.6g}", f"{sigma:.2g}"
    rounded = float(f"{sigma:.1e}")
    decimals = 1 - math.floor(math.log10(rounded) + 1e-9)
    if decimals > _FINEST or max(abs(value), sigma) >= _LARGEST_TENS:
        digits = decimals + math.floor(math.log10(max(abs(value), rounded)) + 1e-9)
        return f"{value:.{digits}e}", f"{sigma:.1e}"
    shown = max(0, decimals)
    return f"{round(value, decimals) + 0.0:.{shown}f}", f"{rounded:.{shown}f}"


def align(rows: Sequence[Sequence[str]], left: int = 0) -> list[str]:
    """Align the cells of a table to the right, the first `left` ones to the left, the last not at all."""
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]) - 1)]
    lines = []
    for row in rows:
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=False)]
        cells[:left] = [cell.ljust(width) for cell, width in zip(row[:left], widths, strict=False)]
        lines.append("  ".join([*cells, row[-1]]).rstrip())
    return lines
