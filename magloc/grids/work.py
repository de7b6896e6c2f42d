"""Independent items of work: computed here, in processes or on a cluster, with results cached in a folder."""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager
from functools import cache, partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import InputError
from arrays.io.text import replaced
from magloc.grids.cluster import check_address, worked_by
from magloc.grids.pool import process_pool

Arrays = Mapping[str, NDArray[Any]]
"""Result of the work on one item."""
Work = Callable[[Any], Arrays]
Each = Callable[[Work, Iterable[Any]], Iterator[tuple[int, Arrays]]]
"""Function that yields the numbers of items, in any order, with the results of the work on them."""
_LOG = logging.getLogger(__name__)
_CODE = (".py", ".so", ".dylib", ".dll", ".pyd")
_PER_PROCESS = 2  # items sent to each process: one that it computes, and the next one


def runner(scheduler: str | None) -> Callable[[Callable[[Any], Any], Iterable[Any]], Iterator[Any]]:
    """Return `map`, or the equivalent with the workers of a dask scheduler, which yields in any order."""
    if scheduler is None:
        return map
    check_address(scheduler)
    return partial(worked_by, scheduler)


@contextmanager
def workers(processes: int, scheduler: str | None, folder: Path | None) -> Iterator[Each]:
    """Provide a function that works on many items, in processes or by the workers of a dask scheduler.

    Results are cached in a folder. Work whose result is there is not done again, unless other code computed it.
    """
    if folder is not None and (older := [path for path in folder.glob("*.npz") if _code() not in path.name]):
        _LOG.warning(f"{folder}: {len(older)} finished parts are of another version of magloc and are computed again")
    with ExitStack() as stack:
        run = runner(scheduler)
        if scheduler is None and processes > 1:
            run = partial(_pooled, stack.enter_context(process_pool(processes)), _PER_PROCESS * processes)
        yield partial(_each, run, folder)


def _each(run: Callable[..., Iterator[Any]], folder: Path | None, work: Work, items: Iterable[Any]) -> Any:
    paths: dict[int, Path] = {}
    before: list[tuple[int, Arrays]] = []

    def not_done() -> Iterator[tuple[int, Any]]:
        for number, item in enumerate(items):
            if folder is not None:
                paths[number] = folder / f"{_code()}-{_key(work, item)}.npz"
                if (result := _read(paths[number])) is not None:
                    before.append((number, result))
                    continue
            yield number, item

    for number, result in run(partial(_numbered, work), not_done()):
        if folder is not None:
            _write(paths[number], result)
        yield number, result
    yield from before


def _pooled(pool: ProcessPoolExecutor, ahead: int, work: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    waiting = iter(items)
    try:
        running = {pool.submit(work, item) for item in islice(waiting, ahead)}
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            running |= {pool.submit(work, item) for item in islice(waiting, len(done))}
            yield from [future.result() for future in done]
    except BrokenProcessPool:
        raise InputError(
            "a process died, perhaps because memory ran out: use fewer processes. Your own script must start its work"
            " below `if __name__ == '__main__':`, because the processes import it."
        ) from None


def _numbered(work: Work, item: tuple[int, Any]) -> tuple[int, Arrays]:
    return item[0], work(item[1])


def _key(work: Work, item: Any) -> str:
    """Return the key of a cached result: a hash of all inputs that determine it."""
    return hashlib.sha256(pickle.dumps((work, item), protocol=5)).hexdigest()


@cache
def _code() -> str:
    """Return a hash of the installed code, which differs between two states of the same version."""
    digest = hashlib.sha256()
    for package in ("arrays", "magloc"):
        spec = find_spec(package)
        assert spec is not None
        for root in map(Path, spec.submodule_search_locations or ()):
            for path in sorted(each for each in root.rglob("*") if each.suffix in _CODE):
                digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def _read(path: Path) -> Arrays | None:
    """Read a cached result; None if it is missing or incomplete."""
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, BadZipFile, EOFError):
        return None


def _write(path: Path, result: Arrays) -> None:
    """Write a result to the cache, completely or not at all."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replaced(path) as written, written.open("wb") as file:
            np.savez(file, **result)  # type: ignore[arg-type]  # NumPy 2.0 does not have allow_pickle
    except OSError as error:
        raise InputError(f"{path} cannot be written ({error.strerror or error}).") from None
