"""The Monte-Carlo runner: the same whatever runs it, and nothing lost."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import xarray as xr

from arrays import SensorArray
from magloc.readings import Readings
from sims.magnetics.scenario import MagneticScenario
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import Simulation, simulate
from sims.montecarlo import run_many


def statistics(array: SensorArray, readings: Readings) -> dict[str, Any]:
    """An estimator that a process can be sent."""
    values = readings.values_T
    return {"rows": len(values), "mean": values.mean(axis=0), "square": values.T @ values}


def failing(simulation: Simulation, result: dict[str, Any]) -> dict[str, Any]:
    """A judge that cannot judge odd seeds."""
    if simulation.seed % 2:
        raise ArithmeticError(f"seed {simulation.seed} is odd")
    return result


def changing(simulation: Simulation, result: dict[str, Any]) -> dict[str, Any]:
    return {"values": np.zeros(2 if simulation.seed < 5 else 3)}


def dying(array: SensorArray, readings: Readings) -> dict[str, Any]:
    os._exit(3)


@pytest.fixture(scope="module")
def short() -> MagneticScenario:
    return replace(read_scenario("paper"), duration_s=5.0)


class TestResult:
    def test_it_holds_what_the_estimator_returns(self, short: MagneticScenario) -> None:
        found = run_many(short, statistics, seeds=[3, 1, 7], processes=1)
        assert list(found.seed) == [3, 1, 7]
        assert found["rows"].dims == ("seed",)
        assert found["square"].dims == ("seed", "square_0", "square_1")
        for seed in (3, 1, 7):
            simulation = simulate(short, seed)
            expected = statistics(simulation.array, simulation.readings)
            for name, value in expected.items():
                np.testing.assert_array_equal(found[name].sel(seed=seed), value)
        assert list(found["error"]) == ["", "", ""]
        assert found.attrs["scenario"] == "paper"

    def test_it_does_not_depend_on_the_number_of_processes(self, short: MagneticScenario) -> None:
        seeds = range(5)
        one, two = (run_many(short, statistics, seeds=seeds, judge=failing, processes=n) for n in (1, 2))
        xr.testing.assert_identical(one, two)

    def test_progress_counts_seeds(self, short: MagneticScenario) -> None:
        counted: list[int] = []
        run_many(short, statistics, seeds=range(4), processes=1, progress=counted.append)
        assert counted == [1, 1, 1, 1]


class TestErrors:
    def test_that_of_one_seed_is_reported(self, short: MagneticScenario) -> None:
        found = run_many(short, statistics, seeds=[2, 5, 8], judge=failing, processes=1)
        assert list(found["error"].values) == ["", "ArithmeticError: seed 5 is odd", ""]
        assert np.isnan(found["mean"].sel(seed=5)).all()
        assert np.isfinite(found["mean"].sel(seed=[2, 8])).all()

    def test_nothing_but_errors_is_a_dataset_too(self, short: MagneticScenario) -> None:
        found = run_many(short, statistics, seeds=[1, 3], judge=failing, processes=1)
        assert list(found.data_vars) == ["error"]

    def test_another_shape_is_one(self, short: MagneticScenario) -> None:
        found = run_many(short, statistics, seeds=[1, 2, 6], judge=changing, processes=1)
        assert found["values"].shape == (3, 2)
        assert [bool(text) for text in found["error"].values] == [False, False, True]
        assert "shapes" in str(found["error"].values[2])

    def test_a_reserved_name_is_one(self, short: MagneticScenario) -> None:
        found = run_many(short, lambda *_: {"seed": 1.0}, seeds=[1], processes=1)
        assert "'seed'" in str(found["error"].values[0])

    @pytest.mark.slow
    def test_a_process_that_dies_is_one(self, short: MagneticScenario) -> None:
        found = run_many(short, dying, seeds=[1, 2], processes=2)
        assert all("process" in str(text) for text in found["error"].values)

    @pytest.mark.slow
    def test_it_can_be_interrupted(self, short: MagneticScenario) -> None:
        for processes in (1, 2):
            with pytest.raises(KeyboardInterrupt):
                run_many(short, statistics, seeds=range(50), processes=processes, progress=_interrupt)

    @pytest.mark.parametrize(
        ("seeds", "processes", "what"), [([], 1, "seeds"), ([1, 1], 1, "seeds"), ([1], 0, "processes")]
    )
    def test_misuse(self, short: MagneticScenario, seeds: list[int], processes: int, what: str) -> None:
        with pytest.raises(ValueError, match=what):
            run_many(short, statistics, seeds=seeds, processes=processes)

    def test_a_closure_cannot_be_sent_to_a_process(self, short: MagneticScenario) -> None:
        with pytest.raises(ValueError, match="pickled"):
            run_many(short, lambda *_: {}, seeds=[1, 2], processes=2)


def _interrupt(_: int) -> None:
    raise KeyboardInterrupt
