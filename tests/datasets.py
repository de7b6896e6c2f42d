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


if __name__ == "__main__":
    for recording in RATES_HZ:
        write_magnetic(recording, MAGLOC)
    write_satellite(ADCS)
