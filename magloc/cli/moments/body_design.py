"""``magloc design --body``: positions and directions of the magnets of a body."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import arrays
from arrays.io.errors import InputError, naming
from arrays.io.outputs import refuse_one_for_two, refuse_unwritable
from magloc.cli.framework import note, print_result, progress

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.bodies.body import MagnetBody
    from magloc.design.bodies import BodyDesign


def design_with_body(
    task: str, array: Path, body: Path, out_body: Path | None, out: Path | None, seed: int, *, as_json: bool
) -> None:
    """Design a body, and the array about it if the task moves sensors; write both."""
    from magloc.bodies.body_file import read_body, write_body
    from magloc.design.bodies import design_body
    from magloc.design.body_task import read_body_task

    wanted = read_body_task(task)
    used, magnets = arrays.read_array(array), read_body(body)
    if out is not None and wanted.sensors is None:
        raise InputError(
            f"--out: found it with a fixed array, expected the tables sensors and sensor_volume in {task}."
        )
    target = Path(f"design-{wanted.name}-body.toml") if out_body is None else out_body
    of_array = None
    if wanted.sensors is not None:
        of_array = Path(f"design-{wanted.name}.toml") if out is None else out
    refuse_one_for_two({"--out-body": target, "--out": of_array})
    refuse_unwritable(target, "--out-body")
    refuse_unwritable(of_array, "--out")
    best: list[tuple[SensorArray, MagnetBody]] = []

    def write(new_array: SensorArray, new_body: MagnetBody) -> None:
        write_body(target, new_body)
        if of_array is not None:
            arrays.write_array(of_array, new_array)

    begin = time.perf_counter()
    try:
        with progress(wanted.search.n_steps, "steps") as advance, naming(str(body), array=str(array), task=task):
            result = design_body(
                wanted, used, magnets, rng=seed, progress=advance, better=lambda *device: best.append(device)
            )
    except KeyboardInterrupt:
        if not best:
            raise KeyboardInterrupt("interrupted: nothing is written, no start had been judged") from None
        write(*best[-1])
        raise KeyboardInterrupt(f"interrupted: the best body so far is in {target}") from None
    write(result.array, result.body)
    written = str(target) if of_array is None else f"{target} and {of_array}"
    report = _report(result) | {"seconds": time.perf_counter() - begin, "out_body": str(target)}
    report |= {} if of_array is None else {"out": str(of_array)}
    print_result(report, _lines(result), as_json=as_json)
    if not as_json:
        note(f"{result.n_converged} of {result.n_descents} refined starts converged; wrote {written}")


def _report(result: BodyDesign) -> dict[str, object]:
    before_m, after_m = result.criterion_m
    return {
        "task": result.task.name,
        "criterion": str(result.task.criterion),
        "lever_m": result.task.lever_m,
        "criterion_before_m": before_m,
        "criterion_after_m": after_m,
        "before": result.before.json() | {"nearest_m": result.nearest_m[0]},
        "after": result.after.json() | {"nearest_m": result.nearest_m[1]},
        "positions_m": result.body.positions_m,
        "moments_Am2": result.body.moments_Am2,
        "sensors_m": result.array.positions,
        "converged": result.converged,
    }


def _lines(result: BodyDesign) -> list[str]:
    lines = []
    for name, bounds, nearest_m in zip(
        ("before", "after"), (result.before, result.after), result.nearest_m, strict=True
    ):
        lines += [f"{name}: {bounds.lines()[0]}", *(f"  {line}" for line in bounds.lines()[1:])]
        lines.append(f"  nearest magnet to a sensor {1e3 * nearest_m:.3g} mm")
    before_mm, after_mm = (f"{1e3 * value:.4g}" for value in result.criterion_m)
    lines.append(
        f"{result.task.criterion} of position and {1e3 * result.task.lever_m:.3g} mm × rotation: {before_mm} mm before,"
        f" {after_mm} mm after"
    )
    return lines
