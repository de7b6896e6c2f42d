"""A time that runs when it is played: a slider, a play button and a speed that move together."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Lock, Thread, current_thread
from time import perf_counter

import numpy as np
import viser

from arrays.typing import BoolArray, FloatArray
from magloc.viewer.panels.inputs import SharedInput
from magloc.viewer.panels.latest import Latest
from magloc.viewer.scene.glyphs import round_length
from magloc.viewer.scene.legend import Colour, css

_STRIP_PARTS = 200
_ROUNDING = 1e-6  # of a part, or of a step of the slider; even times have one part each
_FRAMES_PER_SECOND = 15.0
_SPEEDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0)
_STEPS_OF_SLIDER = 1000.0
_WATCHED_S = 30.0  # how long the whole is played at first, at most


def time_strip(since_first_s: FloatArray, found: BoolArray, colour: Colour) -> str:
    """A strip along the time (n,) as HTML, coloured where all rows have found something: short gaps are seen."""
    n = min(_STRIP_PARTS, len(found))
    span = max(float(since_first_s[-1]), 1e-300)
    part = np.minimum((since_first_s / span * n + _ROUNDING).astype(np.intp), n - 1)
    rows, hits = np.bincount(part, minlength=n), np.bincount(part, found, minlength=n)
    stops = [css(colour) if count and hit == count else "#d5d9de" for count, hit in zip(rows, hits, strict=True)]
    cells = "".join(f'<div style="flex:1;background:{stop}"></div>' for stop in stops)
    return f'<div style="display:flex;height:0.6em;margin-top:0.4em">{cells}</div>'


class PlayedTime:
    """A time between 0 and a duration, which a thread of its own moves while it is played.

    Parameters
    ----------
    gui : viser.GuiApi
        The slider, the button and the speed are added where it is at present.
    duration_s : float
    show : callable
        Called whenever the time has moved, and never twice at once.
    name : str
        Of the thread.

    Attributes
    ----------
    now_s : float
        The time that is wanted.
    step_s : float
        Of the slider.
    """

    def __init__(self, gui: viser.GuiApi, duration_s: float, show: Callable[[], None], name: str) -> None:
        self.now_s = 0.0
        self._duration_s, self._follow, self._name = duration_s, Latest(show), name
        self._lock = Lock()
        self._stop = Event()
        self._thread: Thread | None = None
        still = duration_s == 0.0
        self.step_s = 1.0 if still else round_length(duration_s / _STEPS_OF_SLIDER)
        self.time_slider = gui.add_slider(
            "Time [s]", 0.0, max(duration_s, self.step_s), self.step_s, 0.0, disabled=still, hint="since the first row"
        )
        self.play_button = gui.add_button("Play", disabled=still)
        suitable = max(speed for speed in _SPEEDS if speed <= max(1.0, duration_s / _WATCHED_S))
        self.speed_dropdown = gui.add_dropdown(
            "Speed", [f"{speed:g} ×" for speed in _SPEEDS], initial_value=f"{suitable:g} ×"
        )
        self.loop_checkbox = gui.add_checkbox("Loop", False, disabled=still, hint="from the end to the beginning")
        self._time = SharedInput(self.time_slider, self._slid)
        self.play_button.on_click(self._switch)
        gui.add_command("Play or pause", hotkey="P", disabled=still).on_trigger(self._switch)

    def _switch(self, _: object) -> None:
        if self.is_playing:
            self.pause()
        else:
            self.play()

    def _slid(self) -> None:
        # The slider rounds: a row at its time is not to be missed by that.
        self.move_to(float(self.time_slider.value) + _ROUNDING * self.step_s)

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
            self.play_button.label = "Pause"
            self._thread.start()

    def pause(self) -> None:
        """Let time stand still, and end the thread."""
        with self._lock:
            thread, self._thread = self._thread, None
            self._stop.set()
            self.play_button.label = "Play"
        if thread is not None and thread is not current_thread():
            thread.join()

    def _run(self, stop: Event) -> None:
        last = perf_counter()
        try:
            while self.now_s < self._duration_s and not stop.wait(1.0 / _FRAMES_PER_SECOND):
                now = perf_counter()
                self.now_s += (now - last) * float(self.speed_dropdown.value.split()[0])
                if self.loop_checkbox.value and self.now_s >= self._duration_s:
                    self.now_s = 0.0
                last = now
                self._follow()
        finally:
            # Unless it was stopped, and started anew with another thread.
            if self._stop is stop:
                self.pause()
