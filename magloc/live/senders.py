"""Bounded queues of lines from several senders, served in turns so that no sender starves the others."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field

_GOOD, _NEW, _OTHERS = range(3)
_MOST_SENDERS = 64, 1024, 64  # that wait, by class
_MOST_BYTES = 2**18, 2**12, 2**16  # that wait for one sender, by class
_MOST_LINES = 1000, 4, 16  # that one sender gets at once, by class
_MOST_OTHERS = 4096  # senders without a row that are remembered


@dataclass(frozen=True)
class Batch:
    """Lines that have arrived together.

    Attributes
    ----------
    lines : list of bytes
        Complete lines without line ends.
    sender : hashable, optional
        Sender of the lines, where there may be several senders.
    arrival_s : float
        Arrival time of the first line, by ``time.perf_counter``.
    dropped : int
        Lines that were dropped unread since the previous batch.
    """

    lines: list[bytes]
    sender: Hashable = None
    arrival_s: float = field(default_factory=time.perf_counter)
    dropped: int = 0


class _Queue:
    """Waiting datagrams of one sender, with their arrival times."""

    def __init__(self) -> None:
        self.datagrams: deque[tuple[float, bytes]] = deque()
        self.size = 0

    def __bool__(self) -> bool:
        return bool(self.datagrams)

    def put(self, datagram: bytes, most: int) -> int:
        """Add a datagram, drop the oldest above a size, and return the number of dropped lines."""
        self.datagrams.append((time.perf_counter(), datagram))
        self.size += size_of(datagram)
        dropped = 0
        while self.size > most and len(self.datagrams) > 1:
            _, oldest = self.datagrams.popleft()
            self.size -= size_of(oldest)
            dropped += n_lines(oldest)
        return dropped

    def take(self, most: int) -> Iterator[bytes]:
        """Remove and return the oldest lines."""
        while self.datagrams and most > 0:
            arrival_s, datagram = self.datagrams.popleft()
            lines = datagram.split(b"\n", most)
            self.size -= size_of(datagram)
            if len(lines) > most:
                rest = lines.pop()
                self.datagrams.appendleft((arrival_s, rest))
                self.size += size_of(rest)
            most -= len(lines)
            yield from lines


def size_of(datagram: bytes) -> int:
    """Return the memory that a datagram takes, even an empty one."""
    return len(datagram) + 100


def n_lines(datagram: bytes) -> int:
    """Return the number of lines of a datagram without its last line end."""
    return datagram.count(b"\n") + 1


class Senders:
    """Waiting datagrams by sender.

    Good senders have sent a row or a header before. Good and new senders are served in turns; all others are served
    when none of these waits. New senders get few lines each time. A good sender therefore waits for at most one new
    sender, however many there are. Each sender keeps its newest datagrams, and each class its latest senders.
    """

    def __init__(self) -> None:
        self._good: dict[Hashable, None] = {}  # the latest sender of a row is last
        self._others: dict[Hashable, None] = {}  # the latest new sender is last
        self._waiting: tuple[dict[Hashable, _Queue], ...] = {}, {}, {}
        self._turn = _GOOD
        self._dropped = 0

    def __bool__(self) -> bool:
        """Return whether a datagram waits."""
        return any(self._waiting)

    @property
    def is_urgent(self) -> bool:
        """Whether a good or a new sender waits."""
        return bool(self._waiting[_GOOD] or self._waiting[_NEW])

    def _class_of(self, sender: Hashable) -> int:
        return _GOOD if sender in self._good else _OTHERS if sender in self._others else _NEW

    def put(self, datagram: bytes, sender: Hashable) -> None:
        """Add a datagram; above the bounds, drop the oldest of this sender or the oldest sender."""
        own = self._class_of(sender)
        queues = self._waiting[own]
        if sender not in queues and len(queues) >= _MOST_SENDERS[own]:
            first = queues.pop(next(iter(queues)))
            self._dropped += sum(n_lines(each) for _, each in first.datagrams)
        self._dropped += queues.setdefault(sender, _Queue()).put(datagram.removesuffix(b"\n"), _MOST_BYTES[own])

    def take(self) -> Batch:
        """Remove and return the oldest lines of the next sender."""
        turn = next(c for c in (self._turn, _GOOD, _NEW, _OTHERS) if self._waiting[c])
        self._turn = _NEW if turn == _GOOD else _GOOD
        sender = next(iter(self._waiting[turn]))
        queue = self._waiting[turn].pop(sender)
        if turn == _NEW:
            _remember(self._others, sender, _MOST_OTHERS)
        arrival_s, dropped = queue.datagrams[0][0], self._dropped
        lines = list(queue.take(_MOST_LINES[turn]))
        if queue:
            self._waiting[self._class_of(sender)][sender] = queue
        self._dropped = 0
        return Batch(lines, sender, arrival_s, dropped)

    def accept(self, sender: Hashable) -> None:
        """Record that a sender has sent a row or a header."""
        queue = self._waiting[self._class_of(sender)].pop(sender, None)
        _remember(self._good, sender, _MOST_SENDERS[_GOOD])
        if queue is not None:
            self._waiting[_GOOD][sender] = queue


def _remember(senders: dict[Hashable, None], sender: Hashable, most: int) -> None:
    """Move a sender to the end, and forget the first one above a number of senders."""
    senders.pop(sender, None)
    senders[sender] = None
    if len(senders) > most:
        senders.pop(next(iter(senders)))
