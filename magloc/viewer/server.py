"""Server of a page: start on a free port, static page, and picture."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import rich
import viser

from arrays.io.errors import InputError
from arrays.io.text import replace_file
from magloc.viewer.chromium import BrowserError, Chromium
from magloc.viewer.origin import SMOOTH, start_guarded_server
from magloc.viewer.panels.static_player import static_player
from magloc.viewer.scene.framing import PHONE_WIDTH
from magloc.viewer.scene.legend import BOTTOM_WITH_PLAYER, NARROW_PX, with_legend

if TYPE_CHECKING:
    from magloc.viewer.pages.pages import Page

HOST = "127.0.0.1"  # the viewer is for this machine, not for the network
FIRST_PORT = 8080
_PORTS = 20
_PICTURE_PX = (1280, 800)
_PANEL_PX = 330
_CONNECTION_S = 60.0
_PLAY = "the bar below plays the rows"
_PAUSE_S = 2.0  # on the first row, before the others are played
_CLOSE_NOTICES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"


def free_port(first: int) -> int:
    """Return the first port if it is free, or the next free one of 20; 0 returns any free port."""
    last = first if first == 0 else min(first + _PORTS - 1, 65535)
    for port in range(first, last + 1):
        with socket.socket() as probe:
            # Otherwise the port of a server that has just ended counts as in use.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return probe.getsockname()[1]
    raise InputError(f"Input port: found the ports {first} to {last} in use, expected a free port.")


@contextmanager
def open_server(port: int, title: str) -> Iterator[viser.ViserServer]:
    """Start a server on a free port, with a title above its panel, and stop it at the end."""
    with _silence():
        server = start_guarded_server(host=HOST, port=port, label=title, verbose=False)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(_PANEL_PX)
        server.on_client_connect(_phone_camera(server))
        yield server
    finally:
        with _silence():
            server.stop()


def _phone_camera(server: viser.ViserServer) -> Callable[[viser.ClientHandle], None]:
    """Return a callback that moves the first camera of a page as narrow as a phone back."""
    first = server.initial_camera

    def step_back(camera: viser.CameraHandle) -> None:
        farther = PHONE_WIDTH * camera.image_height / camera.image_width
        if camera.image_width < NARROW_PX and farther > 1.0 and np.allclose(camera.position, first.position, rtol=1e-3):
            camera.position = first.look_at + farther * (first.position - first.look_at)
            camera.look_at = first.look_at  # a change of the position moves it too

    def on_connect(client: viser.ClientHandle) -> None:
        client.camera.on_update(step_back)  # the page may set the first camera after it has connected
        step_back(client.camera)

    return on_connect


@contextmanager
def _silence() -> Iterator[None]:
    """Suppress the messages of viser on stdout and in a notebook."""
    console = rich.get_console()
    was_quiet, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = was_quiet


def address(server: viser.ViserServer) -> str:
    """Return the address of the server for a browser."""
    return f"http://{HOST}:{server.get_port()}"


def wait_for_interruption() -> None:
    """Wait for Ctrl-C, however often the browser is closed and opened."""
    forever = threading.Event()
    try:
        # A wait without a limit cannot be interrupted on every system.
        while not forever.wait(1.0):
            pass
    except KeyboardInterrupt:
        return


def page_html(server: viser.ViserServer, page: Page) -> str:
    """Return the scene as one self-contained HTML page, with a player for several rows."""
    playback = page.playback
    if playback is None:
        return with_legend(server.scene.as_html(), page.title, page.entries, page.notes)
    # Until it is played, the page shows the same row as a served page.
    recording = server.get_scene_serializer()
    recording.insert_sleep(_PAUSE_S)
    step_s, plot = playback.duration_s / len(playback.steps), page.plot
    texts, rows = [playback.row_html()], [] if plot is None else [plot.index]
    for step in playback.steps:
        playback.show(step)
        recording.insert_sleep(step_s)
        texts.append(playback.row_html())
        rows += [] if plot is None else [plot.index]
    html = recording.as_html()
    playback.show(playback.first)
    beside = static_player(texts, _PAUSE_S, step_s, plot, rows)
    notes = (*page.notes, _PLAY)
    return with_legend(html, page.title, page.entries, notes, bottom=BOTTOM_WITH_PLAYER, beside=beside)


def write_page(html: str, path: Path) -> None:
    """Write a page; raise InputError if that is not possible."""
    replace_file(path, lambda place: place.write_text(html, encoding="utf-8", newline="\n"))


def write_screenshot(server: viser.ViserServer, path: Path) -> None:
    """Write the page in a headless Chromium as a PNG file; raise InputError or BrowserError."""
    with open_page(server, _PICTURE_PX) as browser:
        picture = browser.screenshot()
    replace_file(path, lambda place: place.write_bytes(picture))


@contextmanager
def open_page(server: viser.ViserServer, size: tuple[int, int]) -> Iterator[Chromium]:
    """Open the page of a server in a headless Chromium, and wait until it is at rest."""
    with Chromium(address(server) + SMOOTH, size) as browser:
        browser.wait_for("document.querySelector('canvas') !== null")
        # The server sends the scene after the page has reported its camera. A blank page is at rest too.
        _wait_for_client(server)
        browser.settled_screenshot(before=_CLOSE_NOTICES)
        yield browser


def _wait_for_client(server: viser.ViserServer) -> None:
    deadline = time.monotonic() + _CONNECTION_S
    while not server.get_clients():
        if time.monotonic() > deadline:
            raise BrowserError(f"The page did not connect to the server within {_CONNECTION_S:g} s.")
        time.sleep(0.05)
