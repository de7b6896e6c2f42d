"""Names of a package that are loaded when they are first used, so that importing the package costs nothing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` from name to module, ``":module"`` for the module itself."""

    def getattr_(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        where = modules[name]
        value = import_module(where[1:]) if where.startswith(":") else getattr(import_module(where), name)
        setattr(sys.modules[package], name, value)
        return value

    public = sorted(modules)
    return getattr_, lambda: public, public


def by_name(where: str) -> Callable[..., Any]:
    """A function named as ``module:function``: for what stands on a higher floor, such as the figure of a result."""
    module, _, name = where.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function
