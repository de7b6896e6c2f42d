"""Proposal of the table ``columns`` from the names and numbers of a log."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike

import numpy as np

from arrays.columns import NANOTESLA, LogColumns
from arrays.io.csv import is_number_or_empty
from arrays.io.errors import InputError
from arrays.io.text import read_text
from arrays.io.toml import toml_value
from arrays.logs.lines import cells_of
from arrays.typing import FloatArray

_HEAD_LINES, _ROWS, _FEWEST_ROWS = 1000, 200, 5
_MARKS = ("#", "/", "!", "%")
_LINE_NAME = re.compile(r"(/?(?:line|tie|l|t))\s*-?(?:(?<=\s)[A-Za-z]?)\d[\w.:-]*\s*$", re.IGNORECASE)
_MONTHS = 12
_EARTH_nT = (20e3, 70e3)
_LARGEST_nT = 2e9  # no magnet has more beside it
_NAMES = {
    "date": r"date|datum|gps ?date|utc ?date",
    "time": r"(gps|utc|system)?[ _]?(time|timestamp|uhrzeit|zeit|clock|counter|utc|tow|seconds)|t|tow|millis|micros",
    "latitude": r"lat(itude)?|breite|gps ?lat(itude)?",
    "longitude": r"lon(g|gitude)?|lng|länge|gps ?lon(gitude)?",
    "height": r"(ell|orth|gps)?[ _.]?(alt(itude)?|height|elev(ation)?|höhe|h)([ _](asl|amsl|msl))?|z|u|up|h[ _]?ell",
    "above ground": r"(alt(itude)?|height|elev(ation)?|höhe)[ _](agl|(above|over) ground|über grund)|agl|hag|laser",
    "east": r"x|e|east(ing)?|rechtswert|rw|utm[ _]?(e|x|east(ing)?)",
    "north": r"y|n|north(ing)?|hochwert|hw|utm[ _]?(n|y|north(ing)?)",
    "valid": r"(mag)?[ _]?valid",
    "fix": r"fix([ _]?(quality|type))?|gps ?fix|q(uality)?",
    "yaw": r"yaw|heading|hdg",
    "pitch": r"pitch",
    "roll": r"roll",
}
_TIME_OF_DAY = re.compile(r"\d:\d\d")
_UNIT = re.compile(r"\[.*\]|\(.*\)|nT|[uµ]T|m?T|m?G|[mu]?s|h|m|deg|°C?|V|Hz|-")
_FIELD = re.compile(r"mag|^b\d*[xyz]?$|field|feld|flux|tmi|^nt|^t?f\d*[xyz]?$", re.IGNORECASE)
_UNIT_OF_NAME = re.compile(r"^(.*?)[ _]*(?:\[([^\]]*)\]|\(([^)]*)\)|_(nT|uT|µT|mT|T|ms|us|s|m|deg))?$")
_FIELD_UNITS = ("nT", "uT", "µT", "mT")  # T and G also stand for a temperature and for gravity
_UNIT_OF_CLOCK = {"millis": "ms", "micros": "us"}  # the clocks of an Arduino


@dataclass(frozen=True)
class Proposal:
    """Proposed columns of a log, and open questions.

    Attributes
    ----------
    channels : dict of str to str
        Columns of the log, with the first cell of each that is not empty.
    keys : dict
        Keys of the table ``columns`` that the log determines.
    sensors : dict
        Columns of likely magnetometers, by an id.
    asked : list of str
        Questions that the log leaves open.
    header_line : int
        Line of the header.
    about : str
        Sentence about a log without lines, instead of that about the header.
    sensor_lines : tuple of str
        Further lines of the table of each sensor.
    noise_lines : dict
        Measured noise of a sensor, by its id, as lines of its table.
    """

    channels: dict[str, str]
    keys: dict[str, object]
    sensors: dict[str, str | tuple[str, ...]]
    asked: list[str]
    header_line: int
    about: str = ""
    sensor_lines: tuple[str, ...] = ()
    noise_lines: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def toml(self) -> str:
        """Return the text of an array file with the table, and comments with open questions."""
        said = "rows begin" if "names" in self.keys else "header is"
        about = self.about or f"The {said} on line {self.header_line}. Columns, with their first values:"
        lines = [f"# {about}"]
        lines += [f"#   {name}: {cell}" for name, cell in self.channels.items()]
        lines += [f"# Asked: {question}" for question in self.asked]
        for name, of in self.sensors.items():
            kind = "scalar" if isinstance(of, str) else "vector"
            lines += ["", "[[sensor]]", f'id = "{name}"', f'kind = "{kind}"', "position_m = [0.0, 0.0, 0.0]  # asked"]
            lines += [*self.noise_lines.get(name, ["noise_nT = 1.0  # asked"]), *self.sensor_lines]
        lines += ["", "[columns]", *(f"{key} = {toml_value(value)}" for key, value in self.keys.items())]
        lines += ["", "[columns.sensors]", *(f"{name} = {toml_value(of)}" for name, of in self.sensors.items())]
        return "\n".join([*lines, ""])


def propose_columns(path: str | PathLike[str]) -> Proposal:
    """Return a proposal for reading the log of another program.

    Parameters
    ----------
    path : str or path-like
        A text file with a header and rows of numbers.

    Returns
    -------
    Proposal
        Keys that the log determines, and questions to its owner.

    Raises
    ------
    InputError
        The file cannot be read, or has no header with rows of numbers below it.
    """
    keys: dict[str, object] = {}
    asked = ["places and noise of the sensors, in the tables below"]
    try:
        text = read_text(path, "a text file of a logger")
    except InputError as error:
        if "is not UTF-8" not in str(error):
            raise
        text = read_text(path, "a text file of a logger", "windows-1252")
        keys["encoding"] = "windows-1252"
        asked.append("is the text Windows-1252? Letters such as ä in the names below are wrong if not")
    lines = text.splitlines()[:_HEAD_LINES]
    columns, number, header, rows = _layout(str(path), lines)
    keys |= _text_keys(columns, lines, number)
    if columns.names:
        asked.append("the log has no header: what its columns are, by the names that the other keys use")
    cells = {name: [row[i] for row in rows if len(row) > i] for i, name in enumerate(header)}
    channels = {name: next(filter(None, of), "") for name, of in cells.items()}
    values = {name: _numbers(of, columns.decimal) for name, of in cells.items()}
    _propose_time(header, channels, values, keys, asked)
    _propose_places(header, values, keys, asked)
    sensors = _sensors(header, values, keys, asked)
    _propose_attitude(header, keys, asked, len(sensors))
    for key in ("valid", "fix"):
        if (flag := _find(header, key)) is not None:
            seen = ", ".join(f"{value:g}" for value in np.unique(values[flag][np.isfinite(values[flag])])[:6])
            asked.append(
                f'which values of {flag} are valid (seen: {seen})? {key} = {{column = "{flag}", equals = [...]}}'
            )
    return Proposal(channels, keys, sensors, asked, number)


def _layout(name: str, lines: Sequence[str]) -> tuple[LogColumns, int, list[str], list[list[str]]]:
    """Return the best separator and decimal, line and cells of the header, and the rows."""
    best: tuple[int, LogColumns, int, list[str], list[list[str]]] | None = None
    for separator in ("semicolon", "tab", "comma", "space"):
        for decimal in (".", ",") if separator != "comma" else (".",):
            columns = LogColumns(separator=separator, decimal=decimal, comment=_MARKS)
            split = [cells_of(line, columns) for line in lines]
            for k, header in enumerate(split):
                if len(header) < 2 or not _are_names(header, decimal) or (best is not None and header == best[3]):
                    continue
                rows = [row for row in split[k + 1 : k + 1 + _ROWS] if len(header) / 2 <= len(row) <= len(header)]
                counts = [_filled(row, decimal) for row in rows]
                score = int(np.median(counts)) if counts else 0
                is_lower = best is not None and best[1] is columns and score == best[0]  # than a line of the preamble
                if score > 1 and (best is None or score > best[0] or is_lower):
                    best = (score, columns, k + 1, header, [row for row, n in zip(rows, counts, strict=True) if n])
    if best is None:
        return _layout_without_names(name, lines)
    return best[1:]


def _layout_without_names(name: str, lines: Sequence[str]) -> tuple[LogColumns, int, list[str], list[list[str]]]:
    """Return separator, first line, made names and rows of a log without a header."""
    for separator, decimal in itertools.product(("semicolon", "tab", "comma", "space"), (".", ",")):
        if (separator, decimal) == ("comma", ","):
            continue
        columns = LogColumns(separator=separator, decimal=decimal, comment=_MARKS)
        split = [cells_of(line, columns) for line in lines]
        n = int(np.median([len(row) for row in split if row] or [0]))
        numbers = [_filled(row, decimal) if len(row) == n else 0 for row in split]
        rows = [row for row, k in zip(split, numbers, strict=True) if k >= max(2, n // 2)]
        if n > 1 and len(rows) >= _FEWEST_ROWS and 2 * len(rows) > len(lines):
            names = [f"c{i}" for i in range(1, n + 1)]
            return replace(columns, names=tuple(names)), split.index(rows[0]) + 1, names, rows[:_ROWS]
    raise InputError(f"{name}: found no names with rows of numbers below them, expected the text of a logger.")


def _filled(row: Sequence[str], decimal: str) -> int:
    """Return the number of cells of a row that are numbers or times of day."""
    return int(np.isfinite(_numbers(row, decimal)).sum()) + sum(bool(_TIME_OF_DAY.search(cell)) for cell in row)


def _are_names(cells: Sequence[str], decimal: str) -> bool:
    """Return whether no cell is a number, and not all cells are units."""
    filled = [cell for cell in cells if cell]
    is_number = any(is_number_or_empty(cell.replace(decimal, ".")) for cell in filled)
    return not is_number and not all(map(_UNIT.fullmatch, filled))


def _text_keys(columns: LogColumns, lines: Sequence[str], number: int) -> dict[str, object]:
    keys: dict[str, object] = {} if columns.separator == "comma" else {"separator": columns.separator}
    keys |= {} if columns.decimal == "." else {"decimal": columns.decimal}
    keys |= {"names": columns.names} if columns.names else {}
    below = [line.strip() for line in lines[number:]]
    marks = [mark for mark in _MARKS if any(line.startswith(mark) for line in (lines[number - 1].strip(), *below))]
    if marks and marks != ["#"]:
        keys["comment"] = tuple(marks)
    names = {found[1] for line in below if (found := _LINE_NAME.match(line)) and not line.startswith(tuple(marks))}
    return keys | ({"skip": tuple(sorted(names))} if names else {})


def _numbers(cells: Sequence[str], decimal: str) -> FloatArray:
    texts = [cell.replace(decimal, ".") for cell in cells]
    return np.array([float(text) if text and is_number_or_empty(text) else np.nan for text in texts])


def _find(header: Sequence[str], kind: str) -> str | None:
    """Return the first column whose name, without its unit, is of a kind."""
    for name in header:
        found = _UNIT_OF_NAME.match(name)
        if found and re.fullmatch(_NAMES[kind], found[1].strip(), re.IGNORECASE):
            return name
    return None


def _unit(name: str) -> str:
    found = _UNIT_OF_NAME.match(name)
    stated = next(filter(None, found.groups()[1:]), "") if found else ""
    return stated or _UNIT_OF_CLOCK.get(name.lower(), "")


def _propose_time(
    header: Sequence[str],
    channels: dict[str, str],
    values: dict[str, FloatArray],
    keys: dict[str, object],
    asked: list[str],
) -> None:
    time, date = _find(header, "time"), _find(header, "date")
    if time is None:
        asked.append('which column is the time? time = "…"')
        return
    keys["time"] = time
    if ":" in channels[time]:
        keys["time_unit"] = "iso"
        if date is not None:
            keys["time"] = (date, time)
        instant = channels[date] if date is not None else channels[time]
        if re.match(r"\d{1,2}[./-]\d{1,2}[./-]\d{2,4}", instant):
            if "." in instant.split(" ")[0] or int(re.split(r"[./-]", instant)[0]) > _MONTHS:
                keys["day_first"] = True  # no format with points begins with the month
            elif int(re.split(r"[./-]", instant)[1]) > _MONTHS:
                keys["day_first"] = False
            else:
                asked.append(f"does {instant} begin with the day? day_first = true or false")
        elif not re.match(r"\d{4}", instant):
            asked.append('the date of the first row, if it matters: date = "2026-05-12"')
    elif _unit(time) in ("s", "ms", "us"):
        keys["time_unit"] = _unit(time)
    else:
        step = float(np.nanmedian(np.diff(values[time]))) if len(values[time]) > 1 else np.nan
        choice = "time_unit = s, ms, us, or hhmmss"
        asked.append(f"the unit of {time}, which begins with {channels[time]} and grows by {step:g} a row: {choice}")


def _propose_places(
    header: Sequence[str], values: dict[str, FloatArray], keys: dict[str, object], asked: list[str]
) -> None:
    ground = _find(header, "above ground")
    height = ground or _find(header, "height")
    for key, kinds in (("geodetic", ("latitude", "longitude")), ("position", ("east", "north"))):
        names = [_find(header, kind) for kind in kinds]
        if None in names:
            continue
        place = np.array([values[name] for name in names if name is not None])
        place = place[:, (np.isfinite(place) & (place != 0.0)).all(axis=0)]
        keys[key] = tuple(name for name in (*names, height) if name is not None)
        if ground is not None:
            keys["height_is"] = "ground"
        elif height is None:
            asked.append("the height of the array above the ground: height_m = 0.4")
        if key == "geodetic" and place.size:
            heights = np.zeros(1) if height is None or ground is not None else values[height]
            first = float(next(iter(heights[np.isfinite(heights)]), 0.0))
            keys["origin"] = (round(float(place[0, 0]), 5), round(float(place[1, 0]), 5), round(first, 2))
            asked.append("the origin of the world's frame is put at the first place. --ground-m counts from its height")
        elif place.size and np.abs(place).max() > 1e4:
            asked.append('which grid are these places of? crs = "EPSG:32633" for UTM zone 33 north; and an origin')
        return
    asked.append("no columns of a place were found: position or geodetic, if the array moves")


def _propose_attitude(header: Sequence[str], keys: dict[str, object], asked: list[str], sensors: int) -> None:
    if not {"position", "geodetic"} & keys.keys():
        return
    angles = tuple(name for kind in ("yaw", "pitch", "roll") if (name := _find(header, kind)) is not None)
    if len(angles) == 3 or (angles and angles[0] == _find(header, "yaw")):
        keys["angles"] = angles if len(angles) == 3 else angles[:1]
        asked.append(f"are {', '.join(angles)} in degrees, yaw clockwise from north, pitch up, right wing down?")
    elif sensors > 1:
        asked.append("the log has no heading: course = true if x of the array points along the course")


def _sensors(
    header: Sequence[str], values: dict[str, FloatArray], keys: dict[str, object], asked: list[str]
) -> dict[str, str | tuple[str, ...]]:
    """Return columns with the modulus of the Earth's field, or whose names state the unit of a field."""
    taken: list[object] = []
    for key in ("time", "position", "geodetic"):
        named = keys.get(key, ())
        taken += named if isinstance(named, tuple) else [named]
    free = [name for name in header if name not in taken]
    groups: list[tuple[str, ...]] = []
    for name in free:
        for at in [found.start() for found in re.finditer("[xX]", name)]:
            xyz = tuple(name[:at] + letter + name[at + 1 :] for letter in ("xyz" if name[at] == "x" else "XYZ"))
            if set(xyz) <= set(free):
                groups.append(xyz)
                break
    groups += [(name,) for name in free if not any(name in group for group in groups)]
    units: dict[tuple[str, ...], str] = {}
    for group in groups:
        modulus = _modulus(values, group)
        stated = _unit(group[0])
        likely = (
            ("nT", "uT", "G", "mG") if not stated and _FIELD.search(group[0]) else ("nT",) if "names" in keys else ()
        )
        for unit in (stated,) if stated in NANOTESLA else likely:
            if _EARTH_nT[0] < modulus * NANOTESLA[unit] < _EARTH_nT[1]:
                units[group] = unit
                break
    stated_triples: dict[tuple[str, ...], str] = {
        group: unit
        for group in groups
        if len(group) == 3
        and (unit := _unit(group[0])) in _FIELD_UNITS
        and 0.0 < _modulus(values, group) * NANOTESLA[unit] < _LARGEST_nT
    }
    alike = {_digits_hidden(group[0]) for group in units}
    if not units and stated_triples:
        units = stated_triples
        asked.append("is the unit right? Readings differ from the Earth's field, as of Hall sensors with offsets")
    elif units:  # one of several sensors with offsets may read like the Earth's field by chance
        units |= {group: of for group, of in stated_triples.items() if _digits_hidden(group[0]) in alike}
        units = {group: units[group] for group in groups if group in units}
    if not units:
        near = [name for name in free if _EARTH_nT[0] < _modulus(values, (name,)) < _EARTH_nT[1]]
        hint = f" (in nT it could be {' or '.join(near)})" if near else ""
        asked.append(
            f'no column reads like the Earth\'s field: name those of the sensors as s1 = ["bx", "by", "bz"]{hint}'
        )
        return {}
    unit = next(iter(units.values()))
    if any(not _unit(group[0]) for group in units):
        asked.append(f"are the readings in {unit}? Their moduli are then those of the Earth's field")
    if unit != "nT":
        keys["unit"] = unit
    same = [group for group, of in units.items() if of == unit]
    return {f"s{k}": group[0] if len(group) == 1 else group for k, group in enumerate(same, start=1)}


def _digits_hidden(name: str) -> str:
    return re.sub(r"\d+", "#", name)


def _modulus(values: dict[str, FloatArray], group: Sequence[str]) -> float:
    n = min(len(values[name]) for name in group)
    with np.errstate(over="ignore", invalid="ignore"):  # numbers of a log may be any
        moduli = np.linalg.norm([values[name][:n] for name in group], axis=0)
    return float(np.median(moduli[np.isfinite(moduli)])) if np.isfinite(moduli).any() else 0.0
