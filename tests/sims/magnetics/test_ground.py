"""The ground of a simulated survey."""

from __future__ import annotations

import numpy as np
import pytest

from sims.magnetics.ground import Geology, Targets

GEOLOGY = Geology(3e-9)
TARGETS = Targets(12, (-15.0, 15.0), (-10.0, 10.0))


class TestGeology:
    POINTS = np.random.default_rng(0).uniform([-50.0, -50.0, 0.0], [50.0, 50.0, 3.0], (40, 3))

    def test_has_neither_sources_nor_currents_above_the_ground(self) -> None:
        step = 1e-3
        steps = step * np.eye(3)
        changes = [GEOLOGY.at(self.POINTS + e, 1) - GEOLOGY.at(self.POINTS - e, 1) for e in steps]
        G = np.stack(changes, axis=-1) / (2.0 * step)
        scale = np.abs(G).max()
        np.testing.assert_allclose(np.trace(G, axis1=-2, axis2=-1), 0.0, atol=1e-6 * scale)
        np.testing.assert_allclose(G, G.mT, atol=1e-6 * scale)

    def test_size(self) -> None:
        """Horizontal components at the ground, over many fields: 30 of them, each known to a tenth."""
        plane = self.POINTS * [1.0, 1.0, 0.0]
        every = np.array([GEOLOGY.at(plane, seed) for seed in range(30)])
        size = np.sqrt(np.mean(every**2, axis=(0, 1)))
        np.testing.assert_allclose(size, [3e-9, 3e-9, 3e-9 * np.sqrt(2.0)], rtol=0.1)


class TestTargets:
    def test_within_the_bounds(self) -> None:
        position, moment = TARGETS.draw(4)
        assert position.shape == moment.shape == (12, 3)
        assert (np.abs(position[:, :2]) <= [15.0, 10.0]).all()
        assert ((-position[:, 2] >= 0.3) & (-position[:, 2] <= 2.0)).all()
        strength = np.linalg.norm(moment, axis=1)
        assert ((strength >= 0.1) & (strength <= 30.0)).all()

    def test_gaps(self) -> None:
        position, _ = TARGETS.draw(4)
        apart = np.linalg.norm(position[:, None, :2] - position[:, :2], axis=-1)
        assert apart[~np.eye(12, dtype=bool)].min() >= 5.0

    def test_no_room(self) -> None:
        with pytest.raises(ValueError, match="found room"):
            Targets(50, (0.0, 10.0), (0.0, 10.0)).draw(0)
