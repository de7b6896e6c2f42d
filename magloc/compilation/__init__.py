"""Compiled hot loops, each held by a test to a readable twin or an oracle: docs/development/index.md says which.

This module holds the one set of compiler options that all kernels share:

- cached on disk, so that only the first run ever compiles;
- floating-point division by zero gives inf or NaN as in NumPy: Python's ZeroDivisionError would put a branch into each
  loop, and keep it from being vectorised;
- the compiler may fuse a multiplication and an addition into one instruction, which rounds once where two would round
  twice. All other fast-math liberties stay off: NaN and inf mean what IEEE 754 says, sums keep their order.
"""

from __future__ import annotations

import atexit
import gc
import inspect
import logging
import os
import shutil
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, cached_property, partial
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np
from numba import config, get_num_threads, njit
from numba.core import caching, event

from arrays.typing import FloatArray
from magloc.compilation import compiler

Function = TypeVar("Function", bound=Callable[..., Any])
_LOG = logging.getLogger(__name__)
COMPILING = "compiling for this machine, up to a minute; later calls start at once, and warm-up does it ahead"


class _Announcement(event.Listener):
    """Says once a process that something is compiled, which nobody should have to guess from a minute of silence."""

    said = False

    def on_start(self, event: event.Event) -> None:
        """Say so, the first time."""
        if not self.said:
            self.said = True
            _LOG.info(COMPILING)

    def on_end(self, event: event.Event) -> None:
        """Nothing: results say that it is over."""


class _GarbageWaits(event.Listener):
    """Garbage is not collected while something is compiled.

    Of all that the compiler makes hardly anything is, and the search for it takes a tenth of the time. A kernel waits
    for those that it calls, so that events are nested.
    """

    collects = False
    depth = 0

    def on_start(self, event: event.Event) -> None:
        """Let it wait."""
        if self.depth == 0:
            self.collects = gc.isenabled()
            gc.disable()
        self.depth += 1

    def on_end(self, event: event.Event) -> None:
        """Collect garbage again, if that was so before."""
        self.depth -= 1
        if self.depth == 0 and self.collects:
            gc.enable()


for _listener in (_Announcement(), _GarbageWaits(), compiler.QuickTyping(), compiler.Environments()):
    event.register("numba:compile", _listener)  # type: ignore[no-untyped-call]


_NumbasCache: Any = caching.FunctionCache  # which has no types
_NumbasFiles: Any = caching.IndexDataCacheFile


def _made_of(kernel: Any) -> tuple[Any, ...]:
    """Stamps of the files of all kernels that one calls, and the constants that are compiled into them."""
    files, constants, known, left = {}, [], {kernel}, [kernel]
    while left:
        function = left.pop()
        path, variables = function.__code__.co_filename, inspect.getclosurevars(function)
        with suppress(OSError):
            status = os.stat(path)
            files[os.path.basename(path), function.__module__] = status.st_mtime, status.st_size
        for name, value in {**variables.globals, **variables.nonlocals}.items():
            called = getattr(value, "py_func", None)
            if called is not None and called not in known:
                known.add(called)
                left.append(called)
            elif isinstance(value, int | float | np.generic | tuple | np.ndarray):
                value = (value.shape, value.dtype.str, value.tolist()) if isinstance(value, np.ndarray) else value
                constants.append((function.__qualname__, name, repr(value)))
    return tuple(sorted(files.items())), tuple(sorted(constants))


class _Cache(_NumbasCache):  # type: ignore[misc]
    """numba's cache of a function, but a damaged file is compiled anew, and one that cannot be written is no error.

    numba looks for changes in the function's own file alone; here those of what it calls count, too.
    """

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        del self._cache_file

    @cached_property
    def _cache_file(self) -> Any:
        """The index, once all that the function calls is defined."""
        stamp = self._impl.locator.get_source_stamp(), _made_of(self._py_func)
        return _NumbasFiles(self._cache_path, self._impl.filename_base, stamp)

    def load_overload(self, *arguments: Any) -> Any:
        """What was compiled for these types, if it is there and whole."""
        try:
            return super().load_overload(*arguments)
        except Exception:  # a file that is cut short may mean anything to pickle
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, *arguments: Any) -> None:
        """Keep what was compiled, if there is room for it."""
        try:
            super().save_overload(*arguments)
        except OSError as error:
            _say_not_kept(f"{self.cache_path}: {error.strerror or error}")
            self.disable()


class _InternalCache(_Cache):
    """The same of a function that only kernels call."""

    _impl_class = compiler.LinkOnlyFiles


@cache
def _say_not_kept(reason: str) -> None:
    """Say once in a process why the next one compiles again."""
    _LOG.warning("compiled code cannot be kept for the next run (%s)", reason)


def cached(made: Any, kind: type[_Cache] = _Cache) -> Any:
    """Let a compiled function be kept on disk; for this process and its children alone if no place can be written."""
    if not hasattr(made, "enable_caching"):
        return made  # compiling is switched off
    compiler.is_kernel(made)
    try:
        made._cache = kind(made.py_func)
    except RuntimeError:  # "no locator available"
        folder = tempfile.mkdtemp(prefix="magloc-numba-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        config.CACHE_DIR = os.environ["NUMBA_CACHE_DIR"] = folder  # type: ignore[attr-defined]
        _say_not_kept("neither beside the package nor in the user's folder can files be made")
        made._cache = kind(made.py_func)
    return made


# No kernel is called through a C pointer, for which numba would compile a wrapper of each.
_njit = partial(cast(Any, njit), error_model="numpy", fastmath={"contract"}, no_cfunc_wrapper=True)


def compiled(function: Function) -> Function:
    """Compile a serial kernel. Inside another kernel it is inlined, as a C function would be."""
    return cast(Function, cached(_njit(nogil=True)(function)))


def internal(function: Function, **options: Any) -> Function:
    """Compile a kernel that others call and Python cannot, which is optimised inside them alone."""
    kind = _InternalCache if compiler.CAN_LINK_ONLY else _Cache
    return cast(Function, cached(_njit(**compiler.internal_options(), **options)(function), kind))


def inlined_sum(function: Function) -> Function:
    """Compile a sum whose terms may be added in any order, which lets vector instructions do it."""
    return internal(function, forceinline=True, fastmath={"contract", "reassoc"})


def compiled_parallel(function: Function) -> Function:
    """Compile a kernel whose ``prange`` loops run on numba's threads."""
    return cast(Function, cached(_njit(parallel=True)(function)))


def over_rows(kernel: Callable[..., None], n_rows: int, *arguments: Any, rows_a_thread: int = 1) -> None:
    """Run a serial kernel ``kernel(begin, end, *arguments)`` on all rows, with as many threads as numba has.

    For large kernels: a ``prange`` loop around one more than doubles the time that it takes to compile. The kernel is
    made by :func:`compiled`, which lets go of the interpreter's lock, and writes rows begin to end only. To begin
    threads takes as long as some kernels of few rows: a thread is begun for `rows_a_thread` at least.
    """
    n_threads = 1 if n_rows < 2 * rows_a_thread else min(get_num_threads(), n_rows // rows_a_thread)
    if n_threads <= 1:
        kernel(0, n_rows, *arguments)
        return
    n_parts = min(4 * n_threads, n_rows)
    edges = [n_rows * i // n_parts for i in range(n_parts + 1)]
    with ThreadPoolExecutor(n_threads) as pool:
        for done in [pool.submit(kernel, *part, *arguments) for part in pairwise(edges)]:
            done.result()


def own(values: FloatArray) -> FloatArray:
    """A contiguous copy that may be written: kernels are compiled anew, for seconds, for arrays of any other kind."""
    return np.array(values, order="C")


def readable(values: FloatArray) -> FloatArray:
    """The same for a kernel that only reads: no copy where the array is of that kind."""
    return values if values.flags.carray else own(values)
