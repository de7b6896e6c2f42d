"""Fixes as a text table."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.tables import by_sigma
from arrays.typing import FloatArray
from magloc.localization.fit.results import intervals_of, is_observable_set

if TYPE_CHECKING:
    from magloc.localization.fit.fixes import Fixes

_WIDTH = 100
_MILLIMETRES_BELOW_M = 1.0
_MEANINGS = {
    r"\bbent\b": "bent: errors are not Gaussian, trust range95 rather than s",
    r"\brange\?": "range?: the readings do not determine the distance, s is widened to cover its 95 % set",
    r"\+\d+\(\d+%\)": "+1(95%): one other solution fits almost as well, the best one has 95 % of the probability",
    r"\bmerged\b": "merged: two sources that the array cannot separate",
}


def lines_of_fixes(fixes: Fixes, *, joint: bool | None = None, most: int | None = None) -> list[str]:
    """Return aligned lines: a header, then one per source of the best solution of every fix.

    Lengths are in mm if most positions are within a metre, otherwise in m. `joint` adds the number of the source; by
    default it does if some row has several. `most` limits the lines to the first and the last rows.
    """
    shown = list(range(len(fixes)))
    if most is not None and len(shown) > most:
        shown = shown[: most // 2] + shown[-(most // 2) :]
    solved = fixes.solutions.select(fixes.best[fixes.solved])
    if joint is None:
        joint = bool((solved.n_sources > 1).any())
    distances = np.linalg.norm(solved.position_m, axis=-1)
    distances = distances[np.isfinite(distances)]
    in_mm = bool(distances.size) and float(np.median(distances)) < _MILLIMETRES_BELOW_M
    unit, per_m = ("mm", 1e3) if in_mm else ("m", 1.0)

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
    for place, (i, cells) in enumerate(zip(shown, _cells_of_rows(fixes, shown, per_m), strict=True)):
        middle = len(rows) if place == len(shown) // 2 else middle
        time = f"{fixes.time_s[i]:.10g}"
        if not cells:
            rows.append([time])
            reasons.append(fixes.reason[i])
        for k, of_source in enumerate(cells):
            rows.append([time, *([str(k + 1)] if joint else []), *of_source])
            reasons.append("")
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(header) - 1)]
    widest = sum(widths) + max(len(row[-1]) for row in rows if len(row) == len(header)) + 2 * len(widths)
    gap = "  " if widest <= _WIDTH else " "
    lines = []
    for row, reason in zip(rows, reasons, strict=True):
        aligned = [cell.rjust(width) for cell, width in zip(row, widths, strict=False)]
        complete = len(row) == len(header)
        lines.append(
            gap.join([*aligned, row[-1]]).rstrip() if complete else f"{aligned[0]}  not solved: {reason}"[:_WIDTH]
        )
    if len(shown) < len(fixes):
        lines.insert(middle, f"… {len(fixes)} rows")
    return lines


def _cells_of_rows(fixes: Fixes, shown: list[int], per_m: float) -> Iterator[list[list[str]]]:
    """Return the cells of the sources of the best solution of some rows."""
    solved = [i for i in shown if fixes.solved[i]]
    best = fixes.solutions.select(fixes.best[solved])
    blocks = best.covariance_of_source
    deviations = np.sqrt(np.einsum("fkii->fki", blocks))
    of_position = deviations[..., :3] if deviations.shape[-1] == 6 else np.zeros(best.position_m.shape)
    strengths, spreads = _strengths(best.moment_Am2, blocks[..., -3:, -3:])
    place, misfit = dict(zip(solved, range(len(solved)), strict=True)), fixes.misfit
    for i in shown:
        j = place.get(i)
        if j is None:
            yield []
            continue
        others = len(fixes.of_row(i)) - 1
        of_row = [
            *([f"+{others}({100.0 * best.weight[j]:.0f}%)"] if others else []),
            *(["misfit"] if misfit[i] else []),
        ]
        behind = [*(["near"] if fixes.too_near[i] else []), *(f"-{name}" for name in fixes.dropped_sensors[i])]
        cells = []
        for k in range(best.n_sources[j]):
            intervals = intervals_of(best.ranges[j, k])
            uncertain = ["weak"]
            if fixes.detected[i]:
                uncertain = _uncertainty_notes(is_observable_set(intervals), bool(best.gaussian[j, k] or misfit[i]))
            flags = [*uncertain, *of_row, *(["merged"] if best.merged[j, k] else []), *behind]
            cells.append(
                [
                    *cells_of_vector(per_m * best.position_m[j, k], per_m * of_position[j, k]),
                    *by_sigma(float(strengths[j, k]), float(spreads[j, k])),
                    f"{best.chi2[j]:.1f}/{best.dof[j]}",
                    _intervals(intervals, per_m),
                    ",".join(flags),
                ]
            )
        yield cells


def legend(lines: Iterable[str]) -> list[str]:
    """Return explanations of the flags in a table that no other note explains."""
    text = "\n".join(lines)
    return [meaning for flag, meaning in _MEANINGS.items() if re.search(flag, text)]


def cells_of_strength(moment_Am2: FloatArray, covariance: FloatArray) -> tuple[str, str]:
    """Return the modulus of a moment and its standard deviation, from its covariance (3, 3)."""
    strength, sigma = _strengths(moment_Am2, covariance)
    return by_sigma(float(strength), float(sigma))


def cells_of_vector(values: FloatArray, sigma: FloatArray) -> list[str]:
    """Return components (n,) and standard deviations (n,), rounded by the latter's digits."""
    pairs = [by_sigma(*pair) for pair in zip(values.tolist(), sigma.tolist(), strict=True)]
    return [cell for cells in zip(*pairs, strict=True) for cell in cells]


def _strengths(moment_Am2: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return moduli (...) of moments (..., 3) and their standard deviations.

    They are 0 for the mean of two that differ in sign.
    """
    strength = np.linalg.norm(moment_Am2, axis=-1)
    spread = np.sqrt(np.trace(covariance, axis1=-2, axis2=-1))
    has_direction = strength > 1e-6 * spread
    along = moment_Am2 / np.where(has_direction, strength, 1.0)[..., None]
    sigma = np.sqrt(np.einsum("...i,...ij,...j->...", along, covariance, along))
    return np.where(has_direction, strength, 0.0), np.where(has_direction, sigma, spread)


def _uncertainty_notes(observable: bool, described: bool) -> list[str]:
    """Return notes on the standard deviations: an unknown range, or errors that are not Gaussian."""
    if not observable:
        return ["range?"]
    return [] if described else ["bent"]


def _intervals(intervals: Sequence[tuple[float, float | None]], per_m: float) -> str:
    return ",".join(f"{low * per_m:.4g}.." + ("" if high is None else f"{high * per_m:.4g}") for low, high in intervals)
