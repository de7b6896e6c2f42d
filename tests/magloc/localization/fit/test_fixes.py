"""Columns of many fixes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from magloc.localization.fit.fixes import Fixes


def test_columns_that_are_not_given_have_a_row_each_and_others_stay() -> None:
    fixes = Fixes.unsolved(np.arange(3.0), "nothing")
    assert fixes.too_near.tolist() == [False] * 3
    assert fixes.saturated_channels == [()] * 3
    too_near, saturated = np.array([False, True, False]), [("a.x",), (), ()]
    given = replace(fixes, too_near=too_near, saturated_channels=saturated)
    assert given.too_near.tolist() == too_near.tolist()
    assert given.saturated_channels == saturated
