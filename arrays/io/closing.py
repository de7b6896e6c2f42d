"""What is closed, goes on again, or is first heard of, at the end of a block."""

from __future__ import annotations

import gc
import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Self


class Closing(ABC):
    """A context manager that closes itself."""

    @abstractmethod
    def close(self) -> None:
        """Give back what is held."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


@contextmanager
def garbage_waits() -> Iterator[None]:
    """While many objects are made that stay: the collector would look at all of them, again and again."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Let signals wait for the end of the block: compiled code and writing would fail with errors of their own."""
    if threading.current_thread() is not threading.main_thread():
        yield  # which no signal interrupts
        return
    signals: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: signals.append(number)) or signal.SIG_DFL
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if signals:
        signal.raise_signal(signals[0])
