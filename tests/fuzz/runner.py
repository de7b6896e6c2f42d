"""One mangled case: run in this process, and what is wrong with how it ended."""

from __future__ import annotations

import io
import json
import random
import re
import shutil
import signal
import sys
import traceback
import warnings
from collections.abc import Iterator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from adcs.mockup.vision.sky import AmbiguousSkyWarning
from tests.command_line import refuse_constant
from tests.fuzz.cases import LINES, MAINS, SELDOM, STREAM, commands
from tests.fuzz.extremes import Extreme
from tests.fuzz.mangle import mangle_names, mangled_arguments, mangled_file

LONGEST_S = 60.0  # of the processor's time: neither a loaded machine nor a slow one is a hang
LONGEST_WAIT_S = 300.0
LONGEST_SENTENCE = 300
_OPTIONS = dict(commands())
# Words of libraries and of Python, which mean nothing to a user.
_FOREIGN = re.compile(
    r"0x[0-9a-f]{7}|broadcast|same shape|reshape|singular|ndarray|dtype|out of bounds|NoneType|_io\.|Traceback|"
    r"\w+Error\b|invalid value encountered|must be real|"
    r"not subscriptable|unpack|concatenate|'\w+' object|integer string"
)


class Hang(BaseException):
    """Not caught by whatever expects an Exception."""


class Case(NamedTuple):
    """What is run, in a folder that is the command's working directory."""

    program: str
    arguments: list[str]
    stdin: bytes
    mangled: str = ""  # file of the folder


class Ended(NamedTuple):
    """How it ended."""

    status: int | None
    out: str
    err: str
    trace: str


def made_case(seed: int, files: Path, folder: Path) -> Case:
    """The case of a seed: a line, its files in a new folder, and one of stream, files, names or arguments mangled."""
    rng = random.Random(seed)
    names = sorted(LINES)
    command = rng.choices(names, [SELDOM.get(name, 1.0) for name in names])[0]
    words = rng.choice(LINES[command]).split()
    stdin = (files / STREAM).read_bytes()
    read = read_files(words, files, folder)
    what, mangled = rng.random(), ""
    if "-" in words and what < 0.8:
        stdin = mangled_file(stdin, rng)
    elif read and what < 0.65:
        target = folder / rng.choice(read)
        inside = [file for file in sorted(target.rglob("*")) if file.is_file()] if target.is_dir() else [target]
        file = rng.choice(inside)
        file.write_bytes(mangled_file(file.read_bytes(), rng))
        mangled = file.name
    elif read and what < 0.7:
        mangle_names(folder, rng)
    else:
        words = mangled_arguments(words, _OPTIONS[command], rng)
    return _case(command, words, stdin)._replace(mangled=mangled)


def extreme_case(extreme: Extreme, files: Path, folder: Path) -> Case:
    """The case of one number at an end of what it can be."""
    read_files(extreme.words, files, folder)
    if extreme.file:
        text = (folder / extreme.file).read_text(encoding="utf-8")
        text = text[: extreme.at.start] + extreme.value + text[extreme.at.stop :]
        (folder / extreme.file).write_text(text, encoding="utf-8")
    return _case(extreme.command, extreme.words, (files / STREAM).read_bytes())


def read_files(words: Sequence[str], files: Path, folder: Path) -> list[str]:
    """The words of a line that name what it reads, of which a copy is put into a new folder."""
    folder.mkdir()
    names = [word.removeprefix("replay:") for word in words]
    read = [name for name in names if (files / name).exists()]
    for word in read:
        (shutil.copytree if (files / word).is_dir() else shutil.copyfile)(files / word, folder / word)
    return read


def _case(command: str, words: Sequence[str], stdin: bytes) -> Case:
    program, *name = command.split()
    if any(_asks_for_much(words)):
        words = words[:1]
    if "view" in name and not any(word.startswith("--html") for word in words):
        words = [*words, "--html", "out.html"]  # a server would wait for its reader
    return Case(program, [*name, *(word for word in words if word not in ("--view", "--open"))], stdin)


def _asks_for_much(words: Sequence[str]) -> Iterator[bool]:
    """Whether a whole number is long work, which is no hang, rather than too much, which is refused."""
    for option, word in pairwise(words):
        value = word.replace("_", "")  # 1_000 is a number too
        most = {"--duration": 3000, "--seeds": 4}.get(option, 100)
        yield option.startswith("--") and value.isascii() and value.isdigit() and most < float(value) < 1e7


def run_case(case: Case, folder: Path, seconds: float = LONGEST_S) -> Ended:
    """Run a case; warnings that are not the program's own are errors."""
    out, err, trace, status = io.StringIO(), io.StringIO(), "", None
    with chdir(folder), _stdin(case.stdin), redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("default", AmbiguousSkyWarning)
        with _alarm(seconds):
            try:
                status = MAINS[case.program](case.arguments)
            except (Exception, SystemExit, Hang):
                trace = traceback.format_exc()
    return Ended(status, out.getvalue(), err.getvalue(), trace)


def faults(case: Case, ended: Ended, before: set[str], folder: Path) -> Iterator[str]:
    """What is wrong: nothing, for a good program."""
    if ended.trace:
        yield "hang" if "Hang" in ended.trace.splitlines()[-1] else "traceback"
    elif ended.status not in (0, 2):
        yield f"status {ended.status}"
    if "Traceback" in ended.err or "Warning:" in ended.err:
        yield "foreign text on stderr"
    lines = ended.err.splitlines()
    if any(not line.startswith((f"{case.program}: ", "  ")) for line in lines):
        yield "a line of stderr without the program's name"
    if any(not char.isprintable() for line in lines for char in line):
        yield "control characters on stderr"
    if foreign := _FOREIGN.search(ended.err):
        yield f"foreign words: {foreign[0]}"
    begun = lines[-1].removeprefix(f"{case.program}: ").partition(":")[0].partition(",")[0] if lines else ""
    if case.mangled.endswith(".csv") and ended.status == 2 and begun.endswith(".toml"):
        yield f"names {begun} in place of {case.mangled}"
    if ended.status == 2 and (not lines or len(lines[-1]) > LONGEST_SENTENCE):
        yield f"a sentence of {len(lines[-1]) if lines else 0} characters"
    after = {str(file.relative_to(folder)) for file in folder.rglob("*")}
    made = after - before
    if any(part.startswith(".") or part.endswith(".tmp") for file in made for part in Path(file).parts):
        yield f"left behind: {sorted(made)[:3]}"
    # A stream writes complete rows until it is refused.
    is_stream = case.arguments[0] == "live"
    if ended.status == 2 and not is_stream and any(Path(file).suffix and (folder / file).is_file() for file in made):
        yield f"refused, but wrote {sorted(made)[:3]}"
    if ended.status == 0 and "--json" in case.arguments and ended.out:
        try:
            json.loads(ended.out, parse_constant=refuse_constant)
        except (ValueError, AssertionError) as error:
            yield f"not JSON: {error}"


def verdict(seed: int, files: Path, folder: Path) -> tuple[Case, Ended, list[str]]:
    """One case from its seed to what is wrong with it; the folder is left as it is then."""
    case = made_case(seed, files, folder)
    return case, *judged(case, folder)


def judged(case: Case, folder: Path) -> tuple[Ended, list[str]]:
    """How a case ends, and what is wrong with that."""
    before = {str(file.relative_to(folder)) for file in folder.rglob("*")}
    ended = run_case(case, folder)
    return ended, list(faults(case, ended, before, folder))


def report(seed: object, case: Case, ended: Ended, wrong: Sequence[str]) -> str:
    """What a person needs to see one fault again."""
    end = ended.trace or ended.err
    return f"seed {seed}: {'; '.join(wrong)}\n  {case.program} {case.arguments}\n  status {ended.status}\n{end[-1500:]}"


@contextmanager
def _stdin(data: bytes) -> Iterator[None]:
    kept = sys.stdin
    sys.stdin = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8")
    try:
        yield
    finally:
        sys.stdin = kept


@contextmanager
def _alarm(seconds: float) -> Iterator[None]:
    def ring(*_: object) -> None:
        raise Hang

    kept = {name: signal.signal(name, ring) for name in (signal.SIGPROF, signal.SIGALRM)}
    signal.setitimer(signal.ITIMER_PROF, seconds)
    signal.setitimer(signal.ITIMER_REAL, LONGEST_WAIT_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        for name, handler in kept.items():
            signal.signal(name, handler)
