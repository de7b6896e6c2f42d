"""Player of a drive: time, speed, enlargement of errors, and the camera's frame.

Use::

    player = DrivePlayer(server, drive, scene)
    player.move_to(90.0)
    player.play()
    player.pause()                           # ends the thread; call it before server.stop()
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import viser

from adcs.viewer.drive import Drive
from adcs.viewer.enlargement import enlargement_dropdown
from adcs.viewer.error_dial import ErrorDial, estimate_lines
from adcs.viewer.frame_image import identified_stars, mark_stars
from adcs.viewer.table_scene import ENLARGEMENTS, TableScene
from magloc.viewer.pages import texts
from magloc.viewer.panels.time_player import TimePlayer

_CACHE_SIZE = 32
_JPEG_QUALITY = 85


class DrivePlayer(TimePlayer):
    """Player of a drive in the scene.

    Frames are rendered and identified when they become visible, and a few are cached.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    drive : Drive
    scene : TableScene
        Scene of the drive.

    Attributes
    ----------
    row : int
        Present row.
    """

    def __init__(self, server: viser.ViserServer, drive: Drive, scene: TableScene) -> None:
        self._drive, self._scene = drive, scene
        self.row = 0
        self._frame_of = lru_cache(_CACHE_SIZE)(drive.frame_of)
        self._dial = ErrorDial(drive)
        self._shown_fix: int | None = None
        self._add_panels(server.gui)
        self.move_to(0.0)

    def show_row(self, row: int) -> None:
        """Show the drive at the time of a row."""
        self.move_to(float(self._drive.truth.time_s[row]))

    def _add_panels(self, gui: viser.GuiApi) -> None:
        with gui.add_folder("Time"):
            super().__init__(gui, self._drive.duration_s, self._show, "adcs-drive-player")
            hint = "how many times larger the scene shows the estimate's error and its ellipse"
            self.enlarge_dropdown = enlargement_dropdown(gui, self._scene, ENLARGEMENTS, hint, self._follow)
        self.row_panel = gui.add_html("")
        tabs = gui.add_tab_group()
        with tabs.add_tab("Camera"):
            height, width = self._drive.camera.height_px, self._drive.camera.width_px
            self._blank = np.full((height, width, 3), 40, dtype=np.uint8)
            self.frame_image = gui.add_image(self._blank, format="jpeg", jpeg_quality=_JPEG_QUALITY)
            self.frame_panel = gui.add_html("")
        with tabs.add_tab("Error"):
            self.dial_panel = gui.add_html("")

    def _show(self) -> None:
        drive = self._drive
        self.row = row = drive.row_at(self.now_s)
        fix = drive.last_fix(row)
        frame = None if fix is None else self._frame_of(fix)
        self._scene.show(row, frame)
        self._time.show(float(drive.truth.time_s[row]))
        self.row_panel.content = texts.panel_html(estimate_lines(drive, row))
        ellipse = "" if drive.sigma_m is None else ", with its 3σ ellipse"
        self.dial_panel.content = self._dial.svg(row) + texts.panel_html(
            [f"cross: truth; dot: estimate{ellipse}; line: the last 5 s. Table axes."]
        )
        if fix == self._shown_fix:
            return
        self._shown_fix = fix
        if frame is None:
            self.frame_image.image = self._blank
            self.frame_panel.content = texts.panel_html(["no fix has arrived"])
            return
        self.frame_image.image = mark_stars(frame)
        n = len(identified_stars(frame))
        text = f"frame of the last fix: {n} of {len(frame.stars_px)} stars identified"
        self.frame_panel.content = texts.panel_html([text])
