"""``adcs tables``: Tables 3 to 5 of Ivanov et al. (Keldysh Institute, 2014) and our results."""

from __future__ import annotations

from dataclasses import asdict
from itertools import groupby
from typing import TYPE_CHECKING

import sims.experiments
from adcs.cli.options import ReportOptions
from magloc.cli.framework import progress, refuse_outside
from sims.cli.run_tabletsat import RunOptions

if TYPE_CHECKING:
    from sims.experiments.paper_tables import Comparison


def tables(
    *,
    options: RunOptions = RunOptions(),  # noqa: B008 - frozen
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Repeat Tables 3, 4 and 5 of Ivanov et al. (Keldysh Institute preprint 64, 2014).

    Prints the value of the paper, our value and the ratio. Process noise and noise of the star tracker are as printed,
    as far as they are legible. Our value is the standard deviation of the filter at the end, of the worst axis,
    averaged over the runs, followed by the rms error of the last minute. The attitude is half of the angle, as in the
    paper. A star marks a ratio beyond three; the reason is given below. Runs of Table 3 take 200 s, all others 600 s,
    unless --duration is given. --out writes tables.csv.

    Parameters
    ----------
    options : RunOptions
        Number, seeds and duration of the runs of every row.
    report : ReportOptions
        Outputs.
    """
    report.check()
    refuse_outside(1.0, 1e7, "1 to 1e7 s", unit=" s", duration=options.duration)
    rows = sims.experiments.PAPER_ROWS
    compared: list[Comparison] = []
    with progress(len(rows), "rows") as advance:
        for row in rows:
            compared += sims.experiments.compared_with_paper(row, options.numbers, options.duration)
            advance(1)
    rows_as_dicts = [asdict(one) for one in compared]
    columns = {name: [row[name] for row in rows_as_dicts] for name in rows_as_dicts[0]}
    report.write([("tables.csv", columns)])
    report.print({"rows": rows_as_dicts}, table_lines(compared))


_TITLES = {3: "Table 3", 4: "Table 4, disturbance in the state", 5: "Table 5, constant gain"}


def table_lines(compared: list[Comparison]) -> list[str]:
    """Return the comparison as text."""
    lines: list[str] = []
    table = 0
    for (of_table, label), rows in groupby(compared, lambda one: (one.table, one.set)):
        if of_table != table:
            table = of_table
            lines += ["", _TITLES[table]] if lines else [_TITLES[table]]
            lines.append(f"{'set':20s}{'':18s}{'paper':>16s}{'ours':>10s}{'ratio':>9s}{'ours, rms':>11s}")
        shown, notes = label, []
        for one in rows:
            quantity, far = f"{one.quantity} [{one.unit}]", " *" if one.note else ""
            numbers = f"{one.paper_text:>14s}{one.ours:10.2g}{one.ratio:9.3g}{one.rms:11.2g}{far}"
            lines.append(f"{shown:20s}{quantity:20s}{numbers}")
            shown = ""
            notes += [one.note] if one.note and one.note not in notes else []
        lines += [f"{'':20s}* {note}" for note in notes]
    return lines
