"""What all commands share: their common options, JSON on stdout and progress on stderr."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter, Token
from cyclopts.validators import Number


def whole_number(_: type, tokens: Sequence[Token]) -> int:
    """Convert one argument; cyclopts alone would round 1.5."""
    try:
        return int(tokens[0].value)
    except ValueError:
        raise ValueError(f"found {tokens[0].value!r}, expected a whole number.") from None


Flag = Annotated[bool, Parameter(show_default=False)]
Count = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1))]
Seed = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=0))]


@Parameter(name="*", group="Common options")
@dataclass(frozen=True)
class CommonOptions:
    """Options of every command.

    Parameters
    ----------
    seed : int
        Seed of whatever is random; the same seed gives the same result.
    threads : int
        Threads at most; by default all cores. Results do not depend on it.
    quiet : bool
        No progress and no summary on stderr, only errors.
    """

    seed: Seed = 0
    threads: Count | None = None
    quiet: Flag = False

    def apply(self) -> None:
        """Limit the threads of compiled code."""
        if self.threads is not None:
            import numba

            numba.set_num_threads(min(self.threads, numba.config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]


def print_json(value: object) -> None:
    """Print one JSON value on stdout; numbers that are not finite become null, numpy arrays lists."""
    import msgspec

    print(msgspec.json.encode(value, enc_hook=lambda array: array.tolist()).decode())


def print_note(text: str) -> None:
    """Print one line on stderr, whatever the text."""
    print(f"magloc: {' '.join(text.split())}", file=sys.stderr)


@contextmanager
def progress(total: int, unit: str, *, quiet: bool, initial: int = 0) -> Iterator[Callable[[int], None]]:
    """Count up to a total on a terminal's stderr.

    Parameters
    ----------
    total : int
    unit : str
        What is counted.
    quiet : bool
    initial : int
        Finished before; does not count in the estimate of the time left.

    Yields
    ------
    callable
        To be called with the number finished since the last call.
    """
    from tqdm import tqdm

    hidden = quiet or not sys.stderr.isatty()
    with tqdm(total=total, initial=initial, unit=f" {unit}", disable=hidden, leave=False) as bar:

        def advance(finished: int) -> None:
            bar.update(finished)

        yield advance
