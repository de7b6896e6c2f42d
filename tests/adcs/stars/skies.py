"""Photographs of a made-up sky."""

from __future__ import annotations

import math

import numpy as np

HARD = {"gradient": 1.0, "vignetting": 0.8, "hot": 20}


def photograph(sky, camera, R, rng, gradient=0.0, vignetting=0.0, hot=0, trail_px=0.0, corner_px=0.0):
    """Grey picture (height, width) of 16 bits, first row at the top: lights of 1.2 pixels on a glow of 2,000 ± 20.

    ``corner_px``: by how much the lens shifts a star outwards that a pinhole shows in a corner, by the cube elsewhere.
    """
    seen = sky.directions @ R
    front = seen[:, 2] < -0.1
    points = seen[:, :2] / np.where(front, -seen[:, 2], 1.0)[:, None] / math.tan(camera.rad_per_px)
    middle = 0.5 * np.array([camera.width_px, camera.height_px])
    reach = np.linalg.norm(middle)
    # Far beyond the picture the cube would fold the sky back into it.
    squared = np.minimum(np.sum(points**2, axis=1, keepdims=True), 4.0 * reach**2)
    points = middle + points * (1.0 + corner_px * squared / reach**3)
    inside = front & (points > 8.0).all(axis=1) & (points < [camera.width_px - 8.0, camera.height_px - 8.0]).all(axis=1)
    rows = np.flatnonzero(inside)
    y, x = np.mgrid[0 : camera.height_px, 0 : camera.width_px]
    light = np.zeros(x.shape)
    around = np.arange(-8, 9)
    for row in rows:
        flux = 20_000.0 * 10.0 ** (-0.4 * (sky.magnitudes[row] - 6.0))
        for part in np.linspace(-0.5, 0.5, max(round(trail_px) + 1, 1)):
            px, py = points[row, 0] + part * trail_px - 0.5, camera.height_px - points[row, 1] - 0.5
            i, j = around + round(py), around + round(px)
            i, j = i[(i >= 0) & (i < len(x))], j[(j >= 0) & (j < x.shape[1])]
            spot = np.exp(-0.5 * (((i - py) / 1.2) ** 2)[:, None] - 0.5 * ((j - px) / 1.2) ** 2)
            light[i[:, None], j] += flux / (2.0 * math.pi * 1.2**2) / max(round(trail_px) + 1, 1) * spot
    middle = np.hypot(x - 0.5 * camera.width_px, y - 0.5 * camera.height_px) / camera.width_px
    picture = (2000.0 * (1.0 + gradient * x / camera.width_px) + light) * (1.0 - vignetting * middle**2)
    picture += 20.0 * rng.standard_normal(x.shape)
    picture[rng.integers(0, len(x), hot), rng.integers(0, x.shape[1], hot)] += rng.uniform(500.0, 30_000.0, hot)
    return np.clip(np.round(picture), 0, 65_535), points[rows], rows
