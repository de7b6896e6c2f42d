"""Stars in photographs of the sky: reading of pictures, and detection of lights above the background.

The sky glows unevenly, and a lens is darker at its corners. So background and noise are of a neighbourhood, not
of the whole picture.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from itertools import pairwise
from os import PathLike
from pathlib import Path

import numpy as np
from scipy import ndimage

from arrays.io.errors import InputError
from arrays.io.text import read_bytes
from arrays.typing import BoolArray, FloatArray
from magloc.levels import SIGMA_OF_MAD

SUFFIXES = (".png", ".tif", ".tiff", ".fits", ".fit", ".jpg", ".jpeg")
_BLOCK_PX = 32
LEAST_PX = 2 * _BLOCK_PX
"""Least width and height of a picture."""
_STAR_PX = 1.0  # standard deviation of a star's light in the detection
_THRESHOLD_SIGMAS = 5.0
_HOT_SHARE = 0.85  # share of a light in one pixel above which it is a hot pixel
_HALF_WINDOW = 3
_WEIGHT_PX, _ROUNDS = 1.2, 6  # width of the weight of centroids, and number of iterations
_MOST_PIXELS = 10**8
_LEAST_FINITE = 0.5  # share of the pixels of a picture or a block
_FITS_BLOCK, _FITS_CARD = 2880, 80
_FITS_TYPES = {8: ">u1", 16: ">i2", 32: ">i4", -32: ">f4", -64: ">f8"}


@dataclass(frozen=True, eq=False)
class PictureStars:
    """Lights of a picture, brightest first."""

    points_px: FloatArray  # (n, 2): centroids, x to the right, y up; the centre of the lower left pixel is (0.5, 0.5)
    sigma_px: FloatArray  # (n,): standard deviations per axis, from the noise alone
    flux: FloatArray  # (n,): sums above the background
    saturated: BoolArray  # (n,)

    @property
    def magnitudes(self) -> FloatArray:
        """Magnitudes (n,) with an arbitrary zero point."""
        return -2.5 * np.log10(self.flux)

    def __len__(self) -> int:
        return len(self.flux)


def read_picture(path: str | PathLike[str]) -> FloatArray:
    """Read a grey picture (height, width) from PNG, TIFF or JPEG of 8 or 16 bits, or FITS.

    The first row is at the top.

    Parameters
    ----------
    path : str or path-like
        Picture; its colours are averaged.

    Returns
    -------
    ndarray, shape (height, width)
        Grey values as in the file, any unit; the first row is at the top. Masked pixels of a FITS file are NaN.

    Raises
    ------
    InputError
        The file cannot be read or is no such picture.

    Examples
    --------
    >>> import adcs
    >>> adcs.read_picture("night.png").shape  # doctest: +SKIP
    (1040, 1392)
    """
    data = read_bytes(path, f"a picture ({', '.join(SUFFIXES)})")
    if Path(path).suffix.lower() in (".fits", ".fit"):
        return _fits(path, data)
    from PIL import Image

    try:
        with warnings.catch_warnings(action="ignore"), Image.open(BytesIO(data)) as opened:
            if opened.width * opened.height > _MOST_PIXELS:
                raise InputError(f"{path}: found {opened.width} × {opened.height} pixels, expected 10⁸ at most.")
            values = np.asarray(opened)
    except InputError:
        raise
    except Image.DecompressionBombError:
        raise InputError(f"{path}: found too many pixels, expected 10⁸ at most.") from None
    except Exception:  # decoders raise many kinds of errors for other files
        raise InputError(
            f"{path}: found no picture that can be read, expected a whole PNG, TIFF or JPEG file of 8 or 16 bits."
        ) from None
    if values.ndim == 3:
        values = values[..., : 3 if values.shape[2] > 2 else 1].mean(axis=2)
    return _check_picture(path, values)


def _fits(path: str | PathLike[str], data: bytes) -> FloatArray:
    """Return the first image of a FITS file, whose first row is at the bottom."""
    header: dict[str, str] = {}
    start = 0
    for start in range(0, len(data), _FITS_CARD):
        card = data[start : start + _FITS_CARD].decode("ascii", "replace")
        if card.startswith("END") and not card[3:].strip():
            break
        header[card[:8].strip()] = card[10:].partition("/")[0].strip()
    start = -(-(start + _FITS_CARD) // _FITS_BLOCK) * _FITS_BLOCK
    try:
        kind = np.dtype(_FITS_TYPES[int(header["BITPIX"])])
        width, height = int(header["NAXIS1"]), int(header["NAXIS2"])
        values = np.frombuffer(data, kind, width * height, start).reshape(height, width)
        with np.errstate(invalid="ignore", over="ignore"):
            scaled = float(header.get("BSCALE", 1.0)) * values + float(header.get("BZERO", 0.0))
        if kind.kind != "f" and "BLANK" in header:
            scaled[values == int(header["BLANK"])] = np.nan
    except (KeyError, OverflowError, ValueError):
        raise InputError(
            f"{path}: found no image in two dimensions, expected one as the first of a FITS file."
        ) from None
    return _check_picture(path, scaled[::-1])


def _check_picture(path: str | PathLike[str], values: np.ndarray) -> FloatArray:
    picture = np.asarray(values, dtype=np.float64)
    if picture.ndim != 2 or min(picture.shape) < LEAST_PX:
        raise InputError(f"{path}: found a picture of shape {picture.shape}, expected 64 × 64 pixels at least.")
    finite = np.isfinite(picture)
    if finite.mean() < _LEAST_FINITE:
        raise InputError(f"{path}: found {100 * finite.mean():.0f} % finite pixels, expected half of them at least.")
    return np.where(finite, picture, np.nan)


def find_picture_stars(picture: FloatArray, dark: FloatArray | None = None) -> PictureStars:
    """Detect lights whose sum over a star's size is five standard deviations above the background.

    Background and noise are the median of blocks of 32 pixels and the standard deviation about it, interpolated between
    blocks. A light nearly all in one pixel is a hot pixel. Centroids are first moments, weighted by a Gaussian about
    the centroid, in a window of 7 pixels.

    ``picture``, ``dark`` (height, width): the dark picture is subtracted. Pixels that are NaN are masked. A light
    with a masked pixel among its middle 25 is rejected. The brightest light comes first.
    """
    values = picture if dark is None else picture - dark
    masked = ~np.isfinite(values)
    level = _neighbourhood_statistic(values, lambda block: float(np.median(block)))
    noise = _neighbourhood_statistic(values - level, _deviation(1.0))
    above = np.where(masked, 0.0, values - level)
    # The noise of the sum with the star's shape is measured, because noise of neighbouring pixels may be correlated.
    kernel = np.exp(-0.5 * (np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1) / _STAR_PX) ** 2)
    kernel /= kernel.sum()
    smooth = ndimage.correlate1d(ndimage.correlate1d(above, kernel, axis=0), kernel, axis=1)
    deviation = _deviation(float(np.sum(kernel**2)))
    significance = smooth / _neighbourhood_statistic(np.where(masked, np.nan, smooth), deviation)
    peak = (significance > _THRESHOLD_SIGMAS) & (significance == ndimage.maximum_filter(significance, 5))
    inside = np.zeros_like(peak)
    inside[_HALF_WINDOW:-_HALF_WINDOW, _HALF_WINDOW:-_HALF_WINDOW] = True
    rows, columns = np.nonzero(peak & inside & ~ndimage.maximum_filter(masked, 5))
    around = np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1)
    windows = above[rows[:, None, None] + around[:, None], columns[:, None, None] + around]
    light = np.maximum(windows, 0.0) * (windows > 2.0 * noise[rows, columns][:, None, None])
    alone = windows.max(axis=(1, 2)) / np.maximum(light.sum(axis=(1, 2)), 1e-300)
    kept = (alone < _HOT_SHARE) & (np.count_nonzero(light, axis=(1, 2)) >= 3)
    windows, rows, columns = windows[kept], rows[kept], columns[kept]
    flux = smooth[rows, columns] / np.sum(kernel**2) ** 2
    offsets, slope = _centroids(windows)
    sigma = noise[rows, columns] * slope
    x, y = columns + offsets[:, 0] + 0.5, len(values) - (rows + offsets[:, 1] + 0.5)
    saturated = windows.max(axis=(1, 2)) + level[rows, columns] >= 0.98 * np.nanmax(picture)
    order = np.argsort(-flux, kind="stable")
    return PictureStars(np.stack([x, y], axis=1)[order], sigma[order], flux[order], saturated[order])


def _centroids(windows: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return centroids (n, 2) from the middle of windows, and their σ (n,) per noise of a pixel.

    The weight is a Gaussian about the centroid, so that no place within a pixel is favoured. It is as wide as a light,
    so its first moment is half of the distance.
    """
    around = np.arange(-_HALF_WINDOW, _HALF_WINDOW + 1)
    offsets = np.zeros((len(windows), 2))
    slope = np.zeros(len(windows))
    for _ in range(_ROUNDS):
        dx, dy = around - offsets[:, :1], around - offsets[:, 1:]
        weights = np.exp(-0.5 * (dy[:, :, None] ** 2 + dx[:, None, :] ** 2) / _WEIGHT_PX**2)
        total = np.maximum(np.sum(weights * windows, axis=(1, 2)), 1e-300)
        moments = [np.sum(weights * windows * d, axis=(1, 2)) / total for d in (dx[:, None, :], dy[:, :, None])]
        offsets = np.clip(offsets + 2.0 * np.stack(moments, axis=1), -1.5, 1.5)
        slope = 2.0 * np.sqrt(np.sum((weights * dx[:, None, :]) ** 2, axis=(1, 2))) / total
    return offsets, slope


def _neighbourhood_statistic(values: FloatArray, statistic: Callable[[FloatArray], float]) -> FloatArray:
    """Return a statistic of the finite pixels in the blocks around each pixel, interpolated.

    A block with few finite pixels has the statistic of the nearest other block.
    """

    def of(block: FloatArray) -> float:
        finite = block[np.isfinite(block)]
        return statistic(finite) if finite.size >= _LEAST_FINITE * block.size else math.nan

    edges = [np.linspace(0, n, n // _BLOCK_PX + 1).astype(int) for n in values.shape]
    found = np.array(
        [
            [of(values[top:bottom, left:right]) for left, right in pairwise(edges[1].tolist())]
            for top, bottom in pairwise(edges[0].tolist())
        ]
    )
    nearest = ndimage.distance_transform_edt(np.isnan(found), return_distances=False, return_indices=True)
    found = found[tuple(nearest)]
    places = [(np.arange(n) - 0.5 * (e[0] + e[1])) / (e[1] - e[0]) for n, e in zip(values.shape, edges, strict=True)]
    at = np.meshgrid(*places, indexing="ij")
    smooth: FloatArray = ndimage.map_coordinates(ndimage.median_filter(found, 3), at, order=1, mode="nearest")
    return smooth


def _deviation(least: float) -> Callable[[FloatArray], float]:
    """Return a clipped standard deviation, within five σ, not below a least value.

    In a picture of 8 bits the median distance alone would be a whole number.
    """

    def deviation(block: FloatArray) -> float:
        distance = np.abs(block - np.median(block))
        usual = max(SIGMA_OF_MAD * float(np.median(distance)), least)
        return max(math.sqrt(float(np.mean(distance[distance <= 5.0 * usual] ** 2))), least)

    return deviation
