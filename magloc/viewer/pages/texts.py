"""Texts of the viewer's panels: forecasts, fixes and readings as short HTML with units."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from arrays.array import SensorArray
from magloc.viewer.scene.glyphs import length_text

if TYPE_CHECKING:
    from magloc.localization.fit.results import Fix, Solution
    from magloc.viewer.pages.live_fit import Forecast
from arrays.typing import FloatArray

_FIELD_UNITS = (("mT", 1e-3), ("µT", 1e-6), ("nT", 1e-9), ("pT", 1e-12))
_POSITIVE, _NEGATIVE = "0,114,178", "213,94,0"


def position_text(position_m: FloatArray) -> str:
    """Return a position in metres, to four digits of its largest coordinate."""
    largest = float(np.abs(position_m).max())
    decimals = 3 if largest == 0.0 else max(0, 3 - int(np.floor(np.log10(largest))))
    return f"({', '.join(f'{x:.{decimals}f}' for x in position_m)}) m"


def field_text(field_T: float) -> str:
    """Return a field with a suitable unit, such as ``15 µT`` or ``0.2 nT``."""
    for unit, tesla in _FIELD_UNITS:
        if field_T >= tesla or (unit == "nT" and field_T >= 0.1 * tesla):
            return f"{field_T / tesla:.3g} {unit}"
    return f"{field_T * 1e12:.3g} pT"


def range_text(interval_m: tuple[float, float | None], *, observable: bool) -> str:
    """Return the text of an interval of the distance from the array's centre."""
    low, high = interval_m
    if observable and high is not None:
        return f"range observable: {length_text(low)} to {length_text(high)} from the array's centre (95 %)"
    until = "any distance" if high is None else length_text(high)
    return f"range <b>not observable</b>: anything from {length_text(low)} to {until} (95 %)"


def bound_lines(forecast: Forecast) -> list[str]:
    """Return lines on the detectability and the Cramér-Rao bound of a dipole."""
    lines = []
    if not forecast.detectable:
        lines.append("<b>too weak to be detected</b>: the signal is below the noise")
    if np.isfinite(forecast.signal_to_noise):
        lines.append(f"signal {number_text(forecast.signal_to_noise, 3)} σ of the sensors' differences")
    if forecast.covariance is None:
        return [*lines, f"no bound: {escape(forecast.reason)}"]
    sigma = np.sqrt(np.diagonal(forecast.covariance))
    x, y, z = (length_text(value) for value in sigma[:3])
    return [
        *lines,
        f"σ x {x}, y {y}, z {z}",
        f"σ of the moment {number_text(float(np.linalg.norm(sigma[3:])), 3)} A·m²",
        range_text(forecast.range_interval_m, observable=forecast.range_observable),
    ]


def fix_lines(fix: Fix, forecast: Forecast, position_m: FloatArray, moment_Am2: FloatArray) -> list[str]:
    """Return lines on a fix of simulated readings and its errors."""
    if not fix.solutions:
        return [f"<b>no solution</b>: {escape(fix.reason)}"]
    best = fix.best
    lines = []
    if not forecast.detectable:
        lines.append("<b>this is a fit of noise</b>: the signal is too weak to be detected")
    lines.append(f"found at {position_text(best.position_m)}")
    distance = float(np.linalg.norm(best.position_m - position_m))
    error = f"error {length_text(distance)}"
    if forecast.covariance is not None:
        least = float(np.sqrt(np.trace(forecast.covariance[:3, :3])))
        error += f", {number_text(distance / least, 2)} × the least rms error that is possible"
    moment = float(np.linalg.norm(best.moment_Am2 - moment_Am2) / np.linalg.norm(moment_Am2))
    lines += [error, f"error of the moment {number_text(100.0 * moment, 2)} %", _chi2_text(best)]
    lines += [range_text(interval, observable=best.range_observable) for interval in best.range_interval_m]
    return lines + ambiguity_lines(fix)


def ambiguity_lines(fix: Fix) -> list[str]:
    """Return a line on the number of other solutions, if there are any."""
    others = len(fix.solutions) - 1
    return [f"<b>{others} other solution{'s fit' if others > 1 else ' fits'}</b> almost as well"] if others > 0 else []


def warning_lines(fix: Fix) -> list[str]:
    """Return the reasons not to trust a fix: the flags of the command's table as lines."""
    lines = []
    if not fix.detected:
        lines.append("<b>nothing is detected</b> in this row: a fit of noise")
    if fix.misfit:
        lines.append("<b>misfit</b>: χ² is far beyond noise, neither position_text nor σ is to be trusted")
    if fix.too_near:
        lines.append("<b>near</b>: the source is too near, or too large, for a dipole")
    if fix.solutions and any(source.merged for source in fix.best.sources):
        lines.append("<b>merged</b>: two sources that the array cannot separate")
    lines += [f"sensor <b>{escape(name)}</b> contradicts all others and is not used" for name in fix.dropped_sensors]
    if fix.saturated_channels:
        lines.append(f"saturated, not used: {escape(', '.join(fix.saturated_channels))}")
    return lines


def panel_html(lines: Iterable[str], *, warning: bool = False) -> str:
    """Return lines of HTML as a block of a GUI panel."""
    colour = "color:#d55e00;" if warning else ""
    return f'<div style="font-size:0.8em;line-height:1.5;padding:0 0.9em;{colour}">{"<br>".join(lines)}</div>'


def readings_table(array: SensorArray, readings_T: FloatArray, signal_T: FloatArray) -> str:
    """Return an HTML table of a dipole's signal at every sensor, and of the noise, in nT.

    ``readings_T`` (C,): complete readings, which the page shows on hovering [T]. ``signal_T`` (C,): their part due to
    the dipole [T].
    """
    largest = float(np.nanmax(np.abs(signal_T), initial=0.0))
    kinds = {sensor.kind for sensor in array.sensors}
    columns = [*("xyz" if "vector" in kinds else ""), *(["|B|"] if "scalar" in kinds else [])]
    empty = '<td style="text-align:right">·</td>'
    rows = []
    for sensor, channels in zip(array.sensors, array.sensor_channels, strict=True):
        cells = [_signal_cell(1e9 * signal_T[c], 1e9 * readings_T[c], 1e9 * largest) for c in channels if c >= 0]
        others = [empty] * (len(columns) - len(cells))
        values = cells + others if sensor.kind == "vector" else others + cells
        noise = f'<td style="text-align:right">{number_text(1e9 * sensor.noise_T, 2)}</td>'
        rows.append(f"<tr><td>{escape(sensor.id)}</td>{''.join(values)}{noise}</tr>")
    header = _header_html(["sensor", *columns, "noise"])
    return (
        '<div style="font-size:0.75em;padding:0 0.9em;max-height:22em;overflow-y:auto">what the dipole adds [nT]'
        f'<table style="width:100%;border-collapse:collapse">{header}{"".join(rows)}'
        "</table></div>"
    )


def _signal_cell(signal_nT: float, reading_nT: float, largest_nT: float) -> str:
    if not np.isfinite(signal_nT):
        return '<td style="text-align:right">not finite</td>'
    share = 0.0 if largest_nT == 0.0 else abs(signal_nT) / largest_nT
    tint = f"rgba({_POSITIVE if signal_nT > 0.0 else _NEGATIVE},{0.6 * share:.2f})"
    style, title = f"text-align:right;background:{tint}", f"reading {reading_nT:.6g} nT"
    return f'<td style="{style}" title="{title}">{number_text(signal_nT, 3)}</td>'


def _header_html(texts: Sequence[str]) -> str:
    cells = (f'<th style="text-align:{"right" if i else "left"}">{text}</th>' for i, text in enumerate(texts))
    return f"<tr>{''.join(cells)}</tr>"


def _chi2_text(solution: Solution) -> str:
    if not solution.dof:
        return "χ² cannot judge the fit: as many unknowns as differences"
    return f"χ²/dof {solution.chi2:.3g}/{solution.dof} = {solution.chi2 / solution.dof:.2g}"


def number_text(value: float, digits: int) -> str:
    """Return a number, without an exponent as long as it is legible."""
    if value == 0.0 or 1e-3 <= abs(value) < 1e5:
        return f"{float(f'{value:.{digits}g}'):.10g}".replace("-", "\N{MINUS SIGN}")
    return f"{value:.{digits - 1}e}".replace("-", "\N{MINUS SIGN}")
