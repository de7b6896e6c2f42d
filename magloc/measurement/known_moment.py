r"""Prior of a moment: a pseudo-measurement of its modulus or of its three components.

With a known modulus the fit of the moment is nonlinear but still cheap. The minimum of
:math:`\|y - A\mu\|^2 + (|\mu| - M)^2/\sigma^2` solves :math:`(A^T A + \nu I)\mu = A^T y` with
:math:`|\mu| = M/(1 - \nu\sigma^2)` for exactly one ν above :math:`-\lambda_1`, where :math:`\lambda_1` is the least
eigenvalue of :math:`A^T A`: docs/theory/known-position.md.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import FloatArray

_N_NEWTON = 12


@dataclass(frozen=True)
class KnownMoment:
    """Prior of every source's moment m: (h(m) - value)/σ has unit variance.

    Attributes
    ----------
    value_Am2 : tuple of float
        One number for the modulus, or three for the components in the array's frame.
    sigma_Am2 : float
    """

    value_Am2: tuple[float, ...]
    sigma_Am2: float

    @property
    def n_known(self) -> int:
        """Number of known components of one moment."""
        return len(self.value_Am2)

    @property
    def modulus_Am2(self) -> float:
        """Expected modulus of the moment."""
        return float(np.linalg.norm(self.value_Am2))

    def widen(self, share: float) -> KnownMoment:
        """Return the prior with σ not less than a share of the modulus."""
        return replace(self, sigma_Am2=max(self.sigma_Am2, share * self.modulus_Am2))

    def residual(self, moment_Am2: FloatArray) -> FloatArray:
        """Return the residuals (..., K k) of moments (..., K, 3), in standard deviations.

        A residual is the prior value minus the moment's.
        """
        has = moment_Am2 if self.n_known == 3 else np.linalg.norm(moment_Am2, axis=-1, keepdims=True)
        left = np.asarray((np.array(self.value_Am2) - has) / self.sigma_Am2, dtype=np.float64)
        return left.reshape(*moment_Am2.shape[:-2], -1)

    def information(self, moment_Am2: FloatArray) -> FloatArray:
        """Return half the Hessian (..., 3, 3) of the squared residual at moments (..., 3)."""
        if self.n_known == 3:
            return np.broadcast_to(np.eye(3) / self.sigma_Am2**2, (*moment_Am2.shape, 3))
        length = np.linalg.norm(moment_Am2, axis=-1)[..., None, None]
        along = moment_Am2[..., None] * moment_Am2[..., None, :] / length**2
        across: FloatArray = (1.0 - self.modulus_Am2 / length) * (np.eye(3) - along)
        return (along + across) / self.sigma_Am2**2

    def best_moments(self, information: FloatArray, pull: FloatArray, unit_Am2: FloatArray) -> FloatArray:
        """Return the scaled moments μ (..., 3) that minimise ``μᵀ I μ - 2 pᵀ μ + |residual|²``.

        I (..., 3, 3) is the information on μ, and unit (...) the moment [A·m²] for a scaled moment of 1.
        """
        sigma = self.sigma_Am2 / unit_Am2
        if self.n_known == 3:
            weight = sigma[..., None] ** -2
            pulled = pull + weight * (np.array(self.value_Am2) / unit_Am2[..., None])
            solved = np.linalg.solve(information + weight[..., None] * np.eye(3), pulled[..., None])
            return np.asarray(solved[..., 0], dtype=np.float64)
        eigenvalue, axes = np.linalg.eigh(information)
        along = np.einsum("...ji,...j->...i", axes, pull)
        x = moments_of_modulus(np.maximum(eigenvalue, 0.0), along, self.modulus_Am2 / unit_Am2, sigma)
        return np.einsum("...ij,...j->...i", axes, x)

    def jacobian(self, moment_Am2: FloatArray) -> FloatArray:
        """Return the derivative (b, K, k, 3) of the known quantities by the moments (b, K, 3)."""
        if self.n_known == 3:
            return np.broadcast_to(np.eye(3) / self.sigma_Am2, (*moment_Am2.shape, 3))
        length = np.linalg.norm(moment_Am2, axis=-1, keepdims=True)
        return (moment_Am2 / np.maximum(length, 1e-300) / self.sigma_Am2)[..., None, :]


def moments_of_modulus(eigenvalue: FloatArray, along: FloatArray, modulus: FloatArray, sigma: FloatArray) -> FloatArray:
    r"""Return the moments of an expected modulus, by the secular equation.

    They minimise :math:`\sum_i (\lambda_i x_i^2 - 2 b_i x_i) + (|x| - M)^2/\sigma^2`.

    λ and b (..., 3) are eigenvalues of ``AᵀA``, the least one first, and ``Aᵀy`` along its eigenvectors; the result
    has their shape. Newton's iteration on 1/|x|, which is concave in ν, comes from the left and never passes the root.
    In the hard case, b₁ = 0 and the other components too short, the sign of the first one is not determined; the result
    has a positive one.
    """
    variance, wanted = (sigma**2)[..., None], modulus[..., None]
    least = eigenvalue[..., :1]
    above = eigenvalue - least
    # δ = ν + λ₁: no component alone may be longer than the whole.
    bounds = np.abs(along) * (1.0 + eigenvalue * variance) / (wanted + np.abs(along) * variance) - above
    delta = np.maximum(bounds.max(axis=-1, keepdims=True), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        for _ in range(_N_NEWTON):
            x = np.where(along == 0.0, 0.0, along / (above + delta))
            squares = np.sum(x * x, axis=-1, keepdims=True)
            slope = np.sum(np.where(x == 0.0, 0.0, x * x / (above + delta)), axis=-1, keepdims=True) / squares**1.5
            excess = 1.0 / np.sqrt(squares) - (1.0 + (least - delta) * variance) / wanted
            step = np.where(squares > 0.0, excess / (slope + variance / wanted), delta)
            delta = np.maximum(delta - step, 0.0)
        x = np.where(along == 0.0, 0.0, along / (above + delta))
        length = modulus / (1.0 + ((least - delta) * variance)[..., 0])
    missing = np.sqrt(np.maximum(length**2 - np.sum(x[..., 1:] ** 2, axis=-1), 0.0))
    x[..., 0] = np.where(delta[..., 0] > 0.0, x[..., 0], missing)
    return x
