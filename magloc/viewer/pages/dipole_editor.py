"""Editor of a dipole: predicted readings, Cramér-Rao bound, and fix of simulated readings.

Use, inside a tab or folder of the GUI; everything is in the array's frame::

    editor = DipoleEditor(server, array)                       # with a suitable position and moment
    editor.set_array(array)                                    # after a change of the array
    editor.move_to(position_m, moment_Am2)                     # as if the user had dragged it
    editor.extent_m                                            # points (k, 3) that the first camera should see
"""

from __future__ import annotations

import math

import numpy as np
import viser
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.localization.fit.results import Fix
from magloc.measurement.differences import one_digit, suitable_dipole
from magloc.viewer.pages import texts
from magloc.viewer.pages.fixes import best_first
from magloc.viewer.pages.live_fit import Forecast, LiveFit
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.inputs import SharedInput, set_value
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR, FIT_COLOUR, DipoleGlyph, SurfaceGlyph, rotation_from_z
from magloc.viewer.scene.ruler import DropLines
from magloc.viewer.scene.shapes import uncertainty

_SOLUTIONS_SHOWN = 3
_DECADES = 4.0
# Lengths in circumradii of the array.
_ARROW = 0.6
_CONTROL = 1.15
_FARTHEST = 10.0
# Lengths in arrows of the dipole.
_FIT_LENGTH = 1.4
_FIT_THICKNESS = 0.19
# End of an open region, relative to the range.
_FARTHEST_OF_RANGE = 3.0


class DipoleEditor:
    """Dipole with a transform control in the scene, and its panels in the GUI.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    array : SensorArray

    Attributes
    ----------
    forecast : Forecast
        Forecast for the present dipole.
    fix : Fix
        Fix of its simulated readings.
    drop : DropLines
        Line from the dipole to the floor.
    """

    def __init__(self, server: viser.ViserServer, array: SensorArray) -> None:
        self._start = suitable_dipole(array)
        self._live = LiveFit(array)
        self._magnitude = float(np.linalg.norm(self._start[1]))
        self._update_forecast = CoalescedCall(self._show_forecast)
        self._update_fix = CoalescedCall(self._show_fix)
        self._add_nodes(server, array)
        self._add_panels(server, array)
        self.forecast: Forecast
        self.fix: Fix
        self.move_to(*self._start)

    @property
    def array(self) -> SensorArray:
        """Array of the readings."""
        return self._live.array

    @property
    def position_m(self) -> FloatArray:
        """Position of the dipole in the array's frame, shape (3,) [m]."""
        return np.array(self.control.position, dtype=np.float64)

    @property
    def moment_Am2(self) -> FloatArray:
        """Moment of the dipole, along the z axis of the control, shape (3,) [A·m²]."""
        return self._magnitude * direction_of(self.control.wxyz)

    @property
    def extent_m(self) -> FloatArray:
        """Points that the first camera should see, shape (k, 3) [m]."""
        tip = self.position_m + _ARROW * self.array.circumradius * direction_of(self.control.wxyz)
        return np.vstack([self.array.positions, self.position_m, tip])

    def move_to(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> None:
        """Move the dipole, as if the user had dragged it.

        Parameters
        ----------
        position_m, moment_Am2 : array-like, shape (3,)
            Position [m] and moment [A·m²] in the array's frame. A zero moment does not change the direction.
        """
        moment = np.asarray(moment_Am2, dtype=np.float64)
        self._magnitude = float(np.linalg.norm(moment))
        self.control.position = np.asarray(position_m, dtype=np.float64)
        if self._magnitude > 0.0:
            self.control.wxyz = rotation_from_z(moment / self._magnitude)
        self._update()

    def set_array(self, array: SensorArray) -> None:
        """Replace the array.

        Parameters
        ----------
        array : SensorArray
        """
        self._live = LiveFit(array)
        self._update()

    def _add_nodes(self, server: viser.ViserServer, array: SensorArray) -> None:
        name, radius = "/dipole", array.circumradius
        self._region = SurfaceGlyph(server.scene, f"{name}/region")
        self.drop = DropLines(server.scene, f"{name}/drop", DIPOLE_COLOUR)
        self._glyph = DipoleGlyph(server.scene, f"{name}/true", _ARROW * radius, DIPOLE_COLOUR, reach_m=1.5 * radius)
        # A good fit is at the dipole's position. It is thinner and longer, so that its tip is visible.
        length, thickness = _FIT_LENGTH * _ARROW * radius, _FIT_THICKNESS * _ARROW * radius
        self._fit_glyphs = [
            DipoleGlyph(server.scene, f"{name}/fit {i + 1}", length, FIT_COLOUR, label=label, thickness_m=thickness)
            for i, label in enumerate(["fit", *["also fits"] * (_SOLUTIONS_SHOWN - 1)])
        ]
        self.control = server.scene.add_transform_controls(
            f"{name}/control",
            scale=_CONTROL * radius,
            depth_test=False,
            # The control is fainter than the arrows of dipole and fit, without squares that would hide them.
            disable_sliders=True,
            line_width=1.5,
            opacity=0.45,
            translation_limits=((-1e9, 1e9),) * 3,
        )
        self.control.on_update(self._update)

    def _add_panels(self, server: viser.ViserServer, array: SensorArray) -> None:
        gui, self._step_m = server.gui, input_step(array.circumradius)
        decade = round(math.log10(self._magnitude))
        with gui.add_folder("Dipole"):
            gui.add_html(texts.panel_html(["Drag its arrows in the scene, turn it by its rings, or type."]))
            self.position_input = gui.add_vector3("Position [m]", (0.0, 0.0, 0.0), step=self._step_m)
            self.moment_input = gui.add_number("Moment [A·m²]", 0.0, min=0.0, step=one_digit(0.1 * self._magnitude))
            self.decades_slider = gui.add_slider(
                "log₁₀ moment",
                decade - _DECADES,
                decade + _DECADES,
                0.05,
                float(decade),
                hint="log₁₀ of the moment in A·m²",
            )
            self.azimuth_slider = gui.add_slider(
                "Azimuth [°]", -180.0, 180.0, 1.0, 0.0, hint="of the moment, from x to y"
            )
            self.elevation_slider = gui.add_slider(
                "Elevation [°]", -90.0, 90.0, 1.0, 0.0, hint="of the moment, above the plane of x and y"
            )
            self.back_button = gui.add_button("Back to the start")
        with gui.add_folder("Predicted readings"):
            self.readings_panel = gui.add_html("")
        with gui.add_folder("How well it can be known (Cramér–Rao)"):
            self.bound_panel = gui.add_html("")
        with gui.add_folder("Live fit of simulated readings"):
            self.noise_checkbox = gui.add_checkbox("Noise", True, hint="add the sensors' noise to the readings")
            self.seed_input = gui.add_number("Seed of the noise", 0, min=0, step=1)
            self.draw_button = gui.add_button("Another draw of the noise")
            self.fit_panel = gui.add_html("")
        self._position = SharedInput(self.position_input, self._on_position)
        self._moment = SharedInput(self.moment_input, lambda: self._set_magnitude(self.moment_input.value))
        self._decades = SharedInput(self.decades_slider, lambda: self._set_magnitude(10.0**self.decades_slider.value))
        self._azimuth = SharedInput(self.azimuth_slider, self._on_angles)
        self._elevation = SharedInput(self.elevation_slider, self._on_angles)
        self.back_button.on_click(lambda _: self.move_to(*self._start))
        self.noise_checkbox.on_update(self._update_fix)
        self.seed_input.on_update(self._update_fix)
        self.draw_button.on_click(lambda _: set_value(self.seed_input, self.seed_input.value + 1))

    def _update(self, *_: object) -> None:
        # The fix is separate, so that readings and bound follow the hand while a slow fix runs.
        self._update_forecast()
        self._update_fix()

    def _on_position(self) -> None:
        self.control.position = np.array(self.position_input.value)
        self._update()

    def _set_magnitude(self, magnitude_Am2: float) -> None:
        self._magnitude = float(magnitude_Am2)
        self._update()

    def _on_angles(self) -> None:
        azimuth, elevation = math.radians(self.azimuth_slider.value), math.radians(self.elevation_slider.value)
        level = math.cos(elevation)
        direction = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
        self.control.wxyz = rotation_from_z(direction)
        self._update()

    def _show_forecast(self) -> None:
        live, position, moment = self._live, self.position_m, self.moment_Am2
        self.forecast = forecast = live.forecast(position, moment)
        self._forecast_of = (live, position, moment, forecast)
        self._glyph.show(position, moment)
        self.drop.show(position)
        self._show_region(live.array, position, forecast)
        self._show_inputs(position)
        self.readings_panel.content = texts.readings_table(live.array, forecast.readings_T, forecast.signal_T)
        self.bound_panel.content = texts.panel_html(texts.bound_lines(forecast))

    def _show_region(self, array: SensorArray, position: FloatArray, forecast: Forecast) -> None:
        if forecast.covariance is None:
            self._region.show(None)
            return
        distance = float(np.linalg.norm(position - array.centroid))
        self._region.show(
            uncertainty(
                position,
                forecast.covariance,
                array.centroid,
                range_observable=forecast.range_observable,
                range_interval_m=[forecast.range_interval_m],
                farthest_m=max(_FARTHEST * array.circumradius, _FARTHEST_OF_RANGE * distance),
            )
        )

    def _show_inputs(self, position: FloatArray) -> None:
        decimals = max(0, 1 - math.floor(math.log10(self._step_m)))
        azimuth, elevation = angles_of(direction_of(self.control.wxyz))
        if abs(elevation) > 89.9:
            azimuth = self.azimuth_slider.value  # undefined there, and should not jump
        decades = math.log10(self._magnitude) if self._magnitude > 0.0 else -math.inf
        decades = min(max(decades, self.decades_slider.min), self.decades_slider.max)
        x, y, z = np.round(position, decimals).tolist()
        self._position.show((x, y, z))
        self._moment.show(float(f"{self._magnitude:.4g}"))
        self._decades.show(round(decades, 2))
        self._azimuth.show(round(azimuth, 1))
        self._elevation.show(round(elevation, 1))

    def _show_fix(self) -> None:
        live, position, moment, forecast = self._forecast_of
        readings = forecast.readings_T
        if self.noise_checkbox.value and np.isfinite(readings).all():
            readings = live.simulate(readings, int(self.seed_input.value))
        self.fix = fix = live.fix(readings) if not forecast.reason else Fix((), forecast.reason)
        shown = best_first(fix)[:_SOLUTIONS_SHOWN]
        for i, glyph in enumerate(self._fit_glyphs):
            glyph.visible = i < len(shown)
            if i < len(shown):
                glyph.show(shown[i].position_m, shown[i].moment_Am2)
        self.fit_panel.content = texts.panel_html(texts.fix_lines(fix, forecast, position, moment))


def direction_of(wxyz: ArrayLike) -> FloatArray:
    """Return the direction of the z axis after the rotation of a unit quaternion, shape (3,)."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64)
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])


def angles_of(vector: FloatArray) -> tuple[float, float]:
    """Return the azimuth of a vector from x to y, and its elevation above their plane [°]."""
    x, y, z = vector.tolist()
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


def input_step(size_m: float) -> float:
    """Return the step of an input of lengths: a power of ten, at most a hundredth of a size [m]."""
    return float(10.0 ** math.floor(math.log10(size_m) - 2.0))
