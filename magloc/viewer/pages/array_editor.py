"""An array whose sensors the user drags, and saves as an array file.

Use, inside a tab or folder of the GUI::

    editor = ArrayEditor(server, array, on_change=[glyphs.set_array, dipole_editor.set_array], parent="/array")
    editor.array                                       # as edited
    editor.visible = False                             # takes its control out of the scene
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
from magloc.viewer.pages import words
from magloc.viewer.pages.dipole_editor import sensible_step
from magloc.viewer.panels.inputs import SharedInput, set_value
from magloc.viewer.panels.latest import Latest

_CONTROL = 0.6
_SAME_PLACE_RTOL = 1e-3


class ArrayEditor:
    """Panels and a transform control that move the sensors of an array.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added where its GUI is at present.
    array : SensorArray
    save_as : str
        Path that is suggested for the edited array.
    on_change : sequence of callable
        Called with the array after every change of it.
    parent : str
        Name of the scene node of the array's frame; empty for the scene itself.
    file : Path, optional
        That the array was read from: the only file there is that may be replaced.

    Attributes
    ----------
    array : SensorArray
        As edited: the last one that was valid.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        array: SensorArray,
        *,
        save_as: str = "edited-array.toml",
        on_change: Sequence[Callable[[SensorArray], None]] = (),
        parent: str = "",
        file: Path | None = None,
    ) -> None:
        self._own = set() if file is None else {file.resolve()}
        self.array = self._original = array
        self._on_change = on_change
        self._follow = Latest(self._move_to_control)
        self._sensor = array.ids[0]
        self.control = server.scene.add_transform_controls(
            f"{parent}/sensor-control",
            scale=_CONTROL * array.circumradius,
            disable_rotations=True,
            depth_test=False,
            translation_limits=((-1e9, 1e9),) * 3,
            position=array.positions[0],
            visible=False,
        )
        gui, self._step_m = server.gui, sensible_step(array.circumradius)
        with gui.add_folder("Move a sensor"):
            self.sensor_dropdown = gui.add_dropdown("Sensor", array.ids)
            self.drag_checkbox = gui.add_checkbox("Drag it", False, hint="show arrows at the sensor in the scene")
            self.position_input = gui.add_vector3("Position [m]", array.sensors[0].position_m, step=self._step_m)
            self.back_button = gui.add_button("Put all sensors back")
            self.move_panel = gui.add_html("")
        with gui.add_folder("Save the array"):
            self.path_input = gui.add_text("File", save_as, hint="TOML array file, below the folder of the viewer")
            self.save_button = gui.add_button("Save")
            self.overwrite_button = gui.add_button("Overwrite the file", visible=False, color="red")
            self.save_panel = gui.add_html("")
        self.control.on_update(self._follow)
        self.sensor_dropdown.on_update(self._sensor_chosen)
        self.drag_checkbox.on_update(self._drag_switched)
        self._position = SharedInput(self.position_input, self._position_typed)
        self.back_button.on_click(lambda _: self._put_back())
        self.path_input.on_update(lambda _: self._say_of_file("", ask=False))
        self.save_button.on_click(lambda _: self.save(overwrite=False))
        self.overwrite_button.on_click(lambda _: self.save(overwrite=True))

    @property
    def visible(self) -> bool:
        """Whether the control is in the scene."""
        return self.control.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        set_value(self.drag_checkbox, visible)

    def move(self, sensor_id: str, position_m: ArrayLike) -> None:
        """Move a sensor, as if the user had chosen and dragged it.

        Parameters
        ----------
        sensor_id : str
        position_m : array-like, shape (3,)
            In the array's frame [m].
        """
        set_value(self.sensor_dropdown, sensor_id)
        self.control.position = np.asarray(position_m, dtype=np.float64)
        self._follow()

    def save(self, *, overwrite: bool) -> None:
        """Write the array to the path that the user typed; what this run opened or wrote only if told to.

        Parameters
        ----------
        overwrite : bool
            Whether the user has agreed that an existing file is replaced.
        """
        path = Path(self.path_input.value.strip())
        try:
            fault = fault_of_path(path, self._own)
            if fault:
                self._say_of_file(fault, ask=False)
            elif path.exists() and not overwrite:
                self._say_of_file(f"{path} exists already: nothing was written yet.", ask=True)
            else:
                write_array(path, self.array)
                self._own.add(path.resolve())
                self._say_of_file(f"saved as {path}", ask=False, warning=False)
        except (OSError, RuntimeError, ValueError) as error:  # of names that no file can have too
            self._say_of_file(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}.", ask=False)

    def _say_of_file(self, text: str, *, ask: bool, warning: bool = True) -> None:
        self.overwrite_button.visible = ask
        self.save_panel.content = words.panel([escape(text)], warning=warning) if text else ""

    def _sensor_chosen(self, *_: object) -> None:
        chosen = self.sensor_dropdown.value
        if chosen != self._sensor:
            self.control.position = self._place_of(chosen)
            self._sensor = chosen
            self._show_place()

    def _drag_switched(self, *_: object) -> None:
        self.control.visible = self.drag_checkbox.value

    def _position_typed(self) -> None:
        self.control.position = np.array(self.position_input.value)
        self._follow()

    def _put_back(self) -> None:
        self._apply(self._original)
        self.control.position = self._place_of(self._sensor)

    def _move_to_control(self) -> None:
        try:
            # Rounded to what a hand can do: the file should not have ten digits of it.
            place = np.round(self.control.position, 2 - round(math.log10(self._step_m)))
            array = moved(self.array, self._sensor, place)
        except ValueError as error:
            self.move_panel.content = words.panel([escape(f"Not moved: {error}")], warning=True)
            return
        self._apply(array)

    def _apply(self, array: SensorArray) -> None:
        self.array = array
        self.move_panel.content = ""
        self._show_place()
        for follow in self._on_change:
            follow(array)

    def _show_place(self) -> None:
        x, y, z = self._place_of(self._sensor).tolist()
        self._position.show((x, y, z))

    def _place_of(self, sensor_id: str) -> FloatArray:
        return self.array.positions[self.array.ids.index(sensor_id)]


def moved(array: SensorArray, sensor_id: str, position_m: ArrayLike) -> SensorArray:
    """The array with one sensor at another place.

    ``position_m`` (3,): in the array's frame [m]. Raises ValueError: another sensor of the same kind stands there,
    or this is no array.
    """
    place = tuple(np.asarray(position_m, dtype=np.float64).tolist())
    sensors = tuple(replace(sensor, position_m=place) if sensor.id == sensor_id else sensor for sensor in array.sensors)
    (changed,) = (sensor for sensor in sensors if sensor.id == sensor_id)
    for sensor in sensors:
        distance = float(np.linalg.norm(np.subtract(sensor.position_m, changed.position_m)))
        if sensor is not changed and sensor.kind == changed.kind and distance <= _SAME_PLACE_RTOL * array.circumradius:
            raise ValueError(f"sensors {sensor.id} and {sensor_id} would stand in the same place.")
    return replace(array, sensors=sensors)


def fault_of_path(path: Path, own: Collection[Path] = ()) -> str:
    """Why an array file must not be written to a path, as a sentence; empty if nothing speaks against it.

    A file below the working directory, where there is none yet, or one of `own`.
    """
    if path.suffix.lower() != ".toml":
        return f"{path}: expected the name of a file that ends in .toml."
    place = path.resolve()
    if place in own:
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
