"""A time that runs when it is played: what a play button, a slider and a speed move together."""

from __future__ import annotations

from threading import Event, Lock, Thread, current_thread
from time import perf_counter

import numpy as np
import viser

from arrays.typing import BoolArray, FloatArray
from magloc.viewer.panels.latest import Latest
from magloc.viewer.scene.legend import Colour, css

_STRIP_PARTS, _ROUNDING = 200, 1e-9  # of a part; even times have one each
_FRAMES_PER_SECOND = 15.0


def time_strip(since_first_s: FloatArray, found: BoolArray, colour: Colour) -> str:
    """A strip along the time (n,) as HTML, coloured where all rows have found something: short gaps are seen."""
    n = min(_STRIP_PARTS, len(found))
    span = max(float(since_first_s[-1]), 1e-300)
    part = np.minimum((since_first_s / span * n + _ROUNDING).astype(np.intp), n - 1)
    rows, hits = np.bincount(part, minlength=n), np.bincount(part, found, minlength=n)
    stops = [css(colour) if count and hit == count else "#d5d9de" for count, hit in zip(rows, hits, strict=True)]
    cells = "".join(f'<div style="flex:1;background:{stop}"></div>' for stop in stops)
    return f'<div style="display:flex;height:0.6em;margin-top:0.4em">{cells}</div>'


def speed_text(speed: float) -> str:
    """A speed as an entry of a dropdown."""
    return f"{speed:g} ×"


class PlayedTime:
    """A time between 0 and a duration, which a thread of its own moves while it is played.

    Parameters
    ----------
    duration_s : float
    follow : Latest
        Called whenever the time has moved.
    button : viser.GuiButtonHandle
        Plays and pauses, and says which.
    speed : viser.GuiDropdownHandle
        Its entries are made by :func:`speed_text`.
    name : str
        Of the thread.

    Attributes
    ----------
    now_s : float
        The time that is wanted.
    """

    def __init__(
        self,
        duration_s: float,
        follow: Latest,
        button: viser.GuiButtonHandle,
        speed: viser.GuiDropdownHandle[str],
        name: str,
    ) -> None:
        self.now_s = 0.0
        self._duration_s, self._follow, self._name = duration_s, follow, name
        self._button, self._speed = button, speed
        self._lock = Lock()
        self._stop = Event()
        self._thread: Thread | None = None
        button.on_click(lambda _: self.pause() if self.is_playing else self.play())

    @property
    def is_playing(self) -> bool:
        """Whether time runs."""
        return self._thread is not None and not self._stop.is_set()

    def move_to(self, time_s: float) -> None:
        """Move to a time; those before 0 and after the end are these."""
        self.now_s = min(max(time_s, 0.0), self._duration_s)
        self._follow()

    def play(self) -> None:
        """Let time run, from the beginning if it is at the end."""
        with self._lock:
            if self.is_playing or self._duration_s == 0.0:
                return
            if self.now_s >= self._duration_s:
                self.now_s = 0.0
            # An event of its own for every thread: one that is about to end must not go on with the next.
            self._stop = Event()
            self._thread = Thread(target=self._run, args=(self._stop,), name=self._name, daemon=True)
            self._button.label = "Pause"
            self._thread.start()

    def pause(self) -> None:
        """Let time stand still, and end the thread."""
        with self._lock:
            thread, self._thread = self._thread, None
            self._stop.set()
            self._button.label = "Play"
        if thread is not None and thread is not current_thread():
            thread.join()

    def _run(self, stop: Event) -> None:
        last = perf_counter()
        try:
            while self.now_s < self._duration_s and not stop.wait(1.0 / _FRAMES_PER_SECOND):
                now = perf_counter()
                self.now_s += (now - last) * float(self._speed.value.split()[0])
                last = now
                self._follow()
        finally:
            # Unless it was stopped, and started anew with another thread.
            if self._stop is stop:
                self.pause()
