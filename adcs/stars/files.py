"""Files of star images and star catalogues.

A folder of frames has

- ``calibration.txt``: lines ``IMG_X=1392``, ``IMG_Y=1040`` (size in pixels) and ``PIXSCALE=15.78`` (arc seconds per
  pixel); other lines are ignored;
- ``input.csv``: one line for each frame with three numbers for each star: x to the right and y **up** (pixels, as seen
  on the sky), and magnitude;
- ``result.csv``, optional: the number of each star of each frame in the catalogue, or -1 for no star.

A catalogue is a CSV file with the columns ``hip`` (different whole numbers from 0), ``ra_deg``, ``dec_deg`` and
``mag``; other columns are ignored. Its positions should be those at the frames' date, because some stars move by a
second of arc per year.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from adcs.stars.camera import MOST_PIXELS, SCALE_ARCSEC, WIDEST_RAD, StarCamera
from adcs.stars.catalogue import StarCatalogue
from arrays.io.csv import read_table
from arrays.io.errors import LARGEST, InputError
from arrays.io.text import read_text
from arrays.typing import FloatArray, IntArray

NO_STAR = -1
COLUMNS = ("hip", "ra_deg", "dec_deg", "mag")
_LARGEST_NUMBER = 10**15
"""Largest number of a star; floating-point numbers of a file represent whole numbers up to it exactly."""


@dataclass(frozen=True, eq=False)
class StarFrame:
    """Stars of one image.

    Attributes
    ----------
    points_px : ndarray, shape (f, 2)
        Points, x to the right, y up.
    magnitudes : ndarray, shape (f,)
        Magnitudes.
    numbers : ndarray, shape (f,), optional
        Numbers in the catalogue; -1 for no star.
    """

    points_px: FloatArray
    magnitudes: FloatArray
    numbers: IntArray | None


def read_star_catalogue(path: str | PathLike[str]) -> StarCatalogue:
    """Read a catalogue from a CSV file; see :mod:`adcs.stars.files`.

    Parameters
    ----------
    path : str or path-like
        CSV file.

    Returns
    -------
    StarCatalogue
        Stars of the file.

    Raises
    ------
    InputError
        The file cannot be read, a column is missing, or a number is missing or out of range.
    """
    table = read_table(path, f"a header with the columns {', '.join(COLUMNS)}")
    for column in COLUMNS:
        table.require(column, COLUMNS)
    hip = table.complete_and_distinct("hip")
    values = table.complete(COLUMNS)
    table.refuse((hip != np.round(hip))[:, None], COLUMNS, "found a fraction, expected a whole number")
    outside = (hip < 0.0) | (hip > _LARGEST_NUMBER)
    if outside.any():
        found = f"found {hip[np.argmax(outside)]:.15g}, expected a number from 0 to {_LARGEST_NUMBER}"
        table.refuse(outside[:, None], COLUMNS, f"{found} ({NO_STAR} means no star)")
    table.refuse(np.abs(values[:, 2:3]) > 90.0, COLUMNS[2:], "found a declination beyond 90°, expected -90 to 90")
    table.refuse(np.abs(values[:, 1:2]) > 360.0, COLUMNS[1:], "found more than a turn, expected 0 to 360")
    try:
        return StarCatalogue.of(hip, np.radians(values[:, 1]), np.radians(values[:, 2]), values[:, 3])
    except ValueError:
        raise InputError(f"{path}: found {len(values)} stars, expected 4 at least.") from None


def read_star_frames(folder: str | PathLike[str]) -> tuple[StarCamera, list[StarFrame]]:
    """Read the frames of a folder; see :mod:`adcs.stars.files`.

    Parameters
    ----------
    folder : str or path-like
        Folder with ``calibration.txt`` and ``input.csv``.

    Returns
    -------
    camera : StarCamera
        Camera of all frames.
    frames : list of StarFrame
        Frames in the order of the file.

    Raises
    ------
    InputError
        A file cannot be read, a cell is not a number, or the count of numbers in a line is wrong.
    """
    camera = _read_camera(Path(folder) / "calibration.txt")
    frames_path, labels_path = Path(folder) / "input.csv", Path(folder) / "result.csv"
    rows = _read_lines(frames_path, "stars of frames")
    for line, row in rows:
        if len(row) % 3:
            raise InputError(f"{frames_path}, line {line}: found {len(row)} numbers, expected three for each star.")
    stars = [row.reshape(-1, 3) for _, row in rows]
    numbers = _read_labels(labels_path, frames_path, stars) if labels_path.exists() else [None] * len(stars)
    return camera, [StarFrame(star[:, :2], star[:, 2], number) for star, number in zip(stars, numbers, strict=True)]


def _read_labels(path: Path, frames_path: Path, stars: list[FloatArray]) -> list[IntArray | None]:
    """Read the number of each star of each frame."""
    rows = _read_lines(path, "numbers of stars")
    if len(rows) != len(stars):
        raise InputError(f"{path}: found {len(rows)} frames, expected {len(stars)} as in {frames_path}.")
    for (line, row), star in zip(rows, stars, strict=True):
        if len(row) != len(star):
            raise InputError(
                f"{path}, line {line}: found {len(row)} numbers, expected {len(star)}, one for each star of the frame."
            )
        if (row != np.round(row)).any():
            raise InputError(f"{path}, line {line}: found a fraction, expected whole numbers.")
        outside = row[(row < NO_STAR) | (row > _LARGEST_NUMBER)]
        if outside.size:
            raise InputError(
                f"{path}, line {line}: found {outside[0]:.15g}, "
                f"expected numbers of stars, from 0 to {_LARGEST_NUMBER}, or {NO_STAR} for none."
            )
    return [row.astype(np.intp) for _, row in rows]


def _read_camera(path: Path) -> StarCamera:
    """Read a camera from lines NAME=NUMBER."""
    known: dict[str, tuple[int, str]] = {}
    for line, text in enumerate(read_text(path, "a text file with IMG_X, IMG_Y and PIXSCALE").splitlines(), start=1):
        name, equals, given = text.partition("=")
        if equals:
            known[name.strip()] = (line, given.strip())
    numbers = {}
    for name in ("IMG_X", "IMG_Y", "PIXSCALE"):
        if name not in known:
            raise InputError(f"{path}: found no line {name}=…, expected one.")
        line, text = known[name]
        value = _number(text)
        of_pixels = name != "PIXSCALE"
        if not 0.0 < value < math.inf or (of_pixels and value != round(value)):
            kind = "whole number" if of_pixels else "number"
            raise InputError(f"{path}, line {line}: found {name}={text}, expected a positive {kind}.")
        low, high = (1, MOST_PIXELS) if of_pixels else SCALE_ARCSEC
        if not low <= value <= high:
            unit = "pixels" if of_pixels else "arc seconds per pixel"
            raise InputError(f"{path}, line {line}: found {name}={text}, expected {low:g} to {high:g} {unit}.")
        numbers[name] = value
    try:
        return StarCamera(int(numbers["IMG_X"]), int(numbers["IMG_Y"]), math.radians(numbers["PIXSCALE"] / 3600.0))
    except ValueError:
        size = math.hypot(numbers["IMG_X"], numbers["IMG_Y"])
        raise InputError(
            f"{path}, line {known['PIXSCALE'][0]}: found PIXSCALE={known['PIXSCALE'][1]} for {size:.0f} pixels from "
            f"corner to corner, expected an image that shows {math.degrees(WIDEST_RAD):.0f}° at most."
        ) from None


def _read_lines(path: Path, what: str) -> list[tuple[int, FloatArray]]:
    """Return line number and values of each line that is not blank; a line may end with a comma."""
    rows = []
    for line, text in enumerate(read_text(path, f"a CSV file with {what}").splitlines(), start=1):
        cells = text.strip().rstrip(",")
        if cells:
            row = np.array([_number(cell) for cell in cells.split(",")])
            usable = np.abs(row) <= LARGEST
            if not usable.all():
                bad = cells.split(",")[int(np.argmin(usable))].strip()
                raise InputError(f"{path}, line {line}: found {bad[:40]!r}, expected a finite number.")
            rows.append((line, row))
    if not rows:
        raise InputError(f"{path}: found no frame, expected one at least.")
    return rows


def _number(text: str) -> float:
    """Return the number in a text, NaN if it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan
