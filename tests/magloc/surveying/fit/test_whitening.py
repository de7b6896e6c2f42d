"""The Kalman filter that makes the noise of a survey white, against the whole covariance matrix."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.typing import FloatArray
from magloc.fields import dipole
from magloc.surveying.fit.kernels import MeasuredRows, WhiteningFilter

N, K, S = 40, 2, 5
RNG = np.random.default_rng(5)
DT = np.concatenate([[0.0], RNG.uniform(0.05, 0.4, N - 1)])
H = RNG.standard_normal((N, K, S))
# Two that are forgotten, one that walks, a value and its slope.
KEPT = np.column_stack([np.exp(-DT / 2.0), np.exp(-DT / 0.3), np.ones((N, 3))])
KEPT[0] = 1.0
ADDED = np.column_stack([1.0 - KEPT[:, :2] ** 2, 0.3 * DT, 0.02 * DT**3 / 3.0, 0.02 * DT])
START = np.array([1.0, 1.0, 4.0, 9.0, 0.5])


def dense_covariance() -> FloatArray:
    """Of all measurements (N·K, N·K), noise of unit variance included, from the states of all instants."""
    P = np.zeros((N, N, S, S))
    P[0, 0] = np.diag(START)
    for i in range(1, N):
        F = np.diag(KEPT[i])
        F[S - 2, S - 1] = DT[i]
        for j in range(i):
            P[i, j] = F @ P[i - 1, j]
            P[j, i] = P[i, j].T
        P[i, i] = F @ P[i - 1, i - 1] @ F.T + np.diag(ADDED[i])
    return np.einsum("iks,ijst,jlt->ikjl", H, P, H).reshape(N * K, N * K) + np.eye(N * K)


@pytest.mark.usefixtures("instruction_set")
class TestWhitening:
    def test_is_a_root_of_the_inverse_covariance(self) -> None:
        columns = RNG.standard_normal((N, K, 3))
        white = columns.copy()
        filtered = WhiteningFilter(H, KEPT, ADDED, DT, START)
        filtered.whiten(white, np.arange(N))
        flat, white = columns.reshape(N * K, 3), white.reshape(N * K, 3)
        np.testing.assert_allclose(white.T @ white, flat.T @ np.linalg.solve(dense_covariance(), flat), rtol=1e-9)
        logarithm = -2.0 * np.log(filtered.gains[..., S]).sum()
        np.testing.assert_allclose(logarithm, np.linalg.slogdet(dense_covariance())[1], rtol=1e-9)

    def test_rows_that_are_zero_before(self) -> None:
        """Of rows from some row on it gives what it gives of all, zero before."""
        filtered = WhiteningFilter(H, KEPT, ADDED, DT, START)
        whole = np.zeros((N, K, 2))
        whole[12:] = RNG.standard_normal((N - 12, K, 2))
        part, rows = whole[12:].copy(), np.arange(12, N)
        filtered.whiten(whole, np.arange(N))
        filtered.whiten(part, rows)
        np.testing.assert_allclose(part, whole[12:], rtol=1e-12)


@pytest.mark.usefixtures("instruction_set")
class TestColumns:
    """Compiled columns are what the field's own functions give."""

    SENSORS = RNG.uniform([-1.0, -1.0, 1.0], [1.0, 1.0, 3.0], (6, 2, 3))
    DIRECTIONS = RNG.standard_normal((6, 4, 3))
    U = RNG.standard_normal((3, 4))
    OWNER = np.array([0, 0, 1, 1])
    PLACES = RNG.uniform([-1.0, -1.0, -2.0], [1.0, 1.0, 0.0], (5, 3))
    MOMENTS = RNG.standard_normal((5, 3))
    ROWS = MeasuredRows(SENSORS, DIRECTIONS, U, OWNER, np.array([0, 2, 4, 6]))

    def grouped(self, channels: FloatArray) -> FloatArray:
        """Measurements (3, 3, m) of channels (6, 4, m), two rows each."""
        return (self.U @ channels).reshape(3, 2, 3, -1).sum(axis=1) / np.sqrt(2.0)

    def test_moments(self) -> None:
        A = dipole.field_matrix(self.SENSORS[:, self.OWNER, None], self.PLACES)
        expected = np.einsum("nci,ncmij->ncjm", self.DIRECTIONS, A).reshape(6, 4, -1)
        found = self.ROWS.moment_columns(self.PLACES, np.array([0, 2]))
        np.testing.assert_allclose(found, self.grouped(expected)[[0, 2]], rtol=1e-9, atol=1e-20)

    def test_sources(self) -> None:
        J = dipole.field_jacobian(self.SENSORS[:, self.OWNER, None], self.PLACES, self.MOMENTS)
        expected = np.einsum("nci,ncmij->ncmj", self.DIRECTIONS, J).reshape(6, 4, -1)
        found = self.ROWS.source_columns(self.PLACES, self.MOMENTS)
        np.testing.assert_allclose(found, self.grouped(expected), rtol=1e-9, atol=1e-20)

    def test_poles(self) -> None:
        away = self.SENSORS[:, self.OWNER, None] - self.PLACES
        pull = away / np.linalg.norm(away, axis=-1, keepdims=True) ** 3
        expected = np.einsum("nci,ncpi->ncp", self.DIRECTIONS, pull)
        found = self.ROWS.pole_columns(self.PLACES)
        np.testing.assert_allclose(found, self.grouped(expected), rtol=1e-9)
