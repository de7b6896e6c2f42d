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

from os import PathLike

import numpy as np

from adcs.satellite.telemetry import MOST_INSTANTS, Telemetry, steps_of
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


def read_telemetry(path: str | PathLike[str], step_s: float | None = None) -> Telemetry:
    """Read a log.

    Parameters
    ----------
    path : str or path-like
        A log (CSV); see the file formats.
    step_s : float, optional
        Time between readings, such as that of the scenario file; by default the shortest between two rows.

    Raises
    ------
    InputError
        The file cannot be read, a column is unknown or missing, or a time is not a multiple of the step after the
        first.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> adcs.read_telemetry(log.path).star.shape
    (201, 4)
    """
    table = read_table(path, f"a header with {TIME} and columns of sensors")
    known = [TIME, *(name for group in GROUPS for name in group)]
    check_keys(f"{path}, line {table.header_line}", dict.fromkeys(table.header), known, "column")
    table.require(TIME, known)
    time_s = table.complete([TIME])[:, 0]
    if step_s is not None:
        _refuse_times(table, time_s, step_s)
    columns = {group: table.finite_or_missing(group) for group in GROUPS if table.has_group(group)}
    for group in (STAR, SUN):
        if group in columns:
            none = (columns[group] == 0.0).all(axis=1)[:, None]
            table.refuse(none, group[:1], "found a reading of length 0, expected one with a direction")
    star, gyro_deg_s, field_nT = columns.get(STAR), columns.get(GYRO), columns.get(FIELD)
    with naming(str(path)):
        return Telemetry(
            time_s,
            star=None if star is None else np.roll(star, -1, axis=1),
            gyro_rad_s=None if gyro_deg_s is None else np.radians(gyro_deg_s),
            field_T=None if field_nT is None else 1e-9 * field_nT,
            sun=columns.get(SUN),
            wheels_Nms=columns.get(WHEELS),
            step_s=step_s,
        )


def _refuse_times(table: Table, time_s: FloatArray, step_s: float) -> None:
    """Refuse times that are no instants, with their place."""
    rows, off, back = steps_of(time_s, step_s)
    table.refuse(
        off[:, None], [TIME], f"found a time that is no multiple of step_s = {step_s:g} s after the first, expected one"
    )
    table.refuse(back[:, None], [TIME], "found a time that is not after the one before, expected times that ascend")
    if rows[-1] >= MOST_INSTANTS:
        raise InputError(
            f"{table.place(-1, TIME)}: found {rows[-1]} steps after the first row, expected fewer than {MOST_INSTANTS}."
        )


def telemetry_columns(telemetry: Telemetry) -> dict[str, FloatArray]:
    """Columns (n,) of a log's file; there are none of a sensor without any reading."""
    groups = (
        (STAR, np.roll(telemetry.star, 1, axis=1)),
        (GYRO, np.degrees(telemetry.gyro_rad_s)),
        (FIELD, 1e9 * telemetry.field_T),
        (SUN, telemetry.sun),
        (WHEELS, telemetry.wheels_Nms),
    )
    columns = {TIME: telemetry.time_s}
    for names, values in groups:
        if not np.isnan(values).all():
            columns |= dict(zip(names, values.T, strict=True))
    return columns
