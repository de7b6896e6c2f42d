"""Reading of a log of any known format."""

from __future__ import annotations

import logging
from collections.abc import Callable
from importlib import import_module
from os import PathLike
from pathlib import Path

from arrays.io.errors import InputError
from magloc.logs.channels import Log

_LOG = logging.getLogger(__name__)
_FIRST_BYTES = 520
_HDF5 = b"\x89HDF\r\n\x1a\n"
_FORMATS = ((b"ULog\x01\x12\x35", "magloc.logs.px4:read_ulog"),)
_KINDS = "PX4 ULog"


def log_reader(path: str | PathLike[str]) -> Callable[[Path], Log] | None:
    """Return the reader of a binary log by its first bytes; None for text and what cannot be opened."""
    place = Path(path)
    try:
        with place.open("rb") as file:
            first = file.read(_FIRST_BYTES)
    except OSError:
        return None
    for magic, where in _FORMATS:
        if first.startswith(magic):
            module, _, name = where.partition(":")
            read: Callable[[Path], Log] = getattr(import_module(module), name)
            return read
    return None


def read_log(path: str | PathLike[str]) -> Log:
    """Read the channels of a log, with their units, rates and clocks.

    Parameters
    ----------
    path : str or path-like
        PX4 ULog (.ulg).

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
    >>> import magloc
    >>> log = magloc.read_log("flight.ulg")  # doctest: +SKIP
    >>> log["vehicle_magnetometer.magnetometer_ga[0]"].unit  # doctest: +SKIP
    'T'
    """
    place = Path(path)
    if not place.exists():
        raise InputError(f"{path} does not exist, expected a log: {_KINDS}.")
    reader = log_reader(place)
    if reader is None:
        raise InputError(f"{path}: found no format of a log that is known, expected {_KINDS}.")
    log = reader(place)
    for warning in log.warnings:
        _LOG.warning(warning)
    return log
