"""Which glyphs, panels and legend each kind of result gets."""

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
from magloc.viewer.pages import words
from magloc.viewer.pages.field_panel import FieldPanel
from magloc.viewer.pages.fixes import FixView, best_positions, single_sources
from magloc.viewer.pages.live import LivePage
from magloc.viewer.pages.map import MapControls, MapView
from magloc.viewer.pages.open_result import MapResult
from magloc.viewer.pages.survey import add_survey
from magloc.viewer.pages.track_player import TrackPlayer, source_colours, time_colours
from magloc.viewer.panels.readings_plot import ReadingsPlot, residuals_of
from magloc.viewer.scene.framing import Extent, aim, corners_of, extent_of, prepare
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    FIELD_LINE_COLOUR,
    FIT_COLOUR,
    REGION_COLOUR,
    UNUSED_COLOUR,
    ArrayGlyphs,
    DipoleGlyph,
    length_text,
    screen_label,
    screen_lines,
)
from magloc.viewer.scene.legend import ColourScale, Entry, Swatch, legend_html
from magloc.viewer.scene.ruler import DropLines, add_ruler
from magloc.viewer.scene.shapes import line_segments

SENSOR_COLOUR = (90, 96, 105)
ARRAY_PATH_COLOUR = (0, 158, 115)
AXES_WORDS = "axes of array and sensors: x red, y green, z blue"
# Fixes farther than this from the array, in medians, do not move the first camera away from the others.
_FARTHEST_IN_MEDIANS = 3.0
# Size of the glyphs, in radii of the scene, below which the sensors' ids are specks.
_LEAST_LEGIBLE = 0.04
_LIVE_RADII = 1.5  # half the side of the cube that a live page shows at first
_SHADES = 9
_UNUSED = Swatch(UNUSED_COLOUR, "sensor that contradicts the others, and is not used")
_MOST_STEPS, _PLAYED_S = 150, (5.0, 30.0)


@dataclass(frozen=True)
class Playing:
    """What a page without a server plays: a sequence of scenes.

    Attributes
    ----------
    steps : tuple of int
        Rows, one scene each.
    show : callable
        Shows a row, with all that follows it.
    duration_s : float
        How long it takes to play them.
    first : int
        Row that the live page shows at first.
    said : callable
        What is said of the row that is shown, as HTML.
    """

    steps: tuple[int, ...]
    show: Callable[[int], None]
    duration_s: float
    first: int
    said: Callable[[], str]

    @classmethod
    def of(cls, times_s: FloatArray, show: Callable[[int], None], first: int, said: Callable[[], str]) -> Playing:
        """Of all rows, or of 150, evenly: as long as they took, but 5 s at least and 30 s at most."""
        n = len(times_s)
        steps = np.unique(np.linspace(0, n - 1, min(n, _MOST_STEPS)).round().astype(int))
        return cls(tuple(steps.tolist()), show, float(np.clip(np.ptp(times_s), *_PLAYED_S)), first, said)


@dataclass(frozen=True)
class Page:
    """What is said beside the scene.

    Attributes
    ----------
    title : str
    entries : tuple of Entry
        Of the legend.
    notes : tuple of str
        Below the legend.
    close : callable
        Ends what runs by itself; to be called before the server is stopped.
    playing : Playing, optional
        What its static page plays.
    plot : ReadingsPlot, optional
        Readings that follow what is played.
    """

    title: str
    entries: tuple[Entry, ...]
    notes: tuple[str, ...]
    close: Callable[[], None] = lambda: None
    playing: Playing | None = None
    plot: ReadingsPlot | None = None


def array_page(server: viser.ViserServer, array: SensorArray, *, live: bool, file: Path | None = None) -> Page:
    """An array; live if somebody is there to drag a dipole and the sensors, and to replace its file."""
    glyphs = ArrayGlyphs(server.scene, array)
    ball = extent_of(*(corners_of(place, glyphs.size_m) for place in array.positions))
    entries: list[Entry] = [_sensors_entry(array)]
    drops: list[DropLines] = []
    legend = server.gui.add_folder("Legend")
    if live and array.n_sensors > 1:
        # What fits readings takes a second to load, and the other pages do without.
        from magloc.viewer.pages.array_editor import ArrayEditor
        from magloc.viewer.pages.dipole_editor import DipoleEditor

        tabs = server.gui.add_tab_group()
        with tabs.add_tab("Dipole"):
            dipole = DipoleEditor(server, array)
        with tabs.add_tab("Array"):
            follow = [glyphs.set_array, dipole.set_array]
            ArrayEditor(server, array, on_change=follow, parent="/array", file=file)
        drops = [dipole.drop]
        # Its control and most of its field lines too.
        ball = extent_of(ball.points_m, dipole.extent_m, corners_of(dipole.position_m, 0.8 * array.circumradius))
        entries += [
            Swatch(DIPOLE_COLOUR, "dipole to be dragged: the arrow is its moment"),
            Swatch(FIELD_LINE_COLOUR, "its field lines"),
            Swatch(FIT_COLOUR, "what a fix of its readings finds: thinner and longer"),
            Swatch(REGION_COLOUR, "95 % region by the Cramér-Rao bound; long where the range is not observable"),
        ]
    return _finished(server, legend, ball, array.name or "array", entries, drops=drops)


def readings_page(server: viser.ViserServer, array: SensorArray, fixes: Sequence[Fix], rows: Readings | None) -> Page:
    """The fixes of rows, in the world frame if the array's pose is known; with the readings themselves, if given."""
    gui = server.gui
    glyphs = ArrayGlyphs(server.scene, array)
    legend = gui.add_folder("Legend")
    centroids = _centroids(array, rows, len(fixes))
    of_row, positions = best_positions(fixes)
    near = _not_far(positions, centroids[of_row])
    ball = extent_of(array.positions + (centroids - array.centroid)[:, None], near)
    size, dot = max(0.4 * array.circumradius, 0.11 * ball.radius_m), 0.012 * ball.radius_m
    times = np.array([fix.time_s for fix in fixes]) if rows is None else rows.time_s
    view = FixView(server, times, fixes, centroids, size_m=size, reach_m=1.4 * size, dot_m=dot)

    def move_array(row: int) -> None:
        if rows is not None and rows.pose is not None:
            glyphs.set_pose(rows.pose[0][row], rows.pose[1][row].as_quat())

    def mark_sensors(_: int) -> None:
        glyphs.mark(view.dropped)

    move_array(view.row)
    mark_sensors(view.row)
    # The plot stands below the choice of the row, which has to move its mark.
    followers: list[Callable[[int], None]] = [move_array, mark_sensors]
    view.add_controls(followers)
    followers.append(FieldPanel(server, array, view, rows, size).show_row)
    plot = None
    if rows is not None and len(rows) > 1:
        sources = single_sources(fixes)
        left = None if sources is None else residuals_of(array, rows, *sources)
        plot = ReadingsPlot(server, rows, array, left)
        plot.show_row(view.row)
        plot.when_pointed(view.choose)
        followers.append(plot.show_row)
    if view.region.mesh is not None and view.region.visible:
        ball = extent_of(ball.points_m, view.region.mesh.vertices)
    entries = [*view.entries(), *_array_entries(server, glyphs, rows, ball)]
    if any(fix.dropped_sensors for fix in fixes):
        entries.append(_UNUSED)
    playing = None
    if len(fixes) > 1:
        playing = Playing.of(times, lambda row: follow([view.show_row, *followers], row), view.row, view.words)
    name = array.name or "readings"
    return _finished(server, legend, ball, name, entries, drops=[view.drop], playing=playing, plot=plot)


def track_page(
    server: viser.ViserServer, result: TrackResult, array: SensorArray | None, rows: Readings | None
) -> Page:
    """Tracks, with the array that found them and its readings, if they are given."""
    result = replace(result, points=tuple(on_track(result.points)))
    points, gui = result.points, server.gui
    each = [track_column(track, "position_m", 3) for track in result.tracks]
    positions = np.concatenate(each)
    legend = gui.add_folder("Legend")
    name = "true path" if result.is_truth else "track"
    entries = [*_line_entries(result, name), Swatch(DIPOLE_COLOUR, "direction of the moment at this time")]
    seen = [positions]
    followers: list[Callable[[int], None]] = []
    poses = on_pose = None
    if array is not None:
        glyphs = ArrayGlyphs(server.scene, array)
        on_pose = glyphs.set_pose
        followers.append(lambda index: glyphs.mark(points[index].dropped_sensors))
        if rows is not None and rows.pose is not None:
            of_point = _nearest_rows(rows, points)
            poses = (rows.pose[0][of_point], rows.pose[1][of_point].as_quat())
            seen.append(poses[0])
        else:
            seen.append(array.positions)
    ball = extent_of(*seen)
    if array is not None:
        entries += _array_entries(server, glyphs, rows, ball)
        if any(point.dropped_sensors for point in points):
            entries.append(_UNUSED)
    player = TrackPlayer(server, result, 0.2 * ball.radius_m, array_poses=poses, on_pose=on_pose, on_row=followers)
    plot = None
    if array is not None and rows is not None:
        of_point = _nearest_rows(rows, points)
        left = None if result.ids else np.full_like(rows.values_T, np.nan)
        if left is not None:
            left[of_point] = residuals_of(array, rows[of_point], positions, track_column(points, "moment_Am2", 3))
        plot = ReadingsPlot(server, rows, array, left)
        show_row = plot.show_row
        show_row(int(of_point[player.index]))
        followers.append(lambda index: show_row(int(of_point[index])))
        times_s = track_column(points, "time_s")
        plot.when_pointed(lambda row: player.choose(int(nearest_rows(rows.time_s[[row]], times_s)[0])))
    nodes = [f"/times/of-{id}" for id in result.ids] or ["/times"]
    for node, place in zip(nodes, each, strict=True):
        tracked = np.flatnonzero(np.isfinite(place).all(axis=1))
        for i in dict.fromkeys(tracked[[0, -1]].tolist() if tracked.size else ()):
            below = place[i] - np.array([0.0, 0.0, 0.14 * ball.radius_m])  # above, the arrow of the moment may be
            screen_label(server.scene, f"{node}/{i}", f"{points[i].time_s:.6g} s", below)
    drops = [trail.drop for trail in player.trails]
    playing = None
    if len(points) > 1:
        playing = Playing.of(
            track_column(points, "time_s"), player.show_row, player.index, lambda: player.row_panel.content
        )
    return _finished(server, legend, ball, name, entries, close=player.pause, drops=drops, playing=playing, plot=plot)


def _line_entries(result: TrackResult, name: str) -> list[Entry]:
    """Lines of the legend for the tracks: one by time, several by source."""
    ellipsoids = "" if result.is_truth else ", with 95 % ellipsoids"
    if result.ids:
        sources = zip(result.ids, source_colours(result), strict=True)
        return [Swatch(colour, f"source {id}{ellipsoids}") for id, colour in sources if colour is not None]
    shades = time_colours(np.linspace(0.0, 1.0, _SHADES)).tolist()
    colours = tuple((red, green, blue) for red, green, blue in shades)
    first, last = (f"{result.points[i].time_s:.6g} s" for i in (0, -1))
    return [ColourScale(f"{name}{ellipsoids}, by time", first, last, colours)]


def live_page(server: viser.ViserServer, array: SensorArray, live: LivePage) -> Page:
    """A source that is followed while its readings come in, which is expected within three radii of the array."""
    legend = server.gui.add_folder("Legend", expand_by_default=False)
    ball = extent_of(array.positions, corners_of(array.centroid, _LIVE_RADII * array.circumradius))
    entries = [*live.entries(), _sensors_entry(array)]
    return _finished(server, legend, ball, array.name or "live", entries, close=live.close)


def map_page(server: viser.ViserServer, result: MapResult) -> Page:
    """A map over starts or sources."""
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
    ball = extent_of(corners_of([axis[0] + half] * 3, half))
    entries += _array_entries(server, glyphs, None, ball)
    notes = [] if result.every == 1 else [f"Every {result.every}th point of the map along each axis is shown."]
    return _finished(server, legend, ball, result.title, entries, notes, ruler=False)  # its box has numbers


def survey_page(server: viser.ViserServer, found: Survey) -> Page:
    """A survey: rows, ground and targets."""
    legend = server.gui.add_folder("Legend")
    entries, points = add_survey(server, found)
    return _finished(server, legend, extent_of(points), repr(found), entries, of_array=False)


def _finished(
    server: viser.ViserServer,
    legend: viser.GuiFolderHandle,
    ball: Extent,
    title: str,
    entries: Sequence[Entry],
    notes: Sequence[str] = (),
    close: Callable[[], None] = lambda: None,
    *,
    drops: Sequence[DropLines] = (),
    ruler: bool = True,
    of_array: bool = True,
    playing: Playing | None = None,
    plot: ReadingsPlot | None = None,
) -> Page:
    """Floor, light, camera, axes, what stands on the floor, and legend."""
    floor = prepare(server, ball)
    if ruler:
        aim(server, ball._replace(points_m=np.vstack([ball.points_m, add_ruler(server.scene, ball, floor)])))
    for lines in drops:
        lines.stand_on(floor, ball)
    height = f"floor at z = {length_text(floor.height_m)}"
    all_notes = (*notes, *[AXES_WORDS] * of_array, height, f"one square of the floor: {length_text(floor.cell_m)}")
    with legend:
        server.gui.add_html(legend_html(entries, all_notes))
    return Page(title, tuple(entries), all_notes, close, playing, plot)


def follow(followers: Sequence[Callable[[int], None]], row: int) -> None:
    """Let all that follows a row show it."""
    for show in followers:
        show(row)


def _array_entries(server: viser.ViserServer, glyphs: ArrayGlyphs, rows: Readings | None, ball: Extent) -> list[Entry]:
    """Lines of the legend for an array that may be small in the scene, and may move through it."""
    entries: list[Entry] = [_sensors_entry(glyphs.array)]
    if glyphs.size_m < _LEAST_LEGIBLE * ball.radius_m:
        glyphs.name_as_a_whole("array")
    if rows is not None and rows.array_position_m is not None:
        path = line_segments(rows.array_position_m)
        screen_lines(server.scene, "/array-path", path, ARRAY_PATH_COLOUR, 1.5, visible=bool(len(path)))
        entries.append(Swatch(ARRAY_PATH_COLOUR, "path of the array"))
    return entries


def _sensors_entry(array: SensorArray) -> Swatch:
    kinds = {sensor.kind for sensor in array.sensors}
    kind = f"{kinds.pop()} " if len(kinds) == 1 else ""
    least, most = (words.field_text(bound([sensor.noise_T for sensor in array.sensors])) for bound in (min, max))
    noise = least if least == most else f"{least} to {most}"
    return Swatch(SENSOR_COLOUR, f"{array.n_sensors} {kind}sensor{'s' if array.n_sensors > 1 else ''}, noise {noise}")


def _centroids(array: SensorArray, rows: Readings | None, n: int) -> FloatArray:
    """Mean position of the sensors at every row, in the frame of the fixes (n, 3)."""
    if rows is None or rows.pose is None:
        return np.tile(array.centroid, (n, 1))
    origin_m, rotation = rows.pose
    return origin_m + np.asarray(rotation.apply(array.centroid.copy()))  # scipy takes no read-only array


def _nearest_rows(rows: Readings, points: Sequence[TrackPoint]) -> NDArray[np.intp]:
    """The row of the readings that is nearest in time, for every point of a track."""
    order = np.argsort(rows.time_s, kind="stable")
    return order[nearest_rows(track_column(points, "time_s"), rows.time_s[order])]


def _not_far(positions_m: FloatArray, centroids_m: FloatArray) -> FloatArray:
    """Positions without those that are much farther from the array than most."""
    distance = np.linalg.norm(positions_m - centroids_m, axis=1)
    known = np.isfinite(distance)
    if not known.any():
        return positions_m
    return positions_m[known & (distance <= _FARTHEST_IN_MEDIANS * np.median(distance[known]))]
