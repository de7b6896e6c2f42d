"""What a browser shows of a scene: pixels at the places of points, and the inputs of the panel."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import viser
from matplotlib.colors import rgb_to_hsv
from matplotlib.image import imread
from numpy.typing import ArrayLike, NDArray

from tests.browser.browser import Browser

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]
Look = Callable[[FloatArray], BoolArray]
PATIENCE_S = 300.0
_REPEATED_AFTER_S = 30.0
_REOPENED_AFTER_S = 20.0
# viser's page sends at most one change of an input in this time; of several, to whatever inputs, only the last.
_BETWEEN_CHANGES_S = 0.06
_TOLD_S = 5.0
_CLOSE_NOTICES = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(button => button.click())"


@dataclass(frozen=True)
class Camera:
    """A camera whose place is known, and the picture it fills [px]."""

    position_m: FloatArray
    look_at_m: FloatArray
    field_of_view_rad: float
    size: tuple[float, float]

    @property
    def axes(self) -> FloatArray:
        """Right, up and forward."""
        forward = self.look_at_m - self.position_m
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        return np.stack([right, np.cross(right, forward), forward])

    def pixels(self, points_m: ArrayLike) -> FloatArray:
        """Columns and rows at which points are seen (..., 2)."""
        across, up, ahead = np.moveaxis((np.asarray(points_m) - self.position_m) @ self.axes.T, -1, 0)
        width, height = self.size
        scale = 0.5 * height / np.tan(0.5 * self.field_of_view_rad) / ahead
        return np.stack([0.5 * width + scale * across, 0.5 * height - scale * up], axis=-1)


class Screen:
    """The page of a browser, looked at and worked with the mouse."""

    def __init__(self, browser: Browser, folder: Path) -> None:
        self.browser, self._folder = browser, folder
        self._server: viser.ViserServer | None = None

    def open(self, url: str) -> None:
        self._server = None
        self.browser.open(url)
        self.browser.wait_for("document.querySelector('canvas') !== null")

    def open_server(self, server: viser.ViserServer, query: str = "") -> None:
        """Open the live page, and wait until it stands at the first camera, beside the panel."""
        before = set(server.get_clients())
        self.open(f"http://127.0.0.1:{server.get_port()}/{query}")
        first = np.asarray(server.initial_camera.position)

        def arrived() -> bool:
            new = set(server.get_clients()) - before
            if not new or "Legend" not in self.text():
                return False
            camera = server.get_clients()[max(new)].camera
            return bool(np.allclose(camera.position, first, rtol=1e-3) and camera.image_width == self.camera_width())

        self.until(arrived, "the page stands at the first camera")
        self._server = server

    def leave(self) -> None:
        """Close the page, so that its server can end at once."""
        self._server = None
        self.browser.open("about:blank")

    def camera(self, camera: viser.CameraHandle | viser.InitialCameraConfig) -> Camera:
        """A camera of the server, with the size that its picture has in the page."""
        box = self.evaluate("document.querySelector('canvas').getBoundingClientRect().toJSON()")
        assert (box["x"], box["y"]) == (0.0, 0.0)
        size = (box["width"], box["height"])
        return Camera(np.array(camera.position), np.array(camera.look_at), float(camera.fov), size)

    def camera_width(self) -> float:
        return float(self.evaluate("document.querySelector('canvas').getBoundingClientRect().width"))

    def live_camera(self, server: viser.ViserServer) -> Camera:
        """The camera that the newest page has told the server."""
        clients = server.get_clients()
        return self.camera(clients[max(clients)].camera)

    def evaluate(self, expression: str) -> Any:
        return self.browser.evaluate(expression)

    def picture(self) -> FloatArray:
        """Colours as they are now, shape (rows, columns, 3), from 0 to 1."""
        self.evaluate(_CLOSE_NOTICES)
        return np.asarray(imread(io.BytesIO(self.browser.screenshot()))[..., :3], dtype=np.float64)

    def keep(self, name: str) -> None:
        """Keep what is seen as an artefact for whoever wants to look at it."""
        self._folder.mkdir(parents=True, exist_ok=True)
        picture = self.browser.settled_screenshot(interval_s=0.1, same=2, before=_CLOSE_NOTICES)
        (self._folder / f"{name}.png").write_bytes(picture)

    def until(
        self,
        condition: Callable[[], bool],
        what: str,
        patience_s: float = PATIENCE_S,
        again: Callable[[], None] | None = None,
    ) -> None:
        """Wait for a condition; the test fails if it does not come true.

        `again` does what leads to it once more, as a person would whose click is lost: on a busy machine some are.
        """
        begin = repeated = time.monotonic()
        while not condition():
            now = time.monotonic()
            assert now - begin < patience_s, f"not within {patience_s:g} s: {what}"
            if again is not None and now - repeated > _REPEATED_AFTER_S:
                repeated = now
                again()
            time.sleep(0.1)

    def until_seen(self, *sights: Sight) -> None:
        """Wait until every sight is as it should be, all in the same picture.

        A live page that does not show it in time is opened once more: on a busy machine viser's page has been seen to
        drop a message. What the server holds is then sent anew, so that a fault of ours is still a fault.
        """
        missed: list[Sight] = []

        def seen() -> bool:
            picture = self.picture()
            missed[:] = [sight for sight in sights if not sight.holds(picture)]
            return not missed

        def fault(error: AssertionError) -> str:
            self._folder.mkdir(parents=True, exist_ok=True)
            (self._folder / "failed.png").write_bytes(self.browser.screenshot())
            return "; ".join([str(error), *(str(sight) for sight in missed), *self.browser.errors])

        try:
            self.until(seen, "the scene shows", _REOPENED_AFTER_S if self._server else PATIENCE_S)
            return
        except AssertionError as error:
            first = fault(error)
            if self._server is None or self.browser.errors:
                raise AssertionError(first) from None
        print(f"opened anew: {first}")
        self.open_server(self._server)
        try:
            self.until(seen, "the scene shows")
        except AssertionError as error:
            raise AssertionError(fault(error)) from None

    def text(self) -> str:
        """All words of the page, without line ends."""
        return " ".join(self.evaluate("document.body.innerText").split())

    def button(self, text: str) -> tuple[float, float]:
        """Middle of a button, or of a tab, with a text [px]."""
        quoted = json.dumps(text)
        box = self.browser.wait_for(
            "(() => { const found = [...document.querySelectorAll('button, [role=tab]')]"
            f".find(b => b.innerText.trim() === {quoted}); if (!found) return null;"
            " found.scrollIntoView({block: 'nearest'}); return found.getBoundingClientRect().toJSON() })()"
        )
        return box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"]

    def input(self, label: str, part: str) -> dict[str, float]:
        """Rectangle of a part of the panel's line with a label [px], scrolled into view."""
        box = self.browser.wait_for(
            f"(() => {{ const line = ({_FIND_LINE})({json.dumps(label)}); if (!line) return null;"
            f" const part = line.querySelector({json.dumps(part)}); part.scrollIntoView({{block: 'nearest'}});"
            " return part.getBoundingClientRect().toJSON() })()"
        )
        return dict(box)

    def numbers(self, label: str) -> list[float]:
        """What the number inputs of the panel's line with a label say."""
        values = self.browser.wait_for(
            f"(() => {{ const line = ({_FIND_LINE})({json.dumps(label)}); if (!line) return null;"
            " return [...line.querySelectorAll('input[inputmode=decimal]')].map(i => i.value) })()"
        )
        return [float(value) for value in values]

    def switch(self, label: str, on: bool) -> None:
        """Click on a checkbox unless it is as wanted, until the server knows."""
        checked = f"({_FIND_LINE})({json.dumps(label)}).querySelector('input[type=checkbox]').checked"

        def click() -> None:
            box = self.input(label, ".mantine-Checkbox-inner")
            was = self.evaluate(checked)
            self.browser.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
            self.browser.wait_for(f"{checked} === {json.dumps(not was)}")

        if self.evaluate(checked) != on:
            click()
        if not self._told(label, checked):
            # Off and on again, as a user would.
            click()
            time.sleep(_BETWEEN_CHANGES_S)
            click()
            assert self._told(label, checked), f"the server does not know that {label!r} is {'on' if on else 'off'}"

    def slide(self, label: str, share: float) -> None:
        """Drag a slider with the mouse to a share of its length, until the server knows."""
        value = f"Number(({_FIND_LINE})({json.dumps(label)}).querySelector('[role=slider]').ariaValueNow)"
        for where in (share, 0.9 * share + 0.05, share):
            self._drag_slider(label, where)
            if self._told(label, value):
                return
        raise AssertionError(f"the server does not know where the slider {label!r} is")

    def _drag_slider(self, label: str, share: float) -> None:
        track, thumb = self.input(label, ".mantine-Slider-track"), self.input(label, ".mantine-Slider-thumb")
        y = thumb["y"] + 0.5 * thumb["height"]
        begin = thumb["x"] + 0.5 * thumb["width"]
        # A little beyond the end, to reach it.
        beyond = 4.0 if share == 1.0 else 0.0
        self.browser.drag((begin, y), (track["x"] + share * track["width"] + beyond, y), steps=4)

    def _told(self, label: str, value: str) -> bool:
        """Whether page and server come to agree on an input, whose value in the page is a JavaScript expression.

        Always true of a page without a server.
        """
        if self._server is None:
            return True
        identity = self.evaluate(f"({_FIND_LINE})({json.dumps(label)}).querySelector('label[for]').htmlFor")
        handle = self._server.gui._gui_input_handle_from_uuid[identity]
        try:
            self.until(lambda: abs(handle.value - self.evaluate(value)) < 1e-6, f"{label} is told", _TOLD_S)
        except AssertionError:
            return False
        time.sleep(_BETWEEN_CHANGES_S)
        return True


@dataclass(frozen=True)
class Sight:
    """Something of a colour that should be seen at pixels, or that should not.

    ``share`` of the pixels (n, 2) must have a pixel of the colour within ``radius``; where ``absent``, none may.
    """

    what: str
    pixels: FloatArray
    look: Look
    radius: int = 3
    share: float = 1.0
    absent: bool = False

    def holds(self, picture: FloatArray) -> bool:
        hits = np.array([self._hit(picture, x, y) for x, y in np.rint(self.pixels).astype(int)])
        return not hits.any() if self.absent else bool(hits.mean() >= self.share)

    def _hit(self, picture: FloatArray, x: int, y: int) -> bool:
        r = self.radius
        assert r <= x < picture.shape[1] - r, f"{self.what}: column {x} is out of the picture"
        assert r <= y < picture.shape[0] - r, f"{self.what}: row {y} is out of the picture"
        return bool(self.look(picture[y - r : y + r + 1, x - r : x + r + 1]).any())

    def __str__(self) -> str:
        return f"{'no ' if self.absent else ''}{self.what} at {np.rint(self.pixels).astype(int).tolist()}"


def hue_of(colour: ArrayLike, within_deg: float = 14.0, least_saturation: float = 0.4) -> Look:
    """Pixels of the hue of a colour (0 to 255), whatever light falls on it."""
    wanted = rgb_to_hsv(np.asarray(colour) / 255.0)[0]

    def look(picture: FloatArray) -> BoolArray:
        hue, saturation, value = np.moveaxis(rgb_to_hsv(picture), -1, 0)
        apart = np.abs((hue - wanted + 0.5) % 1.0 - 0.5)
        return (apart * 360.0 < within_deg) & (saturation > least_saturation) & (value > 0.25)

    return look


def close_to(colour: ArrayLike, within: float = 36.0) -> Look:
    """Pixels whose colour differs no more than that in any channel (0 to 255)."""
    wanted = np.asarray(colour)[:3] / 255.0
    return lambda picture: np.abs(picture - wanted).max(axis=-1) < within / 255.0


def dark_grey(picture: FloatArray) -> BoolArray:
    """Pixels of a sensor's body, which is darker than bars and floor."""
    return (np.ptp(picture, axis=-1) < 0.16) & (picture.max(axis=-1) < 0.72) & (picture.min(axis=-1) > 0.12)


# A line of the panel holds one label, and the inputs that belong to it.
_FIND_LINE = """(label) => {
  const shown = [...document.querySelectorAll('label[for]')].filter(found => found.offsetParent !== null);
  const found = shown.find(found => found.innerText.trim() === label);
  return found ? found.closest('.mantine-Flex-root') : null;
}"""
