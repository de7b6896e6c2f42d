"""Figure of a photograph of the sky with its identified stars."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from adcs.stars.catalogue import StarCatalogue
from adcs.stars.identification import StarFix
from adcs.stars.pictures import PictureStars
from arrays.typing import FloatArray
from magloc.plots import style

_MOST_LABELLED = 20
_NEAR_EDGE = 0.94  # part of width and height: a number takes 0.06 of the width


def picture_figure(
    name: str, picture: FloatArray, lights: PictureStars, found: StarFix | None, catalogue: StarCatalogue
) -> Figure:
    """Draw the picture with circles around identified stars and numbers of the brightest."""
    height, width = picture.shape
    figure = style.new_figure(style.WIDTH_IN * height / width + 0.5)
    ax = figure.add_subplot()
    low, high = np.nanquantile(picture, [0.2, 0.999])
    shown = np.arcsinh(np.clip(5.0 * (picture - low) / max(high - low, 1e-12), 0.0, None))
    ax.imshow(shown, cmap="gray", extent=(0, width, 0, height), interpolation="nearest")
    text = "no fix"
    if found is not None:
        stars = found.stars
        x, y = lights.points_px[stars[:, 0]].T
        ax.scatter(x, y, s=40.0, facecolor="none", edgecolor=style.ORANGE, lw=0.8)
        # The brightest lights come first.
        for light, row in stars[:_MOST_LABELLED]:
            # Labels near an edge point inwards.
            right, top = lights.points_px[light] > _NEAR_EDGE * np.array([width, height])
            place = lights.points_px[light] + 0.008 * width * np.where([right, top], -1.0, 1.0)
            sides: dict[str, Any] = {"ha": "right" if right else "left", "va": "top" if top else "baseline"}
            ax.annotate(f"{catalogue.numbers[row]}", place, color=style.ORANGE, fontsize=style.SMALL_FONT_SIZE, **sides)
        text = f"{len(stars)} stars, {np.degrees(found.pose.camera.rad_per_px) * 3600.0:.2f} arc seconds per pixel"
    ax.set(xlim=(0, width), ylim=(0, height), aspect="equal")
    style.label_axes(ax, "x [px]", "y [px]")
    ax.grid(visible=False)
    style.add_title(figure, f"{name}: {text}; numbers of the catalogue")
    return figure
