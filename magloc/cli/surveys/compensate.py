"""``magloc compensate``: readings without the field of the platform that carries the sensors."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

import magloc
from arrays.io.errors import naming, naming_options
from arrays.io.outputs import refuse_one_for_two, refuse_unwritable
from arrays.typing import Vector
from magloc.cli.framework import CommonOptions, Flag, print_report, warn
from magloc.cli.options import KnownOptions, LogOptions, in_ambient_field, refuse_not_positive

if TYPE_CHECKING:
    from arrays.array import SensorArray


@Parameter(name="*", group="Platform")
@dataclass(frozen=True)
class PlatformOptions:
    """Currents of the platform, and the Earth's field for an attitude from the pose.

    Parameters
    ----------
    currents : str
        Columns of the log with currents of loads, in any unit, separated by commas.
    current_sigma_nT : float
        Prior standard deviation of the field per unit of a current [nT].
    place : tuple of 3 floats
        Latitude, longitude [deg] and height [m] of the origin of the world frame. With --date it gives the ambient
        field, which arrays without a vector sensor need.
    date : str
        Date of the readings, such as 2026-11-21; needs --place.
    """

    currents: str | None = None
    current_sigma_nT: Annotated[float, Parameter(name="--current-sigma-nT")] = 1000.0
    place: Vector | None = None
    date: str | None = None

    @property
    def names(self) -> list[str]:
        """Columns of currents."""
        return [] if self.currents is None else [name.strip() for name in self.currents.split(",")]


def compensate(
    log: Path,
    /,
    *,
    sensors: LogOptions = LogOptions(),  # noqa: B008 - frozen
    calibration: Path | None = None,
    platform: PlatformOptions = PlatformOptions(),
    out: Path | None = None,
    json: Flag = False,
    common: CommonOptions = CommonOptions(),  # noqa: B008 - frozen
) -> None:
    """Remove the field of the aircraft, drone or vehicle that carries the sensors.

    Estimates its permanent field, its induced field, its eddy currents (Tolles and Lawson) and the fields of measured
    currents, at every sensor. Fly four headings with pitch, roll and yaw on each, high above the ground. A vector
    sensor, or the pose, gives the attitude. The table shows each coefficient with its standard deviation; "not
    determined" = the flight does not show the term, and σ is the prior's. The figure of merit is the sum of the
    amplitudes, peak to peak, of up to twelve manoeuvres.

    Parameters
    ----------
    log : Path
        Readings file or log (CSV) to correct.
    sensors : LogOptions
        Sensors and columns of the log: --array or --instrument.
    calibration : Path
        Readings file or log (CSV) of a calibration flight. By default the log itself.
    platform : PlatformOptions
        Currents of the platform, and the Earth's field for an attitude from the pose.
    out : Path
        CSV file to write: the log, with a column ID_compensated_nT for each channel and ID_compensation_sigma_nT for
        each sensor.
    json : bool
        Print one JSON object instead of the table.
    common : CommonOptions
        Common options.
    """
    from magloc.compensation.files import LogFile

    refuse_one_for_two({"LOG": log, "--out": out})
    refuse_one_for_two({"--calibration": calibration, "--out": out})
    refuse_unwritable(out, "--out")
    refuse_not_positive(platform, "current_sigma_nT")
    used, paths = sensors.sensors(log), [log] if calibration is None else [log, calibration]
    known = KnownOptions(place=platform.place, date=platform.date)
    used, known = known.on_earth(known.select(used, sensors.name), log)
    with naming_options("currents"):
        files = [LogFile.read(path, used, platform.names) for path in paths]
    readings = [_with_ambient(used, file.readings, known) for file in files]
    currents = [dict(file.currents) for file in files]
    with naming(", ".join(map(str, paths)), array=sensors.name):
        found = magloc.compensate(
            used,
            readings[0],
            calibration=None if calibration is None else readings[1],
            currents=currents[0],
            calibration_currents=None if calibration is None else currents[1],
            current_sigma_T=1e-9 * platform.current_sigma_nT,
        )
    if out is not None:
        files[0].write(out, found.columns())
    warn(found.flags)
    if json:
        print_report(found.report())
    else:
        print(found.table())


def _with_ambient(array: SensorArray, readings: magloc.Readings, known: KnownOptions) -> magloc.Readings:
    """Return readings with the ambient field of every row, if they need it for their attitude."""
    if not array.channel_is_scalar.all():
        return readings
    return in_ambient_field(array, readings, known.where)[1]
