"""Chromium with a mouse, and a memory of what its page asked for and complained of."""

from __future__ import annotations

import time
from typing import Any

from magloc.viewer.chromium import Chromium, exception_text


class Browser(Chromium):
    """What a page does, watched.

    Attributes
    ----------
    requests : list of str
        Addresses that the page has asked for, in order; the page's own is the first. What the page itself carries
        (``data:``, ``blob:``) does not count.
    errors : list of str
        Uncaught exceptions of the page and what it wrote as errors.
    """

    def __init__(self, url: str, size: tuple[int, int] = (1280, 800)) -> None:
        self.requests: list[str] = []
        self.errors: list[str] = []
        super().__init__(url, size)

    def open(self, url: str) -> None:
        """Open another page. What the one before asked for and complained of is forgotten."""
        self.requests.clear()
        self.errors.clear()
        super().open(url)

    def note(self, event: dict[str, Any]) -> None:
        """Keep what the page asked for and complained of."""
        parameters = event.get("params", {})
        match event.get("method"):
            case "Network.requestWillBeSent":
                address = parameters["request"]["url"]
                if not address.startswith(("data:", "blob:")):
                    self.requests.append(address)
            case "Network.webSocketCreated":
                self.requests.append(parameters["url"])
            case "Runtime.exceptionThrown":
                self.errors.append(exception_text(parameters["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if parameters["type"] == "error":
                words = (str(argument.get("value", argument.get("description", ""))) for argument in parameters["args"])
                self.errors.append(" ".join(words))

    def click(self, x: float, y: float) -> None:
        """Press and release the left button at a place of the page [px]."""
        self._press(x, y)
        self._mouse("mouseReleased", x, y)

    def drag(self, begin: tuple[float, float], end: tuple[float, float], steps: int = 10) -> None:
        """Drag from one place to another [px] in a number of steps."""
        self._press(*begin)
        for i in range(1, steps + 1):
            x, y = (a + i / steps * (b - a) for a, b in zip(begin, end, strict=True))
            self._mouse("mouseMoved", x, y, button="left", buttons=1)
            time.sleep(0.02)
        self._mouse("mouseReleased", *end)

    def _press(self, x: float, y: float) -> None:
        self._mouse("mouseMoved", x, y, button="none")
        self._mouse("mousePressed", x, y, buttons=1)

    def _mouse(self, kind: str, x: float, y: float, button: str = "left", buttons: int = 0) -> None:
        clicks = 0 if kind == "mouseMoved" else 1
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, buttons=buttons, clickCount=clicks)
