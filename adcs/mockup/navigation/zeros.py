"""Zeros of the accelerometer in closed form, from the integral of its readings and the camera over a run.

See docs/theory/tabletop-navigation.md. Source: Bindel et al., section on least squares (a minus sign is missing in
print). Ours: complex numbers, the fitted start, and further courses of the zeros.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from adcs.mockup.navigation.fixes import FixRecord
from adcs.mockup.navigation.strapdown import ImuRecord, PlanarState, wrapped
from adcs.mockup.vision.similarity import complex_points, pairs_of
from arrays.typing import ComplexArray, FloatArray

SIGMA_M = 1e-3
"""Standard deviation of the camera's fixes, each axis."""


def double_integral(begin_s: float, time_s: ArrayLike, values: ArrayLike, at_s: ArrayLike) -> ComplexArray:
    r"""Integrate twice from rest, :math:`\sum_j u_j Δ_j (t - \tfrac12(t_j + t_{j-1}))`, in O(n).

    ``begin_s``: beginning of the first interval. ``time_s`` (n,): end of each interval. ``values`` (..., n): constant
    over each interval. ``at_s`` (k,): times within the record; the last interval is integrated up to them. Returns
    (..., k).
    """
    t = np.asarray(time_s, dtype=np.float64) - begin_s
    u = np.asarray(values, dtype=np.complex128)
    at = np.asarray(at_s, dtype=np.float64) - begin_s
    if at.size and not (at.min() >= 0.0 and at.max() <= t[-1]):
        raise ValueError(
            f"Input at_s must be within {begin_s:.6g} to {begin_s + t[-1]:.6g} s; "
            f"instead received {begin_s + at.min():.6g} to {begin_s + at.max():.6g} s."
        )
    edges = np.concatenate([[0.0], t])
    gained = u * np.diff(edges)
    lead = np.zeros((*u.shape[:-1], 1), dtype=np.complex128)
    speed = np.concatenate([lead, np.cumsum(gained, axis=-1)], axis=-1)
    moment = np.concatenate([lead, np.cumsum(gained * 0.5 * (edges[1:] + edges[:-1]), axis=-1)], axis=-1)
    row = np.clip(np.searchsorted(edges, at, side="right") - 1, 0, t.size - 1)
    return at * speed[..., row] - moment[..., row] + 0.5 * u[..., row] * (at - edges[row]) ** 2


def heading_from_fixes(imu: ImuRecord, fixes: FixRecord) -> tuple[FloatArray, float]:
    """Return the heading of the gyro midway in each interval, with start and zero fitted to the camera.

    Parameters
    ----------
    imu : ImuRecord
        Samples of one run without missing readings.
    fixes : FixRecord
        At least two fixes with exposures within the record.

    Returns
    -------
    heading_rad : ndarray, shape (n,)
        Heading, counter-clockwise.
    zero_rad_s : float
        Zero of the gyro.

    Raises
    ------
    ValueError
        There are fewer than two fixes.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> heading_rad, zero_rad_s = mockup.heading_from_fixes(run.imu, run.fixes)
    >>> heading_rad.shape
    (500,)
    """
    if len(fixes) < 2:
        raise ValueError(f"Input fixes must be two at least; instead received {len(fixes)}.")
    angle = imu.rate_rad_s * imu.steps_s
    turned_by = np.cumsum(angle)
    edges = np.concatenate([[imu.begin_s], imu.time_s])
    t = fixes.time_s - imu.begin_s
    misfit = fixes.heading_rad - np.interp(fixes.time_s, edges, np.concatenate([[0.0], turned_by]))
    # Relative to the first one, so that misfits near half a turn do not jump by a turn.
    misfit = misfit[0] + wrapped(misfit - misfit[0])
    zero, start = np.linalg.lstsq(np.stack([-t, np.ones(t.size)], axis=1), misfit, rcond=None)[0]
    middle: FloatArray = start + turned_by - 0.5 * angle - zero * (imu.time_s - 0.5 * imu.steps_s - imu.begin_s)
    return middle, float(zero)


@dataclass(frozen=True, eq=False)
class ZeroProblem:
    """Input of the fits at the exposures of k fixes; table axes as complex numbers.

    Attributes
    ----------
    time_s : ndarray, shape (k,)
        Times since the beginning of the record.
    moved : ndarray of complex, shape (k,)
        Double integral D[a e^{iφ}] of the readings [m].
    by_zero : ndarray of complex, shape (m, k)
        Double integral D[s e^{iφ}] for each course s of a zero [s²]; the first course is constant.
    measured : ndarray of complex, shape (k,)
        Positions of the fixes [m].

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> heading_rad, _ = mockup.heading_from_fixes(run.imu, run.fixes)
    >>> problem = mockup.zero_problem(run.imu, heading_rad, run.fixes)
    >>> len(problem.time_s) == len(run.fixes)
    True
    """

    time_s: FloatArray
    moved: ComplexArray
    by_zero: ComplexArray
    measured: ComplexArray


def zero_problem(
    imu: ImuRecord, heading_rad: ArrayLike, fixes: FixRecord, courses: ArrayLike | None = None
) -> ZeroProblem:
    """Prepare the input of the fits.

    Parameters
    ----------
    imu : ImuRecord
        Samples of one run without missing readings.
    heading_rad : array_like, shape (n,)
        Heading in the middle of each interval, from :func:`heading_from_fixes` or a filter.
    fixes : FixRecord
        Fixes with exposures within the record.
    courses : array_like, shape (m, n), optional
        Courses of further zeros, such as the time or the temperature since the beginning.

    Returns
    -------
    ZeroProblem
        Input of :func:`zeros_and_start`.

    Raises
    ------
    ValueError
        The shapes do not match, readings are missing, or an exposure is outside of the record.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> heading_rad, _ = mockup.heading_from_fixes(run.imu, run.fixes)
    >>> problem = mockup.zero_problem(run.imu, heading_rad, run.fixes)
    >>> len(problem.time_s) == len(run.fixes)
    True
    """
    n = len(imu)
    heading = np.asarray(heading_rad, dtype=np.float64)
    further = np.empty((0, n)) if courses is None else np.asarray(courses, dtype=np.float64)
    if heading.shape != (n,):
        raise ValueError(f"Input heading_rad must have shape ({n},); instead received {heading.shape}.")
    if further.ndim != 2 or further.shape[1] != n:
        raise ValueError(f"Input courses must have shape (m, {n}); instead received {further.shape}.")
    if not np.isfinite(imu.acceleration_m_s2).all():
        raise ValueError(
            "Input imu must have all readings; instead received missing ones. Fill them by "
            "adcs.mockup.navigation.strapdown.hold."
        )
    turn = np.exp(1j * heading)
    values = np.concatenate([[complex_points(imu.acceleration_m_s2) * turn, turn], further * turn])
    integrals = double_integral(imu.begin_s, imu.time_s, values, fixes.time_s)
    return ZeroProblem(fixes.time_s - imu.begin_s, integrals[0], integrals[1:], complex_points(fixes.position_m))


@dataclass(frozen=True, eq=False)
class ZeroFit:
    """Fitted zeros and start of a run.

    Attributes
    ----------
    zeros : ndarray, shape (m, 2)
        Zeros along body x and y: the constant ones [m/s²], then those of each course [m/s² per its unit].
    start_position_m, start_velocity_m_s : ndarray, shape (2,)
        State at the beginning of the record, table axes.
    covariance : ndarray
        Covariance of the zeros and, if fitted, of position and velocity, two rows each.
    residual_rms_m : float
        Distance between integrated position and fix, rms.
    """

    zeros: FloatArray
    start_position_m: FloatArray
    start_velocity_m_s: FloatArray
    covariance: FloatArray
    residual_rms_m: float

    @property
    def zero_m_s2(self) -> FloatArray:
        """Constant zeros, shape (2,)."""
        return self.zeros[0]

    def zero_course(self, courses: ArrayLike | None = None) -> FloatArray:
        """Return the zeros (n, 2) of each sample for the problem's courses (m, n), or (2,) without courses."""
        if courses is None:
            return self.zeros[0]
        return self.zeros[0] + np.asarray(courses, dtype=np.float64).T @ self.zeros[1:]

    def start(self, heading_rad: float) -> PlanarState:
        """Return the state at the beginning of the record, with a heading."""
        return PlanarState(self.start_position_m, self.start_velocity_m_s, heading_rad)


def constant_zeros_after(problem: ZeroProblem, first: int = 4, sigma_m: float = SIGMA_M) -> ZeroFit:
    """Fit two zeros in closed form, with the start of a straight line through the first fixes.

    The line fits the fixes minus the motion by the samples, which depends on the zeros.
    ``problem``: problem with constant zeros only. ``first``: number of fixes on the line; two as in the source, where
    the velocity has √2 times the noise of a fix over one period. ``sigma_m``: noise of a fix, each axis, for the
    covariance.
    """
    if len(problem.by_zero) != 1:
        further = len(problem.by_zero) - 1
        raise ValueError(f"Input problem must have constant zeros only; instead received {further} more for each axis.")
    turn, t = problem.by_zero[0], problem.time_s
    if not 2 <= first < t.size:
        raise ValueError(f"Input first must be 2 or more and less than the {t.size} fixes; instead received {first}.")
    middle = t[:first].mean()
    weight = (t[:first] - middle) / np.sum((t[:first] - middle) ** 2)
    line = 1.0 / first + np.outer(t - middle, weight)  # derivative of the line at each instant by the first fixes
    rest = problem.measured - problem.moved
    g, y = turn - line @ turn[:first], rest - line @ rest[:first]
    a11 = float(np.sum(np.abs(g) ** 2))
    zeta = -np.sum(g.conj() * y) / a11
    start = rest[:first] + zeta * turn[:first]
    v0 = np.sum(weight * start)
    by_fix = g.conj()
    by_fix[:first] -= g.conj() @ line
    variance = sigma_m**2 * float(np.sum(np.abs(by_fix) ** 2)) / a11**2
    return ZeroFit(
        pairs_of(zeta[None]),
        pairs_of(start.mean() - v0 * middle),
        pairs_of(v0),
        variance * np.eye(2),
        _rms(y + zeta * g),
    )


def zeros_and_start(problem: ZeroProblem, sigma_m: float = SIGMA_M) -> ZeroFit:
    """Fit zeros of all courses, start position and velocity: six unknowns with constant zeros.

    Parameters
    ----------
    problem : ZeroProblem
        Result of :func:`zero_problem`.
    sigma_m : float
        Standard deviation of a fix, each axis, for the covariance.

    Returns
    -------
    ZeroFit
        Zeros, start position and start velocity with their covariance.

    Raises
    ------
    ValueError
        The fixes do not determine the unknowns: too few, or too close in time.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> heading_rad, _ = mockup.heading_from_fixes(run.imu, run.fixes)
    >>> problem = mockup.zero_problem(run.imu, heading_rad, run.fixes)
    >>> mockup.zeros_and_start(problem).zero_m_s2.shape
    (2,)
    """
    t, m = problem.time_s, len(problem.by_zero)
    A = np.stack([*(-problem.by_zero), np.ones(t.size, dtype=np.complex128), t.astype(np.complex128)], axis=1)
    size = np.linalg.norm(A, axis=0)
    if t.size < A.shape[1] or not (size > 0.0).all() or np.linalg.matrix_rank(A / size) < A.shape[1]:
        raise ValueError(
            f"Input problem must have fixes that determine {A.shape[1]} complex unknowns; "
            f"instead received {t.size} that do not."
        )
    q, r = np.linalg.qr(A / size)
    unknown = np.linalg.solve(r, q.conj().T @ (problem.measured - problem.moved)) / size
    residual = problem.moved + A @ unknown - problem.measured
    inverse = np.linalg.inv(r) / size[:, None]
    covariance = _real_covariance(sigma_m**2 * (inverse @ inverse.conj().T))
    return ZeroFit(pairs_of(unknown[:m]), pairs_of(unknown[m]), pairs_of(unknown[m + 1]), covariance, _rms(residual))


def _rms(residual: ComplexArray) -> float:
    return float(np.sqrt(np.mean(np.abs(residual) ** 2)))


def _real_covariance(C: ComplexArray) -> FloatArray:
    """Return the covariance of alternating real and imaginary parts.

    Equal noise along both axes makes blocks [[R, -I], [I, R]].
    """
    m = len(C)
    blocks = np.stack([np.stack([C.real, -C.imag], axis=-1), np.stack([C.imag, C.real], axis=-1)], axis=-2)
    return blocks.transpose(0, 2, 1, 3).reshape(2 * m, 2 * m)
