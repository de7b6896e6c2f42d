"""``magloc locate``: one fix for every row of a readings file."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from arrays.errors import InputError
from magloc.commands.common import CommonOptions, Flag, print_json, print_note, progress

if TYPE_CHECKING:
    from arrays.sensor import SensorArray
    from magloc.fix import Fix, Knowledge
    from magloc.readings import Readings

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_BOUNDS = re.compile(rf"(?:(?P<below>{_NUMBER})<(?=[xyz]<))?(?P<axis>[xyz])(?P<sign>[<>])(?P<bound>{_NUMBER})")

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
)


def locate(
    readings: Path,
    /,
    *,
    array: Path,
    sensors: str | None = None,
    average: Flag = False,
    region: str | None = None,
    max_moment_Am2: Annotated[float | None, Parameter(name="--max-moment-Am2")] = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Find the source in every row of a readings file, each row on its own.

    Positions are in the array's frame, or in the world frame if the readings have the array's pose. The table has the
    best solution of every row: s is the standard deviation, range95 the 95 % interval of the distance from the
    sensors' centroid. Flags: "range?" = the range is not observable, trust range95 and not s; "+2" = two other
    solutions fit almost as well, see --json.

    Parameters
    ----------
    readings : Path
        Readings file (CSV).
    array : Path
        Array file (TOML).
    sensors : str
        Ids of the sensors to use, separated by commas; columns of others are ignored. All by default.
    average : bool
        Average all rows to one fix. The array and the source must stand still.
    region : str
        Where the source is known to be, in m in the array's frame, as "z>0" or "-1<x<1,z>0"; solutions elsewhere are
        left out.
    max_moment_Am2 : float
        Largest moment that the source can have [A·m²]; solutions with a larger one are left out.
    json : bool
        Print one JSON object with every solution in place of the table.
    common : CommonOptions
        Common options.
    """
    from arrays.files import read_array
    from magloc.commands.fix_table import fix_table
    from magloc.locate import Locator
    from magloc.readings import read_readings

    ids = None if sensors is None else [name.strip() for name in sensors.split(",")]
    used = _vector_sensors(read_array(array), ids, array)
    rows = read_readings(readings, used, sensors=ids)
    if average:
        rows, used = _averaged(rows, used, readings)
    knowledge = _knowledge(region, max_moment_Am2)
    try:
        locator = Locator(used, knowledge=knowledge)
    except ValueError as error:
        place = array if region is None else f"--region {region}"
        raise InputError(f"{place}: {str(error).removeprefix('Input ')}") from None
    with progress(len(rows), "rows", quiet=common.quiet) as advance:
        fixes = locator.fit_rows(rows.values_T, advance)
    fixes = _in_world(fixes, rows)

    if json:
        print_json({"results": [_entry(time, fix) for time, fix in zip(rows.time_s.tolist(), fixes, strict=True)]})
    else:
        print("\n".join(fix_table(rows.time_s.tolist(), fixes)))
    reasons = _counted(fix.reason for fix in fixes if not fix.solutions)
    solved = sum(bool(fix.solutions) for fix in fixes)
    if not solved:
        raise InputError(f"{readings}: found no row that can be solved ({reasons}).")
    if not (json or common.quiet):
        print_note(f"{solved} of {len(fixes)} rows solved" + (f"; not solved: {reasons}" if reasons else ""))


def _vector_sensors(array: SensorArray, ids: Sequence[str] | None, path: Path) -> SensorArray:
    """The sensors of an array that the fixes use."""
    if ids is not None:
        for name in ids:
            if name not in array.ids:
                raise InputError(
                    f"--sensors: found {name!r}, expected ids of sensors in {path}: {', '.join(array.ids)}."
                )
        try:
            array = array.subset(ids)
        except ValueError as error:
            raise InputError(f"--sensors {','.join(ids)}: {error}") from None
    scalar = [sensor.id for sensor in array.sensors if sensor.kind == "scalar"]
    if scalar:
        raise InputError(f"{path}: found scalar sensors ({', '.join(scalar)}), expected vector sensors only.")
    return array


def _knowledge(region: str | None, largest_moment: float | None) -> Knowledge:
    """What the options say of the source."""
    from magloc.fix import Knowledge

    low, high = [-math.inf] * 3, [math.inf] * 3
    for part in [] if region is None else region.split(","):
        bounds = _BOUNDS.fullmatch(part.replace(" ", ""))
        if not bounds:
            raise InputError(f"--region: found {part.strip()!r}, expected bounds such as z>0 or -1<x<1, in m.")
        i = "xyz".index(bounds["axis"])
        lower = bounds["below"] or (bounds["bound"] if bounds["sign"] == ">" else None)
        upper = bounds["bound"] if bounds["sign"] == "<" else None
        low[i] = max(low[i], float(lower)) if lower else low[i]
        high[i] = min(high[i], float(upper)) if upper else high[i]
        if not low[i] < high[i]:
            raise InputError(
                f"--region: found {region!r}, expected bounds that leave some room along {bounds['axis']}."
            )
    if largest_moment is not None and not largest_moment > 0.0:
        raise InputError(f"--max-moment-Am2: found {largest_moment:g}, expected a positive number.")
    return Knowledge(
        (low[0], low[1], low[2]),
        (high[0], high[1], high[2]),
        math.inf if largest_moment is None else largest_moment,
    )


def _averaged(readings: Readings, array: SensorArray, path: Path) -> tuple[Readings, SensorArray]:
    from magloc.readings import average, averaging_array

    try:
        return average(readings), averaging_array(array, readings)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _in_world(fixes: Sequence[Fix], readings: Readings) -> list[Fix]:
    """Fixes in the world frame if the array's pose is known."""
    import numpy as np
    from scipy.spatial.transform import Rotation

    if readings.array_position_m is None or readings.array_rotation_xyzw is None:
        return list(fixes)
    world_from_array = Rotation.from_quat(readings.array_rotation_xyzw).as_matrix()
    moved = []
    for fix, origin, R in zip(fixes, readings.array_position_m, world_from_array, strict=True):
        R6 = np.kron(np.eye(2), R)
        solutions = (
            replace(
                solution,
                position_m=origin + R @ solution.position_m,
                moment_Am2=R @ solution.moment_Am2,
                covariance=R6 @ solution.covariance @ R6.T,
            )
            for solution in fix.solutions
        )
        moved.append(replace(fix, solutions=tuple(solutions)))
    return moved


def _entry(time_s: float, fix: Fix) -> dict[str, object]:
    """What ``--json`` prints of one row."""
    solutions = [{key: getattr(solution, key) for key in _JSON_KEYS} for solution in fix.solutions]
    entry: dict[str, object] = {"time_s": time_s, "solutions": solutions}
    return entry if solutions else {**entry, "reason": fix.reason}


def _counted(reasons: Iterable[str], most: int = 3) -> str:
    """Reasons with the number of rows that each applies to, the commonest first."""
    counts = Counter(reasons).most_common()
    others = sum(n for _, n in counts[most:])
    parts = counts[:most] + [("other reasons", others)] * (others > 0)
    return "; ".join(f"{n} row{'s' if n > 1 else ''}: {reason}" for reason, n in parts)
