"""View of the fixes of rows: all of them as points, and one with its uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

import numpy as np
import viser

from arrays.typing import FloatArray, IntArray
from magloc.localization.fit.results import Fix, Solution, Source
from magloc.viewer.pages import texts
from magloc.viewer.panels.coalesced import CoalescedCall
from magloc.viewer.panels.events import EventButtons, rows_of_change
from magloc.viewer.panels.inputs import set_value
from magloc.viewer.panels.time_player import time_strip
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    FIELD_LINE_COLOUR,
    FIT_COLOUR,
    OTHER_COLOUR,
    REGION_COLOUR,
    UNDETECTED_COLOUR,
    DipoleGlyph,
    SurfaceGlyph,
    add_label,
    add_points,
)
from magloc.viewer.scene.legend import Entry, Swatch
from magloc.viewer.scene.ruler import DropLines
from magloc.viewer.scene.shapes import NOTHING, Surface, join_surfaces, uncertainty

_MOST_OTHERS = 3
_FARTHEST_OF_RANGE = 2.5


class FixView:
    """All fixes in a scene, and the sources of one row with their regions.

    Parameters
    ----------
    server : viser.ViserServer
    times_s : ndarray, shape (n,)
    fixes : sequence of Fix
        Fixes of the n rows in the frame of the scene.
    centroids_m : ndarray, shape (n, 3)
        Centroids of the sensors [m].
    size_m, reach_m, dot_m : float
        Length of the arrows, reach of the field lines, and diameter of the points of all fixes [m].
    """

    def __init__(
        self,
        server: viser.ViserServer,
        times_s: FloatArray,
        fixes: Sequence[Fix],
        centroids_m: FloatArray,
        *,
        size_m: float,
        reach_m: float,
        dot_m: float,
    ) -> None:
        self._server, self._times, self._fixes, self._centroids = server, times_s, fixes, centroids_m
        scene = server.scene
        rows, positions = best_positions(fixes)
        self._detected = np.array([fix.detected and bool(fix.solutions) for fix in fixes])
        if len(positions) > 1:
            colours = np.where(self._detected[rows, None], FIT_COLOUR, UNDETECTED_COLOUR).astype(np.uint8)
            add_points(scene, "/fixes/all", positions, colours, dot_m)
        most = int(np.bincount(rows, minlength=1).max())  # sources of a row
        self.best = DipoleGlyph(scene, "/fixes/best", size_m, DIPOLE_COLOUR, reach_m)
        more = [DipoleGlyph(scene, f"/fixes/best-{i}", size_m, DIPOLE_COLOUR, reach_m) for i in range(2, most + 1)]
        self._best = [self.best, *more]
        n_others = _MOST_OTHERS * max(most, 1)
        self.others = [DipoleGlyph(scene, f"/fixes/other-{i}", 0.8 * size_m, OTHER_COLOUR) for i in range(n_others)]
        self.region = SurfaceGlyph(scene, "/fixes/region", REGION_COLOUR, 0.4)
        self.drop = DropLines(scene, "/fixes/drop", DIPOLE_COLOUR)
        self.time_label = add_label(scene, "/fixes/time", "", np.zeros(3), "center-left")
        self.row = _clearest_row(fixes, centroids_m)
        self.show_row(self.row)

    def show_row(self, row: int) -> None:
        """Show a row."""
        with self._server.atomic():
            self._show(row)

    def _show(self, row: int) -> None:
        self.row = row
        solutions = best_first(self._fixes[row])
        self.shown_sources = _sources_of(solutions[:1])
        best, others = self.shown_sources, _sources_of(solutions[1 : 1 + _MOST_OTHERS])
        for glyph in self._best:
            glyph.body.color = DIPOLE_COLOUR if self._detected[row] else UNDETECTED_COLOUR
        for glyphs, sources in ((self._best, best), (self.others, others)):
            for glyph in glyphs:
                glyph.visible = False
            for glyph, source in zip(glyphs, sources, strict=False):
                glyph.visible = True
                glyph.show(source.position_m, source.moment_Am2)
        self.time_label.text = f"   {self._times[row]:.6g} s"
        self.time_label.visible = bool(best) and len(self._fixes) > 1
        if best:
            self.time_label.position = best[0].position_m
        self.drop.show([source.position_m for source in best])
        regions = [self._region_of(source) for source in best]
        self.region.show(regions[0] if len(regions) == 1 else join_surfaces(regions))

    def show_field_lines(self, visible: bool) -> None:
        """Show or hide the field lines of the row's sources."""
        for glyph in self._best:
            if glyph.field_lines is not None:
                glyph.field_lines.visible = visible

    def _region_of(self, source: Source) -> Surface:
        """Return the 95 % region of a source, or nothing if its position was known beforehand."""
        if source.covariance is None or len(source.covariance) < 6:
            return NOTHING
        centroid = self._centroids[self.row]
        return uncertainty(
            source.position_m,
            source.covariance,
            centroid,
            range_observable=source.range_observable,
            range_interval_m=source.range_interval_m,
            farthest_m=_FARTHEST_OF_RANGE * float(np.linalg.norm(source.position_m - centroid)),
        )

    def add_controls(self, on_row: Sequence[Callable[[int], None]] = ()) -> None:
        """Add the slider of the row, which calls `on_row`, and the text of its fix to the panel."""
        gui = self._server.gui
        with gui.add_folder("Fix"):
            if len(self._fixes) > 1:
                self.slider = gui.add_slider("row", min=0, max=len(self._fixes) - 1, step=1, initial_value=self.row)
                states = [(bool(fix.solutions), *texts.warning_lines(fix)) for fix in self._fixes]
                is_good = np.array([state == (True,) for state in states])
                text = f"{int(is_good.sum())} of {len(is_good)} rows have a fix without warnings; grey: others"
                order = np.argsort(self._times, kind="stable")
                since = self._times[order] - self._times[order[0]]
                self.strip_panel = gui.add_html(texts.panel_html([time_strip(since, is_good[order], FIT_COLOUR), text]))
                self.events = EventButtons(
                    gui, rows_of_change(states), lambda: self.row, self.choose,
                    "Rows in which a source is detected or lost, or a warning begins or ends. Keys: E and Shift E.",
                )  # fmt: skip
            panel = gui.add_html(self.html())

        def follow() -> None:
            self.show_row(int(self.slider.value))
            panel.content = self.html()
            for call in on_row:
                call(self.row)

        if len(self._fixes) > 1:
            self.slider.on_update(CoalescedCall(follow))

    def choose(self, row: int) -> None:
        """Show a row that the user has selected, and move the slider there."""
        set_value(self.slider, row)

    def html(self) -> str:
        """Return the text of the row's fix as HTML."""
        fix = self._fixes[self.row]
        time = f"<b>time {self._times[self.row]:.6g} s</b>"
        if not fix.solutions:
            return texts.panel_html([time, f"<b>no fix</b>: {escape(fix.reason)}"], warning=True)
        best = fix.best
        places = []
        for source in best.sources:
            places.append(texts.position_text(source.position_m))
            places.append(f"moment {np.linalg.norm(source.moment_Am2):.3g} A·m²")
        lines = [
            *texts.warning_lines(fix),
            f"{time}, {places[0]}",
            *places[1:],
            f"χ² {best.chi2:.3g}, {best.dof} degrees of freedom",
            *(
                texts.range_text(interval, observable=source.range_observable)
                for source in best.sources
                for interval in source.range_interval_m
            ),
            *texts.ambiguity_lines(fix),
        ]
        return texts.panel_html(lines, warning=bool(texts.warning_lines(fix)))

    @property
    def dropped_sensors(self) -> tuple[str, ...]:
        """Sensors that the row's fix does not use."""
        return tuple(self._fixes[self.row].dropped_sensors)

    def entries(self) -> list[Entry]:
        """Return the entries of the legend."""
        if not any(fix.solutions for fix in self._fixes):
            return []
        lines: list[Entry] = [
            Swatch(DIPOLE_COLOUR, "source of the row: the arrow is its moment"),
            Swatch(FIELD_LINE_COLOUR, "field lines of the source"),
            Swatch(
                REGION_COLOUR,
                "95 % ellipsoid; where the range is not observable, its 95 % interval, with 95 % of the direction",
            ),
        ]
        solved = np.array([bool(fix.solutions) for fix in self._fixes])
        n, n_detected, n_noise = len(solved), int(self._detected.sum()), int((solved & ~self._detected).sum())
        if n > 1 and n_detected:
            lines.append(Swatch(FIT_COLOUR, f"fixes of {n_detected} of {n} rows, in which a source is detected"))
        if n_noise:
            where = "this row" if n == 1 else f"{n_noise} of {n} rows"
            lines.append(Swatch(UNDETECTED_COLOUR, f"nothing is detected in {where}: fits of noise, no sources"))
        if any(len(fix.solutions) > 1 for fix in self._fixes):
            lines.append(Swatch(OTHER_COLOUR, "other solutions that fit almost as well"))
        return lines


def _clearest_row(fixes: Sequence[Fix], centroids_m: FloatArray) -> int:
    """Return the row with the smallest uncertainty of a detected source relative to its range."""

    def relative_variance(row: int) -> float:
        if not fixes[row].solutions:
            return np.inf
        source = fixes[row].best.sources[0]
        if source.covariance is None:
            return np.inf
        variance = float(np.trace(source.covariance[:3, :3]) / np.sum((source.position_m - centroids_m[row]) ** 2))
        return variance if np.isfinite(variance) else np.inf

    return min(range(len(fixes)), key=lambda row: (not fixes[row].detected, relative_variance(row)))


def best_first(fix: Fix) -> list[Solution]:
    """Return the solutions of a fix: its best one, then the others in their order."""
    if not fix.solutions:
        return []
    best = fix.best
    return [best, *(solution for solution in fix.solutions if solution is not best)]


def _sources_of(solutions: Sequence[Solution]) -> list[Source]:
    return [source for solution in solutions for source in solution.sources]


def best_positions(fixes: Sequence[Fix]) -> tuple[IntArray, FloatArray]:
    """Return rows (k,) and positions (k, 3) of all sources of the best solutions [m]."""
    found = [(row, source) for row, fix in enumerate(fixes) if fix.solutions for source in fix.best.sources]
    positions = np.array([source.position_m for _, source in found]).reshape(-1, 3)
    return np.array([row for row, _ in found], dtype=np.intp), positions


def single_sources(fixes: Sequence[Fix]) -> tuple[FloatArray, FloatArray] | None:
    """Return position and moment of every row's source (n, 3), or None for several sources."""
    if any(fix.solutions and len(fix.best.sources) > 1 for fix in fixes):
        return None
    nowhere = np.full(3, np.nan)
    sources = [fix.best.sources[0] if fix.solutions else None for fix in fixes]
    positions = [nowhere if source is None else source.position_m for source in sources]
    return np.array(positions), np.array([nowhere if source is None else source.moment_Am2 for source in sources])
