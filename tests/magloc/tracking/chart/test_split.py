"""Components that are divided: what is kept, what is left alone, and where a division is due."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from magloc.tracking.chart.mixture import Mixture
from magloc.tracking.chart.split import MOST_COMPONENTS, bends, split
from magloc.tracking.row_filter import LARGEST_BEND
from magloc.tracking.rows import Row
from magloc.tracking.tracker import Tracker
from tests.passing_source import ARRAY, MOMENT, POSITION, SLOW, readings_of

SOURCE = np.concatenate([4.0 * POSITION, MOMENT / 100.0])
READINGS_T = readings_of(ARRAY, SOURCE[None, :3], SOURCE[None, 3:])[0]
ROW = Tracker(ARRAY, SLOW).measurements.of(Row(0.0, READINGS_T))


def component(sigma: float, n_rows: int = 1, seed: int = 0) -> Mixture:
    """Return a component about the source, with errors of about sigma in log-range, direction and relative moment."""
    chart = ROW.chart(SOURCE[None])
    strength = float(np.linalg.norm(SOURCE[3:])) / float(chart.length[0]) ** 4
    root = np.random.default_rng(seed).normal(size=(6, 6)) * sigma * np.array([1.0] * 3 + [strength] * 3)[:, None]
    S = np.linalg.cholesky(root @ root.T)
    return Mixture(SOURCE[None], S[None], np.zeros(1), 6, ROW.centroid_m, ROW.radius_m, n_rows=n_rows)


class TestBends:
    @pytest.mark.parametrize("seed", range(3))
    def test_depend_on_the_covariance_alone(self, seed: int) -> None:
        """Any other root of the same covariance has the same bends."""
        one = component(0.1, seed=seed)
        Q = np.linalg.qr(np.random.default_rng(seed + 10).normal(size=(6, 6)))[0]
        np.testing.assert_allclose(bends(replace(one, S=one.S @ Q), ROW)[0], bends(one, ROW)[0], rtol=1e-6)

    def test_grow_with_the_square_of_the_width_and_the_root_of_the_rows(self) -> None:
        """Where a row tells little, the even part of a Taylor series is of second order."""
        small = bends(component(1e-4), ROW)[0]
        np.testing.assert_allclose(bends(component(2e-4), ROW)[0], 4.0 * small, rtol=1e-2)
        np.testing.assert_allclose(bends(component(1e-4, n_rows=9), ROW)[0], 3.0 * small, rtol=1e-2)

    def test_see_where_a_source_and_its_mirror_image_come_together(self) -> None:
        """A moment along the direction: readings fold along an axis on which both turn.

        They hardly bend along the principal axes of the place, the moment being what is expected there.
        """
        u = POSITION / np.linalg.norm(POSITION)
        x = np.concatenate([8.0 * u, 50.0 * u])
        chart = ROW.chart(x[None])
        J = ROW.directional_derivative(x[None], chart.jacobian(np.zeros((1, 6))))[0] / 5.0
        before = 0.3 * np.array([1.0, 1.0, 1.0, *[50.0 / float(chart.length[0]) ** 4] * 3])
        P = np.linalg.inv(J.T @ J + np.diag(before**-2.0))
        S = np.linalg.cholesky(P)
        variances, axes = np.linalg.eigh(P[:3, :3])
        firm = chart.with_firm_moments(S[None])
        for v in (P[:, :3] @ axes / np.sqrt(variances)).T:
            behind, here, ahead = (ROW.predict_source(firm.retract(share * v[None]))[0] for share in (-1.0, 0.0, 1.0))
            g2 = float(np.sum((0.5 * (ahead - behind)) ** 2))
            assert np.linalg.norm(0.5 * (ahead + behind) - here) / (1.0 + g2) < 0.3 * LARGEST_BEND
        one = Mixture(x[None], S[None], np.zeros(1), 6, ROW.centroid_m, ROW.radius_m)
        assert bends(one, ROW)[0].max() > 2.0 * LARGEST_BEND


class TestSplit:
    def test_leaves_alone_what_is_straight(self) -> None:
        one = component(1e-4)
        parts, origin = split(one, ROW)
        assert parts is one
        assert origin.tolist() == [0]

    def test_keeps_mean_and_covariance(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """As far as the charts about the parts agree with that about the whole, in a narrow component."""
        one = component(1e-3)
        monkeypatch.setattr("magloc.tracking.chart.split.LARGEST_BEND", 0.0)
        parts, origin = split(one, ROW)
        assert 3 <= len(parts) <= MOST_COMPONENTS
        assert (origin == 0).all()
        assert parts.weight.sum() == pytest.approx(1.0, abs=1e-6)
        together, sigma = parts.match_moments(), np.linalg.norm(one.S[0], axis=1)
        np.testing.assert_allclose(one.chart.coordinates(together.x)[0] / sigma, 0.0, atol=0.01)
        found, expected = together.S[0] @ together.S[0].T, one.S[0] @ one.S[0].T
        np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=0.01)

    def test_makes_parts_over_which_readings_bend_less(self) -> None:
        one = component(0.3, n_rows=400)
        parts, _ = split(one, ROW)
        assert bends(one, ROW)[0].max() > LARGEST_BEND
        assert len(parts) > 1
        assert bends(parts, ROW)[0].max() < bends(one, ROW)[0].max()

    def test_leaves_alone_what_is_light(self) -> None:
        """A component that bends beside one of a thousand times its weight and more."""
        wide, narrow = component(0.3, n_rows=400), component(1e-4)
        both = replace(wide, x=np.repeat(wide.x, 2, axis=0), S=np.concatenate([wide.S, narrow.S]))
        light = replace(both, log_weight=np.log([1e-4, 1.0 - 1e-4]))
        assert len(split(replace(both, log_weight=np.log([0.5, 0.5])), ROW)[0]) > 2
        assert len(split(light, ROW)[0]) == 2
