"""The compiled steps of the square-root Kalman filter against their readable twin, magloc.kalman."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from magloc.kalman import predict_square_root
from magloc.kalman_compiled import triangular_root

SEEDS = st.integers(0, 2**32 - 1)


def root_of(rows):
    """Root of rows that are spoilt, every entry of which must be written."""
    root = np.full((len(rows), len(rows)), np.nan)
    triangular_root(rows.copy(), root)
    return root


class TestTriangularRoot:
    @given(SEEDS, st.integers(1, 12), st.integers(0, 12))
    @settings(max_examples=60)
    def test_is_that_of_the_twin(self, seed, n, m):
        """Of the same covariance; lower, with a diagonal that is not negative."""
        rng = np.random.default_rng(seed)
        S, F, S_q = rng.normal(size=(n, n)), rng.normal(size=(n, n)), rng.normal(size=(n, m))
        root, twin = root_of(np.concatenate([F @ S, S_q], axis=1)), predict_square_root(S, F, S_q)
        covariance = twin @ twin.T
        assert_allclose(root @ root.T, covariance, rtol=0.0, atol=1e-13 * np.trace(covariance))
        assert np.array_equal(root, np.tril(root))
        assert (np.diagonal(root) >= 0.0).all()

    def test_states_that_are_known_exactly(self):
        """No noise at all of one state, and two that are the same."""
        rows = np.array([[3.0, 4.0, 0.0], [0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [0.0, 0.0, 2.0]])
        expected = [[5.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [5.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 2.0]]
        assert_allclose(root_of(rows), expected, rtol=1e-15, atol=1e-15)
