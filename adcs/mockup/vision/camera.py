"""Camera below the sky of lights: projection between ceiling and image.

See docs/theory/tabletop-vision.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.navigation.strapdown import rotate
from arrays.io.errors import check_not_negative, check_positive
from arrays.typing import BoolArray, FloatArray

REFERENCE_RADIUS_PX = 320.0
"""Radius at which the distortion, relative to the distance from the optical centre, is k1."""
_LARGEST_K1 = 1e6
FLIP = np.array([1.0, -1.0])  # rows of an image count downwards, centred pixels upwards
_NO_LENS = 1e-17  # a smaller distortion is below rounding, and the closed form of the inverse would overflow


@dataclass(frozen=True)
class Pose:
    """Position and heading of one satellite, or of many as arrays of one shape.

    Attributes
    ----------
    x_m, y_m : float or ndarray
        Position at which the optical axis meets the ceiling, table axes.
    heading_rad : float or ndarray
        Angle from the table's X to the body's x, counter-clockwise seen from above.

    Examples
    --------
    >>> from adcs import mockup
    >>> mockup.Pose(0.1, 0.2, heading_rad=0.3).position_m
    array([0.1, 0.2])
    """

    x_m: float | FloatArray
    y_m: float | FloatArray
    heading_rad: float | FloatArray

    @property
    def position_m(self) -> FloatArray:
        """Position X, Y, shape (..., 2)."""
        return np.stack(np.broadcast_arrays(np.float64(self.x_m), np.float64(self.y_m)), axis=-1)


@dataclass(frozen=True)
class Camera:
    """Camera with a vertical optical axis.

    Attributes
    ----------
    width_px, height_px : int
        Size of the image.
    m_per_px : float
        Size of a pixel on the ceiling, at the optical centre.
    centre_px : tuple, shape (2,), optional
        Column and row of the optical centre; by default the middle of the image.
    k1 : float
        Relative radial distortion at 320 px.
    exposure_s : float
        Time over which a moving light is smeared; the pose refers to its middle.

    Raises
    ------
    ValueError
        A size is not positive, a number is not finite, or the lens maps two points of the ceiling to one pixel.

    Examples
    --------
    >>> from adcs import mockup
    >>> mockup.Camera(m_per_px=0.001).footprint_m
    (0.64, 0.48)
    """

    width_px: int = 640
    height_px: int = 480
    m_per_px: float = 0.9 / 640
    centre_px: tuple[float, float] | None = None
    k1: float = 0.0
    exposure_s: float = 1.0 / 30.0

    def __post_init__(self) -> None:
        for name in ("width_px", "height_px"):
            value = getattr(self, name)
            if not (0 < value < math.inf and value == int(value)):
                raise ValueError(f"Input {name} must be a positive whole number; instead received {value}.")
        check_positive(m_per_px=self.m_per_px)
        check_not_negative(exposure_s=self.exposure_s)
        middle = 0.5 * (self.width_px - 1), 0.5 * (self.height_px - 1)
        centre: Sequence[float] = middle if self.centre_px is None else self.centre_px
        if len(centre) != 2 or not all(map(math.isfinite, centre)):
            raise ValueError(f"Input centre_px must be two finite numbers; instead received {self.centre_px}.")
        object.__setattr__(self, "centre_px", (float(centre[0]), float(centre[1])))
        corners = np.array([[x, y] for x in (0, self.width_px - 1) for y in (0, self.height_px - 1)])
        if not abs(self.k1) < _LARGEST_K1 or np.isnan(undistorted(self, corners)).any():
            raise ValueError(f"Input k1 must leave each pixel its own place; instead received {self.k1}.")

    @property
    def centre(self) -> FloatArray:
        """Optical centre, shape (2,)."""
        return np.array(self.centre_px)

    @property
    def footprint_m(self) -> tuple[float, float]:
        """Width and height of the visible part of the ceiling, without distortion."""
        return self.width_px * self.m_per_px, self.height_px * self.m_per_px


def camera_of_footprint(width_m: float, k1: float = 0.0) -> Camera:
    """Return a camera of 640 × 480 px that sees a given width of the ceiling.

    Parameters
    ----------
    width_m : float
        Width of the visible part of the ceiling.
    k1 : float
        Relative radial distortion at 320 px.

    Returns
    -------
    Camera
        Camera with the optical centre in the middle of the image.

    Examples
    --------
    >>> from adcs import mockup
    >>> mockup.camera_of_footprint(0.64).m_per_px
    0.001
    """
    return Camera(m_per_px=width_m / 640, k1=k1)


def centred_from_table(camera: Camera, pose: Pose, points_m: ArrayLike) -> FloatArray:
    """Project points of the ceiling to centred pixels, with an ideal lens.

    ``pose``: numbers, or arrays of shape (...). ``points_m`` (..., n, 2): in the table's frame [m]. Returns
    (..., n, 2): centred pixels, y up.
    """
    offset = np.asarray(points_m, dtype=np.float64) - pose.position_m[..., None, :]
    # The image is a mirror image of the ceiling, so that the same rotation goes both ways.
    return rotate(np.asarray(pose.heading_rad)[..., None], offset * FLIP) / camera.m_per_px


def table_from_centred(camera: Camera, pose: Pose, points_px: ArrayLike) -> FloatArray:
    """Project centred pixels to the ceiling; inverse of :func:`centred_from_table`.

    Shape ``points_px`` (..., n, 2). ``pose``: numbers, or arrays of shape (...). Returns (..., n, 2): in the table's
    frame [m].
    """
    body = np.asarray(points_px, dtype=np.float64) * (camera.m_per_px * FLIP)
    return rotate(np.asarray(pose.heading_rad)[..., None], body) + pose.position_m[..., None, :]


def distort(camera: Camera, points_px: ArrayLike) -> FloatArray:
    """Distort centred pixels to pixels of the image.

    ``points_px`` (..., 2): centred, y up. Returns (..., 2): column and row; NaN for a point that a lens with k1 < 0
    does not show, beyond 320 px/√(-3 k1).
    """
    points = np.asarray(points_px, dtype=np.float64)
    squared = np.sum(points**2, axis=-1, keepdims=True) / REFERENCE_RADIUS_PX**2
    moved = points * np.where(1.0 + 3.0 * camera.k1 * squared > 0.0, 1.0 + camera.k1 * squared, np.nan)
    return moved * FLIP + camera.centre


def undistorted(camera: Camera, image_px: ArrayLike) -> FloatArray:
    r"""Return centred pixels from pixels of the image; inverse of :func:`distort`.

    With :math:`\rho = r/320` the cubic :math:`\rho + k_1 \rho^3 = d` is solved in closed form, :math:`\rho = A
    \sin(\tfrac13 \arcsin(3d/A))` with :math:`A = \sqrt{-4/(3k_1)}`, and with hyperbolic functions for :math:`k_1 > 0`.

    Parameters
    ----------
    camera : Camera
        Camera with its centre and its distortion.
    image_px : array_like, shape (..., 2)
        Column and row.

    Returns
    -------
    ndarray, shape (..., 2)
        Centred pixels, y up; NaN where the lens shows nothing.

    Examples
    --------
    >>> from adcs import mockup
    >>> mockup.undistorted(mockup.Camera(), [[320.5, 238.5]])
    array([[1., 1.]])
    """
    points: FloatArray = (np.asarray(image_px, dtype=np.float64) - camera.centre) * FLIP
    if abs(camera.k1) < _NO_LENS:
        return points
    d = np.linalg.norm(points, axis=-1, keepdims=True) / REFERENCE_RADIUS_PX
    A = math.sqrt(4.0 / (3.0 * abs(camera.k1)))
    if camera.k1 < 0.0:
        inside = 3.0 * d <= A
        rho = A * np.sin(np.arcsin(np.where(inside, 3.0 * d / A, np.nan)) / 3.0)
    else:
        rho = A * np.sinh(np.arcsinh(3.0 * d / A) / 3.0)
    return points * np.divide(rho, d, out=np.ones_like(d), where=d > 0.0)


def image_from_table(camera: Camera, pose: Pose, points_m: ArrayLike) -> FloatArray:
    """Project points of the ceiling to the image.

    ``pose``: numbers, or arrays of shape (...). ``points_m`` (..., n, 2): in the table's frame [m]. Returns
    (..., n, 2): column and row [px], also outside of the frame; NaN where the lens shows no such point, see
    :func:`distort`.
    """
    return distort(camera, centred_from_table(camera, pose, points_m))


def table_from_image(camera: Camera, pose: Pose, image_px: ArrayLike) -> FloatArray:
    """Project pixels to the ceiling; inverse of :func:`image_from_table`.

    ``pose``: numbers, or arrays of shape (...). ``image_px`` (..., n, 2): column and row. Returns (..., n, 2): in the
    table's frame [m].
    """
    return table_from_centred(camera, pose, undistorted(camera, image_px))


def in_frame(camera: Camera, image_px: ArrayLike, margin_px: float = 0.0) -> BoolArray:
    """Return whether pixels (..., 2) are within the frame by at least a margin; False for NaN."""
    points = np.asarray(image_px, dtype=np.float64)
    last = np.array([camera.width_px - 1.0, camera.height_px - 1.0])
    return np.all((points >= margin_px) & (points <= last - margin_px), axis=-1)


def footprint(camera: Camera, pose: Pose, points_per_side: int = 1) -> FloatArray:
    """Return the outline of the visible part of the ceiling.

    Parameters
    ----------
    camera : Camera
        Camera with its distortion.
    pose : Pose
        Pose of numbers, or of arrays of shape (...).
    points_per_side : int
        Points of each side; a lens with distortion needs more than the corners.

    Returns
    -------
    ndarray, shape (..., 4 points_per_side, 2)
        Points in table axes [m], beginning at the image's upper left.

    Examples
    --------
    >>> from adcs import mockup
    >>> mockup.footprint(mockup.Camera(), mockup.Pose(0.0, 0.0, 0.0)).shape
    (4, 2)
    """
    right, bottom = camera.width_px - 0.5, camera.height_px - 0.5
    corners = np.array([[-0.5, -0.5], [right, -0.5], [right, bottom], [-0.5, bottom], [-0.5, -0.5]])
    along = np.arange(4 * points_per_side) / points_per_side
    outline = np.stack([np.interp(along, np.arange(5), corners[:, axis]) for axis in range(2)], axis=1)
    return table_from_image(camera, pose, outline)
