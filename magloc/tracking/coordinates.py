r"""Coordinates in which a tracked source is Gaussian: log-range, direction and scaled moment.

A source has the range r and the direction u from the sensors' centroid. Its differences are nearly linear in the scaled
moment :math:`\mu = m / r^4`. An error of the state is :math:`e = (\delta\lambda, a, \delta\mu, \delta w, \ldots)` with

.. math::

    r' = r e^{\delta\lambda}, \qquad u' = \frac{u + E a}{|u + E a|}, \qquad m' = r'^4 (\mu + \delta\mu), \qquad
    v' = r' (w + \delta w)

where the columns of E (3, 2) are orthogonal to u, and w = v / r. The valley of sources that readings do not distinguish
is a straight line in these coordinates, and w does not depend on the scale. All further states are added. Means are
Cartesian states, covariances are in these coordinates; :math:`L = \partial x / \partial e`.

Within the radius R of the array the range is known and is not a useful scale. There the origin of the chart moves back
from the centroid, so that its distance from the source is R.

All functions broadcast over leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.tracking.motion import N_SOURCE

MOMENT_POWER = 4.0
"""Power of the range with which differences decrease."""
FIRM = 0.2
"""Relative σ of the scaled moment below which its error is one of strength and direction."""
# A direction orthogonal to that of the chart has infinite coordinates: this bounds the cosine between them.
_LEAST_COSINE = 0.05
_LEAST_NORM = 1e-150  # of a moment; squares of smaller ones underflow
_VELOCITY = slice(6, 9)


@dataclass(frozen=True, eq=False)
class Chart:
    """Local coordinates about states.

    Attributes
    ----------
    x : ndarray, shape (..., n)
        States: position, moment, the velocity if there is one, and others.
    length : ndarray, shape (...)
        Range r [m].
    u : ndarray, shape (..., 3)
        Direction from the origin.
    E : ndarray, shape (..., 3, 2)
        Two unit vectors orthogonal to `u` and to each other.
    firm : ndarray of bool, shape (...)
        States whose moment has strength and direction as coordinates: see :meth:`with_firm_moments`.
    n_pose : int
        Number of errors of the array's pose, the last numbers of the states.
    power : float
        Power of the range with which moments grow along the chart.
    """

    x: FloatArray
    length: FloatArray
    u: FloatArray
    E: FloatArray
    firm: BoolArray
    n_pose: int = 0
    power: float = MOMENT_POWER

    @classmethod
    def at(cls, x: FloatArray, centroid_m: FloatArray, radius_m: float, n_pose: int = 0) -> Chart:
        """Return the chart about states (..., n), with ranges from the sensors' centroid (..., 3)."""
        offset = x[..., :3] - centroid_m
        r = np.sqrt(np.sum(offset * offset, axis=-1))
        safe = np.where(r > 0.0, r, 1.0)[..., None]
        u = np.where(r[..., None] > 0.0, offset / safe, np.array([0.0, 0.0, 1.0]))
        return cls(x, np.maximum(r, radius_m), u, _tangents(u), np.zeros(r.shape, dtype=bool), n_pose)

    def with_firm_moments(self, S: FloatArray) -> Chart:
        r"""Return the chart with strength and direction as coordinates of well-known moments.

        A moment is well known if its σ is small; S (..., n, m) are roots of the covariances. With
        :math:`n = \delta\mu/|\mu|`,

        .. math:: m' = (r'/r)^4 |m| e^{\hat m \cdot n} b/|b|, \qquad b = \hat m + (1 - \hat m \hat m^T) n.

        The derivative at e = 0 is unchanged. A constant moment at a varying range is a straight line here, while
        :math:`r'^4 (\mu + \delta\mu)` loses the square of each step.
        """
        size = np.linalg.norm(self.x[..., 3:6], axis=-1) / self.length**self.power
        sigma = np.sqrt(np.sum(S[..., 3:6, :] ** 2, axis=(-2, -1)))
        return replace(self, firm=sigma < FIRM * size)

    def take(self, index: IntArray | BoolArray) -> Chart:
        """Return the chart about some of the states."""
        own = self.x[index], self.length[index], self.u[index], self.E[index], self.firm[index]
        return Chart(*own, self.n_pose, self.power)

    @property
    def has_velocity(self) -> bool:
        """True if the state has a velocity."""
        return self.x.shape[-1] - self.n_pose >= _VELOCITY.stop

    def retract(self, e: FloatArray) -> FloatArray:
        """Return the states (..., n) at coordinates (..., n)."""
        return self._retract(e)[0]

    def jacobian(self, e: FloatArray) -> FloatArray:
        """Return L (..., n, n), the derivative of :meth:`retract`."""
        return self.linearise(e)[1]

    def linearise(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the states at coordinates, and L there."""
        x, growth, u, slope, by_moment = self._retract(e)
        n = x.shape[-1]
        L = np.zeros((*x.shape, n))
        L[..., np.arange(n), np.arange(n)] = 1.0
        reach = growth * self.length
        L[..., :3, 0] = reach[..., None] * u
        L[..., :3, 1:3] = reach[..., None, None] * slope
        L[..., 3:6, 0] = self.power * x[..., 3:6]
        L[..., 3:6, 3:6] = (reach**self.power)[..., None, None] * np.eye(3)
        if self.firm.any():
            L[self.firm, 3:6, 3:6] = by_moment * (reach[self.firm] ** self.power)[..., None, None]
        if self.has_velocity:
            L[..., _VELOCITY, 0] = x[..., _VELOCITY]
            L[..., _VELOCITY, _VELOCITY] = reach[..., None, None] * np.eye(3)
        return x, L

    def _retract(self, e: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Return states, r'/r, u', ∂u'/∂a (..., 3, 2), and the derivative of firm moments by r⁴ δμ."""
        growth, length = np.exp(e[..., 0]), self.length
        b = self.u + (self.E @ e[..., 1:3, None])[..., 0]
        norm = np.sqrt(np.sum(b * b, axis=-1))
        u = b / norm[..., None]
        slope = (self.E - u[..., :, None] * (u[..., None, :] @ self.E)) / norm[..., None, None]
        x = self.x + e
        x[..., :3] = self.x[..., :3] + length[..., None] * (growth[..., None] * u - self.u)
        scale, unit = growth**self.power, length**self.power
        x[..., 3:6] = scale[..., None] * (self.x[..., 3:6] + unit[..., None] * e[..., 3:6])
        by_moment = np.zeros((0, 3, 3))
        if self.firm.any():
            firm_moment, by_moment = self._firm_moments(e)
            x[self.firm, 3:6] = scale[self.firm, None] * firm_moment
        if self.has_velocity:
            velocity = self.x[..., _VELOCITY] + length[..., None] * e[..., _VELOCITY]
            x[..., _VELOCITY] = growth[..., None] * velocity
        return x, growth, u, slope, by_moment

    def _firm_moments(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return firm moments (f, 3) at r' = r, and their derivative by r⁴ δμ."""
        m = self.x[self.firm, 3:6]
        size = np.maximum(np.linalg.norm(m, axis=-1, keepdims=True), _LEAST_NORM)
        along = m / size
        change = (self.length[self.firm] ** self.power)[:, None] * e[self.firm, 3:6] / size
        nu = np.sum(along * change, axis=-1, keepdims=True)
        b = along + change - nu * along
        norm = np.linalg.norm(b, axis=-1, keepdims=True)
        b /= norm
        strength = size * np.exp(nu)
        moment: FloatArray = strength * b
        one = np.eye(3)
        across = (one - b[:, :, None] * b[:, None, :]) @ (one - along[:, :, None] * along[:, None, :])
        derivative = (moment[:, :, None] * along[:, None, :] + (strength / norm)[..., None] * across) / size[..., None]
        return moment, derivative

    def coordinates(self, x: FloatArray) -> FloatArray:
        """Return the coordinates (..., n) of states (..., n), the inverse of :meth:`retract`.

        A firm moment orthogonal to that of the chart has infinite coordinates.
        """
        length = self.length[..., None]
        offset = x[..., :3] - self.x[..., :3] + length * self.u
        r = np.sqrt(np.sum(offset * offset, axis=-1))
        direction = offset / r[..., None]
        cosine = np.maximum(np.sum(direction * self.u, axis=-1), _LEAST_COSINE)
        e = x - self.x
        e[..., 0] = np.log(r / self.length)
        e[..., 1:3] = (direction[..., None, :] @ self.E)[..., 0, :] / cosine[..., None]
        growth = (r / self.length)[..., None]
        moment = x[..., 3:6] / growth**self.power
        change = moment - self.x[..., 3:6]
        if self.firm.any():
            change[self.firm] = _firm_coordinates(self.x[self.firm, 3:6], moment[self.firm])
        e[..., 3:6] = change / length**self.power
        if self.has_velocity:
            e[..., _VELOCITY] = (x[..., _VELOCITY] / growth - self.x[..., _VELOCITY]) / length
        return e

    def inverse_jacobian(self) -> FloatArray:
        """Return L⁻¹ (..., n, n) at e = 0."""
        n = self.x.shape[-1]
        inverse = np.zeros((*self.x.shape, n))
        inverse[..., np.arange(n), np.arange(n)] = 1.0
        length, unit = self.length[..., None], self.length**self.power
        inverse[..., 0, :3] = self.u / length
        inverse[..., 1:3, :3] = np.swapaxes(self.E, -1, -2) / length[..., None]
        by_range = -self.power * self.x[..., 3:6] / unit[..., None]
        inverse[..., 3:6, :3] = by_range[..., :, None] * inverse[..., None, 0, :3]
        inverse[..., 3:6, 3:6] = np.eye(3) / unit[..., None, None]
        if self.has_velocity:
            by_range = -self.x[..., _VELOCITY] / length
            inverse[..., _VELOCITY, :3] = by_range[..., :, None] * inverse[..., None, 0, :3]
            inverse[..., _VELOCITY, _VELOCITY] = np.eye(3) / length[..., None]
        return inverse


def _firm_coordinates(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return n |m| of changes of firm moments (f, 3), see :meth:`Chart.with_firm_moments`."""
    size, strength = (np.linalg.norm(m, axis=-1, keepdims=True) for m in (before, after))
    along, direction = before / size, after / strength
    cosine = np.maximum(np.sum(along * direction, axis=-1, keepdims=True), _LEAST_COSINE)
    change: FloatArray = size * (direction / cosine - along + np.log(strength / size) * along)
    return change


def _tangents(u: FloatArray) -> FloatArray:
    """Return two unit vectors (..., 3, 2) orthogonal to u and to each other.

    Duff et al., "Building an orthonormal basis, revisited".
    """
    x, y, z = u[..., 0], u[..., 1], u[..., 2]
    sign = np.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    first = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    second = np.stack([b, sign + y * y * a, -y], axis=-1)
    return np.stack([first, second], axis=-1)


def source_root(chart: Chart, sigma: FloatArray) -> FloatArray:
    """Return Cartesian roots (..., 6, 6) from σ (..., 6) of a source's coordinates."""
    return chart.jacobian(np.zeros_like(chart.x))[..., :N_SOURCE, :N_SOURCE] * sigma[..., None, :]


def mirror_images(x: FloatArray, centroid_m: FloatArray) -> FloatArray:
    r"""Return states (4, K, n) with the gradient tensor of states (K, n) at the centroid.

    The first of the four are the states themselves. Readings of a far source show little more than its gradient tensor,
    which four sources at one range share. With u at the angle 0 and m at β in their common plane, u' is at
    :math:`\mathrm{atan2}(s, -\tfrac32 c)` and m' at -β from it, where :math:`(c, s) = |m| (\cos β, \sin β)`. Both may
    be reversed.
    """
    offset, m = x[:, :3] - centroid_m, x[:, 3:6]
    r = np.linalg.norm(offset, axis=1, keepdims=True)
    u = offset / np.maximum(r, 1e-300)
    c = np.sum(u * m, axis=1, keepdims=True)
    across = m - c * u
    s = np.linalg.norm(across, axis=1, keepdims=True)
    w = across / np.maximum(s, 1e-300)
    angle = np.arctan2(s, -1.5 * c)
    u_other = np.cos(angle) * u + np.sin(angle) * w
    w_other = -np.sin(angle) * u + np.cos(angle) * w
    m_other = c * u_other - s * w_other
    states = np.tile(x, (4, 1, 1))
    for i, (direction, moment) in enumerate(((u, m), (-u, -m), (u_other, m_other), (-u_other, -m_other))):
        states[i, :, :3], states[i, :, 3:6] = centroid_m + r * direction, moment
    return states
