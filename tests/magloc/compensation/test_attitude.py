"""Attitudes of a compensation: the root of a covariance."""

from __future__ import annotations

import numpy as np

from magloc.compensation.attitude import root_of


class TestRoot:
    def test_rounding_below_zero(self) -> None:
        """The square of the root is the covariance, also where rounding makes an eigenvalue negative."""
        axes, _ = np.linalg.qr(np.random.default_rng(1).standard_normal((4, 4)))
        covariance = axes @ np.diag([-9e-12, 1e-6, 0.1, 1.0]) @ axes.T
        root = root_of(covariance)
        np.testing.assert_allclose(root @ root.T, covariance, atol=1e-11)
