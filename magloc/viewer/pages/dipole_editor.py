"""A dipole that the user drags: what the sensors would read, how well it could be known, and what a fix finds.

Use, inside a tab or folder of the GUI; everything is in the array's frame::

    editor = DipoleEditor(server, array)                       # a position and a moment that suit the array
    editor = DipoleEditor(server, array, parent="/array")      # parent: node of the array's frame
    editor.set_array(array)                                    # after the array was edited: everything follows
    editor.move_to(position_m, moment_Am2)                     # as if the user had dragged it
    editor.extent_m                                            # points (k, 3) that the first camera should see
"""

from __future__ import annotations

import math
from time import perf_counter

import numpy as np
import viser
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.localization.fit.results import Fix
from magloc.measurement.differences import one_digit, suitable_dipole
from magloc.viewer.pages import words
from magloc.viewer.pages.fixes import heaviest_first
from magloc.viewer.pages.live_fit import Forecast, LiveFit
from magloc.viewer.panels.inputs import SharedInput, set_value
from magloc.viewer.panels.latest import Latest
from magloc.viewer.scene.glyphs import DIPOLE_COLOUR, FIT_COLOUR, DipoleGlyph, SurfaceGlyph, turned_to
from magloc.viewer.scene.ruler import DropLines
from magloc.viewer.scene.shapes import uncertainty

_SOLUTIONS_SHOWN = 3
_DECADES = 4.0
# In circumradii of the array: the arrow and the control, and how far an open region is drawn.
_ARROW = 0.6
_CONTROL = 1.15
# In arrows of the dipole.
_FIT_LENGTH = 1.4
_FIT_THICKNESS = 0.19
_FARTHEST = 10.0
_FARTHEST_OF_RANGE = 3.0


class DipoleEditor:
    """A dipole with a transform control in the scene, and its panels in the GUI.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added where its GUI is at present.
    array : SensorArray
    parent : str
        Name of the scene node of the array's frame; empty for the scene itself.

    Attributes
    ----------
    forecast : Forecast
        Of the present dipole.
    fix : Fix
        Of its simulated readings.
    drop : DropLines
        From the dipole to the floor.
    milliseconds : tuple of 2 floats
        How long the last forecast and the last fix took, from the state of the controls to the scene [ms].
    """

    def __init__(self, server: viser.ViserServer, array: SensorArray, *, parent: str = "") -> None:
        self._start = suitable_dipole(array)
        self._live = LiveFit(array)
        self._magnitude = float(np.linalg.norm(self._start[1]))
        self.milliseconds = (math.nan, math.nan)
        self._follow_dipole = Latest(self._show_forecast)
        self._follow_fit = Latest(self._show_fix)
        self._add_nodes(server, array, parent)
        self._add_panels(server, array)
        self.forecast: Forecast
        self.fix: Fix
        self.move_to(*self._start)

    @property
    def array(self) -> SensorArray:
        """The array that reads the dipole."""
        return self._live.array

    @property
    def position_m(self) -> FloatArray:
        """Where the dipole is, shape (3,), in the array's frame [m]."""
        return np.array(self.control.position, dtype=np.float64)

    @property
    def moment_Am2(self) -> FloatArray:
        """Its moment, shape (3,) [A·m²]: along the z axis of the control."""
        return self._magnitude * direction_of(self.control.wxyz)

    @property
    def extent_m(self) -> FloatArray:
        """Points that the first camera should see, shape (k, 3) [m]."""
        tip = self.position_m + _ARROW * self.array.circumradius * direction_of(self.control.wxyz)
        return np.vstack([self.array.positions, self.position_m, tip])

    def move_to(self, position_m: ArrayLike, moment_Am2: ArrayLike) -> None:
        """Put the dipole somewhere, as if the user had dragged it.

        Parameters
        ----------
        position_m, moment_Am2 : array-like, shape (3,)
            In the array's frame [m]; [A·m²]. A zero moment keeps its direction.
        """
        moment = np.asarray(moment_Am2, dtype=np.float64)
        self._magnitude = float(np.linalg.norm(moment))
        self.control.position = np.asarray(position_m, dtype=np.float64)
        if self._magnitude > 0.0:
            self.control.wxyz = turned_to(moment / self._magnitude)
        self._follow()

    def set_array(self, array: SensorArray) -> None:
        """Let another array read the dipole.

        Parameters
        ----------
        array : SensorArray
        """
        self._live = LiveFit(array)
        self._follow()

    def _add_nodes(self, server: viser.ViserServer, array: SensorArray, parent: str) -> None:
        name, radius = f"{parent}/dipole", array.circumradius
        self._region = SurfaceGlyph(server.scene, f"{name}/region")
        self.drop = DropLines(server.scene, f"{name}/drop", DIPOLE_COLOUR)
        self._glyph = DipoleGlyph(server.scene, f"{name}/true", _ARROW * radius, DIPOLE_COLOUR, reach_m=1.5 * radius)
        # A good fit stands where the dipole is: it is thinner and longer, so that its tip is seen beyond the other's.
        length, thickness = _FIT_LENGTH * _ARROW * radius, _FIT_THICKNESS * _ARROW * radius
        self._found = [
            DipoleGlyph(server.scene, f"{name}/fit {i + 1}", length, FIT_COLOUR, label=label, thickness_m=thickness)
            for i, label in enumerate(["fit", *["also fits"] * (_SOLUTIONS_SHOWN - 1)])
        ]
        self.control = server.scene.add_transform_controls(
            f"{name}/control",
            scale=_CONTROL * radius,
            depth_test=False,
            # Told apart from the arrows of dipole and fit: fainter, and without squares that hide them.
            disable_sliders=True,
            line_width=1.5,
            opacity=0.45,
            translation_limits=((-1e9, 1e9),) * 3,
        )
        self.control.on_update(self._follow)

    def _add_panels(self, server: viser.ViserServer, array: SensorArray) -> None:
        gui, self._step_m = server.gui, sensible_step(array.circumradius)
        decade = round(math.log10(self._magnitude))
        with gui.add_folder("Dipole"):
            gui.add_html(words.panel(["Drag its arrows in the scene, turn it by its rings, or type."]))
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
        self._position = SharedInput(self.position_input, self._position_typed)
        self._moment = SharedInput(self.moment_input, lambda: self._strengthen(self.moment_input.value))
        self._decades = SharedInput(self.decades_slider, lambda: self._strengthen(10.0**self.decades_slider.value))
        self._azimuth = SharedInput(self.azimuth_slider, self._turned_by_sliders)
        self._elevation = SharedInput(self.elevation_slider, self._turned_by_sliders)
        self.back_button.on_click(lambda _: self.move_to(*self._start))
        self.noise_checkbox.on_update(self._follow_fit)
        self.seed_input.on_update(self._follow_fit)
        self.draw_button.on_click(lambda _: set_value(self.seed_input, self.seed_input.value + 1))

    def _follow(self, *_: object) -> None:
        # The fit is a work of its own: while a slow one runs, the readings and the bound still follow the hand.
        self._follow_dipole()
        self._follow_fit()

    def _position_typed(self) -> None:
        self.control.position = np.array(self.position_input.value)
        self._follow()

    def _strengthen(self, magnitude_Am2: float) -> None:
        self._magnitude = float(magnitude_Am2)
        self._follow()

    def _turned_by_sliders(self) -> None:
        azimuth, elevation = math.radians(self.azimuth_slider.value), math.radians(self.elevation_slider.value)
        level = math.cos(elevation)
        direction = np.array([level * math.cos(azimuth), level * math.sin(azimuth), math.sin(elevation)])
        self.control.wxyz = turned_to(direction)
        self._follow()

    def _show_forecast(self) -> None:
        begin = perf_counter()
        live, position, moment = self._live, self.position_m, self.moment_Am2
        self.forecast = forecast = live.forecast(position, moment)
        self._forecast_of = (live, position, moment, forecast)
        self._glyph.show(position, moment)
        self.drop.show(position)
        self._show_region(live.array, position, forecast)
        self._show_inputs(position)
        self.readings_panel.content = words.readings_table(live.array, forecast.readings_T, forecast.signal_T)
        self.bound_panel.content = words.panel(words.bound_words(forecast))
        self.milliseconds = (1e3 * (perf_counter() - begin), self.milliseconds[1])

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
            azimuth = self.azimuth_slider.value  # it does not count there, and should not jump
        decades = math.log10(self._magnitude) if self._magnitude > 0.0 else -math.inf
        decades = min(max(decades, self.decades_slider.min), self.decades_slider.max)
        x, y, z = np.round(position, decimals).tolist()
        self._position.show((x, y, z))
        self._moment.show(float(f"{self._magnitude:.4g}"))
        self._decades.show(round(decades, 2))
        self._azimuth.show(round(azimuth, 1))
        self._elevation.show(round(elevation, 1))

    def _show_fix(self) -> None:
        begin = perf_counter()
        live, position, moment, forecast = self._forecast_of
        readings = forecast.readings_T
        if self.noise_checkbox.value and np.isfinite(readings).all():
            readings = live.simulated(readings, int(self.seed_input.value))
        self.fix = fix = live.fix(readings) if not forecast.reason else Fix((), forecast.reason)
        shown = heaviest_first(fix)[:_SOLUTIONS_SHOWN]
        for i, glyph in enumerate(self._found):
            glyph.visible = i < len(shown)
            if i < len(shown):
                glyph.show(shown[i].position_m, shown[i].moment_Am2)
        self.fit_panel.content = words.panel(words.fix_words(fix, forecast, position, moment))
        self.milliseconds = (self.milliseconds[0], 1e3 * (perf_counter() - begin))


def direction_of(wxyz: ArrayLike) -> FloatArray:
    """The z axis of a frame that a unit quaternion turns, shape (3,)."""
    w, x, y, z = np.asarray(wxyz, dtype=np.float64)
    return np.array([2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)])


def angles_of(vector: FloatArray) -> tuple[float, float]:
    """Azimuth from x to y, and elevation above their plane, of a vector [°]."""
    x, y, z = vector.tolist()
    return math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


def sensible_step(size_m: float) -> float:
    """Step of an input for something of this size: a power of ten, a hundredth of it at most [m]."""
    return float(10.0 ** math.floor(math.log10(size_m) - 2.0))
