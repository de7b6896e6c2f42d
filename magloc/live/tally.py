"""What came in and what did not: late, lost, doubled and garbled rows are counted and named, and end nothing."""

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
"""Rows of a kind that are named one by one."""
_STEPS = 101
_FEWEST_STEPS = 5
_EVERY = 20  # rows, the median step is counted anew
_LATENCIES = 10_000
_JUMP_STEPS, _JUMP_S = 100.0, 1.0
_ROWS_TO_JUMP, _ROWS_TO_SET_BACK = 2, 10
_PACE_S, _LONGEST_PACE_S, _MOST_SKIPPED = 1.0, 10.0, 0.1


@dataclass
class Tally:
    """Rows of a stream, counted.

    Attributes
    ----------
    rows : int
        That were used, or could have been.
    tracked : int
        Of them, where the source was tracked.
    skipped : int
        Of them, that were left out because newer ones were waiting.
    late : int
        That came after a later one, and were not used.
    lost : int
        That never came, as far as the usual step tells.
    doubled : int
        That came a second time.
    garbled : int
        Lines that are no rows, and rows whose time is not to be believed.
    dummies : int
        Readings, one of a sensor in a row, that were dummy values.
    dropped : int
        Lines that were not read, because one sender sent more than can be read.
    restarts : int
        How often the sender's clock was set back.
    latencies_s : deque of float
        From the arrival of a row to its answer, of the last 10,000 rows [s].

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
        """Count a row of a kind, or some, and name the first ones."""
        before = getattr(self, kind)
        setattr(self, kind, before + number)
        if before < _MOST_NAMED:
            last = "; more of them are only counted" if before + number >= _MOST_NAMED else ""
            _LOG.info(f"{kind}: {what}{last}")

    def drop(self, lines: int, stream: str) -> None:
        """Count lines that were not read, and say it the first time."""
        if lines and not self.dropped:
            _LOG.warning(f"{stream}: more comes than can be read, the oldest lines of who sends most are dropped")
        self.dropped += lines

    @property
    def faults(self) -> int:
        """Rows that are late, lost, doubled or garbled."""
        return self.late + self.lost + self.doubled + self.garbled

    def latency_ms(self, share: float) -> float:
        """A quantile of the latencies [ms]; 0 before the first."""
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
    """Whether rows come faster than they can be followed, which is said once.

    Parameters
    ----------
    stream : str
        Its name.
    """

    def __init__(self, stream: str) -> None:
        self._stream = stream
        self._since_s = -math.inf
        self._answered = self._skipped = 0
        self._is_told = False

    def count(self, answered: int, skipped: int) -> None:
        """Count rows that were answered and that were skipped, and compare them once a second."""
        now_s = time.perf_counter()
        self._answered, self._skipped = self._answered + answered, self._skipped + skipped
        elapsed_s = now_s - self._since_s
        if elapsed_s < _PACE_S:
            return
        if elapsed_s < _LONGEST_PACE_S and self._skipped > _MOST_SKIPPED * self._answered and not self._is_told:
            self._is_told = True
            come, can = (n / elapsed_s for n in (self._answered + self._skipped, self._answered))
            _LOG.warning(
                f"{self._stream}: {come:.3g} rows a second come and {can:.3g} can be followed: the oldest are skipped"
            )
        self._since_s, self._answered, self._skipped = now_s, 0, 0


class Clock:
    """The sender's clock, as the times of its rows tell it.

    A row whose time jumps is not believed before others have followed it: two ahead, and ten where it goes back, for
    rows that were only delayed come in order too.

    Parameters
    ----------
    tally : Tally
        Where rows are counted that cannot be used.
    set_back : callable
        Called before the first row of a clock that was set back.
    """

    def __init__(self, tally: Tally, set_back: Callable[[], None]) -> None:
        self._tally, self._set_back = tally, set_back
        self._last_s: float | None = None
        self._steps_s: deque[float] = deque(maxlen=_STEPS)
        self._recent: deque[float] = deque(maxlen=_STEPS)
        self._until_median = _FEWEST_STEPS
        self.step_s = 0.0
        self._jump_s, self._jumped = 0.0, 0

    def takes(self, time_s: float) -> bool:
        """Whether a row of this time [s] is the next one."""
        if self._last_s is None:
            return self._taken(time_s, 0.0)
        step_s = time_s - self._last_s
        limit_s = max(_JUMP_S, _JUMP_STEPS * self.step_s) if self.step_s else float("inf")
        if 0.0 < step_s <= limit_s:
            return self._taken(time_s, step_s)
        if time_s in self._recent:
            self._tally.name("doubled", f"the row of {time_s:.10g} s")
            return False
        follows = 0.0 < time_s - self._jump_s <= limit_s
        self._jump_s, self._jumped = time_s, self._jumped + 1 if follows else 1
        if step_s > 0.0:
            if self._jumped >= _ROWS_TO_JUMP:
                return self._taken(time_s, step_s)
            self._tally.name("garbled", f"the row of {time_s:.10g} s, {step_s:.3g} s after the one before")
            return False
        if self._jumped >= _ROWS_TO_SET_BACK:
            self._tally.restarts += 1
            self._recent.clear()
            self._set_back()
            return self._taken(time_s, 0.0)
        self._tally.name("late", f"the row of {time_s:.10g} s, after that of {self._last_s:.10g} s")
        self._tally.lost = max(0, self._tally.lost - 1)
        return False

    def _taken(self, time_s: float, step_s: float) -> bool:
        self._last_s, self._jumped = time_s, 0
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
