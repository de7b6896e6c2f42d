"""Contexts that close resources, pause the garbage collector, or delay signals."""

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
    """Base of objects that a ``with`` block closes."""

    @abstractmethod
    def close(self) -> None:
        """Close open resources."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


@contextmanager
def pause_garbage_collection() -> Iterator[None]:
    """Pause the garbage collector while many lasting objects are made."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()


@contextmanager
def delay_signals() -> Iterator[None]:
    """Delay signals to the end of the block, in which they would cause other errors."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals only interrupt the main thread
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
