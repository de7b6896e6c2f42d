"""Stars with their names."""

from __future__ import annotations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.text import Annotation

from adcs.plots.stars import picture_figure
from adcs.stars.camera import StarCamera
from adcs.stars.catalogue import StarCatalogue
from adcs.stars.identification import StarFix
from adcs.stars.pictures import PictureStars
from adcs.stars.pose import CameraPose


def test_numbers_of_stars_at_the_edges_are_within_the_picture() -> None:
    width, height = 600, 400
    grid = np.stack(np.meshgrid([2.0, 0.5 * width, width - 2.0], [2.0, 0.5 * height, height - 2.0]), axis=-1)
    points, n = grid.reshape(-1, 2), grid.size // 2
    lights = PictureStars(points, np.full(n, 0.5), np.ones(n), np.zeros(n, dtype=bool))
    catalogue = StarCatalogue.of(120_000 + np.arange(n), np.arange(n) * 0.1, np.zeros(n), np.ones(n))
    pose = CameraPose(np.eye(3), StarCamera(width, height, 1e-4), np.eye(5))
    fix = StarFix(np.stack([np.arange(n)] * 2, axis=1), 0.0, -9.0, pose)
    figure = picture_figure("night", np.zeros((height, width)), lights, fix, catalogue)
    FigureCanvasAgg(figure).draw()
    (axes,) = figure.axes
    box = axes.get_window_extent()
    names = [text for text in axes.texts if isinstance(text, Annotation)]
    assert {text.get_text() for text in names} == {str(number) for number in catalogue.numbers}
    for text in names:
        place = text.get_window_extent()
        assert box.x0 <= place.x0 < place.x1 <= box.x1
        assert box.y0 <= place.y0 < place.y1 <= box.y1
