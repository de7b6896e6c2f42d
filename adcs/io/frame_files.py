"""PNG files of camera frames: grey, 8 bits."""

from __future__ import annotations

import struct
import warnings
import zlib
from io import BytesIO
from os import PathLike
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from adcs.mockup.vision.camera import Camera
from adcs.mockup.vision.centroids import check_frame
from arrays.io.errors import InputError, naming
from arrays.io.text import read_bytes, replace_file
from arrays.typing import ByteArray

_EXPECTED = "a grey PNG image of 8 bits"
_MODES = {
    "1": "an image of black and white alone",
    "I;16": "an image of more than 8 bits",
    "I": "an image of more than 8 bits",
}


def read_frame(path: str | PathLike[str], camera: Camera = Camera()) -> ByteArray:  # noqa: B008 - frozen
    """Read a frame from a PNG file.

    ``camera``: camera of the frame, which states its size. Returns shape (height_px, width_px).
    """
    data = read_bytes(path, _EXPECTED)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(BytesIO(data), formats=["PNG"]) as opened:
                _check_kind(path, opened, camera)
                image = np.array(opened, dtype=np.uint8)
    except UnidentifiedImageError:
        raise InputError(f"{path}: found no PNG image, expected {_EXPECTED}.") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise InputError(f"{path}: found far too many pixels, expected {_size_of(camera)}.") from None
    except InputError:
        raise
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error):
        raise InputError(f"{path}: found a damaged image, expected {_EXPECTED}.") from None
    with naming(str(path)):
        return check_frame(image)


def _check_kind(path: str | PathLike[str], image: Image.Image, camera: Camera) -> None:
    if image.mode != "L":
        found = _MODES.get(image.mode, f"an image with colours or transparency (mode {image.mode})")
        raise InputError(f"{path}: found {found}, expected {_EXPECTED}.")
    if image.size != (camera.width_px, camera.height_px):
        raise InputError(f"{path}: found {image.size[0]} × {image.size[1]} pixels, expected {_size_of(camera)}.")


def _size_of(camera: Camera) -> str:
    return f"{camera.width_px} × {camera.height_px}"


def frame_paths(path: str | PathLike[str]) -> list[Path]:
    """Return a path itself, or all PNG files of a folder in the order of their names."""
    place = Path(path)
    if not place.is_dir():
        if not place.exists():
            raise InputError(f"{path} does not exist, expected a PNG image or a folder of them.")
        return [place]
    found = sorted(file for file in place.iterdir() if file.suffix.lower() == ".png" and file.is_file())
    if not found:
        raise InputError(f"{path}: found no file *.png, expected frames of the camera.")
    return found


def write_frame(frame: ByteArray, path: str | PathLike[str]) -> None:
    """Write a frame (height, width) as a PNG file; replace an existing file at once."""
    replace_file(path, lambda unfinished: Image.fromarray(frame).save(unfinished, format="PNG"))
