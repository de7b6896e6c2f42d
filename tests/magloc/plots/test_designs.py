"""Lines that show a solid lie on its surface and go around it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from magloc.design.volumes import Ball, BoxVolume, Cylinder
from magloc.plots.designs import _outline, design_counts

CENTRE = (0.3, -0.2, 0.7)


@pytest.mark.parametrize(
    ("volume", "half"),
    [
        (Ball(CENTRE, 0.4), (0.4, 0.4, 0.4)),
        (Cylinder(CENTRE, 0.3, 1.2), (0.3, 0.3, 0.6)),
        (BoxVolume(CENTRE, (1.0, 0.4, 0.6)), (0.5, 0.2, 0.3)),
    ],
)
def test_outlines(volume: Ball | Cylinder | BoxVolume, half: tuple[float, float, float]) -> None:
    points = np.concatenate(_outline(volume))
    np.testing.assert_allclose(volume.nearest(points), points, atol=1e-12)  # in the solid
    beyond = volume.centre + 1.01 * (points - volume.centre)
    assert (np.linalg.norm(volume.nearest(beyond) - beyond, axis=1) > 1e-4).all()  # and at its surface
    np.testing.assert_allclose(points.max(axis=0) - CENTRE, half, rtol=1e-3)
    np.testing.assert_allclose(CENTRE - points.min(axis=0), half, rtol=1e-3)


def test_counts_are_drawn_in_their_order() -> None:
    def result(n: int, own_m: float, grid_m: float) -> Any:
        judged = [
            SimpleNamespace(name=name, criterion_m=sigma_m, gain=1.0 - own_m / sigma_m, gain_error=0.01)
            for name, sigma_m in (("task", own_m), ("even grid", grid_m))
        ]
        return SimpleNamespace(task=SimpleNamespace(name="task", n_sensors=n, criterion="q95"), judged=judged)

    figure = design_counts([result(8, 1e-3, 2e-3), result(4, 2e-3, 8e-3)])
    design, grid = figure.axes[0].lines[:2]
    np.testing.assert_allclose(np.asarray(design.get_xydata()), [[4.0, 2.0], [8.0, 1.0]])
    np.testing.assert_allclose(np.asarray(grid.get_xydata()), [[4.0, 8.0], [8.0, 2.0]])
    assert "[mm]" in figure.axes[0].get_ylabel()
    np.testing.assert_allclose(np.asarray(figure.axes[1].lines[0].get_xydata())[:, 1], [75.0, 50.0])
