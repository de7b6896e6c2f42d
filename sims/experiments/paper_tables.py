"""Tables 3 to 5 of Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64, 2014.

In the only scan of the paper most exponents are illegible. Mantissas are as printed; (?) marks an exponent or a digit
that the context implies. Values are standard deviations of the worst axis.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np

from adcs.io.scenario_files import read_scenario
from adcs.kalman.names import Filter
from adcs.kalman.results import STATE_UNITS, largest_by_state, state_table
from arrays.typing import FloatArray
from sims.experiments.attitude import Part, run_scenario

QUANTITIES = {state: state.replace("-", " ") for state in STATE_UNITS}  # as the tables call them


@dataclass(frozen=True)
class PrintedValue:
    """Number of the paper.

    ``low``, ``high``: its value, or its range where it is illegible.
    """

    text: str  # as far as it is legible
    low: float
    high: float

    def ratio(self, ours: float) -> float:
        """Return our value over that of the paper, or over the nearer end of its range; 1 within it."""
        return ours / min(max(ours, self.low), self.high)


def parse_value(text: str) -> PrintedValue:
    """Return the number of a text such as ``"2e-2 (?)"`` or ``"3e-4…5e-3 (?)"``."""
    ends = [float(part) for part in text.replace("(?)", "").split("…")]
    return PrintedValue(text, ends[0], ends[-1])


@dataclass(frozen=True)
class PaperRow:
    """Row of a table of the paper."""

    table: int
    label: str  # sensors, and what is estimated where the table says so
    sensors: str
    states: tuple[str, ...]
    numbers: dict[str, PrintedValue]  # what is printed
    filter: Filter
    duration_s: float  # after which our value is taken
    note: str  # reason of a large difference, if there is one


def _paper_rows() -> Iterator[PaperRow]:
    """Yield the rows of the file beside this module."""
    with Path(__file__).with_suffix(".csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            yield PaperRow(
                table=int(row["table"]),
                label=row["set"],
                sensors=row["sensors"],
                states=tuple(row["states"].split("+")) if row["states"] else (),
                numbers={quantity: parse_value(row[quantity]) for quantity in QUANTITIES.values() if row.get(quantity)},
                filter=cast(Filter, row["filter"]),
                duration_s=float(row["duration_s"]),
                note=row["note"],
            )


PAPER_ROWS = tuple(_paper_rows())
"""All rows. The value of Table 5 for Δb, 6e-1°, is omitted: its exponent is illegible and its unit differs.

The three rows ST+G, [λ, ω], [λ, ω, Δω] and [λ, Δω], have the numbers of the one legible line.
"""
FAR = 3.0
"""Ratio beyond which a value of ours needs a reason."""


@dataclass(frozen=True)
class Comparison:
    """Value of the paper and ours; the attitude is half of the angle, as in the paper."""

    table: int
    set: str
    filter: str
    quantity: str
    unit: str
    paper_text: str  # as far as it is legible, (?) where it is uncertain
    paper_low: float
    paper_high: float
    ours: float  # standard deviation by the filter's covariance at the end, worst axis, mean over the runs
    ratio: float  # ours over the paper's
    rms: float  # of our errors in the last minute, worst axis
    note: str  # reason, if the ratio is beyond :data:`FAR`


def compared_with_paper(row: PaperRow, seeds: Sequence[int], duration_s: float | None = None) -> list[Comparison]:
    """Compare a row of the paper with our values; by default with the duration of the row.

    Parameters
    ----------
    row : PaperRow
        One of :data:`PAPER_ROWS`.
    seeds : sequence of int
        One for each run.
    duration_s : float, optional
        Duration of every run [s]; by default that of the row.

    Returns
    -------
    list of Comparison
        Published value, our value and their ratio, for each quantity of the row.

    Examples
    --------
    >>> from sims import experiments
    >>> row = experiments.PAPER_ROWS[0]
    >>> experiments.compared_with_paper(row, seeds=[0], duration_s=70.0)[0].quantity
    'attitude'
    """
    file = read_scenario("tabletsat")
    sensors = dict(file.tables["sensors"])
    sensors["star_tracker"] = {**sensors["star_tracker"], "noise_deg": 0.002}
    chosen = {"sensors": row.sensors, "states": list(row.states), "filter": row.filter, "process_noise": "paper"}
    duration_s = row.duration_s if duration_s is None else duration_s
    file = file.changed(
        {"duration_s": duration_s, "sensors": sensors, "estimate": {**chosen, "process_noise": "paper"}}
    )
    last: list[FloatArray] = []

    def look(part: Part) -> None:
        last.append(state_table(part.estimates.sigma_by_state)[:, -1])

    outcome = run_scenario(file, file.estimator(file.path), seeds, look=look)
    sigma = largest_by_state(np.concatenate(last)).mean(axis=0)
    rms = largest_by_state(outcome.axis_rms.mean(axis=0))
    found = []
    for place, (state, shown) in enumerate(STATE_UNITS.items()):
        quantity = QUANTITIES[state]
        if quantity not in row.numbers:
            continue
        paper, half = row.numbers[quantity], 0.5 if quantity == "attitude" else 1.0
        ours, error = float(half * sigma[place]), float(half * rms[place])
        what = row.table, row.label, row.filter, quantity, shown.unit
        ratio = paper.ratio(ours)
        note = "" if 1.0 / FAR <= ratio <= FAR else row.note or "not explained"
        found.append(Comparison(*what, paper.text, paper.low, paper.high, ours, ratio, error, note))
    return found
