"""Panel to review a survey: drop, split and add targets, exclude rows, fit again, save."""

from __future__ import annotations

from collections.abc import Callable
from html import escape
from threading import Lock

import numpy as np
import viser

from arrays.typing import FloatArray
from magloc.surveying.results import Survey
from magloc.surveying.review.decisions import Decision, entry_of
from magloc.surveying.review.review import Review
from magloc.viewer.pages import texts
from magloc.viewer.pages.survey import SurveyScene, above
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.scene.glyphs import add_lines, show_segments
from magloc.viewer.scene.shapes import line_segments

_NO_CLICK, _ADDS, _CORNER = "moves the view only", "sets the place to add", "sets a corner"
_COLOUR = (230, 60, 20)
_DIGITS = 2  # of a place that a hand points at [m]
_STEPS = 8  # to the place where a ray meets uneven ground


class ReviewPanel:
    """Panel with the decisions of a review. The user fits again when all are made.

    Parameters
    ----------
    server : viser.ViserServer
        The panels are added to the present container of its GUI.
    scene : SurveyScene
        Scene that shows the result of the last fit.
    save : callable, optional
        Function that saves a survey and returns a sentence for the page. Without it there is no button to save.

    Attributes
    ----------
    review : Review
    corners_m : list of tuple of 2 floats
        Corners of the polygon so far.
    """

    def __init__(self, server: viser.ViserServer, scene: SurveyScene, save: Callable[[Survey], str] | None) -> None:
        self._scene, self._save = scene, save
        self.review = Review(scene.found)
        self._before: list[Review] = []
        self.corners_m: list[tuple[float, float]] = []
        self._lock = Lock()
        gui = server.gui
        with scene.folder:
            self.drop_button = gui.add_button("Drop it")
            self.split_button = gui.add_button("Split it in two")
        with gui.add_folder("Add a target"):
            self.click_dropdown = gui.add_dropdown("A click", (_NO_CLICK, _ADDS, _CORNER), hint="on the ground")
            self.place_input = gui.add_vector2("Place x, y [m]", (0.0, 0.0), step=10.0**-_DIGITS)
            self.add_button = gui.add_button("Add it")
        with gui.add_folder("Exclude rows"):
            self.polygon_button = gui.add_button("Exclude the polygon")
            self.clear_button = gui.add_button("Clear its corners")
            self.line_dropdown = gui.add_dropdown("Line", ("",))
            self.stretch_slider = gui.add_multi_slider("Stretch [%]", 0, 100, 1, (0, 100))
            self.stretch_button = gui.add_button("Exclude the stretch")
        with gui.add_folder("Review"):
            self.refit_button = gui.add_button("Fit again")
            self.back_button = gui.add_button("Take back")
            self.save_button = gui.add_button("Save", visible=save is not None)
            self.panel = gui.add_html("")
        self._polygon = add_lines(server.scene, "/polygon", np.zeros((1, 2, 3)), _COLOUR, 3.0, visible=False)
        self._stretch = add_lines(server.scene, "/stretch", np.zeros((1, 2, 3)), _COLOUR, 4.0, visible=False)
        self.drop_button.on_click(lambda _: self._decide(lambda review: review.drop(scene.dropdown.value)))
        self.split_button.on_click(lambda _: self._decide(lambda review: review.split(scene.dropdown.value)))
        self.add_button.on_click(lambda _: self._decide(lambda review: review.add(self.place_input.value)))
        self.polygon_button.on_click(lambda _: self._exclude_polygon())
        self.clear_button.on_click(lambda _: self._clear())
        self.stretch_button.on_click(lambda _: self._exclude_stretch())
        self.line_dropdown.on_update(lambda _: self._show_stretch())
        self.stretch_slider.on_update(lambda _: self._show_stretch())
        self.refit_button.on_click(lambda _: self._refit())
        self.back_button.on_click(lambda _: self._take_back())
        self.save_button.on_click(lambda _: self._write())
        server.scene.on_click()(lambda event: self.click(np.array(event.ray_origin), np.array(event.ray_direction)))
        self._show()

    def click(self, origin_m: FloatArray, direction: FloatArray) -> None:
        """Use the place on the ground that a ray from the camera meets."""
        if direction[2] >= 0.0 or self.click_dropdown.value == _NO_CLICK:
            return
        place_m = origin_m
        for _ in range(_STEPS):
            height_m = above(self._scene.found.terrain, place_m)[2]
            place_m = origin_m + (height_m - origin_m[2]) / direction[2] * direction
        x, y = np.round(place_m[:2], _DIGITS).tolist()
        if self.click_dropdown.value == _ADDS:
            set_value(self.place_input, (x, y))
        else:
            self.corners_m.append((x, y))
            self._show_corners()

    def _decide(self, change: Callable[[Review], Review]) -> None:
        """Change the review, or say why that is not possible."""
        with self._lock:
            try:
                self.review = change(self.review)
            except ValueError as error:
                self._show(str(error).removeprefix("Input "))
            else:
                self._show()

    def _exclude_polygon(self) -> None:
        before = self.review
        self._decide(lambda review: review.exclude_polygon(self.corners_m))
        if self.review is not before:
            self._clear()

    def _clear(self) -> None:
        self.corners_m = []
        self._show_corners()

    def _exclude_stretch(self) -> None:
        rows = self._stretch_rows()
        if rows is not None:
            time_s = self.review.found.rows.time_s[rows]
            self._decide(lambda review: review.exclude_stretch(float(time_s[0]), float(time_s[-1])))

    def _stretch_rows(self) -> slice | None:
        """Return the rows of the chosen stretch of a line, None without a line."""
        lines = self.review.found.flight_lines
        line = next((line for line in lines if line.name == self.line_dropdown.value), None)
        if line is None:
            return None
        n = line.rows.stop - line.rows.start
        first, last = (int(0.01 * share * (n - 1)) for share in self.stretch_slider.value)
        return slice(line.rows.start + first, line.rows.start + last + 1)

    def _refit(self) -> None:
        with self._lock:
            self._show("fitting …", warning=False)
            self.refit_button.disabled = True
            try:
                before, self.review = self.review, self.review.refit()
                self._before.append(before)
                self._scene.show(self.review.found)
                self._show()
            except ValueError as error:
                self._show(str(error).removeprefix("Input "))
            finally:
                self.refit_button.disabled = False

    def _take_back(self) -> None:
        """Take back the last decision, or the last fit."""
        with self._lock:
            if self.review.pending:
                self.review = self.review.undo()
            elif self._before:
                self.review = self._before.pop()
                self._scene.show(self.review.found)
            self._show()

    def _write(self) -> None:
        if self.review.pending:
            self._refit()
        with self._lock:
            if self._save is None or self.review.pending:
                return
            try:
                self._show(self._save(self.review.found), warning=False)
            except (OSError, ValueError) as error:
                self._show(str(error))

    def _show(self, message: str = "", *, warning: bool = True) -> None:
        """Show the decisions since the last fit, what the last fit found, and a message."""
        found = self.review.found
        lines = [f"{len(found)} targets, {len(found.rows.time_s)} rows, χ² {found.chi2_per_dof:.2f} per reading"]
        lines += [f"{number}. {escape(decision_words(one))}" for number, one in enumerate(self.review.pending, 1)]
        if self.review.pending:
            lines.append("<b>Fit again</b> applies them.")
        blocks = texts.panel_html(lines)
        self.panel.content = blocks + (texts.panel_html([escape(message)], warning=warning) if message else "")
        names = tuple(line.name for line in found.flight_lines) or ("",)
        if names != tuple(self.line_dropdown.options):
            self.line_dropdown.options = names
        self._show_stretch()
        self._show_corners()

    def _show_stretch(self) -> None:
        rows = self._stretch_rows()
        whole = self.stretch_slider.value == (0, 100)
        self._stretch.visible = rows is not None and not whole
        if rows is not None and not whole:
            show_segments(self._stretch, line_segments(self.review.found.rows.place_m[rows]))

    def _show_corners(self) -> None:
        self.polygon_button.disabled = len(self.corners_m) < 3
        closed = above(self._scene.found.terrain, np.array([*self.corners_m, *self.corners_m[:1]]).reshape(-1, 2))
        show_segments(self._polygon, line_segments(closed) if len(closed) > 2 else np.zeros((0, 2, 3)))


def decision_words(decision: Decision) -> str:
    """Return a decision in words."""
    entry = entry_of(decision)
    action = str(entry["action"])
    if "target" in entry:
        return f"{action} {entry['target']}"
    if action == "add":
        return f"add a target at {', '.join(f'{value:g}' for value in entry['place_m'])} m"
    return f"exclude {entry['numbers']['rows']} rows" if action == "exclude" else action
