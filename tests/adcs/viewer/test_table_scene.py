"""Bodies of the scene of the mock-up."""

from __future__ import annotations

import numpy as np
import pytest

from adcs.viewer.table_scene import table_body


def corners(vertices: np.ndarray) -> set[tuple[float, ...]]:
    return {tuple(row) for row in (np.round(vertices, 9) + 0.0).tolist()}


class TestTable:
    VERTICES = np.asarray(table_body().vertices)

    @pytest.mark.parametrize("mirrored", [(-1.0, 1.0, 1.0), (1.0, -1.0, 1.0)])
    def test_is_the_same_from_both_sides(self, mirrored: tuple[float, float, float]) -> None:
        assert corners(self.VERTICES * mirrored) == corners(self.VERTICES)

    def test_stands_on_legs_below_its_top(self) -> None:
        assert self.VERTICES[:, 2].max() == pytest.approx(0.0)
        feet = self.VERTICES[self.VERTICES[:, 2] < self.VERTICES[:, 2].min() + 1e-9]
        quadrants = {(bool(x > 0.0), bool(y > 0.0)) for x, y, _ in feet}
        assert len(quadrants) == 4
        assert (np.abs(feet[:, :2]) < np.abs(self.VERTICES[:, :2]).max(axis=0)).all()
