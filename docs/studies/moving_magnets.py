"""Tracks of magnets over a board: ``python -m docs.studies.moving_magnets --sources 3 --seeds 20``.

Prints every run, and of all of them: swaps, births and losses, NEES per dimension, sensors that were named, and the
processor time of a row. Paths are drawn anew where two magnets come nearer than ``--gap-mm``, all of them or
``--one-by-one``. With ``--crossing-mm`` two magnets go to and fro past each other instead, and with ``--slide-in-mm``
the last one comes from so far away.
"""

from __future__ import annotations

import argparse

import numpy as np

from tests.moving_magnets import (
    FAULTS,
    HIGH_M,
    RATE_HZ,
    STRENGTH_AM2,
    Magnets,
    Within,
    board,
    followed,
    judged,
    with_fault,
)


def main() -> None:
    """Follow magnets in some runs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sources", type=int, default=2)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--gap-mm", type=float, default=20.0)
    parser.add_argument("--highest-mm", type=float, default=1e3 * HIGH_M[2])
    parser.add_argument("--weakest-Am2", type=float, default=STRENGTH_AM2[0])
    parser.add_argument("--roam", type=float, default=1.0)
    parser.add_argument("--one-by-one", action="store_true")
    parser.add_argument("--repelled", action="store_true", help="magnets that keep clear of each other")
    parser.add_argument("--come-and-go", action="store_true")
    parser.add_argument("--crossing-mm", type=float, help="two magnets pass each other at this gap")
    parser.add_argument("--slide-in-mm", type=float, help="the last magnet comes from so far away")
    parser.add_argument("--fault", choices=FAULTS)
    parser.add_argument("--only", type=int, nargs="*", help="these seeds")
    given = parser.parse_args()
    array, n_rows, runs = board(), int(given.seconds * RATE_HZ), []
    for seed in given.only or range(given.first, given.first + given.seeds):
        rng = np.random.default_rng(seed)
        within = Within(1e-3 * given.highest_mm, given.weakest_Am2, given.roam, given.one_by_one, given.repelled)
        if given.crossing_mm:
            truth = Magnets.crossing(n_rows, 1e-3 * given.crossing_mm, rng)
        else:
            truth = Magnets.drawn(
                given.sources, n_rows, 1e-3 * given.gap_mm, rng, come_and_go=given.come_and_go, within=within
            )
        if given.slide_in_mm:
            truth = truth.sliding(1e-3 * given.slide_in_mm, rng)
        readings_T = truth.readings_T(array, rng)
        if given.fault:
            readings_T = with_fault(readings_T, given.fault, int(rng.integers(array.n_sensors)), n_rows // 2)
        points, row_ms = followed(array, readings_T)
        runs.append(judged(points, truth, row_ms))
        run = runs[-1]
        print(
            f"seed {seed}: swaps {run.swaps} ({run.early_swaps} since first reported), rows with too many"
            f" {run.false_births},"
            f" too few {run.lost_rows}, misfit"
            f" {run.misfit_rows}, merged {run.merged_rows}, birth after {run.late_birth_rows}, loss after"
            f" {run.late_loss_rows}, NEES {run.nees:.2f}, rms {1e3 * run.rms_m:.2f} mm, named {run.named},"
            f" {np.median(run.row_ms):.2f} ms a row, {run.row_ms.mean():.2f} mean, {run.row_ms.max():.0f} most"
            + (
                f", others { ({name: round(one, 2) for name, one in run.others.items()}) }" if given.slide_in_mm else ""
            ),
            flush=True,
        )
    nees = np.array([run.nees for run in runs])
    print(
        f"{len(runs)} runs: {sum(run.swaps > 0 for run in runs)} with a swap"
        f" ({sum(run.early_swaps > 0 for run in runs)} since first reported),"
        f" {sum(run.false_births > 0 for run in runs)} with a false birth, {np.sum(nees > 3.0)} broken (NEES above 3);"
        f" NEES of the median run {np.median(nees):.2f};"
        f" {np.median([np.median(run.row_ms) for run in runs]):.2f} ms a row,"
        f" {np.mean([run.row_ms for run in runs]):.2f} mean,"
        f" {np.median([run.row_ms.max() for run in runs]):.0f} the longest one of the median run"
    )


if __name__ == "__main__":
    main()
