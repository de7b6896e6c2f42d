"""Options that several commands share."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from arrays.io.arguments import whole_number
from arrays.io.errors import InputError
from magloc.cli import framework
from magloc.cli.framework import progress

if TYPE_CHECKING:
    from magloc.grids.cube import Chunk
    from magloc.grids.store import Sweep
from magloc.ambient import Place


def print_note(text: str) -> None:
    """Print one line on stderr, whatever the text."""
    framework.print_note(text, "magloc")


Grid = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=2, lte=2000))]
"""Points along an axis: 2000 are 8,000,000,000 points, more than a day of work."""


def complete(sweep: Sweep, chunks: Iterable[Chunk], *, quiet: bool) -> None:
    """Write chunks as they are computed; however that ends, say how to go on.

    Parameters
    ----------
    sweep : Sweep
    chunks : iterable
        Computed chunks that are not written yet.
    quiet : bool
        No progress.

    Raises
    ------
    KeyboardInterrupt
        With what is done.
    InputError
        The file cannot be written, or a chunk cannot be computed; the text says what is done.
    """
    cube = sweep.cube

    def kept() -> str:
        return f"{sweep.chunks_done} of {sweep.n_chunks} chunks are done, the same command goes on with the others"

    with progress(cube.grid**3, f"{cube.point}s", quiet=quiet, initial=sweep.points_done) as advance:
        try:
            sweep.write(chunks, advance)
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"interrupted: {kept()}") from None
        except InputError as error:
            raise InputError(f"{str(error).rstrip('.')}; {kept()}.") from None
        except OSError as error:
            raise InputError(f"{sweep.path} cannot be written ({error.strerror or error}); {kept()}.") from None


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
