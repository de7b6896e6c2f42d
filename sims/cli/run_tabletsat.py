"""``adcs run`` of a satellite with a Kalman filter, and the options of many runs."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from cyclopts import Parameter

import adcs
import sims.experiments
from adcs.cli.options import ReportOptions, ScenarioOptions
from arrays.io.errors import InputError
from magloc.cli.framework import ABOVE_ZERO, Count, Seed, progress, refuse_outside, warn

if TYPE_CHECKING:
    from adcs.io.scenario_files import AttitudeFile
    from adcs.kalman.bank import EstimatorSettings
    from sims.experiments.attitude import Part

_OTHERS = ("complementary", "detumbling", "ellipsoid", "mockup")
_STAR_NOISE_DEG = {"angle": 0.001, "paper": 0.002}


Runs = Annotated[Count, Parameter(name=["--seeds", "--runs"])]
Simulated = TypeVar("Simulated")


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Number, seeds and duration of the runs.

    Parameters
    ----------
    seeds : int
        Number of runs.
    seed : int
        Seed of the first run; the next runs take the next seeds.
    duration : float
        Duration of a run [s]; by default that of the scenario, or of the table.
    """

    seeds: Runs = 10
    seed: Seed = 0
    duration: float | None = None

    @property
    def numbers(self) -> range:
        """Seeds of all runs."""
        return range(self.seed, self.seed + self.seeds)


def run_in_batches(
    options: RunOptions,
    most_at_once: int,
    simulate: Callable[[range], Simulated],
    columns_of: Callable[[Simulated], dict[str, Any]],
    files_of_first: Callable[[Simulated], Iterable[tuple[str, Any]]] | None,
    progress: Callable[[int], None] | None,
) -> tuple[dict[str, Any], list[tuple[str, Any]]]:
    """Simulate all runs, in batches that fit into memory.

    Returns: columns with a row for every run, and the files that show the first batch.
    """
    import numpy as np

    parts: list[dict[str, Any]] = []
    files: list[tuple[str, Any]] = []
    for first in range(0, options.seeds, most_at_once):
        seeds = options.numbers[first : first + most_at_once]
        runs = simulate(seeds)
        parts.append({"seed": np.array(seeds), **columns_of(runs)})
        if files_of_first is not None and not files:
            files += files_of_first(runs)
        if progress is not None:
            progress(len(seeds))
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}, files


def configure(
    scenario: str, options: ScenarioOptions, duration_s: float | None
) -> tuple[AttitudeFile, EstimatorSettings]:
    """Return the scenario with the options, and its filter."""
    from adcs.io.scenario_tables import MOST_STEPS

    file = adcs.read_scenario(scenario, allow_old_elements=options.allow_old_elements)
    changes = options.changes(duration_s, file.estimate.states)
    if duration_s is not None and not 1.0 <= duration_s / file.step_s <= MOST_STEPS:
        longest_s = MOST_STEPS * file.step_s
        raise InputError(f"--duration: found {duration_s:g} s, expected {file.step_s:g} to {longest_s:g} s.")
    refuse_outside(ABOVE_ZERO, 180.0, "more than 0 and at most 180", start_error_deg=options.start_error_deg)
    refuse_outside(0.0, 1e9, "0 to 1e9", field_error_nT=options.field_error_nT)
    if options.share is not None and not 0.0 <= options.share < 1.0:
        raise InputError(f"--share: found {options.share:g}, expected 0 to less than 1.")
    file = file.changed(changes)
    if options.star_noise is not None:
        tables = {**file.tables.get("sensors", {})}
        tables["star_tracker"] = {**tables.get("star_tracker", {}), "noise_deg": _STAR_NOISE_DEG[options.star_noise]}
        file = file.changed({"sensors": tables})
    given = [f"--{key}" for key in ("sensors", "states", "filter") if getattr(options, key) is not None]
    return file, file.estimator(" and ".join(given) or file.path)


def run_attitude(
    scenario: str,
    /,
    *,
    options: ScenarioOptions = ScenarioOptions(),
    runs: RunOptions = RunOptions(),
    report: ReportOptions = ReportOptions(),  # noqa: B008 - frozen
) -> None:
    """Simulate a satellite, estimate its attitude with a Kalman filter, and report the errors.

    Errors are the rms of the last minute per axis, averaged over the runs, of the worst axis. A run with an error of
    more than 10° then has diverged. The largest error while a sensor is degraded or a state is not observable (an
    eclipse, Sun and field on one line) is over all runs, after their first minute. --out writes figures, and
    telemetry.csv and scenario.toml for `adcs estimate`.

    Parameters
    ----------
    scenario : str
        Scenario file (TOML), or a built-in scenario: tabletsat, collinearity, eclipse, field-error, one-vector,
        outliers, residual-dipole, star-blinded or uncalibrated-magnetometer.
    options : ScenarioOptions
        Values that replace those of the scenario file.
    runs : RunOptions
        Number, seeds and duration of the runs.
    report : ReportOptions
        Outputs.
    """
    from adcs.io.scenario_files import built_in_scenarios
    from arrays.io.text import check_netcdf

    if scenario in _OTHERS:
        raise InputError(f"adcs run: found options before {scenario}, expected its name right after run.")
    names = sorted([*_OTHERS, *built_in_scenarios()])
    if scenario not in names and not Path(scenario).exists():
        nearest = difflib.get_close_matches(scenario, names, n=1, cutoff=0.0)[0]
        raise InputError(
            f"{scenario} does not exist, expected a scenario file, or one of {', '.join(names)} "
            f"(the nearest is {nearest})."
        )
    file, estimate = configure(scenario, options, runs.duration)
    if report.out is not None:
        report.check()
        check_netcdf()
    parts: list[Part] = []
    with progress(runs.seeds, "runs") as advance:
        outcome = sims.experiments.run_scenario(
            file,
            estimate,
            runs.numbers,
            through_time=report.out is not None,
            look=None if report.out is None else parts.append,
            advance=advance,
        )
    warn(outcome.warning_lines())
    numbers = outcome.numbers()
    if report.out is not None:
        from sims.cli.attitude_files import attitude_files

        report.write(attitude_files(file, estimate, parts, outcome))
    report.print(numbers, summary_lines(file, estimate, numbers))


def summary_lines(file: AttitudeFile, estimate: EstimatorSettings, numbers: dict[str, Any]) -> Sequence[str]:
    """Return the result as text."""
    from adcs.io.estimates import unseen_line
    from adcs.kalman.diagnostics import PERIODS_S
    from adcs.kalman.results import STATE_UNITS

    runs = "1 run" if numbers["runs"] == 1 else f"{numbers['runs']} runs"
    lines = [f"{file.name}: {runs} of {file.duration_s:g} s; {estimate.in_words}"]
    # The first numbers belong to the states, in this order.
    for (state, shown), number in zip(STATE_UNITS.items(), numbers.values(), strict=False):
        if number is not None:
            words = "angle, rms of the last minute" if state == "attitude" else shown.words
            lines.append(f"{words:34s}{number:.3g} {shown.unit}")
    if numbers["worst_deg"] is not None:
        lines.append(f"{'angle, largest while degraded':34s}{numbers['worst_deg']:.3g} °")
    if numbers["rejected"]:
        good = f"{numbers['rejected_good']} of them good"
        lines.append(f"{'readings that are not used':34s}{numbers['rejected']}, {good}")
    lines.append(f"{'NEES / numbers (1 is consistent)':34s}{numbers['nees_per_dimension']:.3g}")
    lines.append(f"{'diverged runs':34s}{numbers['diverged_runs']}")
    if numbers["tuned_disturbance_s2"] is not None:
        lines.append(f"{'disturbance, 1σ found, median':34s}{numbers['tuned_disturbance_s2']:.2g} 1/s²")
    lines += unseen_line({period: numbers[f"unseen_torque_{period:g}s_Nm"] for period in PERIODS_S})
    return lines
