"""Panel for the fields of a row of readings: arrows at the sensors, field lines, and a slice of the modulus."""

from __future__ import annotations

import numpy as np
import viser

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.fields.dipole import field
from magloc.readings import Readings
from magloc.viewer.pages import texts
from magloc.viewer.pages.fixes import FixView
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.readings_plot import differences_from_mean
from magloc.viewer.scene.fields import FieldSlice, SensorArrows
from magloc.viewer.scene.glyphs import ARROW_COLOUR

NONE, MEASURED, RESIDUAL = "none", "measured, beyond the mean", "residual of the fix"
_PLANES = (NONE, "across x", "across y", "across z")


class FieldPanel:
    """Switches for the fields of the present row.

    Parameters
    ----------
    server : viser.ViserServer
        The panel is added to the present container of its GUI.
    array : SensorArray
    view : FixView
    rows : Readings, optional
        Readings for the arrows.
    size_m : float
        Length of the longest arrow, and a quarter of the side of the slice [m].
    """

    def __init__(
        self,
        server: viser.ViserServer,
        array: SensorArray,
        view: FixView,
        rows: Readings | None,
        size_m: float,
    ) -> None:
        self._array, self._view, self._rows = array, view, rows
        self._vector = np.array([sensor.kind == "vector" for sensor in array.sensors])
        self._arrows = SensorArrows(server.scene, "/array/arrows", size_m, ARROW_COLOUR)
        self._slice = FieldSlice(server.scene, "/fixes/slice", 4.0 * size_m)
        gui = server.gui
        with gui.add_folder("Field"):
            self.lines_checkbox = gui.add_checkbox("field lines", True)
            self.plane_dropdown = gui.add_dropdown("slice of |B|", _PLANES, hint="of the sources of the row")
            has_arrows = rows is not None and bool(self._vector.any())
            kinds = (NONE, MEASURED, RESIDUAL) if has_arrows else (NONE,)
            self.arrows_dropdown = gui.add_dropdown(
                "arrows", kinds, disabled=not has_arrows,
                hint="Fields at the vector sensors minus their mean, or residuals of the fix, on one scale.",
            )  # fmt: skip
            self._panel = gui.add_html("")
        follow = CoalescedCall(self._show)
        for switch in (self.plane_dropdown, self.arrows_dropdown):
            switch.on_update(follow)
        self.lines_checkbox.on_update(lambda _: view.show_field_lines(self.lines_checkbox.value))

    def show_row(self, _: int) -> None:
        """Show the fields of the view's row."""
        self._show()

    def _show(self) -> None:
        lines = []
        sources = self._view.shown_sources
        plane = self.plane_dropdown.value
        if plane == NONE or not sources:
            self._slice.hide()
        else:
            positions, moments = np.array([[source.position_m, source.moment_Am2] for source in sources]).swapaxes(0, 1)
            low, high = self._slice.show(positions, moments, "xyz".index(plane[-1]))
            lines.append(f"|B| from {texts.field_text(low)} (violet) to {texts.field_text(high)} (yellow), logarithmic")
        if self.arrows_dropdown.value == NONE:
            self._arrows.hide()
        else:
            longest = self._arrows.show(self._array.positions[self._vector], self._vectors(self.arrows_dropdown.value))
            lines.append(f"longest arrow: {texts.field_text(longest)}")
        self._panel.content = texts.panel_html(lines) if lines else ""

    def _vectors(self, kind: str) -> FloatArray:
        """Return the fields (n, 3) at the vector sensors minus their mean, in the array's axes [T]."""
        if self._rows is None:
            return np.zeros((0, 3))
        row = self._rows[self._view.row]
        channels = self._array.sensor_channels[self._vector]
        measured = differences_from_mean(self._array, row.values_T)[0][channels]
        if kind == MEASURED or not self._view.shown_sources:
            return measured
        places = self._array.positions[self._vector]
        predicted = np.zeros_like(places)
        for source in self._view.shown_sources:
            position, moment = source.position_m, source.moment_Am2
            if row.pose is not None:
                origin_m, back = row.pose[0][0], row.pose[1][0].inv()
                position, moment = back.apply(position - origin_m), back.apply(moment)
            predicted += field(places, position, moment)
        known = np.isfinite(measured).all(axis=1)
        return measured - (predicted - predicted[known].mean(axis=0))
