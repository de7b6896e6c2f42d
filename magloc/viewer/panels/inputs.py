"""Inputs of the GUI that both the user and the program change."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import viser

T = TypeVar("T")


class SharedInput(Generic[T]):
    """Input whose callback is called for changes by the user only.

    viser calls the callbacks of an input for changes by the program too. The value distinguishes the two, not a flag,
    because they come from different threads.

    Parameters
    ----------
    handle : viser.GuiInputHandle
    on_user : callable
        Called after a change by the user.
    """

    def __init__(self, handle: viser.GuiInputHandle[T], on_user: Callable[[], None]) -> None:
        self.handle = handle
        self._on_user = on_user
        self._program_value: T = handle.value
        handle.on_update(self._on_update)

    def show(self, value: T) -> None:
        """Set the value without a call of the callback."""
        self._program_value = value
        set_value(self.handle, value)

    def _on_update(self, _: object) -> None:
        if self.handle.value != self._program_value:
            self._on_user()


def set_value(handle: Any, value: object) -> None:
    """Set the value of an input; mypy does not know viser's setter, which has two decorators."""
    handle.value = value
