"""Report of a survey: an HTML page that prints on two to six sheets."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from arrays.io.outputs import installed_version
from arrays.io.world_maps import place_in_words
from magloc.deliverables.map_frame import MapFrame
from magloc.navigation.flight_lines import line_spacing
from magloc.surveying.results import IRON_Am2_PER_KG, SIZE_CLASSES_Am2, Survey
from magloc.surveying.review.decisions import entry_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_DPI = 170
_REACH_Am2 = (0.1, 0.3, 1.0, 3.0, 10.0)
_STYLE = """
@page { size: A4; margin: 16mm } body { font: 10.5pt/1.45 sans-serif; max-width: 178mm; margin: auto; color: #111 }
h1 { font-size: 19pt; margin: 0 0 2mm } h2 { font-size: 13pt; margin: 7mm 0 2mm; break-after: avoid }
table { border-collapse: collapse; width: 100%; font-size: 9pt } th { text-align: left; border-bottom: 1px solid #111 }
td, th { padding: 0.8mm 1.5mm; vertical-align: top } tr { break-inside: avoid } td.n, th.n { text-align: right }
tr:nth-child(even) td { background: #f3f3f3 } figure { margin: 2mm 0; break-inside: avoid } img { width: 100% }
td:first-child { white-space: nowrap }
figcaption, small { color: #444; font-size: 9pt }
"""
_MAPS = (
    "Anomaly along the ambient field, the remainder without the targets, and the least moment that is found with 95 %"
    " at the shallowest and at the deepest level. White: no target is found there, however strong."
)
_PROFILES = (
    "Readings along the line nearest to each target, and the fields of the targets. Slow differences are the field of"
    " the ground."
)
_FLAGS = {
    "weak": "trust the depth interval, not the ellipse",
    "near": "another target is so near that one of the two may be spurious",
    "merged": "more than one source, too near to each other to be separated",
    "edge": "at the edge of the volume that was searched",
    "misfit": "the readings do not fit a dipole; errors are larger than stated",
}


def report_html(
    found: Survey, frame: MapFrame, title: str, assumptions: Mapping[str, str], figures: tuple[Figure, Figure]
) -> str:
    """Return the report of a survey as one HTML page without links to other files.

    Parameters
    ----------
    found : Survey
    frame : MapFrame
        Coordinate system of the list of targets, and the origin of the survey's world frame.
    title : str
    assumptions : mapping of str
        Assumptions by name, such as the height of the ground.
    figures : tuple of 2 matplotlib.figure.Figure
        Maps and profiles of the survey.
    """
    maps, profiles = figures
    body = [
        f"<h1>Survey of {escape(title)}</h1>",
        f"<small>magloc {installed_version()}; coordinates: {escape(f'{frame.label} ({frame.system.name})')}</small>",
        "<h2>Survey</h2>",
        _table(("", ""), _survey_rows(found)),
        f"<h2>Targets ({len(found)})</h2>",
        _table(_target_header(frame), _target_rows(found, frame), numbers=range(1, 8)),
        _flag_words(found),
        "<h2>Maps</h2>",
        _picture(maps, _MAPS),
        "<h2>Profiles</h2>",
        _picture(profiles, _PROFILES),
        "<h2>Detectable moments</h2>",
        _table(("depth", *(f"{moment:g} A·m²" for moment in _REACH_Am2)), _reach_rows(found), numbers=range(1, 6)),
        "<small>Share of the area in which a target of that moment is found with 95 %, whatever its direction.</small>",
        "<h2>Assumptions</h2>",
        _table(("", ""), [*_ground_rows(found, frame), *assumptions.items(), *_assumption_rows(found)]),
    ]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>" + "\n".join(body) + "</body></html>\n"
    )


def _survey_rows(found: Survey) -> Iterator[tuple[str, str]]:
    rows = found.rows
    lines = found.flight_lines
    step_m = np.linalg.norm(np.diff(rows.place_m[:, :2], axis=0), axis=1)
    height = -found.terrain.depth_of(rows.place_m)
    speeds = [line.speed_m_s for line in lines] or [0.0]
    rate_Hz = 1.0 / float(np.median(np.diff(rows.time_s)))
    yield "array", ", ".join(filter(None, (found.array.name, _count(found.array.n_sensors, "sensor"))))
    yield "rows", f"{len(rows.time_s)} at {rate_Hz:.3g} Hz, {(rows.time_s[-1] - rows.time_s[0]) / 60.0:.1f} min"
    apart = f", about {line_spacing(rows.place_m[:, :2]):.2g} m apart" if len(lines) > 1 else ""
    yield "lines", f"{len(lines)}, {step_m.sum():.0f} m in total{apart}"
    yield "speed", f"{np.mean(speeds):.2g} m/s ({min(speeds):.2g} to {max(speeds):.2g})"
    yield "height of the sensors above ground", f"{height.mean():.2f} m ({height.min():.2f} to {height.max():.2f})"
    rms_nT = 1e9 * float(rows.residual_T.std())
    yield "remainder", f"{rms_nT:.2g} nT rms without the targets, χ² {found.chi2_per_dof:.2f} per reading"
    if found.decisions:
        yield "review", _review_words(found)
    yield "lag", f"{1e3 * found.lag_s:.0f} ms of the readings, corrected" if found.lag_s else "none found"


def _review_words(found: Survey) -> str:
    """Return the decisions of a review in words, with the number of each kind."""
    actions = [entry_of(decision)["action"] for decision in found.decisions]
    words = (("drop", "dropped"), ("split", "split"), ("add", "added"))
    parts = [f"{_count(actions.count(action), 'target')} {word}" for action, word in words if action in actions]
    if "exclude" in actions:
        parts.append(f"rows excluded in {_count(actions.count('exclude'), 'place')}")
    return f"{', '.join(parts)}; fit after the last decision, each one in decisions.jsonl"


def _target_header(frame: MapFrame) -> tuple[str, ...]:
    places = ("longitude", "latitude") if frame.is_geographic else ("easting", "northing")
    return ("id", *places, "depth [m]", "95 %", "|m| [A·m²]", "± xy [cm]", "iron [kg]", "size", "fit", "flags")


def _target_rows(found: Survey, frame: MapFrame) -> Iterator[tuple[str, ...]]:
    digits = 7 if frame.is_geographic else 2
    for target, (x, y) in zip(found, frame.project(found.position_m).tolist(), strict=True):
        low, high = target.depth_interval95_m
        least, most = target.iron_kg
        yield (
            target.id,
            f"{x:.{digits}f}",
            f"{y:.{digits}f}",
            f"{target.depth_m:.2f}",
            f"{low:.2f}–{high:.2f}",
            f"{target.strength_Am2:.3g}",
            f"{100.0 * target.ellipse95[0]:.2g}",
            f"{_two_digits(least)}–{_two_digits(most)}",
            target.size_class,
            target.fit_quality,
            " ".join(target.flags),
        )


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


def _flag_words(found: Survey) -> str:
    used = sorted({flag for target in found for flag in target.flags})
    words = "; ".join(f"<b>{flag}</b>: {_FLAGS.get(flag, '')}" for flag in used)
    iron = f"A kilogram of iron has {IRON_Am2_PER_KG[0]:g} to {IRON_Am2_PER_KG[1]:g} A·m²."
    edges = ", ".join(f"{name} from {least:g} A·m²" for name, least in SIZE_CLASSES_Am2.items() if least)
    return f"<small>± xy: longer half axis of the 95 % ellipse. {iron} Size: {edges}. {words}</small>"


def _reach_rows(found: Survey) -> Iterator[tuple[str, ...]]:
    for depth, reach in found.reach_by_depth.items():
        yield f"{depth:g} m", *(f"{100.0 * np.mean(reach.moment_Am2 <= moment):.0f} %" for moment in _REACH_Am2)


def _ground_rows(found: Survey, frame: MapFrame) -> Iterator[tuple[str, str]]:
    yield "origin", place_in_words(frame.origin)
    terrain = found.terrain
    if not terrain.is_flat:
        heights = frame.origin[2] + terrain.height_at(found.rows.place_m[:, :2])
        yield "ground", f"{terrain.name}, at heights of {heights.min():.2f} to {heights.max():.2f} m"
        return
    side = "below" if found.ground_m < 0.0 else "above"
    yield "ground", f"flat, {abs(found.ground_m):g} m {side} the origin" if found.ground_m else "flat, at the origin"


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' if number != 1 else ''}"


def _assumption_rows(found: Survey) -> Iterator[tuple[str, str]]:
    yield "model", "every target is a magnetic dipole at rest"
    pose = found.array.pose
    if pose is not None:
        how = "estimated from the rows, because none were stated" if found.pose_assumed else "as stated"
        yield "errors of positions", f"{100.0 * pose.position_m:.2g} cm that last {pose.correlation_s:g} s, {how}"


def _table(header: Sequence[str], rows: Iterable[Sequence[str]], numbers: Iterable[int] = ()) -> str:
    numbers = set(numbers)

    def line(cells: Sequence[str], tag: str) -> str:
        kinds = [' class="n"' if i in numbers else "" for i in range(len(cells))]
        return "<tr>" + "".join(f"<{tag}{k}>{escape(c)}</{tag}>" for k, c in zip(kinds, cells, strict=True)) + "</tr>"

    head = line(header, "th") if any(header) else ""
    return "<table>" + head + "".join(line(row, "td") for row in rows) + "</table>"


def _picture(figure: Figure, caption: str) -> str:
    from magloc.plots import style

    data = base64.b64encode(style.png(figure, _DPI)).decode()
    words = escape(caption)
    image = f'<img alt="{words}" src="data:image/png;base64,{data}">'
    return f"<figure>{image}<figcaption>{words}</figcaption></figure>"
