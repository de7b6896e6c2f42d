"""One thread of linear algebra: on small matrices the threads of BLAS mostly wait for each other.

:func:`guard_public` is applied to all public names of a package where they are loaded
(:func:`arrays.io.lazy.lazy_names`). Commands set it before BLAS loads.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable, Mapping
from functools import cached_property, wraps
from threading import Lock, local
from types import ModuleType
from typing import Any

import numpy as np  # noqa: F401 - numpy and scipy.linalg each load their own BLAS
import scipy.linalg  # noqa: F401
from threadpoolctl import ThreadpoolController

_BLAS = ThreadpoolController().select(user_api="blas").lib_controllers
_PACKAGES = ("arrays", "magloc", "adcs", "sims")
_SPECIAL = ("__init__", "__post_init__", "__call__", "__getitem__", "__repr__", "_repr_html_")
_guarded: set[object] = set()


class _OneThread:
    """Context of one thread of BLAS; the end of the last call in any thread restores the number."""

    def __init__(self) -> None:
        self._lock, self._calls = Lock(), 0
        self.of_thread = local()
        self._before: list[tuple[Any, int]] = []

    def __enter__(self) -> None:
        self.of_thread.calls = 1 + getattr(self.of_thread, "calls", 0)
        with self._lock:
            self._calls += 1
            if self._calls == 1:
                self._before = [(library, n) for library in _BLAS if (n := library.get_num_threads()) != 1]
                for library, _ in self._before:
                    library.set_num_threads(1)

    def __exit__(self, *_: object) -> None:
        self.of_thread.calls -= 1
        with self._lock:
            self._calls -= 1
            if not self._calls:
                for library, n in self._before:
                    library.set_num_threads(n)


one_blas_thread = _OneThread()


def guard_public(modules: Mapping[str, str]) -> None:
    """Guard the functions and classes of a table of public names whose modules are loaded."""
    for name, where in modules.items():
        module_name, _, of_module = where.partition(":")
        if module_name in sys.modules:
            _guard(sys.modules[module_name], of_module or name)
        elif not module_name and of_module in sys.modules:
            module = sys.modules[of_module]
            for own, value in list(vars(module).items()):
                if not own.startswith("_") and getattr(value, "__module__", "") == of_module:
                    _guard(module, own)


def _guard(module: ModuleType, name: str) -> None:
    value = getattr(module, name, None)
    if inspect.isfunction(value):
        setattr(module, name, _guard_function(value))
    elif inspect.isclass(value):
        for one in value.__mro__:
            if one not in _guarded and one.__module__.partition(".")[0] in _PACKAGES:
                _guarded.add(one)
                _guard_class(one)


def _guard_class(of: type) -> None:
    """Guard the methods and cached properties of a class; other properties compute nothing."""
    for name, value in list(vars(of).items()):
        if name.startswith("_") and name not in _SPECIAL:
            continue
        if isinstance(value, cached_property):
            value.func = _guard_function(value.func)
        elif isinstance(value, classmethod | staticmethod):
            setattr(of, name, type(value)(_guard_function(value.__func__)))
        elif inspect.isfunction(value):
            setattr(of, name, _guard_function(value))


def _guard_function(function: Callable[..., Any]) -> Callable[..., Any]:
    if function in _guarded or not inspect.isfunction(function):
        return function

    @wraps(function)
    def limited(*arguments: Any, **options: Any) -> Any:
        if getattr(one_blas_thread.of_thread, "calls", 0):  # our functions call each other often
            return function(*arguments, **options)
        with one_blas_thread:
            return function(*arguments, **options)

    @wraps(function)
    def limited_steps(*arguments: Any, **options: Any) -> Any:
        steps = function(*arguments, **options)
        try:
            while True:
                with one_blas_thread:
                    try:
                        value = next(steps)
                    except StopIteration as end:
                        return end.value
                yield value
        finally:
            steps.close()

    guarded = limited_steps if inspect.isgeneratorfunction(function) else limited
    _guarded.add(guarded)
    return guarded
