"""Camera fixes that arrive late, and how samples and fixes reach whatever fuses them.

A fix is stamped with the time of its exposure; it arrives when the image has been processed and sent. Fixes may pass
one another, come twice, or stay out. The source stamps them on arrival, which is the same only while each exposure
begins on the arrival of the fix before: one failed frame breaks that.
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
class Fix:
    """Position and heading from one image.

    Attributes
    ----------
    time_s : float
        Of the exposure.
    position_m : ndarray, shape (2,)
    heading_rad : float
        Counter-clockwise, of any number of turns.
    sigma : ndarray, shape (3,), optional
        Standard deviations of X, Y [m] and heading [rad], where they are known.
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
        Of the exposures, in any order.
    arrival_s : ndarray, shape (k,)
        Not before the exposure.
    position_m : ndarray, shape (k, 2)
    heading_rad : ndarray, shape (k,)
    sigma : ndarray, shape (k, 3), optional
        Standard deviations of X, Y [m] and heading [rad] of every fix, where they are known.

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

    def __getitem__(self, row: int) -> Fix:
        """One fix."""
        sigma = None if self.sigma is None else self.sigma[row]
        return Fix(float(self.time_s[row]), self.position_m[row], float(self.heading_rad[row]), sigma)

    def rows(self, rows: slice | BoolArray | NDArray[np.intp]) -> FixRecord:
        """Some of the fixes."""
        return FixRecord(**self._columns(rows))

    def _columns(self, rows: slice | BoolArray | NDArray[np.intp]) -> dict[str, Any]:
        return {name: None if values is None else values[rows] for name, values in vars(self).items()}

    def in_time_order(self) -> FixRecord:
        """The fixes sorted by exposure, arriving at it: as if there were no delay."""
        columns = self._columns(np.argsort(self.time_s, kind="stable"))
        return FixRecord(**columns | {"arrival_s": columns["time_s"]})

    def earlier(self, latency_s: float) -> FixRecord:
        """The fixes with time stamps put back by the camera's latency."""
        return replace(self, time_s=self.time_s - latency_s)


class Outcome(enum.Enum):
    """What became of a fix."""

    USED = "used"
    REJECTED = "rejected"
    """By the gate: it contradicts the estimate."""
    REACQUIRED = "reacquired"
    """It contradicts the estimate but not the fixes before, which were rejected: the estimate was given up."""
    DUPLICATE = "duplicate"
    STALE = "stale"
    """A later exposure has been used, and the method cannot go back behind it."""
    TOO_OLD = "too old"
    """The samples since its exposure are not kept any more."""
    AHEAD = "ahead"
    """The samples do not reach its exposure yet."""
    UNUSED = "unused"
    """The method uses no fixes."""


class Fusion(Protocol):
    """Takes samples and fixes as they arrive."""

    def add_samples(self, imu: ImuRecord) -> PlanarTrack:
        """Go on to the end of some samples, which begin where the last ones ended; the estimate at each of them."""

    def add_fix(self, fix: Fix) -> Outcome:
        """Take a fix into the estimate at the last sample."""


@dataclass(frozen=True, eq=False)
class Fused:
    """Estimates as they were known at each sample.

    Attributes
    ----------
    track : PlanarTrack
        At the end of every sample; a fix that arrives just then counts from the next one on.
    outcomes : tuple of Outcome
        Of every fix, as it arrived.
    """

    track: PlanarTrack
    outcomes: tuple[Outcome, ...]

    @property
    def used(self) -> BoolArray:
        """Whether each fix was taken into the estimate, shape (k,)."""
        return np.array([outcome in _TAKEN for outcome in self.outcomes], dtype=np.bool_)


_TAKEN = (Outcome.USED, Outcome.REACQUIRED)


def unused_counts(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Number of the fixes that were not used, by the reason; with those that were used they are all.

    Returns: every reason in words, also where it has none.
    """
    return {reason.value: outcomes.count(reason) for reason in Outcome if reason not in _TAKEN}


def counts_in_words(used: int, unused: Mapping[str, int]) -> str:
    """Numbers of fixes by what became of them, which add up: "187 used, 75 too old".

    ``unused``: of :func:`unused_counts`; reasons without fixes are left out.
    """
    return ", ".join([f"{used} used", *(f"{count} {reason}" for reason, count in unused.items() if count)])


def fuse(fusion: Fusion, imu: ImuRecord, fixes: FixRecord) -> Fused:
    """Give a record's samples and fixes to a method in the order in which they arrive.

    A fix that is faster than the sample of its exposure waits for the end of that sample.

    Parameters
    ----------
    fusion : Fusion
        At ``imu.begin_s``.
    imu : ImuRecord
        Of one run, with one sample at least.
    fixes : FixRecord
        Those that arrive after the last sample are left out.

    Returns
    -------
    Fused
        Its track is of the kind that the method returns.

    Examples
    --------
    >>> import sims
    >>> from adcs import mockup
    >>> run = sims.table_run(sims.TableScenario(duration_s=5.0), seed=0)
    >>> method = mockup.DelayedFilter(run.start, run.imu.begin_s)
    >>> fused = mockup.fuse(method, run.imu, run.fixes)
    >>> fused.track.position_m.shape
    (500, 2)
    """
    tracks: list[PlanarTrack] = []
    outcomes: list[Outcome] = []
    done = 0
    exposed = np.searchsorted(imu.time_s, fixes.time_s) + 1
    rows = np.maximum(np.searchsorted(imu.time_s, fixes.arrival_s, side="right"), exposed)
    for k in np.flatnonzero(fixes.arrival_s <= imu.end_s):
        if rows[k] > done:
            tracks.append(fusion.add_samples(imu.part(done, int(rows[k]))))
            done = int(rows[k])
        outcomes.append(fusion.add_fix(fixes[int(k)]))
    tracks.append(fusion.add_samples(imu.part(done, len(imu))))
    return Fused(joined(tracks), tuple(outcomes))


def joined(tracks: list[PlanarTrack]) -> PlanarTrack:
    """Tracks of one kind, of one run, one after the other in one."""
    kind = type(tracks[0])
    return kind(**{name: np.concatenate([getattr(track, name) for track in tracks]) for name in vars(tracks[0])})
