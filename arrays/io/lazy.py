"""Names of a package that are loaded when they are first used, so that importing the package costs nothing."""

from __future__ import annotations

import sys
from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:  # loading typing takes longer than all the rest of an import
    from collections.abc import Callable, Mapping
    from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package, from name to module.

    ``":module"`` is the module itself, ``"module:other"`` what it names otherwise.
    """

    def getattr_(name: str) -> object:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        where = modules[name]
        module, _, of_module = where.partition(":")
        value = getattr(import_module(module), of_module or name) if module else import_module(of_module)
        setattr(sys.modules[package], name, value)
        return value

    public = sorted(modules)
    return getattr_, lambda: public, public


def by_name(where: str) -> Callable[..., Any]:
    """A function named as ``module:function``: for what stands on a higher floor, such as the figure of a result."""
    module, _, name = where.partition(":")
    return getattr(import_module(module), name)
