"""Magnets over arrays: poses with optical truth, and one that a robot moves."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from arrays.array import SensorArray
from arrays.array_file import read_array
from arrays.sensor import Sensor
from arrays.typing import FloatArray
from magloc.readings import read_readings
from magloc.truth import Truth, read_truth
from tests.proof import Part, Row, Size, row_of_offsets, run_command
from tests.proof.dipole_peers import Fits, cylinders, kalman_track, linear_calibration, random_starts

WRONG_M = 5e-3
MOCAP_SIGMA_M = 0.15e-3
RUNS = (1, 2, 3)
SUBTRACTED = 'background = "subtracted"\n'
NOISY = "noise_nT = 2000, noise_fraction = 0.03"
CYLINDER = ("--magnet", "cylinder", "--size-m", "0.01", "0.01")
FOUR = ("s08", "s11", "s20", "s23")
EVERY = 10
"""Rows of the robot's recording that scipy takes: each tenth; it takes as long as all the others together."""


class Located(NamedTuple):
    """Positions (n, 3) and covariances of a command's rows; NaN where there are none."""

    position_m: FloatArray
    covariance: FloatArray


def best_solutions(text: str) -> Located:
    """Return the best solution of every row that ``magloc locate --json`` or ``magloc track --json`` prints."""
    places, covariances = [], []
    for entry in json.loads(text)["results"]:
        best: Any = entry["solutions"][0] if entry and entry.get("solutions") else entry
        known = bool(best) and best.get("position_m") is not None
        places.append(best["position_m"] if known else [np.nan] * 3)
        covariances.append(np.array(best["covariance"])[:3, :3] if known else np.full((3, 3), np.nan))
    return Located(np.array(places), np.array(covariances))


def prepend_lines(folder: Path, array: Path, first: str) -> Path:
    """Write an array file with first lines of its own into a folder."""
    folder.mkdir(exist_ok=True)
    path = folder / array.name
    path.write_text(first + array.read_text(encoding="utf-8"), encoding="utf-8")
    return path


# ---- sixteen magnetometers, optical truth


def _mocap_row(
    run: int, tool: str, needs: str, seconds: float, places: FloatArray, covariance: FloatArray, truth: Truth
) -> Row:
    off = places - truth.position_m
    return row_of_offsets(f"run {run}", tool, needs, seconds, off, WRONG_M, covariance, MOCAP_SIGMA_M)


def our_mocap(data: Path, _: Size) -> Iterator[Row]:
    """Fixes and tracks with the source's constants of each run, then with a calibration on run 3."""
    folder = data / "magnet-mocap"
    with TemporaryDirectory() as name:
        for run in RUNS:
            readings, truth = folder / f"run{run}.csv", read_truth(folder / f"run{run}-truth.csv")
            array = prepend_lines(Path(name), folder / f"array-run{run}.toml", SUBTRACTED)
            noisy = Path(name) / "noisy.toml"
            text = array.read_text(encoding="utf-8")
            noisy.write_text(text.replace("noise_fraction = 0.003", "noise_fraction = 0.01"), encoding="utf-8")
            for label, path, needs, shape in (
                ("locate", array, "array file", ()),
                ("locate", array, "array file, size and shape of the magnet", CYLINDER),
                ("track", array, "array file", ()),
                ("track", noisy, "array file with noise_fraction = 0.01", ()),
                ("track", noisy, "array file with noise_fraction = 0.01, size and shape of the magnet", CYLINDER),
            ):
                text, seconds = run_command("magloc", label, readings, "--array", path, *shape, "--json")
                tool = f"`magloc {' '.join([label, *shape[:2]])}`" + (", noise stated" if path == noisy else "")
                yield _mocap_row(run, tool, needs, seconds / len(truth.time_s), *best_solutions(text), truth)
        out = Path(name) / "calibrated.toml"
        run3 = folder / "run3.csv", "--array", folder / "array-nominal.toml", "--truth", folder / "run3-truth.csv"
        run_command("magloc", "calibrate", *run3, "--out", out, "--json")
        for run in RUNS[:2]:
            truth = read_truth(folder / f"run{run}-truth.csv")
            text, seconds = run_command("magloc", "locate", folder / f"run{run}.csv", "--array", out, "--json")
            needs = "nominal array, run 3 with its truth"
            row = _mocap_row(
                run, "`magloc calibrate`, `locate`", needs, seconds / len(truth.time_s), *best_solutions(text), truth
            )
            yield replace(row, case=f"run {run}, calibrated on run 3")


def _mocap(folder: Path, array: str, run: int) -> tuple[SensorArray, FloatArray, Truth]:
    sensors = read_array(folder / f"array-{array}.toml")
    values = read_readings(folder / f"run{run}.csv", sensors).values_T
    return sensors, values, read_truth(folder / f"run{run}-truth.csv")


def _box(array: SensorArray) -> tuple[FloatArray, FloatArray]:
    """Return the corners of a box that has the magnet in it: 0.1 m around the sensors."""
    return array.positions.min(axis=0) - 0.1, array.positions.max(axis=0) + 0.1


def scipy_mocap(data: Path, size: Size) -> Iterator[Row]:
    """Least squares from random starts, as a dipole and with other calibrations."""
    folder = data / "magnet-mocap"
    needs = f"array file, box of the magnet, {size.starts} starts"
    for run in RUNS:
        array, values, truth = _mocap(folder, f"run{run}", run)
        fits = random_starts(array, values, *_box(array), size.starts)
        yield _mocap_row(run, "scipy `least_squares`", needs, fits.seconds, *_places(fits), truth)
    nominal, values3, truth3 = _mocap(folder, "nominal", 3)
    assert truth3.moment_Am2 is not None
    matrix = linear_calibration(nominal, values3, truth3.position_m, truth3.moment_Am2)
    for run in RUNS[:2]:
        array, values, truth = _mocap(folder, "run3", run)
        fits = random_starts(array, values, *_box(array), size.starts)
        row = _mocap_row(
            run,
            "scipy `least_squares`, source's constants",
            f"{needs}, constants of run 3",
            fits.seconds,
            *_places(fits),
            truth,
        )
        yield replace(row, case=f"run {run}, calibrated on run 3")
        plain, field = _apply_calibration(nominal, matrix, values)
        fits = random_starts(plain, field, *_box(array), size.starts)
        row = _mocap_row(
            run,
            "numpy `lstsq`, scipy `least_squares`",
            f"{needs}, run 3 with its truth",
            fits.seconds,
            *_places(fits),
            truth,
        )
        yield replace(row, case=f"run {run}, calibrated on run 3")


def _places(fits: Fits) -> tuple[FloatArray, FloatArray]:
    return fits.state[:, :3], fits.covariance[:, :3, :3]


def _apply_calibration(array: SensorArray, matrix: FloatArray, values_T: FloatArray) -> tuple[SensorArray, FloatArray]:
    """Return an array of perfect sensors in the same places, and its readings by a linear calibration."""
    readings = values_T.reshape(len(values_T), -1, 3)
    extended = np.concatenate([readings, np.full((*readings.shape[:2], 1), 1e-4)], axis=2)
    field = np.einsum("sij,nsj->nsi", matrix, extended)
    sensors = tuple(Sensor(s.id, "vector", s.position_m, s.noise_T) for s in array.sensors)
    return SensorArray(sensors, noise_fraction=array.noise_fraction), field.reshape(len(values_T), -1)


def magpylib_mocap(data: Path, size: Size) -> Iterator[Row]:
    """Cylinder of 10 mm diameter and length, from the dipole of the best of five random starts."""
    for run in RUNS:
        array, values, truth = _mocap(data / "magnet-mocap", f"run{run}", run)
        dipoles = random_starts(array, values, *_box(array), min(5, size.starts))
        fits = cylinders(array, values, dipoles, 0.01, 0.01, size.starts)
        needs = "array file, box of the magnet, its size and shape, 5 starts"
        yield _mocap_row(run, "magpylib cylinder in scipy", needs, fits.seconds, *_places(fits), truth)


def filterpy_mocap(data: Path, size: Size) -> Iterator[Row]:
    """Extended Kalman filter from the first fix."""
    for run in RUNS:
        array, values, truth = _mocap(data / "magnet-mocap", f"run{run}", run)
        assert truth.moment_Am2 is not None
        first = random_starts(array, values[:1], *_box(array), size.starts).state[0]
        fits = kalman_track(array, values, first, _step(truth.position_m), _step(truth.moment_Am2))
        needs = "array file, first fix, true rms step of place and moment"
        yield _mocap_row(run, "filterpy EKF", needs, fits.seconds, *_places(fits), truth)


def _step(path: FloatArray) -> float:
    """Return the root mean square of a path's steps, per axis."""
    return float(np.sqrt(np.nanmean(np.square(np.diff(path, axis=0)))))


MOCAP = Part(
    "magnet-mocap", "mm", "beyond 5 mm", our_mocap,
    {"scipy": scipy_mocap, "magpylib": magpylib_mocap, "filterpy": filterpy_mocap},
)  # fmt: skip

# ---- thirty magnetometers under a robot


def _off(places: FloatArray, truth: Truth) -> FloatArray:
    return places[:, :2] - truth.position_m[:, :2]


def _row(
    case: str, tool: str, needs: str, seconds: float, found: Sequence[FloatArray], truth: Truth, rows: slice
) -> Row:
    places, covariance = found
    off, within = _off(places, truth)[rows], covariance[rows, :2, :2]
    return row_of_offsets(case, tool, needs, seconds, off, WRONG_M, within)


def _rows(size: Size) -> slice:
    return slice(0, None, EVERY * size.every)


def our_array(data: Path, size: Size) -> Iterator[Row]:
    """Fixes and tracks with thirty sensors and with four."""
    folder = data / "magnet-array"
    truth, rows = read_truth(folder / "truth.csv"), _rows(size)
    n = len(truth.time_s)
    with TemporaryDirectory() as name:
        noisy = Path(name) / "array.toml"
        text = (folder / "array.toml").read_text(encoding="utf-8")
        noisy.write_text(
            "noise_fraction = 0.03\n" + text.replace("noise_nT = 15000.0", "noise_nT = 2000.0"), encoding="utf-8"
        )
        plain = prepend_lines(Path(name) / "plain", folder / "array.toml", SUBTRACTED)
        four = ("--sensors", ",".join(FOUR))
        above = (*four, f"--region=z>{read_array(folder / 'array.toml').positions[:, 2].max():.4f}")
        known = (*four, "--known-moment-Am2", "0.045", "--known-moment-sigma-Am2", "0.0045")
        for case, tool, array, needs, options in (
            ("30 sensors", "locate", folder / "array.toml", "array file", ()),
            ("30 sensors", "locate", noisy, f"array file with {NOISY}", ()),
            ("30 sensors", "locate", plain, "array file with the background subtracted", ()),
            ("4 sensors", "locate", folder / "array.toml", "array file", four),
            ("4 sensors", "locate", plain, "array file with the background subtracted", four),
            ("4 sensors", "locate", plain, "the same, and that the magnet is above the array", above),
            ("4 sensors", "track", folder / "array.toml", "array file", four),
            ("4 sensors", "locate", noisy, f"array file with {NOISY}, known modulus ± 10 %", known),
        ):
            text, seconds = run_command("magloc", tool, folder / "readings.csv", "--array", array, *options, "--json")
            label = (
                f"`magloc {tool}`"
                + (", noise stated" if array == noisy else "")
                + (", background subtracted" if array == plain else "")
                + (", modulus known" if options == known else "")
                + (", above the array" if options == above else "")
            )
            yield _row(case, label, needs, seconds / n, best_solutions(text), truth, rows)


def _recorded(data: Path, four: bool) -> tuple[SensorArray, FloatArray, Truth]:
    folder = data / "magnet-array"
    array = read_array(folder / "array.toml")
    array = array.subset(FOUR) if four else array
    values = read_readings(folder / "readings.csv", array, sensors=array.ids).values_T
    return array, values, read_truth(folder / "truth.csv")


def scipy_array(data: Path, size: Size) -> Iterator[Row]:
    """Least squares from random starts above the array."""
    for case, four in (("30 sensors", False), ("4 sensors", True)):
        array, values, truth = _recorded(data, four)
        rows = _rows(size)
        low, high = _box(array)
        low = np.array([*low[:2], array.positions[:, 2].max()])
        fits = random_starts(array, values[rows], low, high, size.starts)
        needs = f"array file, box of the magnet (above the array), {size.starts} starts"
        off, covariance = fits.state[:, :2] - truth.position_m[rows, :2], fits.covariance[:, :2, :2]
        yield row_of_offsets(case, "scipy `least_squares`", needs, fits.seconds, off, WRONG_M, covariance)


def filterpy_array(data: Path, size: Size) -> Iterator[Row]:
    """Extended Kalman filter over all rows."""
    for case, four in (("30 sensors", False), ("4 sensors", True)):
        array, values, truth = _recorded(data, four)
        low, high = _box(array)
        low = np.array([*low[:2], array.positions[:, 2].max()])
        first = random_starts(array, values[:1], low, high, size.starts).state[0]
        fits = kalman_track(
            array, values, first, _step(truth.position_m[:, :2]), 0.1 * float(np.linalg.norm(first[3:]))
        )
        needs = "array file, first fix, true rms step of the place"
        yield _row(case, "filterpy EKF", needs, fits.seconds, _places(fits), truth, _rows(size))


ARRAY = Part("magnet-array", "mm", "beyond 5 mm", our_array, {"scipy": scipy_array, "filterpy": filterpy_array})
