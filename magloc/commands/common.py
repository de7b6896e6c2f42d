"""What all commands share."""

from __future__ import annotations

from magloc import command_line
from magloc.command_line import CommonOptions, Count, Flag, Seed, print_json, progress, whole_number

__all__ = [
    "CommonOptions",
    "Count",
    "Flag",
    "Seed",
    "Vector",
    "print_json",
    "print_note",
    "progress",
    "whole_number",
]

Vector = tuple[float, float, float]


def print_note(text: str) -> None:
    """Print one line on stderr, whatever the text."""
    command_line.print_note(text, "magloc")
