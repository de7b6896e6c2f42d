"""No figure of a track is worse than the stored one: ``python -m tests.tracking_figures --compare`` shows all."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from tests.tracking_figures.figures import Comparison, Figures, Run, compare
from tests.tracking_figures.scenarios import QUICK, SCENARIOS, read_stored

OLD = read_stored()
LIKE = Run(1, 100, 1.2, 1.1, 600, 96, 100, 1.1, 1.0, 1.1, 1.0, {"swaps": 0}, ("s1 is well",))


def worse(**changes: object) -> list[str]:
    """Names of figures that are worse where a run is changed."""
    old, new = (Figures.of([run]) for run in (LIKE, replace(LIKE, **changes)))  # type: ignore[arg-type]
    return [one.name for one in compare(old, new) if one.worse]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in SCENARIOS]
)
def test_none_is_worse(name: str) -> None:
    """The same readings as those of the stored figures; what is allowed, tests/tracking_figures/figures.py derives."""
    assert OLD[name].seeds == tuple(SCENARIOS[name].seeds)
    found: list[Comparison] = compare(OLD[name], SCENARIOS[name].figures())
    assert [one for one in found if one.worse] == []


def test_every_scenario_is_stored() -> None:
    assert OLD.keys() == SCENARIOS.keys()


class TestComparison:
    def test_the_same_is_not_worse(self) -> None:
        assert worse() == []
        assert worse(cpu=100.0) == []

    def test_nearer_to_the_ideal_is_not_worse(self) -> None:
        assert worse(nees=1.0, nees_late=0.95, held=95, rms_m=0.9, wrong=(), tracked=101) == []

    @pytest.mark.parametrize(
        ("changes", "expected"),
        [
            # A tenth of 0.2 and √(2/600) = 0.058; the median's slack is √(π/600) = 0.072.
            ({"nees": 1.27}, []),
            ({"nees": 1.28}, ["nees"]),
            ({"nees": 0.7}, ["nees", "nees_median"]),
            ({"nees": math.nan}, ["nees", "nees_median"]),
            ({"nees_late": 1.3}, ["nees_late"]),
            ({"nees": 3.1}, ["nees", "nees_median", "broken"]),
            # A tenth of 0.01 and √(0.95 · 0.05/100) = 0.022.
            ({"held": 98}, []),
            ({"held": 91}, ["coverage"]),
            ({"held": 99}, ["coverage"]),
            # A tenth of 0.1, and 1.1/√600 = 0.045.
            ({"rms_m": 1.15}, []),
            ({"rms_m": 1.16}, ["ratio"]),
            ({"rms_m": 1.17}, ["ratio", "ratio_median"]),
            ({"late_m": 1.16}, ["ratio_late"]),
            ({"tracked": 99}, ["tracked"]),
            ({"counts": {"swaps": 1}}, ["swaps"]),
            ({"counts": {"swaps": 0, "rows that differ": 1}}, ["rows that differ"]),
            ({"wrong": ("s1 is well", "flagged")}, ["wrong"]),
        ],
    )
    def test_what_is_worse(self, changes: dict[str, object], expected: list[str]) -> None:
        assert worse(**changes) == expected

    def test_without_a_bound_the_error_itself_counts(self) -> None:
        old, new = (Figures.of([replace(LIKE, bound_m=math.nan, rms_m=rms_m)]) for rms_m in (1.0, 1.15))
        assert [one.name for one in compare(old, new) if one.worse] == ["rms_m"]

    def test_figures_are_stored_as_they_are(self) -> None:
        figures = Figures.of([LIKE, replace(LIKE, seed=2, nees=math.nan)])
        assert Figures.read(figures.json).json == figures.json
