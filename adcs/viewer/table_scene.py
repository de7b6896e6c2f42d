"""Scene of the table under its sky: lights, camera's view, true and estimated satellite, late fix."""

from __future__ import annotations

import numpy as np
import trimesh
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from adcs.mockup.navigation.fixes import FixOutcome
from adcs.mockup.vision.camera import Pose, footprint
from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.viewer.drive import Drive, IdentifiedFrame
from adcs.viewer.frame_image import IDENTIFIED_COLOUR, OTHER_STAR_COLOUR, ceiling_sheet
from arrays.typing import FloatArray
from magloc.viewer.scene.framing import Extent, extent_of
from magloc.viewer.scene.glyphs import add_label, add_lines, add_mesh, show_segments
from magloc.viewer.scene.legend import Colour, Swatch
from magloc.viewer.scene.shapes import Surface, fan, line_segments, surface_of, unit_circle

CEILING_M = 1.5
"""Height of the sky above the table [m]; the source does not state it."""
TRUTH_COLOUR: Colour = (70, 76, 85)
ESTIMATE_COLOUR: Colour = (0, 114, 178)
FIX_COLOUR: Colour = (213, 94, 0)
VIEW_COLOUR: Colour = (86, 180, 233)
LIGHT_COLOUR: Colour = (150, 156, 165)
TABLE_COLOUR: Colour = (196, 214, 228)
_PATH_COLOUR: Colour = (176, 182, 190)
_REJECTED_COLOUR: Colour = (204, 121, 167)
TRAIL_S = 20.0
_TABLE_HALF_M = (1.35, 1.05, 0.02)
_LEG_M = 0.8
_RADIUS_M, _HEIGHT_M = 0.085, 0.1
_RING_M, _ARROW_M = 0.105, 0.24
_LIGHT_M = 0.016
_TRAIL_POINTS = 400


class TableScene:
    """Scene of one time of a drive: table, sky, true and estimated satellite.

    Parameters
    ----------
    scene : viser.SceneApi
    drive : Drive

    Attributes
    ----------
    enlargement : float
        Factor by which the error of the estimate and its 3σ ellipse are enlarged.
    """

    def __init__(self, scene: viser.SceneApi, drive: Drive) -> None:
        self._scene, self._drive = scene, drive
        self.enlargement = suitable_enlargement(drive.usual_error_m)
        self._fix: int | None = None
        self._add_room()
        path = np.column_stack([drive.truth.position_m, np.full(len(drive.truth), 0.003)])
        step = max(1, len(path) // (5 * _TRAIL_POINTS))
        add_lines(scene, "/path/whole", line_segments(path[::step]), _PATH_COLOUR, 1.0)
        self._trails = [
            add_lines(scene, f"/path/{name}", np.zeros((1, 2, 3)), colour, width, visible=False)
            for name, colour, width in (("truth", TRUTH_COLOUR, 2.5), ("estimate", ESTIMATE_COLOUR, 2.0))
        ]
        self._satellite = scene.add_frame("/satellite", show_axes=False)
        add_mesh(scene, "/satellite/body", satellite_body(), TRUTH_COLOUR, flat=True)
        self._estimate = self._mark("/estimate", ESTIMATE_COLOUR, _HEIGHT_M + 0.01, 4.0)
        self._late = self._mark("/fix", FIX_COLOUR, _HEIGHT_M + 0.006, 3.0)
        self._rejected = self._mark("/rejected-fix", _REJECTED_COLOUR, _HEIGHT_M + 0.006, 3.0)
        self._ellipse = add_mesh(scene, "/ellipse", fan(unit_circle()[:-1]), ESTIMATE_COLOUR, opacity=0.3)
        self._ellipse.visible = False
        # The footprint of the camera moves with it, so that only poses change.
        outline = self._outline_from_body()
        lens = np.array([0.0, 0.0, _HEIGHT_M])
        edges = np.stack([np.broadcast_to(lens, (4, 3)), outline[: -1 : len(outline) // 4]], axis=1)
        add_lines(scene, "/satellite/view", np.concatenate([line_segments(outline), edges]), VIEW_COLOUR, 1.6)
        self._exposure = scene.add_frame("/exposure", show_axes=False, visible=False)
        add_lines(scene, "/exposure/edge", line_segments(outline), FIX_COLOUR, 2.0)
        self._sheet: viser.ImageHandle | None = None
        self._age = add_label(scene, "/age", "", np.zeros(3))
        self._age.visible = False

    def show(self, row: int, frame: IdentifiedFrame | None) -> None:
        """Show a row of the drive.

        Parameters
        ----------
        row : int
        frame : IdentifiedFrame, optional
            Frame of the last fix.
        """
        drive = self._drive
        truth, pose = drive.truth.position_m[row], drive.true_pose(row)
        place_frame(self._satellite, pose)
        place = truth + self.enlargement * drive.errors_m[row]
        show_frame(self._estimate, place, float(drive.track.heading_rad[row]))
        if drive.sigma_m is not None:
            semi_axes = 3.0 * self.enlargement * drive.sigma_m[row]
            self._ellipse.scale = (float(semi_axes[0]), float(semi_axes[1]), 1.0)
            self._ellipse.position = np.array([*place, _HEIGHT_M + 0.008])
            self._ellipse.visible = True
        self._show_trails(row)
        self._show_fix(row, frame)

    def _show_trails(self, row: int) -> None:
        drive = self._drive
        times = drive.truth.time_s
        first = int(np.searchsorted(times, times[row] - TRAIL_S))
        rows = np.unique(np.append(np.arange(first, row + 1, max(1, (row - first) // _TRAIL_POINTS)), row))
        shown = drive.truth.position_m[rows] + self.enlargement * drive.errors_m[rows]
        for trail, places, z in zip(self._trails, (drive.truth.position_m[rows], shown), (0.006, 0.009), strict=True):
            show_segments(trail, line_segments(np.column_stack([places, np.full(len(rows), z)])))

    def _show_fix(self, row: int, frame: IdentifiedFrame | None) -> None:
        drive = self._drive
        fix = drive.last_fix(row)
        if fix is None or frame is None:
            for handle in (self._late, self._rejected, self._exposure, self._age):
                handle.visible = False
            if self._fix is not None:
                self._lights.batched_colors = self._light_colours(None)
            self._fix = None
            return
        age_s = float(drive.truth.time_s[row] - drive.fixes.time_s[fix])
        self._age.text = f"fix of {age_s:.1f} s ago"
        if fix == self._fix:
            return
        self._fix = fix
        rejected = drive.outcomes[fix] is FixOutcome.REJECTED
        shown, hidden = (self._rejected, self._late) if rejected else (self._late, self._rejected)
        show_frame(shown, drive.fixes.position_m[fix], float(drive.fixes.heading_rad[fix]))
        hidden.visible = False
        self._age.position = np.array([*drive.fixes.position_m[fix], _HEIGHT_M + 0.16])
        self._age.visible = True
        self._show_frame(frame, drive.pose_of_exposure(fix))
        self._lights.batched_colors = self._light_colours(frame)

    def _show_frame(self, frame: IdentifiedFrame, pose: Pose) -> None:
        # Right and down in the image are the body's x and y, so that it lies on the ceiling as seen from above.
        sheet = ceiling_sheet(frame)
        if self._sheet is None:
            width, height = self._drive.camera.footprint_m
            self._sheet = self._scene.add_image(
                "/exposure/sheet", sheet, width, height, format="png", position=(0.0, 0.0, CEILING_M - 0.004),
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
        self._sheet.image = sheet
        place_frame(self._exposure, pose)
        self._exposure.visible = True

    def _light_colours(self, frame: IdentifiedFrame | None) -> NDArray[np.uint8]:
        colours = np.tile(np.array(LIGHT_COLOUR, dtype=np.uint8), (len(self._drive.lights_m), 1))
        if frame is not None and isinstance(frame.fix, CameraFix):
            colours[frame.fix.stars[:, 1]] = IDENTIFIED_COLOUR
        return colours

    def _outline_from_body(self) -> FloatArray:
        """Return the closed outline of the camera's footprint, relative to the satellite."""
        outline = footprint(self._drive.camera, Pose(0.0, 0.0, 0.0), 4)
        closed = np.concatenate([outline, outline[:1]])
        return np.column_stack([closed, np.full(len(closed), CEILING_M)])

    def _mark(self, name: str, colour: Colour, height_m: float, width: float) -> viser.FrameHandle:
        """Add a ring with an arrow in a separate frame."""
        frame = self._scene.add_frame(name, show_axes=False, visible=False)
        tip = np.array([_ARROW_M, 0.0, 0.0])
        barbs = [tip + np.array([-0.06, side * 0.045, 0.0]) for side in (1.0, -1.0)]
        shaft = np.array([[[_RING_M, 0.0, 0.0], tip], [barbs[0], tip], [barbs[1], tip]])
        lines = np.concatenate([line_segments(_RING_M * unit_circle()), shaft]) + np.array([0.0, 0.0, height_m])
        add_lines(self._scene, f"{name}/lines", lines, colour, width)
        return frame

    def _add_room(self) -> None:
        scene, lights = self._scene, self._drive.lights_m
        ball = trimesh.creation.icosphere(subdivisions=1, radius=_LIGHT_M)
        self._lights = scene.add_batched_meshes_simple(
            "/sky", ball.vertices, ball.faces, np.tile([1.0, 0.0, 0.0, 0.0], (len(lights), 1)),
            np.column_stack([lights, np.full(len(lights), CEILING_M)]), batched_colors=self._light_colours(None),
            lod="off", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
        (x0, y0), (x1, y1) = lights.min(axis=0) - 0.05, lights.max(axis=0) + 0.05
        corners = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]])
        edges = line_segments(np.column_stack([corners, np.full(5, CEILING_M)]))
        add_lines(scene, "/ceiling", edges, LIGHT_COLOUR, 1.5)
        add_mesh(scene, "/table", table_body(), TABLE_COLOUR, flat=True)


def table_extent(drive: Drive) -> Extent:
    """Return the extent of the scene: sky and table."""
    lights = np.column_stack([drive.lights_m, np.full(len(drive.lights_m), CEILING_M)])
    x, y, _ = _TABLE_HALF_M
    return extent_of(lights, [[a * x, b * y, -0.1] for a in (-1.0, 1.0) for b in (-1.0, 1.0)])


def table_entries(drive: Drive) -> tuple[Swatch, ...]:
    """Return the entries of the legend."""
    note = ", errors enlarged" if suitable_enlargement(drive.usual_error_m) > 1.0 else ""
    estimate = "estimate" + ("" if drive.sigma_m is None else " with its 3σ ellipse")
    return (
        Swatch(TRUTH_COLOUR, "satellite, where it is, and its trail"),
        Swatch(ESTIMATE_COLOUR, estimate + note),
        Swatch(FIX_COLOUR, "late fix: where it was, and the frame on the ceiling"),
        Swatch(VIEW_COLOUR, "what the camera sees now"),
        Swatch(IDENTIFIED_COLOUR, "light identified in that frame"),
        Swatch(OTHER_STAR_COLOUR, "star that is not"),
        *((Swatch(_REJECTED_COLOUR, "fix that was rejected"),) if FixOutcome.REJECTED in drive.outcomes else ()),
    )


def suitable_enlargement(usual_error_m: float) -> float:
    """Return the largest of :data:`ENLARGEMENTS` that draws an error no longer than 12 cm."""
    return max((value for value in ENLARGEMENTS if value * usual_error_m <= 0.12), default=1.0)


ENLARGEMENTS = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)


def place_frame(frame: viser.FrameHandle, pose: Pose) -> None:
    """Move a frame to a pose on the table."""
    frame.position = np.array([pose.x_m, pose.y_m, 0.0])
    frame.wxyz = Rotation.from_rotvec([0.0, 0.0, pose.heading_rad]).as_quat(scalar_first=True)


def show_frame(frame: viser.FrameHandle, position_m: FloatArray, heading_rad: float) -> None:
    """Move a frame on the table, and show it."""
    x, y = position_m.tolist()
    place_frame(frame, Pose(x, y, heading_rad))
    frame.visible = True


def satellite_body() -> Surface:
    """Return the satellite: a can with a lens on top and a nose along x."""
    can = trimesh.creation.cylinder(_RADIUS_M, sections=32, segment=[[0.0, 0.0, 0.012], [0.0, 0.0, _HEIGHT_M - 0.015]])
    lens = trimesh.creation.cylinder(0.3 * _RADIUS_M, sections=24, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, _HEIGHT_M]])
    nose = trimesh.creation.box(extents=[0.06, 0.035, 0.03])
    nose.apply_translation([_RADIUS_M + 0.02, 0.0, 0.05])
    return surface_of(can, lens, nose)


def table_body() -> Surface:
    """Return the table: a slab with its top at z = 0, on four legs."""
    x, y, z = _TABLE_HALF_M
    slab = trimesh.creation.box(extents=[2.0 * x, 2.0 * y, 2.0 * z])
    slab.apply_translation([0.0, 0.0, -z])
    legs = [
        trimesh.creation.cylinder(
            0.03, sections=12, segment=[[a * (x - 0.1), b * (y - 0.1), -_LEG_M], [a * (x - 0.1), b * (y - 0.1), -z]]
        )
        for a in (-1.0, 1.0)
        for b in (-1.0, 1.0)
    ]
    return surface_of(slab, *legs)
