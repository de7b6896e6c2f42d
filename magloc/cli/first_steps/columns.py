"""``magloc columns``: a proposal how to read the log of another program."""

from __future__ import annotations

from pathlib import Path

from arrays.io.outputs import refuse_unwritable
from arrays.io.text import write_text
from magloc.cli.framework import QuietOptions, note


def columns(log: Path, /, *, out: Path | None = None, common: QuietOptions = QuietOptions()) -> None:  # noqa: B008 - frozen
    """Propose the table [columns] of an array file for the log of another program.

    Lists the columns of the log with their first values, writes in TOML what the log determines, and asks for the rest
    in comments. Check the file, answer the questions, and use it as --array.

    Parameters
    ----------
    log : Path
        Text file with a header and rows of numbers.
    out : Path
        Array file to write, in place of printing the proposal.
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
