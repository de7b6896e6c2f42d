"""A magnetometer in the International Space Station, against the geomagnetic model along its track."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from adcs.environment.environment import field_eci
from adcs.frames import R_ecef_from_eci, R_orbital_from_eci
from adcs.satellite.magnetometer_calibration import MagnetometerPrior, calibrate_readings
from arrays.typing import FloatArray
from magloc.fields import geomagnetic
from tests.proof import Part, Row, Size, row_of_errors

PRIOR = MagnetometerPrior(
    noise_T=0.3e-6, bias_T=20e-6, gain=0.2, axes_rad=math.radians(5.0), field_error_T=0.3e-6, time_shift_s=300.0
)
WRONG_NT = 2000.0
CASE = "first half used, second judged"


def station_track(data: Path) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return times and readings, and times and field along the track, in the orbital frame."""
    with (data / "iss-magnetometer" / "commissioning_2022-01-31.csv").open() as file:
        rows = list(csv.DictReader(file))
    utc = np.array([row["Date/Time"].replace(" ", "T") for row in rows], dtype="datetime64[us]")
    time_s = (utc - utc[0]) / np.timedelta64(1, "s")
    latitude, longitude = (np.array([float(row[key]) for row in rows]) for key in ("Latitude", "Longitude"))
    readings = 1e-6 * np.array([[float(row[key]) for key in ("MagX", "MagY", "MagZ")] for row in rows])
    ecef = geomagnetic.ecef_from_geodetic(latitude, longitude, 420e3)
    eci = (R_ecef_from_eci(utc).mT @ ecef[..., None])[..., 0]
    # Every half minute: positions have three decimals of a degree, which a derivative would not forgive.
    track, at = CubicSpline(time_s[::6], eci[::6]), np.arange(0.0, time_s[-1], 10.0)
    position, velocity = track(at), track(at, 1)
    field = field_eci(position, utc[0] + (1e6 * at).astype("timedelta64[us]"))
    return time_s, readings, at, (R_orbital_from_eci(position, velocity) @ field[..., None])[..., 0]


def _row_of_moduli(
    tool: str, needs: str, took: float, corrected: FloatArray, shift_s: float, data: tuple[FloatArray, ...]
) -> Row:
    """Return the row of the moduli of the second half, whose model is at the shifted times."""
    time_s, _, at, field = data
    model = np.linalg.norm(CubicSpline(at, field)(time_s + shift_s), axis=1)
    residual = np.linalg.norm(corrected, axis=1) - model
    return row_of_errors(CASE, tool, needs, took, 1e9 * residual[_half(time_s, 1)], WRONG_NT)


def _half(time_s: FloatArray, number: int) -> slice:
    """Return the rows of a half that are far enough from the ends for every shift of the track."""
    first, last = np.searchsorted(time_s, [1000.0, time_s[-1] - 1000.0])
    middle = (first + last) // 2
    return slice(first, middle) if number == 0 else slice(middle, last)


def our_station(data: Path, _: Size) -> Iterator[Row]:
    """Bias, gains, axes and shift of the clock, by the modulus alone."""
    record = time_s, readings, at, field = station_track(data)
    rows = _half(time_s, 0)
    began = time.process_time()
    result = calibrate_readings(time_s[rows], readings[rows], at, field, prior=PRIOR, attitude="none")
    took = time.process_time() - began
    needs = "positions, date; priors of bias, gains, clock"
    yield _row_of_moduli(
        "`adcs.calibrate_magnetometer`", needs, took, result.applied(readings), result.time_shift_s, record
    )


def scipy_station(data: Path, _: Size) -> Iterator[Row]:
    """Bias and a symmetric matrix by least squares, with the clock as the file has it and with its shift."""
    record = time_s, readings, at, field = station_track(data)
    rows = _half(time_s, 0)
    model = CubicSpline(at, field)
    upper = np.triu_indices(3)

    def corrected(x: FloatArray, values: FloatArray) -> FloatArray:
        matrix = np.zeros((3, 3))
        matrix[upper] = x[3:9]
        matrix = matrix + np.triu(matrix, 1).T
        return (values - 1e-6 * x[:3]) @ matrix

    def fit(clock: bool, start_s: float) -> tuple[FloatArray, float]:
        def residual(x: FloatArray) -> FloatArray:
            true = np.linalg.norm(model(time_s[rows] + (100.0 * x[9] if clock else 0.0)), axis=1)
            return 1e6 * (np.linalg.norm(corrected(x, readings[rows]), axis=1) - true)

        start = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, *([0.01 * start_s] if clock else [])])
        found = least_squares(residual, start, loss="soft_l1")
        return found.x, float(found.cost)

    began = time.process_time()
    plain = fit(False, 0.0)[0]
    took = time.process_time() - began
    yield _row_of_moduli(
        "scipy, ellipsoid, clock as stated", "positions, date", took, corrected(plain, readings), 0.0, record
    )
    began = time.process_time()
    shifted = min((fit(True, start) for start in (-600.0, -300.0, 0.0, 300.0, 600.0)), key=lambda each: each[1])[0]
    took = time.process_time() - began
    needs = "positions, date, starts of the clock's shift"
    row = _row_of_moduli(
        "scipy, ellipsoid and clock", needs, took, corrected(shifted, readings), 100.0 * shifted[9], record
    )
    yield row


STATION = Part("iss-magnetometer", "nT", "beyond 2 µT", our_station, {"scipy": scipy_station})
