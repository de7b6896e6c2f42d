"""Reading of a log of any known format."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from arrays.io.errors import InputError
from magloc.logs.channels import Log

if TYPE_CHECKING:
    import pandas as pd

_LOG = logging.getLogger(__name__)
_PX4, _ARDUPILOT, _BAG, _TABLES = (f"magloc.logs.{name}" for name in ("px4", "ardupilot", "bags", "tables"))
_FORMATS = {
    b"ULog\x01\x12\x35": (_PX4, "read_ulog"),
    b"\xa3\x95\x80": (_ARDUPILOT, "read_dataflash"),
    b"#ROSBAG V2.0": (_BAG, "read_bag"),
    b"\x89MCAP0\r\n": (_BAG, "read_bag"),
    b"SQLite format 3\0": (_BAG, "read_bag"),
    b"PAR1": (_TABLES, "read_parquet"),
    b"\x89HDF\r\n\x1a\n": (_TABLES, "read_hdf5"),
    b"TDSm": (_TABLES, "read_tdms"),
}
"""Readers by the first bytes of their files."""
_KINDS = "PX4 ULog, ArduPilot DataFlash, a ROS bag, MCAP, Parquet, HDF5 or TDMS"


def log_reader(path: str | PathLike[str]) -> Callable[[Path], Log] | None:
    """Return the reader of a binary log by its first bytes; None for text and what cannot be opened."""
    place = Path(path)
    where: tuple[str, str] | None = None
    if place.is_dir():
        where = (_BAG, "read_bag") if (place / "metadata.yaml").is_file() else None
    elif place.is_file():  # the first bytes of a pipe could not be read again
        try:
            with place.open("rb") as file:
                first = file.read(max(map(len, _FORMATS)))
        except OSError:
            return None
        where = next((of for magic, of in _FORMATS.items() if first.startswith(magic)), None)
    if where is None:
        return None
    reader: Callable[[Path], Log] = getattr(import_module(where[0]), where[1])
    return reader


def read_log(source: str | PathLike[str] | pd.DataFrame) -> Log:
    """Read the channels of a log, with their units, rates and clocks.

    Parameters
    ----------
    source : str, path-like or DataFrame
        PX4 ULog (.ulg), ArduPilot DataFlash (.BIN), a bag of ROS 1 or ROS 2, MCAP, Parquet, HDF5, TDMS, or a data
        frame.

    Returns
    -------
    Log
        Channels by their names. Values are in SI where the log states the unit.

    Raises
    ------
    InputError
        The file cannot be read, has another format, or the extra "logs" is not installed.

    Examples
    --------
    >>> import numpy as np
    >>> import pandas as pd
    >>> import magloc
    >>> table = pd.DataFrame({"time_s": np.arange(3) / 50.0, "bx_uT": [20.0, 20.1, 19.9]})
    >>> magloc.read_log(table)["bx_uT"].unit
    'T'
    """
    if not isinstance(source, str | PathLike):
        from magloc.logs.tables import log_of_frame

        return log_of_frame(source)
    if not Path(source).exists():
        raise InputError(f"{source} does not exist, expected a log: {_KINDS}.")
    reader = log_reader(source)
    if reader is None:
        raise InputError(f"{source}: found no format of a log that is known, expected {_KINDS}.")
    log = reader(Path(source))
    for warning in log.warnings:
        _LOG.warning(warning)
    return log
