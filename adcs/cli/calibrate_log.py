"""``adcs calibrate-log``: calibration of magnetometers, gyro and accelerometer from a flight or drive."""

from __future__ import annotations

import time
from pathlib import Path

import adcs
from arrays.io.errors import InputError, naming, naming_options
from arrays.io.outputs import refuse_one_for_two, refuse_unwritable
from arrays.typing import FloatArray, Vector
from magloc.cli.framework import Flag, QuietOptions, note, print_report, warn


def calibrate_log(
    log: Path,
    /,
    *,
    config: Path | None = None,
    place: Vector | None = None,
    date: str | None = None,
    currents: str | None = None,
    out: Path,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Calibrate the compass of a drone or robot from an ordinary flight or drive.

    Estimates hard iron, soft iron, axes and lag of every magnetometer, the field of currents, the gyro's bias and the
    accelerometer's offsets, jointly, each with its standard deviation. Terms that the log does not determine are listed
    with a manoeuvre that would determine them, and are not written. Two to ten minutes with turns on all headings and
    with changes of throttle determine most terms.

    Parameters
    ----------
    log : Path
        CSV file as for `adcs imu`, with more magnetometers in columns such as mast_x_nT and currents in columns such as
        battery_A or throttle; or the log of an autopilot or robot (PX4 .ulg, ArduPilot .BIN, ROS bags).
    config : Path, optional
        TOML file whose table log states other names of columns, units and mountings of a CSV file.
    place : tuple of 3 floats, optional
        Latitude, longitude [deg] and height [m]; by default those of the log's receiver. Without a place the scale is
        not determined.
    date : str, optional
        Date of the log, such as 2026-11-21; by default that of the log's receiver.
    currents : str, optional
        Columns or channels with currents or throttles, separated by commas; by default those that are found.
    out : Path
        File to write: array file of one magnetometer (.toml), or parameters of PX4 (.params) or ArduPilot (.param,
        .parm).
    json : bool
        Print one JSON object, instead of the table.
    common : QuietOptions
        Common options.
    """
    from adcs.log_calibration.autopilot_files import axes_warning, refuse_unplaced, writer_of

    refuse_one_for_two({"LOG": log, "--out": out})
    refuse_unwritable(out, "--out")
    write = writer_of(out)
    names = [] if currents is None else [name.strip() for name in currents.split(",") if name.strip()]
    file = adcs.read_vehicle(log, config, names)
    refuse_unplaced(out, file.log)
    field_T = _field(place or file.place, date or file.date, stated=place is not None)
    began = time.perf_counter()
    with naming(str(log)):
        found = adcs.calibrate_log(file.log, field_T=field_T)
    seconds = time.perf_counter() - began
    if not found.fit.converged:
        expected = "readings of one motion in the field of one place: check place, units, axes and clocks"
        raise InputError(f"{log}: found a fit that does not converge, expected {expected}. No file is written.")
    write(found, out)
    note(f"wrote {out}")
    axes = "" if out.suffix.lower() == ".toml" else axes_warning(found)
    flags = (*file.warnings, *found.flags, *([axes] if axes else []))
    warn(flags)
    if json:
        print_report({**found.report(), "flags": list(flags), "seconds": seconds})
    else:
        print(found.table())


def _field(place: Vector | None, date: str | None, *, stated: bool) -> FloatArray | None:
    """Return the field of the geomagnetic model [T]: east, north, up."""
    if place is None or date is None:
        if stated:
            raise InputError("--place: found no date of the log, expected --date with it.")
        return None
    from magloc.ambient import Place, field_at

    with naming_options("place", "date"):
        return field_at(Place(*place, date, "IGRF-14"))
