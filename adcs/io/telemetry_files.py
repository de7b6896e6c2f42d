"""Telemetry of attitude sensors: CSV files with units in the names of their columns.

``time_s`` counts from ``start`` of the scenario file that goes with it, and ascends in whole multiples of its
``step_s``; rows may be missing, and an empty cell is a missing reading. All other columns are optional, but those of a
sensor come together:

=========================================  ============================================================================
columns                                    meaning
=========================================  ============================================================================
``star_qw, star_qx, star_qy, star_qz``     attitude by the star tracker: the rotation that takes components of a vector
                                           from body axes to the inertial frame (J2000), scalar part first
``gyro_x_deg_s``, y, z                     rate against inertial space, body axes
``field_x_nT``, y, z                       magnetometer, body axes
``sun_x, sun_y, sun_z``                    direction to the Sun, body axes; of any length
``wheels_x_Nms``, y, z                     momentum of all wheels together, body axes; without them there are none
=========================================  ============================================================================

``adcs run SCENARIO --out DIR`` writes an example.
"""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from adcs import quaternion
from adcs.environment.environment import Environment, environment
from adcs.io.scenario_files import AttitudeFile
from adcs.satellite.telemetry import PartReadings, Record, part
from arrays.io.csv import Table, read_table
from arrays.io.errors import InputError, naming
from arrays.io.toml import check_keys
from arrays.typing import FloatArray

TIME = "time_s"
STAR = ("star_qw", "star_qx", "star_qy", "star_qz")
GYRO = ("gyro_x_deg_s", "gyro_y_deg_s", "gyro_z_deg_s")
FIELD = ("field_x_nT", "field_y_nT", "field_z_nT")
SUN = ("sun_x", "sun_y", "sun_z")
WHEELS = ("wheels_x_Nms", "wheels_y_Nms", "wheels_z_Nms")
GROUPS = (STAR, GYRO, FIELD, SUN, WHEELS)
_STEP_TOLERANCE = 1e-3
_MOST_INSTANTS = 500_000


@dataclass(frozen=True, eq=False)
class TelemetryRecord:
    """A log as a :class:`adcs.satellite.telemetry.Record` of one run.

    Attributes
    ----------
    scenario : AttitudeFile
        The satellite and its sensors.
    environment : Environment
        Leading axis one run.
    readings : PartReadings
    momentum_Nms, wheel_torque_Nm : ndarray, shape (1, n, 3)
    rows : ndarray of int
        Instants that the log has; the others lie in its gaps.
    time_s : ndarray, shape (n,)
        As in the log.
    sensors : tuple of str
        Those that have a reading at all, as :data:`adcs.kalman.error_state.SENSORS` names them.
    """

    scenario: AttitudeFile
    environment: Environment
    readings: PartReadings
    momentum_Nms: FloatArray
    wheel_torque_Nm: FloatArray
    rows: NDArray[np.int64]
    time_s: FloatArray
    sensors: tuple[str, ...]

    def since(self, row: int) -> TelemetryRecord:
        """The log from an instant on."""
        if row == 0:
            return self
        later = part(self, np.array([0]), slice(row, None))
        rows = self.rows[self.rows >= row] - row
        return TelemetryRecord(
            scenario=self.scenario,
            environment=later.environment,
            readings=later.readings,
            momentum_Nms=later.momentum_Nms,
            wheel_torque_Nm=later.wheel_torque_Nm,
            rows=rows,
            time_s=self.time_s[row:],
            sensors=self.sensors,
        )


def read_telemetry(path: str | PathLike[str], scenario: AttitudeFile) -> TelemetryRecord:
    """A log with its surroundings.

    Parameters
    ----------
    path : path-like
    scenario : AttitudeFile
        Satellite, orbit, and the step between readings.

    Returns
    -------
    TelemetryRecord

    Raises
    ------
    InputError
        The file cannot be read, a column is unknown or missing, a time is not a multiple of the step after the first,
        or a date is outside of the model of the field.
    """
    table = read_table(path, f"a header with {TIME} and columns of sensors")
    known = [TIME, *(name for group in GROUPS for name in group)]
    check_keys(f"{path}, line {table.header_line}", dict.fromkeys(table.header), known)
    table.require(TIME, known)
    rows = _instants(table, scenario.step_s)
    n = int(rows[-1]) + 1
    time_s = table.complete([TIME])[0, 0] + scenario.step_s * np.arange(n)

    def spread(group: tuple[str, ...]) -> FloatArray:
        """Columns of a group at all instants, NaN in gaps and where one of them is missing."""
        values = np.full((n, len(group)), np.nan)
        if table.has_group(group):
            values[rows] = table.finite_or_missing(group)
        return np.where(np.isnan(values).any(axis=1, keepdims=True), np.nan, values)

    with naming(str(path)):
        around = environment(
            scenario.orbit,
            np.array([scenario.start_utc + np.timedelta64(round(1e6 * time_s[0]), "us")]),
            time_s - time_s[0],
            model=scenario.field_model,
        )
    momentum = _momentum(spread(WHEELS))
    torque = np.zeros_like(momentum)
    torque[:-1] = np.diff(momentum, axis=0) / scenario.step_s
    star, sun = spread(STAR), spread(SUN)
    for group, values in ((STAR, star), (SUN, sun)):
        none = np.linalg.norm(values[rows], axis=1, keepdims=True) == 0.0
        table.refuse(none, group[:1], "found a reading of length 0, expected one with a direction")
    readings = PartReadings(
        star=quaternion.multiply(orbital_from_eci(around)[0], quaternion.normalised(star))[None],
        gyro_rad_s=np.radians(spread(GYRO))[None],
        field_T=1e-9 * spread(FIELD)[None],
        sun=(sun / np.linalg.norm(sun, axis=1, keepdims=True))[None],
    )
    present = {
        "st": readings.star,
        "gyro": readings.gyro_rad_s,
        "mag": readings.field_T,
        "sun": readings.sun,
    }
    return TelemetryRecord(
        scenario=scenario,
        environment=around,
        readings=readings,
        momentum_Nms=momentum[None],
        wheel_torque_Nm=torque[None],
        rows=rows,
        time_s=time_s,
        sensors=tuple(name for name, values in present.items() if not np.isnan(values[..., 0]).all()),
    )


def _instants(table: Table, step_s: float) -> NDArray[np.int64]:
    """Instant of every row, counted in steps from the first."""
    time_s = table.complete([TIME])
    steps = (time_s[:, 0] - time_s[0, 0]) / step_s
    rows = np.round(steps).astype(np.int64)
    off = np.abs(steps - rows)[:, None] > _STEP_TOLERANCE
    table.refuse(
        off, [TIME], f"found a time that is no multiple of step_s = {step_s:g} s after the first, expected one"
    )
    back = np.diff(rows, prepend=-1)[:, None] <= 0
    table.refuse(back, [TIME], "found a time that is not after the one before, expected times that ascend")
    if rows[-1] >= _MOST_INSTANTS:
        raise InputError(
            f"{table.place(-1, TIME)}: found {rows[-1]} steps after the first row, expected "
            f"fewer than {_MOST_INSTANTS}."
        )
    return rows


def _momentum(values: FloatArray) -> FloatArray:
    """Momentum of the wheels at all instants: straight lines through gaps, zero where there is none at all."""
    known = np.flatnonzero(~np.isnan(values[:, 0]))
    if not known.size:
        return np.zeros_like(values)
    return np.stack([np.interp(np.arange(len(values)), known, column[known]) for column in values.T], axis=1)


def orbital_from_eci(around: Environment) -> FloatArray:
    """Attitude of the inertial frame in the orbital one, shape (runs, n, 4)."""
    from scipy.spatial.transform import Rotation

    matrices = around.R_orbital_from_eci
    rotations = Rotation.from_matrix(matrices.reshape(-1, 3, 3))
    return quaternion.from_rotation(rotations).reshape(*matrices.shape[:-2], 4)


def telemetry_columns(record: Record, scenario: AttitudeFile, run: int = 0) -> dict[str, FloatArray]:
    """Columns of the log that a run would have written; of a sensor without any reading there are none.

    Parameters
    ----------
    record : Record
    scenario : AttitudeFile
        Whose ``start_utc`` the times count from.
    run : int

    Returns
    -------
    dict of str to ndarray, shape (n,)
    """
    around, readings = record.environment, record.readings
    eci_from_orbital = quaternion.conjugate(orbital_from_eci(around)[run])
    groups = (
        (STAR, quaternion.multiply(eci_from_orbital, readings.star[run])),
        (GYRO, np.degrees(readings.gyro_rad_s[run])),
        (FIELD, 1e9 * readings.field_T[run]),
        (SUN, readings.sun[run]),
        (WHEELS, record.momentum_Nms[run]),
    )
    seconds = (around.utc[run] - scenario.start_utc).astype(np.float64) / 1e6
    columns = {TIME: seconds}
    for names, values in groups:
        if not np.isnan(values).all():
            columns |= dict(zip(names, values.T, strict=True))
    return columns
