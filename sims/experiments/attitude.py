"""Runs of an attitude scenario: truth, readings, estimates and their errors."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adcs.io.scenario_files import AttitudeFile
from adcs.kalman.bank import EstimatorSettings, estimate_tracks
from adcs.kalman.diagnostics import AttitudeProblem, find_problems, unseen_torque_Nm
from adcs.kalman.error_state import AttitudeTracks, start_near
from adcs.kalman.results import largest_by_state, state_table
from arrays.io.errors import InputError
from arrays.typing import FloatArray
from sims.attitude.files import simulation_of
from sims.attitude.scenario import AttitudeScenario
from sims.attitude.simulation import AttitudeRuns, simulate, start_estimates
from sims.experiments import accuracy

_NUMBERS_AT_ONCE = 40_000_000
"""Largest number of elements of all covariances in memory: 320 MB."""


@dataclass(frozen=True, eq=False)
class Part:
    """Runs that are in memory together."""

    runs: AttitudeRuns
    estimates: AttitudeTracks


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors and consistency of the estimates of all runs.

    Attributes
    ----------
    seeds : ndarray of int, shape (runs,)
    axis_rms : ndarray, shape (runs, 30)
        Rms over the last minute of the angle [°], the rate [°/s], the gyro's bias [°/s], the field's bias [nT], the
        disturbance [1/s²], the error of the field's model [nT] and the dipole [A·m²], three axes each, and nine gains
        of the magnetometer [%]; NaN for a state that the filter does not have.
    nees : ndarray, shape (runs, n)
        NEES per dimension, at all instants or at those of the last minute.
    nis : ndarray, shape (runs, n, 4)
        Normalised innovation squared of every sensor, NaN where it has no reading.
    error_deg : ndarray, shape (runs, n)
        Angle between truth and estimate.
    diverged : ndarray of bool, shape (runs,)
    size : int
        Dimension of the error state.
    late : slice
        Instants of the last minute among the n.
    worst_deg : ndarray, shape (runs,)
        Largest error while a sensor is degraded or a state is not observable, without the first minute; NaN if there
        is no such time.
    rejected, rejected_good : ndarray of int, shape (runs,)
        Number of readings that the filter rejected, and of those among them that are not wild.
    tuned_disturbance_s2 : ndarray, shape (runs,)
        Disturbance that the filter ``self-tuning`` has found at the end, 1 σ; NaN for other filters.
    unseen_torque_Nm : dict of float to float
        Largest amplitude of a torque that the readings do not show, by its period [s]; the largest of all runs.
    warnings : list of list of str
        Warnings of every run, which need no truth: degraded sensors and unobservable states.
    """

    seeds: NDArray[np.int64]
    axis_rms: FloatArray
    nees: FloatArray
    nis: FloatArray
    error_deg: FloatArray
    diverged: NDArray[np.bool_]
    size: int
    late: slice
    worst_deg: FloatArray
    rejected: NDArray[np.int64]
    rejected_good: NDArray[np.int64]
    tuned_disturbance_s2: FloatArray
    unseen_torque_Nm: dict[float, float]
    warnings: list[list[str]]

    def last_minute(self) -> Outcome:
        """Return the outcome with the instants of the last minute only."""
        late = {name: getattr(self, name)[:, self.late].copy() for name in ("nees", "nis", "error_deg")}
        return replace(self, **late, late=slice(None))

    def warning_lines(self) -> list[str]:
        """Return one line for every kind of warning, with the number of runs that have it."""
        first: dict[str, str] = {}
        count: dict[str, int] = {}
        for texts in self.warnings:
            for text in texts:
                kind = re.sub(r"\d[\d.]*", "#", text)
                first.setdefault(kind, text)
                count[kind] = count.get(kind, 0) + 1
        runs = len(self.warnings)
        return [text + (f" ({count[kind]} of {runs} runs)" if runs > 1 else "") for kind, text in first.items()]

    def numbers(self) -> dict[str, Any]:
        """Return the keys of ``--json``: means over the runs, of the worst axis."""
        mean, tuned = largest_by_state(self.axis_rms.mean(axis=0)), np.median(self.tuned_disturbance_s2)
        names = (
            *("angle_rms_deg", "rate_rms_deg_s", "gyro_bias_rms_deg_s"),
            *(
                "field_bias_rms_nT",
                "disturbance_rms_s2",
                "field_model_rms_nT",
                "dipole_error_Am2",
                "field_gain_rms_percent",
            ),
        )
        return {
            **{name: None if math.isnan(value) else float(value) for name, value in zip(names, mean, strict=True)},
            "nees_per_dimension": float(self.nees[:, self.late].mean()),
            "diverged_runs": int(self.diverged.sum()),
            "runs": len(self.seeds),
            "worst_deg": None if np.isnan(self.worst_deg).all() else float(np.nanmax(self.worst_deg)),
            "rejected": int(self.rejected.sum()),
            "rejected_good": int(self.rejected_good.sum()),
            "tuned_disturbance_s2": None if np.isnan(tuned) else float(tuned),
            **{f"unseen_torque_{period:g}s_Nm": torque for period, torque in self.unseen_torque_Nm.items()},
        }


def parts_of(file: AttitudeFile, estimate: EstimatorSettings, seeds: Sequence[int]) -> Iterator[Part]:
    """Yield all runs, as many at once as fit into memory."""
    scenario = simulation_of(file)
    at_once = max(1, _NUMBERS_AT_ONCE // (scenario.n_instants * estimate.settings.sensors.size**2))
    for begin in range(0, len(seeds), at_once):
        yield _part(file, estimate, scenario, seeds[begin : begin + at_once])


def _part(file: AttitudeFile, estimate: EstimatorSettings, scenario: AttitudeScenario, seeds: Sequence[int]) -> Part:
    runs, start = _simulate(file, scenario, seeds), None
    if estimate.start == "near":
        errors = estimate.start_attitude_rad, estimate.start_rate_rad_s
        start = start_near(*start_estimates(runs.prepared, *errors), *errors)
    return Part(runs, estimate_tracks(runs, estimate, start))


def _simulate(file: AttitudeFile, scenario: AttitudeScenario, seeds: Sequence[int]) -> AttitudeRuns:
    try:
        return simulate(scenario, seeds)
    except ValueError as error:
        text = str(error).removeprefix("Input ")
        if text.startswith("conditions"):
            day = file.satellite.start.astype("datetime64[s]")
            text = (
                f"found no time within 24 hours from {day} at which the conditions "
                f"of the table start hold for {file.duration_s:g} s, expected weaker ones, or a shorter duration."
            )
        raise InputError(f"{file.path}: {text}") from None


@np.errstate(over="ignore", divide="ignore", invalid="ignore")  # a run that overflows has diverged
def run_scenario(
    file: AttitudeFile,
    estimate: EstimatorSettings,
    seeds: Sequence[int],
    *,
    through_time: bool = True,
    look: Callable[[Part], None] | None = None,
    advance: Callable[[int], None] | None = None,
) -> Outcome:
    """Simulate and estimate all runs.

    Parameters
    ----------
    file : AttitudeFile
        Scenario from :func:`adcs.read_scenario`.
    estimate : EstimatorSettings
        Filter and its settings.
    seeds : sequence of int
        One for each run.
    through_time : bool
        Keep NEES, NIS and error at all instants, six numbers each; otherwise of the last minute only.
    look : callable, optional
        Called with every part of the runs.
    advance : callable, optional
        Called with the number of runs finished since the last call.

    Returns
    -------
    Outcome
        Errors, NEES and NIS of all runs.

    Raises
    ------
    InputError
        The same errors as in :func:`parts_of`.

    Examples
    --------
    >>> import adcs
    >>> from sims import experiments
    >>> file = adcs.read_scenario("tabletsat").changed({"duration_s": 70.0})
    >>> outcome = experiments.run_scenario(file, file.estimator(file.path), seeds=[0])
    >>> int(outcome.diverged.sum())
    0
    """
    outcomes = []
    for part in parts_of(file, estimate, seeds):
        outcome = outcome_of(part)
        outcomes.append(outcome if through_time else outcome.last_minute())
        if look is not None:
            look(part)
        if advance is not None:
            advance(len(outcome.seeds))
        del part, outcome  # only one part fits into memory
    of_runs: tuple[str, ...] = ("seeds", "axis_rms", "nees", "nis", "error_deg", "diverged", "worst_deg", "rejected")
    of_runs += ("rejected_good", "tuned_disturbance_s2")
    joined: dict[str, Any] = {name: np.concatenate([getattr(one, name) for one in outcomes]) for name in of_runs}
    joined["unseen_torque_Nm"] = _largest(one.unseen_torque_Nm for one in outcomes)
    return replace(outcomes[0], **joined, warnings=[texts for one in outcomes for texts in one.warnings])


def _largest(each: Iterable[Mapping[float, float]]) -> dict[float, float]:
    """Return the largest value of every key of mappings with the same keys."""
    first, *others = each
    return {key: max([value, *(other[key] for other in others)]) for key, value in first.items()}


def errors_in_units(part: Part) -> FloatArray:
    """Return truth minus estimate (runs, n, 30), ordered as :attr:`Outcome.axis_rms`."""
    return state_table(part.estimates.settings.sensors.split(accuracy.errors(part.runs, part.estimates)))


def outcome_of(part: Part) -> Outcome:
    """Return errors and consistency of the estimates of some runs."""
    runs, estimates = part.runs, part.estimates
    late = accuracy.last_rows(runs)
    error_deg = accuracy.error_norm_deg(runs, estimates)
    errors = errors_in_units(part)
    size = estimates.settings.sensors.size
    wild = np.stack(list(runs.prepared.wild.values()), axis=-1)
    problems, first = find_problems(runs, estimates), round(accuracy.LAST_S / runs.dt_s)
    return Outcome(
        seeds=np.array(runs.prepared.seeds),
        axis_rms=np.sqrt(np.mean(errors[:, late] ** 2, axis=1)),
        nees=accuracy.normalised_error_squared(runs, estimates) / size,
        nis=estimates.nis,
        error_deg=error_deg,
        diverged=np.any(~(error_deg[:, late] <= accuracy.DIVERGED_DEG), axis=1) | ~estimates.definite,
        size=size,
        late=late,
        worst_deg=np.array([_worst(*of_run, first) for of_run in zip(error_deg, problems, strict=True)]),
        rejected=estimates.rejected.sum(axis=(1, 2)),
        rejected_good=(estimates.rejected & ~wild).sum(axis=(1, 2)),
        tuned_disturbance_s2=np.full(len(runs.q), np.nan)
        if estimates.tuned_disturbance_s2 is None
        else estimates.tuned_disturbance_s2[:, -1],
        unseen_torque_Nm=_largest(unseen_torque_Nm(runs, estimates, run) for run in range(len(runs.q))),
        warnings=[[problem.text for problem in of_run] for of_run in problems],
    )


def _worst(error_deg: FloatArray, problems: Sequence[AttitudeProblem], first: int) -> float:
    """Return the largest error during problems, from the instant ``first`` on; NaN without any."""
    rows = np.zeros(len(error_deg), dtype=np.bool_)
    for problem in problems:
        rows |= problem.rows
    rows[:first] = False
    return float(error_deg[rows].max()) if rows.any() else math.nan
