"""Live page of a calibration by turning: the sphere of directions, and what turn is missing."""

from __future__ import annotations

import webbrowser
from html import escape
from threading import Lock

import numpy as np
import viser

from magloc.live.turning import SPREAD, TurningCalibrator, TurningProgress, covered_directions
from magloc.readings import Readings
from magloc.viewer.pages import texts
from magloc.viewer.pages.pages import Page
from magloc.viewer.panels.drawing_thread import DrawingThread
from magloc.viewer.scene.framing import aim_camera, corners_of, extent_of, set_up_scene
from magloc.viewer.scene.glyphs import add_label, add_lines, add_points, show_segments
from magloc.viewer.scene.legend import Swatch, legend_html
from magloc.viewer.server import FIRST_PORT
from magloc.viewer.view import View

_COVERED, _MISSING, _NOW, _NEXT = (0, 158, 115), (190, 190, 190), (0, 114, 178), (213, 94, 0)
_FRAMES_PER_SECOND = 20.0


class TurningView(View):
    """Page of a calibration by turning; a separate thread draws the newest row.

    Parameters
    ----------
    calibrator : TurningCalibrator
    port : int
        Port of the server; if it is in use, the next free one is used.
    open : bool
        Open the browser.
    """

    def __init__(self, calibrator: TurningCalibrator, *, port: int = FIRST_PORT, open: bool = True) -> None:
        def fill(server: viser.ViserServer) -> Page:
            self._sphere = _Sphere(server, calibrator)
            return self._sphere.page

        super().__init__("calibrate", fill, port)
        if open:
            webbrowser.open(self.address)

    def update(self, rows: Readings) -> None:
        """Show the newest row and the progress, unless newer rows come before they are drawn."""
        self._sphere.update(rows)


class _Sphere:
    """Directions of the field in the sensor's axes: covered, missing, now and next."""

    def __init__(self, server: viser.ViserServer, calibrator: TurningCalibrator) -> None:
        self._server, self._calibrator = server, calibrator
        self._lock = Lock()
        self._newest: tuple[Readings, TurningProgress | None] | None = None
        self._drawn: TurningProgress | None = None
        scene = server.scene
        self._directions = add_points(scene, "/directions", SPREAD, _MISSING, 0.05)
        self._now = add_lines(scene, "/now", np.zeros((1, 2, 3)), _NOW, 5.0, visible=False)
        self._next = add_lines(scene, "/next", np.zeros((1, 2, 3)), _NEXT, 5.0, visible=False)
        for axis, place in zip("xyz", 1.25 * np.eye(3), strict=True):
            add_label(scene, f"/label-{axis}", f"+{axis}", place)
        gui = server.gui
        self._panel = gui.add_html(texts.panel_html(["turn the sensors slowly in all directions"]))
        extent = extent_of(corners_of(np.zeros(3), 1.3))
        set_up_scene(server, extent)
        aim_camera(server, extent)
        entries = (
            Swatch(_COVERED, "directions of the field in the sensor's axes that are covered"),
            Swatch(_MISSING, "those that are missing"),
            Swatch(_NOW, "the field now"),
            Swatch(_NEXT, "turn until the field points there"),
        )
        with gui.add_folder("Legend"):
            gui.add_html(legend_html(entries, ()))
        self._thread = DrawingThread(self._draw, _FRAMES_PER_SECOND)
        self.page = Page("calibrate", entries, (), self._thread.close)

    def update(self, rows: Readings) -> None:
        with self._lock:
            self._newest = rows, self._calibrator.progress
        self._thread.wake()

    def _draw(self, is_new: bool) -> None:
        with self._lock:
            newest = self._newest
        if newest is not None:
            with self._server.atomic():
                self._show(*newest)

    def _show(self, rows: Readings, progress: TurningProgress | None) -> None:
        directions = self._calibrator.newest_directions(rows.values_T[-1])
        shown = next(iter(directions)) if progress is None else progress.least_covered.id
        show_segments(self._now, np.stack([np.zeros(3), directions[shown]])[None])
        if progress is None or progress is self._drawn:
            return
        self._drawn, sensor = progress, progress.least_covered
        is_covered = covered_directions(sensor.directions)[:, None]
        self._directions.colors = np.where(is_covered, _COVERED, _MISSING).astype(np.uint8)
        segments = np.zeros((0, 2, 3)) if progress.enough else np.stack([np.zeros(3), sensor.missing])[None]
        show_segments(self._next, segments)
        self._panel.content = texts.panel_html(_lines(progress), warning=bool(progress.flags))


def _lines(progress: TurningProgress) -> list[str]:
    lines = [f"<b>{escape(progress.advice)}</b>"]
    for sensor in progress.sensors:
        sigma = f"offsets ± {1e9 * sensor.offset_sigma_T:.3g} nT, gains ± {100.0 * sensor.gain_sigma:.2g} %"
        state = sigma if sensor.fit.converged else escape(sensor.fit.reason)
        lines.append(f"{escape(sensor.id)}: {100.0 * sensor.coverage:.0f} % covered; {state}")
    lines.append(f"goal: ± {1e9 * progress.goal_T:.3g} nT; {progress.rows} rows in use")
    return lines + [escape(flag) for flag in progress.flags]
