"""Decisions about a survey, and the log of them: JSON lines that replay to the same result."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec

from arrays.io.errors import InputError
from arrays.io.text import read_text

_EXAMPLE = '{"action": "drop", "target": "t3"}'
_FEWEST_CORNERS = 3


class _Decision(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True, forbid_unknown_fields=True):
    """Decision about a survey.

    Attributes
    ----------
    when : str
        Time of the decision, ISO 8601 in UTC.
    numbers : dict
        Numbers on which the decision was taken, such as the place of the target.
    """

    when: str = ""
    numbers: dict[str, Any] = {}

    def __post_init__(self) -> None:
        place_m = self.numbers.get("position_m", [0.0, 0.0, 0.0])
        if not (isinstance(place_m, list) and all(isinstance(x, int | float) for x in place_m)):
            raise ValueError(f"Input position_m must have 3 finite numbers; instead received {place_m}")
        _check_places([place_m], (3,))


class Drop(_Decision, frozen=True, tag_field="action", tag="drop"):
    """Drop a target."""

    target: str


class Split(_Decision, frozen=True, tag_field="action", tag="split"):
    """Split a target in two, at two places (x, y) or (x, y, z) in the world frame, or at the likeliest ones."""

    target: str
    places_m: list[list[float]] = []

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.places_m) not in (0, 2):
            raise ValueError(f"Input places_m must have two places or none; instead received {len(self.places_m)}")
        _check_places(self.places_m, (2, 3))


class Add(_Decision, frozen=True, tag_field="action", tag="add"):
    """Add a target at a place (x, y) or (x, y, z) in the world frame; without z at the likeliest depth."""

    place_m: list[float]

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_places([self.place_m], (2, 3))


class Exclude(_Decision, frozen=True, tag_field="action", tag="exclude"):
    """Exclude the rows in a polygon of corners (x, y), or those of a stretch of time."""

    polygon_m: list[list[float]] = []
    from_s: float | None = None
    to_s: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_places(self.polygon_m, (2,))
        is_stretch = self.from_s is not None and self.to_s is not None and self.from_s <= self.to_s
        if (len(self.polygon_m) >= _FEWEST_CORNERS) == is_stretch:
            raise ValueError("Input exclude must have either polygon_m with three corners or more, or from_s <= to_s")


class Refit(_Decision, frozen=True, tag_field="action", tag="refit"):
    """Fit all targets to all remaining rows."""


Decision = Drop | Split | Add | Exclude | Refit
_DECODER: msgspec.json.Decoder[Decision] = msgspec.json.Decoder(Decision)


def _check_places(places_m: Sequence[Sequence[float]], lengths: Sequence[int]) -> None:
    for place in places_m:
        if len(place) not in lengths or not all(map(math.isfinite, place)):
            expected = " or ".join(map(str, lengths))
            raise ValueError(f"Input places must have {expected} finite numbers; instead received {list(place)}")


def now() -> str:
    """Return the present time as the log writes it."""
    return datetime.now(UTC).isoformat(timespec="seconds").replace("+00:00", "Z")


def entry_of(decision: Decision) -> dict[str, Any]:
    """Return a decision as JSON writes it."""
    entry: dict[str, Any] = msgspec.to_builtins(decision)
    return entry


def decision_lines(decisions: Iterable[Decision]) -> str:
    """Return the text of a log of decisions."""
    return "".join(msgspec.json.encode(decision).decode() + "\n" for decision in decisions)


def read_decisions(path: str | PathLike[str]) -> list[Decision]:
    """Read a log of decisions: one JSON object a line; empty lines are ignored.

    Raises
    ------
    InputError
        The file cannot be read, or a line is no decision.
    """
    decisions = []
    for number, line in enumerate(read_text(Path(path), "a log of decisions").splitlines(), start=1):
        if not line.strip():
            continue
        try:
            decisions.append(_DECODER.decode(line))
        except msgspec.DecodeError as error:
            raise InputError(
                f"{path}, line {number}: {str(error).rstrip('.')}, expected a decision such as {_EXAMPLE}."
            ) from None
    return decisions
