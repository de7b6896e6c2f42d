"""Live page of an inertial unit: its attitude, σ and disturbance, while rows arrive."""

from __future__ import annotations

import math
import webbrowser
from collections import deque
from collections.abc import Sequence
from threading import Lock

import numpy as np
import viser

from adcs import quaternion
from adcs.complementary.attitude_filter import AttitudeEstimate
from adcs.viewer.attitude_replay import AttitudeReplay
from adcs.viewer.attitude_scene import AttitudeScene, attitude_entries, attitude_extent
from arrays.typing import FloatArray
from magloc.live.tally import Tally
from magloc.viewer.pages import texts
from magloc.viewer.pages.pages import Page
from magloc.viewer.panels.drawing_thread import DrawingThread
from magloc.viewer.scene.framing import set_up_scene
from magloc.viewer.scene.legend import legend_html
from magloc.viewer.server import FIRST_PORT
from magloc.viewer.view import View

_TRAIL_S, _MOST_ROWS = 10.0, 300
_FRAMES_PER_SECOND = 15.0


class LiveAttitudeView(View):
    """Page of an attitude, drawn by a separate thread, so that no row waits for the page.

    Parameters
    ----------
    port : int
        Port of the server; if it is in use, the next free one is used.
    open : bool
        Open the browser.
    """

    def __init__(self, *, port: int = FIRST_PORT, open: bool = True) -> None:
        def fill(server: viser.ViserServer) -> Page:
            self._live = LiveAttitudePage(server)
            return self._live.page()

        super().__init__("attitude · live", fill, port)
        if open:
            webbrowser.open(self.address)

    def update(self, estimate: AttitudeEstimate, tally: Tally | None = None) -> None:
        """Show a new estimate, unless a newer one comes before it is drawn."""
        self._live.update(estimate, tally)


class LiveAttitudePage:
    """Scene and panels of the newest estimate."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server, self._lock = server, Lock()
        self._window: deque[AttitudeEstimate] = deque(maxlen=_MOST_ROWS)
        self._newest: tuple[AttitudeEstimate, Tally | None] | None = None
        set_up_scene(server, attitude_extent())
        server.scene.remove_by_name("/floor")
        self._scene = AttitudeScene(server.scene, replay_of_estimates([level_estimate(math.nan)]))
        self._panels = {}
        for name in ("Attitude", "Disturbance", "Stream"):
            with server.gui.add_folder(name):
                self._panels[name] = server.gui.add_html(texts.panel_html(["no row yet"]))
        self._thread = DrawingThread(self._draw, _FRAMES_PER_SECOND)

    def page(self) -> Page:
        """Return the page with its legend."""
        entries = attitude_entries(replay_of_estimates([level_estimate(0.0)]))
        with self._server.gui.add_folder("Legend", expand_by_default=False):
            self._server.gui.add_html(legend_html(entries, ()))
        return Page("attitude", entries, (), close=self._thread.close)

    def update(self, estimate: AttitudeEstimate, tally: Tally | None) -> None:
        """Set the newest estimate; those that have not been drawn yet are skipped."""
        with self._lock:
            window = self._window
            if window and estimate.time_s < window[-1].time_s:  # the clock was set back
                window.clear()
            if not window or estimate.time_s - window[-1].time_s >= _TRAIL_S / _MOST_ROWS:
                window.append(estimate)
            self._newest = estimate, tally
        self._thread.wake()

    def _draw(self, is_new: bool) -> None:
        with self._lock:
            newest, window = self._newest, list(self._window)
        if newest is None or not is_new:
            return
        estimate, tally = newest
        recent = [one for one in window if estimate.time_s - _TRAIL_S <= one.time_s < estimate.time_s]
        with self._server.atomic():
            self._scene.replace(replay_of_estimates([*recent, estimate]))
            self._panels["Attitude"].content = texts.panel_html(attitude_lines(estimate))
            self._panels["Disturbance"].content = texts.panel_html(
                disturbance_lines(estimate), warning=estimate.disturbed
            )
            if tally is not None:
                self._panels["Stream"].content = texts.panel_html(
                    [f"{tally.rows} rows", f"{tally.late} late, {tally.doubled} doubled, {tally.garbled} garbled"]
                )


def level_estimate(sigma_rad: float) -> AttitudeEstimate:
    """Return the estimate of a unit that is level and points east, for a page without a row."""
    unknown = np.full(3, np.nan)
    return AttitudeEstimate(0.0, quaternion.IDENTITY, sigma_rad, sigma_rad, unknown, unknown, unknown, 0)


def replay_of_estimates(estimates: Sequence[AttitudeEstimate]) -> AttitudeReplay:
    """Return the replay of some estimates, without readings."""
    q, sigma = np.stack([one.q for one in estimates]), np.stack([body_sigma_rad(one) for one in estimates])
    time_s, unknown = np.array([one.time_s for one in estimates]), np.full(q.shape, np.nan)
    return AttitudeReplay("live", ("east", "north", "up"), time_s, q, sigma, unknown, (), {}, {})


def body_sigma_rad(estimate: AttitudeEstimate) -> FloatArray:
    """Return σ about each body axis (3,): a turn about it is a tilt, a turn of the heading, or both."""
    up = quaternion.rotate_back(estimate.q, np.array([0.0, 0.0, 1.0]))
    variance = up**2 * estimate.sigma_heading_rad**2 + (1.0 - up**2) * estimate.sigma_tilt_rad**2
    return np.asarray(np.sqrt(variance))


def attitude_lines(estimate: AttitudeEstimate) -> list[str]:
    """Return time, direction of the body axis x, and σ as lines of HTML."""
    x = quaternion.rotate(estimate.q, np.array([1.0, 0.0, 0.0]))
    bearing = math.degrees(math.atan2(x[0], x[1])) % 360.0
    elevation = math.degrees(math.asin(min(1.0, max(-1.0, float(x[2])))))
    tilt, heading = np.degrees([estimate.sigma_tilt_rad, estimate.sigma_heading_rad]).tolist()
    return [
        f"time {estimate.time_s:.3f} s",
        f"axis x: <b>{bearing:.1f}°</b> from north, {elevation:.1f}° up",
        f"σ heading {heading:.2g}°, tilt {tilt:.2g}°",
    ]


def disturbance_lines(estimate: AttitudeEstimate) -> list[str]:
    """Return the use of the magnetometer and all flags as lines of HTML."""
    lines = []
    if "field-left-out" in estimate.flags:
        lines.append("the field is ignored")
    if "magnet-subtracted" in estimate.flags:
        lines.append(f"a magnet of {1e6 * float(np.linalg.norm(estimate.offset_T)):.3g} µT is subtracted")
    others = [flag for flag in estimate.flags if flag not in ("field-left-out", "magnet-subtracted")]
    return [*(lines or ["none"]), *others]
