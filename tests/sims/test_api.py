"""The public names of ``sims``, used as a user types them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import adcs
import sims
from arrays import SensorArray
from magloc.readings import Readings
from magloc.truth import Truth
from sims.attitude.simulation import AttitudeRuns


@dataclass(frozen=True)
class Judged:
    """What a track says of itself against the truth."""

    nees: NDArray[np.float64]
    rows: int
    remark: str = "of no number"


class FakeTrack:
    """Remembers where the first row is, and that it is a track of this array."""

    def __init__(self, array: SensorArray, readings: Readings) -> None:
        self.n = len(readings)
        assert readings.values_T.shape == (self.n, array.n_channels)

    def consistency(self, truth: Truth) -> Judged:
        return Judged(np.linalg.norm(truth.position_m, axis=1), self.n)


class TestManySeeds:
    def test_what_a_result_says_against_the_truth(self) -> None:
        """The means are those of the simulations' truths, seed by seed."""
        scenario = replace(sims.read_scenario("weaving"), duration_s=3.0)
        runs = sims.run_many(scenario, lambda array, readings: FakeTrack(array, readings), seeds=range(3))
        assert list(runs.error.values) == ["", "", ""]
        truths = [np.linalg.norm(sims.simulate(scenario, seed).truth.position_m, axis=1) for seed in range(3)]
        np.testing.assert_allclose(runs.nees.mean("seed"), np.mean(truths, axis=0), rtol=1e-12)
        assert (runs.rows == len(truths[0])).all()
        assert "remark" not in runs

    def test_of_a_satellite(self) -> None:
        """A star tracker of 0.0005° about each axis: nothing is as far off as 6 σ, once in 10⁷ angles."""
        scenario = replace(sims.read_scenario("tabletsat"), duration_s=30.0)
        runs = sims.run_many(
            scenario, lambda telemetry, satellite: adcs.estimate(telemetry, satellite, sensors="st"), seeds=[4, 5]
        )
        assert list(runs.error.values) == ["", ""]
        assert runs.error_deg.shape == (2, 31)
        assert float(runs.error_deg.max()) < 6.0 * np.degrees(2.0 * scenario.satellite.star_tracker.sigma_rad)


class TestEitherKind:
    def test_by_name(self) -> None:
        assert isinstance(sims.read_scenario("paper"), sims.MagneticScenario)
        assert isinstance(sims.read_scenario("eclipse"), sims.AttitudeScenario)

    def test_by_file(self, tmp_path: Path) -> None:
        path = tmp_path / "mine.toml"
        path.write_bytes((files("adcs") / "scenarios" / "tabletsat.toml").read_bytes())
        assert isinstance(sims.read_scenario(str(path)), sims.AttitudeScenario)

    def test_no_such_scenario(self) -> None:
        with pytest.raises(ValueError, match=r"nowhere\.toml does not exist.*weaving"):
            sims.read_scenario("nowhere.toml")

    def test_simulations(self) -> None:
        runs = sims.simulate(replace(sims.read_scenario("tabletsat"), duration_s=5.0), [1, 2])
        assert isinstance(runs, AttitudeRuns)
        assert runs.q.shape == (2, 6, 4)
        with pytest.raises(ValueError, match="one seed"):
            sims.simulate(sims.read_scenario("paper"), [1, 2])
