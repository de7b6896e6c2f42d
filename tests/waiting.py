"""Waiting for what other threads and processes do, however busy the machine is."""

from __future__ import annotations

import time
from collections.abc import Callable

WAIT_S = 300.0
"""After this long nobody waits for anything but in vain."""


def wait_for(condition: Callable[[], bool]) -> None:
    """Come back as soon as a condition holds."""
    end = time.monotonic() + WAIT_S
    while not condition():
        if time.monotonic() > end:
            raise TimeoutError(f"it did not happen within {WAIT_S:g} s")
        time.sleep(0.005)
