"""The sender's clock: which rows are taken, and what the others are called."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.live.tally import Clock, Tally

STEP_S = 0.005


class Watched:
    """A clock that has seen some good rows."""

    def __init__(self, n: int = 50) -> None:
        self.tally, self.n_set_back = Tally(), 0
        self.clock = Clock(self.tally, self.count)
        self.now_s = 0.0
        for _ in range(n):
            assert self.take(STEP_S)

    def count(self) -> None:
        self.n_set_back += 1

    def take(self, step_s: float) -> bool:
        self.now_s += step_s
        return self.clock.accepts(self.now_s)

    def counts(self) -> tuple[int, int, int, int]:
        tally = self.tally
        return tally.late, tally.lost, tally.doubled, tally.garbled


class TestClock:
    def test_good_rows(self) -> None:
        assert Watched().counts() == (0, 0, 0, 0)

    @pytest.mark.parametrize("missing", [1, 2, 30])
    def test_lost_rows_are_as_many_as_steps(self, missing: int) -> None:
        watched = Watched()
        assert watched.take((missing + 1) * STEP_S)
        assert watched.counts() == (0, missing, 0, 0)

    def test_uneven_steps_are_no_loss(self) -> None:
        """Within a third of a step of where they should be."""
        watched = Watched(0)
        jitter = np.random.default_rng(0).uniform(-0.2, 0.2, 500)
        for i in range(500):
            assert watched.clock.accepts(STEP_S * (i + jitter[i]))
        assert watched.counts() == (0, 0, 0, 0)

    def test_a_row_that_comes_twice(self) -> None:
        watched = Watched()
        assert not watched.clock.accepts(watched.now_s)
        assert not watched.clock.accepts(watched.now_s - 3 * STEP_S - 1e-17)
        assert watched.counts()[2] >= 1

    def test_a_row_that_was_overtaken_is_late_and_not_lost(self) -> None:
        watched = Watched()
        overtaken = watched.now_s + STEP_S
        assert watched.take(2 * STEP_S)
        assert watched.counts() == (0, 1, 0, 0)
        assert not watched.clock.accepts(overtaken)
        assert watched.counts() == (1, 0, 0, 0)
        assert watched.take(STEP_S)

    @pytest.mark.parametrize("jump_s", [5.0, 1e6, 1e29])
    def test_one_time_far_ahead_is_not_believed(self, jump_s: float) -> None:
        watched = Watched()
        assert not watched.clock.accepts(watched.now_s + jump_s)
        assert watched.take(STEP_S)
        assert watched.counts() == (0, 0, 0, 1)

    def test_a_pause_is_believed_with_its_second_row(self) -> None:
        watched = Watched()
        assert not watched.take(60.0)
        assert watched.take(STEP_S)
        assert watched.take(STEP_S)
        assert watched.tally.lost == pytest.approx(60.0 / STEP_S, abs=1)

    def test_a_clock_that_is_set_back(self) -> None:
        watched = Watched(5000)
        watched.now_s = 0.0
        taken = [watched.take(STEP_S) for _ in range(30)]
        assert taken == [False] * 9 + [True] * 21
        assert (watched.n_set_back, watched.tally.restarts) == (1, 1)

    def test_a_clock_that_is_set_back_to_times_seen_a_moment_ago(self) -> None:
        """They are taken for doubled ones until it goes on."""
        watched = Watched(60)
        watched.now_s = 0.0
        assert any(watched.take(STEP_S) for _ in range(100))

    def test_slow_rows(self) -> None:
        """A row every two minutes: what counts as a jump is told by the steps."""
        watched = Watched(0)
        for _ in range(20):
            assert watched.take(120.0)
        assert watched.counts() == (0, 0, 0, 0)

    def test_any_mess_of_times_leaves_an_order(self) -> None:
        """What is taken increases between two times that the clock is set back."""
        rng = np.random.default_rng(1)
        for _ in range(30):
            taken: list[float] = []
            clock = Clock(Tally(), taken.clear)
            for time_s in rng.choice([0.0, 0.1, 1.0, 5.0, 1e6, -3.0], 300) + np.round(rng.normal(size=300), 1):
                if clock.accepts(float(time_s)):
                    taken.append(float(time_s))
                    assert taken == sorted(set(taken))


class TestTally:
    def test_latency_quantiles(self) -> None:
        tally = Tally()
        assert tally.latency_ms(0.5) == 0.0
        tally.latencies_s.extend(1e-3 * np.random.default_rng(0).permutation(np.arange(1, 1001)))
        assert tally.latency_ms(0.5) == pytest.approx(501.0)
        assert tally.latency_ms(0.999) == pytest.approx(1000.0)
        assert "latency 5e+02 ms, 99.9 % within 1e+03 ms" in str(tally)
