"""A cube that a command computes as far as it is not done."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter
from cyclopts.validators import Number

from arrays.errors import InputError
from magloc.commands.common import progress, whole_number

if TYPE_CHECKING:
    from magloc.cubes import Chunk
    from magloc.sweep import Sweep

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
