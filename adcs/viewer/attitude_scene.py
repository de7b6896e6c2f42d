"""Scene of an attitude: estimated body axes with 3σ cones, true axes, directions measured and expected."""

from __future__ import annotations

import numpy as np
import trimesh
import viser

from adcs import quaternion
from adcs.viewer.attitude_replay import AttitudeReplay
from arrays.typing import FloatArray
from magloc.viewer.scene.framing import Extent, extent_of
from magloc.viewer.scene.glyphs import add_label, add_lines, add_mesh, show_segments
from magloc.viewer.scene.legend import Colour, Swatch
from magloc.viewer.scene.shapes import Surface, fan, line_segments, surface_of, unit_circle

TRUTH_COLOUR: Colour = (122, 128, 136)  # visible on white and on a dark page
DIRECTION_COLOURS: tuple[Colour, ...] = ((204, 121, 167), (230, 159, 0))
_AXIS_COLOURS: tuple[Colour, ...] = ((213, 60, 50), (0, 158, 115), (0, 114, 178))
_BODY_COLOUR: Colour = (196, 204, 212)
_CIRCLE_COLOUR: Colour = (214, 219, 224)
_BODY, _AXIS = (0.36, 0.24, 0.24), 1.0
_LENGTHS = (0.9, 1.12)  # of measured and of expected directions
_TRAIL_ROWS, _TRAIL_S = 300, 10.0


class AttitudeScene:
    """Scene of one instant of a replay.

    Parameters
    ----------
    scene : viser.SceneApi
    replay : AttitudeReplay

    Attributes
    ----------
    enlargement : float
        Factor by which errors and cones are enlarged.
    """

    def __init__(self, scene: viser.SceneApi, replay: AttitudeReplay) -> None:
        self._replay, self.enlargement = replay, replay.enlargement
        circle = unit_circle()
        for i in range(3):
            add_lines(scene, f"/frame/circle-{i}", line_segments(np.roll(circle, i, axis=1)), _CIRCLE_COLOUR, 1.0)
        for i, name in enumerate(replay.axes):
            end = 1.28 * np.eye(3)[i]
            add_lines(scene, f"/frame/axis-{i}", np.array([[0.0 * end, end]]), _CIRCLE_COLOUR, 2.0)
            add_label(scene, f"/frame/name-{i}", name, 1.03 * end)
        self._body = scene.add_frame("/body", show_axes=False)
        add_mesh(scene, "/body/box", surface_of(trimesh.creation.box(_BODY)), _BODY_COLOUR, flat=True)
        self._cones = []
        for i, colour in enumerate(_AXIS_COLOURS):
            along = np.eye(3)[i]
            add_lines(scene, f"/body/axis-{i}", np.array([[0.0 * along, _AXIS * along]]), colour, 4.0)
            add_label(scene, f"/body/name-{i}", "xyz"[i], 1.06 * _AXIS * along)
            self._cones.append(add_mesh(scene, f"/body/cone-{i}", _cone(i), colour, opacity=0.3))
        self._truth = scene.add_frame("/truth", show_axes=False)
        ends = np.stack([np.zeros((3, 3)), 1.1 * _AXIS * np.eye(3)], axis=1)
        add_lines(scene, "/truth/axes", ends, TRUTH_COLOUR, 2.0)
        directions = list(enumerate(zip(replay.directions, DIRECTION_COLOURS, strict=False)))
        self._measured, self._expected = (
            [add_lines(scene, f"{name}-{i}", np.zeros((1, 2, 3)), colour, width) for i, (_, colour) in directions]
            for name, width in (("/body/measured", 6.0), ("/expected", 2.0))
        )
        self._names = [add_label(scene, f"/name-{i}", one.name, np.zeros(3)) for i, (one, _) in directions]
        self._trail = add_lines(scene, "/trail", np.zeros((1, 2, 3)), _AXIS_COLOURS[0], 1.5, visible=False)
        self._tips = _tips(replay)

    def replace(self, replay: AttitudeReplay) -> None:
        """Show the last row of another replay, with the same directions."""
        self._replay, self._tips = replay, _tips(replay)
        self.show(len(replay.time_s) - 1)

    def show(self, row: int) -> None:
        """Show a row of the replay."""
        replay = self._replay
        self._body.wxyz = np.roll(replay.enlarged_attitude(row, self.enlargement).as_quat(), 1)
        self._truth.visible = bool(replay.known[row])
        if self._truth.visible:
            self._truth.wxyz = np.asarray(replay.q_true[row])
        for i, (cone, tangents) in enumerate(zip(self._cones, replay.cones(row, self.enlargement), strict=True)):
            cone.visible = bool(np.isfinite(tangents).all())
            if cone.visible:
                cone.scale = tuple(np.roll([1.0, *tangents], i).tolist())
        for one, *lines, name in zip(replay.directions, self._measured, self._expected, self._names, strict=True):
            for line, direction, length in zip(lines, (one.measured[row], one.expected[row]), _LENGTHS, strict=True):
                line.visible = bool(np.isfinite(direction).all())
                if line.visible:
                    line.points = np.stack([np.zeros(3), length * direction])[None].astype(np.float32)
            name.visible = lines[1].visible
            if name.visible:
                name.position = 1.04 * _LENGTHS[1] * one.expected[row]
        first = int(np.searchsorted(replay.time_s, replay.time_s[row] - _TRAIL_S))
        rows = np.arange(first, row + 1)[:: max(1, (row - first) // _TRAIL_ROWS)]
        show_segments(self._trail, line_segments(self._tips[rows]))


def _tips(replay: AttitudeReplay) -> FloatArray:
    """Return the ends (n, 3) of the body axis x, which leaves a trail."""
    return np.asarray(_AXIS * quaternion.to_rotation(replay.q).apply([1.0, 0.0, 0.0]))


def attitude_extent() -> Extent:
    """Return the extent of the scene: the axes of the frame."""
    return extent_of(1.4 * np.eye(3), -np.eye(3))


def attitude_entries(replay: AttitudeReplay) -> tuple[Swatch, ...]:
    """Return the entries of the legend."""
    cones = " with 3σ cones" if np.isfinite(replay.sigma_rad).any() else ""
    return (
        *(
            Swatch(colour, f"body {axis}, as estimated{cones}")
            for colour, axis in zip(_AXIS_COLOURS, "xyz", strict=True)
        ),
        *((Swatch(TRUTH_COLOUR, "true body axes"),) if replay.known.any() else ()),
        *(
            Swatch(colour, f"{one.name}: thick as measured, thin as expected")
            for one, colour in zip(replay.directions, DIRECTION_COLOURS, strict=False)
        ),
    )


def _cone(axis: int) -> Surface:
    """Return a cone along an axis, with its apex at the origin, unit height and unit radius."""
    return fan(np.roll(unit_circle()[:-1], axis + 1, axis=1) + np.eye(3)[axis])
