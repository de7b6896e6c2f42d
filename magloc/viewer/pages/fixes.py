"""Fixes of the rows of a readings file in a scene: all of them as points, and one with its uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape

import numpy as np
import viser

from arrays.typing import FloatArray
from magloc.localization.fit.results import Fix
from magloc.viewer.pages import words
from magloc.viewer.panels.latest import Latest
from magloc.viewer.scene.glyphs import (
    DIPOLE_COLOUR,
    FIELD_LINE_COLOUR,
    FIT_COLOUR,
    OTHER_COLOUR,
    REGION_COLOUR,
    DipoleGlyph,
    SurfaceGlyph,
)
from magloc.viewer.scene.legend import Entry, Swatch
from magloc.viewer.scene.shapes import NOTHING, uncertainty

_MOST_OTHERS = 3
_FARTHEST_OF_RANGE = 2.5


class FixView:
    """Fixes in a scene.

    Parameters
    ----------
    server : viser.ViserServer
    times_s : ndarray, shape (n,)
        Of the rows [s].
    fixes : sequence of Fix
        Of the rows, in the frame of the scene.
    centroids_m : ndarray, shape (n, 3)
        Of the sensors at every row, in the frame of the scene [m].
    size_m : float
        Length of the arrows.
    reach_m : float
        Of the field lines.
    dot_m : float
        Diameter of the dots that stand for all fixes.

    Attributes
    ----------
    best : DipoleGlyph
        Of the row that is shown.
    region : SurfaceGlyph
        Where its source may be.
    row : int
        Row that is shown.
    slider : viser.GuiSliderHandle
        Of the row, after :meth:`add_controls`, where there are several.
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
        self.positions_m = best_positions(fixes)
        scene = server.scene
        known = self.positions_m[np.isfinite(self.positions_m).all(axis=1)]
        if len(known) > 1:
            scene.add_point_cloud(
                "/fixes/all",
                known.astype(np.float32),
                FIT_COLOUR,
                point_size=dot_m,
                point_shape="circle",
                precision="float32",
            )
        self.best = DipoleGlyph(scene, "/fixes/best", size_m, DIPOLE_COLOUR, reach_m)
        self.others = [DipoleGlyph(scene, f"/fixes/other-{i}", 0.8 * size_m, OTHER_COLOUR) for i in range(_MOST_OTHERS)]
        self.region = SurfaceGlyph(scene, "/fixes/region", REGION_COLOUR, 0.4)
        self.row = _clearest(fixes, centroids_m)
        self.show_row(self.row)

    def show_row(self, row: int) -> None:
        """Show another row.

        Parameters
        ----------
        row : int
        """
        self.row = row
        solutions = self._fixes[row].solutions
        for glyph in (self.best, *self.others):
            glyph.visible = False
        for glyph, solution in zip((self.best, *self.others), solutions, strict=False):
            glyph.visible = True
            glyph.show(solution.position_m, solution.moment_Am2)
        surface = NOTHING
        if solutions:
            best = solutions[0]
            surface = uncertainty(
                best.position_m,
                best.covariance,
                self._centroids[row],
                range_observable=best.range_observable,
                range_interval95_m=best.range_interval_m,
                farthest_m=_FARTHEST_OF_RANGE * float(np.linalg.norm(best.position_m - self._centroids[row])),
            )
        self.region.show(surface)

    def add_controls(self, on_row: Sequence[Callable[[int], None]] = ()) -> None:
        """Put the choice of the row, and what is known of its fix, into the panel.

        Parameters
        ----------
        on_row : sequence of callable
            Called with every row that is chosen.
        """
        gui = self._server.gui
        with gui.add_folder("Fix"):
            if len(self._fixes) > 1:
                self.slider = gui.add_slider("row", min=0, max=len(self._fixes) - 1, step=1, initial_value=self.row)
            panel = gui.add_html(self.words())

        def follow() -> None:
            self.show_row(int(self.slider.value))
            panel.content = self.words()
            for call in on_row:
                call(self.row)

        if len(self._fixes) > 1:
            self.slider.on_update(Latest(follow))

    def words(self) -> str:
        """What is known of the row's fix, as HTML."""
        fix = self._fixes[self.row]
        time = f"<b>time {self._times[self.row]:.6g} s</b>"
        if not fix.solutions:
            return words.panel([time, f"<b>no fix</b>: {escape(fix.reason)}"], warning=True)
        best = fix.solutions[0]
        lines = [
            f"{time}, {words.place(best.position_m)}",
            f"moment {np.linalg.norm(best.moment_Am2):.3g} A·m²",
            f"χ² {best.chi2:.3g}, {best.dof} degrees of freedom",
            *(words.range_words(ends, observable=best.range_observable) for ends in best.range_interval_m),
        ]
        others = len(fix.solutions) - 1
        if others:
            lines.append(f"<b>{others} other solution{'s fit' if others > 1 else ' fits'}</b> almost as well")
        return words.panel(lines)

    def entries(self) -> list[Entry]:
        """Lines of the legend."""
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
        if len(self._fixes) > 1:
            lines.append(Swatch(FIT_COLOUR, "fixes of all rows"))
        if any(len(fix.solutions) > 1 for fix in self._fixes):
            lines.append(Swatch(OTHER_COLOUR, "other solutions that fit almost as well"))
        return lines


def _clearest(fixes: Sequence[Fix], centroids_m: FloatArray) -> int:
    """The row that is shown first: where the position is best known, relative to its range."""

    def relative_variance(row: int) -> float:
        if not fixes[row].solutions:
            return np.inf
        best = fixes[row].solutions[0]
        variance = float(np.trace(best.covariance[:3, :3]) / np.sum((best.position_m - centroids_m[row]) ** 2))
        return variance if np.isfinite(variance) else np.inf

    return min(range(len(fixes)), key=relative_variance)


def best_positions(fixes: Sequence[Fix]) -> FloatArray:
    """Positions of the best solutions, shape (n, 3), NaN where there is none [m]."""
    nowhere = np.full(3, np.nan)
    return np.array([fix.solutions[0].position_m if fix.solutions else nowhere for fix in fixes]).reshape(-1, 3)
