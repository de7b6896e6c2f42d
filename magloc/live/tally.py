"""Counts of the rows of a stream: late, lost, doubled and garbled rows are logged and never end it."""

from __future__ import annotations

import logging
import math
import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

_LOG = logging.getLogger(__name__)
_MOST_NAMED = 5
"""Rows of a kind that are logged one by one."""
_STEPS = 101
_FEWEST_STEPS = 5
_EVERY = 20  # rows between two computations of the median step
_LATENCIES = 10_000
_JUMP_STEPS, _JUMP_S = 100.0, 1.0
_ROWS_TO_JUMP, _ROWS_TO_SET_BACK = 2, 10
_PACE_S, _LONGEST_PACE_S, _MOST_SKIPPED = 1.0, 10.0, 0.1


@dataclass
class Tally:
    """Numbers of rows of a stream.

    Attributes
    ----------
    rows : int
        Valid rows in the order of time.
    tracked : int
        Rows in which the source was tracked.
    skipped : int
        Rows that were skipped because newer ones were waiting.
    late : int
        Rows that came after a later one; they are not used.
    lost : int
        Rows that never came, estimated from the usual step.
    doubled : int
        Rows that came a second time.
    garbled : int
        Lines that are no rows, and rows with an implausible time.
    dummies : int
        Readings that were dummy values, one for each sensor and row.
    dropped : int
        Lines that were dropped unread because a sender sent too many.
    restarts : int
        Times that the sender's clock was set back.
    latencies_s : deque of float
        Time from the arrival of a row to its point, for the last 10,000 rows [s].

    Examples
    --------
    >>> import magloc
    >>> tally = magloc.live.Tally(rows=3, garbled=1)
    >>> print(tally)
    3 rows, 0 tracked, 0 late, 0 lost, 0 doubled, 1 garbled
    """

    rows: int = 0
    tracked: int = 0
    skipped: int = 0
    late: int = 0
    lost: int = 0
    doubled: int = 0
    garbled: int = 0
    dummies: int = 0
    dropped: int = 0
    restarts: int = 0
    latencies_s: deque[float] = field(default_factory=lambda: deque(maxlen=_LATENCIES), repr=False)

    def name(self, kind: str, what: str, number: int = 1) -> None:
        """Count rows of a kind, and log the first ones."""
        before = getattr(self, kind)
        setattr(self, kind, before + number)
        if before < _MOST_NAMED:
            last = "; further ones are only counted" if before + number >= _MOST_NAMED else ""
            _LOG.info(f"{kind}: {what}{last}")

    def drop(self, lines: int, stream: str) -> None:
        """Count lines that were dropped unread, and warn the first time."""
        if lines and not self.dropped:
            _LOG.warning(
                f"{stream}: more lines arrive than can be read; the oldest lines of the busiest senders are dropped"
            )
        self.dropped += lines

    @property
    def faults(self) -> int:
        """Rows that are late, lost, doubled or garbled."""
        return self.late + self.lost + self.doubled + self.garbled

    def latency_ms(self, share: float) -> float:
        """Return a quantile of the latencies [ms]; 0 before the first one."""
        ordered = sorted(self.latencies_s)
        return 1e3 * ordered[min(int(share * len(ordered)), len(ordered) - 1)] if ordered else 0.0

    def __str__(self) -> str:
        words = f"{self.rows} rows, {self.tracked} tracked, {self.late} late, {self.lost} lost, {self.doubled} doubled"
        words += f", {self.garbled} garbled"
        words += f", {self.skipped} skipped" if self.skipped else ""
        words += f", {self.dummies} dummy values" if self.dummies else ""
        words += f", {self.dropped} lines not read" if self.dropped else ""
        words += f", clock set back {self.restarts} times" if self.restarts else ""
        if not self.latencies_s:
            return words
        return f"{words}; latency {self.latency_ms(0.5):.2g} ms, 99.9 % within {self.latency_ms(0.999):.2g} ms"


class Pace:
    """Rates of tracked and skipped rows, with one warning if too many are skipped.

    Parameters
    ----------
    stream : str
        Name of the stream.
    """

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._begin_s = -math.inf
        self._n_tracked = self._n_skipped = 0
        self._has_warned = False

    def count(self, n_tracked: int, n_skipped: int) -> None:
        """Count tracked and skipped rows, and compare both once a second."""
        now_s = time.perf_counter()
        self._n_tracked, self._n_skipped = self._n_tracked + n_tracked, self._n_skipped + n_skipped
        elapsed_s = now_s - self._begin_s
        if elapsed_s < _PACE_S:
            return
        is_behind = elapsed_s < _LONGEST_PACE_S and self._n_skipped > _MOST_SKIPPED * self._n_tracked
        if is_behind and not self._has_warned:
            self._has_warned = True
            arriving, followed = (n / elapsed_s for n in (self._n_tracked + self._n_skipped, self._n_tracked))
            _LOG.warning(
                f"{self._stream}: {arriving:.3g} rows arrive a second, but only {followed:.3g} can be followed;"
                " the oldest are skipped"
            )
        self._begin_s, self._n_tracked, self._n_skipped = now_s, 0, 0


class Clock:
    """Check of the times of a sender's rows.

    A jump of the time is accepted after a number of successive rows confirms it: two for a jump ahead, ten for a jump
    back, because rows that were only delayed are in order too.

    Parameters
    ----------
    tally : Tally
        It counts the rows that cannot be used.
    on_set_back : callable
        Called before the first row of a clock that was set back.
    """

    def __init__(self, tally: Tally, on_set_back: Callable[[], None]) -> None:
        self._tally, self._on_set_back = tally, on_set_back
        self._last_s: float | None = None
        self._steps_s: deque[float] = deque(maxlen=_STEPS)
        self._recent: deque[float] = deque(maxlen=_STEPS)
        self._until_median = _FEWEST_STEPS
        self.step_s = 0.0
        self._jump_s, self._n_after_jump = 0.0, 0

    def accepts(self, time_s: float) -> bool:
        """Return whether a row of this time [s] is to be used, and count it."""
        if self._last_s is None:
            return self._accept(time_s, 0.0)
        step_s = time_s - self._last_s
        limit_s = max(_JUMP_S, _JUMP_STEPS * self.step_s) if self.step_s else float("inf")
        if 0.0 < step_s <= limit_s:
            return self._accept(time_s, step_s)
        if time_s in self._recent:
            self._tally.name("doubled", f"the row of {time_s:.10g} s")
            return False
        follows = 0.0 < time_s - self._jump_s <= limit_s
        self._jump_s, self._n_after_jump = time_s, self._n_after_jump + 1 if follows else 1
        if step_s > 0.0:
            if self._n_after_jump >= _ROWS_TO_JUMP:
                return self._accept(time_s, step_s)
            self._tally.name("garbled", f"the row of {time_s:.10g} s, {step_s:.3g} s after the one before")
            return False
        if self._n_after_jump >= _ROWS_TO_SET_BACK:
            self._tally.restarts += 1
            self._recent.clear()
            self._on_set_back()
            return self._accept(time_s, 0.0)
        self._tally.name("late", f"the row of {time_s:.10g} s, after that of {self._last_s:.10g} s")
        self._tally.lost = max(0, self._tally.lost - 1)
        return False

    def _accept(self, time_s: float, step_s: float) -> bool:
        self._last_s, self._n_after_jump = time_s, 0
        self._recent.append(time_s)
        self._tally.rows += 1
        if step_s:
            if self.step_s and step_s > 1.5 * self.step_s:
                missing = round(step_s / self.step_s) - 1
                if self._tally.lost < _MOST_NAMED:
                    _LOG.info(f"lost: {missing} rows before that of {time_s:.10g} s")
                self._tally.lost += missing
            self._steps_s.append(step_s)
            self._until_median -= 1
            if self._until_median <= 0:
                self.step_s, self._until_median = statistics.median(self._steps_s), _EVERY
        return True
