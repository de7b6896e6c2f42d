"""``adcs view``: attitude through time in three dimensions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import adcs
from adcs.cli.estimate import read_log
from adcs.cli.imu import inertial_attitude
from adcs.io.imu_files import imu_log
from adcs.io.scenario_files import scenario_of, scenario_table
from arrays.io.errors import InputError, naming
from magloc.cli.framework import Flag, QuietOptions, warn
from magloc.cli.options import Port, naming_outputs

if TYPE_CHECKING:
    from adcs.io.scenario_files import AttitudeFile
    from arrays.typing import FloatArray

_OF_A_LAYOUT = {"log", "format_version"}
_QUATERNION = ("qw", "qx", "qy", "qz")


def view(
    log: Path,
    /,
    *,
    config: Path | None = None,
    truth: Path | None = None,
    allow_old_elements: Flag = False,
    html: Path | None = None,
    png: Path | None = None,
    movie: Path | None = None,
    port: Port = 8080,
    open: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Show the attitude of a log in three dimensions.

    The scene has body axes with 3σ cones, and field and Sun as measured and as expected. The command estimates the
    attitude as `adcs estimate` does, or as `adcs imu` for an inertial unit. It starts a server on this machine and
    prints its address; Ctrl-C ends the server. With --html, --png or --movie it writes a file instead.

    Parameters
    ----------
    log : Path
        Telemetry or an attitude message (.aem) as for `adcs estimate`, or a log as for `adcs imu`.
    config : Path, optional
        Scenario file of the satellite; or, for the log of an inertial unit, a file with only the table log.
    truth : Path, optional
        CSV file of the true attitude: time_s, qw, qx, qy, qz (orbital frame from body), as `adcs run --out` writes it.
    allow_old_elements : bool
        Also accept two-line elements 30 days or more from their epoch.
    html : Path
        HTML file to write; it plays the log and needs no server.
    png : Path
        Picture to write (.png); needs Chromium or Chrome.
    movie : Path
        Film to write (.mp4, .gif or .apng); needs Chromium or Chrome.
    port : int
        Port of the server; the next free one if it is in use.
    open : bool
        Open the page in the browser.
    common : QuietOptions
        Common options.
    """
    from magloc.cli.view import write_or_serve
    from magloc.viewer.outputs import check_outputs

    with naming_outputs():
        check_outputs(html, png, movie)
    described = None if config is None else scenario_table(str(config))  # read once, because it may be a pipe
    if described is None or set(described[1]) <= _OF_A_LAYOUT:
        track, *made_of, q_true = _of_inertial_unit(log, described, truth)
    else:
        scenario = scenario_of(*described, allow_old_elements=allow_old_elements)
        track, *made_of, q_true = _of_satellite(log, scenario, truth)
    warn(track.warnings)
    files: dict[str, Any] = {"html": html, "png": png, "movie": movie}
    write_or_serve(
        lambda used: adcs.view(track, *made_of, truth=q_true, open=open, port=used, title=log.stem, **files),
        [str(file) for file in files.values() if file is not None],
        port,
    )


def _of_inertial_unit(log: Path, layout: tuple[str, dict[str, Any]] | None, truth: Path | None) -> tuple[Any, ...]:
    if truth is not None:
        raise InputError(
            f"--truth {truth}: found together with the log of an inertial unit, expected the truth in its columns."
        )
    data = imu_log(log, layout)
    return inertial_attitude(log, data), data, None, data.q_true


def _of_satellite(log: Path, scenario: AttitudeFile, truth: Path | None) -> tuple[Any, ...]:
    telemetry = read_log(log, scenario)
    q_true = None if truth is None else _truth(truth, telemetry.time_s)
    with naming(str(log)):
        track = adcs.estimate(
            telemetry, scenario.satellite, sensors=scenario.estimator(f"{scenario.path}, table estimate")
        )
    return track, telemetry, scenario.satellite, q_true


def _truth(path: Path, time_s: FloatArray) -> FloatArray:
    """Read true attitudes at some instants; NaN where the file has none."""
    import numpy as np

    from adcs.viewer.attitude_replay import rows_at
    from arrays.io.csv import read_table

    columns = ("time_s", *_QUATERNION)
    table = read_table(path, "a header with time_s, qw, qx, qy and qz", only=columns)
    for name in columns:
        table.require(name, columns)
    at = rows_at(time_s, table.times())
    if (at < 0).all():
        raise InputError(f"{path}: found none of the log's times, expected rows with the same time_s.")
    return np.where((at >= 0)[:, None], table.finite_or_missing(_QUATERNION)[at], np.nan)
