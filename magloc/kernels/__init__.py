"""Compiled hot loops. Each has a readable NumPy twin outside this package, and a test that the two agree.

This module holds the one set of compiler options that all kernels share:

- cached on disk, so that only the first run ever compiles;
- floating-point division by zero gives inf or NaN as in NumPy: Python's ZeroDivisionError would put a branch into each
  loop, and keep it from being vectorised;
- the compiler may fuse a multiplication and an addition into one instruction, which rounds once where two would round
  twice. All other fast-math liberties stay off: NaN and inf mean what IEEE 754 says, sums keep their order.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a serial kernel. Inside another kernel it is inlined, as a C function would be."""
    return cast(Function, njit(cache=True, error_model="numpy", fastmath={"contract"})(function))


def compiled_parallel(function: Function) -> Function:
    """Compile a kernel whose ``prange`` loops run on numba's threads."""
    return cast(Function, njit(parallel=True, cache=True, error_model="numpy", fastmath={"contract"})(function))
