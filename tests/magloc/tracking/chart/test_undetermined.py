"""Sources that no row determines alone: what rows say together, of truths drawn from what is known before them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

import magloc
from arrays.geometries import axial
from magloc.measurement.differences import predicted_channels
from magloc.tracking.chart.places import Places
from magloc.tracking.chart.undetermined import _moves_a_source_at_rest
from magloc.tracking.consistency import nees_of
from magloc.tracking.coordinates import Chart
from magloc.tracking.motion import KnownMotion
from magloc.tracking.results import TrackPoint
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker

PAIR = axial(1.5, "vector", 2e-10)
REST, WALK = magloc.RandomWalk(1e-6, 1e-6), magloc.RandomWalk(0.05, 1e-6)
N_ROWS = 12
END = np.array([1.1, 0.0, 0.0])


def run(seed: int, motion: magloc.RandomWalk) -> tuple[TrackPoint, float, int]:
    """A pair of sensors that goes 2.2 m; the source is 1 to 12 m from where it ends, and seen 100 σ strong there.

    The last point, and its NEES and of how many numbers.
    """
    rng = np.random.default_rng(seed)
    direction, moment = rng.normal(size=(2, 3))
    range_m = math.exp(rng.uniform(0.0, math.log(12.0)))
    place = END + PAIR.centroid + range_m * direction / np.linalg.norm(direction)
    seen = np.diff(predicted_channels(PAIR, place - END, moment).reshape(2, 3), axis=0)
    moment *= 2e-8 / float(np.linalg.norm(seen))
    tracker = Tracker(PAIR, motion)
    steps = 0.5 * motion.speed_m_s * rng.normal(size=(N_ROWS, 3))
    for i in range(N_ROWS):
        origin = np.array([-1.1 + 2.2 * i / (N_ROWS - 1), 0.0, 0.0])
        then = place - steps[i + 1 :].sum(axis=0)
        readings = predicted_channels(PAIR, then - origin, moment) + 2e-10 * rng.normal(size=6)
        row = Row(0.5 * i, readings, origin)
        point = tracker.update(row)
    return point, *nees_of(point, np.concatenate([place, moment]), tracker.measurements.of(row))


def holds(point: TrackPoint, seed: int) -> bool:
    rng = np.random.default_rng(seed)
    rng.normal(size=(2, 3))
    range_m = math.exp(rng.uniform(0.0, math.log(12.0)))
    ((low, high),) = point.range_interval_m or ((0.0, None),)
    return low <= range_m and (high is None or range_m <= high)


class TestTogether:
    @pytest.mark.parametrize("n_seeds", [1, pytest.param(40, marks=pytest.mark.slow)])
    @pytest.mark.parametrize("motion", [REST, WALK], ids=["at rest", "walking"])
    def test_sets_hold_the_truth_and_errors_are_claimed(self, n_seeds: int, motion: magloc.RandomWalk) -> None:
        """The last rows: sets of 95 % at 1 in 10,000; the median NEES of 40 at 4 σ, its mean has heavy tails."""
        found = [run(seed, motion) for seed in range(n_seeds)]
        assert sum(holds(point, seed) for seed, (point, _, _) in enumerate(found)) >= stats.binom.ppf(
            1e-4, n_seeds, 0.95
        )
        assert all(point.covariance is not None for point, _, _ in found)
        share = np.median([square / dof for _, square, dof in found])
        assert share < 1.0 + 4.0 * 0.11 if n_seeds > 10 else share < 4.0

    def test_rows_together_know_more_than_the_last_one(self) -> None:
        point, _, _ = run(0, REST)
        (low, high) = point.range_interval_m[0]  # type: ignore[index]
        assert high is not None
        assert high < 1.5 * low  # one row of three differences has the direction and the range open
        assert point.status == "undetermined"

    @pytest.mark.slow
    def test_rows_that_contradict_each_other_are_left(self) -> None:
        """A source that jumps by its range, said to rest: after as many rows again those before are forgotten."""
        rng, tracker, moment = np.random.default_rng(4), Tracker(PAIR, REST), np.array([20.0, 200.0, -50.0])
        for i in range(24):
            place = np.array([2.0, 2.5, 1.0]) if i < 8 else np.array([-3.0, 1.0, -2.0])
            origin = np.array([0.1 * i, 0.0, 0.0])
            readings = predicted_channels(PAIR, place - origin, moment) + 2e-10 * rng.normal(size=6)
            point = tracker.update(Row(0.5 * i, readings, origin))
            assert point.position_m is not None
        ((low, high),) = point.range_interval_m or ((0.0, None),)
        range_m = float(np.linalg.norm(place - origin - PAIR.centroid))
        assert high is not None
        assert low < range_m < high < 2.0 * low

    def test_in_the_axes_of_an_array_that_moves_each_row_speaks_for_itself(self) -> None:
        assert not any(_moves_a_source_at_rest(motion) for motion in (REST, WALK, magloc.OrnsteinUhlenbeck(0.5, 0.1)))
        assert _moves_a_source_at_rest(KnownMotion(0.0, 0.0, array_velocity_m_s=(1.0, 0.0, 0.0)))
        assert _moves_a_source_at_rest(KnownMotion(0.0, 0.0, array_rate_rad_s=(0.0, 0.0, 0.1)))


class TestPlaces:
    X = np.array([[3.0, 1.0, -2.0, 1.0, 2.0, 3.0], [-1.0, 4.0, 2.0, 0.0, 5.0, 1.0]])

    def places(self) -> Places:
        root = np.array([[[0.2, 0.0, 0.0], [0.1, 0.15, 0.0], [-0.05, 0.1, 0.1]], 0.3 * np.eye(3)])
        return Places(Chart.at(self.X, np.zeros(3), 0.5), root, np.log([0.3, 0.7]))

    def test_density_adds_up_to_one(self) -> None:
        """Over log-range and direction, drawn evenly: within 5 % of 200,000."""
        rng = np.random.default_rng(2)
        log_range, direction = rng.uniform(math.log(0.5), math.log(40.0), 200_000), rng.normal(size=(200_000, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        x = np.concatenate([np.exp(log_range)[:, None] * direction, np.ones((200_000, 3))], axis=1)
        volume = math.log(80.0) * 4.0 * math.pi
        total = sum(float(np.exp(self.places().log_density(part)).sum()) for part in np.array_split(x, 20))
        assert total * volume / len(x) == pytest.approx(1.0, rel=0.05)

    def test_draws_are_of_the_density(self) -> None:
        """Mean of the density over its own draws, beside that over even ones: of both within 15 %."""
        places = self.places()
        x = places.draw(300)
        r = np.linalg.norm(x[:, :3], axis=1)
        near = np.linalg.norm(x[:, :3] / r[:, None] - self.X[0, :3] / np.linalg.norm(self.X[0, :3]), axis=1) < 0.7
        assert near.mean() == pytest.approx(0.3, abs=0.02)
        assert np.log(r[near]).std() == pytest.approx(0.2, rel=0.1)
        assert np.log(r[~near]).std() == pytest.approx(0.3, rel=0.1)
        seen = x[:, 3:6] / r[:, None] ** 4
        of_component = self.X[:, 3:] / np.linalg.norm(self.X[:, :3], axis=1)[:, None] ** 4
        np.testing.assert_allclose(seen, of_component[(~near).astype(int)], rtol=1e-9)
