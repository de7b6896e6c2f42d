"""Folders and files that commands write, whole or not at all, with errors that name the option."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from arrays.errors import InputError
from arrays.toml import write_text

Column = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_] | Sequence[str]


def refuse_file(folder: Path, option: str) -> None:
    """Refuse a folder that is a file, before long work; `option` names it."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{option} {folder}: found a file, expected a folder.")


def make_folder(folder: Path, option: str) -> None:
    """Make a folder if it is not there.

    Parameters
    ----------
    folder : Path
    option : str
        That names it, for errors.

    Raises
    ------
    InputError
        There is a file of that name, or it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise InputError(f"{option} {folder}: found a file, expected a folder.") from None
    except OSError as error:
        raise InputError(f"{option} {folder} cannot be written ({error.strerror}).") from None


def replace_file(path: Path, write: Callable[[Path], object]) -> None:
    """Write a file beside its final place first, so that an interruption leaves the old one or the new one.

    Parameters
    ----------
    path : Path
        The final place.
    write : callable
        Writes the file to the path that it is given.

    Raises
    ------
    InputError
        It cannot be written.
    """
    unfinished = path.with_name(f".{path.name}.tmp")
    try:
        write(unfinished)
        os.replace(unfinished, path)
    except (OSError, RuntimeError) as error:  # netCDF's own errors are RuntimeErrors
        raise InputError(f"{path} cannot be written ({getattr(error, 'strerror', None) or error}).") from None
    finally:
        unfinished.unlink(missing_ok=True)


def write_columns(columns: Mapping[str, Column], path: Path) -> None:
    """Write columns of equal length as CSV; numbers in full, those that are not finite as empty cells, texts quoted.

    Parameters
    ----------
    columns : mapping
        From names, with units, to columns.
    path : Path
    """
    cells = [[_cell(value) for value in column] for column in columns.values()]
    lines = [",".join(columns), *(",".join(row) for row in zip(*cells, strict=True))]
    write_text("\n".join([*lines, ""]), path)


def _cell(value: object) -> str:
    if isinstance(value, str):
        return '"' + value.replace('"', '""') + '"'
    if isinstance(value, (bool, np.bool_, int, np.integer)):
        return str(int(value))
    number = float(value)  # type: ignore[arg-type]
    return repr(number) if np.isfinite(number) else ""
