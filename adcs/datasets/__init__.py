"""Small simulated logs that come with the package, for a first try, for pages and for tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from scipy.spatial.transform import Rotation

from adcs.io.scenario_files import read_scenario
from adcs.io.telemetry_files import read_telemetry
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Telemetry
from arrays.io.csv import read_table
from arrays.io.errors import InputError

_FOLDER = Path(__file__).parent


@dataclass(frozen=True, eq=False)
class Dataset:
    """A log with the truth behind it.

    Attributes
    ----------
    telemetry : Telemetry
    satellite : Satellite
        As its user knows it.
    truth : Rotation of n
        Inertial (J2000) from body, at the times of the telemetry.
    path : Path
        Of the telemetry file; NAME-scenario.toml and NAME-truth.csv stand beside it.
    """

    telemetry: Telemetry
    satellite: Satellite
    truth: Rotation
    path: Path


def names() -> tuple[str, ...]:
    """Names of the logs; ``satellite``: star tracker, gyro, magnetometer and Sun sensor of a microsatellite."""
    return tuple(sorted(path.name.removesuffix("-scenario.toml") for path in _FOLDER.glob("*-scenario.toml")))


def load(name: str) -> Dataset:
    """A log by its name.

    Raises
    ------
    InputError
        There is none of that name.
    """
    if name not in names():
        raise InputError(f"Input name must be one of {', '.join(names())}; instead received {name!r}.")
    path = _FOLDER / f"{name}.csv"
    satellite = read_scenario(str(path.with_name(f"{name}-scenario.toml"))).satellite
    truth = read_table(path.with_name(f"{name}-truth.csv"), "qx, qy, qz and qw")
    rotation = Rotation.from_quat(truth.complete(("qx", "qy", "qz", "qw")))
    return Dataset(read_telemetry(path), satellite, rotation, path)
