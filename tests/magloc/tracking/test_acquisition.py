"""Where a track starts: from one row, from several, and when not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from magloc.localization.fit.prior import NOTHING_KNOWN
from magloc.localization.fit.results import Fix
from magloc.tracking import acquisition as acquisition_module
from magloc.tracking.acquisition import Acquisition, Start, _after
from magloc.tracking.results import Row
from tests.magloc.localization.search.test_moving_array import N_ROWS, SOURCE, SQUARE, passing
from tests.passing_source import ARRAY, MOMENT, POSITION, readings_of
from tests.plain_locator import one_source

FloatArray = NDArray[np.float64]


def still_rows(n: int, position_m: FloatArray = POSITION, seed: int = 0) -> list[Row]:
    """Of a fixed tetrahedron and a source at rest."""
    readings = readings_of(ARRAY, np.tile(position_m, (n, 1)), np.tile(MOMENT, (n, 1)), seed)
    return [Row(0.5 * i, values) for i, values in enumerate(readings)]


def square_rows(n: int = N_ROWS, seed: int = 0) -> list[Row]:
    """Of four scalar sensors that pass a source at rest: one row does not determine it."""
    readings, origins, R, ambient = passing(SQUARE, n)
    readings = readings + 1e-11 * np.random.default_rng(seed).normal(size=readings.shape)
    return [Row(0.5 * i, *row) for i, row in enumerate(zip(readings, origins, R, ambient, strict=True))]


def first_start(acquisition: Acquisition, rows: list[Row]) -> tuple[int, Start]:
    for i, row in enumerate(rows):
        start, reason = acquisition.start(row)
        if start is not None:
            return i, start
        assert reason.startswith("not acquired: ")
    raise AssertionError("No track started.")


class TestFromOneRow:
    def test_where_it_is_certain(self) -> None:
        i, start = first_start(Acquisition(ARRAY, NOTHING_KNOWN, 0.1), still_rows(3))
        assert i == 0
        assert len(start.rows) == 1
        off = start.solution.position_m - POSITION
        # 5 σ: once in 1.7 million.
        assert off @ np.linalg.solve(start.solution.covariance[:3, :3], off) < chi2.isf(5.7e-7, 3)

    def test_one_that_looks_certain_enough_is_confirmed_by_the_next(self) -> None:
        """6.9 m away the range is known to 2 % by one row: the noise of the first row must not choose the start."""
        acquisition = Acquisition(ARRAY, NOTHING_KNOWN, 1.0)
        (first, reason), (second, _) = map(acquisition.start, still_rows(2, 2.0 * POSITION))
        assert first is None
        assert reason == "not acquired: the next row is to confirm the source"
        assert second is not None
        assert [row.time_s for row in second.rows] == [0.5]

    def test_in_the_world_frame(self) -> None:
        """The same row of an array that is turned and elsewhere: the same source there, and its covariance."""
        (row,) = still_rows(1)
        R = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        moved = replace(row, origin_m=np.array([10.0, -20.0, 3.0]), R_world_from_array=R)
        here, there = (first_start(Acquisition(ARRAY, NOTHING_KNOWN, 0.1), [r])[1].solution for r in (row, moved))
        np.testing.assert_allclose(there.position_m, R @ here.position_m + moved.origin_m, rtol=1e-9)
        np.testing.assert_allclose(there.moment_Am2, R @ here.moment_Am2, rtol=1e-9)
        R6 = np.kron(np.eye(2), R)
        np.testing.assert_allclose(there.covariance, R6 @ here.covariance @ R6.T, rtol=1e-6, atol=1e-12)

    def test_noise_starts_none(self) -> None:
        rng = np.random.default_rng(3)
        acquisition = Acquisition(ARRAY, NOTHING_KNOWN, 0.1)
        for i in range(20):
            start, reason = acquisition.start(Row(float(i), 2e-10 * rng.normal(size=12)))
            assert start is None
            assert reason.startswith("not acquired: ")


class TestFromSeveralRows:
    def test_of_a_moving_array(self) -> None:
        """Four sensors that read moduli: after some rows, within 5 σ (once in 1.7 million) and of a certain range."""
        rows = square_rows(32)
        i, start = first_start(Acquisition(SQUARE, NOTHING_KNOWN, 1e-6), rows)
        assert 8 <= i + 1 <= 32
        assert len(start.rows) > 2
        off = start.solution.position_m - SOURCE[:3]
        assert off @ np.linalg.solve(start.solution.covariance[:3, :3], off) < chi2.isf(5.7e-7, 3)

    def test_a_few_rows_tell_nothing_yet(self) -> None:
        acquisition = Acquisition(SQUARE, NOTHING_KNOWN, 1e-6)
        for row in square_rows()[:3]:
            start, reason = acquisition.start(row)
            assert start is None
            assert reason == "not acquired: one row does not determine the source"

    def test_of_an_array_at_rest_they_are_as_many_as_the_source_rests(self) -> None:
        """A source 8.6 m away, that one row leaves uncertain: rows of the last 1 % of the range over the speed."""
        rows = still_rows(40, 2.5 * POSITION, seed=1)
        _, slow = first_start(Acquisition(ARRAY, NOTHING_KNOWN, 0.02), rows)
        times = [row.time_s for row in slow.rows]
        assert len(times) > 1
        assert max(times) - min(times) <= 0.01 * 2.5 * 1.1 * float(np.linalg.norm(POSITION)) / 0.02
        assert all(start is None for start, _ in map(Acquisition(ARRAY, NOTHING_KNOWN, 10.0).start, rows[:20]))


class TestAfterAPrediction:
    def test_solutions_are_ranked_and_weighted_by_the_row_and_the_prediction(self) -> None:
        """One fits better by 1 and is 2 σ from where the source was predicted, which is worse by 3 in all."""
        far, near = (
            one_source([x, 0.0, 0.0], np.ones(3), np.eye(6), chi2=chi2, dof=6) for x, chi2 in ((5.0, 5.0), (3.0, 6.0))
        )
        found = _after(Fix((far, near)), np.array([3.0, 0.0, 0.0, 1.0, 1.0, 1.0]), np.eye(6))
        assert [solution.position_m[0] for solution in found.solutions] == [3.0, 5.0]
        np.testing.assert_allclose(
            [solution.weight for solution in found.solutions], np.array([1.0, np.exp(-1.5)]) / (1.0 + np.exp(-1.5))
        )

    def test_a_row_without_a_fix_has_none(self) -> None:
        assert _after(Fix((), reason="no signal"), np.ones(6), np.eye(6)).solutions == ()


Scripted = Callable[[list[float]], list[int]]


class TestTwoProposalsMustAgree:
    """What a fix of several rows proposes is written in advance: positions on a line, each certain to 1 mm."""

    @pytest.fixture
    def calls(self, monkeypatch: pytest.MonkeyPatch) -> Scripted:
        """Rows (of square_rows, counted from one) after which a track starts, for given proposals."""

        def started(heights: list[float], **changes: object) -> list[int]:
            interval = changes.pop("range_interval_m", ((1.0, 1.1),))
            covariance = changes.pop("covariance", 1e-6 * np.eye(6))
            values = {"chi2": 30.0, "dof": 30, **changes}

            proposals = iter(heights)

            def fix(*_: object, **__: object) -> Fix:
                place = [0.0, 0.0, -next(proposals)]
                return Fix((one_source(place, np.ones(3), covariance, range_interval_m=interval, **values),))

            monkeypatch.setattr(acquisition_module, "fit_at_rest", fix)
            acquisition = Acquisition(SQUARE, NOTHING_KNOWN, 1e-6)
            starts = [acquisition.start(row)[0] for row in square_rows(4 * len(heights))]
            return [i + 1 for i, start in enumerate(starts) if start is not None]

        return started

    def test_the_first_one_starts_nothing(self, calls: Scripted) -> None:
        assert calls([1.0]) == []
        assert calls([1.0, 1.0005]) == [8]

    def test_one_elsewhere_does_not_agree(self, calls: Scripted) -> None:
        """10 mm are 7 σ of their difference; after that the next one must agree with it."""
        assert calls([1.0, 1.01, 1.02, 1.0205]) == [16]

    def test_within_4_σ_of_their_difference(self, calls: Scripted) -> None:
        """The limit is that of χ² of three numbers that noise exceeds once in 1000: 4.03 σ, of √2 mm each."""
        limit = float(np.sqrt(chi2.isf(1e-3, 3) * 2e-6))
        assert calls([1.0, 1.0 + 0.99 * limit]) == [8]
        assert calls([1.0, 1.0 + 1.01 * limit]) == []

    @pytest.mark.parametrize(
        "uncertain",
        [{"range_interval_m": ((1.0, None),)}, {"chi2": 300.0}, {"covariance": np.eye(6)}],
        ids=lambda change: next(iter(change)),
    )
    def test_one_that_is_no_start_proposes_nothing(self, calls: Scripted, uncertain: dict[str, object]) -> None:
        assert calls([1.0, 1.0, 1.0], **uncertain) == []  # type: ignore[call-arg]

    def test_what_was_proposed_is_forgotten(self) -> None:
        rows = square_rows(32)
        acquisition = Acquisition(SQUARE, NOTHING_KNOWN, 1e-6)
        i, _ = first_start(acquisition, rows)
        acquisition.forget()
        again = [start is not None for start, _ in map(acquisition.start, rows[i + 1 : i + 5])]
        assert not any(again)
