"""Small simulated logs in the package, for first steps, documentation and tests."""

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
    """Log of a satellite with its true attitude.

    Attributes
    ----------
    telemetry : Telemetry
        Readings of the sensors.
    satellite : Satellite
        Satellite as its user knows it.
    truth : Rotation of n
        True attitude, inertial (J2000) from body, at the times of the telemetry.
    path : Path
        Telemetry file; NAME-scenario.toml and NAME-truth.csv are beside it.
    """

    telemetry: Telemetry
    satellite: Satellite
    truth: Rotation
    path: Path


@dataclass(frozen=True, eq=False)
class ImuDataset:
    """Readings of an inertial unit with a magnetometer, with its true attitude.

    Attributes
    ----------
    time_s : ndarray, shape (n,)
        Times of the readings.
    gyro_rad_s, acceleration_m_s2, field_T : ndarray, shape (n, 3)
        Readings in body axes; at rest the acceleration is 9.81 m/s² upwards. The field is (0, 20, -43) µT, east, north,
        up.
    truth : Rotation of n
        True attitude, east, north, up from body.
    path : Path
        File of the readings; NAME-truth.csv is beside it.
    """

    time_s: FloatArray
    gyro_rad_s: FloatArray
    acceleration_m_s2: FloatArray
    field_T: FloatArray
    truth: Rotation
    path: Path


def names() -> tuple[str, ...]:
    """Return the names of the logs.

    ``satellite`` has star tracker, gyro, magnetometer and Sun sensor of a microsatellite. ``imu`` has gyro,
    accelerometer and magnetometer, turned by hand, at times near a magnet.

    Returns
    -------
    tuple of str
        Names for :func:`load`.

    Examples
    --------
    >>> import adcs
    >>> adcs.datasets.names()
    ('imu', 'satellite')
    """
    return _FILES.names()


@overload
def load(name: Literal["imu"]) -> ImuDataset: ...
@overload
def load(name: Literal["satellite"]) -> Dataset: ...
@overload
def load(name: str) -> Dataset | ImuDataset: ...
def load(name: str) -> Dataset | ImuDataset:
    """Load a log by its name.

    Parameters
    ----------
    name : str
        One of :func:`names`.

    Returns
    -------
    Dataset or ImuDataset
        Readings and truth.

    Raises
    ------
    InputError
        No log has that name.

    Examples
    --------
    >>> import adcs
    >>> adcs.datasets.load("imu").field_T.shape
    (1500, 3)
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
