"""A viser server: opened on a free port of this machine, filled with a result, written as a page or a picture."""

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
from arrays.io.text import replaced, write_text
from magloc.viewer.chromium import BrowserError, Chromium
from magloc.viewer.origin import SMOOTH, guarded_server
from magloc.viewer.panels.static_player import static_player
from magloc.viewer.scene.framing import SIDES_OF_A_PHONE
from magloc.viewer.scene.legend import ABOVE_THE_PLAYER, NARROW_PX, with_legend

if TYPE_CHECKING:
    from magloc.viewer.pages.pages import Page

HOST = "127.0.0.1"  # a viewer for whoever sits at this machine, not for the network
FIRST_PORT = 8080
_PORTS = 20
_PICTURE_PX = (1280, 800)
_PANEL_PX = 330
_CONNECTION_S = 60.0
_PLAY = "the bar below plays the rows"
_STANDS_S = 2.0  # on the first row, before the others are played
_CLOSE_NOTICES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"


def free_port(wanted: int) -> int:
    """A port of this machine on which nobody listens: the one that is wanted, or of the next 19; 0 takes any."""
    last = wanted if wanted == 0 else min(wanted + _PORTS - 1, 65535)
    for port in range(wanted, last + 1):
        with socket.socket() as probe:
            # Else a port of a server that ended a moment ago counts as in use.
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return probe.getsockname()[1]
    raise InputError(f"Input port: found the ports {wanted} to {last} in use, expected a free one.")


@contextmanager
def opened(port: int, title: str) -> Iterator[viser.ViserServer]:
    """A server on a free port, its title above the panel, that is stopped afterwards, whatever happens."""
    with _silent():
        server = guarded_server(host=HOST, port=port, label=title, verbose=False)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        server.gui.main_panel.set_width(_PANEL_PX)
        server.on_client_connect(_steps_back(server))
        yield server
    finally:
        with _silent():
            server.stop()


def _steps_back(server: viser.ViserServer) -> Callable[[viser.ClientHandle], None]:
    """Let a page as narrow as a phone see from farther back what a wider one shows from the first camera."""
    first = server.initial_camera

    def step_back(camera: viser.CameraHandle) -> None:
        farther = SIDES_OF_A_PHONE * camera.image_height / camera.image_width
        if camera.image_width < NARROW_PX and farther > 1.0 and np.allclose(camera.position, first.position, rtol=1e-3):
            camera.position = first.look_at + farther * (first.position - first.look_at)
            camera.look_at = first.look_at  # a camera that moves takes it along

    def connected(client: viser.ClientHandle) -> None:
        client.camera.on_update(step_back)  # the page may take the first camera after it has connected
        step_back(client.camera)

    return connected


@contextmanager
def _silent() -> Iterator[None]:
    """Without viser's own greetings, which go to stdout and, in a notebook, beside it."""
    console = rich.get_console()
    was, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = was


def address(server: viser.ViserServer) -> str:
    """Where a browser finds the server."""
    return f"http://{HOST}:{server.get_port()}"


def wait_for_interruption() -> None:
    """Return after Ctrl-C. A browser that is closed, or opened anew, changes nothing."""
    forever = threading.Event()
    try:
        # Waiting without a limit could not be interrupted on every system.
        while not forever.wait(1.0):
            pass
    except KeyboardInterrupt:
        return


def page_html(server: viser.ViserServer, page: Page) -> str:
    """The scene as one HTML page that needs nothing else; with a time slider where there are several rows."""
    playing = page.playing
    if playing is None:
        return with_legend(server.scene.as_html(), page.title, page.entries, page.notes)
    # The page stands still on the row that a live one would show, until it is played.
    recording = server.get_scene_serializer()
    recording.insert_sleep(_STANDS_S)
    step_s, plot = playing.duration_s / len(playing.steps), page.plot
    said, marked = [playing.said()], [] if plot is None else [plot.index]
    for step in playing.steps:
        playing.show(step)
        recording.insert_sleep(step_s)
        said.append(playing.said())
        marked += [] if plot is None else [plot.index]
    html = recording.as_html()
    playing.show(playing.first)
    beside = static_player(said, _STANDS_S, step_s, plot, marked)
    notes = (*page.notes, _PLAY)
    return with_legend(html, page.title, page.entries, notes, bottom=ABOVE_THE_PLAYER, beside=beside)


def write_page(html: str, path: Path) -> None:
    """Write a page; InputError if it cannot be written."""
    try:
        write_text(html, path)
    except OSError as error:
        raise InputError(f"Input html {path} cannot be written ({error.strerror}).") from None


def write_picture(server: viser.ViserServer, path: Path) -> None:
    """Write the page as a headless Chromium shows it, a PNG file; InputError if it cannot be, BrowserError."""
    with opened_page(server, _PICTURE_PX) as browser:
        picture = browser.screenshot()
    try:
        with replaced(path) as written:
            written.write_bytes(picture)
    except OSError as error:
        raise InputError(f"Input png {path} cannot be written ({error.strerror}).") from None


@contextmanager
def opened_page(server: viser.ViserServer, size: tuple[int, int]) -> Iterator[Chromium]:
    """A headless Chromium with the page of a server, at rest, notices closed."""
    with Chromium(address(server) + SMOOTH, size) as browser:
        browser.wait_for("document.querySelector('canvas') !== null")
        # The scene is sent when the page has reported its camera; before that a blank page is at rest too.
        _wait_for_client(server)
        browser.settled_screenshot(before=_CLOSE_NOTICES)
        yield browser


def _wait_for_client(server: viser.ViserServer) -> None:
    deadline = time.monotonic() + _CONNECTION_S
    while not server.get_clients():
        if time.monotonic() > deadline:
            raise BrowserError(f"The page did not connect to the server within {_CONNECTION_S:g} s.")
        time.sleep(0.05)
