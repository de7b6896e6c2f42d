"""Classes of a target."""

from __future__ import annotations

import numpy as np
import pytest

from magloc.surveying.results import Target


def target(strength_Am2: float, *flags: str) -> Target:
    moment = strength_Am2 * np.array([0.0, 0.6, 0.8])
    return Target("t1", np.array([0.0, 0.0, -1.0]), moment, np.eye(6), 1.0, (0.9, 1.1), 900.0, flags)


class TestClasses:
    @pytest.mark.parametrize(
        ("strength_Am2", "expected"),
        [(0.0, "small"), (0.299, "small"), (0.301, "medium"), (2.999, "medium"), (3.001, "large"), (300.0, "large")],
    )
    def test_size(self, strength_Am2: float, expected: str) -> None:
        assert target(strength_Am2).size_class == expected

    @pytest.mark.parametrize(
        ("flags", "expected"),
        [((), "good"), (("weak",), "weak"), (("weak", "near"), "near"), (("near", "misfit", "merged"), "misfit")],
    )
    def test_quality_is_the_worst_flag(self, flags: tuple[str, ...], expected: str) -> None:
        assert target(1.0, *flags).fit_quality == expected
