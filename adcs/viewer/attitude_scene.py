"""An attitude in three dimensions: body axes with their 3σ cones, the true ones, directions measured and expected."""

from __future__ import annotations

import numpy as np
import trimesh
import viser

from adcs import quaternion
from adcs.viewer.attitude_replay import AttitudeReplay
from magloc.viewer.scene.framing import Extent, extent_of
from magloc.viewer.scene.glyphs import screen_label, screen_lines, solid
from magloc.viewer.scene.legend import Colour, Swatch
from magloc.viewer.scene.shapes import Surface, line_segments, surface_of, unit_circle

TRUTH_COLOUR: Colour = (122, 128, 136)  # seen on white and in the dark
DIRECTION_COLOURS: tuple[Colour, ...] = ((204, 121, 167), (230, 159, 0))
_AXIS_COLOURS: tuple[Colour, ...] = ((213, 60, 50), (0, 158, 115), (0, 114, 178))
_BODY_COLOUR: Colour = (196, 204, 212)
_CIRCLE_COLOUR: Colour = (214, 219, 224)
_BODY, _AXIS = (0.36, 0.24, 0.24), 1.0
_LENGTHS = (0.9, 1.12)  # of a direction as measured, and as expected
_TRAIL_ROWS, _TRAIL_S = 300, 10.0


class AttitudeScene:
    """A body that turns, at one instant of a replay.

    Parameters
    ----------
    scene : viser.SceneApi
    replay : AttitudeReplay

    Attributes
    ----------
    enlarged : float
        How many times errors and cones are drawn larger than they are.
    """

    def __init__(self, scene: viser.SceneApi, replay: AttitudeReplay) -> None:
        self._replay, self.enlarged = replay, replay.enlarged
        circle = unit_circle()
        for i in range(3):
            screen_lines(scene, f"/frame/circle-{i}", line_segments(np.roll(circle, i, axis=1)), _CIRCLE_COLOUR, 1.0)
        for i, name in enumerate(replay.axes):
            end = 1.28 * np.eye(3)[i]
            screen_lines(scene, f"/frame/axis-{i}", np.array([[0.0 * end, end]]), _CIRCLE_COLOUR, 2.0)
            screen_label(scene, f"/frame/name-{i}", name, 1.03 * end)
        self._body = scene.add_frame("/body", show_axes=False)
        solid(scene, "/body/box", surface_of(trimesh.creation.box(_BODY)), _BODY_COLOUR, flat=True)
        self._cones = []
        for i, colour in enumerate(_AXIS_COLOURS):
            along = np.eye(3)[i]
            screen_lines(scene, f"/body/axis-{i}", np.array([[0.0 * along, _AXIS * along]]), colour, 4.0)
            screen_label(scene, f"/body/name-{i}", "xyz"[i], 1.06 * _AXIS * along)
            self._cones.append(solid(scene, f"/body/cone-{i}", _cone(i), colour, opacity=0.3))
        self._truth = scene.add_frame("/truth", show_axes=False)
        ends = np.stack([np.zeros((3, 3)), 1.1 * _AXIS * np.eye(3)], axis=1)
        screen_lines(scene, "/truth/axes", ends, TRUTH_COLOUR, 2.0)
        coloured = list(enumerate(zip(replay.directions, DIRECTION_COLOURS, strict=False)))
        self._measured, self._expected = (
            [screen_lines(scene, f"{name}-{i}", np.zeros((1, 2, 3)), colour, width) for i, (_, colour) in coloured]
            for name, width in (("/body/measured", 6.0), ("/expected", 2.0))
        )
        self._names = [screen_label(scene, f"/name-{i}", one.name, np.zeros(3)) for i, (one, _) in coloured]
        self._trail = screen_lines(scene, "/trail", np.zeros((1, 2, 3)), _AXIS_COLOURS[0], 1.5, visible=False)
        self._tips = _AXIS * quaternion.to_rotation(replay.q).apply([1.0, 0.0, 0.0])

    def show(self, row: int) -> None:
        """Show a row of the replay."""
        replay = self._replay
        turn = replay.drawn(row, self.enlarged)
        self._body.wxyz = np.roll(turn.as_quat(), 1)
        self._truth.visible = bool(replay.known[row])
        if self._truth.visible:
            self._truth.wxyz = np.asarray(replay.q_true[row])
        for i, (cone, tangents) in enumerate(zip(self._cones, replay.cones(row, self.enlarged), strict=True)):
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
        segments = line_segments(self._tips[rows])
        self._trail.visible = bool(len(segments))
        if self._trail.visible:
            self._trail.points = segments.astype(np.float32)


def scene_extent() -> Extent:
    """What should be in view: the axes of the frame."""
    return extent_of(1.4 * np.eye(3), -np.eye(3))


def scene_entries(replay: AttitudeReplay) -> tuple[Swatch, ...]:
    """Legend of the scene."""
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
    """A cone along an axis, of unit height, with its point in the middle and a rim of unit radius."""
    rim = np.roll(unit_circle()[:-1], axis + 1, axis=1) + np.eye(3)[axis]
    n = len(rim)
    faces = np.array([[0, i + 1, (i + 1) % n + 1] for i in range(n)])
    return Surface(np.concatenate([np.zeros((1, 3)), rim]), faces)
