"""Text files, read strictly and written in one step."""

from __future__ import annotations

import codecs
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from arrays.io.closing import delay_signals
from arrays.io.errors import InputError, of_extra

if TYPE_CHECKING:
    import xarray as xr


MOST_BYTES, MOST_PIPED_BYTES = 4 * 10**9, 10**9
"""Largest number of bytes of a file, and of a pipe or device, which may not end."""
LONGEST_LINE = 2**26
"""Largest number of bytes of a line in a pipe or device."""
_CHUNK = 2**24
UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
"""First bytes of a text in UTF-16."""


def read_bytes(path: str | PathLike[str], expected: str, *, text: bool = False) -> bytes:
    """Return the content of a file; `expected` describes it in errors.

    ``text``: stop behind a NUL byte, which no text has.
    """
    try:
        with Path(path).open("rb", buffering=0) as file:
            status = os.fstat(file.fileno())
            is_file = stat.S_ISREG(status.st_mode)
            if is_file and status.st_size > MOST_BYTES:
                raise InputError(f"{path}: found more than {MOST_BYTES / 1e9:g} GB, expected {expected}.")
            chunks, size, line = [], 0, 0
            while chunk := file.read(_CHUNK):
                chunks.append(chunk)
                size, end = size + len(chunk), chunk.rfind(b"\n")
                line = line + len(chunk) if end < 0 else len(chunk) - end
                if text and b"\0" in chunk and not chunks[0].startswith(UTF_16):
                    break
                if not is_file and (size > MOST_PIPED_BYTES or line > LONGEST_LINE):
                    end_of = "a line" if line > LONGEST_LINE else "the data"
                    raise InputError(
                        f"{path}: found no end of {end_of} in {size / 1e6:.0f} MB of a pipe or device,"
                        f" expected {expected}."
                    )
            return b"".join(chunks)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist, expected {expected}.") from None
    except IsADirectoryError:
        raise InputError(f"{path} is a directory, expected {expected}.") from None
    except InputError:
        raise
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(f"{path} cannot be read ({reason}), expected {expected}.") from None


def read_text(path: str | PathLike[str], expected: str, encoding: str | None = None) -> str:
    """Return the text of a file, as :func:`read_bytes` does.

    Without an `encoding` it is UTF-8, with or without a byte order mark, or UTF-16 with one.
    """
    data = read_bytes(path, expected, text=not (encoding or "").lower().startswith(("utf-16", "utf_16", "utf16")))
    used = "utf-16" if data.startswith(UTF_16) else encoding or "utf-8-sig"
    try:
        return data.decode(used).removeprefix("\ufeff")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        called = "UTF-8" if used == "utf-8-sig" else used
        raise InputError(
            f"{path}, line {line}: found the byte 0x{data[error.start]:02x}, which is not {called}, expected {called}"
            " text."
        ) from None


@contextmanager
def replaced(path: str | PathLike[str]) -> Iterator[Path]:
    """Yield the path of a temporary file, which replaces the target in one step at the end.

    Pipes and terminals are written in place. An OSError names the path.
    """
    target = Path(path)
    in_place = target.exists() and not target.is_file()
    if not in_place:
        target = Path(os.path.realpath(path))
    written = target if in_place else target.with_name(f".{target.name}.{os.urandom(4).hex()}.tmp")
    try:
        try:
            yield written
            if not in_place:
                os.replace(written, target)
        finally:
            if not in_place:
                written.unlink(missing_ok=True)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from None


def write_text(text: str, path: str | PathLike[str]) -> None:
    """Write a UTF-8 file, completely or not at all."""
    with replaced(path) as written:
        written.write_text(text, encoding="utf-8", newline="\n")


def replace_file(path: str | PathLike[str], write: Callable[[Path], object]) -> None:
    """Write a file by a function, completely or not at all."""
    try:
        with replaced(path) as written:
            write(written)
    except (OSError, RuntimeError) as error:  # netCDF's own errors are RuntimeErrors
        raise InputError(f"{path} cannot be written ({getattr(error, 'strerror', None) or error}).") from None


def check_netcdf() -> None:
    """Refuse, before long work, netCDF files without the package that writes them."""
    with of_extra("maps", "a netCDF file"):
        import netCDF4  # noqa: F401


def write_netcdf(dataset: xr.Dataset, path: Path) -> None:
    """Write a netCDF file, completely or not at all; a signal acts after it.

    A signal that is raised while xarray takes its lock of HDF5 would leave it locked, and closing the file would hang.
    """
    check_netcdf()
    with delay_signals():
        replace_file(path, lambda unfinished: dataset.to_netcdf(unfinished))
