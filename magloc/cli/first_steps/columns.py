"""``magloc columns``: how a log of another program is read."""

from __future__ import annotations

from pathlib import Path

from arrays.io.outputs import refuse_unwritable
from arrays.io.text import write_text
from magloc.cli.framework import QuietOptions, note


def columns(log: Path, /, *, out: Path | None = None, common: QuietOptions = QuietOptions()) -> None:  # noqa: B008 - frozen
    """Propose the table [columns] of an array file for the log of another program.

    It lists the columns of the log with their first values, says in TOML what the log determines, and asks for the
    rest in remarks. Nothing else is read from the log: check it, answer what is asked, and use the file as --array.

    Parameters
    ----------
    log : Path
        Text file with a header and rows of numbers.
    out : Path
        Write the proposal there, as an array file, in place of printing it.
    common : QuietOptions
        Common options.
    """
    from arrays.logs.proposal import propose_columns

    refuse_unwritable(out, "--out")
    proposal = propose_columns(log)
    if out is None:
        print(proposal.toml(), end="")
        return
    write_text(proposal.toml(), out)
    for question in proposal.asked:
        note(f"asked: {question}")
