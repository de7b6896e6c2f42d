"""Page of an attitude: scene, player and legend."""

from __future__ import annotations

import numpy as np
import viser

from adcs.viewer.attitude_replay import ENLARGEMENTS, AttitudeReplay
from adcs.viewer.attitude_scene import AttitudeScene, attitude_entries, attitude_extent
from adcs.viewer.enlargement import enlargement_dropdown
from magloc.viewer.pages import texts
from magloc.viewer.pages.pages import Page, Playback
from magloc.viewer.panels.time_player import TimePlayer, time_strip
from magloc.viewer.scene.framing import set_up_scene
from magloc.viewer.scene.glyphs import FIT_COLOUR, OTHER_COLOUR
from magloc.viewer.scene.legend import legend_html


class AttitudePlayer(TimePlayer):
    """Player of an attitude in the scene.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    replay : AttitudeReplay
    scene : AttitudeScene
        Scene of the replay.

    Attributes
    ----------
    row : int
        Present row.
    """

    def __init__(self, server: viser.ViserServer, replay: AttitudeReplay, scene: AttitudeScene) -> None:
        self._server, self._replay, self._scene = server, replay, scene
        self._since_first_s = replay.time_s - replay.time_s[0]
        self.row = len(replay.time_s) - 1
        self._add_panels(server.gui)
        self.show_row(self.row)

    def show_row(self, row: int) -> None:
        """Show the attitude at the time of a row."""
        self.move_to(float(self._since_first_s[row]))

    def _add_panels(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Time"):
            super().__init__(gui, float(self._since_first_s[-1]), self._show, "adcs-attitude-player")
            hint = "how many times larger the scene shows errors and cones"
            self.enlarge_dropdown = enlargement_dropdown(gui, self._scene, ENLARGEMENTS, hint, self._follow)
        with gui.add_folder("At this time"):
            self.row_panel = gui.add_html("")
        with gui.add_folder("Readings"):
            gui.add_html(strips_html(self._replay))

    def _show(self) -> None:
        last = int(np.searchsorted(self._since_first_s, self.now_s, side="right")) - 1
        self.row = max(0, last)
        with self._server.atomic():
            self._scene.show(self.row)
        self._time.show(float(self._since_first_s[self.row]))
        self.row_panel.content = texts.panel_html(row_lines(self._replay, self.row))


def row_lines(replay: AttitudeReplay, row: int) -> list[str]:
    """Return the state in a row as lines of HTML."""
    lines = [f"row {row + 1} of {len(replay.time_s)}, time {replay.time_s[row]:.3f} s"]
    lines.append("w, x, y, z: " + ", ".join(f"{part:.5f}" for part in replay.q[row]))
    sigma = np.degrees(replay.sigma_rad[row])
    if np.isfinite(sigma).all():
        lines.append("σ x {:.3g}°, y {:.3g}°, z {:.3g}°".format(*sigma))
    if replay.known[row]:
        lines.append(f"error <b>{float(np.degrees(np.linalg.norm(replay.errors_rad[row]))):.3g}°</b>")
    for name, has_reading in replay.seen.items():
        if not has_reading[row]:
            lines.append(f"no reading of {name}")
        elif name in replay.rejected and replay.rejected[name][row]:
            lines.append(f"{name} not used")
    return lines


def strips_html(replay: AttitudeReplay) -> str:
    """Return a strip along the time for every sensor, coloured where it is used."""
    since = replay.time_s - replay.time_s[0]
    lines = []
    for name, has_reading in replay.seen.items():
        is_rejected = replay.rejected.get(name)
        is_used = has_reading if is_rejected is None else has_reading & ~is_rejected
        text = f"{name}: {has_reading.sum()} of {len(since)} rows"
        text += "" if is_rejected is None else f", {is_rejected.sum()} not used"
        lines += [time_strip(since, is_used, FIT_COLOUR if is_rejected is None else OTHER_COLOUR), text]
    return texts.panel_html(lines)


def attitude_page(server: viser.ViserServer, replay: AttitudeReplay) -> Page:
    """Fill a page with a replay. Close the page before the server is stopped."""
    set_up_scene(server, attitude_extent())
    server.scene.remove_by_name("/floor")
    scene = AttitudeScene(server.scene, replay)
    player = AttitudePlayer(server, replay, scene)
    note = f"Errors and cones are enlarged {scene.enlargement:g} times at first."
    notes = (note,) if scene.enlargement > 1.0 else ()
    entries = attitude_entries(replay)
    with server.gui.add_folder("Legend"):
        server.gui.add_html(legend_html(entries, notes))
    playback = None
    if len(replay.time_s) > 1:
        playback = Playback.of_rows(replay.time_s, player.show_row, player.row, lambda: player.row_panel.content)
    return Page(replay.title, entries, notes, player.pause, playback)
