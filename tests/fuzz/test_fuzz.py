"""Every command, fed with mangled files, streams, names and arguments, ends in a result or in one sentence."""

from __future__ import annotations

import random

import pytest
from cyclopts import Token

from magloc.cli.framework import whole_number
from tests.fuzz.cases import LINES, SELDOM, STREAM, commands, parsed_arguments
from tests.fuzz.extremes import extremes
from tests.fuzz.runner import Case, extreme_case, judged, read_files, report, run_case, verdict

CHUNK = 50
QUICK, NEW = 1, 45  # chunks that are always the same, and chunks that are new in every run
PARTS = 500  # of all numbers that files and options take; the first one is quick, a tenth of them are tried at all


def test_every_command_has_a_line():
    assert sorted(LINES) == sorted(name for name, _ in commands())


@pytest.mark.parametrize(
    ("command", "line"),
    [
        pytest.param(command, line, marks=[pytest.mark.slow] if command in SELDOM or i > 1 else [])
        for command in LINES
        for i, line in enumerate(LINES[command])
    ],
)
def test_the_lines_are_good(command, line, files, tmp_path):
    """A mutation of what is refused anyway would test nothing."""
    program, *name = command.split()
    read_files(line.split(), files, tmp_path / "case")
    case = Case(program, [*name, *line.split()], (files / STREAM).read_bytes())
    ended = run_case(case, tmp_path / "case", seconds=300.0)  # compiles on a new machine
    assert ended.status == 0, ended.err + ended.trace


@pytest.mark.parametrize(
    "chunk", [pytest.param(i, marks=[pytest.mark.slow] if i >= QUICK else []) for i in range(QUICK + NEW)]
)
def test_mangled(chunk, files, tmp_path):
    """A seed that is reported comes again by ``python -m tests.fuzz --one --seed``."""
    first = CHUNK * chunk if chunk < QUICK else random.SystemRandom().randrange(10**9)
    found = []
    for seed in range(first, first + CHUNK):
        case, ended, wrong = verdict(seed, files, tmp_path / str(seed))
        if wrong:
            found.append(report(seed, case, ended, wrong))
    assert not found, "\n\n".join(found)


def test_no_whole_number_is_too_large():
    """For a float, an int64 or a file: the converter refuses it, whatever the option."""
    for command, arguments in parsed_arguments():
        whole = [one for one in arguments if one.hint in (int, int | None)]
        assert all(one.parameter.converter is whole_number for one in whole), command
    assert whole_number(int, [Token(value="-999_999_999_999_999_999")]) == 1 - 10**18
    for digits in (19, 400, 4400):
        with pytest.raises(ValueError, match=r"found '9+', expected a whole number of at most 18 digits"):
            whole_number(int, [Token(value="9" * digits)])


@pytest.mark.parametrize(
    ("line", "word"),
    [
        ("magloc locate moving.csv --array moving-array.toml --body-length-m 1e155", "body"),
        ("magloc locate scalar.csv --array scalar.toml --known-moment-Am2 1e155", "known"),
        ("magloc simulate ground.toml --out /", "--out"),
        ("magloc calibrate readings.csv --array array.toml --out out.toml --offset-prior-nT 5e-324", "--offset-prior"),
        ("adcs run ellipsoid --duration 300 --seeds 1 --noise-deg 5e-324", "--noise-deg"),
        ("adcs run ellipsoid --closed-loop --duration 300 --seeds 1 --drift-deg-s 1e-300", "--drift-deg-s"),
        ("adcs run mockup --part sky --poses 1 --sky sky.toml --believed-k1 1e308", "--believed-k1"),
        ("adcs run detumbling --seeds 1 --duration 1e-300", "--duration"),
        ("adcs stars frames --catalogue stars.csv --scale-arcsec 1e-300", "--scale-arcsec"),
    ],
)
def test_what_was_found(line, word, files, tmp_path):
    program, *words = line.split()
    read_files([name for name in words if name != "/"], files, tmp_path / "case")
    ended = run_case(Case(program, words, b""), tmp_path / "case")
    assert (ended.status, ended.trace) == (2, "")
    assert word in ended.err
    assert len(ended.err.splitlines()) == 1


@pytest.mark.parametrize("part", [pytest.param(i, marks=[pytest.mark.slow] if i else []) for i in range(PARTS // 10)])
def test_extremes(part, files, tmp_path):
    """Each number of each file, and each option, at 1e30, 1e-30, 0, -1, NaN and infinity."""
    every = list(extremes(files))
    random.Random(0).shuffle(every)
    found = []
    for i, extreme in enumerate(every[part::PARTS]):
        case = extreme_case(extreme, files, tmp_path / str(i))
        ended, wrong = judged(case, tmp_path / str(i))
        if wrong:
            found.append(report(extreme, case, ended, wrong))
    assert not found, "\n\n".join(found)
