"""Tracks of a built-in scenario whose array's pose errs, stated or not: ``python -m tests.stated_pose diver walk``.

The source is known to rest. Prints every seed and their means: rows that are tracked; NEES per dimension and rms error
over the bound that has the pose as nuisance, over the tracked rows; and what the tests of the innovations say.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace

import numpy as np

import magloc
import sims
from arrays.pose import PoseUncertainty

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


def main() -> None:
    """Measure one case of one scenario."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenario")
    parser.add_argument("case", choices=CASES)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    errs, stated = CASES[given.case]
    scenario = replace(sims.read_scenario(given.scenario), pose=errs)
    found = []
    for seed in range(given.first, given.first + given.seeds):
        simulation = sims.simulate(scenario, seed)
        track = magloc.track(replace(simulation.array, pose=stated), simulation.readings, motion=REST)
        rows, test = int(track.tracked.sum()), track.innovations
        judged = track.consistency(simulation.truth) if rows else None
        nees, rms, bound = (
            (judged.nees_per_dimension, judged.position_rms_m, judged.position_bound_m) if judged else (math.nan,) * 3
        )
        found.append((rows, nees, rms, bound, test.flagged))
        print(
            f"seed {seed}: {rows} of {len(track)} rows, NEES {nees:.2f}, rms {rms:.4f} m, bound {bound:.4f} m,"
            f" z {test.z_chi2:.1f} and {test.z_lag1:.1f}{' flagged' if test.flagged else ''}",
            flush=True,
        )
    rows, nees, rms, bound, flagged = np.array(found, dtype=np.float64).T
    ratio = math.sqrt(float(np.nanmean(rms**2) / np.nanmean(bound**2)))
    print(
        f"{given.scenario}, {given.case}, {len(found)} seeds: {rows.mean():.0f} rows, NEES {np.nanmean(nees):.2f},"
        f" rms over bound {ratio:.2f}, flagged {int(flagged.sum())}"
    )


if __name__ == "__main__":
    main()
