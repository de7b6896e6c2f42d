"""Coalesced calls for work that follows the user's hand: only the latest state matters, and no calls queue."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock


class CoalescedCall:
    """Callable that runs its work; calls during a run are merged into one more run after it.

    The work reads the present state, so that the last run uses the last state, however many calls came meanwhile. A
    call never waits for another one.

    Parameters
    ----------
    work : callable
        Function without arguments.
    """

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._lock = Lock()
        self._is_running = False
        self._is_pending = False

    def __call__(self, *_: object) -> None:
        """Run the work now, or after the present run; arguments, such as events, are ignored."""
        with self._lock:
            self._is_pending = True
            if self._is_running:
                return
            self._is_running = True
        while True:
            with self._lock:
                if not self._is_pending:
                    self._is_running = False
                    return
                self._is_pending = False
            try:
                self._work()
            except BaseException:
                with self._lock:
                    self._is_running = False
                raise
