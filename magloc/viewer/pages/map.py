"""Map in a scene: points, a surface around a level, movable slices, and their panels."""

from __future__ import annotations

import numpy as np
import viser
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.typing import ByteArray, FloatArray
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.scene.fields import PICTURE_AXES, picture_axes
from magloc.viewer.scene.glyphs import (
    REGION_COLOUR,
    Colour,
    LabelAnchor,
    SurfaceGlyph,
    add_label,
    add_lines,
    add_points,
)
from magloc.viewer.scene.legend import ColourScale, Entry, Swatch
from magloc.viewer.scene.shapes import box_edges, iso_surface

_AXES = "xyz"
_LOGARITHMIC_STEP = 0.01


class MapControls:
    """Switches and sliders for a map in the scene.

    Parameters
    ----------
    server : viser.ViserServer
        The folders are added to the present container of its GUI.
    view : MapView

    Attributes
    ----------
    surface : viser.GuiCheckboxHandle
    level : viser.GuiSliderHandle
        Level of the surface; log₁₀ of it for a logarithmic map.
    slices : list of viser.GuiCheckboxHandle
    places : list of viser.GuiSliderHandle
        Coordinates of the slices across x, y and z [m].
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
        # Two simultaneous changes must not undo each other.
        self._show_visible = CoalescedCall(self._set_visible)
        self.points.on_update(self._show_visible)
        self.failed.on_update(self._show_visible)
        self.cut.on_update(CoalescedCall(lambda: view.show_cut(self.cut.value)))
        self.size.on_update(lambda _: view.show_size(self.size.value))
        show_level = CoalescedCall(self._show_level)
        self.surface.on_update(show_level)
        # A moved slider shows its surface or slice.
        self.level.on_update(lambda _: set_value(self.surface, True))
        self.level.on_update(show_level)
        for i in range(3):
            self._connect_slice(i)

    def _connect_slice(self, i: int) -> None:
        self.slices[i].on_update(self._show_visible)
        self.places[i].on_update(lambda _: set_value(self.slices[i], True))
        self.places[i].on_update(CoalescedCall(lambda: self._view.show_slice(i, self.places[i].value)))

    def _set_visible(self) -> None:
        view = self._view
        view.cloud.visible, view.failed.visible = self.points.value, self.failed.value
        for handle, switch in zip(view.slices, self.slices, strict=True):
            handle.visible = switch.value

    def _show_level(self) -> None:
        view = self._view
        view.surface.visible = self.surface.value
        if self.surface.value:
            view.show_level(10.0**self.level.value if view.result.logarithmic else self.level.value)


FAILED_COLOUR: Colour = (150, 150, 150)
_BOX_COLOUR: Colour = (120, 126, 134)
_SCALE = colormaps["viridis"]
_TOP_PERCENTILE = 99.0
POINT_OF_SPACING = 0.16
_PIXELS_OF_SLICE = 400
_SLICE_ALPHA = 225
_FAILED_ALPHA = 120
_CUT_AXIS = 1  # the first camera looks along y


class MapView:
    """Map in a scene.

    Parameters
    ----------
    server : viser.ViserServer
    result : MapResult

    Attributes
    ----------
    cloud : viser.PointCloudHandle
        Points with a value; in a cut map, those behind the slice across y.
    surface : SurfaceGlyph
    slices : list of viser.ImageHandle
        Slices across x, y and z.
    limits : tuple of 2 floats
        Values of the first and the last colour.
    indices : list of 3 ints
        Indices of the slices' planes.
    spacing_m : float
        Distance between two points along an axis [m].
    """

    def __init__(self, server: viser.ViserServer, result: MapResult) -> None:
        name = "/map"
        self._server, self.result = server, result
        self.limits = _colour_limits(result)
        axis = result.axis_m
        self.spacing_m = float(axis[1] - axis[0])
        through = np.zeros(3) if result.source_m is None else result.source_m
        self.indices = [int(np.argmin(np.abs(axis - through[i]))) for i in range(3)]
        self.cut = True
        size = POINT_OF_SPACING * self.spacing_m
        self.cloud = add_points(server.scene, f"{name}/points", *self._points(np.isfinite(result.values)), size)
        self.failed = add_points(server.scene, f"{name}/failed-points", *self._points(result.failed), size)
        self.failed.visible = False
        self.surface = SurfaceGlyph(server.scene, f"{name}/surface", REGION_COLOUR, 0.45)
        self.surface.visible = False
        self.level = self.limits[1]
        self._colour_cube = self._cube_colours()
        side = self.spacing_m * len(axis)
        self.slices = [
            server.scene.add_image(
                f"{name}/slice-{'xyz'[i]}",
                self._picture(i),
                side,
                side,
                format="png",
                wxyz=Rotation.from_matrix(picture_axes(i).T).as_quat(scalar_first=True),
                position=self._place(i),
                cast_shadow=False,
                receive_shadow=False,
            )
            for i in range(3)
        ]
        # Only one slice is visible at first, because more would hide the points behind it.
        for i in (0, 2):
            self.slices[i].visible = False

    def add_box(self) -> None:
        """Add the edges of the cube, with the coordinates of their ends."""
        name, scene, axis = "/map/box", self._server.scene, self.result.axis_m
        low, high = float(axis[0]), float(axis[-1])
        edges = box_edges([low] * 3, [high] * 3)
        add_lines(scene, f"{name}/edges", edges, _BOX_COLOUR, 1.0)
        beyond = low - 0.06 * (high - low)
        # The first camera sees these edges at the border: x in front, y at the right, z at the left.
        labelled_edges: tuple[tuple[list[float], LabelAnchor], ...] = (
            ([0.0, beyond, low], "center-right"),
            ([high + low - beyond, 0.0, low], "center-left"),
            ([beyond, low, 0.0], "center-right"),
        )
        for axis_name, (place, anchor) in zip("xyz", labelled_edges, strict=True):
            for end in (low, high):
                place["xyz".index(axis_name)] = end
                add_label(scene, f"{name}/{axis_name} {end:g}", f"{axis_name} = {end:g} m", place, anchor)

    def show_level(self, level: float) -> None:
        """Move the surface to another level.

        Parameters
        ----------
        level : float
            Level in the map's quantity.
        """
        self.level = level
        self.surface.show(iso_surface(self.result.axis_m, self.result.values, level))

    def show_slice(self, axis: int, coordinate_m: float) -> None:
        """Move a slice.

        Parameters
        ----------
        axis : int
            0, 1 or 2 for the slice across x, y or z.
        coordinate_m : float
            Coordinate of the slice, which shows the nearest plane of points [m].
        """
        self.indices[axis] = int(np.argmin(np.abs(self.result.axis_m - coordinate_m)))
        handle = self.slices[axis]
        handle.image = self._picture(axis)
        handle.position = self._place(axis)
        if axis == _CUT_AXIS and self.cut:
            self._show_points()

    def show_cut(self, cut: bool) -> None:
        """Hide or show the points in front of the slice across y.

        Parameters
        ----------
        cut : bool
        """
        self.cut = cut
        self._show_points()

    def entries(self) -> list[Entry]:
        """Return the entries of the legend."""
        low, high = self.limits
        lines: list[Entry] = [ColourScale.sample(self.result.quantity, f"{low:.3g}", f"{high:.3g}", _scale_colours)]
        if self.result.failed.any():
            failure = "start that does not converge" if self.result.over == "starts" else "source that is not found"
            lines.append(Swatch(FAILED_COLOUR, f"{failure} (in slices)"))
        return lines

    def show_size(self, share: float) -> None:
        """Set the size of the points.

        Parameters
        ----------
        share : float
            Diameter of a point relative to the spacing.
        """
        for cloud in (self.cloud, self.failed):
            cloud.point_size = share * self.spacing_m

    def _show_points(self) -> None:
        for cloud, where in ((self.cloud, np.isfinite(self.result.values)), (self.failed, self.result.failed)):
            points, colours = self._points(where)
            # Fewer colours than points would be an error in the browser.
            with self._server.atomic():
                cloud.points = points.astype(np.float32)
                cloud.colors = colours

    def _points(self, where: NDArray[np.bool_]) -> tuple[FloatArray, ByteArray]:
        """Return positions and colours of points of the cube, without those in front of the cut."""
        if self.cut:
            behind = np.arange(len(self.result.axis_m)) >= self.indices[_CUT_AXIS]
            where = where & behind[None, :, None]
        points = np.stack([self.result.axis_m[index] for index in np.nonzero(where)], axis=-1)
        colours = np.broadcast_to(np.array(FAILED_COLOUR, dtype=np.uint8), (len(points), 3)).copy()
        values = self.result.values[where]
        known = np.isfinite(values)
        colours[known] = self._colours(values[known])
        return points, colours

    def _colours(self, values: FloatArray) -> ByteArray:
        low, high = self.limits
        if self.result.logarithmic:
            values, low, high = np.log(values), np.log(low), np.log(high)
        return _scale_colours((values - low) / max(high - low, 1e-12))

    def _cube_colours(self) -> ByteArray:
        """Return colour and opacity of every point (n, n, n, 4)."""
        values, failed = self.result.values, self.result.failed
        colours = np.zeros((*values.shape, 4), dtype=np.uint8)
        shown = np.isfinite(values)
        colours[failed] = (*FAILED_COLOUR, _FAILED_ALPHA)
        colours[shown, :3] = self._colours(values[shown])
        colours[shown, 3] = _SLICE_ALPHA
        return colours

    def _picture(self, i: int) -> ByteArray:
        """Return the picture of a plane across an axis, with several pixels for each cell."""
        across, down = PICTURE_AXES[i]
        plane = np.take(self._colour_cube, self.indices[i], axis=i)
        if across < down:  # rows of the picture are vertical
            plane = plane.swapaxes(0, 1)
        pixels = max(1, _PIXELS_OF_SLICE // len(plane))
        return np.repeat(np.repeat(plane, pixels, axis=0), pixels, axis=1)

    def _place(self, i: int) -> FloatArray:
        axis = self.result.axis_m
        place = np.full(3, 0.5 * (axis[0] + axis[-1]))
        place[i] = axis[self.indices[i]]
        return place


def _scale_colours(share: FloatArray) -> ByteArray:
    """Return the colours (..., 3) of shares of the scale."""
    return np.asarray(_SCALE(share, bytes=True)[..., :3], dtype=np.uint8)


def _colour_limits(result: MapResult) -> tuple[float, float]:
    values = result.values[np.isfinite(result.values)]
    if not values.size:
        return 1.0, 2.0
    low, high = float(values.min()), float(np.percentile(values, _TOP_PERCENTILE))
    if not result.logarithmic:
        high = float(np.ceil(high))
    return low, high if high > low else low + 1.0
