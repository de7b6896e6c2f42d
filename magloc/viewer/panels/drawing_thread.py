"""Thread of a live page, which draws the newest state, so that new rows never wait for the page."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Thread


class DrawingThread(Thread):
    """Thread that draws each time it is woken, with a largest rate; it runs until it is closed.

    Parameters
    ----------
    draw : callable
        Function that draws the newest state. Its argument is False if nobody woke the thread. It returns the time until
        it has to draw again [s], or None to wait until the thread is woken.
    frames_per_second : float
        Largest rate.
    """

    def __init__(self, draw: Callable[[bool], float | None], frames_per_second: float) -> None:
        super().__init__(name="magloc-live-page", daemon=True)
        self._draw, self._pause_s = draw, 1.0 / frames_per_second
        self._new, self._closed = Event(), Event()
        self.start()

    def wake(self) -> None:
        """Draw soon, because there is a new state."""
        self._new.set()

    def close(self) -> None:
        """End the thread. Call this before the server is stopped."""
        self._closed.set()
        self._new.set()
        self.join()

    def run(self) -> None:
        """Draw until the thread is closed."""
        again_s: float | None = None
        while True:
            is_new = self._new.wait(again_s)
            if self._closed.is_set():
                return
            self._new.clear()
            again_s = self._draw(is_new)
            self._closed.wait(self._pause_s)
