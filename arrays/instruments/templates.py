"""Array files for the logs of known instruments.

A template is a TOML file in this folder, or in ``tracks`` for positions only. It has the keys of an array file, and in
addition:

- ``title``, and ``source``, the public document or sample that shows the format; ``secondary = true`` if that is not
  the maker's own.
- ``add``, the keys that the user has to add.
- ``[[layout]]``, tables with keys that replace those of the file. The first layout that the log fits is used: the
  header has its columns, with ``every_sensor = true`` those of all sensors, and a line matches the pattern ``row``.

In the table ``columns`` a name may have alternatives, ``"Alt|Altitude"``. Sensors and optional columns (``valid``,
``fix``, ``line``, attitude) that a log does not have are omitted.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import msgspec

from arrays.array import SensorArray
from arrays.array_file import array_of_table
from arrays.columns import ColumnsTable, LogColumns, Track
from arrays.io.errors import InputError
from arrays.io.text import read_text
from arrays.io.toml import BuiltIn, File, read_toml, section_of
from arrays.logs.lines import cells_of

_TEMPLATES = BuiltIn("arrays", "instruments", "instrument")
_TRACKS = BuiltIn("arrays", "instruments/tracks", "log of positions")
_CHARACTERS = 2**20
_LINES = 1000  # at the begin of a log that may hold its header
_RULES = ("every_sensor", "row")
_OWN_KEYS = ("title", "source", "secondary", "add", "layout")
_OPTIONAL = ("valid", "fix", "quaternion", "angles", "line")


class _Template(File, kw_only=True):
    title: str
    source: str
    secondary: bool = False
    add: str = ""
    layout: list[dict[str, Any]] = msgspec.field(default_factory=lambda: [{}])


@dataclass(frozen=True)
class Instrument:
    """Instrument whose logs can be read.

    Attributes
    ----------
    name : str
        Name of the template.
    title : str
        Maker and model.
    source : str
        Public document or sample that shows the format.
    is_secondary : bool
        True if the source is not the maker's own.
    add : str
        Sentence that states what the user has to add; empty if nothing.
    layouts : tuple of mapping
        Array tables, one for each layout of its logs.

    Examples
    --------
    >>> import arrays
    >>> arrays.read_instrument("magarrow").title
    'Geometrics MagArrow'
    """

    name: str
    title: str
    source: str
    is_secondary: bool
    add: str
    layouts: tuple[Mapping[str, Any], ...]

    def array(self, log: str | PathLike[str], keys: str | PathLike[str] | None = None) -> SensorArray:
        """Return the sensors and columns for a log.

        Parameters
        ----------
        log : str or path-like
            Log of the instrument; its header decides which sensors and columns it has.
        keys : str or path-like, optional
            Array file (TOML) with keys that replace those of the template; sensors are matched by their ids.

        Returns
        -------
        SensorArray
            Array with its columns, for :func:`magloc.read_readings`.

        Raises
        ------
        InputError
            The log has none of the layouts of the instrument, or the keys are invalid.
        """
        own = {} if keys is None else read_toml(keys, "a TOML file of an array")
        place = f"instrument {self.name}" if keys is None else f"{keys} (instrument {self.name})"
        text = ""
        for layout in self.layouts:
            table = _merge(layout, own)
            _drop_replaced(table["columns"], own.get("columns", {}))
            columns = table["columns"]
            text = text or read_text(log, "a log of text", columns.get("encoding"))
            if (fitted := _fit(table, text)) is not None:
                return array_of_table(place, fitted)
        wanted = " or ".join(", ".join(map(repr, _required(layout["columns"]))) for layout in self.layouts)
        raise InputError(f"{log}: found no header of a log of {self.title}, expected the columns {wanted}.")


def instrument_names() -> tuple[str, ...]:
    """Return the names of the instruments whose logs can be read.

    Returns
    -------
    tuple of str
        Names, in alphabetical order.

    Examples
    --------
    >>> import arrays
    >>> "magarrow" in arrays.instrument_names()
    True
    """
    return _TEMPLATES.names()


def read_instrument(name: str) -> Instrument:
    """Return the template of an instrument.

    Parameters
    ----------
    name : str
        One of :func:`instrument_names`.

    Returns
    -------
    Instrument
        Its array, with the columns of its logs, and the source of the format.

    Raises
    ------
    InputError
        There is no such instrument; the text has the names of all.

    Examples
    --------
    >>> import arrays
    >>> arrays.read_instrument("gsm19").title
    'GEM Systems GSM-19'
    """
    return _instrument(name.lower(), _TEMPLATES.chosen(name.lower()))


def _instrument(name: str, path: Path) -> Instrument:
    """Return the template in a file."""
    table = read_toml(path, "a template")
    keys = {key: table[key] for key in _OWN_KEYS if key in table}
    own = section_of(str(path), keys, _Template)
    common = {key: value for key, value in table.items() if key not in _OWN_KEYS}
    layouts = tuple(_merge(common, layout) for layout in own.layout)
    return Instrument(name, own.title, own.source, own.secondary, own.add, layouts)


def read_track(path: str | PathLike[str]) -> Track:
    """Return a log of positions, for :attr:`arrays.LogColumns.track`.

    Parameters
    ----------
    path : str or path-like
        Solution of RTKLIB or Emlid (.pos).

    Returns
    -------
    Track
        The file, with the meaning of its columns.

    Raises
    ------
    InputError
        The file cannot be read, or has another format.

    Examples
    --------
    >>> from pathlib import Path
    >>> import arrays
    >>> names = "%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns"
    >>> row = "2026/05/12 09:14:21.000   52.41000001   13.12000002    41.400   1  12"
    >>> _ = Path("walk.pos").write_text(names + chr(10) + row)
    >>> arrays.read_track("walk.pos").columns.time_offset_s
    -18.0
    """
    text = read_text(path, "a log of positions")
    titles = []
    for name in _TRACKS.names():
        template = _instrument(name, _TRACKS.path(name))
        titles.append(template.title)
        for layout in template.layouts:
            if (fitted := _fit(layout, text)) is not None:
                table = section_of(f"track {name}", fitted["columns"], ColumnsTable)
                return Track(str(path), table.columns(f"track {name}", {}))
    raise InputError(f"{path}: found no log of positions, expected one of {', '.join(titles)}.")


def _merge(base: Mapping[str, Any], own: Mapping[str, Any]) -> dict[str, Any]:
    """Return a table with keys that other keys replace; tables are merged, sensors by their ids."""
    merged = dict(base)
    for key, value in own.items():
        before = merged.get(key)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            merged[key] = _merge(before, value)
        elif key == "sensor" and isinstance(before, list) and isinstance(value, list):
            by_id = {of.get("id"): of for of in before}
            for of in value:
                by_id[of.get("id")] = _merge(by_id.get(of.get("id"), {}), of)
            merged[key] = list(by_id.values())
        else:
            merged[key] = value
    return merged


def _drop_replaced(columns: dict[str, Any], own: Mapping[str, Any]) -> None:
    """Drop keys that contradict the user's keys: another place, another attitude, a column of heights."""
    for keys in (("position", "geodetic"), ("quaternion", "angles", "course")):
        if any(key in own for key in keys):
            for key in set(keys) - own.keys():
                columns.pop(key, None)
    if "height_m" in own:
        columns.pop("height_is", None)
        columns.update({key: columns[key][:2] for key in ("position", "geodetic") if key in columns})


def _required(columns: Mapping[str, Any]) -> list[str]:
    """Return the names, with their alternatives, of the columns that a log must have."""
    time = [] if columns.get("time_unit") == "rows" else columns.get("time", "time_s")
    return [*([time] if isinstance(time, str) else time), *columns.get("position", columns.get("geodetic", ()))]


def _fit(table: Mapping[str, Any], text: str) -> dict[str, Any] | None:
    """Return the table with the names of a log, without what the log lacks; None if it has no such header."""
    columns = table["columns"]
    if re.search(table.get("row", ""), text[:_CHARACTERS], flags=re.MULTILINE) is None:
        return None
    form = LogColumns(**{key: _tuple(columns[key]) for key in ("separator", "comment") if key in columns})
    wanted = columns.get("sensors", {})
    for header in [columns["names"]] if "names" in columns else _headers(text, form):
        if all(_name(names, header) for names in _required(columns)):
            sensors = {id_: _names(of, header) for id_, of in wanted.items()}
            sensors = {id_: names for id_, names in sensors.items() if names is not None}
            if len(sensors) == len(wanted) or (sensors and not table.get("every_sensor")):
                fitted = {key: _names(value, header) for key, value in columns.items() if key != "sensors"}
                fitted = {key: columns[key] if value is None else value for key, value in fitted.items()}
                for key in _OPTIONAL:
                    if key in columns and (found := _optional(columns[key], header)) is None:
                        del fitted[key]
                    elif key in columns:
                        fitted[key] = found
                present = [of for of in table.get("sensor", ()) if of["id"] in sensors]
                keys = {key: value for key, value in table.items() if key not in _RULES}
                return {**keys, "sensor": present, "columns": {**fitted, "sensors": sensors}}
    return None


def _headers(text: str, form: LogColumns) -> Iterator[list[str]]:
    lines = text[:_CHARACTERS].removeprefix("\ufeff").splitlines()
    return (cells_of(line, form) for line in itertools.islice(lines, _LINES))


def _name(names: str, header: Sequence[str]) -> str | None:
    """Return the first of the alternatives that is a column."""
    return next((name for name in names.split("|") if name in header), None)


def _names(value: Any, header: Sequence[str]) -> Any:
    """Return a name, or all names of a list, as the header has them; None if one is missing."""
    if isinstance(value, str):
        return _name(value, header)
    if isinstance(value, list) and value and all(isinstance(each, str) for each in value):
        found = [_name(each, header) for each in value]
        return None if None in found else found
    return None


def _optional(value: Any, header: Sequence[str]) -> Any:
    if isinstance(value, Mapping):
        name = _name(value["column"], header)
        return None if name is None else {**value, "column": name}
    return _names(value, header)


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
