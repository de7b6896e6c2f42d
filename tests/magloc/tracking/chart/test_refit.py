"""Rows of a young track fitted together: where that leads, what is given up, and what the prior is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magloc.measurement.differences import predicted_channels
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.refit import Cells, refitted
from magloc.tracking.chart.row import ChartRow
from magloc.tracking.motion import OrnsteinUhlenbeck, RandomWalk
from magloc.tracking.results import Row
from magloc.tracking.tracker import Tracker
from tests.passing_source import ARRAY, MOMENT, POSITION

FloatArray = NDArray[np.float64]
SOURCE = np.concatenate([POSITION, MOMENT])


def rows_of(at_m: FloatArray) -> list[Row]:
    """Rows without noise of an array that stands at places (n, 3) in turn."""
    readings = predicted_channels(ARRAY, SOURCE[:3] - at_m, np.broadcast_to(SOURCE[3:], at_m.shape))
    return [Row(float(i), values, origin_m=at_m[i]) for i, values in enumerate(readings)]


def seed_of(tracker: Tracker, row: Row) -> Mixture:
    state, _ = tracker.motion.start(SOURCE, np.zeros((6, 6)))
    n, last = len(state), ChartRow.of(tracker.measurements.of(row))
    return Mixture(state[None], np.zeros((1, n, n)), np.zeros(1), n, last.centroid_m, last.radius_m)


class TestRefitted:
    def test_leads_to_the_source_from_beside_it(self) -> None:
        """Rows without noise have their least χ² at the source; to 0.05 σ, where the passes stop."""
        tracker = Tracker(ARRAY, RandomWalk(1e-9, 1e-9))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [ChartRow.of(tracker.measurements.of(row)) for row in rows]
        seed = seed_of(tracker, rows[-1])
        beside = replace(seed, x=seed.x * np.repeat([1.05, 0.9], 3))
        found = refitted(beside, measurements, [tracker.motion] * 5, tracker.errors)
        assert found.decided.all()
        mixture = found.mixture
        offset = mixture.chart.coordinates(SOURCE[None])[0]
        assert np.abs(np.linalg.solve(mixture.S[0], offset)).max() < 0.1
        assert found.nis[0] < 0.05

    def test_gives_up_what_explains_the_rows_far_worse(self) -> None:
        """A source turned round: it is decided, and it is not among those that are fitted."""
        tracker = Tracker(ARRAY, RandomWalk(1e-9, 1e-9))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [ChartRow.of(tracker.measurements.of(row)) for row in rows]
        seed = seed_of(tracker, rows[-1])
        both = replace(seed, x=np.vstack([seed.x, -seed.x]), S=np.zeros((2, 6, 6)), log_weight=np.zeros(2))
        found = refitted(both, measurements, [tracker.motion] * 5, tracker.errors)
        assert found.decided.all()
        assert len(found.mixture) == 1


class TestCells:
    """Cells of the range before the first row."""

    def test_together_are_the_fit_without_them(self) -> None:
        """Where the readings are nearly linear: 15 cells, 0.6 of their pitch wide, are even to 1 %, and so are sums."""
        tracker = Tracker(ARRAY, RandomWalk(1e-9, 1e-9))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [ChartRow.of(tracker.measurements.of(row)) for row in rows]
        motions = [tracker.motion] * 5
        mode = refitted(seed_of(tracker, rows[-1]), measurements, motions, tracker.errors).mixture
        sigma = np.linalg.norm(mode.S[0, 0])
        pitch = 0.7 * sigma
        seeds = mode.take(np.zeros(15, dtype=np.intp))
        cells = Cells(pitch * np.arange(-7, 8), np.full(15, 0.6 * pitch))
        found = refitted(seeds, measurements, motions, tracker.errors, cells)
        assert found.decided.all()
        np.testing.assert_array_equal(found.origin, np.arange(15))
        assert np.all(np.diff(found.mixture.chart.length) > 0.0)
        one = found.mixture.take(np.arange(15)).matched()
        assert np.linalg.norm(np.linalg.solve(mode.S[0], mode.chart.coordinates(one.x)[0])) < 0.05
        np.testing.assert_allclose(one.S[0] @ one.S[0].T, mode.S[0] @ mode.S[0].T, rtol=0.05, atol=1e-3 * sigma**2)


class TestPrior:
    def test_a_velocity_that_rows_do_not_tell_is_that_of_the_prior(self) -> None:
        """Two rows with a source that moves by 1 m: at a stated speed of 1 mm/s its velocity stays as small."""
        motion = OrnsteinUhlenbeck(1e-3, 1e-3, correlation_s=1e6)
        tracker = Tracker(ARRAY, motion)
        rows = rows_of(np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]))
        still = [replace(row, origin_m=np.zeros(3)) for row in rows]
        measurements = [ChartRow.of(tracker.measurements.of(row)) for row in still]
        seeds = seed_of(tracker, still[-1])
        fast = replace(seeds, x=seeds.x + np.array([0.0] * 6 + [-0.01, 0.0, 0.0] + [0.0] * 3))
        found = refitted(fast, measurements, [motion] * 2, tracker.errors).mixture
        assert len(found) == 1
        sigma = np.sqrt(np.diagonal(found.S[0] @ found.S[0].T))[6:9] * found.chart.length[0]
        assert np.abs(found.x[0, 6:9]).max() < 4e-3
        assert sigma.max() < 1.1e-3

    def test_of_a_source_that_moves(self) -> None:
        """What is known of velocity before the first row goes with the range: cells keep a covariance of both.

        A trajectory at the motion's own speed, whose covariance had no root once its range alone was replaced.
        """
        tracker = Tracker(ARRAY, OrnsteinUhlenbeck(0.5, 0.1, correlation_s=10.0))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [ChartRow.of(tracker.measurements.of(row)) for row in rows]
        seed = seed_of(tracker, rows[-1])
        seed.x[0, 6:9] = 0.5
        cells = Cells(np.linspace(-0.1, 0.1, 3), np.full(3, 0.1))
        found = refitted(
            seed.take(np.zeros(3, dtype=np.intp)), measurements, [tracker.motion] * 5, tracker.errors, cells
        )
        assert found.origin.tolist() == [0, 1, 2]
