"""The recordings that come with the packages, made by a simulation: ``python -m tests.datasets`` writes them anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

import adcs
import sims
from adcs import quaternion
from adcs.io.scenario_files import scenario_text
from adcs.io.telemetry_files import telemetry_columns
from adcs.satellite.telemetry import Telemetry, orbital_from_eci
from arrays.io.csv import write_columns
from arrays.io.text import write_text
from arrays.typing import FloatArray
from sims.attitude.files import simulation_of
from tests.conftest import REPOSITORY

RATES_HZ: Mapping[str, tuple[str, float]] = {
    "board": ("hand-magnet", 5.0),
    "diver": ("diver", 5.0),
    "drone": ("drone", 5.0),
    "ship": ("ship", 2.0),
}
"""Scenario and rate of each recording of an array; all are of seed 0."""
MAGLOC, ADCS = REPOSITORY / "magloc" / "datasets", REPOSITORY / "adcs" / "datasets"


def write_magnetic(name: str, folder: Path) -> None:
    """Write readings, truth and array of a recording."""
    scenario, rate_Hz = RATES_HZ[name]
    described = sims.read_scenario(scenario)
    assert isinstance(described, sims.MagneticScenario)
    sims.write_simulation(sims.simulate(replace(described, rate_Hz=rate_Hz), 0), folder / f"{name}.csv")


def write_satellite(folder: Path) -> None:
    """Write telemetry, truth and scenario of 200 s of the built-in satellite."""
    file = replace(adcs.read_scenario("tabletsat"), name="satellite", duration_s=200.0)
    runs = sims.simulate(simulation_of(file), 0)
    log = Telemetry.of(runs, file.satellite.start)
    q = quaternion.multiply(quaternion.conjugate(orbital_from_eci(runs.environment)[0]), runs.q[0])
    write_columns(
        {name: np.round(values, 9) for name, values in telemetry_columns(log).items()}, folder / "satellite.csv"
    )
    truth = {"time_s": log.time_s, "qw": q[:, 0], "qx": q[:, 1], "qy": q[:, 2], "qz": q[:, 3]}
    write_columns({name: np.round(values, 12) for name, values in truth.items()}, folder / "satellite-truth.csv")
    write_text(scenario_text(file), folder / "satellite-scenario.toml")


def write_imu(folder: Path) -> None:
    """Write readings and truth of a minute of an inertial unit: at rest, turned by hand, with a magnet for 15 s.

    Zeros of the gyro of some tenths of a degree a second, a hand's accelerations of 1 m/s², and 0.3 µT of noise.
    """
    rng, step_s = np.random.default_rng(0), 0.04
    time_s = step_s * np.arange(1500)
    before, q, after = (_hand(time_s + shift * step_s) for shift in (-0.5, 0.0, 0.5))
    moving = (time_s >= 8.0)[:, None]
    phases, up = np.array([0.3, 1.1, 2.2]), np.array([0.0, 0.0, 9.81])
    gyro = quaternion.log(quaternion.multiply(quaternion.conjugate(before), after)) / step_s
    gyro = gyro + [0.006, -0.004, 0.003] + 2e-3 * rng.standard_normal((1500, 3))
    shaken = np.where(moving, np.sin(np.outer(time_s, [6.1, 7.9, 7.1]) + phases), 0.0)
    acceleration = quaternion.rotate_back(q, shaken + up) + 0.03 * rng.standard_normal((1500, 3))
    magnet = np.where(((time_s >= 30.0) & (time_s < 45.0))[:, None], [7e3, -5e3, 9e3], 0.0)
    field = quaternion.rotate_back(q, [0.0, 20e3, -43e3]) + magnet + 300.0 * rng.standard_normal((1500, 3))
    columns = {"time_s": np.round(time_s, 9)}
    for name, unit, values, digits in (
        ("gyro", "rad_s", gyro, 5),
        ("acceleration", "m_s2", acceleration, 3),
        ("field", "nT", field, 0),
    ):
        columns |= {f"{name}_{axis}_{unit}": np.round(values[:, i], digits) for i, axis in enumerate("xyz")}
    write_columns(columns, folder / "imu.csv")
    truth = {"time_s": np.round(time_s, 9)} | {f"q{axis}": np.round(q[:, i], 7) for i, axis in enumerate("wxyz")}
    write_columns(truth, folder / "imu-truth.csv")


def _hand(time_s: FloatArray) -> FloatArray:
    """Attitude that a hand gives from 8 s on, without a jolt: east, north, up from body."""
    moved = np.maximum(time_s - 8.0, 0.0)
    grown = 1.0 - np.exp(-0.25 * moved**2)
    roll, pitch, yaw = (grown * size * np.sin(rate * moved) for size, rate in ((0.9, 1.1), (0.7, 0.8), (1.5, 0.47)))
    axes = np.eye(3)
    turns = [quaternion.exp(angle[:, None] * axes[axis]) for axis, angle in ((2, yaw + 0.4), (1, pitch), (0, roll))]
    return quaternion.multiply(quaternion.multiply(turns[0], turns[1]), turns[2])


if __name__ == "__main__":
    for recording in RATES_HZ:
        write_magnetic(recording, MAGLOC)
    write_satellite(ADCS)
    write_imu(ADCS)
