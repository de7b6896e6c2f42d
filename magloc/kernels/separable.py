"""Compiled search for one dipole by separable least squares; the readable twin is :mod:`magloc.separable`.

The moment enters linearly, so a fix is a search over the source's position alone, here in homogeneous coordinates
(u, s) on the unit sphere of R⁴: position = centroid + radius · u / s. Infinity (s = 0) and the centroid (u = 0) are
ordinary points of it, and (u, s), (-u, -s) the same source.

Arrays are transposed against the twin, (component, channel), so that the inner loops run over contiguous channels.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from magloc.kernels import compiled

FloatArray = NDArray[np.float64]

# Numba compiles a function once more for every literal integer that it is called with; a converted one is no literal.
runtime_int = cast(Callable[[int], int], np.int64)

# |s| stays above this: below it the differences lose their digits, and no array resolves a range of 10⁵ radii.
SMALLEST_S = 1e-5

# How a refinement ends.
CONVERGED, KNOWN, FAILED = 0, 1, 2

# Gauss-Newton gain in χ² at which an optimum is one: the position is then within 1e-4 σ of it.
OPTIMUM_TOLERANCE = 1e-9
# The same for the profile over the range, which is read at a rise of 3.84 to 0.01.
PROFILE_TOLERANCE = 1e-3
# No step of the profile is longer, in α: it would leap over what is between.
LARGEST_PROFILE_STEP = 0.2


@compiled
def _project_common(rows: FloatArray, n_rows: int, common: FloatArray, shrinkage: FloatArray) -> None:
    """Remove the common field from whitened rows (k, c) in place."""
    for j in range(n_rows):
        for k in range(shrinkage.size):
            t = 0.0
            for c in range(rows.shape[1]):
                t += common[k, c] * rows[j, c]
            t *= shrinkage[k]
            for c in range(rows.shape[1]):
                rows[j, c] -= t * common[k, c]


@compiled
def unit_basis(
    q: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    basis: FloatArray,
) -> None:
    """Whitened readings of the three unit moments at q, into basis (3, c)."""
    last = -1
    n0 = n1 = n2 = r3 = 0.0
    for c in range(channel_sensor.size):
        i = channel_sensor[c]
        if i != last:
            v0 = q[3] * sensors[i, 0] - q[0]
            v1 = q[3] * sensors[i, 1] - q[1]
            v2 = q[3] * sensors[i, 2] - q[2]
            inverse = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            n0, n1, n2 = v0 * inverse, v1 * inverse, v2 * inverse
            r3 = inverse * inverse * inverse
            last = i
        g0, g1, g2 = gain[c, 0], gain[c, 1], gain[c, 2]
        t = 3.0 * (n0 * g0 + n1 * g1 + n2 * g2)
        basis[0, c] = (t * n0 - g0) * r3
        basis[1, c] = (t * n1 - g1) * r3
        basis[2, c] = (t * n2 - g2) * r3
    _project_common(basis, 3, common, shrinkage)


@compiled
def homogeneous_jacobian(
    q: FloatArray,
    mu: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    jacobian: FloatArray,
) -> None:
    """Derivative of the readings of the scaled moment mu along (u, s), before the common field is removed: (4, c)."""
    last = -1
    n0 = n1 = n2 = r4 = nm = 0.0
    for c in range(channel_sensor.size):
        i = channel_sensor[c]
        if i != last:
            v0 = q[3] * sensors[i, 0] - q[0]
            v1 = q[3] * sensors[i, 1] - q[1]
            v2 = q[3] * sensors[i, 2] - q[2]
            inverse = 1.0 / math.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
            n0, n1, n2 = v0 * inverse, v1 * inverse, v2 * inverse
            r4 = 3.0 * inverse * inverse * inverse * inverse
            nm = n0 * mu[0] + n1 * mu[1] + n2 * mu[2]
            last = i
        g0, g1, g2 = gain[c, 0], gain[c, 1], gain[c, 2]
        ng = n0 * g0 + n1 * g1 + n2 * g2
        mg = mu[0] * g0 + mu[1] * g1 + mu[2] * g2
        along = mg - 5.0 * nm * ng
        w0 = (nm * g0 + along * n0 + ng * mu[0]) * r4
        w1 = (nm * g1 + along * n1 + ng * mu[1]) * r4
        w2 = (nm * g2 + along * n2 + ng * mu[2]) * r4
        jacobian[0, c] = -w0
        jacobian[1, c] = -w1
        jacobian[2, c] = -w2
        jacobian[3, c] = w0 * sensors[i, 0] + w1 * sensors[i, 1] + w2 * sensors[i, 2]


@compiled
def orthonormalise(rows: FloatArray, triangle: FloatArray) -> None:
    """Gram-Schmidt, twice, of rows (k, c) in place; triangle (k, k) becomes R with rows = Rᵀ · orthonormal rows."""
    n_rows, n = rows.shape
    for j in range(n_rows):
        for k in range(j):
            triangle[k, j] = 0.0
        for _ in range(2):
            for k in range(j):
                t = 0.0
                for c in range(n):
                    t += rows[k, c] * rows[j, c]
                triangle[k, j] += t
                for c in range(n):
                    rows[j, c] -= t * rows[k, c]
        t = 0.0
        for c in range(n):
            t += rows[j, c] * rows[j, c]
        norm = math.sqrt(t)
        triangle[j, j] = norm
        inverse = 1.0 / norm if norm > 0.0 else 0.0
        for c in range(n):
            rows[j, c] *= inverse


@compiled
def _residual(
    q: FloatArray,
    y: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    basis: FloatArray,
    triangle: FloatArray,
    mu: FloatArray,
    residual: FloatArray,
) -> float:
    """Orthonormal basis, best scaled moment mu and residual at q; returns χ²."""
    unit_basis(q, sensors, channel_sensor, gain, common, shrinkage, basis)
    orthonormalise(basis, triangle)
    n = y.size
    for c in range(n):
        residual[c] = y[c]
    for j in range(3):
        t = 0.0
        for c in range(n):
            t += basis[j, c] * residual[c]
        mu[j] = t
        for c in range(n):
            residual[c] -= t * basis[j, c]
    for j in range(2, -1, -1):
        t = mu[j]
        for k in range(j + 1, 3):
            t -= triangle[j, k] * mu[k]
        mu[j] = t / triangle[j, j] if triangle[j, j] > 0.0 else 0.0
    chi2 = 0.0
    for c in range(n):
        chi2 += residual[c] * residual[c]
    return chi2


@compiled
def _tangent(q: FloatArray, tangent: FloatArray) -> None:
    """Orthonormal basis (3, 4) of the plane orthogonal to the unit vector q, from a Householder reflection."""
    sign = 1.0 if q[3] >= 0.0 else -1.0
    beta = 1.0 / (1.0 + sign * q[3])
    for j in range(3):
        for a in range(4):
            w = q[a] if a < 3 else q[3] + sign
            tangent[j, a] = (1.0 if a == j else 0.0) - beta * q[j] * w


@compiled
def _directional_tangent(q: FloatArray, tangent: FloatArray) -> None:
    """Two orthonormal rows orthogonal to u that leave s, and with it the range, alone."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    u0, u1, u2 = q[0] / norm, q[1] / norm, q[2] / norm
    sign = 1.0 if u2 >= 0.0 else -1.0
    a = -1.0 / (sign + u2)
    b = u0 * u1 * a
    tangent[0, 3] = tangent[1, 3] = 0.0
    tangent[0, 0], tangent[0, 1], tangent[0, 2] = 1.0 + sign * u0 * u0 * a, sign * b, -sign * u0
    tangent[1, 0], tangent[1, 1], tangent[1, 2] = b, sign + u1 * u1 * a, -u1


@compiled
def _solve_damped(a: FloatArray, b: FloatArray, n: int, damping: float, step: FloatArray) -> None:
    """Step = (a + damping · diag(a))⁻¹ b for n ≤ 3 by Cholesky; columns without information do not move."""
    m = np.empty((3, 3))
    largest = 0.0
    for i in range(n):
        largest = max(largest, a[i, i])
    for i in range(n):
        for j in range(n):
            m[i, j] = a[i, j]
        m[i, i] += damping * a[i, i] + 1e-14 * largest
    for i in range(n):
        for j in range(i + 1):
            t = m[i, j]
            for k in range(j):
                t -= m[i, k] * m[j, k]
            if i == j:
                m[i, i] = math.sqrt(t) if t > 0.0 else math.inf
            else:
                m[i, j] = t / m[j, j]
    for i in range(n):
        t = b[i]
        for k in range(i):
            t -= m[i, k] * step[k]
        step[i] = t / m[i, i]
    for i in range(n - 1, -1, -1):
        t = step[i]
        for k in range(i + 1, n):
            t -= m[k, i] * step[k]
        step[i] = t / m[i, i]


@compiled
def same_optimum(q: FloatArray, chi2: float, other_q: FloatArray, other_chi2: float) -> bool:
    """Whether two ends are one optimum: 0.01 rad apart on the sphere of homogeneous coordinates, at the same χ²."""
    t = q[0] * other_q[0] + q[1] * other_q[1] + q[2] * other_q[2] + q[3] * other_q[3]
    return abs(t) > 0.99995 and abs(chi2 - other_chi2) < 0.01


@compiled
def refine(
    q: FloatArray,
    y: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    n_free: int,
    tolerance: float,
    max_iterations: int,
    known_q: FloatArray,
    known_chi2: FloatArray,
    n_known: int,
    mu: FloatArray,
) -> tuple[float, int, int]:
    """Damped Gauss-Newton on the projected cost, from q (4,), which becomes the optimum as mu its scaled moment.

    With n_free = 3 it moves on the sphere of homogeneous coordinates, with 2 at one range. Every accepted step
    decreases χ². It ends where a further Gauss-Newton step would gain less than the tolerance, or as soon as it has
    come to one of the known optima. Returns χ², the number of linearisations, and CONVERGED, KNOWN or FAILED.
    """
    n = y.size
    basis, triangle, residual = np.empty((3, n)), np.zeros((3, 3)), np.empty(n)
    new_basis, new_triangle, new_residual = np.empty((3, n)), np.zeros((3, 3)), np.empty(n)
    jacobian, rows = np.empty((4, n)), np.empty((n_free, n))
    tangent, new_q, new_mu = np.empty((3, 4)), np.empty(4), np.empty(3)
    a, b, step = np.empty((3, 3)), np.empty(3), np.empty(3)
    chi2 = _residual(q, y, sensors, channel_sensor, gain, common, shrinkage, basis, triangle, mu, residual)
    if not math.isfinite(chi2):
        return math.inf, 0, FAILED
    damping = 1e-3
    for iteration in range(1, max_iterations + 1):
        for j in range(n_known):
            if same_optimum(q, chi2, known_q[j], known_chi2[j]):
                return chi2, iteration - 1, KNOWN
        homogeneous_jacobian(q, mu, sensors, channel_sensor, gain, jacobian)
        if n_free == 2:
            _directional_tangent(q, tangent)
        else:
            _tangent(q, tangent)
        for j in range(n_free):
            for c in range(n):
                rows[j, c] = (
                    tangent[j, 0] * jacobian[0, c]
                    + tangent[j, 1] * jacobian[1, c]
                    + tangent[j, 2] * jacobian[2, c]
                    + tangent[j, 3] * jacobian[3, c]
                )
        _project_common(rows, n_free, common, shrinkage)
        # Kaufman's form of variable projection: the moment's part of every column is taken out.
        for j in range(n_free):
            for k in range(3):
                t = 0.0
                for c in range(n):
                    t += basis[k, c] * rows[j, c]
                for c in range(n):
                    rows[j, c] -= t * basis[k, c]
        for i in range(n_free):
            t = 0.0
            for c in range(n):
                t += rows[i, c] * residual[c]
            b[i] = t
            for j in range(i + 1):
                t = 0.0
                for c in range(n):
                    t += rows[i, c] * rows[j, c]
                a[i, j] = t
                a[j, i] = t
        _solve_damped(a, b, n_free, 0.0, step)
        decrement = 0.0
        for i in range(n_free):
            decrement += b[i] * step[i]
        if not math.isfinite(decrement):
            return chi2, iteration, FAILED
        if decrement < tolerance + 1e-14 * chi2:
            return chi2, iteration, CONVERGED
        accepted = False
        while damping < 1e12:
            _solve_damped(a, b, n_free, damping, step)
            length = 0.0
            for i in range(n_free):
                length += step[i] * step[i]
            length = math.sqrt(length)
            shorten = 0.5 / length if length > 0.5 else 1.0
            norm = 0.0
            for d in range(4):
                t = q[d]
                for i in range(n_free):
                    t += shorten * step[i] * tangent[i, d]
                new_q[d] = t
                norm += t * t
            if n_free == 2:
                u2 = norm - new_q[3] * new_q[3]
                stretch = math.sqrt((1.0 - new_q[3] * new_q[3]) / u2)
                for d in range(3):
                    new_q[d] *= stretch
            else:
                norm = 1.0 / math.sqrt(norm)
                for d in range(4):
                    new_q[d] *= norm
                if abs(new_q[3]) < SMALLEST_S:
                    new_q[3] = math.copysign(SMALLEST_S, new_q[3])
            new_chi2 = _residual(
                new_q, y, sensors, channel_sensor, gain, common, shrinkage,
                new_basis, new_triangle, new_mu, new_residual,
            )  # fmt: skip
            if new_chi2 < chi2:
                accepted = True
                break
            damping = max(damping, 1e-4) * 5.0
        if not accepted:
            # No representable step decreases χ²: an optimum to rounding if the model promised next to nothing.
            return chi2, iteration, CONVERGED if decrement < 1e-6 * (1.0 + chi2) else FAILED
        # χ² falls by twice the step's product with the gradient, less its curvature: a ratio of gains of one is a model
        # that holds, a low one a step that went too far.
        promised = 0.0
        for i in range(n_free):
            t = 0.0
            for j in range(n_free):
                t += a[i, j] * shorten * step[j]
            promised += shorten * step[i] * (2.0 * b[i] - t)
        gained = chi2 - new_chi2
        if gained > 0.75 * promised:
            damping *= 0.1
        elif gained < 0.5 * promised:
            damping = max(damping, 0.1) * 3.0
        for d in range(4):
            q[d] = new_q[d]
        for d in range(3):
            mu[d] = new_mu[d]
        chi2 = new_chi2
        basis, new_basis = new_basis, basis
        residual, new_residual = new_residual, residual
    return chi2, max_iterations, FAILED


@compiled
def _scaled_covariance(
    q: FloatArray,
    mu: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Inverse information of (ρ, μ), ρ = u/s and μ scaled at s = 1, by QR of the whitened Jacobian."""
    n = channel_sensor.size
    rho, mu1 = np.empty(4), np.empty(3)
    for d in range(4):
        rho[d] = q[d] / q[3]
    inverse = 1.0 / abs(q[3]) ** 3
    for d in range(3):
        mu1[d] = mu[d] * inverse
    rows, basis, jacobian = np.empty((6, n)), np.empty((3, n)), np.empty((4, n))
    unit_basis(rho, sensors, channel_sensor, gain, common, shrinkage, basis)
    homogeneous_jacobian(rho, mu1, sensors, channel_sensor, gain, jacobian)
    _project_common(jacobian, 3, common, shrinkage)
    scale = np.empty(6)
    # Moment first: its three columns are the well-conditioned part.
    for j in range(6):
        t = 0.0
        for c in range(n):
            rows[j, c] = basis[j, c] if j < 3 else jacobian[j - 3, c]
            t += rows[j, c] * rows[j, c]
        scale[j] = math.sqrt(t)
        if not (scale[j] > 0.0 and math.isfinite(scale[j])):
            return False
        for c in range(n):
            rows[j, c] /= scale[j]
    triangle = np.zeros((6, 6))
    orthonormalise(rows, triangle)
    inverse_triangle = np.zeros((6, 6))
    for j in range(6):
        if not triangle[j, j] > 1e-13:
            return False
        inverse_triangle[j, j] = 1.0 / triangle[j, j]
        for i in range(j - 1, -1, -1):
            t = 0.0
            for k in range(i + 1, j + 1):
                t += triangle[i, k] * inverse_triangle[k, j]
            inverse_triangle[i, j] = -t / triangle[i, i]
    for i in range(6):
        for j in range(6):
            t = 0.0
            for k in range(max(i, j), 6):
                t += inverse_triangle[i, k] * inverse_triangle[j, k]
            covariance[(i + 3) % 6, (j + 3) % 6] = t / (scale[i] * scale[j])
    return True


@compiled
def _profile_end(
    q: FloatArray,
    chi2: float,
    rise: float,
    outward: bool,
    first_step: float,
    y: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
) -> float:
    """Angle α where the profile χ² has risen by `rise`; π/2 inward or -π/2 outward where it never does.

    The angle α = atan2(s, |u|) is the coordinate: π/2 at the centroid, 0 at infinity, negative beyond it on the other
    side. The direction is re-optimised at every step, starting from the step before.
    """
    mu = np.empty(3)
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
    best = np.empty(4)
    trial = np.empty(4)
    for d in range(3):
        best[d] = q[d] / norm
    alpha = math.atan2(abs(q[3]), norm)
    if q[3] < 0.0:
        for d in range(3):
            best[d] = -best[d]
    toward = -1.0 if outward else 1.0
    bound = toward * (0.5 * math.pi - SMALLEST_S)
    inside, f_inside = alpha, -rise
    step = first_step
    outside, f_outside = alpha, 0.0
    found = False
    for _ in range(60):
        outside = inside + toward * step
        if toward * (outside - bound) > 0.0:
            outside = bound
        f_outside = (
            _profile(best, trial, outside, y, sensors, channel_sensor, gain, common, shrinkage, mu) - chi2 - rise
        )
        if f_outside > 0.0:
            found = True
            break
        if outside == bound:
            break
        for d in range(3):
            best[d] = trial[d]
        inside, f_inside = outside, f_outside
        step = min(1.7 * step, LARGEST_PROFILE_STEP)
    if not found:
        return toward * 0.5 * math.pi
    for _ in range(40):
        # The profile is nearly a parabola in α: interpolate its square root, with bisection as a guard.
        a, b = math.sqrt(max(f_inside + rise, 0.0)), math.sqrt(f_outside + rise)
        t = (math.sqrt(rise) - a) / (b - a) if b > a else 0.5
        t = min(max(t, 0.05), 0.95)
        middle = inside + t * (outside - inside)
        f = _profile(best, trial, middle, y, sensors, channel_sensor, gain, common, shrinkage, mu) - chi2 - rise
        if abs(f) < 0.01 or abs(outside - inside) < 1e-4 * min(abs(inside), abs(outside)):
            return middle
        if f > 0.0:
            outside, f_outside = middle, f
        else:
            inside, f_inside = middle, max(f, -rise)
            for d in range(3):
                best[d] = trial[d]
    return inside


@compiled
def _profile(
    direction: FloatArray,
    trial: FloatArray,
    alpha: float,
    y: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    mu: FloatArray,
) -> float:
    """Smallest χ² at one α, searched from a direction; trial becomes the best direction (unit u)."""
    if abs(alpha) < SMALLEST_S:
        alpha = math.copysign(SMALLEST_S, alpha)
    q = np.empty(4)
    for d in range(3):
        q[d] = direction[d] * math.cos(alpha)
    q[3] = math.sin(alpha)
    chi2, _, _ = refine(
        q, y, sensors, channel_sensor, gain, common, shrinkage, runtime_int(2), PROFILE_TOLERANCE, runtime_int(30),
        q.reshape(1, 4), mu, runtime_int(0), mu,
    )  # fmt: skip
    for d in range(3):
        trial[d] = q[d] / math.cos(alpha)
    return chi2


@compiled
def candidate_bases(
    begin: int,
    end: int,
    candidates: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    bases: FloatArray,
) -> None:
    """Orthonormal whitened bases (n, 3, c) of candidate positions q (n, 4), rows begin to end."""
    triangle = np.zeros((3, 3))
    for i in range(begin, end):
        unit_basis(candidates[i], sensors, channel_sensor, gain, common, shrinkage, bases[i])
        orthonormalise(bases[i], triangle)


@compiled
def _pick_starts(
    y: FloatArray, bases: NDArray[np.float32], candidates: FloatArray, cos_apart: float, starts: FloatArray
) -> int:
    """Candidates that explain most of the energy of y, some angle apart on the sphere of homogeneous coordinates."""
    n = candidates.shape[0]
    components = np.zeros(3 * n, np.float32)
    for c in range(y.size):
        t = np.float32(y[c])
        for i in range(3 * n):
            components[i] += t * bases[c, i]
    score = np.empty(n, np.float32)
    for i in range(n):
        score[i] = components[i] ** 2 + components[n + i] ** 2 + components[2 * n + i] ** 2
    for k in range(starts.shape[0]):
        best = 0
        for i in range(n):
            if score[i] > score[best]:
                best = i
        if score[best] < 0.0:
            return k
        for d in range(4):
            starts[k, d] = candidates[best, d]
        q0, q1, q2, q3 = starts[k]
        for i in range(n):
            t = candidates[i, 0] * q0 + candidates[i, 1] * q1 + candidates[i, 2] * q2 + candidates[i, 3] * q3
            if abs(t) > cos_apart:
                score[i] = -1.0
    return int(starts.shape[0])


@compiled
def _gaussian_step(q: FloatArray, covariance: FloatArray, rise: float) -> float:
    """Step in α where a Gaussian profile would rise by `rise`: dα = dρ / (1 + ρ²)."""
    rho = np.empty(3)
    rho2 = 0.0
    for d in range(3):
        rho[d] = q[d] / q[3]
        rho2 += rho[d] * rho[d]
    variance = 0.0
    for i in range(3):
        for j in range(3):
            variance += rho[i] * covariance[i, j] * rho[j]
    sigma = math.sqrt(max(variance, 0.0) / max(rho2, 1e-300))
    return min(max(math.sqrt(rise) * sigma / (1.0 + rho2), 1e-9), 0.2)


@compiled
def _search_row(
    y: FloatArray,
    ranked: FloatArray,
    bases: NDArray[np.float32],
    candidates: FloatArray,
    first: FloatArray,
    cos_apart: float,
    keep_within: float,
    max_iterations: int,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    out_q: FloatArray,
    out_mu: FloatArray,
    out_chi2: FloatArray,
    out_iterations: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Distinct optima of one row into the outputs, best first; counts as in :func:`search_rows`."""
    n_starts, n_first = out_chi2.size, first.shape[0]
    starts = np.empty((n_starts, 4))
    moments = np.empty((n_starts, 3))
    chi2 = np.empty(n_starts)
    iterations = np.empty(n_starts, np.int64)
    for k in range(n_first):
        for d in range(4):
            starts[k, d] = first[k, d]
    n = n_first + _pick_starts(ranked, bases, candidates, cos_apart, starts[n_first:])
    found = runtime_int(0)
    counts[1] = counts[2] = 0
    for k in range(n):
        # The optima found so far fill the places of the starts that led to them.
        for d in range(4):
            starts[found, d] = starts[k, d]
        chi2[found], iterations[found], end = refine(
            starts[found], y, sensors, channel_sensor, gain, common, shrinkage, runtime_int(3),
            OPTIMUM_TOLERANCE, max_iterations, starts, chi2, found, moments[found],
        )  # fmt: skip
        counts[2] += iterations[found]
        if end == FAILED:
            counts[1] += 1
        elif end == CONVERGED:
            known = False
            for j in range(found):
                known = known or same_optimum(starts[found], chi2[found], starts[j], chi2[j])
            if not known:
                found += 1
    kept = 0
    best = math.inf
    while kept < found:
        k = 0
        for i in range(1, found):
            if chi2[i] < chi2[k]:
                k = i
        best = min(best, chi2[k])
        if chi2[k] > best + keep_within or chi2[k] == math.inf:
            break
        for d in range(4):
            out_q[kept, d] = starts[k, d]
        for d in range(3):
            out_mu[kept, d] = moments[k, d]
        out_chi2[kept] = chi2[k]
        out_iterations[kept] = iterations[k]
        chi2[k] = math.inf
        kept += 1
    counts[0] = kept


@compiled
def search_rows(
    begin: int,
    end: int,
    y: FloatArray,
    ranked: FloatArray,
    reading_of_row: NDArray[np.intp],
    bases: NDArray[np.float32],
    candidates: FloatArray,
    first: FloatArray,
    cos_apart: float,
    keep_within: float,
    max_iterations: int,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    set_of_row: NDArray[np.intp],
    out_q: FloatArray,
    out_mu: FloatArray,
    out_chi2: FloatArray,
    out_iterations: NDArray[np.int64],
    counts: NDArray[np.int64],
) -> None:
    """Distinct optima of rows begin to end, best first; for :func:`magloc.kernels.over_rows`.

    y (readings, c) are whitened readings, reading_of_row which of them a row has; ranked (readings, c) the same ones
    under the whitening of bases (c, 3 · candidates), the candidates' orthonormal bases in single precision, which ranks
    them as well; first (rows, f, 4) are starts of a row's own, refined before the best candidates; gain (sets, c, 3),
    common (sets, q, c), shrinkage (sets, q) the whitening, set_of_row which of them a row has. Into the outputs
    (rows, starts, …): q, mu, χ², linearisations; counts (rows, 3) are the optima kept, the starts that did not
    converge, and all linearisations.
    """
    for row in range(begin, end):
        w, r = set_of_row[row], reading_of_row[row]
        _search_row(
            y[r], ranked[r], bases, candidates, first[row], cos_apart, keep_within, max_iterations,
            sensors, channel_sensor, gain[w], common[w], shrinkage[w],
            out_q[row], out_mu[row], out_chi2[row], out_iterations[row], counts[row],
        )  # fmt: skip


@compiled
def covariance_rows(
    begin: int,
    end: int,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    set_of_row: NDArray[np.intp],
    q: FloatArray,
    mu: FloatArray,
    counts: NDArray[np.int64],
    out_covariance: FloatArray,
) -> None:
    """Scaled covariances of the optima of :func:`search_rows`, rows begin to end, into (rows, starts, 6, 6).

    They are left as they are where the information is singular.
    """
    for row in range(begin, end):
        w = set_of_row[row]
        for j in range(counts[row, 0]):
            _scaled_covariance(
                q[row, j], mu[row, j], sensors, channel_sensor, gain[w], common[w], shrinkage[w], out_covariance[row, j]
            )


@compiled
def profile_rows(
    begin: int,
    end: int,
    y: FloatArray,
    rise: FloatArray,
    sensors: FloatArray,
    channel_sensor: NDArray[np.intp],
    gain: FloatArray,
    common: FloatArray,
    shrinkage: FloatArray,
    set_of_row: NDArray[np.intp],
    q: FloatArray,
    chi2: FloatArray,
    counts: NDArray[np.int64],
    covariance: FloatArray,
    out_alpha: FloatArray,
) -> None:
    """Ends of the profiles of the optima of :func:`search_rows`, rows begin to end, into (rows, starts, 2).

    rise (rows,) is how far they may rise above the χ² of a row's first optimum. The least and the largest α of every
    optimum are left as they are where its own χ² is higher than that, or where rise is infinite: then nothing bounds
    the range. The scaled covariances serve for the first steps.
    """
    for row in range(begin, end):
        w = set_of_row[row]
        for j in range(counts[row, 0]):
            left = rise[row] - (chi2[row, j] - chi2[row, 0])
            if not (left > 0.0 and math.isfinite(left)):
                continue
            first_step = _gaussian_step(q[row, j], covariance[row, j], left)
            if not math.isfinite(first_step):
                first_step = 0.05
            for side in range(2):
                out_alpha[row, j, side] = _profile_end(
                    q[row, j], chi2[row, j], left, side == 0, first_step, y[row],
                    sensors, channel_sensor, gain[w], common[w], shrinkage[w],
                )  # fmt: skip
