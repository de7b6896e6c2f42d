"""Telemetry of attitude sensors: CSV files with units in the names of the columns.

``time_s`` is the time since ``start`` of the scenario file; it ascends in any steps. Rows may be missing, and an empty
cell is a missing reading. All other columns are optional, but all columns of a sensor come together:

=========================================  ============================================================================
columns                                    meaning
=========================================  ============================================================================
``star_qw, star_qx, star_qy, star_qz``     attitude of the star tracker: rotation of components from body axes to the
                                           inertial frame (J2000), scalar first
``gyro_x_deg_s``, y, z                     rate against inertial space, body axes
``field_x_nT``, y, z                       magnetometer, body axes
``sun_x, sun_y, sun_z``                    direction to the Sun, body axes, any length
``wheels_x_Nms``, y, z                     total momentum of the wheels, body axes; zero without the columns
``torquers_x_Am2``, y, z                   commanded magnetic moment, body axes, held until the next; zero without them
=========================================  ============================================================================

``adcs run SCENARIO --out DIR`` writes an example.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike

import numpy as np

from adcs.io.log_layout import STANDARD, LogLayout
from adcs.satellite.telemetry import MOST_INSTANTS, Telemetry, steps_within, usual_step_s
from arrays.io.csv import Table, read_table, table_of_text
from arrays.io.errors import InputError, naming
from arrays.io.text import read_text
from arrays.io.toml import check_keys
from arrays.typing import FloatArray

TIME = "time_s"
_UNUSED = np.datetime64(0, "us")
STAR, GYRO, FIELD, SUN, WHEELS, TORQUERS = GROUPS = tuple(one.columns for one in STANDARD.values())


def read_telemetry(
    path: str | PathLike[str], step_s: float | None = None, *, layout: LogLayout | None = None
) -> Telemetry:
    """Read a log of attitude sensors.

    Parameters
    ----------
    path : str or path-like
        Log (CSV); see the file formats.
    step_s : float, optional
        Usual time between readings, such as that of the scenario file; by default the shortest between two rows.
    layout : LogLayout, optional
        Columns, units and conventions of the log: ``log`` of :func:`adcs.read_scenario`; by default the standard ones.

    Returns
    -------
    Telemetry
        Readings in SI and body axes, NaN where missing.

    Raises
    ------
    InputError
        The file cannot be read, a column is unknown or missing, or the times do not ascend.

    Examples
    --------
    >>> import adcs
    >>> log = adcs.datasets.load("satellite")
    >>> adcs.read_telemetry(log.path).star.shape
    (201, 4)
    """
    expected = f"a header with {TIME if layout is None else layout.time} and columns of sensors"
    if layout is None:
        table = read_table(path, expected)
        known = [TIME, *(name for group in GROUPS for name in group)]
        check_keys(f"{path}, line {table.header_line}", dict.fromkeys(table.header), known, "column")
        layout = LogLayout(_UNUSED, TIME, "seconds", {k: v for k, v in STANDARD.items() if table.has_group(v.columns)})
    else:
        table = named_table(read_text(path, "a CSV file"), str(path), expected, layout)
    time_s, columns = columns_of(table, layout)
    _refuse_many(table, layout.time, time_s, step_s)
    with naming(str(path)):
        return Telemetry(time_s, **columns, step_s=step_s)


def named_table(text: str, name: str, expected: str, layout: LogLayout, more: Sequence[str] = ()) -> Table:
    """Return the columns that a layout names, and ``more`` ones, of a CSV file's text; `name` is for errors."""
    names = [layout.time, *(column for one in layout.columns.values() for column in one.columns), *more]
    instant = [layout.time] if layout.time_format == "utc" else []
    table = table_of_text(text, name, expected, only=names, instant=instant)
    for column in names:
        table.require(column, names)
    return table


def columns_of(table: Table, layout: LogLayout) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Return ascending times (n,), and readings by the layout's names, in SI and body axes, NaN where missing."""
    table.require(layout.time, [layout.time])
    time_s = layout.seconds(table.complete([layout.time])[:, 0])
    table.refuse_late(layout.time, time_s)
    table.refuse_back(layout.time, np.diff(time_s) <= 0.0, "times that ascend", "{:.15g} s")
    columns = {}
    for name, group in layout.columns.items():
        values = table.finite_or_missing(group.columns)
        if name in ("star", "sun"):
            none = (values == 0.0).all(axis=1)[:, None]
            table.refuse(none, group.columns[:1], "found a reading of length 0, expected one with a direction")
        columns[name] = group.of(values)
    return time_s, columns


def _refuse_many(table: Table, column: str, time_s: FloatArray, step_s: float | None) -> None:
    """Raise InputError if there are more instants than a filter can hold."""
    steps = steps_within(time_s, step_s or usual_step_s(time_s))
    if steps >= MOST_INSTANTS:
        raise InputError(
            f"{table.place(-1, column)}: found {steps:.6g} steps after the first row, "
            f"expected fewer than {MOST_INSTANTS}."
        )


def telemetry_columns(telemetry: Telemetry) -> dict[str, FloatArray]:
    """Return the columns (n,) of a log's file; a sensor without any reading has none."""
    groups = (
        (STAR, np.roll(telemetry.star, 1, axis=1)),
        (GYRO, np.degrees(telemetry.gyro_rad_s)),
        (FIELD, 1e9 * telemetry.field_T),
        (SUN, telemetry.sun),
        (WHEELS, telemetry.wheels_Nms),
        (TORQUERS, telemetry.torquers_Am2),
    )
    columns = {TIME: telemetry.time_s}
    for names, values in groups:
        if not np.isnan(values).all():
            columns |= dict(zip(names, values.T, strict=True))
    return columns
