"""Twenty-four magnets in beating tissue in one filter: ``python -m docs.studies.beating_tissue --out beating.png``.

The recording `curibio`: 24 wells, each with a magnet some 5 mm over three sensors of its own, 100 rows a second. Prints
whether any two tracks came near each other, how far each magnet moved and what a row took, and draws how they move.
"""

from __future__ import annotations

import argparse
import os
import time
from pathlib import Path

import netCDF4
import numpy as np
from matplotlib.figure import Figure

import magloc
from arrays.array import SensorArray
from arrays.sensor import Sensor
from arrays.typing import FloatArray

PITCH_M, ROWS, COLUMNS = 0.0195, 4, 6
TRIAD_M = np.array([[-2.15e-3, 1.7e-3, 0.0], [2.15e-3, 1.7e-3, 0.0], [0.0, -2.743e-3, 0.0]])
T_PER_COUNT = 16e-4 / 2**16
NOISE_T, RATE_HZ = 9.5e-6, 100.0
# What is drawn: the last seconds, and how far apart lines are.
SHOWN_S, APART_UM = 10.0, 20.0
# The first rows carry times that go to and fro.
FIRST_ROW = 5
WELL = np.array([[PITCH_M * (n % COLUMNS), -PITCH_M * (n // COLUMNS), 0.0] for n in range(ROWS * COLUMNS)])


def plate() -> SensorArray:
    """Three sensors below each of the wells."""
    return SensorArray(
        tuple(
            Sensor(f"w{n + 1:02}{'abc'[i]}", "vector", tuple((well + at).tolist()), NOISE_T)
            for n, well in enumerate(WELL)
            for i, at in enumerate(TRIAD_M)
        ),
        name="plate of 24 wells",
    )


def readings_T(folder: Path) -> FloatArray:
    """Readings (n, 216) less the mean of the empty plate."""

    def of(kind: str, well: int) -> FloatArray:
        with netCDF4.Dataset(folder / f"{kind}_{well}.h5") as file:
            counts: FloatArray = np.asarray(file["tissue_sensor_readings"][:], dtype=np.float64)
        return T_PER_COUNT * (counts - 2**15)

    wells = range(1, ROWS * COLUMNS + 1)
    return np.concatenate([of("90min", n) - of("Baseline", n).mean(axis=1, keepdims=True) for n in wells]).T


def followed(array: SensorArray, values: FloatArray) -> tuple[FloatArray, FloatArray, list[str], FloatArray]:
    """Places (24, n, 3) of all magnets, their σ, the sensors that were named, and the processor time of each row."""
    n = len(WELL)
    tracker = magloc.SourcesTracker(array, sources=n, motion=magloc.FreeMotion(speed_m_s=0.005, turn_rad_s=0.3))
    places, sigma = np.full((2, n, len(values), 3), np.nan)
    named: list[str] = []
    took = np.empty(len(values))
    for row, of_row in enumerate(values):
        began = time.thread_time()
        point = tracker.update(magloc.Readings(of_row[None], time_s=np.array([row / RATE_HZ])))
        took[row] = time.thread_time() - began
        named += [name for name in point.dropped_sensors if name not in named]
        for track in point.tracks:
            if track.id <= n:
                places[track.id - 1, row] = track.position_m
                sigma[track.id - 1, row] = np.sqrt(np.diagonal(track.covariance)[:3])
    return places, sigma, named, took


def drawn(places: FloatArray, sigma: FloatArray) -> Figure:
    """One axis of all magnets over ten seconds, and all axes of the one that moves most with its σ."""
    figure = Figure(figsize=(11, 6), layout="constrained")
    left, right = figure.subplots(1, 2)
    n = int(SHOWN_S * RATE_HZ)
    time_s, shown = np.arange(n) / RATE_HZ, places[:, -n:]
    away = 1e6 * (shown - np.nanmean(shown, axis=1, keepdims=True))
    order = np.argsort([int(np.argmin(np.linalg.norm(WELL[:, :2] - place[:2], axis=1))) for place in places[:, 0]])
    for i, k in enumerate(order):
        left.plot(time_s, away[k, :, 0] + APART_UM * i, color=f"C{i % 2}", linewidth=0.8)
    left.set_yticks(APART_UM * np.arange(len(order)), [f"{i + 1}" for i in range(len(order))])
    left.set(xlabel="time [s]", ylabel=f"well: x of its magnet, lines {APART_UM:g} µm apart")
    well = int(np.argmax(np.nanstd(away[order], axis=1).max(axis=1)))
    for axis, name in enumerate("xyz"):
        moved, width = away[order[well], :, axis], 1e6 * np.median(sigma[order[well], -n:, axis])
        right.plot(time_s, moved + 2.0 * APART_UM * axis, linewidth=0.9, label=f"{name}, σ {width:.0f} µm")
    right.set(xlabel="time [s]", ylabel=f"magnet of well {well + 1} [µm], axes {2.0 * APART_UM:g} µm apart")
    right.legend(loc="lower center", ncols=3)
    return figure


def main() -> None:
    """Follow the magnets, and draw them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rows", type=int, default=10_000)
    parser.add_argument("--without", default="", help="a sensor that is left out")
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    array = plate()
    values = readings_T(Path(os.environ["MAGLOC_DATA"]) / "curibio")[FIRST_ROW : FIRST_ROW + given.rows]
    left_out = np.array([name == given.without for name in array.ids])
    values[:, left_out[array.channel_sensor]] = np.nan
    places, sigma, named, took = followed(array, values)
    told = np.isfinite(places[:, :, 0])
    mean = np.nanmean(places, axis=1)
    nearest = np.array([np.linalg.norm(WELL[:, :2] - place[:2], axis=1).argmin() for place in mean])
    away = np.linalg.norm(places - mean[:, None], axis=2)
    wells = len(set(nearest.tolist()))
    print(
        f"{len(values)} rows, {int(told.sum())} places of {told.size}; magnets in {wells} wells, none farther than"
        f" {1e6 * np.nanmax(away):.0f} µm from its mean place, {1e3 * PITCH_M:.1f} mm from the next; heights"
        f" {1e3 * mean[:, 2].min():.2f} to {1e3 * mean[:, 2].max():.2f} mm; named: {named}; {1e3 * took[0]:.0f} ms the"
        f" first row, {1e3 * np.median(took):.1f} ms the median one, {1e3 * took[1:].max():.0f} most"
    )
    if given.out is not None:
        drawn(places, sigma).savefig(given.out, dpi=130)


if __name__ == "__main__":
    main()
