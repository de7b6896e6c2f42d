"""Editor of an array: the user drags its sensors, and saves it as an array file.

Use, inside a tab or folder of the GUI::

    editor = ArrayEditor(server, array, on_change=[glyphs.set_array, dipole_editor.set_array])
    editor.array                                       # with all changes
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
import viser
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.array_file import write_array
from arrays.typing import FloatArray
from magloc.viewer.pages import texts
from magloc.viewer.pages.dipole_editor import input_step
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.inputs import SharedInput

_FILE = "edited-array.toml"
_CONTROL = 0.6
_SAME_PLACE_RTOL = 1e-3


class ArrayEditor:
    """Panels and a transform control that move the sensors of an array.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    array : SensorArray
    on_change : sequence of callable
        Called with the array after every change.
    file : Path, optional
        File of the array, the only existing file that the editor may replace.

    Attributes
    ----------
    array : SensorArray
        Last valid array.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        array: SensorArray,
        *,
        on_change: Sequence[Callable[[SensorArray], None]] = (),
        file: Path | None = None,
    ) -> None:
        self._own_files = set() if file is None else {file.resolve()}
        self.array = self._original = array
        self._on_change = on_change
        self._update = CoalescedCall(self._move_to_control)
        self._sensor = array.ids[0]
        self.control = server.scene.add_transform_controls(
            "/array/sensor-control",
            scale=_CONTROL * array.circumradius,
            disable_rotations=True,
            depth_test=False,
            translation_limits=((-1e9, 1e9),) * 3,
            position=array.positions[0],
            visible=False,
        )
        gui, self._step_m = server.gui, input_step(array.circumradius)
        with gui.add_folder("Move a sensor"):
            self.sensor_dropdown = gui.add_dropdown("Sensor", array.ids)
            self.drag_checkbox = gui.add_checkbox("Drag it", False, hint="show arrows at the sensor in the scene")
            self.position_input = gui.add_vector3("Position [m]", array.sensors[0].position_m, step=self._step_m)
            self.back_button = gui.add_button("Put all sensors back")
            self.move_panel = gui.add_html("")
        with gui.add_folder("Save the array"):
            self.path_input = gui.add_text("File", _FILE, hint="TOML array file, below the folder of the viewer")
            self.save_button = gui.add_button("Save")
            self.overwrite_button = gui.add_button("Overwrite the file", visible=False, color="red")
            self.save_panel = gui.add_html("")
        self.control.on_update(self._update)
        self.sensor_dropdown.on_update(self._on_sensor)
        self.drag_checkbox.on_update(self._on_drag)
        self._position = SharedInput(self.position_input, self._on_position)
        self.back_button.on_click(lambda _: self._put_back())
        self.path_input.on_update(lambda _: self._show_message("", can_overwrite=False))
        self.save_button.on_click(lambda _: self.save(overwrite=False))
        self.overwrite_button.on_click(lambda _: self.save(overwrite=True))

    def save(self, *, overwrite: bool) -> None:
        """Write the array to the path in the input.

        Parameters
        ----------
        overwrite : bool
            Whether the user has agreed to replace an existing file.
        """
        path = Path(self.path_input.value.strip())
        try:
            fault = path_fault(path, self._own_files)
            if fault:
                self._show_message(fault, can_overwrite=False)
            elif path.exists() and not overwrite:
                self._show_message(f"{path} exists already: nothing was written yet.", can_overwrite=True)
            else:
                write_array(path, self.array)
                self._own_files.add(path.resolve())
                self._show_message(f"saved as {path}", can_overwrite=False, warning=False)
        except (OSError, RuntimeError, ValueError) as error:  # also from names that no file can have
            reason = getattr(error, "strerror", None) or error
            self._show_message(f"{path} cannot be written: {reason}.", can_overwrite=False)

    def _show_message(self, text: str, *, can_overwrite: bool, warning: bool = True) -> None:
        self.overwrite_button.visible = can_overwrite
        self.save_panel.content = texts.panel_html([escape(text)], warning=warning) if text else ""

    def _on_sensor(self, *_: object) -> None:
        sensor = self.sensor_dropdown.value
        if sensor != self._sensor:
            self.control.position = self._position_of(sensor)
            self._sensor = sensor
            self._show_position()

    def _on_drag(self, *_: object) -> None:
        self.control.visible = self.drag_checkbox.value

    def _on_position(self) -> None:
        self.control.position = np.array(self.position_input.value)
        self._update()

    def _put_back(self) -> None:
        self._apply(self._original)
        self.control.position = self._position_of(self._sensor)

    def _move_to_control(self) -> None:
        try:
            # Rounded to the precision of a hand, so that the file has few digits.
            position_m = np.round(self.control.position, 2 - round(math.log10(self._step_m)))
            array = move_sensor(self.array, self._sensor, position_m)
        except ValueError as error:
            self.move_panel.content = texts.panel_html([escape(f"Not moved: {error}")], warning=True)
            return
        self._apply(array)

    def _apply(self, array: SensorArray) -> None:
        self.array = array
        self.move_panel.content = ""
        self._show_position()
        for call in self._on_change:
            call(array)

    def _show_position(self) -> None:
        x, y, z = self._position_of(self._sensor).tolist()
        self._position.show((x, y, z))

    def _position_of(self, sensor_id: str) -> FloatArray:
        return self.array.positions[self.array.ids.index(sensor_id)]


def move_sensor(array: SensorArray, sensor_id: str, position_m: ArrayLike) -> SensorArray:
    """Return the array with one sensor at another position.

    ``position_m`` (3,): position in the array's frame [m]. Raises ValueError if another sensor of the same kind is
    there, or the array would be invalid.
    """
    place = tuple(np.asarray(position_m, dtype=np.float64).tolist())
    sensors = tuple(replace(sensor, position_m=place) if sensor.id == sensor_id else sensor for sensor in array.sensors)
    own = sensors[array.ids.index(sensor_id)]
    for sensor in sensors:
        distance = float(np.linalg.norm(np.subtract(sensor.position_m, own.position_m)))
        if sensor is not own and sensor.kind == own.kind and distance <= _SAME_PLACE_RTOL * array.circumradius:
            raise ValueError(f"sensors {sensor.id} and {sensor_id} would stand in the same place.")
    return replace(array, sensors=sensors)


def path_fault(path: Path, own_files: Collection[Path] = ()) -> str:
    """Return the reason why an array file must not be written to a path, or an empty text.

    Allowed are new files below the working directory, and `own_files`.
    """
    if path.suffix.lower() != ".toml":
        return f"{path}: expected the name of a file that ends in .toml."
    place = path.resolve()
    if place in own_files:
        return ""
    if not place.is_relative_to(Path.cwd().resolve()):
        return f"{path}: expected a file below the folder in which the viewer was started."
    if place.is_dir():
        return f"{path} is a folder, expected the name of a file."
    if not place.parent.is_dir():
        return f"{path}: there is no folder {path.parent}."
    if place.exists():
        return f"{path} exists already and was not opened here, expected the name of a new file."
    return ""
