"""Compiled hot loops. Each has a readable NumPy twin outside this package, and a test that the two agree.

This module holds the one set of compiler options that all kernels share:

- cached on disk, so that only the first run ever compiles;
- floating-point division by zero gives inf or NaN as in NumPy: Python's ZeroDivisionError would put a branch into each
  loop, and keep it from being vectorised;
- the compiler may fuse a multiplication and an addition into one instruction, which rounds once where two would round
  twice. All other fast-math liberties stay off: NaN and inf mean what IEEE 754 says, sums keep their order.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import Any, TypeVar, cast

import numpy as np
from numba import get_num_threads, njit
from numba.core import event

from arrays.typing import FloatArray

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
        """Say nothing."""


event.register("numba:compile", _Announcement())  # type: ignore[no-untyped-call]


def compiled(function: Function) -> Function:
    """Compile a serial kernel. Inside another kernel it is inlined, as a C function would be."""
    return cast(Function, njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})(function))


def compiled_parallel(function: Function) -> Function:
    """Compile a kernel whose ``prange`` loops run on numba's threads."""
    return cast(Function, njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract"})(function))


def over_rows(kernel: Callable[..., None], n_rows: int, *arguments: Any) -> None:
    """Run a serial kernel ``kernel(begin, end, *arguments)`` on all rows, with as many threads as numba has.

    For large kernels: a ``prange`` loop around one more than doubles the time that it takes to compile. The kernel is
    made by :func:`compiled`, which lets go of the interpreter's lock, and writes rows begin to end only.
    """
    n_threads = min(get_num_threads(), n_rows)
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


# Numba compiles a function once more for every literal integer that it is called with; a converted one is no literal.
runtime_int = cast(Callable[[int], int], np.int64)
