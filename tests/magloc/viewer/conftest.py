"""A server whose scene tests read without a browser."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest
import viser

from magloc.viewer.server import free_port, open_server
from tests.waiting import wait_for


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    """Open a server, and see that none of its threads outlives it."""
    before = set(threading.enumerate())
    with open_server(free_port(0), "test") as server:
        yield server
    wait_for(lambda: set(threading.enumerate()) <= before)


def node(server: viser.ViserServer, name: str) -> viser.SceneNodeHandle:
    """Return a node of the scene, which must be there."""
    handle = server.scene.get_handle_by_name(name)
    assert handle is not None
    return handle
