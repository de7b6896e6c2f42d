"""What fixes look like in JSON."""

from __future__ import annotations

from magloc.localization.fit.fixes import BODY_MATTERS, Fixes
from magloc.localization.fit.results import Fix, Solution, Source


def json_of_fixes(fixes: Fixes, *, joint: bool) -> dict[str, object]:
    """What ``magloc locate --json`` prints; `joint`: every solution has a list of its sources, also for one."""
    return {"results": [_entry(fix, joint) for fix in fixes]}


def _entry(fix: Fix, joint: bool) -> dict[str, object]:
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
        "misfit": fix.misfit,
        "body_length_m": fix.body_length_m,
        "body_factor": fix.body_factor if fix.body_factor > BODY_MATTERS else None,
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
