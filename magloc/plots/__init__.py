"""Figures of results, in one house style (:mod:`magloc.plots.style`): units on every axis, fit for print."""

from magloc.plots.calibration import calibration_figure, turning_figure
from magloc.plots.fixes import fix_figure, residual_figure
from magloc.plots.maps import convergence, sources
from magloc.plots.style import save, write
from magloc.plots.tracks import consistency_figure, track_figure

__all__ = [
    "calibration_figure",
    "consistency_figure",
    "convergence",
    "fix_figure",
    "residual_figure",
    "save",
    "sources",
    "track_figure",
    "turning_figure",
    "write",
]
