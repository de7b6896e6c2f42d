"""Fixes as a dataset: every variable is the column of its name, at its row, and nothing where there is no solution."""

from __future__ import annotations

import numpy as np
import pytest

from arrays.geometries import tetrahedron
from magloc.localization.fit.fixes import Fixes
from magloc.localization.locator import locate
from magloc.readings import Readings
from tests.passing_source import readings_of

ARRAY = tetrahedron(1.0)


@pytest.fixture(scope="module")
def fixes() -> Fixes:
    """A source near by, no readings at all, and a source far away."""
    places = np.array([[3.0, 1.0, -0.5], [3.0, 1.0, -0.5], [20.0, 3.0, 1.0]])
    readings = readings_of(ARRAY, places, np.array([[0.0, 20.0, 90.0], [0.0, 20.0, 90.0], [0.0, 900.0, 90.0]]))
    readings[1] = np.nan
    return locate(ARRAY, Readings(readings))


@pytest.mark.parametrize("which", ["best", "all"])
@pytest.mark.parametrize(
    "name", ["position_m", "moment_Am2", "gaussian", "merged", "chi2", "weight", "dof", "n_sources"]
)
def test_solutions_are_in_their_rows(fixes: Fixes, which: str, name: str) -> None:
    dataset = fixes.to_xarray(which)
    columns = getattr(fixes.solutions, name)
    assert fixes.solved.any()
    assert not fixes.solved.all()
    for row in range(len(fixes)):
        own = np.flatnonzero(fixes.solutions.of_row == row)
        wanted = fixes.best[row : row + 1] if which == "best" and own.size else own
        found = dataset[name].isel(row=row).to_numpy()
        found = found[None] if which == "best" else found
        np.testing.assert_array_equal(found[: len(wanted)], columns[wanted])
        empty = np.unique(found[len(wanted) :])
        assert empty.size <= 1
        if empty.size:
            assert np.isnan(empty[0]) if found.dtype.kind == "f" else not empty[0]
