"""Names of a package that load at their first use, so that importing the package is fast."""

from __future__ import annotations

import sys
from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:  # loading typing takes longer than all the rest of an import
    from collections.abc import Callable, Mapping
    from typing import Any

_tables: list[Mapping[str, str]] = []


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return ``__getattr__``, ``__dir__`` and ``__all__`` of a package, from name to module.

    ``":module"`` is the module itself, ``"module:other"`` an object with another name.
    """

    def getattr_(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, of_module = modules[name].partition(":")
        loaded = import_module(module or of_module)
        from arrays.blas_threads import guard_public

        for table in _tables:
            guard_public(table)
        value = getattr(loaded, of_module or name) if module else loaded
        setattr(sys.modules[package], name, value)
        return value

    _tables.append(modules)
    public = sorted(modules)
    return getattr_, lambda: public, public


def by_name(where: str) -> Callable[..., Any]:
    """Return a function by ``module:function``, such as the figure of a result on a higher floor."""
    module, _, name = where.partition(":")
    return getattr(import_module(module), name)
