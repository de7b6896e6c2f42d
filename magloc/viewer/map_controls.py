"""The panels of a map: what is shown of it, at which level, and where the slices are."""

from __future__ import annotations

import numpy as np
import viser

from magloc.viewer.inputs import set_value
from magloc.viewer.latest import Latest
from magloc.viewer.map_view import POINT_OF_SPACING, MapView

_AXES = "xyz"
_LOGARITHMIC_STEP = 0.01


class MapControls:
    """Folders of switches and sliders for a map in the scene.

    Parameters
    ----------
    server : viser.ViserServer
        The folders are added where its GUI is at present.
    view : MapView

    Attributes
    ----------
    surface : viser.GuiCheckboxHandle
    level : viser.GuiSliderHandle
        Of the surface; its logarithm to the base 10 where the map is logarithmic.
    slices : list of viser.GuiCheckboxHandle
    places : list of viser.GuiSliderHandle
        Of the slices across x, y and z [m].
    """

    def __init__(self, server: viser.ViserServer, view: MapView) -> None:
        self._view = view
        gui, axis = server.gui, view.result.axis_m
        with gui.add_folder("Points"):
            self.points = gui.add_checkbox("coloured points", True)
            self.failed = gui.add_checkbox("grey points", False, hint="starts or sources that fail")
            self.cut = gui.add_checkbox("cut open", view.cut, hint="only the points behind the slice across y")
            self.size = gui.add_slider("size", min=0.05, max=1.0, step=0.01, initial_value=POINT_OF_SPACING)
        with gui.add_folder("Surface around low values"):
            hint = "light blue, around the points whose value is the level at most"
            self.surface = gui.add_checkbox("surface", False, hint=hint)
            ends, step, label = np.array(view.limits), 1.0, "level"
            if view.result.logarithmic:
                ends, step, label = np.log10(view.limits), _LOGARITHMIC_STEP, "log₁₀ level"
            first, last = (np.round(ends / step) * step).tolist()
            last = max(last, first + step)
            self.level = gui.add_slider(label, min=first, max=last, step=step, initial_value=last)
        with gui.add_folder("Slices"):
            self.slices = [
                gui.add_checkbox(f"across {name}", handle.visible)
                for name, handle in zip(_AXES, view.slices, strict=True)
            ]
            self.places = [
                gui.add_slider(
                    f"{name} [m]",
                    min=float(axis[0]),
                    max=float(axis[-1]),
                    step=view.spacing_m,
                    initial_value=float(axis[view.indices[i]]),
                )
                for i, name in enumerate(_AXES)
            ]
        # Two switches that are thrown at once must not undo each other.
        self._show_switched = Latest(self._switch)
        self.points.on_update(self._show_switched)
        self.failed.on_update(self._show_switched)
        self.cut.on_update(Latest(lambda: view.show_cut(self.cut.value)))
        self.size.on_update(lambda _: view.show_size(self.size.value))
        show_level = Latest(self._show_level)
        self.surface.on_update(show_level)
        # Who moves a slider wants to see what it moves.
        self.level.on_update(lambda _: set_value(self.surface, True))
        self.level.on_update(show_level)
        for i in range(3):
            self._connect_slice(i)

    def _connect_slice(self, i: int) -> None:
        self.slices[i].on_update(self._show_switched)
        self.places[i].on_update(lambda _: set_value(self.slices[i], True))
        self.places[i].on_update(Latest(lambda: self._view.show_slice(i, self.places[i].value)))

    def _switch(self) -> None:
        view = self._view
        view.cloud.visible, view.failed.visible = self.points.value, self.failed.value
        for handle, switch in zip(view.slices, self.slices, strict=True):
            handle.visible = switch.value

    def _show_level(self) -> None:
        view = self._view
        view.surface.visible = self.surface.value
        if self.surface.value:
            view.show_level(10.0**self.level.value if view.result.logarithmic else self.level.value)
