"""Tracks where the array's pose errs, stated or not, or the ambient field: ``python -m tests.stated_pose diver walk``.

The source is known to rest. Prints every seed and their means: rows that are tracked; NEES per dimension and rms error
over the bound that has the errors as nuisance, over the tracked rows and of the last one; and what the tests of the
innovations say.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

import magloc
import sims
from arrays.pose import PoseUncertainty
from magloc.tracking.posterior_bound import posterior_bound
from magloc.tracking.results import rows_of
from sims.magnetics.simulation import Simulation
from tests.magloc.tracking.test_ambient_uncertainty import SCENARIO

REST = magloc.RandomWalk(1e-5, 1e-5)
WHITE = PoseUncertainty(0.02, math.radians(0.3), 0.02, 0.0, 0.0, 0.0)
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
}
# σ of the ambient field, which is stated, for a scenario of moduli.
AMBIENT_T = {"ambient-50": 50e-9, "ambient-500": 500e-9}


def main() -> None:
    """Measure one case of one scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario", help="of magloc simulate, or moduli: eight scalar sensors")
    parser.add_argument("case", choices=[*CASES, *AMBIENT_T])
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    errs, stated = CASES.get(given.case, (None, None))
    scenario = SCENARIO if given.scenario == "moduli" else sims.read_scenario(given.scenario)
    of_field = replace(scenario.array, ambient_uncertainty_T=AMBIENT_T.get(given.case, 0.0))
    scenario = replace(scenario, array=of_field, pose=errs)
    found = []
    for seed in range(given.first, given.first + given.seeds):
        simulation = sims.simulate(scenario, seed)
        track = magloc.track(replace(simulation.array, pose=stated), simulation.readings, motion=REST)
        rows, test = int(track.tracked.sum()), track.innovations
        judged = track.consistency(simulation.truth) if rows else None
        nees, rms, bound = (
            (judged.nees_per_dimension, judged.position_rms_m, judged.position_bound_m) if judged else (math.nan,) * 3
        )
        last = last_row(simulation, track)
        found.append((rows, nees, rms, bound, test.flagged, *last))
        print(
            f"seed {seed}: {rows} of {len(track)} rows, NEES {nees:.2f}, rms {rms:.4f} m, bound {bound:.4f} m,"
            f" last {last[0]:.2f}, {last[1]:.4f} and {last[2]:.4f} m,"
            f" z {test.z_chi2:.1f} and {test.z_lag1:.1f}{' flagged' if test.flagged else ''}",
            flush=True,
        )
    rows, nees, rms, bound, flagged, last_nees, last_off, last_bound = np.array(found, dtype=np.float64).T
    ratio, last_ratio = (
        math.sqrt(float(np.nanmean(of**2) / np.nanmean(least**2)))
        for of, least in ((rms, bound), (last_off, last_bound))
    )
    print(
        f"{given.scenario}, {given.case}, {len(found)} seeds: {rows.mean():.0f} rows, NEES {np.nanmean(nees):.2f},"
        f" median {np.nanmedian(nees):.2f}, rms over bound {ratio:.2f}; last row {np.nanmean(last_nees):.2f} and"
        f" {last_ratio:.2f}; flagged {int(flagged.sum())}"
    )


def last_row(simulation: Simulation, track: magloc.Track) -> tuple[float, float, float]:
    """NEES per dimension, error and bound [m] of the last row; NaN where it is not tracked."""
    truth = simulation.truth
    if not track.tracked[-1] or truth.moment_Am2 is None:
        return (math.nan,) * 3
    bound = posterior_bound(track.tracker, list(rows_of(track.readings)), truth.position_m, truth.moment_Am2)
    true = np.concatenate([truth.position_m[-1], truth.moment_Am2[-1]])
    error = np.concatenate([track.position_m[-1], track.moment_Am2[-1]]) - true
    nees = float(error @ np.linalg.solve(track.covariance[-1], error)) / 6.0
    return nees, float(np.linalg.norm(error[:3])), float(bound[-1])


if __name__ == "__main__":
    main()
