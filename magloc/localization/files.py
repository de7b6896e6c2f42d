"""Fixes as JSON."""

from __future__ import annotations

from collections.abc import Iterator

from magloc.localization.fit.fixes import BODY_MATTERS, Fixes
from magloc.localization.fit.results import Fix, Solution, values_of

_SOURCE_KEYS = ("position_m", "moment_Am2", "covariance", "range_observable", "range_interval95_m", "gaussian")


def entries_of_fixes(fixes: Fixes, *, joint: bool) -> Iterator[dict[str, object]]:
    """Return the results that ``magloc locate --json`` prints.

    `joint`: every solution has a list of its sources, also for one.
    """
    for fix, misfit, factor in zip(fixes, fixes.misfit.tolist(), fixes.body_factor.tolist(), strict=True):
        yield _fix_entry(fix, joint=joint, misfit=misfit, body_factor=factor)


def _fix_entry(fix: Fix, *, joint: bool, misfit: bool, body_factor: float) -> dict[str, object]:
    solutions = [_solution_entry(solution, joint) for solution in fix.solutions]
    flags = values_of(fix, ("reason", "dropped_sensors", "saturated_channels", "too_near"))
    flags |= {"misfit": misfit, "body_length_m": fix.body_length_m}
    flags["body_factor"] = body_factor if body_factor > BODY_MATTERS else None
    entry = {"time_s": fix.time_s, "detected": fix.detected, "solutions": solutions}
    return entry | {name: value for name, value in flags.items() if value}


def _solution_entry(solution: Solution, joint: bool) -> dict[str, object]:
    whole = values_of(solution, ("chi2", "dof", "iterations")) | {"converged": True, "weight": solution.weight}
    if not joint:
        return values_of(solution.source, _SOURCE_KEYS) | whole
    sources = [values_of(source, (*_SOURCE_KEYS, "merged")) for source in solution.sources]
    return {"sources": sources, "covariance": solution.covariance} | whole
