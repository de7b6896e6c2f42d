"""Checks of the files of a view before long work."""

from __future__ import annotations

from pathlib import Path

from arrays.io.errors import InputError
from arrays.io.outputs import refuse_unwritable
from magloc.viewer.chromium import find_chromium

FILM_FORMATS = {".mp4": "MP4", ".gif": "GIF", ".apng": "PNG"}


def check_outputs(html: str | Path | None, png: str | Path | None, movie: str | Path | None = None) -> None:
    """Raise InputError for files that cannot be written, and for a missing browser."""
    refuse_unwritable(None if html is None else Path(html), "Input html")
    refuse_unwritable(None if png is None else Path(png), "Input png", ".png")
    if movie is not None:
        _refuse_format(Path(movie))
        refuse_unwritable(Path(movie), "Input movie")
    for name, path in (("png", png), ("movie", movie)):
        if path is not None:
            try:
                find_chromium()
            except InputError as error:
                raise InputError(f"Input {name}: {error}") from None


def _refuse_format(path: Path) -> None:
    suffix = path.suffix.lower()
    if suffix not in FILM_FORMATS:
        raise InputError(f"Input movie {path}: found a name that ends with {suffix!r}, expected .mp4, .gif or .apng.")
