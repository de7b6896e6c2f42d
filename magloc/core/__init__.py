"""Compiled kernels: C++17 behind one C header, called by thin modules of the rooms that use them.

A thin module checks shapes, allocates results, describes the problem (:func:`problem`) and computes its items
(:func:`run`). Users call its functions, not these. docs/development/kernels.md shows how to add a kernel.

Environment variables:

- MAGLOC_ISA: the instruction set, "baseline", "avx2" or "avx512" (default: the best one of the machine);
- MAGLOC_NUM_THREADS: the number of threads (default: NUMBA_NUM_THREADS, or all processors that the process may use);
- MAGLOC_KERNELS: another library, such as one built with sanitizers.
"""

from __future__ import annotations

import os
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arrays.io.errors import InputError
from magloc.core._declarations import ffi

if TYPE_CHECKING:
    from collections.abc import Iterable

_HERE = Path(__file__).parent
_SUFFIX = ".dll" if sys.platform == "win32" else ".so"
_lib: Any = ffi.dlopen(os.environ.get("MAGLOC_KERNELS") or str(_HERE / f"kernels{_SUFFIX}"))
_TYPES: dict[str, np.dtype[Any]] = {
    "double": np.dtype(np.float64),
    "float": np.dtype(np.float32),
    "int64_t": np.dtype(np.int64),
    "uint8_t": np.dtype(np.uint8),
}


class Problem:
    """A C struct that describes a problem, and the arrays and structs that it points to."""

    def __init__(self, kind: str, fields: dict[str, Any]) -> None:
        struct, types = _type_and_fields(kind)
        if fields.keys() != types.keys():
            raise TypeError(f"magloc_{kind} has the fields {[*types]}; instead received {[*fields]}")
        self.kind, self.kept = kind, fields
        self.struct = ffi.new(struct, {name: _c_value(name, types[name], value) for name, value in fields.items()})

    def with_fields(self, **changed: Any) -> Problem:
        """Return a copy with other values of some fields, in less time than a new problem takes."""
        struct, types = _type_and_fields(self.kind)
        copy = object.__new__(Problem)
        copy.kind, copy.kept = self.kind, self.kept | changed
        copy.struct = ffi.new(struct, self.struct[0])
        for name, value in changed.items():
            setattr(copy.struct, name, _c_value(name, types[name], value))
        return copy


@lru_cache  # readings that come one by one describe the same kinds of problems again and again
def _type_and_fields(kind: str) -> tuple[Any, dict[str, tuple[Any, np.dtype[Any] | None]]]:
    """Return the type of a pointer to a struct, and the C types of its array fields and of their elements."""
    types: dict[str, tuple[Any, np.dtype[Any] | None]] = {}
    for name, field in ffi.typeof(f"magloc_{kind}").fields:
        element = field.type.item.cname if field.type.kind == "pointer" else ""
        types[name] = (ffi.typeof(f"{element}[]"), _TYPES[element]) if element in _TYPES else (None, None)
    return ffi.typeof(f"magloc_{kind} *"), types


def _c_value(name: str, types: tuple[Any, np.dtype[Any] | None], value: Any) -> Any:
    """Return a field's value as cffi takes it: an array as a C array of the field's type."""
    if isinstance(value, np.ndarray):
        array_type, wanted = types
        flags = value.flags
        if value.dtype != wanted or not flags.c_contiguous or not flags.aligned:
            raise TypeError(f"{name} must be a C-contiguous array of {wanted}; instead received {value.dtype}")
        return ffi.from_buffer(array_type, value)
    if isinstance(value, Problem):
        return value.struct
    return ffi.NULL if value is None else value


def problem(kind: str, **fields: Any) -> Problem:
    """
    Describe a problem to a kernel.

    Parameters
    ----------
    kind : str
        Name of the struct in magloc.h, without "magloc_".
    **fields
        All fields of the struct: numbers, tuples of numbers, arrays in C order of the type that the header states, and
        structs that are Problems themselves. None is a null pointer.

    Returns
    -------
    Problem
        The struct; it keeps what it points to alive.

    Raises
    ------
    TypeError
        If a field is missing or unknown, or an array has another type or order.
    """
    return Problem(kind, fields)


def workspace_size(kernel: str, work: Problem) -> int:
    """Return how many doubles the workspace of a kernel has."""
    return int(getattr(_lib, f"magloc_{kernel}")(work.struct, 0, 0, ffi.NULL))


def new_workspace(kernel: str, work: Problem) -> Any:
    """Return a workspace for :func:`run`, to be used by one thread again and again."""
    return ffi.new("double[]", workspace_size(kernel, work) + 1)


def run(
    kernel: str, work: Problem, n: int, *, block: int, chain: int | None = None, workspace: Any | None = None
) -> None:
    """
    Compute the items 0 to n - 1 of a problem, by several threads if there is more than one block.

    The interpreter's lock is released, and Ctrl-C acts between blocks.

    Parameters
    ----------
    kernel : str
        Name of the function in magloc.h, without "magloc_".
    work : Problem
        What the kernel computes.
    n : int
        Number of items.
    block : int
        Number of items that one call computes. It should take 1 to 100 ms.
    chain : int, optional
        Number of items that depend on each other, such as the steps of a filter. One thread computes them in order, and
        the workspace is the same for all of them.
    workspace : optional
        Of :func:`new_workspace`, or an array of as many doubles, where there is one chain or block; by default a new
        one.
    """
    function = getattr(_lib, f"magloc_{kernel}")
    if isinstance(workspace, np.ndarray):
        workspace = ffi.from_buffer("double[]", workspace)
    if 0 < n <= block:
        function(work.struct, 0, n, new_workspace(kernel, work) if workspace is None else workspace)
        return
    chain = chain or block
    parts = range(0, n, chain)
    n_threads = min(threads(), len(parts))
    stopped = False

    def compute(parts: Iterable[int]) -> None:
        space = new_workspace(kernel, work) if workspace is None else workspace
        for part in parts:
            end = min(part + chain, n)
            for begin in range(part, end, block):
                if not stopped:
                    function(work.struct, begin, min(begin + block, end), space)

    if n_threads <= 1:
        compute(parts)
        return
    shared = iter(parts)  # one job a thread: Ctrl-C while a job is queued can break a lock of the pool
    with ThreadPoolExecutor(n_threads) as pool:
        try:
            for done in [pool.submit(compute, shared) for _ in range(n_threads)]:
                done.result()
        except BaseException:
            stopped = True
            pool.shutdown(wait=False, cancel_futures=True)
            raise


def threads() -> int:
    """Return the number of threads that kernels use."""
    return _threads


def set_threads(n: int) -> None:
    """Set the number of threads that kernels use."""
    global _threads
    _threads = n


def _available_threads() -> int:
    for variable in ("MAGLOC_NUM_THREADS", "NUMBA_NUM_THREADS"):
        if wanted := os.environ.get(variable):
            if not (wanted.isascii() and wanted.isdecimal() and int(wanted[:9]) > 0):
                raise InputError(f"Environment variable {variable}: found {wanted!r:.40}, expected a number above 0.")
            return int(wanted[:9])
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


_threads = _available_threads()


def instruction_set() -> str:
    """Return the instruction set in use: "baseline", "avx2" or "avx512"."""
    return str(ffi.string(_lib.magloc_instruction_set()).decode())


def use_instruction_set(name: str) -> None:
    """
    Use an instruction set by its name.

    Raises
    ------
    ValueError
        If this machine or build does not have it.
    """
    if _lib.magloc_use_instruction_set(name.encode()):
        raise ValueError(f"Instruction set {name!r} is unknown, or this machine or build does not have it.")


def include_dir() -> Path:
    """Return the folder of the C and C++ headers of magloc and adcs, for the compiler's option -I."""
    return _HERE / "include"


if _wanted := os.environ.get("MAGLOC_ISA"):
    try:
        use_instruction_set(_wanted)
    except ValueError:
        raise InputError(
            f"Environment variable MAGLOC_ISA: found {_wanted!r:.40}, expected baseline, avx2 or avx512, as far as this"
            " machine and build have them."
        ) from None
