"""Options that several commands share."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from arrays.io.arguments import whole_number
from arrays.io.errors import InputError
from magloc.ambient import Place
from magloc.cli import framework


def print_note(text: str) -> None:
    """Print one line on stderr, whatever the text."""
    framework.print_note(text, "magloc")


Grid = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=2, lte=2000))]
"""Points along an axis: 2000 are 8,000,000,000 points, more than a day of work."""


@contextmanager
def naming_scheduler() -> Iterator[None]:
    """Let errors of a scheduler speak of the option."""
    from magloc.grids.cluster import SchedulerError

    try:
        yield
    except SchedulerError as error:
        raise InputError(f"--{error}") from None


@contextmanager
def naming_outputs() -> Iterator[None]:
    """Let errors of a viewer speak of the options --html, --png and --port."""
    from magloc.viewer.chromium import BrowserError

    try:
        yield
    except BrowserError as error:
        raise InputError(f"--png: {error}") from None
    except InputError as error:
        if str(error).startswith(("Input html", "Input png", "Input port")):
            raise InputError(f"--{str(error).removeprefix('Input ')}") from None
        raise


_DATE = re.compile(r"\d{4}-\d{2}-\d{2}(T\d{2}:\d{2}(:\d{2}(\.\d+)?)?)?")


def place_of_options(place: tuple[float, float, float] | None, date: str | None, model: str | None) -> Place | None:
    """The place that the options name, or None if they name none."""
    if place is None and date is None and model is None:
        return None
    if place is None:
        given = "--date" if date is not None else "--geomagnetic-model"
        raise InputError(f"{given}: found no --place, expected --place LAT LON ALT_M with it.")
    if date is None:
        raise InputError("--place: found no --date, expected the date of the readings, such as --date 2026-11-21.")
    if not _DATE.fullmatch(date):
        raise InputError(f"--date: found {date!r}, expected a date such as 2026-11-21.")
    return Place(*place, date, model or "IGRF-14")
