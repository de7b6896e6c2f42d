"""What all commands share."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from magloc import command_line
from magloc.command_line import Count, Flag, QuietOptions, Seed, print_json, progress

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["Count", "Flag", "QuietOptions", "Seed", "print_json", "print_note", "progress", "write_table"]


def write_table(path: Path, columns: tuple[str, ...], table: NDArray[np.float64]) -> None:
    """Write a table (n, k) of numbers as CSV, to nine digits."""
    from arrays.toml import write_text

    lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in table.tolist()), ""]
    write_text("\n".join(lines), path)


def print_note(text: str) -> None:
    """Print one line on stderr, whatever the text."""
    command_line.print_note(text, "adcs")
