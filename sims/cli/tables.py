"""``adcs tables``: what the source paper's Tables 3 to 5 say, what we find, and the ratio."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import numpy as np
from cyclopts import Parameter

from adcs.cli.options import print_note
from adcs.io.scenario_files import AttitudeFile, read_scenario
from arrays.io.arguments import Count, Flag, Seed
from magloc.cli.framework import QuietOptions, print_json, progress
from sims.experiments.paper_tables import PAPER_ROWS, UNITS, PaperRow, Quantity

if TYPE_CHECKING:
    from sims.experiments.attitude import Part


_QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)


@Parameter(name="*")
@dataclass(frozen=True)
class TableOptions:
    """Runs.

    Parameters
    ----------
    seeds : int
        Number of runs of every row.
    seed : int
        Of the first run; the next ones follow.
    duration : float
        Seconds; by default 200 for Table 3 and 600 for the others.
    """

    seeds: Annotated[Count, Parameter(name=["--seeds", "--runs"])] = 10
    seed: Seed = 0
    duration: float | None = None


@dataclass(frozen=True)
class Comparison:
    """A number of the paper and ours.

    Attributes
    ----------
    table : int
    set : str
    filter : str
    quantity, unit : str
    paper_text : str
        As it can be read, (?) where it is unsure.
    paper_low, paper_high : float
    ours : float
        Standard deviation by the filter's covariance at the end, worst axis, mean over the runs.
    ratio : float
        Ours over the paper's.
    rms : float
        Of our errors in the last minute, worst axis.
    """

    table: int
    set: str
    filter: str
    quantity: str
    unit: str
    paper_text: str
    paper_low: float
    paper_high: float
    ours: float
    ratio: float
    rms: float


def tables(
    *,
    options: TableOptions = TableOptions(),
    out: Path | None = None,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Tables 3, 4 and 5 of the paper: its value, ours, and the ratio.

    Process noise and noise of the star tracker are the paper's, as far as they can be read. Ours is the standard
    deviation that the filter gives at the end, worst axis, the mean of the runs, and beside it the rms of its errors in
    the last minute. The attitude is half of the angle, as in the paper.

    Parameters
    ----------
    options : TableOptions
        Runs.
    out : Path, optional
        Folder for tables.csv.
    json : bool
        Print one JSON object.
    common : QuietOptions
        Common options.
    """
    from arrays.io.csv import write_columns
    from arrays.io.errors import InputError
    from arrays.io.outputs import make_folder, refuse_file

    if out is not None:
        refuse_file(out, "--out")
    if options.duration is not None and not 1.0 <= options.duration <= 1e7:
        raise InputError(f"--duration: found {options.duration:g} s, expected 1 to 1e7 s.")
    file = read_scenario("tabletsat")
    compared: list[Comparison] = []
    with progress(len(PAPER_ROWS), "rows", quiet=common.quiet) as advance:
        for row in PAPER_ROWS:
            compared += comparisons(file, row, options)
            advance(1)
    if out is not None:
        make_folder(out, "--out")
        names = list(asdict(compared[0]))
        write_columns({name: [getattr(one, name) for one in compared] for name in names}, out / "tables.csv")
        if not common.quiet:
            print_note(f"wrote tables.csv into {out}")
    if json:
        print_json({"rows": [asdict(one) for one in compared]})
    else:
        print("\n".join(table_lines(compared)))


def comparisons(file: AttitudeFile, row: PaperRow, options: TableOptions) -> list[Comparison]:
    """Numbers of a row of the paper and ours.

    Parameters
    ----------
    file : AttitudeFile
        The satellite.
    row : PaperRow
    options : TableOptions

    Returns
    -------
    list of Comparison
    """
    from adcs.kalman.results import in_units, sigma_by_state
    from sims.experiments.attitude import run_scenario

    sensors = dict(file.tables["sensors"])
    sensors["star_tracker"] = {**sensors["star_tracker"], "noise_deg": 0.002}
    estimate = {
        "sensors": row.sensors,
        "states": list(row.states),
        "filter": row.filter,
        "process_noise": "paper",
    }
    duration_s = row.duration_s if options.duration is None else options.duration
    file = file.changed({"duration_s": duration_s, "sensors": sensors, "estimate": estimate})
    last: list[np.ndarray] = []

    def look(part: Part) -> None:
        last.append(in_units(sigma_by_state(part.estimates))[:, -1])

    seeds = range(options.seed, options.seed + options.seeds)
    outcome = run_scenario(file, file.estimator(file.path), seeds, look=look)
    sigma = np.concatenate(last).reshape(-1, 5, 3).max(axis=2).mean(axis=0)
    rms = outcome.axis_rms.mean(axis=0).reshape(5, 3).max(axis=1)
    found = []
    for place, quantity in enumerate(_QUANTITIES):
        if quantity not in row.numbers:
            continue
        paper, half = row.numbers[quantity], 0.5 if quantity == "attitude" else 1.0
        ours = float(half * sigma[place])
        found.append(
            Comparison(
                table=row.table,
                set=row.label,
                filter=row.filter,
                quantity=quantity,
                unit=UNITS[quantity],
                paper_text=paper.text,
                paper_low=paper.low,
                paper_high=paper.high,
                ours=ours,
                ratio=paper.ratio(ours),
                rms=float(half * rms[place]),
            )
        )
    return found


_TITLES = {3: "Table 3", 4: "Table 4, disturbance in the state", 5: "Table 5, constant gain"}


def table_lines(compared: list[Comparison]) -> list[str]:
    """The comparison as text.

    Parameters
    ----------
    compared : list of Comparison

    Returns
    -------
    list of str
    """
    lines: list[str] = []
    table, label = 0, ""
    for one in compared:
        if one.table != table:
            table, label = one.table, ""
            lines += ["", _TITLES[table]] if lines else [_TITLES[table]]
            lines.append(f"{'set':20s}{'':18s}{'paper':>16s}{'ours':>10s}{'ratio':>9s}{'ours, rms':>11s}")
        shown = one.set if one.set != label else ""
        label = one.set
        quantity = f"{one.quantity} [{one.unit}]"
        lines.append(f"{shown:20s}{quantity:20s}{one.paper_text:>14s}{one.ours:10.2g}{one.ratio:9.3g}{one.rms:11.2g}")
    return lines
