"""Page of a drive: scene, player and legend."""

from __future__ import annotations

import numpy as np
import viser

from adcs.viewer.drive import Drive
from adcs.viewer.drive_player import DrivePlayer
from adcs.viewer.table_scene import TableScene, table_entries, table_extent
from magloc.viewer.pages.pages import Page, Playback
from magloc.viewer.scene.framing import set_up_scene
from magloc.viewer.scene.legend import legend_html

_STEP_S = 0.2
_MOST_STEPS = 1500


def drive_page(server: viser.ViserServer, drive: Drive, at_s: float) -> tuple[Page, DrivePlayer]:
    """Fill a page with a drive at a time. Close the page before the server is stopped."""
    set_up_scene(server, table_extent(drive))
    scene = TableScene(server.scene, drive)
    player = DrivePlayer(server, drive, scene)
    entries = table_entries(drive)
    notes = (
        "Frames are rendered at the true pose of the exposure and identified when they are seen; the fixes are those "
        "of the simulated drive.",
        *((f"Errors are enlarged {scene.enlargement:g} times at first.",) if scene.enlargement > 1.0 else ()),
    )
    with server.gui.add_folder("Legend"):
        server.gui.add_html(legend_html(entries, notes))
    player.move_to(at_s)
    steps_s = np.arange(0.0, drive.duration_s, max(_STEP_S, drive.duration_s / _MOST_STEPS))
    rows = tuple(drive.row_at(float(time_s)) for time_s in steps_s)
    playback = Playback(rows, player.show_row, drive.duration_s, player.row, lambda: player.row_panel.content)
    return Page(drive.title, entries, notes, player.pause, playback), player
