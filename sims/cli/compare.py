"""``adcs compare``: scenarios, sensors and filters on the same seeds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np
from cyclopts import Parameter

import sims.experiments
from adcs.cli.options import ReportOptions, ScenarioOptions
from adcs.kalman.names import FILTERS
from arrays.io.errors import InputError
from magloc.cli.framework import Flag, progress, warn
from sims.cli.run_tabletsat import RunOptions, configure

if TYPE_CHECKING:
    from adcs.io.scenario_files import AttitudeFile
    from adcs.kalman.bank import EstimatorSettings
    from sims.experiments.attitude import Outcome
from arrays.typing import FloatArray


@Parameter(name="*")
@dataclass(frozen=True)
class CompareOptions:
    """Sensors, states and filters to compare, in lists separated by commas.

    Parameters
    ----------
    sensors : str
        Sets of sensors, as in st,st+gyro,mag+sun+gyro; by default that of each scenario.
    states : str
        Sets of states, as in none,gyro-bias,gyro-bias+disturbance; by default that of each scenario.
    filter : str
        Filters: mekf, constant-gain, parallel-disturbance, reduced, smoother, self-tuning; by default that of each
        scenario.
    allow_old_elements : bool
        Also accept two-line elements 30 days or more from their epoch.
    """

    sensors: str | None = None
    states: str | None = None
    filter: str | None = None
    allow_old_elements: Flag = False

    def combinations(self) -> list[ScenarioOptions]:
        """Return all combinations of the lists."""
        lists = [[None] if text is None else _items(text) for text in (self.sensors, self.states, self.filter)]
        for name in lists[2]:
            if name is not None and name not in FILTERS:
                raise InputError(f"--filter: found {name!r}, expected some of {', '.join(FILTERS)}.")
        empty = ScenarioOptions(allow_old_elements=self.allow_old_elements)
        return [
            replace(empty, sensors=sensors, states=states, filter=name)  # type: ignore[arg-type]
            for sensors, states, name in product(*lists)
        ]


def _items(text: str) -> list[str | None]:
    return [item.strip() for item in text.split(",") if item.strip()]


@dataclass(frozen=True, eq=False)
class Row:
    """One scenario with one filter."""

    file: AttitudeFile
    estimate: EstimatorSettings
    outcome: Outcome

    def report(self) -> dict[str, Any]:
        """Return the JSON object of the row."""
        used = self.estimate.settings.sensors
        return {
            "scenario": self.file.name,
            "sensors": used.sensors,
            "states": list(used.states),
            "filter": self.estimate.filter,
            **self.outcome.numbers(),
            "warnings": [*self.file.warnings, *self.outcome.warning_lines()],
        }


def compare(
    *scenarios: str,
    options: CompareOptions = CompareOptions(),
    runs: RunOptions = RunOptions(),  # noqa: B008 - frozen
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Compare scenarios, sets of sensors or filters on the same seeds.

    --out writes compare.png, with the median errors through time, and compare.csv.

    Parameters
    ----------
    scenarios : str
        Scenario files (TOML) or names of built-in ones.
    options : CompareOptions
        Sensors, states and filters to compare.
    runs : RunOptions
        Number, seeds and duration of the runs.
    report : ReportOptions
        Outputs.
    """
    if not scenarios:
        raise InputError("adcs compare: found no scenario, expected one or more, such as tabletsat eclipse.")
    report.check()
    pairs = [configure(name, chosen, runs.duration) for name, chosen in product(scenarios, options.combinations())]
    rows = []
    with progress(len(pairs) * runs.seeds, "runs") as advance:
        for file, estimate in pairs:
            outcome = sims.experiments.run_scenario(
                file, estimate, runs.numbers, through_time=report.out is not None, advance=advance
            )
            rows.append(Row(file, estimate, outcome))
    reports = [row.report() for row in rows]
    report.write(_files(rows, reports))
    report.print({"rows": reports}, compare_lines(reports))
    for of_row in [] if report.json else reports:
        warn(f"{of_row['scenario']}, {of_row['sensors']}: {line}" for line in of_row["warnings"])


_COLUMNS = (
    ("angle_rms_deg", "angle [°]"),
    ("worst_deg", "worst [°]"),
    ("rate_rms_deg_s", "rate [°/s]"),
    ("gyro_bias_rms_deg_s", "Δω [°/s]"),
    ("field_bias_rms_nT", "Δb [nT]"),
    ("disturbance_rms_s2", "d [1/s²]"),
    ("field_model_rms_nT", "e [nT]"),
    ("dipole_error_Am2", "m [A·m²]"),
    ("field_gain_rms_percent", "D [%]"),
    ("nees_per_dimension", "NEES/n"),
    ("diverged_runs", "diverged"),
)


def compare_lines(reports: list[dict[str, Any]]) -> list[str]:
    """Return the comparison as text."""
    names = [label_of(report) for report in reports]
    width = max(22, *(len(name) for name in names)) + 1
    lines = [f"{'rms of the last minute':{width}s}" + "".join(f"{title:>12s}" for _, title in _COLUMNS)]
    for name, report in zip(names, reports, strict=True):
        cells = ["" if report[key] is None else f"{report[key]:.3g}" for key, _ in _COLUMNS]
        lines.append(f"{name:{width}s}" + "".join(f"{cell:>12s}" for cell in cells))
    return lines


def label_of(report: dict[str, Any]) -> str:
    """Return scenario, sensors, states and filter in a few words."""
    parts = [report["scenario"], report["sensors"], *report["states"]]
    return " ".join(parts if report["filter"] == "mekf" else [*parts, report["filter"]])


def _files(rows: list[Row], reports: list[dict[str, Any]]) -> Iterator[tuple[str, Any]]:
    """Yield the numbers of all rows, and their median errors through time as a figure."""
    from adcs.plots.attitude import compare_figure

    names = [label_of(report) for report in reports]
    columns: dict[str, Any] = {"row": names}
    for key, _ in _COLUMNS:
        columns[key] = np.array([report[key] for report in reports], dtype=np.float64)  # None becomes NaN
    yield "compare.csv", columns
    lines: list[tuple[str, FloatArray, FloatArray]] = []
    for name, row in zip(names, rows, strict=True):
        error: FloatArray = np.median(row.outcome.error_deg, axis=0)
        lines.append((name, row.file.step_s * np.arange(len(error), dtype=np.float64), error))
    yield "compare.png", compare_figure(lines)
