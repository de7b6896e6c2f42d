"""Tracks by arrays whose carrier has fields of its own that the ambient one induces, in simulation.

A tetrahedron of 0.2 nT turns and sways past a source at rest, at 2 m; every sensor sees up to 5 nT of what the Earth's
field induces, and 1 nT of eddy currents, all of it constant matrices. The seeds are not chosen.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

import magloc
from arrays.geometries import cube, tetrahedron
from magloc.tracking.track import Track
from sims.magnetics.paths import Attitude, Steered
from sims.magnetics.scenario import Carrier, MagneticScenario, Platform, Source
from sims.magnetics.sensors import SensorModel
from sims.magnetics.simulation import Simulation, simulate
from tests.passing_source import nees

SCENARIO = MagneticScenario(
    tetrahedron(1.5),
    (SensorModel("vector", 2e-10).with_sigma(2e-10, 5.0),) * 4,
    duration_s=8.0,
    rate_Hz=5.0,
    sources=(Source(Carrier(Steered((0.0, 0.5, 0.0))), moment_Am2=(50.0, -40.0, 30.0)),),
    carrier=Carrier(
        Steered((-2.0, -1.6, 0.0), math.pi / 2, 0.4),
        Attitude(wobble_rad=(0.2, 0.2, 0.3), wobble_period_s=(9.0, 13.0, 17.0)),
    ),
    ambient_T=(2e-6, 20e-6, -43e-6),
    platform=Platform(induced=1e-4, eddy_s=1e-4),
)
MODULI = replace(
    SCENARIO,
    array=cube(1.2, kind="scalar"),
    models=(SensorModel("scalar", 2e-10).with_sigma(2e-10, 5.0),) * 8,
    # Moduli see it along the ambient field: of more than a nanotesla what the source turns that by is left.
    platform=Platform(induced=2e-5, eddy_s=2e-5),
)
REST = magloc.RandomWalk(1e-6, 1e-6)


def run(scenario: MagneticScenario, seed: int, *, stated: bool = True) -> tuple[Simulation, Track]:
    """One record; its array states what the simulated platform has, or nothing."""
    simulation = simulate(scenario, seed)
    array = simulation.array
    if not stated:
        unknown = (replace(s, induced_uncertainty=0.0, eddy_uncertainty_s=0.0) for s in array.sensors)
        array = replace(array, sensors=tuple(unknown))
    return simulation, magloc.track(array, simulation.readings, motion=REST)


class TestStated:
    @pytest.mark.slow
    @pytest.mark.parametrize("scenario", [SCENARIO, MODULI], ids=["vectors", "moduli"])
    def test_claims_are_those_of_the_errors(self, scenario: MagneticScenario) -> None:
        """Of the last rows of 12 tracks: χ² of 72 numbers, which a right filter leaves with the probability 1e-3.

        The mean NEES per dimension over all rows is asked for as that of every error that can be stated is.
        """
        tracks = [run(scenario, seed) for seed in range(12)]
        low, high = stats.chi2.ppf([5e-4, 1.0 - 5e-4], 6 * len(tracks))
        assert low < sum(nees(*track) for track in tracks) < high
        assert 0.8 < np.mean([track.consistency(of.truth).nees_per_dimension for of, track in tracks]) < 1.25
        assert not any(track.innovations.flagged for _, track in tracks)

    def test_cost_accuracy(self) -> None:
        """One track: right within 5 σ, which are more than where nothing is induced."""
        simulation, track = run(SCENARIO, 1)
        assert nees(simulation, track) < stats.chi2.ppf(1.0 - 1e-6, 6)
        exact = run(replace(SCENARIO, platform=Platform()), 1)[1]
        sigma, of_exact = (np.sqrt(np.trace(one.covariance[-1, :3, :3])) for one in (track, exact))
        assert sigma > 1.5 * of_exact


class TestNotStated:
    @pytest.mark.slow_after(1)
    @pytest.mark.parametrize("seed", range(4))
    def test_no_track_is_silent(self, seed: int) -> None:
        _, track = run(SCENARIO, seed, stated=False)
        assert track.innovations.flagged or track.tracked.mean() < 0.5
