"""``magloc design``: positions of an array's sensors, or of a body's magnets."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter
from cyclopts.validators import Number

import arrays
import magloc
from arrays.io.errors import InputError, naming
from arrays.io.outputs import refuse_one_for_two, refuse_unwritable
from magloc.cli.framework import CommonOptions, Flag, note, print_result, progress, whole_number

_DEFAULT_TASK = "half-space-2m"
Sensors = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1, lte=1000))]

if TYPE_CHECKING:
    from arrays.array import SensorArray
    from magloc.design.evaluation import Judgement
    from magloc.design.optimise import Design
    from magloc.design.task import DesignTask


def design(
    task: str = _DEFAULT_TASK,
    /,
    *,
    out: Path | None = None,
    png: Path | None = None,
    json: Flag = False,
    counts: Annotated[list[Sensors] | None, Parameter(consume_multiple=True)] = None,
    array: Path | None = None,
    body: Path | None = None,
    out_body: Path | None = None,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Optimise the positions of an array's sensors for the sources that it has to locate.

    Minimises a quantile or the mean, over sources and moments, of the Cramér-Rao bound of the range. Compares the
    array with a tetrahedron, a cube and a cross of the same span, and with an even grid of as many sensors in the same
    volume. An interrupted command writes the best array so far.

    With --array and --body, places the magnets of the body instead, and turns their moments, for the smallest bound of
    the pose over the limits of the body file. Prints the bounds of magloc bounds --body before and after.

    Parameters
    ----------
    task : str
        Built-in task, or task file (TOML) with sensors, volume or surface, sources and criterion. With --body a task
        file with magnets and volume; sensors move too if it has sensors and sensor_volume.
    out : Path
        Array file to write; by default design-TASK.toml. With --body only if sensors move.
    png : Path
        Picture to write (.png): the sensors, and the standard deviation of the range over the distance.
    json : bool
        Print one JSON object with the array and the comparison.
    counts : list of int
        Numbers of sensors, instead of the task's. Writes one array each, NAME-NUMBER.toml, and shows the gain of more
        sensors.
    array : Path
        Array file (TOML) of the sensors about the body.
    body : Path
        Body file (TOML) of a rigid body of two or more magnets, with limits of its position.
    out_body : Path
        Body file to write; by default design-TASK-body.toml.
    common : CommonOptions
        Common options.
    """
    if body is not None:
        _design_body(task, array, body, out_body, out, {"--png": png, "--counts": counts}, common.seed, as_json=json)
        return
    for name, path in (("--array", array), ("--out-body", out_body)):
        if path is not None:
            raise InputError(f"{name}: found no --body, expected the body file.")
    wanted = magloc.DesignTask.read(task)
    target = Path(f"design-{wanted.name}.toml") if out is None else out
    if counts:
        with naming(task):
            tasks = [replace(wanted, n_sensors=count) for count in sorted(set(counts))]
        _compare_counts(tasks, target, png, json=json, common=common)
        return
    refuse_one_for_two({"--out": target, "--png": png})
    refuse_unwritable(target, "--out")
    refuse_unwritable(png, "--png", ".png")
    best: list[SensorArray] = []
    begin = time.perf_counter()
    try:
        with progress(wanted.search.n_steps, "steps") as advance, naming(task):
            result = magloc.design_array(wanted, rng=common.seed, progress=advance, better=best.append)
    except KeyboardInterrupt:
        if not best:
            raise KeyboardInterrupt("interrupted: nothing is written, no start had been judged") from None
        arrays.write_array(target, best[-1])
        raise KeyboardInterrupt(f"interrupted: the best array so far is in {target}") from None
    seconds = time.perf_counter() - begin
    arrays.write_array(target, result.array)
    if png is not None:
        magloc.plots.save(result.plot(common.seed), png)
    print_result(_report(result, target, png, seconds), [*_table(result), "", *_findings(result)], as_json=json)
    if json:
        return
    drawn = "" if png is None else f" and {png}"
    note(
        f"{result.n_converged} of {result.n_descents} refined starts converged, {seconds:.1f} s; wrote {target}{drawn}"
    )


def _design_body(
    task: str,
    array: Path | None,
    body: Path,
    out_body: Path | None,
    out: Path | None,
    of_arrays: Mapping[str, object],
    seed: int,
    *,
    as_json: bool,
) -> None:
    """Design a body; refuse options of an array's design."""
    from magloc.cli.moments.body_design import design_with_body
    from magloc.cli.moments.body_poses import refuse_with_body

    refuse_with_body(of_arrays)
    if array is None:
        raise InputError("--body: found no --array, expected the array file.")
    if task == _DEFAULT_TASK:
        raise InputError("--body: found no task file, expected one with the tables magnets and volume.")
    design_with_body(task, array, body, out_body, out, seed, as_json=as_json)


def _compare_counts(
    tasks: Sequence[DesignTask], out: Path, png: Path | None, *, json: bool, common: CommonOptions
) -> None:
    """Design arrays of several numbers of sensors, and show the gain of more sensors."""
    from magloc.design.evaluation import EVEN

    targets = [out.with_name(f"{out.stem}-{task.n_sensors}{out.suffix}") for task in tasks]
    for path in targets:
        refuse_one_for_two({"--out": path, "--png": png})
        refuse_unwritable(path, "--out")
    refuse_unwritable(png, "--png", ".png")
    results = []
    with progress(sum(task.search.n_steps for task in tasks), "steps") as advance:
        for task, path in zip(tasks, targets, strict=True):
            with naming(task.name):
                results.append(magloc.design_array(task, rng=common.seed, progress=advance))
            arrays.write_array(path, results[-1].array)
    if png is not None:
        magloc.plots.save(magloc.plots.design_counts(results), png)
    grids = [next(judged for judged in result.judged if judged.name == EVEN) for result in results]
    rows: list[dict[str, Any]] = [
        {
            "sensors": result.task.n_sensors,
            "criterion_m": result.judged[0].criterion_m,
            "even_grid_m": grid.criterion_m,
            "design_gain": grid.gain,
            "design_gain_standard_error": grid.gain_error,
            "positions_m": result.array.positions,
            "out": str(path),
        }
        for result, grid, path in zip(results, grids, targets, strict=True)
    ]
    lines = [f"{tasks[0].criterion} of the range's standard deviation, on independent sources"]
    lines.append(f"{'sensors':>7}{'design_m':>11}{'even_grid_m':>13}{'gain_%':>8}{'±':>5}")
    for row in rows:
        gain, error = 100.0 * row["design_gain"], 100.0 * row["design_gain_standard_error"]
        sigma, grid_sigma = _number(row["criterion_m"]), _number(row["even_grid_m"])
        lines.append(f"{row['sensors']:>7}{sigma:>11}{grid_sigma:>13}{gain:>8.1f}{error:>5.1f}")
    report = {"task": tasks[0].name, "criterion": str(tasks[0].criterion), "counts": rows}
    print_result(report, lines, as_json=json)


def _report(result: Design, out: Path, png: Path | None, seconds: float) -> dict[str, Any]:
    return {
        "task": result.task.name,
        "criterion": str(result.task.criterion),
        "converged": result.converged,
        "converged_starts": result.n_converged,
        "refined_starts": result.n_descents,
        "positions_m": result.array.positions,
        "fitted_m": result.fitted_m,
        "best_start_m": result.start_m,
        "near_optimal": list(result.near_optimal),
        "worst_found_m": result.worst_m,
        "worst_is_bounded": result.worst_is_bounded,
        "arrays": [_of_array(judged) for judged in result.judged],
        "seconds": seconds,
        "out": str(out),
        "png": None if png is None else str(png),
    }


def _of_array(judged: Judgement) -> dict[str, Any]:
    return {
        "name": judged.name,
        "sensors": judged.array.n_sensors,
        "fits_volume": judged.fits,
        "criterion_m": judged.criterion_m,
        "design_gain": judged.gain,
        "design_gain_standard_error": judged.gain_error,
        "distance_m": judged.distance_m,
        **{f"sigma_range_{name}": values for name, values in judged.sigma_range._asdict().items()},
        "sigma_bearing_q95_rad": judged.bearing_q95_rad,
    }


def _table(result: Design) -> list[str]:
    """Return the bounds of all arrays at all distances."""
    statistics = "".join(f"{name:>11}" for name in ("q50_m", "q95_m", "mean_m"))
    head = f"{'array':<24}{'sensors':>8}{'distance_m':>12}{statistics}{'bearing_q95_deg':>17}"
    lines = ["standard deviations of range and bearing (Cramér-Rao bounds)", head]
    for judged in result.judged:
        if not math.isfinite(judged.criterion_m):
            continue
        for i, distance in enumerate(judged.distance_m):
            bearing = math.degrees(judged.bearing_q95_rad[i])
            lines.append(
                f"{judged.name[:23] if i == 0 else '':<24}{judged.array.n_sensors if i == 0 else '':>8}{distance:>12g}"
                + "".join(f"{_number(value):>11}" for value in (values[i] for values in judged.sigma_range))
                + f"{_number(bearing) if bearing < 180.0 else 'unknown':>17}"
            )
    return lines


def _findings(result: Design) -> list[str]:
    """Return the conclusions of the table."""
    from magloc.design.evaluation import EVEN
    from magloc.design.optimise import NEAR_OPTIMAL

    criterion = result.task.criterion
    own = result.judged[0]
    lines = [f"{criterion} of the range's standard deviation: {_number(own.criterion_m)} m, on independent sources"]
    for other in result.judged[1:]:
        lines.append(f"  {_comparison(other)}")
    lines += [
        f"The {name} of the same {'volume' if name == EVEN else 'span'} is near-optimal for this task: the design gains"
        f" less than {100.0 * NEAR_OPTIMAL:g} % on it."
        for name in result.near_optimal
    ]
    lines.append(_worst_case(result))
    if not result.converged:
        lines.append("The descent to this array did not converge: slightly better arrays may be near.")
    return lines


def _worst_case(result: Design) -> str:
    if result.worst_is_bounded:
        return f"Worst case that was found: {_number(result.worst_m)} m."
    text = "The worst case is infinite: at isolated directions and moments the differences lose rank"
    four_vector_sensors = result.task.kind == "vector" and result.task.n_sensors == 4
    return f"{text}, as every array of four vector sensors does." if four_vector_sensors else f"{text}."


def _comparison(other: Judgement) -> str:
    outside = "" if other.fits else ", outside the volume"
    name = f"{other.name} ({other.array.n_sensors} sensors{outside})"
    if not math.isfinite(other.criterion_m):
        return f"{name}: determines no range"
    better = "better" if other.gain >= 0.0 else "worse"
    return (
        f"{name}: {_number(other.criterion_m)} m, the design is {100.0 * abs(other.gain):.1f} ±"
        f" {100.0 * other.gain_error:.1f} % {better}"
    )


def _number(value: float) -> str:
    return f"{value:.4g}" if math.isfinite(value) else "infinite"
