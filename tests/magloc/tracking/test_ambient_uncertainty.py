"""Tracks by moduli in an ambient field that is not exactly known, in simulation.

Eight scalar sensors of 0.1 nT on a carrier that turns and sways pass a source at rest, at 3 m. The seeds are not
chosen.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import magloc
from arrays.array import SensorArray
from arrays.sensor import Sensor
from magloc.tracking.consistency import THRESHOLD
from magloc.tracking.track import Track
from sims.magnetics.paths import Attitude, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Source
from sims.magnetics.sensors import SensorModel
from sims.magnetics.simulation import Simulation, simulate
from tests.passing_source import nees

NOISE_T = 1e-10
PLACES = np.random.default_rng(4).uniform(-0.75, 0.75, (8, 3)).tolist()
ARRAY = SensorArray(tuple(Sensor(f"s{i}", "scalar", (x, y, z), NOISE_T) for i, (x, y, z) in enumerate(PLACES)))
SCENARIO = MagneticScenario(
    ARRAY,
    (SensorModel("scalar", noise_T_rtHz=NOISE_T),) * 8,
    duration_s=12.0,
    rate_Hz=2.0,
    carrier=Carrier(
        Steered((-3.0, 0.5, 2.0), speed_m_s=0.5),
        Attitude(True, wobble_rad=(0.1, 0.08, 0.1), wobble_period_s=(5.3, 4.1, 7.7)),
    ),
    sources=(Source(Carrier(Steered((0.0, 0.0, -1.0))), moment_Am2=(40.0, -20.0, 30.0)),),
    ambient_T=(2e-6, 20e-6, -43e-6),
)
REST = magloc.RandomWalk(1e-5, 1e-5)


def run(seed: int, constant_T: float, white_T: float = 0.0, *, stated: bool = True) -> tuple[Simulation, Track]:
    """A field that errs by so much, stated or not."""
    errs = replace(ARRAY, ambient_uncertainty_T=constant_T, ambient_uncertainty_white_T=white_T)
    simulation = simulate(replace(SCENARIO, array=errs), seed)
    exact = replace(simulation.array, ambient_uncertainty_T=0.0, ambient_uncertainty_white_T=0.0)
    return simulation, magloc.track(simulation.array if stated else exact, simulation.readings, motion=REST)


class TestStated:
    def test_errors_are_claimed(self) -> None:
        """One track each: within 5 σ; the constant costs little, what is new in every row more."""
        claims = []
        for errors in ((0.0, 0.0), (200e-9, 0.0), (0.0, 200e-9)):
            simulation, track = run(1, *errors)
            assert nees(simulation, track) < stats.chi2.ppf(1.0 - 1e-6, 6)
            assert track.tracked.all()
            claims.append(float(np.sqrt(np.trace(track.covariance[-1, :3, :3]))))
        assert claims[0] < claims[1] < claims[2]

    @pytest.mark.slow
    @pytest.mark.parametrize("errors", [(50e-9, 0.0), (500e-9, 0.0), (0.0, 50e-9)], ids=["50", "500", "white"])
    def test_claims_are_those_of_the_errors(self, errors: tuple[float, float]) -> None:
        """Of the last rows of 20 tracks: χ² of 120 numbers, which a right filter leaves with the probability 1e-3."""
        squares = [nees(*run(seed, *errors)) for seed in range(20)]
        low, high = stats.chi2.ppf([5e-4, 1.0 - 5e-4], 6 * len(squares))
        assert low < sum(squares) < high


class TestNotStated:
    def test_is_far_outside_of_what_is_claimed(self) -> None:
        squares = [nees(*run(seed, 200e-9, stated=False)) for seed in range(4)]
        assert np.mean(squares) > 100.0 * 6

    def test_is_told_of_in_every_record(self) -> None:
        """Of what errors of 300 nT would do; whether they are there, the rows cannot always tell."""
        for constant_T in (0.0, 200e-9):
            test = run(5, constant_T, stated=False)[1].innovations
            assert constant_T or not test.flagged  # right tracks are once in 1,000
            assert "if it is wrong by 300 nT" in test.caution

    def test_rows_that_see_it_say_so(self) -> None:
        """Errors of 500 nT, of which every second record or more sees enough."""
        tests = [run(seed, 500e-9, stated=False)[1].innovations for seed in range(4)]
        seen = [test.reason for test in tests if test.z_ambient > THRESHOLD]
        assert seen
        assert all("another ambient field" in reason for reason in seen)

    @pytest.mark.slow
    def test_told_size_is_that_of_the_errors(self) -> None:
        """rms of 6 numbers of 20 runs, driven by three normal ones each: within a factor of 1.6 at 1 in 1,000."""
        runs = [run(seed, 300e-9, stated=False) for seed in range(20)]
        told = np.mean([track.innovations.ambient_factor for _, track in runs])
        rms = math.sqrt(np.mean([nees(*one) for one in runs]) / 6.0)
        assert told / 1.6 < rms < told * 1.6

    def test_is_not_told_of_where_it_is_stated(self) -> None:
        test = run(5, 200e-9)[1].innovations
        assert math.isnan(test.z_ambient)
        assert "300 nT" not in test.caution


class TestSimulated:
    def test_readings_state_the_field_with_its_errors(self) -> None:
        """Of 25 rows: what is new in every row has its rms within 4.5 σ, and the rest is constant in the world."""
        simulation = simulate(replace(SCENARIO, array=replace(ARRAY, ambient_uncertainty_T=300e-9)), 2)
        white = replace(ARRAY, ambient_uncertainty_white_T=100e-9)
        noisy = simulate(replace(SCENARIO, array=white), 2)
        constant, changing = (
            found.readings.array_rotation.apply(found.readings.ambient_T) - SCENARIO.ambient_T  # type: ignore[union-attr]
            for found in (simulation, noisy)
        )
        np.testing.assert_allclose(constant, np.broadcast_to(constant[0], constant.shape), atol=1e-18)
        assert 50e-9 < np.linalg.norm(constant[0]) < 1500e-9
        size = changing.size
        assert np.mean(changing**2) == pytest.approx(1e-14, rel=4.5 * math.sqrt(2.0 / size))
        np.testing.assert_array_equal(noisy.readings.values_T, simulation.readings.values_T)
