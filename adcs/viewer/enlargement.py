"""A dropdown of how many times larger than it is a scene shows an error."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import viser


class Enlarging(Protocol):
    """A scene that enlarges errors."""

    enlarged: float


def enlargement_dropdown(
    gui: viser.GuiApi, scene: Enlarging, choices: Sequence[float], hint: str, follow: Callable[[], None]
) -> viser.GuiDropdownHandle[str]:
    """The dropdown, which changes the scene and then follows."""
    dropdown = gui.add_dropdown(
        "Errors", [f"{value:g} ×" for value in choices], initial_value=f"{scene.enlarged:g} ×", hint=hint
    )

    def enlarge(_: object) -> None:
        scene.enlarged = float(dropdown.value.split()[0])
        follow()

    dropdown.on_update(enlarge)
    return dropdown
