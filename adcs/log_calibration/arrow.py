"""Gaussian systems of a chain of states and of parameters that all of them share.

The information matrix is block tridiagonal in the states and dense in the parameters: an arrow. Elimination of the
states from the first to the last is exact, and costs a time proportional to their number.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arrays.typing import FloatArray


@dataclass(frozen=True, eq=False)
class ArrowSystem:
    """Information and gradient of K states of size n and of p shared parameters.

    Attributes
    ----------
    diagonal : ndarray, shape (K, n, n)
    next : ndarray, shape (K - 1, n, n)
        Blocks between a state and the one after it.
    border : ndarray, shape (K, n, p)
        Blocks between states and parameters.
    corner : ndarray, shape (p, p)
    gradient : ndarray, shape (K, n)
        Right side of the states: JᵀW r with residuals r = observed - predicted.
    corner_gradient : ndarray, shape (p,)
    """

    diagonal: FloatArray
    next: FloatArray
    border: FloatArray
    corner: FloatArray
    gradient: FloatArray
    corner_gradient: FloatArray

    @classmethod
    def empty(cls, n_states: int, size: int, n_parameters: int) -> ArrowSystem:
        """Return a system without information."""
        return cls(
            np.zeros((n_states, size, size)),
            np.zeros((n_states - 1, size, size)),
            np.zeros((n_states, size, n_parameters)),
            np.zeros((n_parameters, n_parameters)),
            np.zeros((n_states, size)),
            np.zeros(n_parameters),
        )

    def add(self, other: ArrowSystem, weight: float = 1.0) -> None:
        """Add a system with a weight."""
        for name in ("diagonal", "next", "border", "corner", "gradient", "corner_gradient"):
            getattr(self, name)[:] += weight * getattr(other, name)

    def add_pairs(self, J: FloatArray, J_parameters: FloatArray, residuals: FloatArray) -> None:
        """Add whitened residuals (K - 1, m) of each state and the next.

        ``J`` (K - 1, m, 2n) and ``J_parameters`` (K - 1, m, p) are derivatives of predictions.
        """
        n = self.diagonal.shape[1]
        JJ = J.transpose(0, 2, 1) @ np.concatenate([J, J_parameters, residuals[:, :, None]], axis=2)
        self.diagonal[:-1] += JJ[:, :n, :n]
        self.diagonal[1:] += JJ[:, n:, n : 2 * n]
        self.next[:] += JJ[:, :n, n : 2 * n]
        self.border[:-1] += JJ[:, :n, 2 * n : -1]
        self.border[1:] += JJ[:, n:, 2 * n : -1]
        self.gradient[:-1] += JJ[:, :n, -1]
        self.gradient[1:] += JJ[:, n:, -1]
        flat = J_parameters.reshape(-1, J_parameters.shape[-1])
        self.corner[:] += flat.T @ flat
        self.corner_gradient[:] += flat.T @ residuals.ravel()

    def solve(self, damping: float = 0.0) -> Solution:
        """Return the solution, with the diagonal of the information increased by a part of itself."""
        K, n, p = self.border.shape
        corner = self.corner + damping * np.diag(np.diagonal(self.corner))
        right = self.corner_gradient.copy()
        gain = np.empty((K, n, n + p + 1))
        log_determinant = 0.0
        S, C, g = self.diagonal[0], self.border[0], self.gradient[0]
        for k in range(K):
            following = self.next[k] if k < K - 1 else np.zeros((n, n))
            S = S + damping * np.diag(np.diagonal(self.diagonal[k]))
            scale = 1.0 / np.sqrt(np.diagonal(S))
            lower = np.linalg.cholesky(scale[:, None] * S * scale)
            log_determinant += 2.0 * float(np.log(np.diagonal(lower) / scale).sum())
            half = np.linalg.inv(lower) * scale
            gain[k] = half.T @ (half @ np.concatenate([following, C, g[:, None]], axis=1))
            corner = corner - C.T @ gain[k][:, n:-1]
            right = right - C.T @ gain[k][:, -1]
            if k < K - 1:
                S = self.diagonal[k + 1] - following.T @ gain[k][:, :n]
                C = self.border[k + 1] - following.T @ gain[k][:, n:-1]
                g = self.gradient[k + 1] - following.T @ gain[k][:, -1]
        scale = 1.0 / np.sqrt(np.diagonal(corner))
        covariance = scale[:, None] * np.linalg.inv(scale[:, None] * corner * scale) * scale
        covariance = 0.5 * (covariance + covariance.T)
        parameters = covariance @ right
        states = np.empty((K, n))
        state = np.zeros(n)
        for k in range(K - 1, -1, -1):
            state = gain[k][:, -1] - gain[k][:, :n] @ state - gain[k][:, n:-1] @ parameters
            states[k] = state
        log_determinant += float(np.linalg.slogdet(corner)[1])
        return Solution(states, parameters, covariance, corner, log_determinant)


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of an :class:`ArrowSystem`.

    Attributes
    ----------
    states : ndarray, shape (K, n)
    parameters : ndarray, shape (p,)
    covariance : ndarray, shape (p, p)
        Covariance of the parameters, all states being unknown.
    information : ndarray, shape (p, p)
        Inverse of the covariance.
    log_determinant : float
        Logarithm of the determinant of the whole information.
    """

    states: FloatArray
    parameters: FloatArray
    covariance: FloatArray
    information: FloatArray
    log_determinant: float

    def decrease(self, system: ArrowSystem) -> float:
        """Return the decrease of the cost that the step predicts."""
        return float(np.sum(self.states * system.gradient) + self.parameters @ system.corner_gradient)
