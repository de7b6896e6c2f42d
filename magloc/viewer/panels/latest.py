"""Work that follows a moving hand: only the latest state counts, and nothing queues."""

from __future__ import annotations

from collections.abc import Callable
from threading import Lock


class Latest:
    """Runs work in the caller's thread, one run at a time; calls during a run lead to one more run after it.

    The work reads the state that it needs when it runs, so that the last run has seen the last state, however many
    calls came meanwhile. A call never waits for another.

    Parameters
    ----------
    work : callable
        Without arguments.
    """

    def __init__(self, work: Callable[[], None]) -> None:
        self._work = work
        self._lock = Lock()
        self._running = False
        self._asked_again = False

    def __call__(self, *_: object) -> None:
        """Run the work now, or leave it to the run that is under way. Arguments, such as events, do not count."""
        with self._lock:
            self._asked_again = True
            if self._running:
                return
            self._running = True
        while True:
            with self._lock:
                if not self._asked_again:
                    self._running = False
                    return
                self._asked_again = False
            try:
                self._work()
            except BaseException:
                with self._lock:
                    self._running = False
                raise
