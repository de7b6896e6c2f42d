"""Main loop, common options, JSON output, notes and progress of the command lines.

Commands are functions that :mod:`cyclopts` calls. They raise :class:`arrays.io.errors.InputError` for bad input, which
becomes one line on stderr and exit status 2. An interruption becomes exit status 130.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import io
import logging
import math
import os
import shlex
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from cyclopts import App, CycloptsError, MissingArgumentError, Parameter, Token, UnknownCommandError
from cyclopts.validators import Number

from arrays.io.errors import LARGEST, PACKAGES, InputError
from arrays.io.outputs import installed_version, make_folder
from magloc.cli.entry import INTERRUPTED

DONE = 0
INTERNAL = 1
BAD_INPUT = 2
BROKEN_PIPE = 141
_LONGEST_WORD = 200
_LOG = logging.getLogger(__name__)
_warnings: list[str] = []
"""Warnings of the command line that runs, for its JSON."""
# Commands that end when their user or their stream does.
_ENDLESS = {"live", "view"}
_FIRST_SIGN_S = 10.0
# Level of the log between INFO and WARNING: results on stderr, which --quiet keeps.
_RESULT = 25
_bars: list[object] = []
_TOO_LARGE = 10**18


def whole_number(_: type, tokens: Sequence[Token]) -> int:
    """Convert one argument. cyclopts alone would round 1.5 and accept numbers beyond int64."""
    try:
        number = int(tokens[0].value)
        if abs(number) < _TOO_LARGE:
            return number
    except ValueError:
        pass
    raise ValueError(f"found {tokens[0].value!r}, expected a whole number of at most 18 digits.")


ABOVE_ZERO = math.ulp(0.0)
"""Smallest positive number: the limit of options that must be positive."""


def refuse_outside(low: float, high: float, expected: str, *, unit: str = "", **options: float | None) -> None:
    """Refuse options, given by their Python names, whose values are outside the limits."""
    for name, value in options.items():
        if value is not None and not low <= value <= high:
            most = f", at most {LARGEST:g}" if LARGEST == high < value < math.inf else ""
            raise InputError(f"--{name.replace('_', '-')}: found {value:g}{unit}, expected {expected}{most}.")


Flag = Annotated[bool, Parameter(show_default=False)]
# A command with ten million runs would not end.
Count = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=1, lt=10_000_000))]
Seed = Annotated[int, Parameter(converter=whole_number, validator=Number(gte=0))]


@Parameter(name="*", group="Common options")
@dataclass(frozen=True)
class QuietOptions:
    """Options of every command.

    Parameters
    ----------
    threads : int
        Largest number of threads; by default all cores. Results do not depend on it.
    quiet : bool
        Print errors only: no progress and no summary on stderr.
    """

    threads: Count | None = None
    quiet: Flag = False

    def apply(self) -> None:
        """Set the number of threads of the kernels, and which notes are printed."""
        for name in PACKAGES:
            logging.getLogger(name).setLevel(_RESULT if self.quiet else logging.INFO)
        if self.threads is not None:
            from magloc import core

            core.set_threads(min(self.threads, os.cpu_count() or 1))


@Parameter(name="*", group="Common options")
@dataclass(frozen=True)
class CommonOptions(QuietOptions):
    """Options of every command that draws random numbers once.

    Parameters
    ----------
    threads : int
        Largest number of threads; by default all cores. Results do not depend on it.
    quiet : bool
        Print errors only: no progress and no summary on stderr.
    seed : int
        Seed of all random numbers. The same seed gives the same result.
    """

    seed: Seed = 0


def new_app(name: str, help: str, commands: Iterable[tuple[str, str, str]], **options: Any) -> App:
    """Return a command line whose commands load when they are called.

    ``commands``: name, ``module:function`` and a line of help each. Names also reach packages on a higher floor.
    """
    app = App(name=name, help=help, **options)
    for command, where, line in commands:
        app.command(where, name=command, help=line)
    return app


def new_program(name: str, help: str, commands: Iterable[tuple[str, str, str]]) -> App:
    """Return the command line of a program."""
    app = new_app(name, help, commands, version=installed_version, default_parameter=Parameter(negative=()))
    app.register_install_completion_command(help="Let the Tab key complete commands and options (bash, zsh, fish).")
    return app


def run(app: App, arguments: Sequence[str] | None = None) -> int:
    """Run one command of a command line.

    Parameters
    ----------
    app : App
    arguments : sequence of str, optional
        The command and its arguments; by default those of the process.

    Returns
    -------
    int
        Exit status: 0 done, 1 a fault of the program, 2 bad input, 130 interrupted, 141 nobody reads the output.
    """
    _warnings.clear()
    program = app.name[0]
    tokens = sys.argv[1:] if arguments is None else list(arguments)
    # A stream is None where the shell closed it. This order keeps the first file opened from taking its place.
    for name in ("stdin", "stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115
    # Input is UTF-8 on every system, as in files. Characters that an output cannot show are escaped.
    if isinstance(sys.stdin, io.TextIOWrapper):
        with contextlib.suppress(io.UnsupportedOperation):  # something was read from it already
            sys.stdin.reconfigure(encoding="utf-8")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        with _one_line_warnings(program), _notes_of_the_library(program):
            call(app, tokens)
            sys.stdout.flush()
    except (InputError, CycloptsError) as error:
        print_note(str(error), program)
        return BAD_INPUT
    except KeyboardInterrupt as interruption:
        print_note(str(interruption) or "interrupted", program)
        return INTERRUPTED
    except BrokenPipeError:
        _give_up_stdout()
        return BROKEN_PIPE
    except SystemExit as error:
        if not isinstance(error.__context__, BrokenPipeError):  # raised by rich for a broken pipe
            raise
        _give_up_stdout()
        return BROKEN_PIPE
    except OSError as error:
        # Every function that writes a file names it in the error; here it is stdout.
        if not error.filename and error.errno in (errno.ENOSPC, errno.EIO, errno.EBADF):
            error.filename = "standard output"
            _give_up_stdout()
        print_note(f"{error.filename}: {error.strerror}" if error.filename else str(error), program)
        return BAD_INPUT
    except MemoryError:
        print_note("the memory is full; use fewer rows or points, or a coarser grid.", program)
        return BAD_INPUT
    except Exception as error:  # a traceback does not help a user
        print_note(_internal(error), program)
        _LOG.debug("internal error", exc_info=error)
        return INTERNAL
    return DONE


def _internal(error: Exception) -> str:
    """Return a sentence that names the place of an unexpected error and asks for a report."""
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    own = [frame for frame in frames if frame.f_globals.get("__name__", "").partition(".")[0] in PACKAGES]
    place = f" in {own[-1].f_globals['__name__']}, line {own[-1].f_lineno}" if own else ""
    return (
        f"internal error{place} ({type(error).__name__}: {error}). This is a fault of the program: please report"
        " this line, with the command and its files if you may."
    )


def _give_up_stdout() -> None:
    """Send stdout to the null device, because the interpreter flushes it once more at its end."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def call(app: App, tokens: Sequence[str]) -> None:
    """Run one command; errors are raised."""
    try:
        use_docstrings(app, tokens)
        command, bound, _ = app.parse_args(tokens, print_error=False, exit_on_error=False)
    except UnknownCommandError as error:
        raise InputError(_unknown_command(app, error)) from None
    except MissingArgumentError as error:
        if error.keyword is not None:
            raise  # the option is there without its value
        raise InputError(str(error).replace(" requires an argument.", " is missing.")) from None
    except ImportError as error:
        raise InputError(f"the command cannot be loaded ({error.__cause__ or error}).") from None
    options = next((value for value in bound.arguments.values() if isinstance(value, QuietOptions)), QuietOptions())
    options.apply()
    endless = "-" in tokens or not _ENDLESS.isdisjoint(tokens[:1])
    with contextlib.nullcontext() if options.quiet or endless else _signs_of_life(app.name[0]):
        command(*bound.args, **bound.kwargs)


@contextmanager
def _signs_of_life(program: str) -> Iterator[None]:
    """Print at growing intervals how long a command has run, on a terminal without a progress bar."""
    ended = threading.Event()

    def tell() -> None:
        wait_s, passed_s = _FIRST_SIGN_S, 0.0
        while not ended.wait(wait_s):
            passed_s += wait_s
            wait_s = passed_s
            if not _bars:
                print_note(f"still computing after {passed_s:g} s", program)

    if sys.stderr.isatty():
        threading.Thread(target=tell, daemon=True).start()
    try:
        yield
    finally:
        ended.set()


def _unknown_command(app: App, error: UnknownCommandError) -> str:
    """Return the sentence for an unknown command; cyclopts would load every command for it."""
    token, *_ = error.unused_tokens or [""]
    names = [name for name in app if not name.startswith("-")]
    near = "".join(f' Did you mean "{name}"?' for name in difflib.get_close_matches(token, names, n=1))
    return f'Unknown command "{token}".{near} Available commands: {", ".join(names)}.'


def use_docstrings(app: App, tokens: Sequence[str]) -> None:
    """Use the docstring of a command as its help, instead of the line in the list of commands."""
    chain, apps, _ = app.parse_commands(tokens)
    for name, command in zip(chain, apps[1:], strict=True):
        if not name.startswith("-") and all(inner.startswith("-") for inner in command):
            command.help = None


@contextmanager
def _one_line_warnings(program: str) -> Iterator[None]:
    """Show our own warnings in one line, and log those of other libraries."""

    def show(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
        if category.__module__.partition(".")[0] in PACKAGES:
            _warnings.append(str(message))
            print_note(f"warning: {message}", program)
        else:
            _LOG.debug("%s: %s", category.__name__, message)

    with warnings.catch_warnings():
        warnings.showwarning = show
        yield


class _Notes(logging.Handler):
    """Handler that prints log messages of the library and the commands as notes of a program."""

    def __init__(self, program: str) -> None:
        super().__init__()
        self.program = program

    def emit(self, record: logging.LogRecord) -> None:
        """Print one record."""
        prefix = ""
        if record.levelno >= logging.WARNING:
            prefix = "warning: "
            _warnings.append(record.getMessage())
        print_note(prefix + record.getMessage(), self.program)


@contextmanager
def _notes_of_the_library(program: str) -> Iterator[None]:
    """Print the log of the packages, one line for each record."""
    handler = _Notes(program)
    loggers = [logging.getLogger(name) for name in PACKAGES]
    for logger in loggers:
        logger.addHandler(handler)
        logger.setLevel(logging.INFO)
        logger.propagate = False
    try:
        yield
    finally:
        for logger in loggers:
            logger.removeHandler(handler)
            logger.setLevel(logging.NOTSET)
            logger.propagate = True


def demonstrate(app: App, out: Path, calls: Sequence[Sequence[str]], common: QuietOptions) -> list[str]:
    """Run commands, show each as a user types it, and return their outputs."""
    make_folder(out, "OUT")
    every = []
    for tokens in calls:
        if not common.quiet:
            print(f"$ {' '.join([app.name[0], *map(shlex.quote, tokens)])}", flush=True)
        with contextlib.redirect_stdout(io.StringIO()) as printed:
            call(app, [*tokens, "--quiet"])
        every.append(printed.getvalue())
    return every


def json_text(value: object) -> str:
    """Return a value as JSON; NaN and infinity become null, numpy arrays lists."""
    import msgspec

    return msgspec.json.encode(value, enc_hook=lambda array: array.tolist()).decode()


def print_json(value: object) -> None:
    """Print one JSON value on stdout."""
    print(json_text(value))


def print_json_list(name: str, entries: Iterable[object]) -> None:
    """Print a JSON object with one list; only one entry at a time is in memory."""
    print(f'{{"{name}":[', end="")
    for i, entry in enumerate(entries):
        print("," if i else "", json_text(entry), sep="", end="")
    print(f'],"warnings":{json_text(_warnings)}}}')


def print_report(report: Mapping[str, object]) -> None:
    """Print the report of a command as one JSON object with all warnings."""
    own = report.get("warnings", [])
    assert isinstance(own, list)
    print_json({**report, "warnings": [*own, *(text for text in _warnings if text not in own)]})


def print_result(result: Mapping[str, object], lines: Sequence[str], *, as_json: bool) -> None:
    """Print a result as text, or as one JSON object with the warnings, if there are any."""
    if as_json and _warnings:
        print_report(result)
    elif as_json:
        print_json(result)
    else:
        print("\n".join(lines))


def note(text: str, *, always: bool = False) -> None:
    """Print one line on stderr; --quiet hides it unless it is a result, shown `always`."""
    _LOG.log(_RESULT if always else logging.INFO, text)


def warn(texts: Iterable[str]) -> None:
    """Print warnings, which the JSON object of a command lists by itself; --quiet hides them."""
    for text in texts:
        note(f"warning: {text}")


def print_note(text: str, program: str) -> None:
    """Print one line on stderr: control characters are escaped, very long words are shortened."""
    words = (word if len(word) <= _LONGEST_WORD else f"{word[:20]}…{word[-20:]}" for word in text.split())
    line = "".join(char if char.isprintable() else ascii(char)[1:-1] for char in " ".join(words))
    print(f"{program}: {line}", file=sys.stderr)


@contextmanager
def progress(total: int, unit: str) -> Iterator[Callable[[int], None]]:
    """Count up to a total on a terminal's stderr, unless --quiet hides it.

    Parameters
    ----------
    total : int
    unit : str
        What is counted.

    Yields
    ------
    callable
        Function to call with the number finished since the last call.
    """
    from tqdm import tqdm

    hidden = not (sys.stderr.isatty() and _LOG.isEnabledFor(logging.INFO))
    with tqdm(total=total, unit=f" {unit}", disable=hidden, leave=False) as bar:

        def advance(finished: int) -> None:
            bar.update(finished)

        if not hidden:
            _bars.append(bar)
        try:
            yield advance
        finally:
            if not hidden:
                _bars.remove(bar)
