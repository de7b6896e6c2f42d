"""What fixes look like in JSON."""

from __future__ import annotations

from collections.abc import Iterator

from magloc.localization.fit.fixes import BODY_MATTERS, Fixes
from magloc.localization.fit.results import Fix, Solution, Source


def entries_of_fixes(fixes: Fixes, *, joint: bool) -> Iterator[dict[str, object]]:
    """Results that ``magloc locate --json`` prints; `joint`: every solution has a list of its sources, also for one."""
    for fix, misfit, factor in zip(fixes, fixes.misfit.tolist(), fixes.body_factor.tolist(), strict=True):
        yield _entry(fix, joint=joint, misfit=misfit, body_factor=factor)


def _entry(fix: Fix, *, joint: bool, misfit: bool, body_factor: float) -> dict[str, object]:
    entry: dict[str, object] = {
        "time_s": fix.time_s,
        "detected": fix.detected,
        "solutions": [_of_solution(solution, joint) for solution in fix.solutions],
    }
    flags = {
        "reason": fix.reason,
        "dropped_sensors": fix.dropped_sensors,
        "saturated_channels": fix.saturated_channels,
        "too_near": fix.too_near,
        "misfit": misfit,
        "body_length_m": fix.body_length_m,
        "body_factor": body_factor if body_factor > BODY_MATTERS else None,
    }
    return entry | {name: value for name, value in flags.items() if value}


def _of_solution(solution: Solution, joint: bool) -> dict[str, object]:
    whole: dict[str, object] = {
        "chi2": solution.chi2,
        "dof": solution.dof,
        "iterations": solution.iterations,
        "converged": True,
        "weight": solution.weight,
    }
    if not joint:
        return _of_source(solution.source) | whole
    sources = [_of_source(source) | {"merged": source.merged} for source in solution.sources]
    return {"sources": sources, "covariance": solution.covariance} | whole


def _of_source(source: Source) -> dict[str, object]:
    return {
        "position_m": source.position_m,
        "moment_Am2": source.moment_Am2,
        "covariance": source.covariance,
        "range_observable": source.range_observable,
        "range_interval95_m": source.range_interval_m,
        "gaussian": source.gaussian,
    }
