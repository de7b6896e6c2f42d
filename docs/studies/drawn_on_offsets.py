"""Tracks on unknown offsets of sources that move as is stated: ``python -m docs.studies.drawn_on_offsets walk``.

Truths are drawn from the motion that the tracker assumes, 250 A·m² from 8 m on. Prints NEES per dimension of every
track, and what it says of itself.
"""

from __future__ import annotations

import argparse
import math

import numpy as np

import magloc
from magloc.truth import Truth
from tests.passing_source import ARRAY
from tests.tracked_sources import WALK, drawn

MOTIONS = {"walk": WALK, "wandering": magloc.OrnsteinUhlenbeck(WALK.speed_m_s, WALK.turn_rad_s)}


def main() -> None:
    """Measure one motion."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("motion", choices=MOTIONS)
    parser.add_argument("--first", type=int, default=4000)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--rows", type=int, default=240)
    given = parser.parse_args()
    found = []
    for seed in range(given.first, given.first + given.seeds):
        truth, readings = drawn(MOTIONS[given.motion], given.rows, seed)
        track = magloc.track(ARRAY, readings.high_passed(0.01), motion=MOTIONS[given.motion])
        nees = math.nan
        if track.tracked.any():
            nees = track.consistency(Truth(track.time_s, truth[:, :3], truth[:, 3:6])).nees_per_dimension
        found.append(nees)
        said = track.innovations.reason or "nothing"
        print(f"seed {seed}: {int(track.tracked.sum())} rows, NEES {nees:.2f}, says {said}", flush=True)
    print(f"{given.motion}: median NEES {np.nanmedian(found):.1f} of {int(np.isfinite(found).sum())} tracks")


if __name__ == "__main__":
    main()
