"""Tables of numbers as logs: data frames, Parquet, HDF5 and TDMS."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from arrays.io.errors import InputError, of_extra
from magloc.logs.channels import ROWS, Log, Topic
from magloc.logs.units import LoggedUnit, logged_unit, unit_of_field

if TYPE_CHECKING:
    import pandas as pd

_TIME = re.compile(r"(?:.*[/_ ])?(time|timestamp|t|clock)(?:[ _]*[\[(]?(?:s|ms|us)[\])]?)?", re.IGNORECASE)
_MOST_COLUMNS = 16  # of a table of two dimensions; wider ones are pictures


def _topic(name: str, fields: Mapping[str, NDArray[Any]], units: Mapping[str, str], separator: str = "/") -> Topic:
    """Return a topic whose clock is a field of times in a known unit, if there is one."""
    known = {of: logged_unit(units[of]) if units.get(of) else unit_of_field(of) for of in fields}
    for of, values in fields.items():
        if not _TIME.fullmatch(of):
            continue
        is_instant = values.dtype.kind == "M"
        if is_instant:
            unit, values = LoggedUnit("s", "s"), values.astype("datetime64[ns]").astype(np.int64) * 1e-9
        elif (unit := known[of]).si != "s":
            continue
        time_s = np.asarray(values * unit.si_per_unit, dtype=np.float64)
        rest = {key: value for key, value in fields.items() if key != of or not is_instant}
        return Topic(name, time_s, _numeric(rest), known, "unix" if is_instant else of, separator)
    n = len(next(iter(fields.values())))
    return Topic(name, np.arange(float(n)), _numeric(fields), known, ROWS, separator)


def _numeric(fields: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    return {name: of for name, of in fields.items() if of.dtype.kind in "biuf"}


def log_of_frame(frame: pd.DataFrame, path: str = "the data frame", kind: str = "table") -> Log:
    """Return the channels of a data frame: its columns of numbers."""
    fields = {str(name): np.asarray(frame[name]) for name in frame.columns}
    fields = {name: of for name, of in fields.items() if of.dtype.kind in "biufM"}
    if not fields or not len(frame):
        raise InputError(f"{path}: found no column of numbers, expected a table of readings.")
    return Log(path, kind, (_topic("", fields, frame.attrs.get("units", {})),))


def read_parquet(path: Path) -> Log:
    """Return the channels of a Parquet file, read by pandas with pyarrow or fastparquet."""
    import pandas as pd

    try:
        frame = pd.read_parquet(path)
    except ImportError:
        raise InputError(f"{path}: a Parquet file needs pyarrow or fastparquet: pip install pyarrow.") from None
    except Exception:  # both engines raise many kinds of errors
        raise InputError(f"{path}: found a Parquet file that cannot be read, expected a whole one.") from None
    return log_of_frame(frame, str(path), "Parquet")


def read_hdf5(path: Path) -> Log:
    """Return the channels of an HDF5 file: its tables of one or two dimensions, by their paths."""
    with of_extra("logs", "an HDF5 file"):
        import h5py
    groups: dict[tuple[str, int], dict[str, NDArray[Any]]] = {}
    units: dict[str, dict[str, str]] = {}

    def collect(name: str, item: Any) -> None:
        if not isinstance(item, h5py.Dataset) or item.ndim not in (1, 2) or not len(item):
            return
        group, _, own = name.rpartition("/")
        stated = item.attrs.get("units", item.attrs.get("unit", ""))
        unit = stated.decode() if isinstance(stated, bytes) else str(stated)
        for field, values in _columns(own, item):
            groups.setdefault((group, len(item)), {})[field] = values
            units.setdefault(group, {})[field] = unit

    try:
        with h5py.File(path, "r") as file:
            file.visititems(collect)
    except Exception:  # h5py raises many kinds of errors for damaged files
        raise InputError(f"{path}: found an HDF5 file that cannot be read, expected a whole one.") from None
    topics = tuple(_topic(group, fields, units[group]) for (group, _), fields in groups.items())
    if not topics:
        raise InputError(f"{path}: found an HDF5 file without tables of numbers, expected readings.")
    return Log(str(path), "HDF5", topics)


def _columns(name: str, item: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield the columns of a data set with their names."""
    if item.dtype.names:
        if item.ndim == 1:
            table = item[()]
            yield from ((f"{name}.{of}", table[of]) for of in item.dtype.names if table[of].dtype.kind in "biuf")
    elif item.dtype.kind not in "biuf":
        return
    elif item.ndim == 1:
        yield name, item[()]
    elif item.shape[1] <= _MOST_COLUMNS:
        yield from ((f"{name}[{i}]", column) for i, column in enumerate(item[()].T))


def read_tdms(path: Path) -> Log:
    """Return the channels of a TDMS file; a waveform has its own clock."""
    with of_extra("logs", "a TDMS file"):
        from nptdms import TdmsFile
        from nptdms.log import log_manager
    log_manager.set_level(logging.ERROR)  # its warnings are in those of the log
    try:
        file = TdmsFile.read(path)
        topics = [topic for group in file.groups() for topic in _tdms_topics(group)]
        is_cut = bool(file.file_status.incomplete_final_segment)
    except Exception:  # nptdms raises many kinds of errors for damaged files
        raise InputError(f"{path}: found a TDMS file that cannot be read, expected a whole one.") from None
    if not topics:
        raise InputError(f"{path}: found a TDMS file without numbers, expected readings.")
    warnings = (f"{path}: the last segment is cut; its whole values are read",) * is_cut
    return Log(str(path), "TDMS", tuple(topics), warnings=warnings)


def _tdms_topics(group: Any) -> Iterator[Topic]:
    plain: dict[int, dict[str, NDArray[Any]]] = {}
    units: dict[str, str] = {}
    for channel in group.channels():
        values = np.asarray(channel[:])
        if values.dtype.kind not in "biufM" or not len(values):
            continue
        stated = str(channel.properties.get("unit_string", ""))
        step_s = float(channel.properties.get("wf_increment", 0.0))
        if step_s > 0.0:
            start_s = float(channel.properties.get("wf_start_offset", 0.0))
            time_s = start_s + step_s * np.arange(float(len(values)))
            unit = logged_unit(stated) if stated else unit_of_field(channel.name)
            yield Topic(group.name, time_s, {channel.name: values}, {channel.name: unit}, "waveform", "/")
        else:
            plain.setdefault(len(values), {})[channel.name] = values
            units[channel.name] = stated
    yield from (_topic(group.name, fields, units) for fields in plain.values())
