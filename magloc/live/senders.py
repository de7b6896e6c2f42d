"""Lines of several senders who do not wait, within bounds and handed out in turns, so that none starves the others."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, field

_GOOD, _NEW, _OTHERS = range(3)
_MOST_SENDERS = 64, 1024, 64  # of each class, that wait
_MOST_BYTES = 2**18, 2**12, 2**16  # of a sender of each class, that wait
_MOST_LINES = 1000, 4, 16  # of a sender of each class, at once
_MOST_REMEMBERED = 4096  # senders of nothing but what is no row


@dataclass(frozen=True)
class Batch:
    """Lines that have arrived together.

    Attributes
    ----------
    lines : list of bytes
        Whole lines, without their ends.
    sender : hashable, optional
        Who sent them, where there may be several.
    arrived_s : float
        When the first of them arrived, by ``time.perf_counter``.
    dropped : int
        Lines that were dropped unread since the batch before.
    """

    lines: list[bytes]
    sender: Hashable = None
    arrived_s: float = field(default_factory=time.perf_counter)
    dropped: int = 0


class _Queue:
    """Datagrams of one sender that wait, with their times of arrival."""

    def __init__(self) -> None:
        self.datagrams: deque[tuple[float, bytes]] = deque()
        self.size = 0

    def __bool__(self) -> bool:
        return bool(self.datagrams)

    def put(self, datagram: bytes, most: int) -> int:
        """Add a datagram; returns how many lines of the oldest ones have to go, for so many bytes at most to wait."""
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
            arrived_s, datagram = self.datagrams.popleft()
            lines = datagram.split(b"\n", most)
            self.size -= size_of(datagram)
            if len(lines) > most:
                rest = lines.pop()
                self.datagrams.appendleft((arrived_s, rest))
                self.size += size_of(rest)
            most -= len(lines)
            yield from lines


def size_of(datagram: bytes) -> int:
    """Return the memory that a datagram takes, an empty one too."""
    return len(datagram) + 100


def n_lines(datagram: bytes) -> int:
    """Return the number of lines of a datagram without its last line end."""
    return datagram.count(b"\n") + 1


class Senders:
    """Datagrams that wait, by their senders.

    Whoever sent a row or a header before and whoever sends for the first time are served in turns, and all others when
    none of these waits; strangers get few lines each time. So a good sender waits for one stranger at most, however
    many they are. The newest datagrams of every sender are kept, and the last senders of every class.
    """

    def __init__(self) -> None:
        self._good: dict[Hashable, None] = {}  # the last one to send a row at the end
        self._heard: dict[Hashable, None] = {}  # others, the last new one at the end
        self._waiting: tuple[dict[Hashable, _Queue], ...] = {}, {}, {}
        self._turn = _GOOD
        self._dropped = 0

    def __bool__(self) -> bool:
        """Whether anything waits."""
        return any(self._waiting)

    @property
    def is_urgent(self) -> bool:
        """Whether more waits than what comes from senders of nothing but what is no row."""
        return bool(self._waiting[_GOOD] or self._waiting[_NEW])

    def _class_of(self, sender: Hashable) -> int:
        return _GOOD if sender in self._good else _OTHERS if sender in self._heard else _NEW

    def put(self, datagram: bytes, sender: Hashable) -> None:
        """Add a datagram; the oldest ones of this sender, or those of the first of too many, are dropped for it."""
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
            _remember(self._heard, sender, _MOST_REMEMBERED)
        arrived_s, dropped = queue.datagrams[0][0], self._dropped
        lines = list(queue.take(_MOST_LINES[turn]))
        if queue:
            self._waiting[self._class_of(sender)][sender] = queue
        self._dropped = 0
        return Batch(lines, sender, arrived_s, dropped)

    def accept(self, sender: Hashable) -> None:
        """Note that a sender sent a row or a header."""
        queue = self._waiting[self._class_of(sender)].pop(sender, None)
        _remember(self._good, sender, _MOST_SENDERS[_GOOD])
        if queue is not None:
            self._waiting[_GOOD][sender] = queue


def _remember(senders: dict[Hashable, None], sender: Hashable, most: int) -> None:
    """Put a sender at the end of the last ones."""
    senders.pop(sender, None)
    senders[sender] = None
    if len(senders) > most:
        senders.pop(next(iter(senders)))
