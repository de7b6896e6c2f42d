r"""The coordinates in which a tracked source is Gaussian: log-range, direction, and the moment as it is seen.

From the sensors' centroid a source stands at the range r in the direction u, and its differences are nearly linear in
:math:`\mu = m / r^4`. An error of the state is :math:`e = (\delta\lambda, a, \delta\mu, \delta w, \ldots)` with

.. math::

    r' = r e^{\delta\lambda}, \qquad u' = \frac{u + E a}{|u + E a|}, \qquad m' = r'^4 (\mu + \delta\mu), \qquad
    v' = r' (w + \delta w)

where E (3, 2) are two directions at right angles to u, and w = v / r. A state that only follows along the valley of
ranges does so along a straight line, and a constant velocity is free of scale. All further states are plain sums. Means
are kept as Cartesian states, covariances in these coordinates; :math:`L = \partial x / \partial e`.

Within the array's own radius R the range is known and r is no measure of anything: there the chart's origin stands back
from the centroid, so that the source is R away from it.

All functions take leading axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.tracking.motion import N_SOURCE

MOMENT_POWER = 4.0
"""How differences fall with the range."""
FIRM = 0.2
"""σ of a moment as it is seen, over its size, below which its error is one of strength and direction."""
# Directions at right angles to the chart's own lie at infinity: they are taken as this near to it.
_LEAST_COSINE = 0.05
_VELOCITY = slice(6, 9)


@dataclass(frozen=True, eq=False)
class Chart:
    """Coordinates about states.

    Attributes
    ----------
    x : ndarray, shape (..., n)
        States: position, moment, where there is one the velocity, and what else.
    length : ndarray, shape (...)
        The range r [m].
    u : ndarray, shape (..., 3)
        Direction from the origin.
    E : ndarray, shape (..., 3, 2)
        At right angles to it.
    firm : ndarray of bool, shape (...)
        Whose moment is moved by its strength and its direction: see :meth:`firmly`.
    n_pose : int
        How many of the last numbers of the states are errors of the array's pose.
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
        """About states (..., n), from the sensors' centroid (..., 3)."""
        offset = x[..., :3] - centroid_m
        r = np.sqrt(np.sum(offset * offset, axis=-1))
        safe = np.where(r > 0.0, r, 1.0)[..., None]
        u = np.where(r[..., None] > 0.0, offset / safe, np.array([0.0, 0.0, 1.0]))
        return cls(x, np.maximum(r, radius_m), u, _tangents(u), np.zeros(r.shape, dtype=bool), n_pose)

    def firmly(self, S: FloatArray) -> Chart:
        r"""The same where the roots (..., n, m) leave little of the moment open: with :math:`n = \delta\mu/|\mu|`,

        .. math:: m' = (r'/r)^4 |m| e^{\hat m \cdot n} b/|b|, \qquad b = \hat m + (1 - \hat m \hat m^T) n.

        The derivative at e = 0 is the same. A moment that stays what it is while its range wanders is a straight line
        here, while :math:`r'^4 (\mu + \delta\mu)` loses the square of each step.
        """
        size = np.linalg.norm(self.x[..., 3:6], axis=-1) / self.length**self.power
        sigma = np.sqrt(np.sum(S[..., 3:6, :] ** 2, axis=(-2, -1)))
        return replace(self, firm=sigma < FIRM * size)

    def take(self, index: IntArray | BoolArray) -> Chart:
        """About some of the states."""
        own = self.x[index], self.length[index], self.u[index], self.E[index], self.firm[index]
        return Chart(*own, self.n_pose, self.power)

    @property
    def has_velocity(self) -> bool:
        """Whether the state has one."""
        return self.x.shape[-1] - self.n_pose >= _VELOCITY.stop

    def retracted(self, e: FloatArray) -> FloatArray:
        """States (..., n) at coordinates (..., n)."""
        return self._moved(e)[0]

    def jacobian(self, e: FloatArray) -> FloatArray:
        """L (..., n, n): the derivative of :meth:`retracted`."""
        return self.linearised(e)[1]

    def linearised(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """States at coordinates, and L there."""
        x, growth, u, slope, by_moment = self._moved(e)
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

    def _moved(self, e: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """States, r'/r, u' and its derivative (..., 3, 2) by a, and that of firm moments by r⁴ δμ."""
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
            of_strength, by_moment = self._of_strength(e)
            x[self.firm, 3:6] = scale[self.firm, None] * of_strength
        if self.has_velocity:
            of_unit = self.x[..., _VELOCITY] + length[..., None] * e[..., _VELOCITY]
            x[..., _VELOCITY] = growth[..., None] * of_unit
        return x, growth, u, slope, by_moment

    def _of_strength(self, e: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Firm moments at r' = r (f, 3), and their derivative by r⁴ δμ."""
        m = self.x[self.firm, 3:6]
        size = np.linalg.norm(m, axis=-1, keepdims=True)
        along = m / size
        change = (self.length[self.firm] ** self.power)[:, None] * e[self.firm, 3:6] / size
        nu = np.sum(along * change, axis=-1, keepdims=True)
        b = along + change - nu * along
        norm = np.linalg.norm(b, axis=-1, keepdims=True)
        b /= norm
        strength = size * np.exp(nu)
        moved: FloatArray = strength * b
        one = np.eye(3)
        across = (one - b[:, :, None] * b[:, None, :]) @ (one - along[:, :, None] * along[:, None, :])
        derivative = (moved[:, :, None] * along[:, None, :] + (strength / norm)[..., None] * across) / size[..., None]
        return moved, derivative

    def coordinates(self, x: FloatArray) -> FloatArray:
        """Return the coordinates (..., n) of states (..., n): the inverse of :meth:`retracted`.

        Directions of firm moments at right angles to the chart's own lie at infinity.
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
            change[self.firm] = _change_of_strength(self.x[self.firm, 3:6], moment[self.firm])
        e[..., 3:6] = change / length**self.power
        if self.has_velocity:
            e[..., _VELOCITY] = (x[..., _VELOCITY] / growth - self.x[..., _VELOCITY]) / length
        return e

    def inverse_jacobian(self) -> FloatArray:
        """L⁻¹ (..., n, n) at e = 0."""
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


def _change_of_strength(before: FloatArray, after: FloatArray) -> FloatArray:
    """Return n |m| of firm moments (f, 3) that become others: the inverse of what :meth:`Chart.firmly` states."""
    size, strength = (np.linalg.norm(m, axis=-1, keepdims=True) for m in (before, after))
    along, direction = before / size, after / strength
    cosine = np.maximum(np.sum(along * direction, axis=-1, keepdims=True), _LEAST_COSINE)
    change: FloatArray = size * (direction / cosine - along + np.log(strength / size) * along)
    return change


def _tangents(u: FloatArray) -> FloatArray:
    """Two unit vectors (..., 3, 2) at right angles to u and to each other.

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
    """Root (..., 6, 6) of a Cartesian covariance from standard deviations (..., 6) of a source's coordinates."""
    return chart.jacobian(np.zeros_like(chart.x))[..., :N_SOURCE, :N_SOURCE] * sigma[..., None, :]


def mirrored(x: FloatArray, centroid_m: FloatArray) -> FloatArray:
    r"""States (4, K, n) whose gradient tensor at the sensors' centroid is that of states (K, n); the first are they.

    A far source shows little but its gradient tensor, and that belongs to four sources at one range: with u at the
    angle 0 and m at β in their common plane, u' stands at :math:`\mathrm{atan2}(s, -\tfrac32 c)` and m' at -β from it,
    where :math:`(c, s) = |m| (\cos β, \sin β)`; and both may be turned round.
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
