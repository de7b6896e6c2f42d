"""Small simulated logs that come with the package, for a first try, for pages and for tests."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, overload

from scipy.spatial.transform import Rotation

from adcs.io.scenario_files import read_scenario
from adcs.io.telemetry_files import read_telemetry
from adcs.satellite.satellite import Satellite
from adcs.satellite.telemetry import Telemetry
from arrays.io.csv import read_table
from arrays.io.toml import BuiltIn
from arrays.typing import FloatArray

_FILES = BuiltIn("adcs", "datasets", "log", "-truth.csv")


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


@dataclass(frozen=True, eq=False)
class ImuDataset:
    """Readings of an inertial unit with a magnetometer, with the truth behind them.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
    gyro_rad_s, acceleration_m_s2, field_T : ndarray, shape (n, 3)
        Body axes; at rest the acceleration is 9.81 m/s² upwards. There is a field of (0, 20, -43) µT.
    truth : Rotation of n
        East, north, up from body.
    path : Path
        Of the file; NAME-truth.csv stands beside it.
    """

    time_s: FloatArray
    gyro_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    field_T: FloatArray
    truth: Rotation
    path: Path


def names() -> tuple[str, ...]:
    """Names of the logs.

    ``satellite``: star tracker, gyro, magnetometer and Sun sensor of a microsatellite; ``imu``: gyro, accelerometer and
    magnetometer that are turned by hand, with a magnet beside them for a while.
    """
    return _FILES.names()


@overload
def load(name: Literal["imu"]) -> ImuDataset: ...
@overload
def load(name: Literal["satellite"]) -> Dataset: ...
@overload
def load(name: str) -> Dataset | ImuDataset: ...
def load(name: str) -> Dataset | ImuDataset:
    """A log by its name.

    Raises
    ------
    InputError
        There is none of that name.
    """
    beside = _FILES.chosen(name)
    path = beside.with_name(f"{name}.csv")
    truth = Rotation.from_quat(read_table(beside, "qx, qy, qz and qw").complete(("qx", "qy", "qz", "qw")))
    if name == "imu":
        table = read_table(path, "time and three times three readings")
        values = table.complete(table.header)
        return ImuDataset(values[:, 0], values[:, 1:4], values[:, 4:7], 1e-9 * values[:, 7:], truth, path)
    satellite = read_scenario(str(path.with_name(f"{name}-scenario.toml"))).satellite
    return Dataset(read_telemetry(path), satellite, truth, path)
