"""Components that are kept of a mixture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magloc.tracking.chart.mixture import Mixture
from tests.magloc.tracking.chart.test_split import component


def with_another(factor: float, weight: float) -> Mixture:
    """Return a component, and another of some weight so many times as far away, which reads alike."""
    one = component(0.05)
    x = np.concatenate([one.x, one.x * np.r_[np.full(3, factor), np.full(3, factor**4)]])
    return replace(one, x=x, S=np.tile(one.S, (2, 1, 1)), log_weight=np.log([1.0 - weight, weight]))


class TestDropUnlikely:
    @pytest.mark.parametrize(("factor", "weight", "n"), [(1e8, 1e-4, 1), (1e8, 0.1, 2), (3.0, 1e-4, 2), (3.0, 1e-8, 1)])
    def test_a_light_component_that_has_run_away_is_no_part_of_the_mean(
        self, factor: float, weight: float, n: int
    ) -> None:
        assert len(with_another(factor, weight).drop_unlikely()) == n
