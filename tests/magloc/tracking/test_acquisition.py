"""Starts from several rows of a drone's four moduli, none of which determines the source alone, in simulation."""

from __future__ import annotations

import numpy as np
import pytest

import magloc
from magloc.localization.fit.prior import NOTHING_KNOWN
from magloc.tracking.acquisition import Acquisition
from magloc.tracking.rows import rows_of
from magloc.tracking.tracker import Tracker
from sims.magnetics.scenario_files import read_scenario
from sims.magnetics.simulation import simulate

SOURCE_M = np.array([1.0, 0.5, -1.0])
REST = magloc.RandomWalk(1e-5, 1e-5)
# The drone flies by, seven metres away; before them no row shows enough.
PASSING = slice(40, 160)


class TestRows:
    """A few rows find the place, and all that were kept say how well it is known."""

    @pytest.fixture(scope="class")
    @classmethod
    def start(cls):
        simulation = simulate(read_scenario("drone"), 3000)
        rows = list(rows_of(simulation.readings))[PASSING]
        acquisition = Acquisition(simulation.array, NOTHING_KNOWN)
        return simulation.array, next(found for row in rows if (found := acquisition.start(row)) is not None)

    def test_none_is_left_out(self, start):
        _, found = start
        times = np.array([row.time_s for row in found.rows])
        assert len(times) > 40
        assert np.diff(times).max() < 0.35  # every tenth of a second, and a few are missing

    def test_all_of_them_know_the_place_better(self, start):
        array, found = start
        tracker = Tracker(array, REST)
        source = np.concatenate([found.solution.position_m, found.solution.moment_Am2])
        every, few = (
            tracker.start(source, found.solution.covariance, rows) for rows in (found.rows, found.rows[-1::-4][::-1])
        )
        assert every is not None
        assert few is not None
        assert np.linalg.norm(every.S[:3]) < 0.7 * np.linalg.norm(few.S[:3])
        error = every.x[:3] - SOURCE_M
        # Three numbers within their 1 - 1e-6 quantile.
        assert error @ np.linalg.solve(every.S[:3] @ every.S[:3].T, error) < 30.7
