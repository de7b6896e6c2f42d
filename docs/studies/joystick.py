"""Figures of the joystick: ``python -m docs.studies.joystick --seeds 24``.

Prints, for every way of calibration, the rms errors of a motion at 1 kHz, with and without the common frame, and the
cross-talk: the median and the worst of the devices.
"""

from __future__ import annotations

import argparse
from dataclasses import astuple

import numpy as np

from tests.joystick_runs import run


def main() -> None:
    """Calibrate and follow some devices."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--first", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=24)
    parser.add_argument("--seconds", type=float, default=1.0)
    given = parser.parse_args()
    runs = [run(seed, given.seconds) for seed in range(given.first, given.first + given.seeds)]
    print(f"{'':37}{'mm':>8}{'°':>8}{'mm, own frame':>16}{'°, own frame':>16}{'cross-talk %':>14}{'lost %':>8}")
    for name in runs[0]:
        values = np.array([astuple(each[name]) for each in runs]) * [1.0, 1.0, 1.0, 1.0, 100.0, 100.0]
        for word, row in (("median", np.median(values, axis=0)), ("worst", values.max(axis=0))):
            mm, deg, own_mm, own_deg, talk, lost = row.tolist()
            print(f"{name:30}{word:>7}{mm:8.4f}{deg:8.3f}{own_mm:16.4f}{own_deg:16.3f}{talk:14.2f}{lost:8.1f}")


if __name__ == "__main__":
    main()
