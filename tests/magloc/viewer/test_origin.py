"""Strangers on the network: what another page, another name or another file may do with a viewer, by a real client."""

from __future__ import annotations

import ast
import gzip
import http.client
import socket
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import msgspec
import pytest
import viser
import websockets.asyncio.server
from viser._messages import GuiUpdateMessage, Message, ViewerCameraMessage
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from arrays.array_file import read_array, write_array
from arrays.geometries import cube, tetrahedron
from magloc.viewer.origin import MOST_BYTES, start_guarded_server
from magloc.viewer.pages.array_editor import ArrayEditor
from tests.conftest import REPOSITORY
from tests.waiting import WAIT_S, wait_for

SMALL, LARGE = tetrahedron(0.03), cube(30.0)
EVIL = "http://evil.example"
CAMERA = ViewerCameraMessage(
    (1.0, 0.0, 0.0, 0.0), (3.0, 3.0, 3.0), 1.0, 0.1, 9.0, 6, 8, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, beside which other files stand."""
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    return tmp_path / "work"


@contextmanager
def client(server: viser.ViserServer, host: str | None = None, origin: str | None = None) -> Iterator[ClientConnection]:
    """A websocket from wherever it says; by default from the viewer's own page."""
    here = f"127.0.0.1:{server.get_port()}"
    with (
        socket.create_connection(("127.0.0.1", server.get_port())) as plain,
        connect(
            f"ws://{host or here}/",
            sock=plain,
            origin=f"http://{host or here}" if origin is None else origin or None,  # type: ignore[arg-type]
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            open_timeout=WAIT_S,
        ) as websocket,
    ):
        yield websocket


def status_of(server: viser.ViserServer, **headers: str) -> tuple[int, dict[str, str]]:
    connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=WAIT_S)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    reply = connection.getresponse()
    connection.close()
    return reply.status, dict(reply.getheaders())


class TestWhoIsAnswered:
    @pytest.mark.parametrize("name", ["127.0.0.1", "localhost"])
    @pytest.mark.parametrize("tunnel", [False, True])
    def test_its_own_page(self, server: viser.ViserServer, name: str, tunnel: bool) -> None:
        """By whatever port of this machine leads to it."""
        host = f"{name}:{9 if tunnel else server.get_port()}"
        with client(server, host) as websocket:
            assert websocket.recv(timeout=WAIT_S)
        assert status_of(server, Host=host)[0] == 200
        assert status_of(server, Host=host, Origin=f"http://{host}")[0] == 200

    @pytest.mark.parametrize("origin", [EVIL, "null", "http://127.0.0.1:9", "https://127.0.0.1:{}", ""])
    def test_no_other_origin_and_none_that_is_not_named(self, server: viser.ViserServer, origin: str) -> None:
        with (
            pytest.raises(InvalidStatus, match="403"),
            client(server, origin=origin.format(server.get_port())),
        ):
            pass
        assert not server.get_clients()

    @pytest.mark.parametrize("host", ["evil.example:{}", "127.0.0.1.evil.example:{}", "evil.localhost:{}", "10.0.0.1"])
    def test_no_other_name_of_this_machine(self, server: viser.ViserServer, host: str) -> None:
        """As a page has it whose name was made to point here, so that its origin is the same."""
        named = host.format(server.get_port())
        with pytest.raises(InvalidStatus, match="403"), client(server, named):
            pass
        assert status_of(server, Host=named)[0] == 403

    def test_headers_of_http(self, server: viser.ViserServer) -> None:
        here = f"127.0.0.1:{server.get_port()}"
        assert status_of(server)[0] == 403
        assert status_of(server, Host=here, Origin=EVIL)[0] == 403
        status, headers = status_of(server, Host=here)
        assert status == 200
        assert f"connect-src 'self' ws://{here} data: blob:;" in headers["Content-Security-Policy"]
        assert "frame-ancestors 'self'" in headers["Content-Security-Policy"]
        assert "Access-Control-Allow-Origin" not in headers

    @pytest.mark.parametrize("compressed", [False, True])
    def test_page_says_that_it_connects(self, server: viser.ViserServer, compressed: bool) -> None:
        """What is served is viser's page and ours after it, as long as it says, however it is packed."""
        connection = http.client.HTTPConnection("127.0.0.1", server.get_port(), timeout=WAIT_S)
        connection.request("GET", "/", headers={"Accept-Encoding": "gzip" if compressed else "identity"})
        reply = connection.getresponse()
        body = reply.read()
        connection.close()
        assert int(reply.headers["Content-Length"]) == len(body)
        page = (gzip.decompress(body) if compressed else body).decode()
        assert page.startswith("<!doctype html>")
        assert page.count("Connecting…") == 1

    def test_no_endless_message(self, server: viser.ViserServer) -> None:
        with client(server) as websocket:
            websocket.send(bytes(MOST_BYTES + 1))
            with pytest.raises(ConnectionClosed, match="1009"):
                deque(iter(partial(websocket.recv, WAIT_S), None))

    def test_others_servers_are_left_alone(self, server: viser.ViserServer) -> None:
        plain = websockets.asyncio.server.serve
        other = viser.ViserServer("127.0.0.1", 0, verbose=False)
        try:
            assert websockets.asyncio.server.serve is plain
            assert plain.__module__ == "websockets.asyncio.server"
            assert status_of(other, Host="evil.example")[0] == 200
        finally:
            other.stop()

    def test_a_viser_that_starts_otherwise_is_not_used(self, monkeypatch: pytest.MonkeyPatch) -> None:
        class Other:
            stopped = False

            def __init__(self, **_: object) -> None: ...

            def stop(self) -> None:
                Other.stopped = True

        monkeypatch.setattr(viser, "ViserServer", Other)
        with pytest.raises(RuntimeError, match="in an unknown way"):
            start_guarded_server()
        assert Other.stopped

    def test_every_page_has_such_a_server(self) -> None:
        made = [
            str(path.relative_to(REPOSITORY))
            for package in ("arrays", "magloc", "adcs", "sims")
            for path in sorted((REPOSITORY / package).rglob("*.py"))
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("ViserServer", "WebsockServer"))
        ]
        assert made == ["magloc/viewer/origin.py"]


class Hand:
    """What a page sends when somebody types a path and clicks."""

    def __init__(self, server: viser.ViserServer, editor: ArrayEditor) -> None:
        self.server, self.editor = server, editor

    def save(self, path: str, *, overwrite: bool = False) -> str:
        editor, button = self.editor, self.editor.overwrite_button if overwrite else self.editor.save_button
        with client(self.server) as websocket:
            self._send(websocket, CAMERA)  # before it, a page counts as not yet there
            wait_for(lambda: bool(self.server.get_clients()))
            if editor.path_input.value != path:
                editor.save_panel.content = "before"
                self._send(websocket, GuiUpdateMessage(editor.path_input._impl.uuid, {"value": path}))
                wait_for(lambda: editor.save_panel.content == "")
            editor.save_panel.content = ""
            self._send(websocket, GuiUpdateMessage(button._impl.uuid, {"value": True}))
            wait_for(lambda: editor.save_panel.content != "")
        return editor.save_panel.content

    @staticmethod
    def _send(websocket: ClientConnection, message: Message) -> None:
        websocket.send(msgspec.msgpack.encode(message.as_serializable_dict()))


class TestWhatIsWritten:
    """By whoever drives the page: new files below the working directory, and what this run opened."""

    @pytest.fixture
    def opened_file(self, tmp_path: Path) -> Path:
        write_array(tmp_path / "opened.toml", LARGE)
        return tmp_path / "opened.toml"

    @pytest.fixture
    def hand(self, server: viser.ViserServer, folder: Path, opened_file: Path) -> Hand:
        return Hand(server, ArrayEditor(server, SMALL, file=opened_file))

    def test_a_new_file(self, hand: Hand, folder: Path) -> None:
        (folder / "sub").mkdir()
        for path in ("a.toml", "sub/b.toml", f"{folder}/c.toml"):
            assert f"saved as {path}" in hand.save(path)
            assert read_array(folder / path) == SMALL

    def test_the_opened_file_and_what_was_written_here_when_asked_to(
        self, hand: Hand, opened_file: Path, folder: Path
    ) -> None:
        hand.save("a.toml")
        write_array(folder / "a.toml", LARGE)
        for path in (str(opened_file), "../opened.toml", "a.toml"):
            write_array(folder / path, LARGE)
            assert "nothing was written yet" in hand.save(path)
            assert read_array(folder / path) == LARGE
            assert "saved as" in hand.save(path, overwrite=True)
            assert read_array(folder / path) == SMALL

    def test_nothing_else(self, hand: Hand, tmp_path: Path, folder: Path) -> None:
        foreign, near = tmp_path / "foreign.toml", folder / "near.toml"
        for path in (foreign, near):
            write_array(path, LARGE)
        (folder / "link.toml").symlink_to(foreign)
        (folder / "out").symlink_to(tmp_path)
        for path, words in {
            str(foreign): "below the folder",
            "../foreign.toml": "below the folder",
            "../new.toml": "below the folder",
            "../none/new.toml": "below the folder",
            "link.toml": "below the folder",
            "out/new.toml": "below the folder",
            "near.toml": "was not opened here",
            "a\0b.toml": "null",
            "a" * 300 + ".toml": "too long",
        }.items():
            for overwrite in (False, True):
                said = hand.save(path, overwrite=overwrite)
                assert words in said
                assert str(tmp_path) not in said.replace(path, "")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["foreign.toml", "opened.toml", "work"]
        assert sorted(path.name for path in folder.iterdir()) == ["link.toml", "near.toml", "out"]
        assert read_array(foreign) == read_array(near) == LARGE
