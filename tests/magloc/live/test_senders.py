"""Datagrams of several senders: each has its turn, none fills the memory, and a flood costs a good sender no row."""

from __future__ import annotations

from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from magloc.live import senders as module
from magloc.live.senders import Senders
from tests.live_flood import KINDS, flooded

DATAGRAMS = st.lists(
    st.tuples(st.sampled_from([b"a", b"a\n", b"a\nb", b"\n\n", b"", b"a\n" * 20]), st.integers(0, 5)), max_size=28
)


class TestTurns:
    @given(DATAGRAMS, st.sets(st.integers(0, 5)))
    def test_every_line_comes_once_in_its_sender_s_order(self, sent: list[tuple[bytes, int]], good: set[int]) -> None:
        senders, expected, found = Senders(), {i: [] for i in range(6)}, {i: [] for i in range(6)}
        for sender in good:
            senders.accept(sender)
        for datagram, sender in sent:
            senders.put(datagram, sender)
            expected[sender] += datagram.removesuffix(b"\n").split(b"\n")
        while senders:
            batch = senders.take()
            found[batch.sender] += batch.lines
            assert batch.dropped == 0
            assert len(batch.lines) <= (module._MOST_LINES[0] if batch.sender in good else max(module._MOST_LINES[1:]))
        assert found == expected

    @given(st.integers(1, 200), st.integers(1, 80))
    def test_a_good_sender_waits_for_one_stranger(self, n: int, strangers: int) -> None:
        senders = Senders()
        senders.accept("good")
        for i in range(n):
            senders.put(b"x\n" * 100, i % strangers)
            if i % 3 == 0:
                senders.take()
        senders.put(b"row", "good")
        assert "good" in {senders.take().sender for _ in range(2)}

    @given(st.integers(1, 100))
    def test_who_is_new_is_heard_before_who_sent_nothing_good(self, others: int) -> None:
        senders = Senders()
        for i in range(2 * others):
            senders.put(b"x", i % others)
            senders.take()
        for i in range(others):
            senders.put(b"x", i)
        senders.put(b"header", "new")
        assert "new" in {senders.take().sender for _ in range(2) if senders}
        senders.accept("new")
        senders.put(b"row", "new")
        assert "new" in {senders.take().sender for _ in range(2) if senders}

    def test_strangers_have_turns_too(self) -> None:
        senders = Senders()
        senders.accept("good")
        seen: Counter[object] = Counter()
        for i in range(100):
            senders.put(b"row", "good")
            senders.put(b"x", i)
            seen[senders.take().sender == "good"] += 1
        assert min(seen.values()) > 40


class TestBounds:
    def test_empty_datagrams_are_bounded_too(self) -> None:
        senders = Senders()
        for _ in range(5000):
            senders.put(b"", "one")
        assert len(senders.take().lines) + senders._dropped < 5000
        assert sum(len(q.datagrams) for queues in senders._waiting for q in queues.values()) < 100

    @pytest.mark.parametrize("senders_of_all", [1, 64, 1000])
    def test_the_newest_are_kept_and_the_rest_is_counted(self, senders_of_all: int) -> None:
        senders, size, n = Senders(), 10_000, 3000
        for i in range(n):
            senders.put(b"%06d" % i + b"x" * size + b"\n", i % senders_of_all)
        waiting = sum(len(data) for queues in senders._waiting for q in queues.values() for _, data in q.datagrams)
        assert waiting <= 1024 * (2**12 + size)
        lines, dropped = [], 0
        while senders:
            batch = senders.take()
            lines, dropped = lines + batch.lines, dropped + batch.dropped
        assert len(lines) + dropped == n
        numbers = sorted(int(line[:6]) for line in lines)
        assert numbers == list(range(n - len(numbers), n))


@pytest.mark.slow
@pytest.mark.parametrize("ports", [1, 500])
@pytest.mark.parametrize("kind", KINDS)
def test_a_flood_costs_no_row(kind: str, ports: int) -> None:
    """10,000 foreign datagrams a second for 20 s; figures of latency are in the guide, as no test asks the clock."""
    found = flooded(KINDS[kind], 20.0, 1e4, ports)
    assert found.foreign_per_s > 5e3
    assert found.answered >= found.sent - 1
    assert found.memory_MiB < 300.0
    assert found.status == 143
    assert "garbled" in found.said
