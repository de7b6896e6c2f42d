"""Decisions about a survey against surveys of the same rows, and against the truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import magloc
import sims
from arrays.typing import FloatArray
from magloc.readings import Readings
from magloc.surveying.review.decisions import Drop
from sims.magnetics.paths import Steered
from sims.magnetics.scenario import Carrier, Source
from sims.magnetics.simulation import Simulation
from tests.hills import PAIR, hills, terrain_of, walk
from tests.magloc.surveying import test_tiled
from tests.magloc.surveying.test_survey import nearest, simulated, surveyed

# χ² of the last step of a fit: two fits of the same rows may be that far apart.
SETTLED = 0.1
POLYGON_m = [[-6.0, 1.0], [6.0, 1.0], [6.0, 3.2], [-6.0, 3.2]]


def reviewed() -> magloc.Review:
    return magloc.Review(surveyed("survey-drone", 901))


def state_of(target: magloc.Target) -> FloatArray:
    return np.concatenate([target.position_m, target.moment_Am2])


def assert_same(found: magloc.Survey, expected: magloc.Survey) -> None:
    """Same targets within the last step of a fit, with the same errors."""
    assert len(found) == len(expected)
    for target in found:
        other = nearest(expected, target.position_m)
        step = state_of(target) - state_of(other)
        assert step @ np.linalg.solve(other.covariance, step) < 4.0 * SETTLED
        np.testing.assert_allclose(
            np.diagonal(target.covariance), np.diagonal(other.covariance), rtol=0.05 if target.flags else 0.02
        )
    assert found.chi2_per_dof == pytest.approx(expected.chi2_per_dof, rel=1e-3)


def some_rows(readings: Readings, which: np.ndarray) -> Readings:
    return readings[np.flatnonzero(which)]


class TestRefit:
    def test_without_a_decision_changes_nothing(self) -> None:
        found = reviewed().found
        assert_same(reviewed().refit().found, found)

    def test_after_an_exclusion_equals_a_survey_of_the_other_rows(self) -> None:
        field = simulated("survey-drone", 901)
        places = field.readings.array_position_m
        assert places is not None
        inside = (np.abs(places[:, 0]) < 6.0) & (places[:, 1] > 1.0) & (places[:, 1] < 3.2)
        review = reviewed().exclude_polygon(POLYGON_m).refit()
        assert review.decisions[0].numbers == {"rows": int(inside.sum())}
        assert len(review.found.rows.time_s) == len(field.readings) - inside.sum()
        assert_same(review.found, magloc.survey(field.array, some_rows(field.readings, ~inside)))

    def test_after_a_stretch_is_excluded(self) -> None:
        field = simulated("survey-drone", 901)
        time_s = field.readings.time_s
        line = reviewed().found.flight_lines[4]
        from_s, to_s = time_s[line.rows][[0, -1]]
        review = reviewed().exclude_stretch(from_s, to_s).refit()
        rest = (time_s < from_s) | (time_s > to_s)
        assert_same(review.found, magloc.survey(field.array, some_rows(field.readings, rest)))

    def test_estimated_errors_of_places_are_estimated_again(self) -> None:
        field = simulated("survey-drone", 901)
        found = magloc.survey(replace(field.array, pose=None), field.readings)
        again = magloc.Review(found).refit().found
        assert found.pose_assumed
        assert again.array.pose == found.array.pose


class TestTargets:
    def test_dropped_and_added_at_its_place_it_is_the_same(self) -> None:
        found = reviewed().found
        place = found[1].position_m[:2].tolist()
        without = reviewed().drop("t2").refit()
        assert without.ids == ("t1",)
        assert without.found.chi2_per_dof > found.chi2_per_dof
        review = without.add(place).refit()
        assert review.ids == ("t1", "a1")
        assert_same(review.found, found)

    def test_a_depth_that_is_given_is_a_start(self) -> None:
        found = reviewed().found
        at = [*found[1].position_m[:2], found[1].position_m[2] - 0.2]
        assert_same(reviewed().drop("t2").add(at).refit().found, found)

    def test_all_may_be_dropped(self) -> None:
        review = reviewed().drop("t1").drop("t2").refit()
        assert len(review.found) == 0
        np.testing.assert_array_equal(review.found.rows.residual_T, review.found.rows.anomaly_T)

    def test_one_where_nothing_is_stays_and_says_so(self) -> None:
        """A person decided; χ² of 3 degrees of freedom is below 30 in all but one of a million."""
        x, y = reviewed().found[0].position_m[:2]
        review = reviewed().add([-x, -y]).refit()
        (added,) = (target for target in review.found if target.id == "a1")
        assert added.significance < 30.0
        assert "weak" in added.flags


@cache
def pair() -> Simulation:
    """Two targets so near each other that the survey finds one."""
    places, moments = ((-0.2, 0.0, -0.7), (0.2, 0.0, -0.7)), ((2.0, 1.0, -6.0), (3.0, -2.0, -5.0))
    sources = tuple(Source(Carrier(Steered(place)), moment) for place, moment in zip(places, moments, strict=True))
    return sims.simulate(replace(simulated("survey-drone", 905, 0).scenario, sources=sources), rng=921)


class TestSplit:
    def test_of_a_merged_pair_finds_both(self) -> None:
        """χ² of three: 1 in 10,000 right ones is beyond 21."""
        field = pair()
        (merged,) = found = magloc.survey(field.array, field.readings)
        assert "merged" in merged.flags
        review = magloc.Review(found).split("t1").refit()
        assert sorted(review.ids) == ["t1a", "t1b"]
        assert not any("merged" in target.flags for target in review.found)
        for truth in field.truths:
            target = nearest(review.found, truth.position_m[0])
            error = target.position_m - truth.position_m[0]
            assert error @ np.linalg.solve(target.covariance[:3, :3], error) < 21.0

    def test_at_given_places_it_is_the_same_pair(self) -> None:
        found = magloc.survey(pair().array, pair().readings)
        by_search, by_hand = (
            magloc.Review(found).split("t1", places).refit().found for places in ((), [[-0.3, 0.0], [0.3, 0.0]])
        )
        assert_same(by_hand, by_search)


class TestTwoTiles:
    """One target on the seam, and one whose field the other tile subtracts."""

    def test_dropped_and_added_they_are_the_same(self) -> None:
        review = magloc.Review(test_tiled.surveyed(1))
        found = review.found
        for target in found:
            review = review.drop(target.id).add(target.position_m[:2].tolist())
        again = review.refit(processes=1).found
        assert [target.id for target in again] == ["a1", "a2", "a3"]
        assert_same(again, found)

    def test_after_an_exclusion_equals_a_survey_of_the_other_rows(self) -> None:
        readings = test_tiled.field().readings
        rest = (readings.time_s < 20.0) | (readings.time_s > 26.0)
        again = magloc.Review(test_tiled.surveyed(1)).exclude_stretch(20.0, 26.0).refit(processes=1).found
        prior = test_tiled.SHALLOW
        assert_same(again, magloc.survey(test_tiled.field().array, some_rows(readings, rest), prior=prior, processes=1))


def test_on_hills_a_target_is_added_below_the_local_ground() -> None:
    found = magloc.survey(PAIR, walk(41, hills, 5.0, 3).readings, ground_m=terrain_of(hills))
    review = magloc.Review(found)
    for target in found:
        review = review.drop(target.id).add(target.position_m[:2].tolist())
    assert_same(review.refit().found, found)


class TestLog:
    def test_replays_to_the_same_result(self, tmp_path: Path) -> None:
        review = reviewed().drop("t2").add([0.0, 0.5]).refit().split("t1").exclude_polygon(POLYGON_m).refit()
        review.write_decisions(tmp_path / "decisions.jsonl")
        again = reviewed().replay(tmp_path / "decisions.jsonl")
        assert again.decisions == review.decisions
        assert [target.id for target in again.found] == [target.id for target in review.found]
        for target, other in zip(again.found, review.found, strict=True):
            np.testing.assert_array_equal(target.covariance, other.covariance)
            np.testing.assert_array_equal(target.position_m, other.position_m)

    def test_has_times_and_numbers(self) -> None:
        found = reviewed().found
        decision = reviewed().drop("t2").pending[0]
        assert decision.when.endswith("Z")
        assert decision.numbers["significance"] == pytest.approx(found[1].significance, abs=0.01)
        np.testing.assert_allclose(decision.numbers["position_m"], found[1].position_m, rtol=0.0, atol=1e-4)

    def test_ends_with_a_fit(self) -> None:
        review = reviewed().replay([Drop(target="t2")])
        assert review.pending == ()
        assert review.ids == ("t1",)

    def test_of_another_survey_is_refused(self) -> None:
        other = Drop(target="t2", numbers={"position_m": [30.0, 40.0, -1.0]})
        with pytest.raises(ValueError, match="entry 1: target t2 must be where the decision says"):
            reviewed().replay([other])

    def test_undo(self) -> None:
        review = reviewed().drop("t2").drop("t1").undo()
        assert review.ids == ("t1",)
        with pytest.raises(ValueError, match="must have a decision"):
            reviewed().undo()


class TestRefusals:
    def test_a_target_that_is_not_there(self) -> None:
        with pytest.raises(ValueError, match="must be one of t1, t2; instead received t9"):
            reviewed().drop("t9")
        with pytest.raises(ValueError, match="must be one of t2, t1a, t1b; instead received t1"):
            reviewed().split("t1").drop("t1")

    def test_a_place_without_rows(self) -> None:
        with pytest.raises(ValueError, match=r"of a row on the map; instead received \(90, 0\)"):
            reviewed().add([90.0, 0.0])
        with pytest.raises(ValueError, match="below the ground; instead received one 5 m above it"):
            reviewed().add([0.0, 0.5, 5.0])

    def test_rows_to_exclude(self) -> None:
        with pytest.raises(ValueError, match="must contain a row"):
            reviewed().exclude_polygon([[50.0, 0.0], [51.0, 0.0], [51.0, 1.0]])
        with pytest.raises(ValueError, match="must leave 20 rows or more; instead received 0"):
            reviewed().exclude_stretch(-1e9, 1e9)

    def test_a_result_without_its_rows(self) -> None:
        with pytest.raises(ValueError, match=r"must be a result of magloc\.survey"):
            magloc.Review(replace(reviewed().found, state=None)).refit()
