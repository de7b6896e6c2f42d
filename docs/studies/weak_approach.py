"""A weak source that comes nearer, from its first row: ``python -m docs.studies.weak_approach --first 100 --seeds 20``.

A tetrahedron of 1.5 m, 0.2 nT, 2 Hz. The source starts 20 m away in any direction, with a moment in any direction that
is 4 to 6 standard deviations strong in the first row, and passes by at 5 m in the last one, at constant velocity; its
moment turns at a rate of 1.2°/s about each axis. The tracker knows the motion, but not that the source comes nearer.

Prints of rows what errors, range sets and weights are against what they claim.
"""

from __future__ import annotations

import argparse
import math
import time

import numpy as np

from arrays.typing import FloatArray
from magloc.tracking.consistency import nees_of
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import rows_of
from magloc.tracking.tracker import Tracker
from magloc.tracking.whole_records.posterior_bound import posterior_bound
from tests.passing_source import ARRAY
from tests.tracked_sources import APPROACH, N_APPROACH, approach


def judged(seed: int) -> FloatArray:
    """Of every row (n, 8).

    Whether it shows the source, and whether it is answered; squared error and its bound; NEES per dimension;
    whether the range set holds the truth; Brier's score of the weights, and what it is on average if they are honest.
    """
    truth, readings = approach(seed)
    rows, tracker = list(rows_of(readings)), Tracker(ARRAY, APPROACH)
    bounds = posterior_bound(tracker, rows, truth[:, :3], truth[:, 3:])
    result = np.full((N_APPROACH, 8), np.nan)
    for i, point in enumerate(tracker.run(rows)):
        seen = tracker.measurements.of(rows[i]).is_detected(tracker.errors.sigma)
        result[i, :2] = seen, point.position_m is not None
        if point.position_m is None:
            continue
        ((low, high),) = point.range_interval_m or ((0.0, None),)
        range_m = float(np.linalg.norm(truth[i, :3] - ARRAY.centroid))
        result[i, 2:6] = (
            np.sum((point.position_m - truth[i, :3]) ** 2),
            bounds[i] ** 2,
            nees_of(point, truth[i], tracker.measurements.of(rows[i]))[0] / 6.0,
            low <= range_m and (high is None or range_m <= high),
        )
        result[i, 6:] = brier_of(point, truth[i])
    return result


def brier_of(point: TrackPoint, truth: FloatArray) -> tuple[float, float]:
    """Brier's score of a mixture's weights, and its mean if they are honest.

    Which component proved true, the truth tells with the probabilities q of each given the truth, so that the score is
    the mean 1 - 2 q·w + w·w of them; if the truth is one of the mixture's draws, q is w on average.
    """
    mixture = point.mixture
    assert mixture is not None
    e = mixture.chart.coordinates(np.tile(truth, (len(mixture), 1)))
    standard = np.linalg.solve(mixture.S, e[..., None])[..., 0]
    log_q = mixture.log_weight - 0.5 * np.sum(standard**2, axis=1) - np.linalg.slogdet(mixture.S)[1]
    weight, q = mixture.weight, np.exp(log_q - np.logaddexp.reduce(log_q))
    square = float(weight @ weight)
    return 1.0 - 2.0 * float(q @ weight) + square, 1.0 - square


def main() -> None:
    """Follow some approaches."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--seeds", type=int, default=20)
    given = parser.parse_args()
    runs = []
    for seed in range(given.first, given.first + given.seeds):
        begin = time.process_time()
        runs.append(judged(seed))
        took, run = time.process_time() - begin, runs[-1]
        last, missing = run[-1], int(np.sum(run[:, 0] > run[:, 1]))
        print(
            f"seed {seed}: detected in row {int(np.argmax(run[:, 0]))}, {missing} detected rows"
            f" unanswered; last row: error {math.sqrt(last[2]):.3f} m, bound {math.sqrt(last[3]):.3f} m, NEES"
            f" {last[4]:.2f}; sets hold {100.0 * np.nanmean(run[:, 5]):.0f} %; {took:.1f} s",
            flush=True,
        )
    print_rows(np.array(runs))


def print_rows(runs: FloatArray) -> None:
    """What all runs (runs, n, 8) say of some rows, and of all."""
    print("row: answered, rms over the bound, NEES (median), sets that hold the truth, Brier's score (if honest)")
    for row in (0, 5, 10, 20, 30, 40, 50, 55, runs.shape[1] - 1):
        of_row = runs[:, row]
        told = of_row[of_row[:, 1] > 0.0]
        if not len(told):
            continue
        finite = told[np.isfinite(told[:, 3])]
        ratio = math.sqrt(finite[:, 2].mean() / finite[:, 3].mean()) if len(finite) else math.nan
        answered = int(np.sum(of_row[:, 1] * of_row[:, 0]))
        print(
            f"{row}: {answered} of {int(of_row[:, 0].sum())}, {ratio:.2f}, {told[:, 4].mean():.2f}"
            f" ({np.median(told[:, 4]):.2f}), {100.0 * told[:, 5].mean():.0f} %, {told[:, 6].mean():.2f}"
            f" ({told[:, 7].mean():.2f})"
        )
    detected, inside = runs[..., 0] > 0.0, runs[..., 5]
    told = np.isfinite(inside).sum(axis=0) >= 0.5 * len(runs)
    held = np.nansum(inside, axis=0) / np.maximum(np.isfinite(inside).sum(axis=0), 1)
    rows = np.where(told, held, np.inf)
    print(
        f"{len(runs)} runs: {100.0 * np.mean(runs[..., 1][detected]):.1f} % of detected rows answered; sets hold the"
        f" truth in {100.0 * np.nanmean(inside):.1f} %, {100.0 * rows.min():.1f} % at the worst row,"
        f" {int(np.argmin(rows))}; Brier's score {np.nanmean(runs[..., 6]):.3f}, {np.nanmean(runs[..., 7]):.3f} if"
        " weights are honest"
    )


if __name__ == "__main__":
    main()
