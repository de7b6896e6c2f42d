"""What may have happened in a row that its prediction does not explain: a beam over the fewest, likeliest events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations

import numpy as np

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.localization.fit.prior import SourcePrior
from magloc.tracking.multi_target.measurement import Cells, Channels, JointRow
from magloc.tracking.multi_target.motion import FreeMotion
from magloc.tracking.multi_target.state import JointState
from magloc.tracking.multi_target.update import JointUpdate, joint_update
from magloc.tracking.rows import Row
from magloc.tracking.sensor_health import SENSOR_LIMIT, SensorHealth

BIRTH_LIMIT = 45.0
"""Energy, of three degrees of freedom, in one of some hundred cells above which another source is there."""
LEFT_LIMIT = 25.0
"""The same of mean residuals of the last rows, above which it is asked whether one has come slowly."""
COST_LIMIT = 5.0
"""Standard deviations above its mean at which χ² of a row contradicts the prediction."""
SENSOR_OUT, BIRTH, DEATH, MANOEUVRE = 32.0, 16.0, 14.0, 12.0
"""What an event costs, as -2 ln of how likely it is."""
MANOEUVRE_AGILITY = 10.0
"""How much faster than usual a source moves and turns in the step of a manoeuvre."""
NAMES_A_ROW = 100
"""A source's name is this times the row of its birth, and a number."""
MOST_BY_ITSELF = 5
"""Sources that are searched for one by one; of more that takes seconds and leads nowhere."""
# Squared distance in units of its covariance below which two states are one.
_SAME_SIGMA2 = 1.0
# What three readings of noise cost, and half as much again: a sensor that is well is better not left out.
_LEFT_OUT = 4.5
# A birth starts from so many cells, if they explain that much.
_BIRTH_STARTS = 4
_WORTH_A_BIRTH = 16.0
# Steps of a first update that tells where a birth is to begin.
_START_TRIALS = 20
# Explanations that go on from one event to the next, and those that are returned.
_WIDTH = 4
_RETURNED = 3
_AS_GOOD = 20.0
# From nothing: explanations of which sources are split, and those that are refined, so often until they are that good.
_SPLIT_WIDTH = 2
_REFINED = 10
_ROUNDS, _SCORE_GAIN = 4, 0.05
# More sources are not looked for where one more was that much less likely, and explanations are kept up to that.
_NO_MORE = 15.0
_WEIGHED = 25.0
_MOST_WEIGHED = 8
# By what share of the distance to the nearest sensor the halves of a source are moved apart.
_HALVES = 0.25
_SAME_SCORE = 0.1
# Which of the memories of residuals is asked, and what a mean of unit variance is of one row.
_LEFT_MEMORY, _LEFT_SHARE = 1, 0.25
_NEXT_TO_NO_MOMENT = np.array([0.0, 0.0, 1e-30])
# How much less is known of a source that is found in many weak rows than where they first seem to have it.
_LATE_SPREAD, _LATE_STARTS = 2.0, 8
_MUCH_STRONGER = 100.0
# Share of a source's energy in one sensor above which no other sensor sees it.
_LONELY = 0.9
# What is known of a new source: the direction of its moment [rad], ln of its strength, its place over its distance.
_TURN, _LOG_STRENGTH, _PLACE = 1.0, 1.5, 0.5


@dataclass(frozen=True, eq=False)
class Scene:
    """What does not change from row to row: array, motion, and what is known of the sources."""

    channels: Channels
    motion: FreeMotion
    prior: SourcePrior
    most_sources: int

    @property
    def array(self) -> SensorArray:
        """Whose rows they are."""
        return self.channels.array


@dataclass(frozen=True, eq=False)
class Explanation:
    """A prediction, what has happened since, and the update by the row's readings.

    Attributes
    ----------
    prior : JointState
        The prediction after what has happened.
    update : JointUpdate
    ids : tuple of int
        Of the sources.
    out : ndarray of bool, shape (N,)
        Sensors that are left out.
    penalty : float
        Of what has happened.
    """

    prior: JointState
    update: JointUpdate
    ids: tuple[int, ...]
    out: BoolArray
    penalty: float = 0.0

    @property
    def score(self) -> float:
        """-2 ln of how likely the row is with what has happened, up to a constant."""
        return self.update.score + self.penalty + _LEFT_OUT * float(np.count_nonzero(self.out))

    @property
    def excess(self) -> float:
        """χ² of the row above its mean, in standard deviations."""
        n = max(1, self.update.row.n_readings)
        return (self.update.cost - n) / float(np.sqrt(2.0 * n))


@dataclass(frozen=True, eq=False)
class RowProblem:
    """One row that is to be explained.

    Attributes
    ----------
    scene : Scene
    row : Row
    index : int
        Of the row: sources that are born in it are called by it.
    step : ndarray, shape (13,)
        Of the motion to it.
    further : dict
        Explanations that were asked what else may have happened, by their identity, and the answers.
    """

    scene: Scene
    row: Row
    index: int
    step: FloatArray
    further: dict[int, tuple[Explanation, list[Explanation]]] = field(default_factory=dict)

    @cached_property
    def measured(self) -> JointRow:
        """All readings of the row."""
        return self.scene.channels.measured(self.row)

    @cached_property
    def _cells(self) -> Cells:
        return self.scene.channels.of(self.row)[1]

    def updated(self, prior: JointState, ids: tuple[int, ...], out: BoolArray, penalty: float = 0.0) -> Explanation:
        """The readings put into a prediction."""
        return Explanation(prior, joint_update(prior, self.measured.without(out)), ids, out, penalty)

    def holds(self, found: Explanation) -> bool:
        """Whether nothing in the row contradicts an explanation."""
        if not (found.update.converged and found.excess < COST_LIMIT):
            return False
        if float(found.update.sensor_chi2.max()) > SENSOR_LIMIT:
            return False
        full = len(found.ids) >= self.scene.most_sources
        return full or float(self._cells.energy(found.update.residual).max()) < BIRTH_LIMIT

    def explanations(self, plain: Explanation, manoeuvring: JointState) -> list[Explanation]:
        """The likeliest explanations that hold, from one that does not; none: nothing explains the row.

        That the known sources manoeuvre is only tried where nothing else holds: else an old one jumps onto a newcomer.
        """
        if not plain.ids:
            return self.anew(plain.prior, plain.out) or self._beam(plain, self.scene.most_sources + 1)
        found = self._beam(plain, self.scene.most_sources + 1)
        if found:
            return found
        moved = self.updated(manoeuvring, plain.ids, plain.out, plain.penalty + MANOEUVRE)
        return [moved] if self.holds(moved) else self._beam(moved, 1)

    def anew(self, common: JointState, out: BoolArray) -> list[Explanation]:
        """Explanations from nothing that hold, the likeliest first, of each number of sources that is not hopeless.

        Two sources may explain what three do, in a wrong place, and leave nothing for a birth to start from: so sources
        are split in two as well, and all of them refined together.
        """
        level, best = [self.updated(common, (), out)], np.inf
        found: list[Explanation] = []
        while level and len(level[0].ids) < min(self.scene.most_sources, MOST_BY_ITSELF):
            starts = [child for one in level[:_WIDTH] for child in self.births(one)]
            starts += [child for one in level[:_SPLIT_WIDTH] for child in self._halved(common, one)]
            level = apart(self._refined(common, one) for one in distinct(starts)[:_REFINED])
            found += level
            if level and level[0].score > best + _NO_MORE:
                break
            best = min([best, *(one.score for one in level)])
        held = [
            one for one in sorted(found, key=_score) if self.holds(one) and self.allows(one.update.state, self.measured)
        ]
        held = [one for one in held if one.score < held[0].score + _WEIGHED][:_MOST_WEIGHED]
        return [replace(one, ids=self._names(len(one.ids), i * MOST_BY_ITSELF)) for i, one in enumerate(held)]

    def _halved(self, common: JointState, found: Explanation) -> Iterator[Explanation]:
        """The row explained with a source in two halves, along each axis."""
        state = found.update.state
        for k, (place_m, moment) in enumerate(zip(state.position_m, state.moment_Am2, strict=True)):
            others = np.arange(len(state.position_m)) != k
            in_array = self.row.R_world_from_array.T @ (place_m - self.row.origin_m)
            nearest_m = float(np.linalg.norm(self.scene.array.positions - in_array, axis=1).min())
            for axis in np.eye(3):
                halves_m = place_m + _HALVES * nearest_m * np.stack([axis, -axis])
                places_m = np.concatenate([state.position_m[others], halves_m])
                moments = np.concatenate([state.moment_Am2[others], 0.5 * np.stack([moment, moment])])
                yield self.found_anew(common, places_m, moments, found.out)

    def _refined(self, common: JointState, found: Explanation) -> Explanation:
        """The same with nothing known but where it was found, until that does not make it likelier."""
        for _ in range(_ROUNDS):
            state = found.update.state
            again = self.found_anew(common, state.position_m, state.moment_Am2, found.out)
            if not again.score < found.score - _SCORE_GAIN:
                break
            found = again
        return found

    def of_more_sources(self, nothing: Explanation, least: int) -> list[Explanation]:
        """Explanations from nothing, with some number of sources at least: fewer may hold in a row, and be wrong."""
        return self._beam(nothing, least + 1, least)

    def _beam(self, plain: Explanation, most_events: int, least: int = 0) -> list[Explanation]:
        level = [plain]
        for _ in range(most_events):
            # An event that does not make the row likelier by more than it costs leads nowhere.
            level = distinct(
                one
                for before in level[:_WIDTH]
                for one in self._one_event_more(before)
                if one.score < before.score or len(before.ids) < len(one.ids) <= least
            )
            holding = [found for found in level if len(found.ids) >= least and self.holds(found)]
            if holding and least:
                return holding[:_RETURNED]
            if holding:
                holding = distinct([*holding, *(fewer for found in holding[:_WIDTH] for fewer in self._merged(found))])
                return [found for found in holding if found.score < holding[0].score + _AS_GOOD][:_RETURNED]
        return []

    def _merged(self, found: Explanation) -> list[Explanation]:
        """The same with a source less, of those that are born in this row, where that holds too.

        A first birth between two sources is followed by two more, of which two stand for one.
        """
        born = [k for k, name in enumerate(found.ids) if name >= self.first_id]
        if len(born) < 2:
            return []
        return [fewer for fewer in self.one_less(found, born, list(combinations(born, 2))) if self.holds(fewer)]

    def one_less(
        self, found: Explanation, sources: Sequence[int], pairs: Sequence[tuple[int, int]]
    ) -> Iterator[Explanation]:
        """Without each of some sources, and with one source in place of each of some pairs."""
        prior, state, ids, penalty = found.prior, found.update.state, found.ids, found.penalty - BIRTH
        for k in sources:
            yield self.updated(prior.without(k), ids[:k] + ids[k + 1 :], found.out, penalty)
        for first, second in pairs:
            place_m = 0.5 * (state.position_m[first] + state.position_m[second])
            together = state.moment_Am2[first] + state.moment_Am2[second]
            others = tuple(name for k, name in enumerate(ids) if k not in (first, second))
            alone = self.with_sources(prior.without(second).without(first), place_m[None], together[None])
            yield self.updated(alone, (*others, min(ids[first], ids[second])), found.out, penalty)

    def _one_event_more(self, found: Explanation) -> list[Explanation]:
        """A sensor out, a death, and births at the best cells."""
        if id(found) not in self.further:
            self.further[id(found)] = found, list(self._events(found))
        return self.further[id(found)][1]

    def _events(self, found: Explanation) -> Iterator[Explanation]:
        if not found.update.converged and not np.isfinite(found.update.cost):
            return
        chi2 = found.update.sensor_chi2
        worst = int(np.argmax(chi2))
        if 2 * np.count_nonzero(found.out) < len(found.out) and chi2[worst] > 0.5 * SENSOR_LIMIT:
            out = found.out.copy()
            out[worst] = True
            yield self.updated(found.prior, found.ids, out, found.penalty + SENSOR_OUT)
        for k in range(len(found.ids)):
            ids = found.ids[:k] + found.ids[k + 1 :]
            yield self.updated(found.prior.without(k), ids, found.out, found.penalty + DEATH)
        if len(found.ids) < self.scene.most_sources:
            yield from self.births(found)

    def births(self, found: Explanation) -> Iterator[Explanation]:
        """Explanations with another source, from the cells that explain most of what is left."""
        energy = self._cells.energy(found.update.surprise)
        born = 1 + sum(name >= self.first_id for name in found.ids)
        for cell in self._cells.best(energy, _BIRTH_STARTS):
            if energy[cell] < _WORTH_A_BIRTH:
                continue
            update = found.update
            ids = (*found.ids, self.first_id + born)
            prior = self.with_sources(
                found.prior, *self._at(cell, update.innovation, update.seen_before, update.row.used)
            )
            start = joint_update(prior, update.row, _START_TRIALS).state
            if not 0.0 < np.linalg.norm(start.moment_Am2[-1]) < np.inf:
                continue
            # Where it is found, not where it was looked for, is what the next event starts from.
            prior = self.with_sources(found.prior, start.position_m[-1:], start.moment_Am2[-1:])
            child = self.updated(prior, ids, found.out, found.penalty + BIRTH)
            if self.allows(child.update.state, child.update.row, slice(-1, None)):
                yield child

    @property
    def first_id(self) -> int:
        """Below those of the sources that are born in this row."""
        return self.index * NAMES_A_ROW

    def left(self, health: SensorHealth) -> tuple[FloatArray, float]:
        """Mean residuals (C,) of the last rows, of unit variance, and the most of their energy that a cell explains."""
        mean = health.means[_LEFT_MEMORY].ravel()
        return mean, float(self._cells.energy(mean).max())

    def starts(self, prior: JointState, found: Explanation, left: FloatArray) -> Iterator[JointState]:
        """Predictions with another source at the cells that explain most of mean residuals (C,)."""
        update = found.update
        for cell in self._cells.best(self._cells.energy(left), _LATE_STARTS):
            source = self._at(cell, _LEFT_SHARE * left, update.seen, update.row.used)
            yield self.with_sources(prior, *source, _LATE_SPREAD)

    def _at(self, cell: int, left: FloatArray, seen: FloatArray, used: BoolArray) -> tuple[FloatArray, FloatArray]:
        """Place and moment (1, 3) of the source in a cell that explains most of what is left."""
        R = self.row.R_world_from_array
        place_m = self.row.origin_m + R @ self._cells.position_m[cell]
        return place_m[None], (R @ self._cells.moment(cell, left, seen, used))[None]

    def allows(self, state: JointState, row: JointRow, born: slice = slice(None)) -> bool:
        """Whether sources agree with what is known, and may be told from a fault and from the ambient field.

        A single sensor that sees one may be at fault; one so far away that it is much stronger than the others is a
        gradient of the ambient field.
        """
        if far_sources(state):
            return False
        return all(
            self._allows_one(row, position, moment)
            for position, moment in zip(state.position_m[born], state.moment_Am2[born], strict=True)
        )

    def _allows_one(self, row: JointRow, position_m: FloatArray, moment_Am2: FloatArray) -> bool:
        in_array = self.row.R_world_from_array.T @ (position_m - self.row.origin_m)
        if not (self.scene.prior.allows_position(in_array) and self.scene.prior.allows_moment(moment_Am2)):
            return False
        energy = row.energy_of(position_m, moment_Am2)
        return bool(energy.max() < _LONELY * energy.sum())

    def with_sources(
        self, state: JointState, position_m: FloatArray, moment_Am2: FloatArray, spread: float = 1.0
    ) -> JointState:
        """The state with other sources (j, 3), of which hardly more is known than where the readings have them."""
        scene = self.scene
        # The best moment of a cell may be zero beside a sensor that is a billion times better.
        moment_Am2 = np.where(moment_Am2.any(axis=-1, keepdims=True), moment_Am2, _NEXT_TO_NO_MOMENT)
        strength = np.sqrt(np.vecdot(moment_Am2, moment_Am2))[:, None]
        log_strength = spread * _LOG_STRENGTH
        known = scene.prior.known_moment
        if known is not None:
            log_strength = known.sigma_Am2 / known.modulus_Am2
            moment_Am2 = known.modulus_Am2 / strength * moment_Am2
        from_centroid = position_m - self.measured.centroid_m
        away_m = np.maximum(
            spread * _PLACE * np.sqrt(np.vecdot(from_centroid, from_centroid)), scene.array.circumradius
        )
        roots = scene.motion.start(moment_Am2, away_m, _TURN, log_strength)
        return state.with_sources(position_m, moment_Am2, roots)

    def found_anew(
        self, common: JointState, positions_m: FloatArray, moments_Am2: FloatArray, out: BoolArray
    ) -> Explanation:
        """The row explained by sources (K, 3) that a search has found, with nothing else known of them."""
        ids = self._names(len(positions_m))
        return self.updated(self.with_sources(common, positions_m, moments_Am2), ids, out, BIRTH * len(ids))

    def _names(self, number: int, after: int = 0) -> tuple[int, ...]:
        return tuple(self.first_id + after + 1 + k for k in range(number))


def distinct(found: Iterable[Explanation]) -> list[Explanation]:
    """The likeliest first, without those that are one: births from different cells often end in the same place."""
    kept: list[Explanation] = []
    for one in sorted(found, key=_score):
        if not any(abs(one.score - other.score) < _SAME_SCORE and len(one.ids) == len(other.ids) for other in kept):
            kept.append(one)
    return kept


def apart(found: Iterable[Explanation]) -> list[Explanation]:
    """The likeliest first, without those whose sources are where those of a likelier one are."""
    kept: list[Explanation] = []
    for one in sorted((one for one in found if np.isfinite(one.score)), key=_score):
        if not any(are_same(one.update.state, other.update.state) for other in kept):
            kept.append(one)
    return kept


def far_sources(state: JointState) -> list[int]:
    """Those that are so much stronger than another one that they are far away, where all is a gradient."""
    strength = np.linalg.norm(state.moment_Am2, axis=1)
    return np.flatnonzero(strength > _MUCH_STRONGER * strength.min(initial=np.inf)).tolist()


def are_same(first: JointState, second: JointState) -> bool:
    """Whether two states have the same sources, in some order."""
    if first.n_sources != second.n_sources:
        return False
    offset = first.position_m[:, None] - second.position_m
    apart = np.linalg.solve(first.covariances[:, None, :3, :3], offset[..., None])[..., 0]
    near = np.vecdot(offset, apart) < _SAME_SIGMA2
    return bool(near.any(axis=1).all() and near.any(axis=0).all())


def _score(found: Explanation) -> float:
    return found.score
