"""What the first row says of a source: eight moduli of 0.1 nT, four metres from 54 A·m². The seeds are not chosen."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from magloc.ambient import in_world_field
from magloc.tracking.chart.row import ChartRow
from magloc.tracking.results import rows_of
from magloc.tracking.tracker import Tracker
from sims.magnetics.simulation import simulate
from tests.magloc.tracking.test_ambient_uncertainty import REST, SCENARIO


class TestValleyOfRangesThatBends:
    @pytest.mark.parametrize("seed", range(5))
    def test_the_truth_is_in_one_of_its_parts(self, seed: int) -> None:
        """χ² of six numbers, once in 100,000 each; of the one Gaussian in its middle 106, 8,428 and 980 in three."""
        simulation = simulate(replace(SCENARIO, duration_s=1.0), seed)
        tracker, truth = Tracker(simulation.array, REST), simulation.truth
        row = next(iter(rows_of(in_world_field(simulation.readings, simulation.array))))
        mixture, _ = tracker.filter.started(ChartRow.of(tracker.measurements.of(row)), REST)
        assert mixture is not None
        assert truth.moment_Am2 is not None
        true = np.concatenate([truth.position_m[0], truth.moment_Am2[0]])
        e = mixture.chart.coordinates(np.broadcast_to(true, (len(mixture), 6)))
        square = np.sum(np.linalg.solve(mixture.S, e[..., None])[..., 0] ** 2, axis=1)
        assert len(mixture) > 10
        assert square.min() < stats.chi2.ppf(1.0 - 1e-5, 6)
