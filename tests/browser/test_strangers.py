"""A page from elsewhere, in a real browser, cannot speak to a viewer, nor read, frame or mislead it."""

from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest
import viser
from websockets.sync.server import ServerConnection, serve

from arrays.geometries import tetrahedron
from magloc.viewer.pages.pages import array_page
from magloc.viewer.server import address, open_server
from tests.browser.screen import Screen

SOCKET = """new Promise(done => {
  const socket = new WebSocket('%s', ['viser-v%s']);
  socket.onmessage = () => done('answered');
  socket.onerror = () => done('refused');
})"""
READ = "fetch('%s').then(reply => reply.text()).then(text => 'read ' + text.length, () => 'refused')"
FRAME = """new Promise(done => {
  const frame = document.createElement('iframe');
  frame.src = '%s';
  frame.onload = () => done('loaded');
  document.body.append(frame);
})"""


class Elsewhere(BaseHTTPRequestHandler):
    """Another page of another server."""

    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title><body>")

    def log_message(self, *_: object) -> None: ...


@pytest.fixture(scope="module")
def elsewhere() -> Iterator[int]:
    """Its port."""
    with ThreadingHTTPServer(("127.0.0.1", 0), Elsewhere) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        yield other.server_port
        other.shutdown()


@pytest.fixture(scope="module")
def only_server(screen: Screen) -> Iterator[viser.ViserServer]:
    """Stopped once: it waits some seconds for what the browser has connected ahead and never used."""
    with open_server(0, "array") as server:
        page = array_page(server, tetrahedron(1.0), live=True)
        yield server
        page.close()


@pytest.fixture
def server(screen: Screen, only_server: viser.ViserServer) -> Iterator[viser.ViserServer]:
    """Without a page that speaks to it."""
    yield only_server
    screen.leave()
    screen.until(lambda: not only_server.get_clients(), "the page has left")


@contextmanager
def another_viewer() -> Iterator[tuple[str, list[str]]]:
    """Address of a websocket to which a page might be led, and who came."""
    came: list[str] = []

    def welcome(connection: ServerConnection) -> None:
        assert connection.request is not None
        came.append(connection.request.headers["Origin"])

    with serve(welcome, "127.0.0.1", 0, select_subprotocol=lambda _, offered: offered[0] if offered else None) as other:
        threading.Thread(target=other.serve_forever, daemon=True).start()
        yield f"ws://127.0.0.1:{other.socket.getsockname()[1]}", came
        other.shutdown()


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "evil.localhost"])
def test_a_page_from_elsewhere(screen: Screen, server: viser.ViserServer, elsewhere: int, name: str) -> None:
    screen.browser.open(f"http://{name}:{elsewhere}/")
    screen.browser.wait_for("document.title === 'elsewhere'")
    for host in ("127.0.0.1", "localhost", "evil.localhost"):
        here = f"//{host}:{server.get_port()}/"
        assert screen.evaluate(SOCKET % (f"ws:{here}", viser.__version__)) == "refused"
        assert screen.evaluate(READ % f"http:{here}") == "refused"
    assert not server.get_clients()


def test_a_name_that_was_made_to_point_here(screen: Screen, server: viser.ViserServer) -> None:
    """To the browser it is the page's own origin."""
    screen.browser.open(f"http://evil.localhost:{server.get_port()}/")
    screen.browser.wait_for("document.body.innerText.includes('own page')")
    own = f"ws://evil.localhost:{server.get_port()}/"
    assert screen.evaluate(SOCKET % (own, viser.__version__)) == "refused"
    assert not server.get_clients()


def test_its_own_page_is_answered(screen: Screen, server: viser.ViserServer) -> None:
    screen.open_server(server)
    assert screen.evaluate(SOCKET % (f"ws://127.0.0.1:{server.get_port()}/", viser.__version__)) == "answered"
    assert screen.browser.errors == []


def test_a_page_from_elsewhere_does_not_frame_it(screen: Screen, server: viser.ViserServer, elsewhere: int) -> None:
    for name, clients in (("evil.localhost", 0), ("localhost", 1)):
        screen.browser.open(f"http://{name}:{elsewhere}/")
        screen.browser.wait_for("document.title === 'elsewhere'")
        assert screen.evaluate(FRAME % address(server)) == "loaded"
        if clients:
            screen.until(lambda: bool(server.get_clients()), "the page in the frame speaks to its server")
        else:
            assert not server.get_clients()


@pytest.mark.slow
def test_no_address_leads_it_to_another_server(screen: Screen, server: viser.ViserServer) -> None:
    """That server could have its own scripts run in the page, and these could speak to this one."""
    with another_viewer() as (other, came), redirect_stdout(io.StringIO()):
        plain = viser.ViserServer("127.0.0.1", 0, verbose=False)
        try:
            screen.open(f"{address(plain)}/?websocket={other}")
            screen.until(lambda: bool(came), "without a guard, the page speaks to the other server")
            screen.leave()
        finally:
            plain.stop()
        came.clear()
        screen.open(f"{address(server)}/?websocket={other}")
        assert screen.evaluate(SOCKET % (other, viser.__version__)) == "refused"
        assert screen.evaluate("new Promise(done => setTimeout(() => done('waited'), 3000))") == "waited"
        assert came == []
