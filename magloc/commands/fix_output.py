"""What a fix looks like in JSON, in the world frame, and what has to be said of all of them on stderr."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtrc

from arrays.sensor import SensorArray
from magloc.commands.common import print_note
from magloc.fix import Fix, JointFix, Solution, Source
from magloc.readings import Readings
from magloc.rivals import MISFIT

FloatArray = NDArray[np.float64]
AnyFix = Fix | JointFix
AnySource = TypeVar("AnySource", Solution, Source)

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


def in_world(fix: AnyFix, readings: Readings, row: int) -> AnyFix:
    """A fix in the world frame if the array's pose is known."""
    if readings.array_position_m is None or readings.array_rotation_xyzw is None:
        return fix
    origin, R = readings.array_position_m[row], Rotation.from_quat(readings.array_rotation_xyzw[row]).as_matrix()

    def turned(covariance: FloatArray) -> FloatArray:
        R_all = np.kron(np.eye(len(covariance) // 3), R)
        return R_all @ covariance @ R_all.T

    def moved(found: AnySource) -> AnySource:
        return replace(
            found,
            position_m=origin + R @ found.position_m,
            moment_Am2=R @ found.moment_Am2,
            covariance=turned(found.covariance),
        )

    if isinstance(fix, Fix):
        return replace(fix, solutions=tuple(moved(solution) for solution in fix.solutions))
    solutions = (
        replace(
            solution,
            sources=tuple(moved(source) for source in solution.sources),
            covariance=turned(solution.covariance),
        )
        for solution in fix.solutions
    )
    return replace(fix, solutions=tuple(solutions))


def saturated_channels(measured: Readings, rows: Readings, array: SensorArray) -> list[tuple[str, ...]]:
    """Names of the channels that saturate, for every row."""
    lost = np.isfinite(measured.values_T) & ~np.isfinite(rows.values_T)
    return [tuple(array.channel_names[channel] for channel in np.flatnonzero(row)) for row in lost]


def is_misfit(fix: AnyFix) -> bool:
    """Whether χ² is far beyond noise: then neither the position nor its standard deviations are to be trusted."""
    if not fix.solutions or fix.solutions[0].dof <= 0:
        return False
    return bool(chdtrc(fix.solutions[0].dof, fix.solutions[0].chi2) < MISFIT)


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


def warn_of(
    fixes: Sequence[AnyFix], saturated: Sequence[tuple[str, ...]], near: Sequence[bool], *, quiet: bool
) -> None:
    """Name what is wrong with the sensors and with the source, on stderr."""
    if quiet:
        return
    dropped = Counter(name for fix in fixes for name in fix.dropped)
    if dropped:
        print_note(f"warning: sensors that contradict all others are not used: {_rows_of(dropped)}")
    fewer = Counter(fix.reason for fix in fixes if fix.solutions and fix.reason)
    for reason, n in fewer.most_common():
        print_note(f"note: in {n} of {len(fixes)} rows {reason}")
    misfits = sum(is_misfit(fix) for fix in fixes)
    if misfits:
        print_note(
            f"warning: in {misfits} of {len(fixes)} rows χ² is far beyond noise: the noise is understated, or the model"
            " does not hold, and the standard deviations say too little"
        )
    weak = sum(bool(fix.solutions) and not fix.detected for fix in fixes)
    if weak:
        print_note(
            f"note: in {weak} of {len(fixes)} rows nothing stands out of the noise: their solutions are fits of noise,"
            " and a source may be at any range"
        )
    lost = Counter(name for names in saturated for name in names)
    if lost:
        print_note(f"warning: saturated readings are not used: {_rows_of(lost)}")
    if any(near):
        print_note(
            f"warning: in {sum(near)} of {len(near)} rows the source is too near, or too large, for a dipole: what is"
            " left has the pattern of an extended source, or it is nearer than three body lengths"
        )


def _rows_of(counts: Counter[str]) -> str:
    return ", ".join(f"{name} ({n} row{'s' if n > 1 else ''})" for name, n in counts.most_common())


def counted_reasons(reasons: Iterable[str], most: int = 3) -> str:
    """Reasons with the number of rows that each applies to, the commonest first."""
    counts = Counter(reasons).most_common()
    others = sum(n for _, n in counts[most:])
    parts = counts[:most] + [("other reasons", others)] * (others > 0)
    return "; ".join(f"{n} row{'s' if n > 1 else ''}: {reason}" for reason, n in parts)
