"""A drive played through time: slider, play and pause, speed, enlargement of errors; the camera's frame beside it.

Use::

    player = DrivePlayer(server, drive, scene)
    player.move_to(90.0)
    player.play()
    player.pause()                           # ends the playing thread; call it before server.stop()
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import viser

from adcs.viewer.drive import Drive
from adcs.viewer.enlargement import enlargement_dropdown
from adcs.viewer.error_dial import ErrorDial, words_of
from adcs.viewer.frame_image import marked_image, named_stars
from adcs.viewer.table_scene import ENLARGEMENTS, TableScene
from magloc.viewer.pages import words
from magloc.viewer.panels.played_time import PlayedTime

_FRAMES_KEPT = 32
_JPEG_QUALITY = 85


class DrivePlayer(PlayedTime):
    """A drive in the scene at one time, and the panels that move the time.

    Frames are rendered and identified when they are to be seen, and a few are kept.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added where its GUI is at present.
    drive : Drive
    scene : TableScene
        Of this drive.

    Attributes
    ----------
    row : int
        That is shown.
    """

    def __init__(self, server: viser.ViserServer, drive: Drive, scene: TableScene) -> None:
        self._drive, self._scene = drive, scene
        self.row = 0
        self._frame_of = lru_cache(_FRAMES_KEPT)(drive.frame_of)
        self._dial = ErrorDial(drive)
        self._pictured: int | None = None
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
        self.row_panel.content = words.panel(words_of(drive, row))
        believed = "" if drive.sigma_m is None else ", with its 3σ ellipse"
        self.dial_panel.content = self._dial.svg(row) + words.panel(
            [f"cross: truth; dot: estimate{believed}; line: the last 5 s. Table axes."]
        )
        if fix == self._pictured:
            return
        self._pictured = fix
        if frame is None:
            self.frame_image.image = self._blank
            self.frame_panel.content = words.panel(["no fix has arrived"])
            return
        self.frame_image.image = marked_image(frame)
        named = len(named_stars(frame))
        text = f"frame that the last fix came from: {named} of {len(frame.stars_px)} stars identified"
        self.frame_panel.content = words.panel([text])
