"""Lines that show a solid lie on its surface and go around it."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.design.volumes import Ball, Box, Cylinder
from magloc.plots.designs import _outline

CENTRE = (0.3, -0.2, 0.7)


@pytest.mark.parametrize(
    ("volume", "half"),
    [
        (Ball(CENTRE, 0.4), (0.4, 0.4, 0.4)),
        (Cylinder(CENTRE, 0.3, 1.2), (0.3, 0.3, 0.6)),
        (Box(CENTRE, (1.0, 0.4, 0.6)), (0.5, 0.2, 0.3)),
    ],
)
def test_outlines(volume: Ball | Cylinder | Box, half: tuple[float, float, float]) -> None:
    points = np.concatenate(_outline(volume))
    np.testing.assert_allclose(volume.nearest(points), points, atol=1e-12)  # in the solid
    beyond = volume.centre + 1.01 * (points - volume.centre)
    assert (np.linalg.norm(volume.nearest(beyond) - beyond, axis=1) > 1e-4).all()  # and at its surface
    np.testing.assert_allclose(points.max(axis=0) - CENTRE, half, rtol=1e-3)
    np.testing.assert_allclose(CENTRE - points.min(axis=0), half, rtol=1e-3)
