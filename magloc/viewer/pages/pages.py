"""Pages of the kinds of results: their glyphs, panels and legends."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import viser
from numpy.typing import NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.localization.fit.results import Fix
from magloc.readings import Readings
from magloc.surveying.results import Survey
from magloc.tracking.results import TrackPoint, TrackResult, on_track, track_column
from magloc.truth import nearest_rows
from magloc.viewer.pages import texts
from magloc.viewer.pages.field_panel import FieldPanel
from magloc.viewer.pages.fixes import FixView, best_positions, single_sources
from magloc.viewer.pages.live import LivePage
from magloc.viewer.pages.map import MapControls, MapView
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.pages.survey import SurveyScene
from magloc.viewer.pages.track_player import TrackPlayer, source_colours, time_colours
from magloc.viewer.panels.readings_plot import ReadingsPlot, residuals_of
from magloc.viewer.scene.framing import Extent, aim_camera, corners_of, extent_of, set_up_scene
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    FIELD_LINE_COLOUR,
    FIT_COLOUR,
    REGION_COLOUR,
    UNUSED_COLOUR,
    ArrayGlyphs,
    DipoleGlyph,
    add_label,
    add_lines,
    length_text,
)
from magloc.viewer.scene.legend import ColourScale, Entry, Swatch, legend_html
from magloc.viewer.scene.ruler import DropLines, add_ruler
from magloc.viewer.scene.shapes import line_segments

SENSOR_COLOUR = (90, 96, 105)
ARRAY_PATH_COLOUR = (0, 158, 115)
_AXES_NOTE = "axes of array and sensors: x red, y green, z blue"
# The first view ignores fixes that are farther than this from the array, in medians.
_FARTHEST_IN_MEDIANS = 3.0
# Size of the glyphs, in radii of the scene, below which the sensors' ids are not legible.
_LEAST_LEGIBLE = 0.04
_LIVE_RADII = 1.5  # half the side of the cube in the first view of a live page
_UNUSED = Swatch(UNUSED_COLOUR, "sensor that contradicts the others, and is not used")
_MOST_STEPS, _DURATIONS_S = 150, (5.0, 30.0)


@dataclass(frozen=True)
class Playback:
    """Playback of a page without a server.

    Attributes
    ----------
    steps : tuple of int
        Rows, one scene each.
    show : callable
        It shows a row in the scene and in all panels.
    duration_s : float
        Duration of the playback [s].
    first : int
        Row that a served page shows at first.
    row_html : callable
        It returns the text of the present row as HTML.
    """

    steps: tuple[int, ...]
    show: Callable[[int], None]
    duration_s: float
    first: int
    row_html: Callable[[], str]

    @classmethod
    def of_rows(
        cls, times_s: FloatArray, show: Callable[[int], None], first: int, row_html: Callable[[], str]
    ) -> Playback:
        """Return the playback of at most 150 rows in real time, limited to 5 s to 30 s."""
        n = len(times_s)
        steps = np.unique(np.linspace(0, n - 1, min(n, _MOST_STEPS)).round().astype(int))
        return cls(tuple(steps.tolist()), show, float(np.clip(np.ptp(times_s), *_DURATIONS_S)), first, row_html)


@dataclass(frozen=True)
class Page:
    """Contents of a page beside its scene.

    Attributes
    ----------
    title : str
    entries : tuple of Entry
        Entries of the legend.
    notes : tuple of str
        Notes below the legend.
    close : callable
        It ends the threads of the page. Call it before the server is stopped.
    playback : Playback, optional
        Playback of the static page.
    plot : ReadingsPlot, optional
        Plot of the readings that follows the playback.
    """

    title: str
    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    close: Callable[[], None] = lambda: None
    playback: Playback | None = None
    plot: ReadingsPlot | None = None


def array_page(server: viser.ViserServer, array: SensorArray, *, live: bool, file: Path | None = None) -> Page:
    """Fill a page with an array; a live page has editors, which may replace the file."""
    glyphs = ArrayGlyphs(server.scene, array)
    extent = extent_of(*(corners_of(place, glyphs.size_m) for place in array.positions))
    entries: list[Entry] = [_sensors_entry(array)]
    drops: list[DropLines] = []
    legend = server.gui.add_folder("Legend")
    if live and array.n_sensors > 1:
        # These modules take a second to load, and other pages do not need them.
        from magloc.viewer.pages.array_editor import ArrayEditor
        from magloc.viewer.pages.dipole_editor import DipoleEditor

        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Dipole"):
            dipole = DipoleEditor(server, array)
        with tabs.add_tab("Array"):
            ArrayEditor(server, array, on_change=[glyphs.set_array, dipole.set_array], file=file)
        drops = [dipole.drop]
        # The view includes the control and most of the field lines.
        extent = extent_of(extent.points_m, dipole.extent_m, corners_of(dipole.position_m, 0.8 * array.circumradius))
        entries += [
            Swatch(DIPOLE_COLOUR, "dipole to be dragged: the arrow is its moment"),
            Swatch(FIELD_LINE_COLOUR, "its field lines"),
            Swatch(FIT_COLOUR, "fix of its readings: thinner and longer"),
            Swatch(REGION_COLOUR, "95 % region by the Cramér-Rao bound; long where the range is not observable"),
        ]
    return _finish_page(server, legend, extent, array.name or "array", entries, drops=drops)


def readings_page(server: viser.ViserServer, array: SensorArray, fixes: Sequence[Fix], rows: Readings | None) -> Page:
    """Fill a page with the fixes of rows, and with their readings if given.

    The frame of the scene is the world if the rows have poses, otherwise that of the array.
    """
    gui = server.gui
    glyphs = ArrayGlyphs(server.scene, array)
    legend = gui.add_folder("Legend")
    centroids = _row_centroids(array, rows, len(fixes))
    fix_rows, positions = best_positions(fixes)
    near = _near_positions(positions, centroids[fix_rows])
    extent = extent_of(array.positions + (centroids - array.centroid)[:, None], near)
    size, dot = max(0.4 * array.circumradius, 0.11 * extent.radius_m), 0.012 * extent.radius_m
    times = np.array([fix.time_s for fix in fixes]) if rows is None else rows.time_s
    view = FixView(server, times, fixes, centroids, size_m=size, reach_m=1.4 * size, dot_m=dot)

    def move_array(row: int) -> None:
        if rows is not None and rows.pose is not None:
            glyphs.set_pose(rows.pose[0][row], rows.pose[1][row].as_quat())

    def mark_sensors(_: int) -> None:
        glyphs.mark_unused(view.dropped_sensors)

    move_array(view.row)
    mark_sensors(view.row)
    # The plot is below the slider of the row, but follows it.
    followers: list[Callable[[int], None]] = [move_array, mark_sensors]
    view.add_controls(followers)
    followers.append(FieldPanel(server, array, view, rows, size).show_row)
    plot = None
    if rows is not None and len(rows) > 1:
        sources = single_sources(fixes)
        residuals_T = None if sources is None else residuals_of(array, rows, *sources)
        plot = ReadingsPlot(server, rows, array, residuals_T)
        plot.show_row(view.row)
        plot.on_select(view.choose)
        followers.append(plot.show_row)
    if view.region.mesh is not None and view.region.visible:
        extent = extent_of(extent.points_m, view.region.mesh.vertices)
    entries = [*view.entries(), *_array_entries(server, glyphs, rows, extent)]
    if any(fix.dropped_sensors for fix in fixes):
        entries.append(_UNUSED)
    playback = None
    if len(fixes) > 1:
        playback = Playback.of_rows(times, lambda row: follow([view.show_row, *followers], row), view.row, view.html)
    name = array.name or "readings"
    return _finish_page(server, legend, extent, name, entries, drops=[view.drop], playback=playback, plot=plot)


def track_page(
    server: viser.ViserServer, result: TrackResult, array: SensorArray | None, rows: Readings | None
) -> Page:
    """Fill a page with tracks, and with their array and readings if given."""
    result = replace(result, points=tuple(on_track(result.points)))
    points, gui = result.points, server.gui
    each = [track_column(track, "position_m", 3) for track in result.tracks]
    positions = np.concatenate(each)
    legend = gui.add_folder("Legend")
    name = "true path" if result.is_truth else "track"
    entries = [*_line_entries(result, name), Swatch(DIPOLE_COLOUR, "direction of the moment at this time")]
    extent_points = [positions]
    followers: list[Callable[[int], None]] = []
    poses = on_pose = None
    if array is not None:
        glyphs = ArrayGlyphs(server.scene, array)
        on_pose = glyphs.set_pose
        followers.append(lambda index: glyphs.mark_unused(points[index].dropped_sensors))
        if rows is not None and rows.pose is not None:
            point_rows = _nearest_rows(rows, points)
            poses = (rows.pose[0][point_rows], rows.pose[1][point_rows].as_quat())
            extent_points.append(poses[0])
        else:
            extent_points.append(array.positions)
    extent = extent_of(*extent_points)
    if array is not None:
        entries += _array_entries(server, glyphs, rows, extent)
        if any(point.dropped_sensors for point in points):
            entries.append(_UNUSED)
    player = TrackPlayer(server, result, 0.2 * extent.radius_m, array_poses=poses, on_pose=on_pose, on_row=followers)
    plot = None
    if array is not None and rows is not None:
        point_rows = _nearest_rows(rows, points)
        residuals_T = None if result.ids else np.full_like(rows.values_T, np.nan)
        if residuals_T is not None:
            moments = track_column(points, "moment_Am2", 3)
            residuals_T[point_rows] = residuals_of(array, rows[point_rows], positions, moments)
        plot = ReadingsPlot(server, rows, array, residuals_T)
        show_row = plot.show_row
        show_row(int(point_rows[player.index]))
        followers.append(lambda index: show_row(int(point_rows[index])))
        times_s = track_column(points, "time_s")
        plot.on_select(lambda row: player.choose(int(nearest_rows(rows.time_s[[row]], times_s)[0])))
    nodes = [f"/times/of-{id}" for id in result.ids] or ["/times"]
    for node, place in zip(nodes, each, strict=True):
        tracked = np.flatnonzero(np.isfinite(place).all(axis=1))
        for i in dict.fromkeys(tracked[[0, -1]].tolist() if tracked.size else ()):
            below = place[i] - np.array([0.0, 0.0, 0.14 * extent.radius_m])  # the arrow of the moment may be above
            add_label(server.scene, f"{node}/{i}", f"{points[i].time_s:.6g} s", below)
    drops = [trail.drop for trail in player.trails]
    playback = None
    if len(points) > 1:
        times_s = track_column(points, "time_s")
        playback = Playback.of_rows(times_s, player.show_row, player.index, lambda: player.row_panel.content)
    close = player.pause
    return _finish_page(server, legend, extent, name, entries, close=close, drops=drops, playback=playback, plot=plot)


def _line_entries(result: TrackResult, name: str) -> list[Entry]:
    """Return the entries of the legend for tracks: a single one by time, several by source."""
    has_any = any(point.covariance is not None for track in result.tracks for point in track)
    ellipsoids = ", with 95 % ellipsoids" if has_any else ""
    if result.ids:
        sources = zip(result.ids, source_colours(result), strict=True)
        return [Swatch(colour, f"{result.kind} {id}{ellipsoids}") for id, colour in sources if colour is not None]
    first, last = (f"{result.points[i].time_s:.6g} s" for i in (0, -1))
    return [ColourScale.sample(f"{name}{ellipsoids}, by time", first, last, time_colours)]


def live_page(server: viser.ViserServer, array: SensorArray, live: LivePage) -> Page:
    """Fill a page with tracked sources, which are expected near the array."""
    legend = server.gui.add_folder("Legend", expand_by_default=False)
    extent = extent_of(array.positions, corners_of(array.centroid, _LIVE_RADII * array.circumradius))
    entries = [*live.entries(), _sensors_entry(array)]
    return _finish_page(server, legend, extent, array.name or "live", entries, close=live.close)


def map_page(server: viser.ViserServer, result: MapResult) -> Page:
    """Fill a page with a map over starts or sources."""
    legend = server.gui.add_folder("Legend")
    view = MapView(server, result)
    view.add_box()
    axis, array = result.axis_m, result.array
    glyphs = ArrayGlyphs(server.scene, array)
    entries = view.entries()
    if result.source_m is not None and result.moment_Am2 is not None:
        size = 0.09 * float(axis[-1] - axis[0])
        glyph = DipoleGlyph(server.scene, "/source", size, DIPOLE_COLOUR, label="source")
        glyph.show(result.source_m, result.moment_Am2)
        strength = float(np.linalg.norm(result.moment_Am2))
        entries.append(Swatch(DIPOLE_COLOUR, f"source: the arrow is its moment, {strength:.3g} A·m²"))
    MapControls(server, view)
    half = 0.5 * float(axis[-1] - axis[0])
    extent = extent_of(corners_of([axis[0] + half] * 3, half))
    entries += _array_entries(server, glyphs, None, extent)
    notes = [] if result.every == 1 else [f"Every {result.every}th point of the map along each axis is shown."]
    return _finish_page(server, legend, extent, result.title, entries, notes, ruler=False)  # the box has labels


def survey_page(
    server: viser.ViserServer,
    found: Survey,
    *,
    save: Callable[[Survey], str] | None = None,
    live: bool = False,
) -> Page:
    """Fill a page with a survey; a live page of one with its rows has a review, which is saved by a function."""
    legend = server.gui.add_folder("Legend")
    scene = SurveyScene(server, found)
    if live and found.state is not None:
        from magloc.viewer.pages.survey_review import ReviewPanel

        ReviewPanel(server, scene, save)
    return _finish_page(server, legend, extent_of(scene.points_m), repr(found), scene.entries, has_array=False)


def _finish_page(
    server: viser.ViserServer,
    legend: viser.GuiFolderHandle,
    extent: Extent,
    title: str,
    entries: Sequence[Entry],
    notes: Sequence[str] = (),
    close: Callable[[], None] = lambda: None,
    *,
    drops: Sequence[DropLines] = (),
    ruler: bool = True,
    has_array: bool = True,
    playback: Playback | None = None,
    plot: ReadingsPlot | None = None,
) -> Page:
    """Add floor, lights, camera, rulers and legend, and return the page."""
    floor = set_up_scene(server, extent)
    if ruler:
        points_m = np.vstack([extent.points_m, add_ruler(server.scene, extent, floor)])
        aim_camera(server, extent._replace(points_m=points_m))
    for lines in drops:
        lines.set_floor(floor, extent)
    height = f"floor at z = {length_text(floor.height_m)}"
    all_notes = (*notes, *[_AXES_NOTE] * has_array, height, f"one square of the floor: {length_text(floor.cell_m)}")
    with legend:
        server.gui.add_html(legend_html(entries, all_notes))
    return Page(title, tuple(entries), all_notes, close, playback, plot)


def follow(followers: Sequence[Callable[[int], None]], row: int) -> None:
    """Call all followers of the row."""
    for show in followers:
        show(row)


def _array_entries(
    server: viser.ViserServer, glyphs: ArrayGlyphs, rows: Readings | None, extent: Extent
) -> list[Entry]:
    """Return the entries of an array; add its path, and a label if it is small."""
    entries: list[Entry] = [_sensors_entry(glyphs.array)]
    if glyphs.size_m < _LEAST_LEGIBLE * extent.radius_m:
        glyphs.label_array("array")
    if rows is not None and rows.array_position_m is not None:
        path = line_segments(rows.array_position_m)
        add_lines(server.scene, "/array-path", path, ARRAY_PATH_COLOUR, 1.5, visible=bool(len(path)))
        entries.append(Swatch(ARRAY_PATH_COLOUR, "path of the array"))
    return entries


def _sensors_entry(array: SensorArray) -> Swatch:
    kinds = {sensor.kind for sensor in array.sensors}
    kind = f"{kinds.pop()} " if len(kinds) == 1 else ""
    least, most = (texts.field_text(bound([sensor.noise_T for sensor in array.sensors])) for bound in (min, max))
    noise = least if least == most else f"{least} to {most}"
    return Swatch(SENSOR_COLOUR, f"{array.n_sensors} {kind}sensor{'s' if array.n_sensors > 1 else ''}, noise {noise}")


def _row_centroids(array: SensorArray, rows: Readings | None, n: int) -> FloatArray:
    """Return the centroid of the sensors in every row, in the frame of the fixes (n, 3)."""
    if rows is None or rows.pose is None:
        return np.tile(array.centroid, (n, 1))
    origin_m, rotation = rows.pose
    return origin_m + np.asarray(rotation.apply(array.centroid.copy()))  # scipy does not accept a read-only array


def _nearest_rows(rows: Readings, points: Sequence[TrackPoint]) -> NDArray[np.intp]:
    """Return the row of the readings nearest in time to every point of a track."""
    order = np.argsort(rows.time_s, kind="stable")
    return order[nearest_rows(track_column(points, "time_s"), rows.time_s[order])]


def _near_positions(positions_m: FloatArray, centroids_m: FloatArray) -> FloatArray:
    """Return the positions without those that are much farther from the array than most."""
    distance = np.linalg.norm(positions_m - centroids_m, axis=1)
    known = np.isfinite(distance)
    if not known.any():
        return positions_m
    return positions_m[known & (distance <= _FARTHEST_IN_MEDIANS * np.median(distance[known]))]
