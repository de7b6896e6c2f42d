"""Simulated photographs, solved from the picture alone: ``python -m docs.studies.photograph_figures``.

Of the real sky, 1024 × 768 px of 40″, twice as bright at one side as at the other, corners 30 % dark, 20 hot pixels,
every second with trails of 3 px, the scale stated wrong by up to 4 %. Prints how many are solved, how many are false,
and the NEES of a pose.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np
from scipy.spatial.transform import Rotation

import adcs
from adcs.stars.camera import StarCamera
from adcs.stars.identification import StarFix
from adcs.stars.unknown_scale import solve_photograph
from tests.adcs.stars.skies import HARD, photograph

CAMERA = StarCamera(1024, 768, math.radians(40.0 / 3600.0))
FALSE_RAD = math.radians(0.05)


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=12)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    sky = adcs.hipparcos_catalogue(1991.25)
    right, false, nees, seconds = 0, 0, [], []
    for i, R in enumerate(Rotation.random(given.count, rng).as_matrix()):
        picture, _, _ = photograph(sky, CAMERA, R, rng, **HARD, trail_px=3.0 * (i % 2))
        stated = CAMERA.rad_per_px * rng.uniform(0.96, 1.04)
        began = time.process_time()
        _, found = solve_photograph(picture, sky, rad_per_px=stated)
        seconds.append(time.process_time() - began)
        if not isinstance(found, StarFix):
            print(f"picture {i}: {found.reason}", flush=True)
            continue
        turn = Rotation.from_matrix(R.T @ found.R_catalogue_from_frame).as_rotvec()
        off = math.log(found.pose.camera.rad_per_px / CAMERA.rad_per_px)
        if np.linalg.norm(turn) > FALSE_RAD or abs(off) > 1e-3:
            false += 1
            print(f"picture {i}: false by {math.degrees(np.linalg.norm(turn)):.2f}°, {off:.2%}", flush=True)
            continue
        right += 1
        error = np.array([*turn, off, found.pose.camera.radial])
        nees.append(error @ np.linalg.solve(found.pose.covariance, error) / 5.0)
        if right % 100 == 0:
            print(f"picture {i}: {right} right, NEES {np.mean(nees):.2f}", flush=True)
    print(f"{right} of {given.count} right, {false} false; NEES per state {np.mean(nees):.2f}")
    print(f"CPU of one: median {np.median(seconds):.2f} s, most {max(seconds):.2f} s")


if __name__ == "__main__":
    main()
