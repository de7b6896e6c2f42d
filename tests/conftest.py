"""Fixtures for all tests."""

from __future__ import annotations

import gc
import os
import shutil
import signal
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import HealthCheck, settings

from adcs.cli.app import main as adcs_main
from magloc import core
from magloc.cli.app import main
from tests.command_line import Outcome, Run
from tests.fuzz.cases import write_files

if TYPE_CHECKING:
    from xdist.remote import Producer
    from xdist.scheduler import LoadScopeScheduling

REPOSITORY = Path(__file__).parents[1]
LONGEST_WRITE_S = 600.0

# The same examples in every run of `make test`; new ones, and more, in every run of `make test-full`. Neither asks the
# clock.
for profile, derandomize, n in (("fixed", True, 40), ("random", False, 100)):
    settings.register_profile(
        profile, derandomize=derandomize, max_examples=n, deadline=None, suppress_health_check=[HealthCheck.too_slow]
    )
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))

# The notebooks that `make test` executes: each takes seconds, and all are executed by `make test-full`.
QUICK_NOTEBOOKS = {"01-first-fix"}


def pytest_configure() -> None:
    """Let Ctrl-C reach the commands that tests start, even where these tests run in the background of a shell."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the longer notebooks and the cases after the quick ones as slow, and choose the order for processes.

    What takes longest comes first, so that they end together; beside it what needs other kernels, so that where none is
    cached yet no two processes compile the same ones.
    """

    @cache
    def rank(path: Path) -> int:
        if "browser" in path.parts or path.stem == "test_scenario_consistency":
            return 0
        if path.is_relative_to(REPOSITORY / "tests" / "adcs"):
            return 1
        return 2 if path.suffix == ".ipynb" or path.stem == "test_guide" else 3

    seen: Counter[str] = Counter()
    for item in items:
        kept = item.get_closest_marker("slow_after")
        test = item.nodeid.partition("[")[0]
        seen[test] += 1
        longer_notebook = ".ipynb" in test and item.path.stem not in QUICK_NOTEBOOKS
        if longer_notebook or (kept is not None and seen[test] > kept.args[0]):
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: rank(item.path))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Spare the garbage collector the modules and tests, which stay to the end: it would walk them again and again."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Producer) -> LoadScopeScheduling:
    """Give all tests of a file to one process, which sets up once what they share; one browser serves its folder."""
    from xdist.scheduler import LoadScopeScheduling

    class ByFile(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            file = nodeid.partition("::")[0]
            return "tests/browser" if file.startswith("tests/browser/") else file

    config.option.loadscopereorder = False
    return ByFile(config, log)


@pytest.fixture(scope="module", autouse=True)
def forgetful(request: pytest.FixtureRequest) -> Iterator[None]:
    """What a file keeps for its own tests in caches goes with it."""
    yield
    for kept in vars(request.module).values():
        if hasattr(kept, "cache_clear") and kept.__module__ == request.module.__name__:
            kept.cache_clear()


@pytest.fixture(params=["baseline", "avx2", "avx512"])
def instruction_set(request: pytest.FixtureRequest) -> Iterator[str]:
    """Use each of the machine's instruction sets in compiled kernels."""
    before = core.instruction_set()
    try:
        core.use_instruction_set(request.param)
    except ValueError:
        pytest.skip(f"this machine or build does not have {request.param}")
    yield request.param
    core.use_instruction_set(before)


@pytest.fixture
def instruction_sets() -> Iterator[Iterator[str]]:
    """Use each of the machine's instruction sets in turn, where a test compares all with one result that takes long."""
    before = core.instruction_set()

    def usable() -> Iterator[str]:
        for name in ("baseline", "avx2", "avx512"):
            try:
                core.use_instruction_set(name)
            except ValueError:
                continue
            yield name

    yield usable()
    core.use_instruction_set(before)


@pytest.fixture
def threads() -> Iterator[Callable[[int], None]]:
    """Set the number of threads of compiled kernels, for one test."""
    before = core.threads()
    yield core.set_threads
    core.set_threads(before)


def folder_of_data() -> Path | None:
    """Return the folder of recordings: that of MAGLOC_DATA, else ``../shared/data`` beside the repository; or None."""
    named = os.environ.get("MAGLOC_DATA")
    beside = REPOSITORY.parent / "shared" / "data"
    return next((folder for folder in (Path(named) if named else beside, beside) if folder.is_dir()), None)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of recordings; a test without it is skipped."""
    folder = folder_of_data()
    if folder is None:
        pytest.skip("needs recordings, but neither MAGLOC_DATA nor ../shared/data is a folder")
    return folder


@pytest.fixture(scope="session")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the lines of `tests.fuzz.cases` read: for copies, as it takes seconds to write."""
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "files"
    written = folder.with_name("files-written")
    # The first worker writes them, the others wait; one that is killed while it writes leaves them without an end.
    end_s = time.monotonic() + LONGEST_WRITE_S
    while not written.exists():
        if time.monotonic() > end_s:
            pytest.fail(f"{folder} was not written within {LONGEST_WRITE_S:g} s")
        try:
            folder.mkdir()
        except FileExistsError:
            time.sleep(0.1)
            continue
        try:
            with pytest.MonkeyPatch.context() as patch:
                patch.setattr("matplotlib.figure.Figure.draw", lambda figure, renderer: None)  # no line reads a picture
                write_files(folder)
            written.touch()
        except BaseException:
            shutil.rmtree(folder)
            raise
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``magloc`` with arguments in this process."""

    def run_in_process(*arguments: str | Path) -> Outcome:
        status = main([str(argument) for argument in arguments])
        return Outcome(status, *capsys.readouterr())

    return run_in_process


@pytest.fixture
def adcs(capsys: pytest.CaptureFixture[str]) -> Run:
    """Run ``adcs`` with arguments in this process."""

    def run_in_process(*arguments: str | Path) -> Outcome:
        status = adcs_main([str(argument) for argument in arguments])
        return Outcome(status, *capsys.readouterr())

    return run_in_process
