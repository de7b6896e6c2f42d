"""Headless Chromium, controlled by its DevTools protocol."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

from arrays.io.closing import Closing, delay_signals
from arrays.io.errors import InputError

BINARIES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
# On a machine without a graphics card the canvas stays blank unless both flags are set.
_SOFTWARE_WEBGL = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
# Ends the browser with its children and removes its folder when stdin is closed, also if this process is killed.
_GUARD = 'exec >/dev/null 2>&1; read pid; cat; [ -z "$pid" ] || kill -9 "-$pid"; until rm -rf "$0"; do sleep 0.1; done'
_POLL_S = 0.05
_REPLY_S = 60.0


class BrowserError(RuntimeError):
    """Error of a browser: it ended, did not answer in time, or its page raised an exception."""


def find_chromium() -> str:
    """Return the path of Chromium or Chrome; raise InputError if none is on the PATH."""
    for name in BINARIES:
        found = shutil.which(name)
        if found:
            return found
    raise InputError(f"found none of {', '.join(BINARIES)} on the PATH, expected one of them to draw a picture.")


class Chromium(Closing):
    """One page of a headless Chromium, as a context manager.

    Parameters
    ----------
    url : str
        Page to open: ``http://…`` or ``file://…``.
    size : tuple of 2 ints
        Width and height of the page [px].
    timeout_s : float
        Longest time that the browser may take to start.

    Raises
    ------
    InputError
        There is no Chromium.
    BrowserError
        The browser does not start, or cannot reach the page.
    """

    def __init__(self, url: str, size: tuple[int, int] = (1280, 800), timeout_s: float = 60.0) -> None:
        self._numbers = itertools.count(1)
        self._profile = ""
        self._socket: ClientConnection | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._guard: subprocess.Popen[bytes] | None = None
        try:
            with delay_signals():  # otherwise a folder or a process could be left over
                self._profile = tempfile.mkdtemp(prefix="magloc-chromium-")
                if os.name == "posix":
                    guard = ["sh", "-c", _GUARD, self._profile]
                    self._guard = subprocess.Popen(guard, bufsize=0, stdin=subprocess.PIPE, start_new_session=True)
                self._process = _start(find_chromium(), self._profile, size)
                if self._guard and self._guard.stdin:
                    self._guard.stdin.write(b"%d\n" % self._process.pid)
            self._socket = connect(self._page_address(timeout_s), max_size=None, proxy=None, ping_interval=None)
            for domain in ("Network", "Page", "Runtime"):
                self.call(f"{domain}.enable")
            # The size of the window includes its frame; these metrics are for the page alone.
            metrics = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
            self.call("Emulation.setDeviceMetricsOverride", **metrics)
            self.open(url)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the browser and remove its files."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            self._process.terminate()
            try:
                self._process.wait(10.0)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        if self._guard is None:
            if self._profile:
                shutil.rmtree(self._profile, ignore_errors=True)
            return
        # Children of the browser may outlive it and still write to its folder: the guard ends them first.
        with contextlib.suppress(subprocess.TimeoutExpired):  # the guard continues on its own
            self._guard.communicate(timeout=10.0)
        self._guard = None

    def open(self, url: str) -> None:
        """Open another page.

        Parameters
        ----------
        url : str

        Raises
        ------
        BrowserError
            The page cannot be reached.
        """
        fault = self.call("Page.navigate", url=url).get("errorText")
        if fault:
            raise BrowserError(f"Chromium cannot open {url}: {fault}.")

    def call(self, method: str, **parameters: object) -> dict[str, Any]:
        """Call a DevTools method, such as ``Page.reload``, and return its result.

        Parameters
        ----------
        method : str
        **parameters : object
            Parameters by their names in the protocol.

        Returns
        -------
        dict

        Raises
        ------
        BrowserError
            The method fails, or the browser has ended.
        """
        if self._socket is None:
            raise BrowserError("The browser is closed.")
        number = next(self._numbers)
        try:
            self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
            while True:
                message = json.loads(self._socket.recv(timeout=_REPLY_S))
                if message.get("id") == number:
                    break
                self.note(message)
        except (ConnectionClosed, TimeoutError) as error:
            raise BrowserError(f"Chromium did not answer {method} ({type(error).__name__}).") from None
        if "error" in message:
            raise BrowserError(f"{method}: {message['error'].get('message', message['error'])}")
        return message["result"]

    def evaluate(self, expression: str) -> Any:
        """Evaluate a JavaScript expression in the page, and await a promise.

        Parameters
        ----------
        expression : str

        Returns
        -------
        object
            Value of the expression, through JSON.

        Raises
        ------
        BrowserError
            The expression raises an exception.
        """
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise BrowserError(exception_text(answer["exceptionDetails"]))
        return answer["result"].get("value")

    def pdf(self) -> bytes:
        """Return the page as PDF, in the paper's size that its style states.

        Raises
        ------
        BrowserError
            The page cannot be printed.
        """
        self.wait_for("document.readyState === 'complete'")
        answer = self.call("Page.printToPDF", printBackground=True, preferCSSPageSize=True)
        return base64.b64decode(answer["data"])

    def wait_for(self, expression: str, timeout_s: float = 30.0) -> Any:
        """Wait until a JavaScript expression is true.

        Parameters
        ----------
        expression : str
        timeout_s : float

        Returns
        -------
        object
            Value of the expression.

        Raises
        ------
        BrowserError
            The expression does not become true in time.
        """
        deadline = time.monotonic() + timeout_s
        while not (value := self.evaluate(expression)):
            if time.monotonic() > deadline:
                raise BrowserError(f"The page was not ready within {timeout_s:g} s: {expression}")
            time.sleep(_POLL_S)
        return value

    def screenshot(self) -> bytes:
        """Return the present page as a PNG file."""
        return base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])

    def settled_screenshot(
        self, timeout_s: float = 60.0, interval_s: float = 0.3, same: int = 3, before: str = ""
    ) -> bytes:
        """Wait until the page no longer changes, and return it as a PNG file.

        Parameters
        ----------
        timeout_s : float
        interval_s : float
            Time between two screenshots.
        same : int
            Number of successive screenshots that have to be identical.
        before : str
            JavaScript that is evaluated before every screenshot.

        Returns
        -------
        bytes

        Raises
        ------
        BrowserError
            The page does not come to rest in time.
        """
        deadline = time.monotonic() + timeout_s
        last, n_same = b"", 0
        while n_same < same:
            if time.monotonic() > deadline:
                raise BrowserError(f"The page did not come to rest within {timeout_s:g} s.")
            if before:
                self.evaluate(before)
            shot = self.screenshot()
            n_same = n_same + 1 if shot == last else 1
            last = shot
            time.sleep(interval_s)
        return last

    def note(self, event: dict[str, Any]) -> None:
        """Receive an event of the page; this class ignores events."""

    def _page_address(self, timeout_s: float) -> str:
        """Wait for the browser's port, and return the address of the page's DevTools socket."""
        if self._process is None:
            raise BrowserError("The browser is closed.")
        port_file = Path(self._profile, "DevToolsActivePort")
        # A proxy from the environment could not reach this machine.
        direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            if self._process.poll() is not None:
                raise BrowserError(f"Chromium ended at once, with status {self._process.returncode}.")
            lines = port_file.read_text(encoding="utf-8").split() if port_file.exists() else []
            if len(lines) == 2:
                with direct.open(f"http://127.0.0.1:{lines[0]}/json/list", timeout=timeout_s) as reply:
                    for target in json.load(reply):
                        if target["type"] == "page":
                            return target["webSocketDebuggerUrl"]
            time.sleep(_POLL_S)
        raise BrowserError(f"Chromium did not start within {timeout_s:g} s.")


def _start(binary: str, profile: str, size: tuple[int, int]) -> subprocess.Popen[bytes]:
    flags = [
        "--headless=new",
        "--disable-dev-shm-usage",
        "--disable-background-networking",
        "--disable-features=BackForwardCache",  # otherwise a closed page keeps its socket
        "--no-first-run",
        "--no-proxy-server",
        "--hide-scrollbars",
        *_SOFTWARE_WEBGL,
        f"--window-size={size[0]},{size[1]}",
        "--remote-debugging-port=0",
        f"--user-data-dir={profile}",
    ]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        flags.append("--no-sandbox")  # Chromium has no sandbox for root
    return subprocess.Popen(
        [binary, *flags, "about:blank"],
        # The browser's socket, whose path must be short, is removed with the folder.
        env={**os.environ, "TMPDIR": profile} if len(profile) < 50 else None,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        process_group=0 if os.name == "posix" else None,
    )


def exception_text(details: dict[str, Any]) -> str:
    """Return the description of an exception in a page."""
    return str(details.get("exception", {}).get("description", details.get("text", "an exception")))
