"""The command line ``magloc``.

Every command is a function in a module of :mod:`magloc.commands`; its NumPy docstring is its help text. It raises
:class:`arrays.errors.InputError` for bad input. Here is what all of them have in common: one line on stderr and exit
status 2 for whatever is wrong with the input, 130 for an interruption.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import metadata

from cyclopts import App, CycloptsError, Parameter

from arrays.errors import InputError
from magloc.commands.calibrate import calibrate
from magloc.commands.common import CommonOptions, print_note
from magloc.commands.locate import locate
from magloc.commands.map import map_
from magloc.commands.simulate import simulate
from magloc.commands.track import track
from magloc.commands.view import view

DONE = 0
BAD_INPUT = 2
INTERRUPTED = 130
BROKEN_PIPE = 141


def _version() -> str:
    try:
        return metadata.version("magloc")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


app = App(
    name="magloc",
    help="Find magnetic dipoles from the differences between magnetometers.",
    version=_version,
    default_parameter=Parameter(negative=()),
)
app.command(calibrate)
app.command(locate)
app.command(map_, name="map")
app.command(track)
app.command(simulate)
app.command(view)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    arguments : sequence of str, optional
        The command and its arguments; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 2 bad input, 130 interrupted, 141 the reader of the output is gone.
    """
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    # Before numpy is loaded: threads of linear algebra only wait for each other over matrices as small as ours.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        with _one_line_warnings():
            _run(tokens)
            sys.stdout.flush()
    except (InputError, CycloptsError) as error:
        print_note(str(error))
        return BAD_INPUT
    except KeyboardInterrupt as interruption:
        print_note(str(interruption) or "interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The interpreter flushes stdout once more when it exits, which must not fail again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        print_note(f"{error.filename}: {error.strerror}" if error.filename else str(error))
        return BAD_INPUT
    return DONE


def _run(tokens: Sequence[str]) -> None:
    command, bound, _ = app.parse_args(tokens, print_error=False, exit_on_error=False)
    for value in bound.arguments.values():
        if isinstance(value, CommonOptions):
            value.apply()
    command(*bound.args, **bound.kwargs)


@contextmanager
def _one_line_warnings() -> Iterator[None]:
    """Show warnings without the source line that raised them."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: print_note(f"warning: {message}")
        yield


if __name__ == "__main__":
    sys.exit(main())
