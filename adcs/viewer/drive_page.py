"""The page of a drive: scene, player and legend; and the same as a file that plays."""

from __future__ import annotations

from html import escape
from pathlib import Path

import numpy as np
import viser

from adcs.viewer.drive import Drive
from adcs.viewer.drive_player import DrivePlayer
from adcs.viewer.table_scene import TableScene, scene_entries, scene_extent
from arrays.io.errors import InputError
from arrays.io.text import write_text
from magloc.viewer.pages.pages import Page
from magloc.viewer.scene.framing import aim, prepare
from magloc.viewer.scene.legend import add_legend, legend_html

_STEP_S = 0.2
_MOST_STEPS = 1500


def drive_page(server: viser.ViserServer, drive: Drive, at_s: float) -> tuple[Page, DrivePlayer]:
    """Fill a server with a drive.

    Parameters
    ----------
    server : viser.ViserServer
    drive : Drive
    at_s : float
        Time that is shown at first.

    Returns
    -------
    Page
    DrivePlayer
        To be closed before the server is stopped.
    """
    extent = scene_extent(drive)
    prepare(server, extent)
    aim(server, extent)
    scene = TableScene(server.scene, drive)
    player = DrivePlayer(server, drive, scene)
    entries = scene_entries(drive)
    notes = (
        "Frames are rendered at the true pose of the exposure and identified when they are seen; the fixes are those "
        "of the simulated drive.",
        *((f"Errors are enlarged {scene.enlarged:g} times at first.",) if scene.enlarged > 1.0 else ()),
    )
    with server.gui.add_folder("Legend"):
        add_legend(server.gui, entries, notes)
    player.show_time(at_s)
    return Page(drive.title, entries, notes, player.close), player


def write_playing_page(server: viser.ViserServer, page: Page, player: DrivePlayer, drive: Drive, path: Path) -> None:
    """Write the whole drive as one HTML file that plays and needs nothing else.

    Parameters
    ----------
    server : viser.ViserServer
    page : Page
    player : DrivePlayer
    drive : Drive
    path : Path
        Replaced if it exists.

    Raises
    ------
    InputError
        It cannot be written.
    """
    player.show_time(0.0)
    recording = server.get_scene_serializer()
    step_s = max(_STEP_S, drive.duration_s / _MOST_STEPS)
    for time_s in np.arange(step_s, drive.duration_s, step_s):
        recording.insert_sleep(step_s)
        player.show_time(float(time_s))
    try:
        write_text(_with_legend(recording.as_html(), page), path)
    except OSError as error:
        raise InputError(f"--html {path} cannot be written ({error.strerror}).") from None


def _with_legend(html: str, page: Page) -> str:
    """As :func:`magloc.viewer.scene.legend.with_legend`, but above the bar that plays."""
    box = (
        '<div style="position:fixed;bottom:4em;left:.8em;z-index:1000;max-width:19rem;background:rgba(255,255,255,.9);'
        "color:#222;border-radius:.4em;box-shadow:0 1px 4px rgba(0,0,0,.25);font-family:sans-serif;"
        f'pointer-events:none"><div style="font-weight:600;padding:.5em .6em .2em">{escape(page.title)}</div>'
        f"{legend_html(page.entries, page.notes)}</div>"
    )
    before, end, after = html.rpartition("</body>")
    return f"{before}{box}{end}{after}"
