"""``magloc columns``: a proposal how to read the log of another program."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import arrays
from arrays.io.errors import InputError
from arrays.io.outputs import refuse_file, refuse_unwritable, write_files
from arrays.io.text import write_text
from magloc.cli.framework import QuietOptions, note
from magloc.cli.options import LogOptions

if TYPE_CHECKING:
    from magloc.logs.channels import Log


def columns(
    log: Path,
    /,
    *,
    instrument: str | None = None,
    out: Path | None = None,
    rest: Path | None = None,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Propose the table [columns] of an array file for the log of another program.

    Lists the columns of the log with their first values, writes in TOML what the log determines, and asks for the rest
    in comments. Check the file, answer the questions, and use it as --array. With --instrument the file is
    the template of that instrument, for the columns of this log.

    Parameters
    ----------
    log : Path
        Text file with a header and rows of numbers, or a binary log: PX4 ULog, ArduPilot DataFlash, a ROS bag, MCAP,
        Parquet, HDF5, TDMS.
    instrument : str
        Instrument that wrote the log, such as magarrow or gsm19. An unknown name lists all.
    out : Path
        Array file to write, instead of printing the proposal.
    rest : Path
        Folder for the noise of a log of an autopilot at rest: allan.csv and allan.png, the Allan deviation of
        magnetometers, gyro and accelerometer, and sensors.toml, tables of a scenario file. The proposal then has the
        noise, flicker and drift that were measured.
    common : QuietOptions
        Common options.
    """
    from arrays.logs.proposal import propose_columns
    from magloc.logs.proposal import propose_log_columns
    from magloc.logs.read import log_reader, read_log

    refuse_unwritable(out, "--out")
    refuse_file(rest, "--rest")
    if instrument is not None:
        text = arrays.array_toml(LogOptions(instrument=instrument).sensors(log))
        if out is None:
            print(text, end="")
        else:
            write_text(text, out)
        return
    is_text = log_reader(log) is None
    if is_text and rest is not None:
        raise InputError(f"--rest: found the text {log}, expected the log of an autopilot.")
    proposal = propose_columns(log) if is_text else propose_log_columns(channels := read_log(log))
    if rest is not None:
        proposal = replace(proposal, noise_lines=_measure_noise(channels, proposal.sensors, rest))
    if out is None:
        print(proposal.toml(), end="")
        return
    write_text(proposal.toml(), out)
    for question in proposal.asked:
        note(f"asked: {question}")


def _measure_noise(log: Log, sensors: Mapping[str, str | tuple[str, ...]], folder: Path) -> dict[str, list[str]]:
    """Write the noise of a log at rest, and return that of the proposed sensors as lines of an array file."""
    import numpy as np

    from magloc.logs.rest_noise import array_lines, log_rest_noise, scenario_text
    from magloc.plots.rest_noise import allan_figure

    noises = log_rest_noise(log)
    columns = {
        "sensor": [noise.name for noise in noises for _ in noise.tau_s],
        "tau_s": np.concatenate([noise.tau_s for noise in noises]),
        **{
            f"deviation_{axis}": np.concatenate([noise.deviation[:, i] for noise in noises])
            for i, axis in enumerate("xyz")
        },
        "unit": [noise.unit for noise in noises for _ in noise.tau_s],
    }
    picture = allan_figure(noises, Path(log.path).stem)
    write_files(
        folder, [("allan.csv", columns), ("allan.png", picture), ("sensors.toml", scenario_text(noises))], "--rest"
    )
    by_name = {noise.name: noise for noise in noises if noise.unit == "T"}
    return {key: array_lines(by_name[names[0]]) for key, names in sensors.items() if names[0] in by_name}
