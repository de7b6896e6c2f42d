"""Output folders and files, written completely or not at all, with errors that name the option."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterable, Mapping
from io import FileIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from arrays.io.closing import delay_signals
from arrays.io.errors import InputError
from arrays.io.lazy import by_name

if TYPE_CHECKING:
    from arrays.io.csv import Column

_LOG = logging.getLogger(__name__)


def refuse_file(folder: Path | None, option: str) -> None:
    """Refuse, before long work, a path that cannot become a folder."""
    if folder is None:  # nothing is to be written
        return
    place = folder.absolute()
    while not place.exists() and place != place.parent:
        place = place.parent
    if not place.is_dir():
        raise InputError(f"{option} {folder}: found a file, expected a folder.")
    _refuse_closed(place, folder, option)


def refuse_unwritable(path: Path | None, option: str, suffix: str | None = None) -> None:
    """Refuse, before long work, an output file that cannot be written or has another suffix."""
    if path is None:  # nothing is to be written
        return
    if path.is_dir():
        raise InputError(f"{option} {path}: found a folder, expected a file.")
    if suffix is not None and path.suffix.lower() != suffix:
        raise InputError(f"{option} {path}: found a name that ends with {path.suffix!r}, expected {suffix}.")
    if path.exists() and not path.is_file():
        return  # a pipe or a terminal needs no file beside it
    folder = path.absolute().parent
    if not folder.is_dir():
        raise InputError(f"{option} {path}: found no folder {folder}, expected one.")
    _refuse_closed(Path(os.path.realpath(path)).parent, path, option, prefix=f".{path.name}.")


def refuse_one_for_two(outputs: Mapping[str, Path | None]) -> None:
    """Refuse outputs, by their options, with the same path."""
    seen: dict[str, str] = {}
    for option, path in outputs.items():
        if path is None:
            continue
        same = seen.setdefault(os.path.realpath(path), option)
        if same != option:
            raise InputError(f"{option} {path}: found the file of {same}, expected another one.")


def _refuse_closed(folder: Path, wanted: Path, option: str, prefix: str = ".") -> None:
    """Refuse a folder in which no file can be made; only an attempt shows it."""
    try:
        # The prefix tests the length of the name. An interruption waits, so that no file stays behind.
        with delay_signals(), tempfile.NamedTemporaryFile(dir=folder, prefix=prefix, suffix=".tmp"):
            pass
    except OSError as error:
        raise InputError(
            f"{option} {wanted}: no file can be made in {folder} ({error.strerror}), expected a folder that can be"
            " written to."
        ) from None


def make_folder(folder: Path, option: str) -> None:
    """Make a folder if it does not exist; refuse one in which nothing can be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{option} {folder}: found a file, expected a folder.") from None
    except OSError as error:
        raise InputError(f"{option} {folder} cannot be written ({error.strerror}).") from None
    _refuse_closed(folder, folder, option)


def write_files(folder: Path | None, files: Iterable[tuple[str, Any]], option: str = "--out") -> None:
    """Write files by their names into a folder, if there is one, and log the names."""
    if folder is None:
        return
    make_folder(folder, option)
    names = []
    for name, content in files:
        write_file(content, folder / name)
        names.append(name)
    _LOG.info("wrote %s into %s", " and ".join(filter(None, (", ".join(names[:-1]), names[-1]))), folder)


def write_file(content: Any, path: Path) -> None:
    """Write a file completely or not at all.

    A figure becomes a PNG file, a mapping of columns a CSV file, a dataset a netCDF file, a string a text file.
    Anything else is called with the path.
    """
    from arrays.io.csv import write_columns
    from arrays.io.text import write_netcdf, write_text

    if hasattr(content, "savefig"):
        by_name("magloc.plots.style:save")(content, path)
    elif hasattr(content, "to_netcdf"):
        write_netcdf(content, path)
    elif isinstance(content, str):
        write_text(content, path)
    elif isinstance(content, Mapping):
        write_columns(content, path)
    else:
        content(path)


def installed_version() -> str:
    """Return the version of the package with the command lines."""
    from importlib import metadata

    try:
        return metadata.version("magloc")
    except metadata.PackageNotFoundError:
        return "unknown (not installed)"


class GrowingTable:
    """CSV file that grows by whole rows, so that an interruption leaves complete rows.

    Parameters
    ----------
    path : Path
        File; the first row replaces it.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: FileIO | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._file is not None:
            self._file.close()

    def add(self, columns: Mapping[str, Column]) -> None:
        """Write rows; the first rows set the names."""
        from arrays.io.csv import csv_lines

        header, *rows = csv_lines(columns)
        try:
            if self._file is None:
                self._file = FileIO(self._path, "w")
                rows.insert(0, header)
            if rows:
                self._file.write("\n".join([*rows, ""]).encode())
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from None
