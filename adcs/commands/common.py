"""What all commands share."""

from __future__ import annotations

from magloc import command_line
from magloc.command_line import Count, Flag, QuietOptions, Seed, print_json, progress

__all__ = ["Count", "Flag", "QuietOptions", "Seed", "print_json", "print_note", "progress"]


def print_note(text: str) -> None:
    """Print one line on stderr, whatever the text."""
    command_line.print_note(text, "adcs")
