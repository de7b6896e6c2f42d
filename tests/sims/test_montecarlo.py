"""The Monte-Carlo runner: the same whatever runs it, and nothing lost."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from sims.magnetics.scenario import Scenario
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import Simulation, simulate
from sims.montecarlo import run


def statistics(simulation: Simulation) -> dict[str, Any]:
    """An estimator that a process can be sent."""
    values = simulation.readings.values_T
    return {"rows": len(values), "mean": values.mean(axis=0), "square": values.T @ values}


def failing(simulation: Simulation) -> dict[str, Any]:
    if simulation.seed % 2:
        raise ArithmeticError(f"seed {simulation.seed} is odd")
    return statistics(simulation)


def changing(simulation: Simulation) -> dict[str, Any]:
    return {"values": np.zeros(2 if simulation.seed < 5 else 3)}


def dying(simulation: Simulation) -> dict[str, Any]:
    os._exit(3)


@pytest.fixture(scope="module")
def short() -> Scenario:
    return replace(read_scenario("paper"), duration_s=5.0)


class TestResult:
    def test_it_holds_what_the_estimator_returns(self, short: Scenario) -> None:
        found = run(short, statistics, [3, 1, 7], processes=1)
        assert list(found.seed) == [3, 1, 7]
        assert found["rows"].dims == ("seed",)
        assert found["square"].dims == ("seed", "square_0", "square_1")
        for seed in (3, 1, 7):
            expected = statistics(simulate(short, seed))
            for name, value in expected.items():
                np.testing.assert_array_equal(found[name].sel(seed=seed), value)
        assert list(found["error"]) == ["", "", ""]
        assert found.attrs["scenario"] == "paper"

    def test_it_does_not_depend_on_the_number_of_processes(self, short: Scenario) -> None:
        seeds = range(5)
        xr.testing.assert_identical(run(short, failing, seeds, processes=1), run(short, failing, seeds, processes=2))

    def test_progress_counts_seeds(self, short: Scenario) -> None:
        counted: list[int] = []
        run(short, statistics, range(4), processes=1, progress=counted.append)
        assert counted == [1, 1, 1, 1]


class TestErrors:
    def test_that_of_one_seed_is_reported(self, short: Scenario) -> None:
        found = run(short, failing, [2, 5, 8], processes=1)
        assert list(found["error"].values) == ["", "ArithmeticError: seed 5 is odd", ""]
        assert np.isnan(found["mean"].sel(seed=5)).all()
        assert np.isfinite(found["mean"].sel(seed=[2, 8])).all()

    def test_nothing_but_errors_is_a_dataset_too(self, short: Scenario) -> None:
        found = run(short, failing, [1, 3], processes=1)
        assert list(found.data_vars) == ["error"]

    def test_another_shape_is_one(self, short: Scenario) -> None:
        found = run(short, changing, [1, 2, 6], processes=1)
        assert found["values"].shape == (3, 2)
        assert [bool(text) for text in found["error"].values] == [False, False, True]
        assert "shapes" in str(found["error"].values[2])

    def test_a_reserved_name_is_one(self, short: Scenario) -> None:
        found = run(short, lambda _: {"seed": 1.0}, [1], processes=1)
        assert "'seed'" in str(found["error"].values[0])

    def test_a_process_that_dies_is_one(self, short: Scenario) -> None:
        found = run(short, dying, [1, 2], processes=2)
        assert all("process" in str(text) for text in found["error"].values)

    def test_it_can_be_interrupted(self, short: Scenario) -> None:
        for processes in (1, 2):
            with pytest.raises(KeyboardInterrupt):
                run(short, statistics, range(50), processes=processes, progress=_interrupt)

    @pytest.mark.parametrize(
        ("seeds", "processes", "what"), [([], 1, "seeds"), ([1, 1], 1, "seeds"), ([1], 0, "processes")]
    )
    def test_misuse(self, short: Scenario, seeds: list[int], processes: int, what: str) -> None:
        with pytest.raises(ValueError, match=what):
            run(short, statistics, seeds, processes=processes)

    def test_a_closure_cannot_be_sent_to_a_process(self, short: Scenario) -> None:
        with pytest.raises(ValueError, match="pickled"):
            run(short, lambda _: {}, [1, 2], processes=2)


def _interrupt(_: int) -> None:
    raise KeyboardInterrupt
