"""What a row may be explained by otherwise."""

from __future__ import annotations

import numpy as np

import magloc
from magloc.tracking.multi_target.explanations import BIRTH, RowProblem
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.results import Row
from tests.magloc.tracking.multi_target.test_update import BOARD, COMMON_T, MOMENTS, PLACES, readings


def test_one_source_that_stands_for_two_is_halved():
    """From the best single source at least one pair of halves comes within 3 mm of both, and is likelier."""
    problem = RowProblem(magloc.SourcesTracker(BOARD).scene, Row(0.0, readings(np.random.default_rng(2))), 0)
    nothing, out = JointState.empty(COMMON_T, 1e-6), np.zeros(BOARD.n_sensors, dtype=bool)
    single = problem.found_anew(nothing, PLACES.mean(axis=0)[None], MOMENTS.sum(axis=0)[None], out)
    best = min(problem.halved(single), key=lambda one: one.score)
    assert best.score < single.score
    assert best.penalty == 2.0 * BIRTH
    apart = np.linalg.norm(best.update.found.position_m[:, None] - PLACES, axis=-1)
    np.testing.assert_array_less(apart.min(axis=0), 3e-3)
