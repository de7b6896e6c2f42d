"""Figures of the runs of a scenario, and whether they are worse than those that are stored.

A figure is worse where its distance from the ideal grows by more than a tenth and a slack. The slack is the standard
deviation that the figure of a right tracker has by chance if its rows are independent: √(2/n) of a NEES of n numbers,
√(0.95 · 0.05/n) of the coverage of n sets, and 1/√(6 n) of the rms error of n places, relative, as a mean of 3 n
squares has √(2/(3 n)). A median over runs scatters √(π/2) times as much as a mean. Errors of successive rows are alike,
so that true scatter is larger; but old and new figures are of the same readings. Counts have no slack.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

BROKEN = 3.0
"""NEES per dimension of a run that is broken."""
LARGEST_GROWTH = 0.1
"""By which share of itself the distance from the ideal may grow."""
RANGE_LEVEL = 0.95
N_STATES = 6
FIRST_ROWS = 8
"""The first of so many parts of the rows is left out of `nees_late`."""


@dataclass(frozen=True)
class Run:
    """One seed of a scenario; NaN where a number does not exist.

    Attributes
    ----------
    tracked : int
        Rows with a track, or pairs of a row and a source.
    nees, nees_late : float
        NEES per dimension, mean over rows, and over those after the first eighth.
    nees_numbers : int
        Numbers that NEES is of.
    held, sets : int
        95 % range sets that hold the truth, and all of them.
    rms_m, bound_m : float
        Error, and the posterior bound of the same rows; A·m² where the place is known.
    late_m, late_bound_m : float
        The same after the first eighth of the rows.
    counts : dict
        Of what should not be: swaps, rows with a source too many.
    wrong : tuple of str
        Sensors named that are well or not named that are not, rows that differ, flags that are wrong.
    cpu : float
        Processor time over that of a fixed computation.
    """

    seed: int
    tracked: int
    nees: float = math.nan
    nees_late: float = math.nan
    nees_numbers: int = 0
    held: int = 0
    sets: int = 0
    rms_m: float = math.nan
    bound_m: float = math.nan
    late_m: float = math.nan
    late_bound_m: float = math.nan
    counts: dict[str, int] = field(default_factory=dict)
    wrong: tuple[str, ...] = ()
    cpu: float = math.nan


@dataclass(frozen=True)
class Figures:
    """What is stored of a scenario: figures of all runs together, and NEES and rms of each, which nothing compares."""

    seeds: tuple[int, ...]
    tracked: int
    nees: float | None
    nees_late: float | None
    nees_median: float | None
    nees_numbers: int
    coverage: float | None
    sets: int
    ratio: float | None
    ratio_late: float | None
    ratio_median: float | None
    rms_m: float | None
    broken: int
    counts: dict[str, int]
    wrong: tuple[str, ...]
    cpu: float
    nees_of_runs: tuple[float | None, ...]
    rms_of_runs_m: tuple[float | None, ...]

    @classmethod
    def of(cls, runs: Sequence[Run]) -> Figures:
        """Pooled over runs: errors and bounds are root mean squares."""
        nees, rms, bound, late, late_bound = (
            np.array([getattr(run, name) for run in runs])
            for name in ("nees", "rms_m", "bound_m", "late_m", "late_bound_m")
        )
        sets = sum(run.sets for run in runs)
        counts: dict[str, int] = {}
        for run in runs:
            for name, count in run.counts.items():
                counts[name] = counts.get(name, 0) + int(count)
        return cls(
            seeds=tuple(run.seed for run in runs),
            tracked=sum(run.tracked for run in runs),
            nees=_mean(nees),
            nees_late=_mean(np.array([run.nees_late for run in runs])),
            nees_median=_median(nees),
            nees_numbers=sum(run.nees_numbers for run in runs),
            coverage=_rounded(sum(run.held for run in runs) / sets) if sets else None,
            sets=sets,
            ratio=_rounded(math.sqrt(float(np.mean(rms**2) / np.mean(bound**2)))),
            ratio_late=_rounded(math.sqrt(float(np.mean(late**2) / np.mean(late_bound**2)))),
            ratio_median=_median(rms / bound),
            rms_m=_root_mean_square(rms),
            broken=int(np.sum(nees > BROKEN)),
            counts=counts,
            wrong=tuple(f"{run.seed}: {what}" for run in runs for what in run.wrong),
            cpu=round(sum(run.cpu for run in runs), 1),
            nees_of_runs=tuple(_rounded(float(value)) for value in nees),
            rms_of_runs_m=tuple(_rounded(float(value)) for value in rms),
        )

    @classmethod
    def read(cls, stored: dict[str, object]) -> Figures:
        """From JSON."""
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in stored.items()})  # type: ignore[arg-type]

    @property
    def json(self) -> dict[str, object]:
        return asdict(self)


def _rounded(value: float) -> float | None:
    """Six digits, None of what is not finite: JSON has no NaN."""
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _mean(values: np.ndarray) -> float | None:
    return _rounded(float(np.nanmean(values))) if np.isfinite(values).any() else None


def _median(values: np.ndarray) -> float | None:
    return _rounded(float(np.median(values[np.isfinite(values)]))) if np.isfinite(values).any() else None


def _root_mean_square(values: np.ndarray) -> float | None:
    return None if (square := _mean(values**2)) is None else _rounded(math.sqrt(square))


@dataclass(frozen=True)
class Comparison:
    """One figure, old and new; `limit` is the worst that is allowed, in words."""

    name: str
    old: object
    new: object
    worse: bool
    limit: str = ""


def compare(old: Figures, new: Figures) -> list[Comparison]:
    """All figures of a scenario."""
    late, of_median = 1.0 - 1.0 / FIRST_ROWS, math.sqrt(0.5 * math.pi)
    of_nees = math.sqrt(2.0 / max(old.nees_numbers, 1))
    of_error = 1.0 / math.sqrt(max(old.nees_numbers, 1))  # six numbers a place
    found = [
        _distance("nees", old.nees, new.nees, 1.0, of_nees),
        _distance("nees_late", old.nees_late, new.nees_late, 1.0, of_nees / math.sqrt(late)),
        _distance("nees_median", old.nees_median, new.nees_median, 1.0, of_nees * of_median),
        _distance(
            "coverage",
            old.coverage,
            new.coverage,
            RANGE_LEVEL,
            math.sqrt(RANGE_LEVEL * (1.0 - RANGE_LEVEL) / max(old.sets, 1)),
        ),
    ]
    # An error below the bound is no fault: what is asked is that it does not grow.
    ratios = (("ratio", of_error), ("ratio_late", of_error / math.sqrt(late)), ("ratio_median", of_error * of_median))
    for name, relative in ratios:
        if (of_old := getattr(old, name)) is not None:
            most = of_old + LARGEST_GROWTH * abs(of_old - 1.0) + of_old * relative
            found.append(_at_most(name, of_old, getattr(new, name), most))
    if old.ratio is None and old.rms_m is not None:
        found.append(_at_most("rms_m", old.rms_m, new.rms_m, old.rms_m * (1.0 + LARGEST_GROWTH + of_error)))
    found.append(Comparison("tracked", old.tracked, new.tracked, new.tracked < old.tracked, f">= {old.tracked}"))
    found.append(_at_most("broken", old.broken, new.broken, old.broken))
    for name in dict.fromkeys([*old.counts, *new.counts]):
        of_old = old.counts.get(name, 0)
        found.append(_at_most(name, of_old, new.counts.get(name, 0), of_old))
    found.append(Comparison("wrong", old.wrong, new.wrong, bool(set(new.wrong) - set(old.wrong)), "no others"))
    return [one for one in found if one.old is not None or one.new is not None]


def _distance(name: str, old: float | None, new: float | None, ideal: float, slack: float) -> Comparison:
    if old is None:
        return Comparison(name, old, new, worse=False)
    allowed = (1.0 + LARGEST_GROWTH) * abs(old - ideal) + slack
    worse = new is None or abs(new - ideal) > allowed
    return Comparison(name, old, new, worse, f"{ideal - allowed:.3g} to {ideal + allowed:.3g}")


def _at_most(name: str, old: float, new: float | None, most: float) -> Comparison:
    return Comparison(name, old, new, new is None or new > most, f"<= {most:.4g}")
