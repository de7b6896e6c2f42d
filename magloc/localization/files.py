"""What a fix looks like in JSON, in the world frame, and what has to be said of all of them on stderr."""

from __future__ import annotations

from magloc.localization.fit.results import AnyFix, Fix
from magloc.localization.uncertainty.covariance import is_misfit

_JSON_KEYS = (
    "position_m",
    "moment_Am2",
    "covariance",
    "chi2",
    "dof",
    "iterations",
    "converged",
    "range_observable",
    "range_interval95_m",
    "gaussian",
    "weight",
)
_SOURCE_KEYS = (
    "position_m",
    "moment_Am2",
    "covariance",
    "range_observable",
    "range_interval95_m",
    "gaussian",
    "merged",
)
_JOINT_KEYS = ("covariance", "chi2", "dof", "iterations", "converged", "weight")


def json_entry(time_s: float, fix: AnyFix, saturated: tuple[str, ...], near: bool) -> dict[str, object]:
    """What ``--json`` prints of one row."""
    solutions: list[dict[str, object]]
    if isinstance(fix, Fix):
        solutions = [{key: getattr(solution, key) for key in _JSON_KEYS} for solution in fix.solutions]
    else:
        solutions = [
            {
                "sources": [{key: getattr(source, key) for key in _SOURCE_KEYS} for source in solution.sources],
                **{key: getattr(solution, key) for key in _JOINT_KEYS},
            }
            for solution in fix.solutions
        ]
    entry: dict[str, object] = {"time_s": time_s, "detected": fix.detected, "solutions": solutions}
    if fix.reason:
        entry["reason"] = fix.reason
    if fix.dropped:
        entry["dropped_sensors"] = fix.dropped
    if saturated:
        entry["saturated_channels"] = saturated
    if near:
        entry["too_near"] = True
    if is_misfit(fix):
        entry["misfit"] = True
    return entry
