"""Inputs of the GUI that both the user and the program write."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import viser

T = TypeVar("T")


class SharedInput(Generic[T]):
    """An input that follows something, and that the user may change; only the user's changes are acted on.

    viser calls an input's callbacks for what the program writes too. Whether a change was the user's is told by the
    value, not by a flag, because the two come in different threads.

    Parameters
    ----------
    handle : viser.GuiInputHandle
    on_user : callable
        Called after a change that the program did not write.
    """

    def __init__(self, handle: viser.GuiInputHandle[T], on_user: Callable[[], None]) -> None:
        self.handle = handle
        self._on_user = on_user
        self._written: T = handle.value
        handle.on_update(self._changed)

    def show(self, value: T) -> None:
        """Write a value without acting on it."""
        self._written = value
        set_value(self.handle, value)

    def _changed(self, _: object) -> None:
        if self.handle.value != self._written:
            self._on_user()


def set_value(handle: Any, value: object) -> None:
    """Write the value of an input. viser's setter is none to mypy, because it is decorated twice."""
    handle.value = value
