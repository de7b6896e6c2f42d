"""A map in a scene: a cloud, a surface around a level, slices that move, and the panels that steer them."""

from __future__ import annotations

import numpy as np
import viser
from matplotlib import colormaps
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from arrays.typing import ByteArray, FloatArray
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.panels.latest import Latest
from magloc.viewer.scene.fields import PICTURE_AXES, picture_axes
from magloc.viewer.scene.glyphs import (
    REGION_COLOUR,
    Colour,
    LabelAnchor,
    SurfaceGlyph,
    dots,
    screen_label,
    screen_lines,
)
from magloc.viewer.scene.legend import ColourScale, Entry, Swatch
from magloc.viewer.scene.shapes import box_edges, iso_surface

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


FAILED_COLOUR: Colour = (150, 150, 150)
_BOX_COLOUR: Colour = (120, 126, 134)
_SCALE = colormaps["viridis"]
_LEGEND_STEPS = 9
_TOP_PERCENTILE = 99.0
POINT_OF_SPACING = 0.16
_PIXELS_OF_SLICE = 400
_SLICE_ALPHA = 225
_FAILED_ALPHA = 120
_CUT_AXIS = 1  # the first camera looks along y


class MapView:
    """A map in a scene.

    Parameters
    ----------
    server : viser.ViserServer
    result : MapResult
    name : str
        Of the node that holds it all.

    Attributes
    ----------
    cloud : viser.PointCloudHandle
        All points that have a value, as one cloud; where it is cut open, those behind the slice across y.
    surface : SurfaceGlyph
    slices : list of viser.ImageHandle
        Across x, y and z.
    limits : tuple of 2 floats
        Values of the first and the last colour.
    indices : list of 3 ints
        Of the planes that the slices show.
    spacing_m : float
        Between two points along an axis.
    """

    def __init__(self, server: viser.ViserServer, result: MapResult, name: str = "/map") -> None:
        self._server, self.result = server, result
        self.limits = _limits(result)
        axis = result.axis_m
        self.spacing_m = float(axis[1] - axis[0])
        through = np.zeros(3) if result.source_m is None else result.source_m
        self.indices = [int(np.argmin(np.abs(axis - through[i]))) for i in range(3)]
        self.cut = True
        size = POINT_OF_SPACING * self.spacing_m
        self.cloud = dots(server.scene, f"{name}/points", *self._points(np.isfinite(result.values)), size)
        self.failed = dots(server.scene, f"{name}/failed-points", *self._points(result.failed), size)
        self.failed.visible = False
        self.surface = SurfaceGlyph(server.scene, f"{name}/surface", REGION_COLOUR, 0.45)
        self.surface.visible = False
        self.level = self.limits[1]
        self._colour_cube = self._all_colours()
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
        # One slice and the points behind it: more would hide what is inside.
        for i in (0, 2):
            self.slices[i].visible = False

    def add_box(self, name: str = "/map/box") -> None:
        """Show the edges of the cube, with the coordinates of their ends.

        Parameters
        ----------
        name : str
            Of the node that holds it.
        """
        scene, axis = self._server.scene, self.result.axis_m
        low, high = float(axis[0]), float(axis[-1])
        edges = box_edges([low] * 3, [high] * 3)
        screen_lines(scene, f"{name}/edges", edges, _BOX_COLOUR, 1.0)
        beyond = low - 0.06 * (high - low)
        # Along the edges that the first camera sees at the border: x in front, y to the right, z to the left.
        edges_seen: tuple[tuple[list[float], LabelAnchor], ...] = (
            ([0.0, beyond, low], "center-right"),
            ([high + low - beyond, 0.0, low], "center-left"),
            ([beyond, low, 0.0], "center-right"),
        )
        for axis_name, (place, anchor) in zip("xyz", edges_seen, strict=True):
            for end in (low, high):
                place["xyz".index(axis_name)] = end
                screen_label(scene, f"{name}/{axis_name} {end:g}", f"{axis_name} = {end:g} m", place, anchor)

    def show_level(self, level: float) -> None:
        """Move the surface to another level.

        Parameters
        ----------
        level : float
            In the map's quantity.
        """
        self.level = level
        self.surface.show(iso_surface(self.result.axis_m, self.result.values, level))

    def show_slice(self, axis: int, coordinate_m: float) -> None:
        """Move a slice.

        Parameters
        ----------
        axis : int
            0, 1, 2 for the slice across x, y, z.
        coordinate_m : float
            The nearest plane of points is shown [m].
        """
        self.indices[axis] = int(np.argmin(np.abs(self.result.axis_m - coordinate_m)))
        handle = self.slices[axis]
        handle.image = self._picture(axis)
        handle.position = self._place(axis)
        if axis == _CUT_AXIS and self.cut:
            self._show_points()

    def show_cut(self, cut: bool) -> None:
        """Leave out the points in front of the slice across y, or show them.

        Parameters
        ----------
        cut : bool
        """
        self.cut = cut
        self._show_points()

    def entries(self) -> list[Entry]:
        """Lines of the legend."""
        low, high = self.limits
        colours = tuple(tuple(int(c) for c in rgb) for rgb in self._scale(np.linspace(0.0, 1.0, _LEGEND_STEPS)))
        lines: list[Entry] = [ColourScale(self.result.quantity, f"{low:.3g}", f"{high:.3g}", colours)]  # type: ignore[arg-type]
        if self.result.failed.any():
            what = "start that does not converge" if self.result.over == "starts" else "source that is not found"
            lines.append(Swatch(FAILED_COLOUR, f"{what} (in slices)"))
        return lines

    def show_size(self, share: float) -> None:
        """Draw the points larger or smaller.

        Parameters
        ----------
        share : float
            Their diameter over the distance between two of them.
        """
        for cloud in (self.cloud, self.failed):
            cloud.point_size = share * self.spacing_m

    def _show_points(self) -> None:
        for cloud, where in ((self.cloud, np.isfinite(self.result.values)), (self.failed, self.result.failed)):
            points, colours = self._points(where)
            # Fewer colours than points, for a moment, would be an error in the browser.
            with self._server.atomic():
                cloud.points = points.astype(np.float32)
                cloud.colors = colours

    def _points(self, where: NDArray[np.bool_]) -> tuple[FloatArray, ByteArray]:
        """Places and colours of some points of the cube, of those behind the cut."""
        if self.cut:
            behind = np.arange(len(self.result.axis_m)) >= self.indices[_CUT_AXIS]
            where = where & behind[None, :, None]
        points = np.stack([self.result.axis_m[index] for index in np.nonzero(where)], axis=-1)
        colours = np.broadcast_to(np.array(FAILED_COLOUR, dtype=np.uint8), (len(points), 3)).copy()
        values = self.result.values[where]
        known = np.isfinite(values)
        colours[known] = self._colours(values[known])
        return points, colours

    def _scale(self, share: FloatArray) -> ByteArray:
        return np.asarray(_SCALE(share, bytes=True)[..., :3], dtype=np.uint8)

    def _colours(self, values: FloatArray) -> ByteArray:
        low, high = self.limits
        if self.result.logarithmic:
            values, low, high = np.log(values), np.log(low), np.log(high)
        return self._scale((values - low) / max(high - low, 1e-12))

    def _all_colours(self) -> ByteArray:
        """Colour and opacity of every point (n, n, n, 4)."""
        values, failed = self.result.values, self.result.failed
        colours = np.zeros((*values.shape, 4), dtype=np.uint8)
        shown = np.isfinite(values)
        colours[failed] = (*FAILED_COLOUR, _FAILED_ALPHA)
        colours[shown, :3] = self._colours(values[shown])
        colours[shown, 3] = _SLICE_ALPHA
        return colours

    def _picture(self, i: int) -> ByteArray:
        """The plane across an axis, with cells of several pixels so that their edges stay sharp."""
        across, down = PICTURE_AXES[i]
        plane = np.take(self._colour_cube, self.indices[i], axis=i)
        if across < down:  # the plane's axes are in their order; rows go down
            plane = plane.swapaxes(0, 1)
        pixels = max(1, _PIXELS_OF_SLICE // len(plane))
        return np.repeat(np.repeat(plane, pixels, axis=0), pixels, axis=1)

    def _place(self, i: int) -> FloatArray:
        axis = self.result.axis_m
        place = np.full(3, 0.5 * (axis[0] + axis[-1]))
        place[i] = axis[self.indices[i]]
        return place


def _limits(result: MapResult) -> tuple[float, float]:
    values = result.values[np.isfinite(result.values)]
    if not values.size:
        return 1.0, 2.0
    low, high = float(values.min()), float(np.percentile(values, _TOP_PERCENTILE))
    if not result.logarithmic:
        high = float(np.ceil(high))
    return low, high if high > low else low + 1.0
