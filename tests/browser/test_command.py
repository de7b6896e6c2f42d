"""``magloc view`` as a process of its own: its server outlives the page, and ends at Ctrl-C."""

from __future__ import annotations

import signal
import socket
import subprocess
from pathlib import Path

import pytest

from arrays.array_file import write_array
from arrays.geometries import tetrahedron
from tests.browser.screen import Screen
from tests.command_line import viewer_started

ARRAY = tetrahedron(1.5)


@pytest.fixture
def array_file(tmp_path: Path) -> Path:
    write_array(tmp_path / "tetra.toml", ARRAY)
    return tmp_path / "tetra.toml"


def interrupted(process: subprocess.Popen[str]) -> str:
    """What it writes to stderr until it has ended after Ctrl-C."""
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120.0)
    assert process.returncode == 0
    assert out == ""
    assert "Traceback" not in err
    return err


class TestProcess:
    @pytest.mark.slow
    def test_a_closed_page_leaves_the_server_as_it_was(self, screen: Screen, array_file: Path) -> None:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            port = taken.getsockname()[1]
            with viewer_started(array_file, "--port", str(port)) as (process, address):
                screen.open(address)
                screen.until(lambda: "found at" in screen.text(), "the whole panel; no button moves any more")
                screen.browser.click(*screen.button("Another draw of the noise"))
                screen.until(lambda: screen.numbers("Seed of the noise") == [1.0], "another draw")
                screen.leave()
                assert process.poll() is None
                screen.open(address)
                screen.until(lambda: "found at" in screen.text(), "the panel")
                assert screen.numbers("Seed of the noise") == [1.0]
                # Nothing is fetched from anywhere else.
                asked = {url.replace("ws:", "http:").split("/?")[0].rstrip("/") for url in screen.browser.requests}
                assert asked == {address}
                screen.leave()
                err = interrupted(process)
        assert f"port {port} is in use" in err
