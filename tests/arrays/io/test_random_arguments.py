"""Random arguments: seeds, generators, and the old name."""

from __future__ import annotations

import numpy as np
import pytest

import sims
from arrays.io.values import accept_seed, seed_of
from arrays.typing import Rng


@accept_seed
def draw(rng: Rng = 0) -> int:
    return seed_of(rng)


class TestSeedOf:
    def test_is_a_seed_itself(self) -> None:
        assert (seed_of(7), seed_of(np.int64(7)), seed_of(10**30)) == (7, 7, 10**30)

    def test_is_drawn_by_a_generator(self) -> None:
        generator = np.random.default_rng(1)
        first, second = seed_of(generator), seed_of(generator)
        assert first != second
        assert first == seed_of(np.random.default_rng(1)) == seed_of(np.random.SeedSequence(1))

    def test_is_new_without_one(self) -> None:
        assert seed_of(None) != seed_of(None)  # alike once in 9e18


class TestAcceptSeed:
    def test_the_old_name_warns(self) -> None:
        with pytest.warns(DeprecationWarning, match=r"seed of draw\(\) is called rng now"):
            assert draw(seed=3) == draw(rng=3) == draw(3) == 3  # type: ignore[call-arg]

    def test_both_names_are_refused(self) -> None:
        with pytest.raises(TypeError, match="rng or seed, not both"):
            draw(rng=1, seed=1)  # type: ignore[call-arg]

    def test_a_generator_simulates(self) -> None:
        scenario = sims.read_scenario("weaving")
        first, second = (sims.simulate(scenario, rng=np.random.default_rng(5)).readings.values_T for _ in range(2))
        np.testing.assert_array_equal(first, second)
