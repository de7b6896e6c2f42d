"""Surveys whose positions are in another unit, or have their axes exchanged."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

import magloc
from arrays.typing import FloatArray
from magloc.grids.work import workers
from magloc.localization.fit.prior import NOTHING_KNOWN
from magloc.surveying.piece import Ground
from magloc.surveying.review.wrong_positions import likely_error_of_positions
from magloc.surveying.survey import tile_rows
from magloc.terrain.surface import FLAT
from tests.hills import PAIR, plain, walk

ROWS = walk(71, plain, 5.0, 3).readings
EXCHANGED = np.eye(3)[[1, 0, 2]]


def with_positions(matrix: ArrayLike) -> magloc.Readings:
    return replace(ROWS, array_position_m=ROWS.array_position_m @ np.asarray(matrix))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("matrix", "error"),
    [
        (np.eye(3), ""),
        (np.eye(3) / 0.3048, "be in feet"),
        (np.diag([1.0, 1.0, 0.3048]) / 0.3048, "be in feet, and their heights in metres"),
        (0.3048 * np.eye(3), "be metres that were converted from feet"),
        (EXCHANGED, "have east and north exchanged"),
    ],
)
def test_error_that_is_undone_fits(matrix: FloatArray, error: str) -> None:
    """A map with east and north exchanged may fit as well: this was named for 2 of 4 simulated surveys."""
    ground = Ground(NOTHING_KNOWN, FLAT, 15.0, math.inf)
    with workers(1, None, None) as each:
        assert likely_error_of_positions(tile_rows(PAIR, with_positions(matrix), ground), each) == error


def test_a_survey_names_the_error(caplog: pytest.LogCaptureFixture) -> None:
    magloc.survey(PAIR, with_positions(np.eye(3) / 0.3048), processes=1)
    assert "the positions appear to be in feet: the strongest anomaly fits much better" in caplog.text


@pytest.mark.slow
def test_a_survey_without_a_cause_lists_what_to_check(caplog: pytest.LogCaptureFixture) -> None:
    """White errors of the places of 0.3 m that are stated as 2 cm: no other position helps."""
    error_m = np.random.default_rng(3).normal(size=(len(ROWS), 3), scale=[0.3, 0.3, 0.0])
    magloc.survey(PAIR, replace(ROWS, array_position_m=ROWS.array_position_m + error_m), processes=1)
    assert "the positions appear" not in caplog.text
    assert "check heights, unit and axes of the positions" in caplog.text
