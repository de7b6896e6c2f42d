"""Lights in a frame: threshold, connected blobs, intensity-weighted centroids.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from arrays.typing import ByteArray, FloatArray, IntArray
from magloc.levels import SIGMA_OF_MAD

WordArray = NDArray[np.uint16]
WHITE = 255
THRESHOLD_SIGMAS = 6.0
FEWEST_PIXELS = 4
"""Least number of pixels of a star; fewer are a hot pixel or noise."""
FEWEST_SUMS = 10
"""Least number of pixels of a star in sums of 3 × 3 pixels."""
# Standard deviation of rounding; the median deviation of whole numbers is zero for a quiet image.
_ROUNDING_SIGMA = 12.0**-0.5
_BACKGROUND_STRIDE = 3  # every third row, 100,000 pixels, is enough for medians
_ALL_NEIGHBOURS = np.ones((3, 3), dtype=np.int8)


class NoLightsError(ValueError):
    """Error of a frame that is black, saturated or uniform."""


@dataclass(frozen=True, eq=False)
class Stars:
    """Detected lights of a frame, brightest first.

    Attributes
    ----------
    positions_px : ndarray, shape (n, 2)
        Column and row of each centroid.
    intensity_DN : ndarray, shape (n,)
        Sum of each light's pixels above the background.
    n_pixels : ndarray of int, shape (n,)
        Number of pixels of each light.
    background_DN : float
        Median of the frame.
    threshold_DN : float
        Threshold above the background.
    """

    positions_px: FloatArray
    intensity_DN: FloatArray
    n_pixels: IntArray
    background_DN: float
    threshold_DN: float

    def __len__(self) -> int:
        return len(self.positions_px)


def find_stars(frame: ArrayLike) -> Stars:
    """Detect lights above six standard deviations of the background.

    The background is the frame's median. Its standard deviation is 1.4826 times the median distance from it (MAD).
    Blobs are 8-connected pixels above the threshold; blobs of fewer than 4 pixels or at the border are ignored.

    Parameters
    ----------
    frame : array_like of uint8, shape (height, width)
        Grey image.

    Returns
    -------
    Stars
        Centroids and intensities, brightest first.

    Raises
    ------
    NoLightsError
        The frame is black, saturated or uniform.
    ValueError
        The frame is no grey image of bytes.

    Examples
    --------
    >>> import numpy as np
    >>> import sims
    >>> from adcs import mockup
    >>> sky, camera, pose = mockup.led_sky(), mockup.Camera(), mockup.Pose(0.1, 0.2, 0.3)
    >>> frame = sims.rendered_frame(sky, camera, pose, np.random.default_rng(0))
    >>> stars = mockup.find_stars(frame.image)
    >>> stars.positions_px.shape == (len(stars), 2)
    True
    """
    image = check_frame(frame)
    background, sigma = _background(image)
    return _stars_above(image, background, THRESHOLD_SIGMAS * sigma)


def find_faint_stars(frame: ArrayLike) -> Stars:
    """Detect lights above six standard deviations of the background in sums of 3 × 3 pixels.

    As :func:`find_stars`, but for sums of each pixel and its eight neighbours. A light that is smeared over 24 pixels
    is as weak as noise and breaks into pieces; in the sums it does not. At rest centroids are better too, because less
    of the light is below the threshold. A hot pixel has nine sums, so a star needs more.
    Shape ``frame`` (height, width). Intensities, background and threshold refer to the sums.
    """
    image = check_frame(frame).astype(np.uint16)
    if min(image.shape) < 3:
        raise ValueError(f"Input frame must have 3 pixels each way at least; instead received shape {image.shape}.")
    rows = image[:-2] + image[1:-1] + image[2:]
    sums = rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
    background, sigma = _background(sums)
    stars = _stars_above(sums, background, THRESHOLD_SIGMAS * sigma, FEWEST_SUMS)
    return replace(stars, positions_px=stars.positions_px + 1.0)


def find_stars_between_extremes(frame: ArrayLike, level: float = 0.3) -> Stars:
    """Detect lights above a level between the darkest and the brightest pixel, as in the source paper.

    Shape ``frame`` (height, width). ``level``: 0 is the darkest pixel of the frame and 1 the brightest one.
    """
    if not 0.0 < level < 1.0:
        raise ValueError(f"Input level must be between 0 and 1; instead received {level}.")
    image = check_frame(frame)
    darkest, brightest = int(image.min()), int(image.max())
    return _stars_above(image, darkest, level * (brightest - darkest))


def check_frame(frame: ArrayLike) -> ByteArray:
    """Check a grey image for the detection of lights: ``frame`` (height, width) -> (height, width)."""
    image = np.asarray(frame)
    if image.ndim != 2 or image.size == 0:
        raise ValueError(f"Input frame must be a grey image (height, width); instead received shape {image.shape}.")
    if image.dtype != np.uint8:
        raise ValueError(f"Input frame must have whole numbers from 0 to 255 (uint8); instead received {image.dtype}.")
    brightest = int(image.max())
    if brightest == 0:
        raise NoLightsError("Input frame must show lights; instead received a black image.")
    if brightest == WHITE and 2 * np.count_nonzero(image == WHITE) > image.size:
        raise NoLightsError("Input frame must show lights; instead received a saturated image.")
    if brightest == int(image.min()):
        raise NoLightsError(f"Input frame must show lights; instead received {brightest} in all pixels.")
    return image


def _background(image: ByteArray | WordArray) -> tuple[int, float]:
    """Return the median of whole numbers, and their standard deviation from the median distance."""
    counts = np.bincount(image[::_BACKGROUND_STRIDE].reshape(-1))
    background = _median(counts)
    distances = np.bincount(np.abs(np.arange(counts.size) - background), weights=counts)
    return background, max(SIGMA_OF_MAD * _median(distances), _ROUNDING_SIGMA)


def _median(counts: NDArray[np.intp] | FloatArray) -> int:
    """Return the lower median of whole numbers from the count of each."""
    cumulative = np.cumsum(counts)
    return int(np.searchsorted(cumulative, 0.5 * cumulative[-1]))


def _stars_above(
    image: ByteArray | WordArray, background: int, threshold: float, fewest_pixels: int = FEWEST_PIXELS
) -> Stars:
    # A comparison of bytes is several times as fast as one of floats.
    above = image > min(background + int(threshold), np.iinfo(image.dtype).max)
    labels, n_blobs = ndimage.label(above, structure=_ALL_NEIGHBOURS)
    places = np.flatnonzero(above)
    blob = labels.reshape(-1)[places] - 1
    row, column = np.divmod(places, image.shape[1])
    weight = image.reshape(-1)[places].astype(np.float64) - background
    n_pixels = np.bincount(blob, minlength=n_blobs).astype(np.intp)
    intensity = np.asarray(np.bincount(blob, weights=weight, minlength=n_blobs), dtype=np.float64)
    at_border = (row == 0) | (row == image.shape[0] - 1) | (column == 0) | (column == image.shape[1] - 1)
    kept = (n_pixels >= fewest_pixels) & (np.bincount(blob, weights=at_border, minlength=n_blobs) == 0)
    sums = np.stack([np.bincount(blob, weights=weight * axis, minlength=n_blobs) for axis in (column, row)], axis=1)
    order = np.flatnonzero(kept)[np.argsort(-intensity[kept], kind="stable")]
    centroids: FloatArray = sums[order] / intensity[order, None]
    return Stars(centroids, intensity[order], n_pixels[order], float(background), float(threshold))
