"""Pictures of the camera's frame: with marks for the panel, and as a sheet on the ceiling."""

from __future__ import annotations

import numpy as np
from PIL import Image, ImageDraw

from adcs.mockup.vision.paper_matcher import CameraFix
from adcs.viewer.drive import IdentifiedFrame
from arrays.typing import ByteArray, IntArray
from magloc.viewer.scene.legend import Colour

IDENTIFIED_COLOUR: Colour = (0, 158, 115)
OTHER_STAR_COLOUR: Colour = (230, 159, 0)
_BRIGHTENING = 2.0  # because lights are faint in unsaturated frames
_RING_PX, _LINE_PX = 13, 3
_SHEET_STEP = 2  # every second pixel is enough on the ceiling
_SHEET_COLOUR = (30, 36, 48, 150)
_LIGHT_DN = 30


def identified_stars(frame: IdentifiedFrame) -> IntArray:
    """Return the numbers of the image's stars that the fix identifies."""
    return frame.fix.stars[:, 0] if isinstance(frame.fix, CameraFix) else np.empty(0, dtype=np.intp)


def mark_stars(frame: IdentifiedFrame) -> ByteArray:
    """Return the brightened frame (height, width, 3) with a ring around each star.

    Rings of identified stars are green, the others orange.
    """
    bright = np.minimum(frame.image * _BRIGHTENING, 255.0).astype(np.uint8)
    picture = Image.fromarray(bright).convert("RGB")
    _draw_rings(picture, frame, _RING_PX, 1)
    return np.asarray(picture)


def ceiling_sheet(frame: IdentifiedFrame) -> ByteArray:
    """Return the frame as a dark translucent sheet with rings (height / 2, width / 2, 4)."""
    height, width = (size // _SHEET_STEP * _SHEET_STEP for size in frame.image.shape)
    blocks = frame.image[:height, :width].reshape(height // _SHEET_STEP, _SHEET_STEP, width // _SHEET_STEP, -1)
    brightest = blocks.max(axis=(1, 3))
    sheet = np.empty((*brightest.shape, 4), dtype=np.uint8)
    sheet[:] = _SHEET_COLOUR
    sheet[brightest > int(np.median(brightest)) + _LIGHT_DN] = 255
    picture = Image.fromarray(sheet)
    _draw_rings(picture, frame, _RING_PX // _SHEET_STEP + 2, _SHEET_STEP)
    return np.asarray(picture)


def _draw_rings(picture: Image.Image, frame: IdentifiedFrame, radius: int, step: int) -> None:
    draw = ImageDraw.Draw(picture)
    identified = set(identified_stars(frame).tolist())
    for star, (column, row) in enumerate(frame.stars_px / step):
        colour = IDENTIFIED_COLOUR if star in identified else OTHER_STAR_COLOUR
        box = (column - radius, row - radius, column + radius, row + radius)
        draw.ellipse(box, outline=colour, width=_LINE_PX)
