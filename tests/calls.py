"""How much interpreted work something does: the same number on every machine, however busy."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable


def calls_of(action: Callable[[], object]) -> int:
    """Calls of functions, interpreted and built in, by an action that has run before: compiling is not counted."""
    action()
    count = 0

    def one_more(frame: object, event: str, argument: object) -> None:
        nonlocal count
        count += event in ("call", "c_call")

    # What the collector finalises of others in between is none of it.
    gc.collect()
    gc.disable()
    sys.setprofile(one_more)
    try:
        action()
    finally:
        sys.setprofile(None)
        gc.enable()
    return count
