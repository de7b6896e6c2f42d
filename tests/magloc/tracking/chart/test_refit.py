"""Rows of a young track fitted together: how far what they say is from a Gaussian, and what the prior is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from magloc.measurement.differences import predicted_channels
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.refit import curvature, refitted
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
    n, last = len(state), tracker.measurements.of(row)
    return Mixture(state[None], np.zeros((1, n, n)), np.zeros(1), n, last.centroid_m, last.radius_m)


def curvature_at(noise_T: float) -> float:
    sensors = tuple(replace(sensor, noise_T=noise_T) for sensor in ARRAY.sensors)
    tracker = Tracker(replace(ARRAY, sensors=sensors), RandomWalk(1e-9, 1e-9))
    rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
    measurements = [tracker.measurements.of(row) for row in rows]
    found, _, _ = refitted(seed_of(tracker, rows[-1]), measurements, tracker.moved, tracker.errors)
    assert len(found) == 1
    return curvature(found, measurements, tracker.moved, tracker.errors)


class TestCurvature:
    def test_is_of_second_order(self) -> None:
        """What a step misses the fit by falls with the square of its length, in σ with σ: its square by four."""
        wide, narrow = curvature_at(4e-10), curvature_at(2e-10)
        assert wide / narrow == pytest.approx(4.0, rel=0.1)

    def test_of_a_source_that_is_well_known_is_none(self) -> None:
        assert curvature_at(1e-12) < 1e-4


class TestPrior:
    def test_a_velocity_that_rows_do_not_tell_is_that_of_the_prior(self) -> None:
        """Two rows with a source that moves by 1 m: at a stated speed of 1 mm/s its velocity stays as small."""
        motion = OrnsteinUhlenbeck(1e-3, 1e-3, correlation_s=1e6)
        tracker = Tracker(ARRAY, motion)
        rows = rows_of(np.array([[0.0, 0.0, 0.0], [0.01, 0.0, 0.0]]))
        still = [replace(row, origin_m=np.zeros(3)) for row in rows]
        measurements = [tracker.measurements.of(row) for row in still]
        seeds = seed_of(tracker, still[-1])
        fast = replace(seeds, x=seeds.x + np.array([0.0] * 6 + [-0.01, 0.0, 0.0] + [0.0] * 3))
        found, _, _ = refitted(fast, measurements, motion, tracker.errors)
        assert len(found) == 1
        sigma = np.sqrt(np.diagonal(found.S[0] @ found.S[0].T))[6:9] * found.chart.length[0]
        assert np.abs(found.x[0, 6:9]).max() < 4e-3
        assert sigma.max() < 1.1e-3
