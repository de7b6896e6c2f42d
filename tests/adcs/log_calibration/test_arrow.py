"""The elimination of a chain of states, against the dense system."""

import numpy as np
import pytest

from adcs.log_calibration.arrow import ArrowSystem

K, N, P = 6, 3, 4


@pytest.fixture
def chain():
    rng = np.random.default_rng(1)
    system = ArrowSystem.empty(K, N, P)
    J, JP, r = rng.normal(size=(K - 1, 11, 2 * N)), rng.normal(size=(K - 1, 11, P)), rng.normal(size=(K - 1, 11))
    system.add_pairs(J, JP, r)
    rows = np.zeros((K - 1, 11, K * N + P))
    for k in range(K - 1):
        rows[k, :, N * k : N * (k + 2)] = J[k]
        rows[k, :, K * N :] = JP[k]
    return system, rows.reshape(-1, K * N + P), r.ravel()


def test_solution_covariance_and_determinant(chain):
    system, J, r = chain
    solution = system.solve()
    dense = np.linalg.lstsq(J, r, rcond=None)[0]
    np.testing.assert_allclose(np.append(solution.states.ravel(), solution.parameters), dense, atol=1e-10)
    np.testing.assert_allclose(solution.covariance, np.linalg.inv(J.T @ J)[K * N :, K * N :], atol=1e-10)
    assert solution.log_determinant == pytest.approx(np.linalg.slogdet(J.T @ J)[1])
    assert solution.decrease(system) == pytest.approx(r @ r - np.sum((r - J @ dense) ** 2))


def test_damping_adds_a_part_of_the_diagonal(chain):
    system, J, r = chain
    solution = system.solve(0.3)
    information = J.T @ J
    dense = np.linalg.solve(information + 0.3 * np.diag(np.diagonal(information)), J.T @ r)
    np.testing.assert_allclose(np.append(solution.states.ravel(), solution.parameters), dense, atol=1e-10)


def test_weighted_sum(chain):
    system = chain[0]
    twice = ArrowSystem.empty(K, N, P)
    twice.add(system, 4.0)
    np.testing.assert_allclose(twice.solve().covariance, system.solve().covariance / 4.0, atol=1e-12)
