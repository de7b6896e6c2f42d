"""Tables 3 to 5 of Ivanov, Ivlev, Karpenko, Ovchinnikov, Keldysh Institute preprint 64, 2014.

In the scan that is left of the paper most exponents are lost. Mantissas are as printed; a (?) says that the exponent,
or the digit, is what the context needs. "1" of a quantity is one standard deviation of the worst axis.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adcs.io.scenario_files import read_scenario
from adcs.kalman.names import Filter
from adcs.kalman.results import SHOWN, in_units, sigma_by_state
from arrays.typing import FloatArray
from sims.experiments.attitude import Part, run_scenario


@dataclass(frozen=True)
class Printed:
    """A number of the paper.

    ``low``, ``high``: its value, or the range that is left of it.
    """

    text: str  # as it can be read
    low: float
    high: float

    def ratio(self, ours: float) -> float:
        """Ours over the paper's, or over the nearer end of its range; 1 within it."""
        return ours / min(max(ours, self.low), self.high)


def printed(text: str) -> Printed:
    """Number of a text such as ``"2e-2 (?)"`` or ``"3e-4…5e-3 (?)"``."""
    ends = [float(part) for part in text.replace("(?)", "").split("…")]
    return Printed(text, ends[0], ends[-1])


@dataclass(frozen=True)
class PaperRow:
    """A row of a table."""

    table: int
    label: str  # sensors, and what is estimated where the table says so
    sensors: str
    states: tuple[str, ...]
    texts: dict[str, str]  # what is printed
    filter: Filter = "mekf"

    @property
    def numbers(self) -> dict[str, Printed]:
        """What is printed."""
        return {quantity: printed(text) for quantity, text in self.texts.items()}

    @property
    def duration_s(self) -> float:
        """After which ours is taken."""
        return 200.0 if self.table == 3 else 600.0


_G, _B, _D = "gyro-bias", "field-bias", "disturbance"
_CONSTANT: Filter = "constant-gain"
_STAR: dict[str, str] = {"attitude": "5e-4", "rate": "4e-4"}
_STAR_D: dict[str, str] = {"attitude": "8e-4", "rate": "1e-4", "disturbance": "5e-8 (?)"}
_VECTORS_D: dict[str, str] = {"attitude": "3e-2", "rate": "2e-3", "disturbance": "5e-7 (?)"}
_GYRO_D: dict[str, str] = {"attitude": "2e-2", "rate": "2e-3", "gyro bias": "5e-4", "disturbance": "8e-7"}
PAPER_ROWS: tuple[PaperRow, ...] = (
    PaperRow(3, "ST+G+M+S", "st+gyro+mag+sun", (), _STAR),
    PaperRow(3, "ST+G+M", "st+gyro+mag", (), _STAR),
    PaperRow(3, "ST+G", "st+gyro", (), _STAR),
    PaperRow(3, "ST+M+S", "st+mag+sun", (), {"attitude": "7e-4", "rate": "6e-4"}),
    PaperRow(3, "ST+M, Δb", "st+mag", (_B,), {"attitude": "7e-4", "rate": "6e-4", "field bias": "80"}),
    PaperRow(3, "ST+G, Δω", "st+gyro", (_G,), {"attitude": "5e-4", "rate": "4e-4", "gyro bias": "3e-3 (?)"}),
    PaperRow(3, "Mag+Sun+G", "mag+sun+gyro", (), {"attitude": "2e-2 (?)", "rate": "4e-3 (?)"}),
    PaperRow(3, "Mag+Sun+G, Δω", "mag+sun+gyro", (_G,), {"attitude": "2e-2", "rate": "4e-3", "gyro bias": "5e-4"}),
    PaperRow(3, "Mag+Sun+G, Δb", "mag+sun+gyro", (_B,), {"attitude": "5e-2 (?)", "rate": "4e-3", "field bias": "400"}),
    PaperRow(3, "Mag+Sun", "mag+sun", (), {"attitude": "1.2e-1 (?)", "rate": "2e-2 (?)"}),
    PaperRow(3, "Mag+G", "mag+gyro", (), {"attitude": "2e-1 (?)", "rate": "5e-3 (?)"}),
    PaperRow(3, "ST", "st", (), {"attitude": "8e-4", "rate": "6e-4"}),
    PaperRow(4, "ST, d", "st", (_D,), _STAR_D),
    PaperRow(
        4,
        "ST+G, Δω, d",
        "st+gyro",
        (_G, _D),
        {"attitude": "8e-4", "rate": "7e-5 (?)", "gyro bias": "1e-5…1e-3 (?)", "disturbance": "5e-8 (?)"},
    ),
    PaperRow(4, "Mag+Sun, d", "mag+sun", (_D,), _VECTORS_D),
    PaperRow(4, "Mag+Sun+G, Δω, d", "mag+sun+gyro", (_G, _D), _GYRO_D),
    PaperRow(5, "ST", "st", (), {"attitude": "2e-3 (?)", "rate": "4e-4"}, _CONSTANT),
    PaperRow(5, "ST, d", "st", (_D,), _STAR_D, _CONSTANT),
    PaperRow(
        5,
        "ST+G, Δω",
        "st+gyro",
        (_G,),
        {"attitude": "1.5e-3", "rate": "3e-4…5e-3 (?)", "gyro bias": "4e-4"},
        _CONSTANT,
    ),
    PaperRow(
        5,
        "ST+G, Δω, d",
        "st+gyro",
        (_G, _D),
        {"attitude": "8e-4", "rate": "7e-5", "gyro bias": "1e-5 (?)"},
        _CONSTANT,
    ),
    PaperRow(5, "Mag+Sun+G", "mag+sun+gyro", (), {"attitude": "2e-2", "rate": "2.2e-2"}, _CONSTANT),
    PaperRow(5, "Mag+Sun+G, Δb", "mag+sun+gyro", (_B,), {"attitude": "2e-2", "rate": "5e-3"}, _CONSTANT),
    PaperRow(
        5,
        "Mag+Sun+G, [λ, Δω]",
        "mag+sun+gyro",
        (_G,),
        {"attitude": "2e-2", "rate": "5e-3", "gyro bias": "1e-3"},
        "reduced",
    ),
    PaperRow(5, "Mag+Sun+G, Δω, d", "mag+sun+gyro", (_G, _D), _GYRO_D, _CONSTANT),
    PaperRow(5, "Mag+Sun", "mag+sun", (), {"attitude": "0.1", "rate": "5e-3"}, _CONSTANT),
    PaperRow(5, "Mag+Sun, d", "mag+sun", (_D,), _VECTORS_D, _CONSTANT),
)
"""All rows. What Table 5 prints for Δb, 6e-1°, has a lost exponent and another unit; it is left out."""


@dataclass(frozen=True)
class Comparison:
    """A number of the paper and ours; that of the attitude is half of the angle, as the paper has it."""

    table: int
    set: str
    filter: str
    quantity: str
    unit: str
    paper_text: str  # as it can be read, (?) where it is unsure
    paper_low: float
    paper_high: float
    ours: float  # standard deviation by the filter's covariance at the end, worst axis, mean over the runs
    ratio: float  # ours over the paper's
    rms: float  # of our errors in the last minute, worst axis


def compared_with_paper(row: PaperRow, seeds: Sequence[int], duration_s: float | None = None) -> list[Comparison]:
    """Numbers of a row of the paper and ours; the duration is the row's unless given."""
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
        last.append(in_units(sigma_by_state(part.estimates))[:, -1])

    outcome = run_scenario(file, file.estimator(file.path), seeds, look=look)
    sigma = np.concatenate(last).reshape(-1, 5, 3).max(axis=2).mean(axis=0)
    rms = outcome.axis_rms.mean(axis=0).reshape(5, 3).max(axis=1)
    found = []
    for place, (state, shown) in enumerate(SHOWN.items()):
        quantity = state.replace("-", " ")
        if quantity not in row.numbers:
            continue
        paper, half = row.numbers[quantity], 0.5 if quantity == "attitude" else 1.0
        ours, error = float(half * sigma[place]), float(half * rms[place])
        what = row.table, row.label, row.filter, quantity, shown.unit
        found.append(Comparison(*what, paper.text, paper.low, paper.high, ours, paper.ratio(ours), error))
    return found
