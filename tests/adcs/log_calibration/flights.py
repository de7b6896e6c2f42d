"""Flights for tests of the calibration from logs: fits, and their files."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np

import adcs
from adcs.log_calibration.calibrate import MODEL_ERROR_T
from arrays.io.csv import write_columns
from sims.attitude.flights import Flight, FlightSettings, simulate_flight

FIELD_T = np.array(FlightSettings().field_T)


@cache
def calibrated(seed: int, settings: FlightSettings) -> tuple[Flight, adcs.LogCalibration]:
    """Return a flight and its calibration by a model of the field that is wrong as stated."""
    flight = simulate_flight(seed, settings)
    model_T = FIELD_T + np.random.default_rng(seed + 10**6).normal(0.0, MODEL_ERROR_T, 3)
    return flight, adcs.calibrate_log(flight.log, field_T=model_T)


def parameter_errors(flight: Flight, found: adcs.LogCalibration) -> tuple[np.ndarray, np.ndarray]:
    """Return errors and covariance of the parameters of the first magnetometer, gyro and accelerometer (µT, s)."""
    layout = found.fit.estimate.problem.layout
    begin = layout.matrix(0).start
    which = np.r_[3:6, 12:15, begin : begin + layout.per_sensor]
    truth = np.concatenate(
        [
            flight.gyro_bias_rad_s,
            flight.force_offset_m_s2,
            flight.scale[0].ravel(),
            1e6 * flight.offset_T[0],
            flight.lag_s[:1],
            1e6 * flight.current_T_A[0],
        ]
    )
    return found.fit.estimate.parameters[which] - truth, found.fit.solution.covariance[np.ix_(which, which)]


def write_flight(flight: Flight, path: Path) -> None:
    """Write a flight as a CSV file; readings between the inertial times take the next row."""
    log = flight.log
    columns = {"time_s": log.time_s}
    for i, axis in enumerate("xyz"):
        columns[f"gyro_{axis}_rad_s"] = log.gyro_rad_s[:, i]
        columns[f"acceleration_{axis}_m_s2"] = log.acceleration_m_s2[:, i]
    for m, series in enumerate(log.magnetometers):
        name = "field" if m == 0 else series.name
        for i, axis in enumerate("xyz"):
            column = np.full(len(log.time_s), np.nan)
            rows = np.searchsorted(log.time_s, series.time_s)
            column[rows[rows < len(column)]] = 1e9 * series.values[rows < len(column), i]
            columns[f"{name}_{axis}_nT"] = column
    columns |= {one.name: one.values for one in log.currents}
    write_columns(columns, path)
