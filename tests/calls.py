"""How much interpreted work something does: the same number on every machine, however busy."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable


def calls_of(action: Callable[[], object]) -> int:
    """Calls of functions, interpreted and built in, by an action that has run before: compiling is not counted.

    The least of three counts: what else this thread is made to do in between only adds to one of them.
    """
    action()
    return min(_counted(action) for _ in range(3))


def _counted(action: Callable[[], object]) -> int:
    count = 0

    def one_more(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    # What the collector finalises of others in between is none of it.
    gc.disable()
    sys.setprofile(one_more)
    try:
        action()
    finally:
        sys.setprofile(None)
        gc.enable()
    return count
