"""Review of a survey by a person, with a log that replays to the same result."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from scipy.optimize import linear_sum_assignment

from arrays.io.errors import own_sentence
from arrays.io.text import write_text
from arrays.typing import BoolArray, FloatArray
from magloc import core
from magloc.grids.work import workers
from magloc.surveying.fit.joint_fit import Sources
from magloc.surveying.piece import refit_sources
from magloc.surveying.preparation import FEWEST_ROWS
from magloc.surveying.results import Survey, Target
from magloc.surveying.review import edits
from magloc.surveying.review.decisions import (
    Add,
    Decision,
    Drop,
    Exclude,
    Refit,
    Split,
    decision_lines,
    now,
    read_decisions,
)
from magloc.surveying.review.edits import SurveyEdit
from magloc.surveying.review.state import SurveyState
from magloc.surveying.tiled import TiledSurvey

_SAME_TARGET_M = 0.5  # a target of a log that is farther from its place then is another one


@dataclass(frozen=True, eq=False)
class Review:
    """Survey under review: decisions are collected, and :meth:`refit` applies them.

    Attributes
    ----------
    found : Survey
        Result of the last fit.
    pending : tuple
        Decisions since then.

    Examples
    --------
    >>> import sims
    >>> import magloc
    >>> from dataclasses import replace
    >>> scenario = replace(sims.read_scenario("survey-drone"), duration_s=120.0)
    >>> field = sims.simulate(scenario, rng=1)
    >>> review = magloc.Review(magloc.survey(field.array, field.readings))
    >>> review = review.drop("t3").exclude_stretch(100.0, 120.0).refit()
    >>> review.found
    Survey: 2 targets, 1600 rows
    """

    found: Survey
    pending: tuple[Decision, ...] = ()

    @property
    def decisions(self) -> tuple[Decision, ...]:
        """All decisions in their order."""
        return (*self.found.decisions, *self.pending)

    @property
    def ids(self) -> tuple[str, ...]:
        """Names of the targets after all decisions."""
        ids = [target.id for target in self.found]
        for number, decision in enumerate(self.pending):
            if isinstance(decision, Drop | Split):
                ids.remove(decision.target)
            ids += self._new_ids(number)
        return tuple(ids)

    def drop(self, target: str) -> Review:
        """Drop a target."""
        return self.decide(Drop(target=target))

    def split(self, target: str, places_m: Sequence[Sequence[float]] = ()) -> Review:
        """Split a target in two, at places (x, y) or (x, y, z) if given."""
        return self.decide(Split(target=target, places_m=[list(map(float, place)) for place in places_m]))

    def add(self, place_m: Sequence[float]) -> Review:
        """Add a target at a place (x, y), or (x, y, z), in the world frame."""
        return self.decide(Add(place_m=list(map(float, place_m))))

    def exclude_polygon(self, corners_m: Sequence[Sequence[float]]) -> Review:
        """Exclude the rows in a polygon of corners (x, y) in the world frame."""
        return self.decide(Exclude(polygon_m=[list(map(float, corner)) for corner in corners_m]))

    def exclude_stretch(self, from_s: float, to_s: float) -> Review:
        """Exclude the rows between two times, such as a stretch of a line."""
        return self.decide(Exclude(from_s=from_s, to_s=to_s))

    def undo(self) -> Review:
        """Take back the last decision since the last fit."""
        if not self.pending:
            raise ValueError("Input review must have a decision since its last fit; instead received none.")
        return replace(self, pending=self.pending[:-1])

    def decide(self, decision: Decision) -> Review:
        """Add a decision, with its time and the numbers that it is based on.

        Raises
        ------
        ValueError
            There is no such target, or it is elsewhere than the decision says, or no such row.
        """
        if isinstance(decision, Refit):
            return self.refit(decision)
        numbers: dict[str, Any] = {}
        if isinstance(decision, Drop | Split):
            SurveyEdit(_state(self.found).tiled, self.ids).index(decision.target)
            numbers = self._numbers_of(decision)
        elif isinstance(decision, Exclude):
            numbers = {"rows": self._count_excluded(decision)}
        for place_m in _places_of(decision):
            edits.check_place(_state(self.found).tiled, place_m)
        return replace(self, pending=(*self.pending, _completed(decision, numbers)))

    def refit(
        self,
        decision: Refit | None = None,
        *,
        processes: int | None = None,
        progress: Callable[[str], None] | None = None,
    ) -> Review:
        """Fit all targets jointly to all remaining rows, and keep all of them.

        Parameters
        ----------
        decision : Refit, optional
            Entry of a log that this fit repeats.
        processes : int, optional
            Number of processes for tiles; by default the number of threads of compiled code.
        progress : callable, optional
            Called with a sentence after every tile.
        """
        state = _state(self.found)
        targets = list(self.found)
        sources = Sources.none()
        if targets:
            sources = Sources(*(np.array([getattr(t, name) for t in targets]) for name in ("position_m", "moment_Am2")))
        edit = SurveyEdit(state.tiled.with_sources(sources), tuple(target.id for target in targets))
        for number, pending in enumerate(self.pending):
            edit = self._apply(edit, pending, self._new_ids(number))
        tiled, tell = edit.tiled, progress or (lambda _: None)
        with workers(min(core.threads() if processes is None else processes, len(tiled.tiles)), None, None) as each:
            if len(tiled.tiles) > 1:
                tiled, _ = tiled.settle(refit_sources, each, tell)
            names = _Names(edit.ids, edit.tiled.sources.position_m)
            found = replace(state, tiled=tiled).measure(each, tell, names, keep_all=True)
        summary = {"targets": len(found), "rows": len(found.rows.time_s), "chi2_per_dof": found.chi2_per_dof}
        return Review(replace(found, decisions=(*self.decisions, _completed(decision or Refit(), summary))))

    def replay(
        self, log: str | os.PathLike[str] | Iterable[Decision], progress: Callable[[str], None] | None = None
    ) -> Review:
        """Return the review after all decisions of a log, a file or decisions, with a fit at the end."""
        review = self
        for number, decision in enumerate(read_decisions(log) if isinstance(log, str | os.PathLike) else log, start=1):
            try:
                if isinstance(decision, Refit):
                    review = review.refit(decision, progress=progress)
                else:
                    review = review.decide(decision)
            except ValueError as error:
                raise ValueError(f"Input entry {number}: {own_sentence(error)}") from None
        return review.refit(progress=progress) if review.pending else review

    def write_decisions(self, path: str | os.PathLike[str]) -> None:
        """Write the log of decisions as JSON lines."""
        write_text(decision_lines(self.decisions), Path(path))

    def _new_ids(self, number: int) -> tuple[str, ...]:
        """Return the names of the targets that a pending decision makes."""
        decision = self.pending[number]
        if isinstance(decision, Split):
            return f"{decision.target}a", f"{decision.target}b"
        if isinstance(decision, Add):
            before = [*self.found.decisions, *self.pending[: number + 1]]
            return (f"a{sum(isinstance(one, Add) for one in before)}",)
        return ()

    def _apply(self, edit: SurveyEdit, decision: Decision, new: tuple[str, ...]) -> SurveyEdit:
        """Return the survey after one decision."""
        if isinstance(decision, Drop):
            return edits.drop(edit, decision.target)
        if isinstance(decision, Split):
            return edits.split(edit, decision.target, decision.places_m, (new[0], new[1]))
        if isinstance(decision, Add):
            return edits.add(edit, decision.place_m, new[0])
        if isinstance(decision, Exclude):
            return edits.exclude_rows(edit, rows_of(edit.tiled, decision))
        return edit

    def _count_excluded(self, decision: Exclude) -> int:
        """Return the number of rows that a decision excludes; refuse one that excludes none, or too many."""
        tiled = _state(self.found).tiled
        rows = rows_of(tiled, decision)
        if not rows.any():
            raise ValueError("Input rows to exclude must contain a row of the survey; instead received none.")
        every = [rows, *(rows_of(tiled, one) for one in self.pending if isinstance(one, Exclude))]
        left = int((~np.any(every, axis=0)).sum())
        if left < FEWEST_ROWS:
            raise ValueError(f"Input rows to exclude must leave {FEWEST_ROWS} rows or more; instead received {left}.")
        return int(rows.sum())

    def _numbers_of(self, decision: Drop | Split) -> dict[str, Any]:
        """Return the numbers of a decision's target; refuse one at another place than the decision says."""
        target = next((one for one in self.found if one.id == decision.target), None)
        if target is None:  # it is new and has no numbers before the next fit
            return {}
        then = decision.numbers.get("position_m")
        if then is not None and (apart_m := math.dist(target.position_m, then)) > _SAME_TARGET_M:
            raise ValueError(
                f"Input target {target.id} must be where the decision says; instead received one {apart_m:.3g} m away:"
                " the log is of another survey, or of other options."
            )
        return _numbers(target)


@dataclass(frozen=True, eq=False)
class _Names:
    """Names of targets by the places from which their fit started; none for a source that two tiles fitted apart."""

    ids: tuple[str, ...]
    start_m: FloatArray

    def __call__(self, position_m: FloatArray) -> list[str]:
        names = [""] * len(position_m)
        for i, k in zip(
            *linear_sum_assignment(np.linalg.norm(position_m[:, None] - self.start_m, axis=-1)), strict=True
        ):
            names[i] = self.ids[k]
        return names


def _places_of(decision: Decision) -> list[list[float]]:
    return decision.places_m if isinstance(decision, Split) else [decision.place_m] if isinstance(decision, Add) else []


def rows_of(tiled: TiledSurvey, decision: Exclude) -> BoolArray:
    """Return the rows (n,) that a decision excludes."""
    if decision.polygon_m:
        return edits.inside_polygon(edits.row_places(tiled)[:, :2], np.array(decision.polygon_m))
    assert decision.from_s is not None
    assert decision.to_s is not None
    time_s = tiled.readings.time_s
    return np.asarray((time_s >= decision.from_s) & (time_s <= decision.to_s))


def _completed(decision: Decision, numbers: dict[str, Any]) -> Decision:
    """Return a decision with its time and its numbers; a decision from a log keeps its own."""
    return msgspec.structs.replace(decision, when=decision.when or now(), numbers=decision.numbers or numbers)


def _numbers(target: Target) -> dict[str, Any]:
    return {
        "position_m": [round(float(value), 4) for value in target.position_m],
        "depth_m": round(target.depth_m, 4),
        "strength_Am2": round(target.strength_Am2, 6),
        "significance": round(target.significance, 2),
        "flags": list(target.flags),
    }


def _state(found: Survey) -> SurveyState:
    if found.state is None:
        raise ValueError("Input found must be a result of magloc.survey; instead received one without its rows.")
    return found.state
