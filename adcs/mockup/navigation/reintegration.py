"""Fusion of delayed fixes by re-integration, as in the source, and two estimates without fusion.

See docs/theory/tabletop-navigation.md.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from adcs.mockup.navigation.fixes import FixOutcome, PlanarFix
from adcs.mockup.navigation.strapdown import Gate, ImuRecord, PlanarState, PlanarTrack, hold, strapdown, wrapped
from arrays.typing import FloatArray

VelocityRule = Callable[[PlanarFix, PlanarFix, ImuRecord], FloatArray]
"""Velocity (2,) at the exposure of the second of two fixes, from both and the samples between them."""


def finite_difference(first: PlanarFix, second: PlanarFix, imu: ImuRecord) -> FloatArray:
    """Return the source's velocity, (p₂ - p₁)/(t₂ - t₁), which is the velocity midway between both fixes.

    Parameters
    ----------
    first, second : PlanarFix
        Consecutive fixes.
    imu : ImuRecord
        Samples between both fixes; not used.

    Returns
    -------
    ndarray, shape (2,)
        Velocity, table axes [m/s].

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> first, second = run.fixes[0], run.fixes[1]
    >>> imu = run.imu.between(first.time_s, second.time_s)
    >>> mockup.finite_difference(first, second, imu).shape
    (2,)
    """
    return (second.position_m - first.position_m) / (second.time_s - first.time_s)


def corrected_velocity(first: PlanarFix, second: PlanarFix, imu: ImuRecord) -> FloatArray:
    r"""Return the velocity at the second exposure, :math:`(p_2 - p_1 - Δp_{imu})/(t_2 - t_1) + Δv_{imu}`.

    Δp and Δv are the integrals of the samples from rest at the first fix's heading.

    Parameters
    ----------
    first, second : PlanarFix
        Consecutive fixes.
    imu : ImuRecord
        Samples between both fixes.

    Returns
    -------
    ndarray, shape (2,)
        Velocity, table axes [m/s].

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> first, second = run.fixes[0], run.fixes[1]
    >>> imu = run.imu.between(first.time_s, second.time_s)
    >>> mockup.corrected_velocity(first, second, imu).shape
    (2,)
    """
    moved = strapdown(imu, PlanarState(np.zeros(2), np.zeros(2), first.heading_rad))
    mean: FloatArray = (second.position_m - first.position_m - moved.position_m[-1]) / (second.time_s - first.time_s)
    return mean + moved.velocity_m_s[-1]


class Reintegration:
    """Fusion that integrates again from the exposure of each fix.

    - The first fix, and a fix after a gap longer than ``longest_gap_s``, keeps the velocity of the estimate at its
      exposure.
    - A fix with an exposure before the last used one is ignored (stale), also one with the same exposure (duplicate).
    - The buffer of samples is ``buffer_s`` long; a fix older than that is ignored.

    Parameters
    ----------
    start : PlanarState
        State at ``begin_s``.
    begin_s : float
        Beginning of the first sample.
    velocity : callable
        :func:`finite_difference` as in the source, or :func:`corrected_velocity`.
    gate : Gate
        Limits of the samples.
    longest_gap_s : float
        Longest time between two fixes that determine a velocity; the source's slowest fix is 2.7 s late.
    buffer_s : float
        Length of the buffer of samples.

    Attributes
    ----------
    state : PlanarState
        Estimate at the last sample.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> method = mockup.Reintegration(run.start, run.imu.begin_s)
    >>> len(mockup.fuse(method, run.imu, run.fixes).track)
    500
    """

    def __init__(
        self,
        start: PlanarState,
        begin_s: float,
        velocity: VelocityRule = finite_difference,
        *,
        gate: Gate = Gate(),  # noqa: B008 - frozen
        longest_gap_s: float = 3.0,
        buffer_s: float = 10.0,
    ) -> None:
        self.state = start
        self._velocity, self._gate = velocity, gate
        self._longest_gap_s, self._buffer_s = longest_gap_s, buffer_s
        self._samples = ImuRecord(begin_s, np.empty(0), np.empty((0, 2)), np.empty(0))
        self._oldest = start
        self._rate_rad_s = 0.0
        self._last: PlanarFix | None = None

    def add_samples(self, imu: ImuRecord) -> PlanarTrack:
        """Integrate some samples.

        Parameters
        ----------
        imu : ImuRecord
            Samples of one run, which begin at the end of the last ones.

        Returns
        -------
        PlanarTrack
            Estimate at the end of each sample.

        Raises
        ------
        ValueError
            The samples begin elsewhere.
        """
        believed = hold(imu, self._gate.accept(imu), self._rate_rad_s)
        samples = self._samples.concatenate(believed)
        track = strapdown(believed, self.state)
        if len(imu):
            self._samples, self.state = samples, track.state(-1)
            self._rate_rad_s = float(believed.rate_rad_s[-1])
        self._forget_before(self._samples.end_s - self._buffer_s)
        return track

    def add_fix(self, fix: PlanarFix) -> FixOutcome:
        """Set the state at the exposure to a fix, and integrate again from there.

        Parameters
        ----------
        fix : PlanarFix
            Fix with an exposure before the last sample.

        Returns
        -------
        FixOutcome
            The state has changed only if it is USED.
        """
        if fix.time_s > self._samples.end_s:
            return FixOutcome.AHEAD
        if self._last is not None and fix.time_s <= self._last.time_s:
            return FixOutcome.DUPLICATE if fix.time_s == self._last.time_s else FixOutcome.STALE
        if fix.time_s < self._samples.begin_s:
            return FixOutcome.TOO_OLD
        before = self._state_at(fix.time_s)
        last, velocity = self._last, before.velocity_m_s
        if last is not None and last.time_s >= max(self._samples.begin_s, fix.time_s - self._longest_gap_s):
            velocity = self._velocity(last, fix, self._samples.between(last.time_s, fix.time_s))
        heading = before.heading_rad + float(wrapped(fix.heading_rad - before.heading_rad))
        self._oldest = self.state = PlanarState(fix.position_m, velocity, heading)
        self._samples = self._samples.between(fix.time_s, self._samples.end_s)
        if len(self._samples):
            self.state = strapdown(self._samples, self._oldest).state(-1)
        self._last = fix
        return FixOutcome.USED

    def _state_at(self, time_s: float) -> PlanarState:
        samples = self._samples.between(self._samples.begin_s, time_s)
        return strapdown(samples, self._oldest).state(-1) if len(samples) else self._oldest

    def _forget_before(self, time_s: float) -> None:
        if time_s > self._samples.begin_s:
            self._oldest = self._state_at(time_s)
            self._samples = self._samples.between(time_s, self._samples.end_s)


class CameraOnly:
    """Estimate from the last fix alone, held constant, with the velocity between the last two fixes.

    Parameters
    ----------
    start : PlanarState
        State until the first fix.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> method = mockup.CameraOnly(run.start)
    >>> len(mockup.fuse(method, run.imu, run.fixes).track)
    500
    """

    def __init__(self, start: PlanarState) -> None:
        self.state = start
        self._last: PlanarFix | None = None

    def add_samples(self, imu: ImuRecord) -> PlanarTrack:
        """Hold the state, whatever the samples.

        Parameters
        ----------
        imu : ImuRecord
            Samples, of which only the times count.

        Returns
        -------
        PlanarTrack
            The same state at each sample.
        """
        n, state = len(imu), self.state
        position, velocity = np.tile(state.position_m, (n, 1)), np.tile(state.velocity_m_s, (n, 1))
        return PlanarTrack(imu.time_s, position, velocity, np.full(n, state.heading_rad))

    def add_fix(self, fix: PlanarFix) -> FixOutcome:
        """Replace the state by a fix, unless it is older than the last one.

        Parameters
        ----------
        fix : PlanarFix
            Fix that arrives.

        Returns
        -------
        FixOutcome
            USED, STALE or DUPLICATE.
        """
        velocity = self.state.velocity_m_s
        if self._last is not None:
            if fix.time_s <= self._last.time_s:
                return FixOutcome.DUPLICATE if fix.time_s == self._last.time_s else FixOutcome.STALE
            velocity = (fix.position_m - self._last.position_m) / (fix.time_s - self._last.time_s)
        heading = self.state.heading_rad + float(wrapped(fix.heading_rad - self.state.heading_rad))
        self.state = PlanarState(fix.position_m, velocity, heading)
        self._last = fix
        return FixOutcome.USED


class ImuOnly:
    """Estimate from the samples alone; fixes are ignored.

    Parameters
    ----------
    start : PlanarState
        State at the beginning of the first sample.
    gate : Gate
        Limits of the samples.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> method = mockup.ImuOnly(run.start)
    >>> len(mockup.fuse(method, run.imu, run.fixes).track)
    500
    """

    def __init__(self, start: PlanarState, gate: Gate = Gate()) -> None:  # noqa: B008 - frozen
        self.state = start
        self._gate = gate
        self._rate_rad_s = 0.0

    def add_samples(self, imu: ImuRecord) -> PlanarTrack:
        """Integrate some samples.

        Parameters
        ----------
        imu : ImuRecord
            Samples of one run.

        Returns
        -------
        PlanarTrack
            Estimate at the end of each sample.
        """
        believed = hold(imu, self._gate.accept(imu), self._rate_rad_s)
        track = strapdown(believed, self.state)
        if len(imu):
            self.state, self._rate_rad_s = track.state(-1), float(believed.rate_rad_s[-1])
        return track

    def add_fix(self, fix: PlanarFix) -> FixOutcome:
        """Ignore a fix.

        Parameters
        ----------
        fix : PlanarFix
            Fix that arrives.

        Returns
        -------
        FixOutcome
            UNUSED.
        """
        return FixOutcome.UNUSED
