"""The page of a drive: scene, player and legend; and the same as a file that plays."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import viser

from adcs.viewer.drive import Drive
from adcs.viewer.drive_player import DrivePlayer
from adcs.viewer.table_scene import TableScene, scene_entries, scene_extent
from magloc.viewer.pages.pages import Page
from magloc.viewer.scene.framing import prepare
from magloc.viewer.scene.legend import ABOVE_THE_PLAYER, legend_html, with_legend
from magloc.viewer.server import write_page

_STEP_S = 0.2
_MOST_STEPS = 1500


def drive_page(server: viser.ViserServer, drive: Drive, at_s: float) -> tuple[Page, DrivePlayer]:
    """Fill a server with a drive at a time; the page is to be closed before the server is stopped."""
    extent = scene_extent(drive)
    prepare(server, extent)
    scene = TableScene(server.scene, drive)
    player = DrivePlayer(server, drive, scene)
    entries = scene_entries(drive)
    notes = (
        "Frames are rendered at the true pose of the exposure and identified when they are seen; the fixes are those "
        "of the simulated drive.",
        *((f"Errors are enlarged {scene.enlarged:g} times at first.",) if scene.enlarged > 1.0 else ()),
    )
    with server.gui.add_folder("Legend"):
        server.gui.add_html(legend_html(entries, notes))
    player.move_to(at_s)
    return Page(drive.title, entries, notes, player.pause), player


def write_playing_page(server: viser.ViserServer, page: Page, player: DrivePlayer, drive: Drive, path: Path) -> None:
    """Write the whole drive as one HTML file that plays and needs nothing else."""
    player.move_to(0.0)
    recording = server.get_scene_serializer()
    step_s = max(_STEP_S, drive.duration_s / _MOST_STEPS)
    for time_s in np.arange(step_s, drive.duration_s, step_s):
        recording.insert_sleep(step_s)
        player.move_to(float(time_s))
    html = with_legend(recording.as_html(), page.title, page.entries, page.notes, bottom=ABOVE_THE_PLAYER)
    write_page(html, path)
