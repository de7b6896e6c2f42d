"""Dial of the present error: position of the estimate relative to the truth, with its 3σ ellipse."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from adcs.mockup.navigation.fixes import FixOutcome
from adcs.mockup.navigation.strapdown import wrapped
from adcs.viewer.drive import SETTLING_S, Drive
from arrays.typing import FloatArray
from magloc.viewer.scene.glyphs import length_text, round_length

TRAIL_S = 5.0
_HALF = 100.0
_ROOM = 1.3
_POINTS = 60


class ErrorDial:
    """Dial of the error of a drive's estimate at one time.

    Parameters
    ----------
    drive : Drive

    Attributes
    ----------
    reach_m : float
        Radius of the outer circle: 5 mm, 10 mm, 20 mm, … [m].
    """

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        late = drive.truth.time_s >= min(SETTLING_S, 0.5 * drive.duration_s)
        least_m = _ROOM * drive.usual_error_m
        if drive.sigma_m is not None:
            least_m = max(least_m, 3.0 * float(np.median(drive.sigma_m[late])) + drive.usual_error_m)
        lengths = (round_length(factor * least_m) for factor in (1.0, 2.0, 2.5, 5.0))
        self.reach_m = next(length for length in lengths if length >= least_m)

    def svg(self, row: int) -> str:
        """Return the dial for a row of the drive.

        Parameters
        ----------
        row : int

        Returns
        -------
        str
        """
        drive, scale = self._drive, _HALF / self.reach_m
        times = drive.truth.time_s
        first = int(np.searchsorted(times, times[row] - TRAIL_S))
        trail = drive.errors_m[first : row + 1 : max(1, (row - first) // _POINTS)] * scale
        x, y = (drive.errors_m[row] * scale).tolist()
        outside = float(np.hypot(x, y)) > _HALF
        if outside:
            x, y = (np.array([x, y]) * (_HALF / np.hypot(x, y))).tolist()
        parts = [
            *(f'<circle r="{r}" fill="none" stroke="#c4cad0"/>' for r in (0.5 * _HALF, _HALF)),
            f'<path d="M {-_HALF} 0 H {_HALF} M 0 {-_HALF} V {_HALF}" stroke="#c4cad0"/>',
            f'<polyline points="{_svg_points(trail)}" fill="none" stroke="#56b4e9" stroke-width="2"/>',
        ]
        if drive.sigma_m is not None:
            a, b = (3.0 * drive.sigma_m[row] * scale).tolist()
            parts.append(
                f'<ellipse cx="{x:.1f}" cy="{-y:.1f}" rx="{a:.1f}" ry="{b:.1f}" fill="#0072b2" fill-opacity=".18" '
                'stroke="#0072b2"/>'
            )
        parts += [
            '<path d="M -6 0 H 6 M 0 -6 V 6" stroke="currentColor" stroke-width="2"/>',
            f'<circle cx="{x:.1f}" cy="{-y:.1f}" r="5" fill="{"#d55e00" if outside else "#0072b2"}"/>',
            _text(_HALF - 2, 12, f"{length_text(self.reach_m)} X", "end"),
            _text(5, -_HALF + 11, "Y", "start"),
            _text(-_HALF, -_HALF + 9, length_text(float(np.hypot(*drive.errors_m[row]))), "start"),
        ]
        return (
            '<div style="padding:.3em .9em"><svg viewBox="-104 -104 208 208" style="width:100%;display:block" '
            f'clip-path="inset(0)">{"".join(parts)}</svg></div>'
        )


def _svg_points(values: FloatArray) -> str:
    return " ".join(f"{x:.1f},{-y:.1f}" for x, y in values.tolist())


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x}" y="{y}" font-size="10" fill="currentColor" text-anchor="{anchor}">{text}</text>'


def estimate_lines(drive: Drive, row: int) -> Sequence[str]:
    """Return the estimate and its error in a row as lines of HTML."""
    track, now = drive.track, float(drive.truth.time_s[row])
    error_mm = 1e3 * float(np.hypot(*drive.errors_m[row]))
    turn = float(np.degrees(wrapped(track.heading_rad[row] - drive.truth.heading_rad[row])))
    x, y = track.position_m[row]
    lines = [
        f"estimate ({x:.4f}, {y:.4f}) m, {np.degrees(wrapped(track.heading_rad[row])):.2f}°",
        f"error <b>{error_mm:.1f} mm</b>, {turn:.3f}°",
    ]
    fix = drive.last_fix(row)
    if fix is None:
        return [*lines, "no fix has arrived"]
    outcome = drive.outcomes[fix]
    text = outcome.value if outcome is not FixOutcome.REJECTED else "<b>rejected</b>"
    return [*lines, f"last fix: taken {now - drive.fixes.time_s[fix]:.2f} s ago, {text}"]
