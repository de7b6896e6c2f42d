"""The page of an attitude: scene, player and legend."""

from __future__ import annotations

import numpy as np
import viser

from adcs.viewer.attitude_replay import ENLARGEMENTS, AttitudeReplay
from adcs.viewer.attitude_scene import AttitudeScene, scene_entries, scene_extent
from adcs.viewer.enlargement import enlargement_dropdown
from magloc.viewer.pages import words
from magloc.viewer.pages.pages import Page, Playing
from magloc.viewer.panels.played_time import PlayedTime, time_strip
from magloc.viewer.scene.framing import prepare
from magloc.viewer.scene.glyphs import FIT_COLOUR, OTHER_COLOUR
from magloc.viewer.scene.legend import legend_html


class AttitudePlayer(PlayedTime):
    """An attitude in the scene at one time, and the panels that move the time.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added where its GUI is at present.
    replay : AttitudeReplay
    scene : AttitudeScene
        Of this replay.

    Attributes
    ----------
    row : int
        That is shown.
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
            self.strips_panel = gui.add_html(strips(self._replay))

    def _show(self) -> None:
        last = int(np.searchsorted(self._since_first_s, self.now_s, side="right")) - 1
        self.row = max(0, last)
        with self._server.atomic():
            self._scene.show(self.row)
        self._time.show(float(self._since_first_s[self.row]))
        self.row_panel.content = words.panel(row_words(self._replay, self.row))


def row_words(replay: AttitudeReplay, row: int) -> list[str]:
    """What is known in a row, as lines of HTML."""
    lines = [f"row {row + 1} of {len(replay.time_s)}, time {replay.time_s[row]:.3f} s"]
    lines.append("w, x, y, z: " + ", ".join(f"{part:.5f}" for part in replay.q[row]))
    sigma = np.degrees(replay.sigma_rad[row])
    if np.isfinite(sigma).all():
        lines.append("σ x {:.3g}°, y {:.3g}°, z {:.3g}°".format(*sigma))
    if replay.known[row]:
        lines.append(f"error <b>{float(np.degrees(np.linalg.norm(replay.errors_rad[row]))):.3g}°</b>")
    for name, there in replay.seen.items():
        if not there[row]:
            lines.append(f"no reading of {name}")
        elif name in replay.rejected and replay.rejected[name][row]:
            lines.append(f"{name} not used")
    return lines


def strips(replay: AttitudeReplay) -> str:
    """A strip along the time for every sensor: coloured where it is used, as HTML."""
    since = replay.time_s - replay.time_s[0]
    lines = []
    for name, there in replay.seen.items():
        left_out = replay.rejected.get(name)
        used = there if left_out is None else there & ~left_out
        text = f"{name}: {there.sum()} of {len(since)} rows"
        text += "" if left_out is None else f", {left_out.sum()} not used"
        lines += [time_strip(since, used, FIT_COLOUR if left_out is None else OTHER_COLOUR), text]
    return words.panel(lines)


def attitude_page(server: viser.ViserServer, replay: AttitudeReplay) -> Page:
    """Fill a server with a replay; the page is to be closed before the server is stopped."""
    prepare(server, scene_extent())
    server.scene.remove_by_name("/floor")
    scene = AttitudeScene(server.scene, replay)
    player = AttitudePlayer(server, replay, scene)
    larger = f"Errors and cones are drawn {scene.enlarged:g} times larger than they are."
    notes = (larger,) if scene.enlarged > 1.0 else ()
    entries = scene_entries(replay)
    with server.gui.add_folder("Legend"):
        server.gui.add_html(legend_html(entries, notes))
    playing = None
    if len(replay.time_s) > 1:
        playing = Playing.of(replay.time_s, player.show_row, player.row, lambda: player.row_panel.content)
    return Page(replay.title, entries, notes, player.pause, playing)
