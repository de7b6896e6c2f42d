"""Player of a time: slider, play button and speed."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event, Lock, Thread, current_thread
from time import perf_counter

import numpy as np
import viser

from arrays.typing import BoolArray, FloatArray
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.inputs import SharedInput
from magloc.viewer.scene.glyphs import round_length
from magloc.viewer.scene.legend import Colour, css

_STRIP_PARTS = 200
_ROUNDING = 1e-6  # in parts of the strip or steps of the slider
_FRAMES_PER_SECOND = 15.0
_SPEEDS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0, 1000.0)
_STEPS_OF_SLIDER = 1000.0
_LONGEST_PLAY_S = 30.0  # at the initial speed


def time_strip(since_first_s: FloatArray, is_good: BoolArray, colour: Colour) -> str:
    """Return a strip along the time (n,) as HTML, coloured in parts where all rows are good."""
    n = min(_STRIP_PARTS, len(is_good))
    span = max(float(since_first_s[-1]), 1e-300)
    part = np.minimum((since_first_s / span * n + _ROUNDING).astype(np.intp), n - 1)
    rows, n_good = np.bincount(part, minlength=n), np.bincount(part, is_good, minlength=n)
    colours = [css(colour) if count and good == count else "#d5d9de" for count, good in zip(rows, n_good, strict=True)]
    cells = "".join(f'<div style="flex:1;background:{part_colour}"></div>' for part_colour in colours)
    return f'<div style="display:flex;height:0.6em;margin-top:0.4em">{cells}</div>'


class TimePlayer:
    """Player of a time between 0 and a duration, in a separate thread.

    Parameters
    ----------
    gui : viser.GuiApi
        Slider, button and speed are added to its present container.
    duration_s : float
    show : callable
        Called after every change of the time, never twice at once.
    name : str
        Name of the thread.

    Attributes
    ----------
    now_s : float
        Present time [s].
    step_s : float
        Step of the slider [s].
    """

    def __init__(self, gui: viser.GuiApi, duration_s: float, show: Callable[[], None], name: str) -> None:
        self.now_s = 0.0
        self._duration_s, self._follow, self._name = duration_s, CoalescedCall(show), name
        self._lock = Lock()
        self._stop = Event()
        self._thread: Thread | None = None
        still = duration_s == 0.0
        self.step_s = 1.0 if still else round_length(duration_s / _STEPS_OF_SLIDER)
        self.time_slider = gui.add_slider(
            "Time [s]", 0.0, max(duration_s, self.step_s), self.step_s, 0.0, disabled=still, hint="since the first row"
        )
        self.play_button = gui.add_button("Play", disabled=still)
        initial = max(speed for speed in _SPEEDS if speed <= max(1.0, duration_s / _LONGEST_PLAY_S))
        self.speed_dropdown = gui.add_dropdown(
            "Speed", [f"{speed:g} ×" for speed in _SPEEDS], initial_value=f"{initial:g} ×"
        )
        self.loop_checkbox = gui.add_checkbox("Loop", False, disabled=still, hint="from the end to the beginning")
        self._time = SharedInput(self.time_slider, self._on_slider)
        self.play_button.on_click(self._on_play)
        gui.add_command("Play or pause", hotkey="P", disabled=still).on_trigger(self._on_play)

    def _on_play(self, _: object) -> None:
        if self.is_playing:
            self.pause()
        else:
            self.play()

    def _on_slider(self) -> None:
        # The margin includes a row whose time the slider has rounded down.
        self.move_to(float(self.time_slider.value) + _ROUNDING * self.step_s)

    @property
    def is_playing(self) -> bool:
        """Return whether the time runs."""
        return self._thread is not None and not self._stop.is_set()

    def move_to(self, time_s: float) -> None:
        """Move to a time, limited to the duration."""
        self.now_s = min(max(time_s, 0.0), self._duration_s)
        self._follow()

    def play(self) -> None:
        """Run the time, from the beginning if it is at the end."""
        with self._lock:
            if self.is_playing or self._duration_s == 0.0:
                return
            if self.now_s >= self._duration_s:
                self.now_s = 0.0
            # Every thread has its own event, so that an ending thread does not continue after a restart.
            self._stop = Event()
            self._thread = Thread(target=self._run, args=(self._stop,), name=self._name, daemon=True)
            self.play_button.label = "Pause"
            self._thread.start()

    def pause(self) -> None:
        """Stop the time, and end the thread."""
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
            # Another thread may have started meanwhile.
            if self._stop is stop:
                self.pause()
