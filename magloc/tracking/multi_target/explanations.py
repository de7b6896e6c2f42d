"""Beam search over births, deaths and faults that explain a row."""

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
"""Energy of a residual in a cell above which there is another source: 3 degrees of freedom, the best of ~100 cells."""
LEFT_LIMIT = 25.0
"""Energy of the mean residual of recent rows above which a late birth is tried."""
COST_LIMIT = 5.0
"""Excess of χ² over its mean, in standard deviations, at which a row contradicts the prediction."""
SENSOR_OUT, BIRTH, DEATH, MANOEUVRE = 32.0, 16.0, 14.0, 12.0
"""Penalty of an event: -2 ln of its prior probability."""
MANOEUVRE_AGILITY = 10.0
"""Factor of the noise of velocity and turn in the step of a manoeuvre."""
IDS_PER_ROW = 100
"""The id of a source is this times the row of its birth, plus a number."""
MOST_BY_ITSELF = 5
"""Largest number of sources that are searched for one by one; a search for more takes seconds and fails."""
# Squared Mahalanobis distance below which two sources are the same.
_SAME_SIGMA2 = 1.0
# Penalty of an excluded sensor: 1.5 times the mean χ² of its three readings, so that good sensors are kept.
_LEFT_OUT = 4.5
# Number of cells from which a birth starts, and the least energy in them.
_BIRTH_STARTS = 4
_WORTH_A_BIRTH = 16.0
# Steps of the first update of a birth.
_START_TRIALS = 20
# Width of the beam, and largest number and score difference of explanations returned.
_WIDTH = 4
_RETURNED = 3
_AS_GOOD = 20.0
# Search from nothing: numbers of explanations split and refined, rounds and least gain of a refinement.
_SPLIT_WIDTH = 2
_REFINED = 10
_ROUNDS, _SCORE_GAIN = 4, 0.05
# Increase of the score by a further source that ends the search; largest score difference and number of its results.
_NO_MORE = 15.0
_WEIGHED = 25.0
_MOST_WEIGHED = 8
# Offset of the halves of a split source over the distance to the nearest sensor.
_HALVES = 0.25
_SAME_SCORE = 0.1
# Index of the memory of residuals for late births, and factor from its mean of unit variance to one row.
_LEFT_MEMORY, _LEFT_SHARE = 1, 0.25
_NEXT_TO_NO_MOMENT = np.array([0.0, 0.0, 1e-30])
# Factor of the prior σ of a late birth, and number of its starts.
_LATE_SPREAD, _LATE_STARTS = 2.0, 8
_MUCH_STRONGER = 100.0
# Largest share of a source's energy in one sensor; with more it cannot be distinguished from a fault.
_LONELY = 0.9
# Prior σ of a new source: direction of the moment [rad], ln of its strength, position over distance.
_TURN, _LOG_STRENGTH, _PLACE = 1.0, 1.5, 0.5


@dataclass(frozen=True, eq=False)
class Scene:
    """Constants of a tracker: array, motion, prior and largest number of sources."""

    channels: Channels
    motion: FreeMotion
    prior: SourcePrior
    most_sources: int

    @property
    def array(self) -> SensorArray:
        """Array of the rows."""
        return self.channels.array


@dataclass(frozen=True, eq=False)
class Explanation:
    """A prediction with events such as births, and its update by the row's readings.

    Attributes
    ----------
    prior : JointState
        Prediction after the events.
    update : JointUpdate
    ids : tuple of int
        Ids of the sources.
    out : ndarray of bool, shape (N,)
        Sensors that are excluded.
    penalty : float
        Sum of the penalties of the events.
    """

    prior: JointState
    update: JointUpdate
    ids: tuple[int, ...]
    out: BoolArray
    penalty: float = 0.0

    @property
    def score(self) -> float:
        """-2 ln of the probability of row and events, up to a constant."""
        return self.update.score + self.penalty + _LEFT_OUT * float(np.count_nonzero(self.out))

    @property
    def excess(self) -> float:
        """Excess of χ² of the row over its mean, in standard deviations."""
        n = max(1, self.update.row.n_readings)
        return (self.update.cost - n) / float(np.sqrt(2.0 * n))


@dataclass(frozen=True, eq=False)
class RowProblem:
    """Search for explanations of one row.

    Attributes
    ----------
    scene : Scene
    row : Row
    index : int
        Index of the row, part of the ids of sources born in it.
    step : ndarray, shape (13,)
        Step of the motion to the row.
    further : dict
        Cache of :meth:`_expand`, by the identity of the explanation.
    """

    scene: Scene
    row: Row
    index: int
    step: FloatArray
    further: dict[int, tuple[Explanation, list[Explanation]]] = field(default_factory=dict)

    @cached_property
    def joint_row(self) -> JointRow:
        """Measurement model of the row with all readings."""
        return self.scene.channels.joint_row(self.row)

    @cached_property
    def _cells(self) -> Cells:
        return self.scene.channels.of(self.row)[1]

    def update(self, prior: JointState, ids: tuple[int, ...], out: BoolArray, penalty: float = 0.0) -> Explanation:
        """Return the explanation by a prediction, updated by the row's readings."""
        return Explanation(prior, joint_update(prior, self.joint_row.without(out)), ids, out, penalty)

    def is_consistent(self, found: Explanation) -> bool:
        """Return True if nothing in the row contradicts an explanation."""
        if not (found.update.converged and found.excess < COST_LIMIT):
            return False
        if float(found.update.sensor_chi2.max()) > SENSOR_LIMIT:
            return False
        full = len(found.ids) >= self.scene.most_sources
        return full or float(self._cells.energy(found.update.residual).max()) < BIRTH_LIMIT

    def explanations(self, plain: Explanation, manoeuvring: JointState) -> list[Explanation]:
        """Return the likeliest consistent explanations, starting from an inconsistent one.

        A manoeuvre of the known sources is tried last; otherwise a known source would jump to a new one.
        """
        if not plain.ids:
            return self.explain_from_nothing(plain.prior, plain.out) or self._beam(plain, self.scene.most_sources + 1)
        found = self._beam(plain, self.scene.most_sources + 1)
        if found:
            return found
        moved = self.update(manoeuvring, plain.ids, plain.out, plain.penalty + MANOEUVRE)
        return [moved] if self.is_consistent(moved) else self._beam(moved, 1)

    def explain_from_nothing(self, common: JointState, out: BoolArray) -> list[Explanation]:
        """Return consistent explanations without known sources, the likeliest first.

        Two sources at wrong places may explain the readings of three, and leave no residual for a birth. Therefore
        sources are also split in two, and all are refined together.
        """
        level, best = [self.update(common, (), out)], np.inf
        found: list[Explanation] = []
        while level and len(level[0].ids) < min(self.scene.most_sources, MOST_BY_ITSELF):
            starts = [child for one in level[:_WIDTH] for child in self.births(one)]
            starts += [child for one in level[:_SPLIT_WIDTH] for child in self._halve_sources(common, one)]
            level = drop_same_places(self._refine(common, one) for one in drop_duplicates(starts)[:_REFINED])
            found += level
            if level and level[0].score > best + _NO_MORE:
                break
            best = min([best, *(one.score for one in level)])
        consistent = [
            one
            for one in sorted(found, key=_score)
            if self.is_consistent(one) and self.allows(one.update.state, self.joint_row)
        ]
        likely = [one for one in consistent if one.score < consistent[0].score + _WEIGHED][:_MOST_WEIGHED]
        return [replace(one, ids=self._new_ids(len(one.ids), i * MOST_BY_ITSELF)) for i, one in enumerate(likely)]

    def _halve_sources(self, common: JointState, found: Explanation) -> Iterator[Explanation]:
        """Yield explanations with one source split in two halves along an axis."""
        state = found.update.state
        for k, (place_m, moment) in enumerate(zip(state.position_m, state.moment_Am2, strict=True)):
            others = np.arange(len(state.position_m)) != k
            in_array = self.row.R_world_from_array.T @ (place_m - self.row.origin_m)
            nearest_m = float(np.linalg.norm(self.scene.array.positions - in_array, axis=1).min())
            for axis in np.eye(3):
                halves_m = place_m + _HALVES * nearest_m * np.stack([axis, -axis])
                places_m = np.concatenate([state.position_m[others], halves_m])
                moments = np.concatenate([state.moment_Am2[others], 0.5 * np.stack([moment, moment])])
                yield self.explain_sources(common, places_m, moments, found.out)

    def _refine(self, common: JointState, found: Explanation) -> Explanation:
        """Update again from its own sources as the prior, until the score no longer improves."""
        for _ in range(_ROUNDS):
            state = found.update.state
            again = self.explain_sources(common, state.position_m, state.moment_Am2, found.out)
            if not again.score < found.score - _SCORE_GAIN:
                break
            found = again
        return found

    def explain_with_at_least(self, nothing: Explanation, least: int) -> list[Explanation]:
        """Return explanations with a least number of sources; fewer may be consistent and wrong."""
        return self._beam(nothing, least + 1, least)

    def _beam(self, plain: Explanation, most_events: int, least: int = 0) -> list[Explanation]:
        """Return the likeliest consistent explanations with at most some number of events."""
        level = [plain]
        for _ in range(most_events):
            # An event must improve the likelihood by more than its penalty.
            level = drop_duplicates(
                one
                for before in level[:_WIDTH]
                for one in self._expand(before)
                if one.score < before.score or len(before.ids) < len(one.ids) <= least
            )
            holding = [found for found in level if len(found.ids) >= least and self.is_consistent(found)]
            if holding and least:
                return holding[:_RETURNED]
            if holding:
                holding = drop_duplicates(
                    [*holding, *(fewer for found in holding[:_WIDTH] for fewer in self._merge_births(found))]
                )
                return [found for found in holding if found.score < holding[0].score + _AS_GOOD][:_RETURNED]
        return []

    def _merge_births(self, found: Explanation) -> list[Explanation]:
        """Return consistent explanations with one fewer of the sources born in this row.

        A first birth between two sources leads to two more births, one of which is redundant.
        """
        born = [k for k, name in enumerate(found.ids) if name >= self.first_id]
        if len(born) < 2:
            return []
        return [
            fewer
            for fewer in self.remove_sources(found, born, list(combinations(born, 2)))
            if self.is_consistent(fewer)
        ]

    def remove_sources(
        self, found: Explanation, sources: Sequence[int], pairs: Sequence[tuple[int, int]]
    ) -> Iterator[Explanation]:
        """Yield explanations without each of some sources, and with each of some pairs merged."""
        prior, state, ids, penalty = found.prior, found.update.state, found.ids, found.penalty - BIRTH
        for k in sources:
            yield self.update(prior.without(k), ids[:k] + ids[k + 1 :], found.out, penalty)
        for first, second in pairs:
            place_m = 0.5 * (state.position_m[first] + state.position_m[second])
            together = state.moment_Am2[first] + state.moment_Am2[second]
            others = tuple(id for k, id in enumerate(ids) if k not in (first, second))
            alone = self.with_sources(prior.without(second).without(first), place_m[None], together[None])
            yield self.update(alone, (*others, min(ids[first], ids[second])), found.out, penalty)

    def _expand(self, found: Explanation) -> list[Explanation]:
        """Return the explanations with one more event: an excluded sensor, a death or a birth."""
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
            yield self.update(found.prior, found.ids, out, found.penalty + SENSOR_OUT)
        for k in range(len(found.ids)):
            ids = found.ids[:k] + found.ids[k + 1 :]
            yield self.update(found.prior.without(k), ids, found.out, found.penalty + DEATH)
        if len(found.ids) < self.scene.most_sources:
            yield from self.births(found)

    def births(self, found: Explanation) -> Iterator[Explanation]:
        """Yield explanations with another source, from the cells that explain most of the residual."""
        energy = self._cells.energy(found.update.surprise)
        born = 1 + sum(name >= self.first_id for name in found.ids)
        for cell in self._cells.best(energy, _BIRTH_STARTS):
            if energy[cell] < _WORTH_A_BIRTH:
                continue
            update = found.update
            ids = (*found.ids, self.first_id + born)
            prior = self.with_sources(
                found.prior, *self._cell_source(cell, update.innovation, update.projector_before, update.row.used)
            )
            start = joint_update(prior, update.row, _START_TRIALS).state
            if not 0.0 < np.linalg.norm(start.moment_Am2[-1]) < np.inf:
                continue
            # The next event starts from the place found, not from the cell.
            prior = self.with_sources(found.prior, start.position_m[-1:], start.moment_Am2[-1:])
            child = self.update(prior, ids, found.out, found.penalty + BIRTH)
            if self.allows(child.update.state, child.update.row, slice(-1, None)):
                yield child

    @property
    def first_id(self) -> int:
        """Lower bound of the ids of sources born in this row."""
        return self.index * IDS_PER_ROW

    def mean_residual(self, health: SensorHealth) -> tuple[FloatArray, float]:
        """Return the mean residual (C,) of recent rows, and its energy in the best cell."""
        mean = health.means[_LEFT_MEMORY].ravel()
        return mean, float(self._cells.energy(mean).max())

    def late_birth_priors(self, prior: JointState, found: Explanation, left: FloatArray) -> Iterator[JointState]:
        """Yield predictions with another source at the best cells of a mean residual (C,)."""
        update = found.update
        for cell in self._cells.best(self._cells.energy(left), _LATE_STARTS):
            source = self._cell_source(cell, _LEFT_SHARE * left, update.projector, update.row.used)
            yield self.with_sources(prior, *source, _LATE_SPREAD)

    def _cell_source(
        self, cell: int, left: FloatArray, projector: FloatArray, used: BoolArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return position and best moment (1, 3) of a source in a cell, for a residual (C,)."""
        R = self.row.R_world_from_array
        place_m = self.row.origin_m + R @ self._cells.position_m[cell]
        return place_m[None], (R @ self._cells.moment(cell, left, projector, used))[None]

    def allows(self, state: JointState, row: JointRow, born: slice = slice(None)) -> bool:
        """Return True if sources agree with the prior, and are neither faults nor ambient field.

        A source in the readings of a single sensor may be a fault of that sensor. A far source that is much stronger
        than the others may be a gradient of the ambient field.
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
        """Return the state with further sources (j, 3) and nearly flat priors about them."""
        scene = self.scene
        # The best moment of a cell may be zero next to a sensor with much less noise.
        moment_Am2 = np.where(moment_Am2.any(axis=-1, keepdims=True), moment_Am2, _NEXT_TO_NO_MOMENT)
        strength = np.sqrt(np.vecdot(moment_Am2, moment_Am2))[:, None]
        log_strength = spread * _LOG_STRENGTH
        known = scene.prior.known_moment
        if known is not None:
            log_strength = known.sigma_Am2 / known.modulus_Am2
            moment_Am2 = known.modulus_Am2 / strength * moment_Am2
        from_centroid = position_m - self.joint_row.centroid_m
        away_m = np.maximum(
            spread * _PLACE * np.sqrt(np.vecdot(from_centroid, from_centroid)), scene.array.circumradius
        )
        roots = scene.motion.start(moment_Am2, away_m, _TURN, log_strength)
        return state.with_sources(position_m, moment_Am2, roots)

    def explain_sources(
        self, common: JointState, positions_m: FloatArray, moments_Am2: FloatArray, out: BoolArray
    ) -> Explanation:
        """Return the explanation by sources (K, 3) of a search, with nearly flat priors."""
        ids = self._new_ids(len(positions_m))
        return self.update(self.with_sources(common, positions_m, moments_Am2), ids, out, BIRTH * len(ids))

    def _new_ids(self, number: int, after: int = 0) -> tuple[int, ...]:
        return tuple(self.first_id + after + 1 + k for k in range(number))


def drop_duplicates(found: Iterable[Explanation]) -> list[Explanation]:
    """Return explanations without duplicates, which several cells may find, the likeliest first."""
    unique: list[Explanation] = []
    for one in sorted(found, key=_score):
        if not any(abs(one.score - other.score) < _SAME_SCORE and len(one.ids) == len(other.ids) for other in unique):
            unique.append(one)
    return unique


def drop_same_places(found: Iterable[Explanation]) -> list[Explanation]:
    """Return explanations, the likeliest first, with at most one for each set of sources."""
    unique: list[Explanation] = []
    for one in sorted((one for one in found if np.isfinite(one.score)), key=_score):
        if not any(are_same(one.update.state, other.update.state) for other in unique):
            unique.append(one)
    return unique


def far_sources(state: JointState) -> list[int]:
    """Return indices of sources so strong, thus far, that they look like a field gradient."""
    strength = np.linalg.norm(state.moment_Am2, axis=1)
    return np.flatnonzero(strength > _MUCH_STRONGER * strength.min(initial=np.inf)).tolist()


def are_same(first: JointState, second: JointState) -> bool:
    """Return True if two states have the same sources, in any order."""
    if first.n_sources != second.n_sources:
        return False
    offset = first.position_m[:, None] - second.position_m
    apart = np.linalg.solve(first.covariances[:, None, :3, :3], offset[..., None])[..., 0]
    near = np.vecdot(offset, apart) < _SAME_SIGMA2
    return bool(near.any(axis=1).all() and near.any(axis=0).all())


def _score(found: Explanation) -> float:
    return found.score
