"""Fields in a scene: arrows at the sensors, and a plane coloured by the modulus."""

from __future__ import annotations

import numpy as np
import viser
from matplotlib import colormaps
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from arrays.typing import ByteArray, FloatArray
from magloc.fields.dipole import field
from magloc.viewer.scene.glyphs import Colour

_SCALE = colormaps["viridis"]
_PIXELS = 160
_DECADES = 3.0
_ALPHA = 200
# Sizes of the arrows, relative to the greatest length.
_SHAFT, _HEAD, _HEAD_LENGTH = 0.03, 0.08, 0.2


class SensorArrows:
    """Arrows at places of a frame on one linear scale.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Name of the node, below the frame of places and vectors.
    size_m : float
        Length of the longest arrow [m].
    colour : tuple of 3 ints
    """

    def __init__(self, scene: viser.SceneApi, name: str, size_m: float, colour: Colour) -> None:
        self._size_m = size_m
        self._arrows = scene.add_arrows(
            name, np.zeros((1, 2, 3), dtype=np.float32), colour, shaft_radius=_SHAFT * size_m,
            head_radius=_HEAD * size_m, head_length=_HEAD_LENGTH * size_m, visible=False,
        )  # fmt: skip

    def hide(self) -> None:
        """Hide the arrows."""
        self._arrows.visible = False

    def show(self, places_m: ArrayLike, vectors: ArrayLike) -> float:
        """Show the finite vectors (n, 3) at places (n, 3) [m], and return the largest modulus."""
        places, values = np.asarray(places_m, dtype=np.float64), np.asarray(vectors, dtype=np.float64)
        known = np.isfinite(values).all(axis=1)
        longest = float(np.linalg.norm(values[known], axis=1).max()) if known.any() else 0.0
        self._arrows.visible = longest > 0.0
        if longest > 0.0:
            ends = places[known] + self._size_m / longest * values[known]
            self._arrows.points = np.stack([places[known], ends], axis=1).astype(np.float32)
        return longest


class FieldSlice:
    """Square plane through a source, coloured by the logarithm of the field's modulus.

    Parameters
    ----------
    scene : viser.SceneApi
    name : str
        Name of the node.
    side_m : float
        Side of the square [m].
    """

    def __init__(self, scene: viser.SceneApi, name: str, side_m: float) -> None:
        self._side_m = side_m
        empty = np.zeros((2, 2, 4), dtype=np.uint8)
        self._image = scene.add_image(
            name, empty, side_m, side_m, format="png", cast_shadow=False, receive_shadow=False, visible=False
        )

    def hide(self) -> None:
        """Hide the plane."""
        self._image.visible = False

    def show(self, positions_m: ArrayLike, moments_Am2: ArrayLike, axis: int) -> tuple[float, float]:
        """Show the field of sources (k, 3) [m, A·m²], and return the ends of the scale [T].

        The plane goes through the first source. The scale has three decades, up to the field that one pixel in a
        hundred exceeds.
        """
        positions, moments = np.atleast_2d(positions_m), np.atleast_2d(moments_Am2)
        R = picture_axes(axis)
        steps = self._side_m * (np.arange(_PIXELS) + 0.5 - 0.5 * _PIXELS) / _PIXELS
        points = positions[0] + steps[None, :, None] * R[0] + steps[:, None, None] * R[1]
        B = np.linalg.norm(field(points[..., None, :], positions, moments).sum(axis=-2), axis=-1)
        high = float(np.nanquantile(B, 0.99))
        low = high * 10.0**-_DECADES
        self._image.image = _slice_colours(np.log10(B / low) / _DECADES)
        self._image.position = positions[0]
        self._image.wxyz = Rotation.from_matrix(R.T).as_quat(scalar_first=True)
        self._image.visible = True
        return low, high


PICTURE_AXES = ((1, 2), (2, 0), (0, 1))
"""Horizontal and vertical axis of a picture across each axis of the scene."""


def picture_axes(axis: int) -> FloatArray:
    """Return the right-handed directions across, down and out of a picture, as rows (3, 3)."""
    across, down = PICTURE_AXES[axis]
    return np.eye(3)[[across, down, axis]]


def _slice_colours(share: FloatArray) -> ByteArray:
    """Return the colours (..., 4) of shares of the scale; unknown values are transparent."""
    colours = _SCALE(np.clip(np.nan_to_num(share), 0.0, 1.0), bytes=True)
    colours[..., 3] = np.where(np.isfinite(share), _ALPHA, 0)
    return np.asarray(colours, dtype=np.uint8)
