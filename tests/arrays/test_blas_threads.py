"""Linear algebra has one thread of BLAS in every public call and every command, and afterwards as many as before."""

from __future__ import annotations

import doctest
import inspect
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from threading import Thread
from types import FrameType

import matplotlib
import numpy as np
import pytest
import scipy.linalg
from threadpoolctl import ThreadpoolController, threadpool_limits

import magloc
from arrays.blas_threads import guard_public, one_blas_thread
from tests.conftest import REPOSITORY
from tests.fuzz.cases import LINES, STREAM
from tests.test_guide import PACKAGES, documented

BLAS = ThreadpoolController().select(user_api="blas").lib_controllers
HERE = 2
LINEAR_ALGEBRA = tuple(str(Path(module.__file__).parent) for module in (np.linalg, scipy.linalg))
OURS = tuple(str(REPOSITORY / package) for package in ("arrays", "magloc", "adcs", "sims"))
# A program that says on stderr how many threads BLAS has when a command has run.
COUNT = """
import sys
from {program}.cli.__main__ import main
main()
from threadpoolctl import threadpool_info
print("threads", *{{each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}}, file=sys.stderr)
"""


def threads() -> set[int]:
    return {library.num_threads for library in BLAS}


@pytest.fixture(autouse=True)
def two_threads() -> Iterator[None]:
    with threadpool_limits(HERE, user_api="blas"):
        if threads() != {HERE}:
            pytest.skip("this BLAS has one thread at most")
        yield


@contextmanager
def counted() -> Iterator[dict[str, set[int]]]:
    """Numbers of threads that linear algebra meets, by the place in our code that calls it.

    Vectors and single 3 × 3 matrices, which no BLAS divides, do not count.
    """
    met: dict[str, set[int]] = {}

    def count(frame: FrameType, event: str, _: object) -> None:
        before = frame.f_back
        code = frame.f_code
        if event == "call" and before is not None and code.co_filename.startswith(LINEAR_ALGEBRA):
            place = before.f_code.co_filename
            if (
                place.startswith(OURS)
                and "norm" not in code.co_name
                and np.size(frame.f_locals[code.co_varnames[0]]) > 9
            ):
                met.setdefault(f"{place}:{before.f_lineno}", set()).update(threads())

    sys.setprofile(count)
    try:
        yield met
    finally:
        sys.setprofile(None)


class TestPublicNames:
    @pytest.mark.slow_after(2)
    @pytest.mark.parametrize("package", sorted(PACKAGES, key=("magloc.live", "arrays").__contains__, reverse=True))
    def test_examples_meet_one_thread(self, package: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        matplotlib.use("agg")
        monkeypatch.chdir(tmp_path)
        runner, parser = doctest.DocTestRunner(verbose=False), doctest.DocTestParser()
        with counted() as met:
            for name, thing in documented(package).items():
                runner.run(parser.get_doctest(inspect.getdoc(thing) or "", {}, name, None, None), out=lambda _: None)
        assert {place: n for place, n in met.items() if n != {1}} == {}
        assert threads() == {HERE}

    @pytest.mark.parametrize("door", ["track", "table", "consistency", "locate", "fit", "calibrate", "detection_range"])
    def test_one_inside_and_those_of_before_after(self, door: str) -> None:
        board = magloc.datasets.load("board")
        array, rows, sparse = board.array, board.readings[:5], board.readings[::5]
        few = array.subset(array.ids[:4])
        locator, track = magloc.Locator(array), magloc.track(array, rows)
        calls: dict[str, Callable[[], object]] = {
            "track": lambda: magloc.track(array, rows),
            "table": lambda: track.table(),
            "consistency": lambda: track.consistency(board.truth),
            "locate": lambda: magloc.locate(array, rows),
            "fit": lambda: locator.fit(rows.values_T[0]),
            "calibrate": lambda: magloc.calibrate(array, sparse, truth=board.truth),
            "detection_range": lambda: magloc.detection_range(few, 1.0, false_alarm_rate=0.1),
        }
        with counted() as met:
            calls[door]()
        assert met
        assert set().union(*met.values()) == {1}
        assert threads() == {HERE}


class TestGuard:
    class Thing:
        """A class of ours with one of each."""

        __module__ = "magloc.thing"

        def method(self) -> set[int]:
            return threads()

        @cached_property
        def seen(self) -> set[int]:
            return threads()

        @classmethod
        def of(cls) -> set[int]:
            return threads()

        def steps(self) -> Iterator[set[int]]:
            yield threads()
            yield threads()

        def fails(self) -> None:
            raise ZeroDivisionError

    def test_methods_cached_properties_and_steps(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(magloc, "Thing", self.Thing, raising=False)
        guard_public({"Thing": "magloc"})
        thing = self.Thing()
        assert [thing.method(), thing.seen, thing.of()] == [{1}] * 3
        steps = thing.steps()
        assert (next(steps), threads(), next(steps), threads()) == ({1}, {HERE}, {1}, {HERE})
        with pytest.raises(ZeroDivisionError):
            thing.fails()
        assert threads() == {HERE}

    def test_one_inside_another(self) -> None:
        with one_blas_thread:
            with one_blas_thread:
                assert threads() == {1}
            assert threads() == {1}
        assert threads() == {HERE}

    def test_the_last_thread_of_python_gives_back(self) -> None:
        with one_blas_thread:
            other = Thread(target=one_blas_thread.__enter__)
            other.start()
            other.join()
        assert threads() == {1}
        one_blas_thread.__exit__()
        assert threads() == {HERE}


class TestCommands:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize(
        "command",
        sorted(
            (name for name in LINES if not name.endswith("warm-up")),  # it loads no linear algebra
            key="adcs vectors".__eq__,
            reverse=True,
        ),
    )
    def test_one_thread(self, command: str, files: Path, tmp_path: Path) -> None:
        assert self.threads_of(command, files, tmp_path / "case", {}) == {"1"}

    def test_the_users_own_number_stays(self, files: Path, tmp_path: Path) -> None:
        own = {"OPENBLAS_NUM_THREADS": str(HERE)}
        assert self.threads_of("magloc new-array", files, tmp_path / "case", own) == {str(HERE)}

    def threads_of(self, command: str, files: Path, folder: Path, own: dict[str, str]) -> set[str]:
        shutil.copytree(files, folder)
        program, *name = command.split()
        names = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
        environment = {key: value for key, value in os.environ.items() if key not in names}
        with (folder / STREAM).open("rb") as stdin:
            ran = subprocess.run(
                [sys.executable, "-c", COUNT.format(program=program), *name, *LINES[command][0].split()],
                cwd=folder,
                env=environment | own | {"PYTHONPATH": str(REPOSITORY), "MPLBACKEND": "agg"},
                stdin=stdin,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
        return set(ran.stderr.splitlines()[-1].removeprefix("threads ").split())
