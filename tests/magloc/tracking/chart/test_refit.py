"""Rows of a young track fitted together: where that leads, what is given up, and what the prior is."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from arrays.pose import PoseUncertainty
from magloc.localization.fit.prior import SourcePrior
from magloc.measurement.differences import predicted_channels
from magloc.tracking.chart import refit
from magloc.tracking.chart.known_moment import KnownInWorld
from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.refit import RangeCells, refit_components
from magloc.tracking.motion import OrnsteinUhlenbeck, RandomWalk
from magloc.tracking.rows import Row
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


class TestRefitted:
    def test_leads_to_the_source_from_beside_it(self) -> None:
        """Rows without noise have their least χ² at the source; to 0.05 σ, where the passes stop."""
        tracker = Tracker(ARRAY, RandomWalk(1e-9, 1e-9))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [tracker.measurements.of(row) for row in rows]
        seed = seed_of(tracker, rows[-1])
        beside = replace(seed, x=seed.x * np.repeat([1.05, 0.9], 3))
        found = refit_components(beside, measurements, [tracker.motion] * 5, tracker.errors, tracker.pose_errors)
        assert found.decided.all()
        mixture = found.mixture
        offset = mixture.chart.coordinates(SOURCE[None])[0]
        assert np.abs(np.linalg.solve(mixture.S[0], offset)).max() < 0.1
        assert found.nis[0] < 0.05

    def test_gives_up_what_explains_the_rows_far_worse(self) -> None:
        """A source turned round: it is decided, and it is not among those that are fitted."""
        tracker = Tracker(ARRAY, RandomWalk(1e-9, 1e-9))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [tracker.measurements.of(row) for row in rows]
        seed = seed_of(tracker, rows[-1])
        both = replace(seed, x=np.vstack([seed.x, -seed.x]), S=np.zeros((2, 6, 6)), log_weight=np.zeros(2))
        found = refit_components(both, measurements, [tracker.motion] * 5, tracker.errors, tracker.pose_errors)
        assert found.decided.all()
        assert len(found.mixture) == 1


class TestCells:
    """Cells of the range before the first row."""

    def test_together_are_the_fit_without_them(self) -> None:
        """Where the readings are nearly linear: 15 cells, 0.6 of their pitch wide, are even to 1 %, and so are sums."""
        tracker = Tracker(ARRAY, RandomWalk(1e-9, 1e-9))
        rows = rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        measurements = [tracker.measurements.of(row) for row in rows]
        motions = [tracker.motion] * 5
        mode = refit_components(
            seed_of(tracker, rows[-1]), measurements, motions, tracker.errors, tracker.pose_errors
        ).mixture
        sigma = np.linalg.norm(mode.S[0, 0])
        pitch = 0.7 * sigma
        seeds = mode.take(np.zeros(15, dtype=np.intp))
        cells = RangeCells(pitch * np.arange(-7, 8), np.full(15, 0.6 * pitch))
        found = refit_components(seeds, measurements, motions, tracker.errors, tracker.pose_errors, cells)
        assert found.decided.all()
        np.testing.assert_array_equal(found.origin, np.arange(15))
        assert np.all(np.diff(found.mixture.chart.length) > 0.0)
        one = found.mixture.take(np.arange(15)).match_moments()
        assert np.linalg.norm(np.linalg.solve(mode.S[0], mode.chart.coordinates(one.x)[0])) < 0.05
        np.testing.assert_allclose(one.S[0] @ one.S[0].T, mode.S[0] @ mode.S[0].T, rtol=0.05, atol=1e-3 * sigma**2)


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
        found = refit_components(fast, measurements, [motion] * 2, tracker.errors, tracker.pose_errors).mixture
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
        measurements = [tracker.measurements.of(row) for row in rows]
        seed = seed_of(tracker, rows[-1])
        seed.x[0, 6:9] = 0.5
        cells = RangeCells(np.linspace(-0.1, 0.1, 3), np.full(3, 0.1))
        found = refit_components(
            seed.take(np.zeros(3, dtype=np.intp)),
            measurements,
            [tracker.motion] * 5,
            tracker.errors,
            tracker.pose_errors,
            cells,
        )
        assert found.origin.tolist() == [0, 1, 2]


class TestLastingErrors:
    @pytest.mark.parametrize("prior", [SourcePrior(), SourcePrior(known_moment_Am2=250.0, known_moment_sigma_Am2=2.0)])
    def test_is_the_best_fit_of_all_rows_sensors_and_poses(
        self, prior: SourcePrior, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """SciPy's optimum of source, poses and offsets, in rows over which the chart hardly bends."""
        monkeypatch.setattr(refit, "_TOLERANCE", 1e-4)
        monkeypatch.setattr(refit, "_MOST_PASSES", 200)
        pose = PoseUncertainty(0.02, 0.002, 0.0, 10.0, 0.0, 0.0)
        array = replace(ARRAY, pose=pose, sensors=tuple(replace(s, offset_uncertainty_T=2e-9) for s in ARRAY.sensors))
        tracker = Tracker(array, RandomWalk(0.01, 0.01), prior=prior)
        rng = np.random.default_rng(5)
        of_sensors = 2e-9 * rng.normal(size=array.n_channels)
        rows = [
            replace(row, readings_T=row.readings_T + of_sensors + array.channel_noise_T * rng.normal(size=12))
            for row in rows_of(np.linspace([-3.0, 0.0, 0.0], [0.0, 0.0, 0.0], 5))
        ]
        measurements = [tracker.measurements.of(row) for row in rows]
        n, e, last = measurements[0].n_charted, tracker.errors.n_states, measurements[-1]
        x = np.concatenate([SOURCE, np.zeros(n - 6 + e)])[None]
        seed = Mixture(x, np.eye(n + e)[None], np.zeros(1), n, last.centroid_m, last.radius_m, last.n_pose)
        in_world = KnownInWorld.of(tracker.prior, np.eye(3))
        motions = [tracker.motion] * 5
        found = refit_components(
            seed, measurements, motions, tracker.errors, tracker.pose_errors, None, in_world
        ).mixture
        kept, added = tracker.pose_errors.step(1.0)
        _, _, S_q = tracker.motion.step(found.x[0, :6], 1.0)
        Q = S_q @ S_q.T
        # A modulus that is kept has no noise: give it next to none.
        S_q = np.linalg.cholesky(Q + 1e-10 * np.diag(np.diag(Q)))
        scale = np.concatenate([np.tile(np.append(np.abs(SOURCE), np.ones(n - 6)), 5), tracker.errors.sigma])

        def residuals(y: FloatArray) -> FloatArray:
            states, errors = (scale * y)[: 5 * n].reshape(5, n), (scale * y)[5 * n :]
            parts = [states[0, 6:], y[5 * n :]]
            parts += [
                row.z - row.predict_source(x) - row.effect @ errors for row, x in zip(measurements, states, strict=True)
            ]
            for before, after in pairwise(states):
                parts += [np.linalg.solve(S_q, (after - before)[:6]), (after[6:] - kept * before[6:]) / added]
            if in_world is not None:
                parts.append(in_world.residual(states[:1])[0])
            return np.concatenate(parts)

        fit = least_squares(residuals, np.append(np.tile(found.x[0, :n], 5), found.x[0, n:]) / scale, "3-point")
        state = np.r_[4 * n : 5 * n + e]
        spread = (scale[:, None] * np.linalg.inv(np.linalg.qr(fit.jac, "r")))[state]
        P = spread @ spread.T
        root = found.S[0].copy()
        root[:n] = found.chart.jacobian(np.zeros((1, n)))[0] @ root[:n]
        sigma = np.sqrt(np.diagonal(P))
        assert np.abs((found.x[0] - (scale * fit.x)[state]) / sigma).max() < 0.1
        unit = np.outer(sigma, sigma)
        np.testing.assert_allclose(root @ root.T / unit, P / unit, atol=0.03)
