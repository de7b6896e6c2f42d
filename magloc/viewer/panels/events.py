"""Buttons and keys for the rows in which a state changes."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence

import numpy as np
import viser

from arrays.typing import IntArray


def rows_of_change(states: Sequence[Hashable]) -> IntArray:
    """Return the rows whose state differs from the previous row's."""
    return np.array([i for i in range(1, len(states)) if states[i] != states[i - 1]], dtype=np.intp)


class EventButtons:
    """Buttons and keys that show the row of the next or the previous event, if there are events.

    Parameters
    ----------
    gui : viser.GuiApi
        The buttons are added to its present container.
    rows : ndarray of int, shape (k,)
        Rows of the events, ascending.
    present : callable
        It returns the present row.
    show : callable
        It shows a row.
    hint : str
        Explanation of the events.
    """

    def __init__(
        self, gui: viser.GuiApi, rows: IntArray, present: Callable[[], int], show: Callable[[int], None], hint: str
    ) -> None:
        self._rows, self._present, self._show = rows, present, show
        if not len(rows):
            return
        buttons = gui.add_button_group(f"Event ({len(rows)})", ("previous", "next"), hint=hint)
        buttons.on_click(lambda _: self.go(forwards=buttons.value == "next"))
        gui.add_command("Next event", hotkey="E").on_trigger(lambda _: self.go(forwards=True))
        backwards = gui.add_command("Previous event", hotkey="E", modifier="shift")
        backwards.on_trigger(lambda _: self.go(forwards=False))

    def go(self, *, forwards: bool) -> None:
        """Show the next or the previous event, if there is one."""
        place = int(np.searchsorted(self._rows, self._present(), side="right" if forwards else "left"))
        place -= 0 if forwards else 1
        if 0 <= place < len(self._rows):
            self._show(int(self._rows[place]))
