"""Tracks where the pose or the ambient field errs, stated or not: ``python -m docs.studies.stated_pose diver walk``.

The source is known to rest. Prints of every seed, and of all: rows that have an answer; NEES per dimension and rms
error over the bound that has the errors as nuisance, over the answered rows and of the last one; and what the tests of
the innovations say. With ``--kept FILE`` seeds that stand there are not run again.
"""

from __future__ import annotations

import argparse
import csv
import math
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import numpy as np

import magloc
import sims
from arrays.pose import PoseUncertainty
from sims.magnetics.scenario import MagneticScenario
from tests.magloc.tracking import test_ambient_uncertainty
from tests.tracked_sources import PASSING, REST, WHITE

SCENARIOS = {"tetrahedron": PASSING, "moduli": test_ambient_uncertainty.SCENARIO}
WALK = replace(WHITE, correlation_s=10.0)
MOUNTING = {"position_constant_m": 0.05, "attitude_constant_rad": math.radians(0.5)}
SMALL = PoseUncertainty(0.002, math.radians(0.03), 0.0, 0.0, 0.0, 0.0)
# What errs, and what is stated.
CASES: dict[str, tuple[PoseUncertainty | None, PoseUncertainty | None]] = {
    "exact": (None, None),
    "white": (WHITE, WHITE),
    "walk": (WALK, WALK),
    "white-mounting": (replace(WHITE, **MOUNTING), replace(WHITE, **MOUNTING)),
    "walk-mounting": (replace(WALK, **MOUNTING), replace(WALK, **MOUNTING)),
    "unstated": (SMALL, None),
    "walk-as-white": (WALK, WHITE),
    "mounting-as-exact": (replace(WHITE, **MOUNTING), WHITE),
}
# σ of the ambient field, which is stated, for a scenario of moduli.
AMBIENT_T = {"ambient-50": 50e-9, "ambient-500": 500e-9}


@dataclass(frozen=True)
class Run:
    """One seed: rows answered and on the track; NEES per dimension, rms error and bound [m], also of the last row."""

    seed: int
    answered: float
    tracked: float
    nees: float = math.nan
    rms_m: float = math.nan
    bound_m: float = math.nan
    last_nees: float = math.nan
    last_m: float = math.nan
    last_bound_m: float = math.nan
    z_chi2: float = math.nan
    z_lag1: float = math.nan
    z_constants: float = math.nan
    flagged: float = 0.0


def main() -> None:
    """Measure one case of one scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", help=f"of magloc simulate, or one of {', '.join(SCENARIOS)}")
    parser.add_argument("case", choices=[*CASES, *AMBIENT_T])
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--kept", type=Path, help="table of the seeds so far")
    given = parser.parse_args()
    errs, stated = CASES.get(given.case, (None, None))
    scenario = SCENARIOS.get(given.scenario) or sims.read_scenario(given.scenario)
    of_field = replace(scenario.array, ambient_uncertainty_T=AMBIENT_T.get(given.case, 0.0))
    scenario = replace(scenario, array=of_field, pose=errs)
    kept = runs_of(given.kept)
    found = []
    for seed in range(given.first, given.first + given.seeds):
        if seed not in kept:
            kept[seed] = run(scenario, seed, stated)
            if given.kept is not None:
                append(given.kept, kept[seed])
        found.append(kept[seed])
        print(", ".join(f"{name} {value:.4g}" for name, value in asdict(found[-1]).items()), flush=True)
    print(f"{given.scenario}, {given.case}, {len(found)} seeds: {summary(found)}")


def run(scenario: MagneticScenario, seed: int, stated: PoseUncertainty | None) -> Run:
    """Track one seed, and judge the track."""
    simulation = sims.simulate(scenario, seed)
    track = magloc.track(replace(simulation.array, pose=stated), simulation.readings, motion=REST)
    of_track = Run(seed, np.isfinite(track.position_m[:, 0]).sum(), track.tracked.sum())
    if not of_track.answered:
        return of_track
    judged, test = track.consistency(simulation.truth), track.innovations
    return replace(
        of_track,
        nees=judged.nees_per_dimension,
        rms_m=judged.position_rms_m,
        bound_m=judged.position_bound_m,
        last_nees=judged.nees[-1] / judged.nees_dof[-1] if judged.nees_dof[-1] else math.nan,
        last_m=float(np.linalg.norm(track.position_m[-1] - judged.true_position_m[-1])),
        last_bound_m=math.nan if judged.bound_m is None else judged.bound_m[-1],
        z_chi2=test.z_chi2,
        z_lag1=test.z_lag1,
        z_constants=test.z_constants,
        flagged=test.flagged,
    )


def summary(runs: list[Run]) -> str:
    """Means over seeds; rms errors over bounds are pooled."""
    of = {name: np.array([getattr(one, name) for one in runs], dtype=np.float64) for name in asdict(runs[0])}

    def ratio(error: str, bound: str) -> float:
        return math.sqrt(float(np.nanmean(of[error] ** 2) / np.nanmean(of[bound] ** 2)))

    return (
        f"{of['answered'].mean():.0f} rows, {of['tracked'].mean():.0f} on the track,"
        f" NEES {np.nanmean(of['nees']):.2f}, median {np.nanmedian(of['nees']):.2f},"
        f" rms over bound {ratio('rms_m', 'bound_m'):.2f}; last row {np.nanmean(of['last_nees']):.2f} and"
        f" {ratio('last_m', 'last_bound_m'):.2f}; flagged {int(of['flagged'].sum())}"
    )


def runs_of(table: Path | None) -> dict[int, Run]:
    """Runs that a table has, by their seeds."""
    if table is None or not table.exists():
        return {}
    with table.open(encoding="utf-8", newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    return {int(row["seed"]): Run(**{**row, "seed": int(row["seed"])}) for row in rows}  # type: ignore[arg-type]


def append(table: Path, one: Run) -> None:
    """One more row of a table."""
    begins = not table.exists()
    with table.open("a", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, [field.name for field in fields(Run)])
        if begins:
            writer.writeheader()
        writer.writerow({name: float(value) for name, value in asdict(one).items()})


if __name__ == "__main__":
    main()
