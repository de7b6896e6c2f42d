"""Delayed camera fixes, and the order in which samples and fixes arrive.

The time stamp of a fix is the time of its exposure. A fix arrives when its image has been processed and sent. Fixes may
overtake each other, arrive twice, or be lost. The source stamps them on arrival, which is equivalent only if each
exposure begins when the fix before it arrives: one failed frame breaks that.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from adcs.mockup.navigation.strapdown import ImuRecord, PlanarTrack
from arrays.typing import BoolArray, FloatArray


@dataclass(frozen=True, eq=False)
class PlanarFix:
    """Position and heading from one image.

    Attributes
    ----------
    time_s : float
        Time of the exposure.
    position_m : ndarray, shape (2,)
        X and Y, table axes.
    heading_rad : float
        Heading, counter-clockwise, of any number of turns.
    sigma : ndarray, shape (3,), optional
        Standard deviations of X, Y [m] and heading [rad], if known.
    """

    time_s: float
    position_m: FloatArray
    heading_rad: float
    sigma: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class FixRecord:
    """Fixes in the order of their arrival.

    Attributes
    ----------
    time_s : ndarray, shape (k,)
        Times of the exposures, in any order.
    arrival_s : ndarray, shape (k,)
        Times of arrival, ascending and not before the exposure.
    position_m : ndarray, shape (k, 2)
        X and Y, table axes.
    heading_rad : ndarray, shape (k,)
        Headings, counter-clockwise.
    sigma : ndarray, shape (k, 3), optional
        Standard deviations of X, Y [m] and heading [rad] of each fix, if known.

    Raises
    ------
    ValueError
        The shapes do not match, a number is not finite, a standard deviation is not positive, arrivals go back, or a
        fix arrives before its exposure.
    """

    time_s: FloatArray
    arrival_s: FloatArray
    position_m: FloatArray
    heading_rad: FloatArray
    sigma: FloatArray | None = None

    def __post_init__(self) -> None:
        k = np.shape(self.time_s)[0] if np.ndim(self.time_s) else -1
        shapes = {"time_s": (k,), "arrival_s": (k,), "position_m": (k, 2), "heading_rad": (k,)}
        for name, shape in (shapes if self.sigma is None else shapes | {"sigma": (k, 3)}).items():
            values = np.asarray(getattr(self, name), dtype=np.float64)
            if values.shape != shape:
                expected = "(k,)" if k < 0 else str(shape)
                raise ValueError(f"Input {name} must have shape {expected}; instead received {values.shape}.")
            if not np.isfinite(values).all():
                raise ValueError(f"Input {name} must be finite; instead received a number that is not.")
            object.__setattr__(self, name, values)
        if self.sigma is not None and not (self.sigma > 0.0).all():
            raise ValueError(f"Input sigma must be positive; instead received {self.sigma.min():.6g}.")
        back = np.flatnonzero(np.diff(self.arrival_s) < 0.0)
        if back.size:
            before, after = self.arrival_s[back[0]], self.arrival_s[back[0] + 1]
            raise ValueError(
                f"Input arrival_s must not go back; instead received {after:.6g} s after {before:.6g} s "
                f"(fix {back[0] + 1})."
            )
        early = np.flatnonzero(self.arrival_s < self.time_s)
        if early.size:
            raise ValueError(
                "Input arrival_s must not be before the exposure; instead received "
                f"{self.arrival_s[early[0]]:.6g} s for an exposure at {self.time_s[early[0]]:.6g} s (fix {early[0]})."
            )

    def __len__(self) -> int:
        """Return the number of fixes."""
        return self.time_s.size

    def __getitem__(self, row: int) -> PlanarFix:
        """Return one fix."""
        sigma = None if self.sigma is None else self.sigma[row]
        return PlanarFix(float(self.time_s[row]), self.position_m[row], float(self.heading_rad[row]), sigma)

    def rows(self, rows: slice | BoolArray | NDArray[np.intp]) -> FixRecord:
        """Select some of the fixes."""
        return FixRecord(**self._columns(rows))

    def _columns(self, rows: slice | BoolArray | NDArray[np.intp]) -> dict[str, Any]:
        return {name: None if values is None else values[rows] for name, values in vars(self).items()}

    def in_time_order(self) -> FixRecord:
        """Return the fixes sorted by exposure and without delay."""
        columns = self._columns(np.argsort(self.time_s, kind="stable"))
        return FixRecord(**columns | {"arrival_s": columns["time_s"]})

    def earlier(self, latency_s: float) -> FixRecord:
        """Return the fixes with time stamps reduced by the camera's latency."""
        return replace(self, time_s=self.time_s - latency_s)


class FixOutcome(enum.Enum):
    """Outcome of a fix."""

    USED = "used"
    REJECTED = "rejected"
    """The fix contradicts the estimate and fails the gate."""
    REACQUIRED = "reacquired"
    """The fix agrees with the rejected fixes before it: they replace the estimate."""
    DUPLICATE = "duplicate"
    STALE = "stale"
    """A later exposure has been used, and the method cannot go back before it."""
    TOO_OLD = "too old"
    """The samples since its exposure are no longer in the buffer."""
    AHEAD = "ahead"
    """The samples do not reach its exposure yet."""
    UNUSED = "unused"
    """The method uses no fixes."""


class Fusion(Protocol):
    """Interface of fusion methods: samples and fixes as they arrive."""

    def add_samples(self, imu: ImuRecord) -> PlanarTrack:
        """Process consecutive samples; return the estimate at each of them."""

    def add_fix(self, fix: PlanarFix) -> FixOutcome:
        """Update the estimate at the last sample by a fix."""


@dataclass(frozen=True, eq=False)
class Fused:
    """Estimates at each sample with the data available then.

    Attributes
    ----------
    track : PlanarTrack
        Estimate at the end of each sample; a fix that arrives just then is used from the next sample on.
    outcomes : tuple of FixOutcome
        Outcome of each fix, in the order of arrival.
    """

    track: PlanarTrack
    outcomes: tuple[FixOutcome, ...]

    @property
    def used(self) -> BoolArray:
        """Mask (k,) of the used fixes."""
        return np.array([outcome in _TAKEN for outcome in self.outcomes], dtype=np.bool_)


_TAKEN = (FixOutcome.USED, FixOutcome.REACQUIRED)


def unused_counts(outcomes: Sequence[FixOutcome]) -> dict[str, int]:
    """Return the number of unused fixes by reason in words, also for reasons without fixes."""
    return {reason.value: outcomes.count(reason) for reason in FixOutcome if reason not in _TAKEN}


def counts_in_words(used: int, unused: Mapping[str, int]) -> str:
    """Return the numbers of fixes by outcome in words: "187 used, 75 too old".

    ``unused``: result of :func:`unused_counts`; reasons without fixes are omitted.
    """
    return ", ".join([f"{used} used", *(f"{count} {reason}" for reason, count in unused.items() if count)])


def fuse(fusion: Fusion, imu: ImuRecord, fixes: FixRecord) -> Fused:
    """Run a fusion method on a record's samples and fixes in the order of their arrival.

    A fix that arrives before the sample of its exposure ends waits for that end.

    Parameters
    ----------
    fusion : Fusion
        Fusion method with its state at ``imu.begin_s``.
    imu : ImuRecord
        Samples of one run, at least one.
    fixes : FixRecord
        Fixes; those that arrive after the last sample are ignored.

    Returns
    -------
    Fused
        Track of the type that the method returns, and the outcome of each fix.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), rng=0)
    >>> method = mockup.DelayedFilter(run.start, run.imu.begin_s)
    >>> fused = mockup.fuse(method, run.imu, run.fixes)
    >>> fused.track.position_m.shape
    (500, 2)
    """
    tracks: list[PlanarTrack] = []
    outcomes: list[FixOutcome] = []
    done = 0
    exposed = np.searchsorted(imu.time_s, fixes.time_s) + 1
    rows = np.maximum(np.searchsorted(imu.time_s, fixes.arrival_s, side="right"), exposed)
    for k in np.flatnonzero(fixes.arrival_s <= imu.end_s):
        if rows[k] > done:
            tracks.append(fusion.add_samples(imu.part(done, int(rows[k]))))
            done = int(rows[k])
        outcomes.append(fusion.add_fix(fixes[int(k)]))
    tracks.append(fusion.add_samples(imu.part(done, len(imu))))
    return Fused(join_tracks(tracks), tuple(outcomes))


def join_tracks(tracks: list[PlanarTrack]) -> PlanarTrack:
    """Join consecutive tracks of one run."""
    kind = type(tracks[0])
    return kind(**{name: np.concatenate([getattr(track, name) for track in tracks]) for name in vars(tracks[0])})
