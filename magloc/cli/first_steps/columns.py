"""``magloc columns``: a proposal how to read the log of another program."""

from __future__ import annotations

from pathlib import Path

import arrays
from arrays.io.outputs import refuse_unwritable
from arrays.io.text import write_text
from magloc.cli.framework import QuietOptions, note
from magloc.cli.options import LogOptions


def columns(
    log: Path,
    /,
    *,
    instrument: str | None = None,
    out: Path | None = None,
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
        Array file to write, in place of printing the proposal.
    common : QuietOptions
        Common options.
    """
    from arrays.logs.proposal import propose_columns
    from magloc.logs.proposal import propose_log_columns
    from magloc.logs.read import log_reader, read_log

    refuse_unwritable(out, "--out")
    if instrument is not None:
        text = arrays.array_toml(LogOptions(instrument=instrument).sensors(log))
        if out is None:
            print(text, end="")
        else:
            write_text(text, out)
        return
    proposal = propose_columns(log) if log_reader(log) is None else propose_log_columns(read_log(log))
    if out is None:
        print(proposal.toml(), end="")
        return
    write_text(proposal.toml(), out)
    for question in proposal.asked:
        note(f"asked: {question}")
