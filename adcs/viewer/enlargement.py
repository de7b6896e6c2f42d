"""Dropdown for the enlargement of errors in a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Protocol

import viser


class EnlargedScene(Protocol):
    """Protocol of a scene with enlarged errors."""

    enlargement: float


def enlargement_dropdown(
    gui: viser.GuiApi, scene: EnlargedScene, choices: Sequence[float], hint: str, update: Callable[[], None]
) -> viser.GuiDropdownHandle[str]:
    """Add a dropdown that changes the enlargement of a scene and then calls an update."""
    dropdown = gui.add_dropdown(
        "Errors", [f"{value:g} ×" for value in choices], initial_value=f"{scene.enlargement:g} ×", hint=hint
    )

    def enlarge(_: object) -> None:
        scene.enlargement = float(dropdown.value.split()[0])
        update()

    dropdown.on_update(enlarge)
    return dropdown
