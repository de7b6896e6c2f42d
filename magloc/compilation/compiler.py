"""What numba does anew for every kernel, done once: two thirds of a first call remain, and kernels compute the same.

- A function that Python never calls (:func:`internal_options`) is optimised and becomes machine code inside the kernels
  that call it. numba would do both for the function, too, and for those between.
- The types of sums of numbers and of elements of arrays are looked up first where numba looks last, behind some ten
  other kinds of operands, thousands of times (:class:`QuickTyping`).

numba's ``pipeline_class``, ``infer_global`` and events let it in. What is replaced deeper inside is looked for before;
where it is not found, kernels are compiled as numba does.
"""

from __future__ import annotations

import operator
from contextlib import suppress
from functools import cache
from typing import Any

import numba
from numba.core import caching, codegen, compiler, event

_Library: Any = getattr(codegen, "JITCodeLibrary", object)  # numba has no types
_Compiler: Any = compiler.Compiler
_Implementation: Any = caching.CompileResultCacheImpl
_REPLACED = (
    "_optimize_functions",
    "_optimize_final_module",
    "_finalize_final_module",
    "_finalize_dynamic_globals",
    "get_pointer_to_function",
    "serialize_using_object_code",
    "serialize_using_bitcode",
)
# Versions whose compiler this was tried with: a later one may do with these parts what nobody has seen.
_TRIED = numba.version_info.short < (0, 69)
CAN_LINK_ONLY = (
    _TRIED and all(hasattr(_Library, name) for name in _REPLACED) and hasattr(codegen.JITCPUCodegen, "_library_class")
)
_OF_NUMBERS = frozenset(
    (
        *(operator.add, operator.sub, operator.mul, operator.truediv, operator.neg),
        *(operator.iadd, operator.isub, operator.imul, operator.itruediv),
        *(operator.lt, operator.le, operator.gt, operator.ge),  # not ==, which has rules of its own for literals
    )
)
_environments: dict[str, tuple[Any, Any]] = {}  # of functions whose code is not in this process yet
_addresses: set[str] = set()  # of kernels, as the names have it under which numba puts them into code, unread


def is_kernel(made: Any) -> None:
    """Note what other kernels may call."""
    _addresses.add(f"{id(made):x}")


def internal_options() -> dict[str, Any]:
    """Options of ``njit`` for a function that only kernels call."""
    return {"no_cpython_wrapper": True, **({"pipeline_class": _LinkOnlyCompiler} if CAN_LINK_ONLY else {})}


class _LinkOnly(_Library):  # type: ignore[misc]
    """Code of such a function, as it is handed to the kernels that call it."""

    _dynamic_globals: list[str]
    _finalized: bool
    _linking_libraries: list[Any]
    _codegen: Any

    def _optimize_functions(self, module: Any) -> None:
        module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        pass

    def _finalize_final_module(self) -> None:
        self._finalize_dynamic_globals()  # addresses, which mean nothing in another process
        known = {name for library in self._linking_libraries for name in getattr(library, "unread", ())}
        names = self._dynamic_globals
        self.unread = {name for name in names if name in known or not _addresses.isdisjoint(name.split("."))}
        self._dynamic_globals = [name for name in names if name not in self.unread]
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        """None: there is no machine code."""
        return 0

    def serialize_using_object_code(self) -> Any:
        """For numba's files: what comes before machine code."""
        return self.serialize_using_bitcode()

    @property
    def codegen(self) -> _LinkOnly:
        """Whom numba asks to set the environment of a finished function."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Keep it until the function is part of a kernel."""
        _environments[name] = self._codegen, environment


class _LinkOnlyCompiler(_Compiler):  # type: ignore[misc]
    """numba's compiler, with a library of that kind."""

    def __init__(self, typing: Any, target: Any, library: Any, *arguments: Any) -> None:
        library = _LinkOnly(target.codegen(), "internal")
        library.enable_object_caching()
        super().__init__(typing, target, library, *arguments)


class LinkOnlyFiles(_Implementation):  # type: ignore[misc]
    """Such libraries in numba's files, under names of their own: one may be compiled for Python, too."""

    def get_filename_base(self, *arguments: Any) -> str:
        """What a name begins with."""
        return f"internal-{super().get_filename_base(*arguments)}"

    def rebuild(self, target: Any, payload: Any) -> Any:
        """A function as it was saved; the compiler's lock is held."""
        generator = target.codegen()
        generator._library_class = _LinkOnly
        try:
            made = super().rebuild(target, payload)
        finally:
            del generator._library_class
        made.library.unread, made.library._dynamic_globals = {*made.library._dynamic_globals}, []  # else not in a file
        return made


class Environments(event.Listener):
    """Gives internal functions their environments, once they are part of a kernel."""

    def on_start(self, event: event.Event) -> None:
        """Nothing: there is no code yet."""

    def on_end(self, event: event.Event) -> None:
        """Set those of which there is code now."""
        for name, (generator, environment) in list(_environments.items()):
            if generator._engine.is_symbol_defined(name):
                generator.set_env(name, environment)
                del _environments[name]


class QuickTyping(event.Listener):
    """Lets numba try first what nearly all operands of a kernel are; the rules are its own."""

    def on_start(self, event: event.Event) -> None:
        """Before the first function is compiled."""
        with suppress(AttributeError, ImportError):
            _register()

    def on_end(self, event: event.Event) -> None:
        """Nothing."""


@cache
def _register() -> None:
    """Register rules once more, for these operands alone and for this target: numba asks those of a target first."""
    from numba.core import types  # slow to import, and of no use where kernels are on disk
    from numba.core.typing import arraydecl, templates

    def is_plain(array: Any, index: Any) -> bool:
        parts: Any = index if isinstance(index, types.BaseTuple) else [index]
        return (
            isinstance(array, types.Array)
            and isinstance(array.dtype, types.Number | types.Boolean)
            and all(isinstance(part, types.Integer | types.SliceType) for part in parts)
        )

    def of_arrays(rule: Any) -> Any:
        def generic(self: Any, args: Any, kws: Any) -> Any:
            return rule.generic(self, args, kws) if is_plain(*args[:2]) else None

        return type("OfArrays", (rule,), {"generic": generic, **first})

    register: Any = templates.infer_global
    first = {"metadata": {"target": "cpu"}}
    for operation, kind in list(templates.builtin_registry.globals):
        if operation in _OF_NUMBERS:
            for rule in kind.templates:
                if issubclass(rule, templates.ConcreteTemplate):
                    register(operation)(type("OfNumbers", (rule,), {"exact_match_required": True, **first}))
    register(operator.getitem)(of_arrays(arraydecl.GetItemBuffer))
    register(operator.setitem)(of_arrays(arraydecl.SetItemBuffer))
