"""Every estimator gets on with any missing cells and any values: an entry for every row, and no exception."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

import arrays
import magloc
from arrays.typing import BoolArray, FloatArray

ARRAY = arrays.tetrahedron(1.5, noise_T=1e-9)
MOST_ROWS, C = 9, ARRAY.n_channels
MOTION = magloc.RandomWalk(0.1, 0.1)
WILD = st.tuples(st.integers(0, MOST_ROWS - 1), st.integers(0, C - 1), st.floats())

masks = st.integers(1, MOST_ROWS).flatmap(lambda n: npst.arrays(np.bool_, (n, C)))


def fixed(readings: magloc.Readings) -> list[str]:
    """What is said of every row."""
    fixes = magloc.locate(ARRAY, readings)
    assert fixes.misfit.shape == fixes.body_factor.shape == (len(fixes),)
    return [fix.reason or "solved" for fix in fixes if fix.solutions or fix.reason]


ESTIMATORS: dict[str, Callable[[magloc.Readings], list[str]]] = {
    "locate": fixed,
    "known place": lambda rows: [
        fix.reason or "solved" for fix in magloc.locate(ARRAY, rows, position_m=[3.0, 0.5, 0.3])
    ],
    "track": lambda rows: [point.status for point in magloc.track(ARRAY, rows, motion=MOTION)],
    "stream": lambda rows: [point.status for point in magloc.Tracker(ARRAY, MOTION).run(rows)],
    "sources": lambda rows: [point.status for point in magloc.track_sources(ARRAY, rows)],
    "moment": lambda rows: [point.status for point in magloc.track_moment(ARRAY, rows, [3.0, 0.5, 0.3])],
}


def readings_of(missing: BoolArray, wild: list[tuple[int, int, float]], seed: int) -> magloc.Readings:
    """Rows near a dipole with missing cells and some values of something else."""
    rng = np.random.default_rng(seed)
    clean = ARRAY.readings_of(magloc.dipole.field(ARRAY.positions, np.array([3.0, 0.5, 0.3]), np.array([1e2, 0, 0])))
    values: FloatArray = clean + 1e-9 * rng.standard_normal(missing.shape)
    values[missing] = np.nan
    for row, channel, value in wild:
        if row < len(values):
            values[row, channel] = value
    return magloc.Readings(values)


class TestAnyCells:
    """The rows with random masks, alone and with wild values in some cells."""

    @pytest.mark.parametrize("name", ESTIMATORS)
    @settings(max_examples=4)
    @given(masks, st.lists(WILD, max_size=4), st.integers(0, 9))
    def test_an_entry_for_every_row(self, name: str, missing: BoolArray, wild: list[tuple[int, int, float]], seed: int):
        said = ESTIMATORS[name](readings_of(missing, wild, seed))
        assert len(said) == len(missing)
        assert all(said)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ESTIMATORS)
    @given(masks, st.lists(WILD, max_size=4), st.integers(0, 9))
    def test_many(self, name: str, missing: BoolArray, wild: list[tuple[int, int, float]], seed: int):
        self.test_an_entry_for_every_row.hypothesis.inner_test(self, name, missing, wild, seed)

    def test_one_singular_row_is_one_row(self) -> None:
        """The others are as they are without it."""
        values = readings_of(np.zeros((3, C), dtype=bool), [], 0).values_T
        alone = magloc.locate(ARRAY, values[[0, 2]])
        values[1, 2] = 1e3
        fixes = magloc.locate(ARRAY, values)
        np.testing.assert_allclose(fixes.position_m[[0, 2]], alone.position_m, rtol=1e-9)
        np.testing.assert_allclose(fixes.body_factor[[0, 2]], alone.body_factor, rtol=1e-6)


class TestTurnsOfSensors:
    """Sensors that are read in turn: no row has six differences."""

    def test_a_source_at_rest_is_seen(self) -> None:
        """What rows of other sensors say together is honest: its NEES is below the 99.9 % quantile of three numbers."""
        missing = np.zeros((5, C), dtype=bool)
        missing[::2, 6:] = missing[1::2, 8:] = True
        tracker = magloc.Tracker(ARRAY, magloc.RandomWalk(0.0, 0.0))
        *_, last = tracker.run(readings_of(missing, [], 0))
        assert last.position_m is not None
        off = last.position_m - [3.0, 0.5, 0.3]
        assert off @ np.linalg.solve(last.covariance[:3, :3], off) < 16.3

    @pytest.mark.slow
    def test_rows_of_one_mask_are_as_before(self) -> None:
        """A row of fewer sensors among them changes what is known by what it says, not more."""
        missing = np.zeros((MOST_ROWS, C), dtype=bool)
        missing[:, 8:] = True
        whole = readings_of(missing, [], 1)
        missing[4, 6:] = True
        shorter = readings_of(missing, [], 1)
        points = [
            [*magloc.Tracker(ARRAY, magloc.RandomWalk(0.0, 0.0)).run(rows)][-1].position_m for rows in (whole, shorter)
        ]
        np.testing.assert_allclose(points[0], points[1], atol=0.3)
