"""Square-root Kalman filtering against forms that others wrote.

| what | who checks it |
|---|---|
| update | exact rational arithmetic, filterpy's batch update, information form, an expansion in how little is learnt |
| predict | F P Fᵀ + Q |
| smoothing_gain | Rauch, Tung and Striebel's formulas with inverses, of each of a batch |
| iterated_update | scipy's minimiser of the MAP cost, Stone Soup's IteratedKalmanUpdater, the affine closed form |
| IteratedExtendedKalmanFilter | filterpy's ExtendedKalmanFilter where one linearisation is exact |
"""

from __future__ import annotations

from fractions import Fraction

import filterpy.kalman
import numpy as np
import pytest
import scipy.optimize
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from arrays.geometries import tetrahedron
from magloc.measurement.differences import DifferenceMeasurement
from magloc.state_space import (
    IteratedExtendedKalmanFilter,
    estimability,
    iterated_update,
    predict,
    smoothing_gain,
    symmetric_square_root,
    update,
    whitened_innovation,
)
from tests import oracles


def random_problem(seed, n=6, k=9):
    rng = np.random.default_rng(seed)
    return (
        rng.normal(size=n),
        rng.normal(size=(n, n)),
        rng.normal(size=(k, n)),
        rng.normal(size=k),
        rng.uniform(0.1, 2, k),
    )


def updated(x, S, H, innovation, variance):
    """State and root after :func:`update`, from rows that are not in units of their noise yet."""
    sigma = np.sqrt(variance)
    return update(x, S, H / sigma[:, None], innovation / sigma)[:2]


def in_turn(x, S, H, innovation, variance):
    """The same by one scalar after the other, in Potter's form (Bierman, II.4)."""
    x0 = x
    for h, nu, r in zip(H, innovation, variance, strict=True):
        phi = h @ S
        alpha = 1.0 / (phi @ phi + r)
        gain = alpha * (S @ phi)
        x, S = x + gain * (nu - h @ (x - x0)), S - np.outer(gain, phi) / (1.0 + np.sqrt(alpha * r))
    return x, S


def dipole_problem(start, seed=0, prior=(3.0, 300.0), scale=1.0):
    """Readings of a dipole before a tetrahedron, as an update problem in nT (the sizes scipy's stop rules expect)."""
    rng = np.random.default_rng(seed)
    measurement = DifferenceMeasurement.of(tetrahedron(1.5, noise_T=1e-9))
    z = 1e9 * measurement.predicted([5.0, 0.0, 0.306], [60.0, 50.0, 60.0])
    variance = 1e18 * measurement.variance * scale
    z = z + rng.normal(size=z.size) * np.sqrt(variance)
    return (
        np.asarray(start, dtype=float),
        np.diag(np.repeat(prior, 3)),
        z,
        variance,
        lambda x: 1e9 * measurement.predicted(x[:3], x[3:]),
        lambda x: 1e9 * measurement.jacobian(x[:3], x[3:]),
    )


START = [7.0, 1.0, 2.0, 0.0, 0.0, 0.0]


class TestUpdateIsBayes:
    """A Gaussian state is conditioned exactly on all scalars of one linearisation."""

    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=30, deadline=None)
    def test_information_form(self, seed):
        x, S, H, nu, r = random_problem(seed)
        x_new, S_new = updated(x, S, H, nu, r)
        prior, gain = np.linalg.inv(S @ S.T), H.T / r
        information = prior + gain @ H
        P = np.linalg.inv(information)
        # An inverse is off by its condition times eps: that of the prior is carried through P, the other one is P's.
        size = np.linalg.norm(P, 2)
        relative = np.linalg.cond(S) ** 2 * np.linalg.norm(prior, 2) * size + np.linalg.cond(information)
        off = 10.0 * np.finfo(np.float64).eps * relative * size
        assume(off < 1e-3 * size)
        np.testing.assert_allclose(S_new @ S_new.T, P, rtol=0.0, atol=off)
        np.testing.assert_allclose(x_new - x, P @ gain @ nu, rtol=0.0, atol=off * np.linalg.norm(gain @ nu))

    @given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 12))
    @settings(max_examples=30)
    def test_is_the_update_in_turn(self, seed, n, k):
        x, S, H, nu, r = random_problem(seed, n, k)
        x_new, S_new = updated(x, S, H, nu, r)
        x_turn, S_turn = in_turn(x, S, H, nu, r)
        phi = np.linalg.norm(H / np.sqrt(r)[:, None] @ S, 2)
        # Householder's reflections of n + k rows by n columns, and the sum with x.
        size = np.finfo(np.float64).eps * (1.0 + phi**2) * n * (n + k) * np.linalg.norm(S)
        off = size * np.linalg.norm(nu / np.sqrt(r)) + 2.0 * np.finfo(np.float64).eps * np.linalg.norm(x)
        np.testing.assert_allclose(S_new @ S_new.T, S_turn @ S_turn.T, rtol=0.0, atol=size * np.linalg.norm(S))
        np.testing.assert_allclose(x_new, x_turn, rtol=0.0, atol=off)

    def test_exact_rational_arithmetic_where_the_prior_dwarfs_the_noise(self):
        """P = 1e8·I against r = 1e-8: P - K H P loses every digit in float64, the square root none."""
        h = [3, 4]
        P, r = Fraction(10) ** 8, Fraction(1, 10**8)
        s = P * 25 + r
        exact = [[(P if i == j else 0) - P * h[i] * h[j] * P / s for j in range(2)] for i in range(2)]
        _, S = updated(np.zeros(2), 1e4 * np.eye(2), np.array([[3.0, 4.0]]), np.zeros(1), np.array([1e-8]))
        along = np.array([0.6, 0.8])
        exact_along = sum(Fraction(h[i], 5) * exact[i][j] * Fraction(h[j], 5) for i in range(2) for j in range(2))
        assert np.linalg.norm(S.T @ along) ** 2 == pytest.approx(float(exact_along), rel=1e-6)
        naive = 1e8 * np.eye(2) - np.outer([3e8, 4e8], [3e8, 4e8]) / (25e8 + 1e-8)
        assert abs(along @ naive @ along - float(exact_along)) > 0.5 * float(exact_along)

    @pytest.mark.parametrize("weight", [0.0, 1e-12, 1e-9, 1e-7, 1e-5, 1e-4])
    @pytest.mark.parametrize("k", [1, 3, 9])
    def test_readings_that_teach_next_to_nothing(self, weight, k):
        """P⁺ = S (I - ΦᵀΦ) Sᵀ but for Φ⁴: nothing is divided by the digits that a difference from one loses."""
        x, S, H, nu, r = random_problem(5, k=k)
        x_new, S_new = updated(x, S, weight * H, nu, r)
        phi = weight * H / np.sqrt(r)[:, None] @ S
        size = np.linalg.norm(S)
        off = size**2 * (1e-14 + np.linalg.norm(phi) ** 4)
        np.testing.assert_allclose(S_new @ S_new.T, S @ (np.eye(6) - phi.T @ phi) @ S.T, rtol=0.0, atol=off)
        first = S @ phi.T @ (nu / np.sqrt(r))
        np.testing.assert_allclose(
            x_new, x + first, rtol=0.0, atol=1e-14 + np.linalg.norm(phi) ** 2 * np.abs(first).max()
        )


class TestPrediction:
    @given(st.integers(0, 2**32 - 1))
    @settings(max_examples=30, deadline=None)
    def test_covariance(self, seed):
        rng = np.random.default_rng(seed)
        S, F, S_q = rng.normal(size=(4, 4)), rng.normal(size=(4, 4)), rng.normal(size=(4, 2))
        L = predict(S, F, S_q)
        np.testing.assert_allclose(L @ L.T, F @ S @ S.T @ F.T + S_q @ S_q.T, rtol=1e-10, atol=1e-12)
        np.testing.assert_array_equal(L, np.tril(L))


class TestSmoothing:
    def test_gain_and_rest_of_every_one_of_a_batch(self):
        """G = P Fᵀ P₋⁻¹, and D Dᵀ = P - G P₋ Gᵀ, with P₋ = F P Fᵀ + Q."""
        rng = np.random.default_rng(10)
        S, F, S_q = rng.normal(size=(5, 4, 4)), rng.normal(size=(5, 4, 4)), rng.normal(size=(5, 4, 2))
        P, Q = S @ S.mT, S_q @ S_q.mT
        ahead = F @ P @ F.mT + Q
        G, D = smoothing_gain(S, F, S_q)
        np.testing.assert_allclose(G, P @ F.mT @ np.linalg.inv(ahead), rtol=1e-9, atol=1e-10)
        np.testing.assert_allclose(D @ D.mT, P - G @ ahead @ G.mT, rtol=1e-8, atol=1e-9)


class TestWhitenedInnovation:
    def test_by_the_lower_cholesky_factor(self):
        _, S, H, nu, _ = random_problem(11)
        L = np.linalg.cholesky(H @ S @ S.T @ H.T + np.eye(9))
        np.testing.assert_allclose(whitened_innovation(S, H, nu), np.linalg.solve(L, nu), rtol=1e-10)


class TestIteratedUpdateIsMaximumAPosteriori:
    def test_scipy_minimises_the_same_cost(self):
        x, S, z, r, h, H = dipole_problem(START)
        ours = iterated_update(x, S, z, r, h, H, tolerance=1e-9, max_iterations=100)

        def residual(y):
            return np.concatenate([np.linalg.solve(S, y - x), (z - h(y)) / np.sqrt(r)])

        theirs = scipy.optimize.least_squares(residual, x, x_scale=np.diag(S), xtol=1e-14, ftol=1e-14, gtol=1e-14)
        assert ours.converged
        np.testing.assert_allclose(ours.x, theirs.x, rtol=1e-5, atol=1e-5)

    def test_stone_soup_iterates_the_same_steps(self):
        x, S, z, r, h, H = dipole_problem(START)
        ours = iterated_update(x, S, z, r, h, H, tolerance=1e-9, max_iterations=100)
        mean, covariance = oracles.stonesoup_iterated_update(x, S @ S.T, z, np.diag(r), h, H)
        np.testing.assert_allclose(ours.x, mean, rtol=1e-6, atol=1e-6)
        scale = np.sqrt(np.diag(covariance))
        np.testing.assert_allclose(
            ours.S @ ours.S.T / np.outer(scale, scale), covariance / np.outer(scale, scale), atol=1e-5
        )

    def test_affine_measurement_needs_one_linearisation(self):
        x, S, H, nu, r = random_problem(5)
        z = H @ x + nu
        result = iterated_update(x, S, z, r, lambda y: H @ y, lambda _: H, tolerance=1e-8)
        expected, _ = in_turn(x, S, H, nu, r)
        assert result.iterations == 2  # the second finds that nothing changes
        np.testing.assert_allclose(result.x, expected, rtol=1e-10)

    def test_a_measurement_counts_once_however_often_it_is_linearised(self):
        x, S, z, r, h, H = dipole_problem(START)
        result = iterated_update(x, S, z, r, h, H, tolerance=1e-9, max_iterations=100)
        J = H(result.x)
        P = np.linalg.inv(np.linalg.inv(S @ S.T) + (J.T / r) @ J)
        np.testing.assert_allclose(np.linalg.norm(result.S, axis=1), np.sqrt(np.diag(P)), rtol=1e-5)


class TestOneLinearisationIsAnExtendedKalmanFilter:
    """With one iteration and no stop rule the prediction is asked once; the update is filterpy's, vague priors too."""

    @pytest.mark.parametrize("prior", [(0.3, 20.0), (300.0, 1e6)])
    def test_filterpy(self, prior):
        x, S, z, r, h, H = dipole_problem([5.2, 0.1, 0.4, 55.0, 50.0, 60.0], prior=prior)
        asked = []
        ours = iterated_update(x, S, z, r, lambda y: asked.append(y) or h(y), H, tolerance=0.0, max_iterations=1)
        linear, S_turn = in_turn(x, S, H(x), z - h(x), r)
        assert (len(asked), ours.iterations, ours.converged) == (1, 1, False)
        np.testing.assert_allclose((ours.x - x) / prior[0], (linear - x) / prior[0], rtol=0.0, atol=1e-7)
        P, scale = ours.S @ ours.S.T, np.linalg.norm(S_turn, axis=1)
        np.testing.assert_allclose(P / np.outer(scale, scale), S_turn @ S_turn.T / np.outer(scale, scale), atol=1e-8)
        rows = np.concatenate([H(x) / np.sqrt(r)[:, None] @ S, np.eye(6)])
        _, nis, *_ = np.linalg.lstsq(rows, np.concatenate([(z - h(x)) / np.sqrt(r), np.zeros(6)]))
        assert ours.nis == pytest.approx(nis[0], rel=1e-9)
        if prior[0] == 0.3:
            peer = filterpy.kalman.ExtendedKalmanFilter(dim_x=6, dim_z=9)
            peer.x, peer.P, peer.R = x, S @ S.T, np.diag(r)
            peer.update(z, H, h)
            np.testing.assert_allclose(ours.x, peer.x, rtol=1e-7)
            np.testing.assert_allclose(P, peer.P, rtol=1e-6, atol=1e-8 * scale.max() ** 2)


class TestShrink:
    """Fletcher's example: residuals (x + 1, λx² + x - 1), where Gauss-Newton multiplies the distance from 0 by λ."""

    SLOPE = -1.3

    def update(self, shrink, max_iterations=50):
        return iterated_update(
            np.array([0.1]),
            np.array([[1e2]]),
            np.zeros(2),
            np.ones(2),
            lambda x: np.array([x[0] + 1.0, self.SLOPE * x[0] ** 2 + x[0] - 1.0]),
            lambda x: np.array([[1.0], [2.0 * self.SLOPE * x[0] + 1.0]]),
            tolerance=1e-10,
            max_iterations=max_iterations,
            shrink=shrink,
        )

    def test_whole_steps_swing_for_ever(self):
        assert not self.update(1.0).converged

    def test_shorter_ones_reach_the_optimum(self):
        """Which is at 0, by scipy too."""
        result = self.update(0.5)
        assert result.converged
        cost = scipy.optimize.minimize_scalar(
            lambda x: (x + 1.0) ** 2 + (self.SLOPE * x**2 + x - 1.0) ** 2, bracket=(-0.2, 0.1, 0.3)
        )
        assert abs(result.x[0]) < 1e-5
        assert cost.x == pytest.approx(result.x[0], abs=1e-5)

    def test_steps_that_do_not_swing_stay_whole(self):
        """Where every change of the prediction is smaller than the one before, nothing is shrunk: to the last bit."""
        x, S, z, r, h, H = dipole_problem([5.2, 0.1, 0.4, 55.0, 50.0, 60.0], prior=(0.3, 30.0))
        whole, shrunk = (iterated_update(x, S, z, r, h, H, tolerance=1e-6, shrink=s) for s in (1.0, 0.5))
        assert whole.converged
        np.testing.assert_array_equal(shrunk.x, whole.x)
        np.testing.assert_array_equal(shrunk.S, whole.S)


class TestStopRule:
    def test_too_few_iterations_are_not_convergence(self):
        x, S, z, r, h, H = dipole_problem(START)
        result = iterated_update(x, S, z, r, h, H, tolerance=1e-9, max_iterations=2)
        assert not result.converged
        assert result.iterations == 2

    def test_the_last_iteration_that_is_allowed_may_converge(self):
        """As many as are needed are enough, and one fewer is not."""
        x, S, z, r, h, H = dipole_problem(START)
        needed = iterated_update(x, S, z, r, h, H, tolerance=1e-9)
        at_most = {
            n: iterated_update(x, S, z, r, h, H, tolerance=1e-9, max_iterations=n)
            for n in (needed.iterations - 1, needed.iterations)
        }
        assert [update.converged for update in at_most.values()] == [False, True]
        np.testing.assert_array_equal(at_most[needed.iterations].x, needed.x)

    def test_no_iteration_at_all_is_refused(self):
        with pytest.raises(ValueError, match="max_iterations must be at least 1; instead received 0"):
            IteratedExtendedKalmanFilter(6, 9, tolerance=1e-9, max_iterations=0)

    def test_a_start_on_a_sensor_does_not_converge(self):
        sensor = tetrahedron(1.5).positions[0]
        x, S, z, r, h, H = dipole_problem([*sensor, 0.0, 0.0, 0.0])
        result = iterated_update(x, S, z, r, h, H, tolerance=1e-9)
        assert not result.converged


class TestNothingMeasured:
    """No scalar at all leaves the prior as it is, without a word of LAPACK."""

    def test_every_update(self, capfd):
        x, S, H, nu, r = random_problem(9, k=0)
        iterated = iterated_update(x, S, nu, r, lambda y: H @ y, lambda _: H, tolerance=1e-9)
        for x_new, S_new in (updated(x, S, H, nu, r), (iterated.x, iterated.S)):
            np.testing.assert_array_equal(x_new, x)
            np.testing.assert_array_equal(S_new, S)
        assert (iterated.nis, iterated.converged) == (0.0, True)
        assert whitened_innovation(S, H, nu).shape == (0,)
        assert capfd.readouterr() == ("", "")


class TestEstimability:
    def test_nothing_learned_and_fully_determined(self):
        S = np.diag([2.0, 3.0])
        _, S_new = updated(np.zeros(2), S, np.array([[1.0, 0.0]]), np.zeros(1), np.array([1e-12]))
        np.testing.assert_allclose(estimability(S_new, S), [1.0, 0.0], atol=1e-6)


class TestFilterpyNames:
    def test_same_numbers_as_filterpy_where_one_linearisation_is_exact(self):
        x, S, H, nu, r = random_problem(6, n=4, k=3)
        F = np.eye(4) + np.diag([0.1, 0.1, 0.1], k=1)
        ours = IteratedExtendedKalmanFilter(4, 3, tolerance=1e-9)
        peer = filterpy.kalman.ExtendedKalmanFilter(dim_x=4, dim_z=3)
        for kf, column in ((ours, x), (peer, x[:, None])):
            kf.x, kf.P, kf.F, kf.Q, kf.R = column, S @ S.T, F, 0.3 * np.eye(4), np.diag(r)
        z = H @ x + nu
        ours.predict()
        peer.predict()
        ours.update(z, lambda _: H, lambda y: H @ y)
        peer.update(z[:, None], lambda _: H, lambda y: H @ y)
        np.testing.assert_allclose(ours.x, peer.x.ravel(), rtol=1e-10)
        np.testing.assert_allclose(ours.P, peer.P, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(ours.y, peer.y.ravel(), rtol=1e-9)
        np.testing.assert_allclose(ours.P_prior, peer.P_prior, rtol=1e-9, atol=1e-12)

    def test_process_noise_may_change_in_place(self):
        """Its root is kept from step to step."""
        kf = IteratedExtendedKalmanFilter(2, 1, tolerance=1e-9)
        for variance in (0.0, 3.0, 5.0):
            kf.P, kf.Q[1, 1] = np.eye(2), variance
            kf.predict()
            np.testing.assert_allclose(kf.P, np.diag([1.0, 1.0 + variance]), rtol=1e-12)
            np.testing.assert_array_equal(kf.P_prior, kf.P)

    def test_correlated_noise_is_decorrelated_first(self):
        x, S, H, nu, _ = random_problem(7, n=4, k=3)
        root = np.random.default_rng(8).normal(size=(3, 3))
        R = root @ root.T + 0.1 * np.eye(3)
        ours = IteratedExtendedKalmanFilter(4, 3, tolerance=1e-9)
        ours.x, ours.P = x, S @ S.T
        ours.update(H @ x + nu, lambda _: H, lambda y: H @ y, R=R)
        P = np.linalg.inv(np.linalg.inv(S @ S.T) + H.T @ np.linalg.inv(R) @ H)
        np.testing.assert_allclose(ours.P, P, rtol=1e-8, atol=1e-10)

    def test_covariance_that_is_none(self):
        with pytest.raises(ValueError, match="positive semidefinite"):
            symmetric_square_root(np.diag([1.0, -1.0]))
        with pytest.raises(ValueError, match="symmetric"):
            symmetric_square_root(np.array([[1.0, 0.5], [0.0, 1.0]]))

    def test_singular_covariance_has_a_root(self):
        P = np.outer([1e-3, 2.0, 300.0], [1e-3, 2.0, 300.0])
        S = symmetric_square_root(P)
        np.testing.assert_allclose(S @ S.T, P, rtol=1e-12)
