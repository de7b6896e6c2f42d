"""Magnets that move over a board, and how their tracks are judged.

Paths are sums of sinusoids, rates of turn Ornstein-Uhlenbeck processes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

import magloc
import sims
from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray
from magloc.fields import dipole
from magloc.tracking.results import SourcesPoint

RATE_HZ = 100.0
NOISE_T = 5e-7
AMBIENT_T = np.array([1.5e-6, 20.5e-6, -43e-6])
LOW_M, HIGH_M = np.array([-0.05, -0.04, 0.03]), np.array([0.05, 0.04, 0.08])
# Paths that are drawn one after the other: tries for one of them until all begin anew.
TRIES = 5000
SPEED_M_S, STRENGTH_AM2 = 0.3, (0.02, 0.1)
RATE_RAD_S, RATE_LASTS_S = 1.2, 0.4
# Rows in which a track must be nearer to another magnet than to its own to be counted as swapped.
ROWS_OF_A_SWAP = 20
# Square of a distance in units of a track's covariance within which a magnet may be the one it is of.
TOLD_APART = 25.0
FAULTS = ("zero", "stuck", "noisy", "drift")
# Magnets that repel each other: speed of an axis and how long it lasts, within how far beyond the gap they are pushed,
# how much, and rows that are drawn anew where one leaves the box, is too fast or too near, and how often.
WANDER_M_S, WANDER_LASTS_S = 0.08, 1.0
SOFT_M, PUSH_PER_S2, ROWS_ANEW, MOST_FAILED = 0.01, 800.0, 50, 200
# A magnet that slides in begins to, and how long it takes.
SLIDE_BEGINS_S, SLIDE_S = 2.0, 3.0
# Rows after the birth of the last magnet in which the others are looked at.
ROWS_AFTER_BIRTH = 100
# How often a second two magnets go to and fro, and how far from the middle.
PASSES_HZ, PASS_M = 0.4, 0.04


def board() -> SensorArray:
    """30 sensors, 16 mm apart, of 0.5 µT."""
    array = sims.read_scenario("hand-magnet").array  # type: ignore[union-attr]
    sensors = (
        replace(one, noise_T=NOISE_T, misalignment_rad=0.0, gain_uncertainty=0.0, flicker_T=0.0)
        for one in array.sensors
    )
    return replace(array, sensors=tuple(sensors), ambient_T=None)


@dataclass(frozen=True)
class Within:
    """What magnets are drawn within: heights, strengths, and of the box the share of each axis that one moves in.

    `one_by_one`: a path is drawn until it keeps the gap to those before it, not all of them anew, which of three
    magnets takes a minute, and of more for ever. `repelled`: five in a narrow box keep clear of each other, as a swarm
    does; sinusoids that do so by chance are not found.
    """

    highest_m: float = HIGH_M[2]
    weakest_Am2: float = STRENGTH_AM2[0]
    roam: float = 1.0
    one_by_one: bool = False
    repelled: bool = False


@dataclass(frozen=True, eq=False)
class Magnets:
    """Truth: positions and moments (K, n, 3), and when each magnet is there (K, n)."""

    position_m: FloatArray
    moment_Am2: FloatArray
    present: BoolArray

    @classmethod
    def drawn(
        cls,
        k: int,
        n_rows: int,
        gap_m: float,
        rng: np.random.Generator,
        *,
        come_and_go: bool = False,
        within: Within = Within(),
    ) -> Magnets:
        """Magnets whose paths keep a gap; `come_and_go`: the last one comes at 30 % of the rows and goes at 70 %."""
        position = _paths(k, n_rows, gap_m, within, rng)
        strength = rng.uniform(within.weakest_Am2, STRENGTH_AM2[1], k)
        moment = np.stack([one * _direction(n_rows, rng) for one in strength])
        present = np.ones((k, n_rows), dtype=bool)
        if come_and_go:
            present[-1, : int(0.3 * n_rows)] = present[-1, int(0.7 * n_rows) :] = False
        return cls(position, moment, present)

    @classmethod
    def crossing(cls, n_rows: int, gap_m: float, rng: np.random.Generator) -> Magnets:
        """Two magnets that go to and fro along a line, against each other, and pass at a gap."""
        half_m = np.full(3, np.inf)
        while (half_m > 0.5 * (HIGH_M - LOW_M)).any():
            way, across = Rotation.random(rng=rng).apply(np.eye(3)[:2])
            half_m = np.abs(PASS_M * way) + np.abs(0.5 * gap_m * across)
        centre = rng.uniform(LOW_M + half_m, HIGH_M - half_m)
        wave = np.sin(2.0 * np.pi * (PASSES_HZ * np.arange(n_rows) / RATE_HZ + rng.uniform()))
        offset = PASS_M * wave[:, None] * way + 0.5 * gap_m * across
        moment = np.stack([one * _direction(n_rows, rng) for one in rng.uniform(*STRENGTH_AM2, 2)])
        return cls(np.stack([centre + offset, centre - offset]), moment, np.ones((2, n_rows), dtype=bool))

    def sliding(self, from_m: float, rng: np.random.Generator) -> Magnets:
        """The same with the last one coming from far away, above the board."""
        to_go = 1.0 - np.clip((np.arange(self.present.shape[1]) / RATE_HZ - SLIDE_BEGINS_S) / SLIDE_S, 0.0, 1.0)
        way = rng.normal(size=3)
        way[2] = abs(way[2])
        position = self.position_m.copy()
        position[-1] += from_m * (to_go**2 * (3.0 - 2.0 * to_go))[:, None] * way / np.linalg.norm(way)
        return replace(self, position_m=position)

    def first(self, n_rows: int) -> Magnets:
        """The same for as long as some rows."""
        return Magnets(self.position_m[:, :n_rows], self.moment_Am2[:, :n_rows], self.present[:, :n_rows])

    def since(self, row: int) -> Magnets:
        """The same from a row on."""
        return Magnets(self.position_m[:, row:], self.moment_Am2[:, row:], self.present[:, row:])

    def readings_T(self, array: SensorArray, rng: np.random.Generator) -> FloatArray:
        """What the board reads (n, C)."""
        fields = np.zeros((self.present.shape[1], array.n_sensors, 3)) + AMBIENT_T
        for place, moment, there in zip(self.position_m, self.moment_Am2, self.present, strict=True):
            fields += there[:, None, None] * dipole.field(array.positions, place[:, None], moment[:, None])
        return array.readings_of(fields) + NOISE_T * rng.normal(size=(len(fields), array.n_channels))


def _paths(k: int, n_rows: int, gap_m: float, within: Within, rng: np.random.Generator) -> FloatArray:
    """Paths (k, n, 3) that keep a gap."""
    if within.repelled:
        return _repelled_paths(k, n_rows, gap_m, within, rng)
    at_once, position = 1 if within.one_by_one else k, np.zeros((0, n_rows, 3))
    while len(position) < k:
        for _ in range(TRIES):
            more = np.stack([_path(n_rows, within, rng) for _ in range(at_once)])
            tried = np.concatenate([position, more])
            apart = np.linalg.norm(tried[:, None] - more, axis=-1)
            if np.sort(apart, axis=0)[1:].min(initial=np.inf) >= gap_m:
                position = tried
                break
        else:
            position = np.zeros((0, n_rows, 3))
    return position


def _repelled_paths(k: int, n_rows: int, gap_m: float, within: Within, rng: np.random.Generator) -> FloatArray:
    """Wanderers in the box that push each other and are pushed by its walls, softly.

    Where two come too near after all, or one is too fast or leaves, some last rows are drawn anew.
    """
    low, high = LOW_M, np.array([*HIGH_M[:2], within.highest_m])
    kept, itself = np.exp(-1.0 / (RATE_HZ * WANDER_LASTS_S)), np.diag(np.full(k, np.inf))
    path: list[tuple[FloatArray, FloatArray]] = []
    failed = 0
    while len(path) < n_rows:
        if not path or failed > MOST_FAILED:
            position, failed = low + (high - low) * rng.uniform(size=(k, 3)), 0
            near = (np.linalg.norm(position[:, None] - position, axis=-1) + itself).min() < gap_m
            path = [] if near else [(position, np.zeros((k, 3)))]
            continue
        position, velocity = path[-1]
        offset = position[:, None] - position
        apart = (np.linalg.norm(offset, axis=-1) + itself)[:, :, None]
        push = np.sum(np.maximum(gap_m + SOFT_M - apart, 0.0) * offset / apart, axis=1)
        push += np.maximum(low + SOFT_M - position, 0.0) - np.maximum(position - high + SOFT_M, 0.0)
        noise = WANDER_M_S * np.sqrt(1.0 - kept**2) * rng.normal(size=(k, 3))
        velocity = kept * velocity + PUSH_PER_S2 / RATE_HZ * push + noise
        position = position + velocity / RATE_HZ
        outside = np.maximum(low - position, position - high).max() > 0.0
        too_near = (np.linalg.norm(position[:, None] - position, axis=-1) + itself).min() < gap_m
        if outside or too_near or np.linalg.norm(velocity, axis=1).max() > SPEED_M_S:
            del path[max(1, len(path) - ROWS_ANEW) :]
            failed += 1
        else:
            path.append((position, velocity))
    return np.stack([position for position, _ in path], axis=1)


def _path(n_rows: int, within: Within, rng: np.random.Generator) -> FloatArray:
    """Three sinusoids an axis within the box, or a part of it, no faster than the largest speed."""
    t = np.arange(n_rows) / RATE_HZ
    frequency, phase = rng.uniform(0.15, 0.45, (3, 3)), rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    share = rng.dirichlet(np.ones(3), 3)
    wave = np.sum(share[:, :, None] * np.sin(2.0 * np.pi * frequency[:, :, None] * t + phase[:, :, None]), axis=1).T
    low, high = LOW_M, np.array([*HIGH_M[:2], within.highest_m])
    if within.roam < 1.0:
        low = low + (1.0 - within.roam) * (high - low) * rng.uniform(size=3)
        high = low + within.roam * (np.array([*HIGH_M[:2], within.highest_m]) - LOW_M)
    position = 0.5 * (low + high) + 0.5 * (high - low) * wave
    speed = np.linalg.norm(np.diff(position, axis=0), axis=1).max(initial=0.0) * RATE_HZ
    return position if speed <= SPEED_M_S else _path(n_rows, within, rng)


def _direction(n_rows: int, rng: np.random.Generator) -> FloatArray:
    """Unit vectors (n, 3) that turn, by 180°/s at most along an axis."""
    kept = np.exp(-1.0 / (RATE_HZ * RATE_LASTS_S))
    rate = RATE_RAD_S * rng.normal(size=3)
    turned, directions = Rotation.random(rng=rng), []
    for _ in range(n_rows):
        directions.append(turned.apply([0.0, 0.0, 1.0]))
        turned = Rotation.from_rotvec(np.clip(rate, -np.pi, np.pi) / RATE_HZ) * turned
        rate = kept * rate + RATE_RAD_S * np.sqrt(1.0 - kept**2) * rng.normal(size=3)
    return np.array(directions)


def with_fault(readings_T: FloatArray, kind: str, sensor: int, first: int, drift_T_s: float = 2e-6) -> FloatArray:
    """Readings (n, C) of which a sensor fails from a row on."""
    bad, at = readings_T.copy(), slice(3 * sensor, 3 * sensor + 3)
    left = len(bad) - first
    if kind == "zero":
        bad[first:, at] = 0.0
    elif kind == "stuck":
        bad[first:, at] = bad[first, at]
    elif kind == "noisy":
        bad[first:, at] += 20.0 * NOISE_T * np.random.default_rng(first).normal(size=(left, 3))
    else:
        bad[first:, at] += drift_T_s / np.sqrt(3.0) * (np.arange(1, left + 1) / RATE_HZ)[:, None]
    return bad


@dataclass(frozen=True, eq=False)
class Run:
    """How one run went; NEES is per dimension, over all rows and tracks that are told.

    `early_swaps` counts from the row in which a track was first told, where its covariance may have two magnets within;
    `swaps` from the first one in which it has a single one. Before that its error is that from the nearest.
    """

    swaps: int
    early_swaps: int
    false_births: int
    lost_rows: int
    misfit_rows: int
    merged_rows: int
    late_birth_rows: int
    late_loss_rows: int
    nees: float
    rms_m: float
    named: dict[str, int]
    row_ms: FloatArray
    others: dict[str, float]


def judged(points: list[SourcesPoint], truth: Magnets, row_ms: FloatArray) -> Run:
    """Tracks against the magnets: each is of the nearest one when it is first told, or first told apart."""
    owners: tuple[dict[int, int], dict[int, int]] = {}, {}
    away: tuple[dict[int, int], dict[int, int]] = {}, {}
    swaps = [0, 0]
    named: dict[str, int] = {}
    squares, errors, false, lost = [], [], 0, 0
    old: set[int] = set()
    of_others = np.full((len(points), 3), np.nan)
    last = truth.present[-1]
    first, end = int(np.argmax(last)), int(len(last) - np.argmax(last[::-1]))
    seen_first, seen_last = len(last), 0
    for row, point in enumerate(points):
        for name in point.dropped_sensors:
            named.setdefault(name, row)
        there, others = np.flatnonzero(truth.present[:, row]), []
        of_others[row, 1] = point.status in ("misfit", "doubtful")
        false += len(point.tracks) > len(there)
        lost += len(point.tracks) < len(there)
        for track in point.tracks:
            assert track.position_m is not None
            apart = np.linalg.norm(truth.position_m[:, row] - track.position_m, axis=1)
            nearest = int(there[np.argmin(apart[there])])
            offsets = truth.position_m[there, row] - track.position_m
            within = np.vecdot(offsets, np.linalg.solve(track.covariance[:3, :3], offsets[..., None])[..., 0])
            for i, (owner, gone) in enumerate(zip(owners, away, strict=True)):
                if track.id not in owner and i and np.count_nonzero(within < TOLD_APART) != 1:
                    continue
                own = owner.setdefault(track.id, nearest)
                gone[track.id] = (
                    gone.get(track.id, 0) + 1 if nearest != own and apart[nearest] < 0.5 * apart[own] else 0
                )
                if gone[track.id] == ROWS_OF_A_SWAP:
                    swaps[i], owner[track.id] = swaps[i] + 1, nearest
            own = owners[1].get(track.id, nearest)
            if own == len(truth.present) - 1:
                seen_first, seen_last = min(seen_first, row), row + 1
            offset = track.position_m - truth.position_m[own, row]
            error = np.concatenate([offset, track.moment_Am2 - truth.moment_Am2[own, row]])
            if truth.present[own, row]:
                squares.append(error @ np.linalg.solve(track.covariance, error) / 6.0)
                errors.append(offset @ offset)
                if track.id in old and own != len(truth.present) - 1:
                    others.append(squares[-1])
                elif track.id not in old and row >= SLIDE_BEGINS_S * RATE_HZ:
                    of_others[row, 2] = squares[-1]
        of_others[row, 0] = np.mean(others) if others else np.nan
        old |= {track.id for track in point.tracks if row < SLIDE_BEGINS_S * RATE_HZ}
    return Run(
        swaps=swaps[1],
        early_swaps=swaps[0],
        false_births=false,
        lost_rows=lost,
        misfit_rows=sum(point.status == "misfit" for point in points),
        merged_rows=sum(any(track.merged for track in point.tracks) for point in points),
        late_birth_rows=seen_first - first,
        late_loss_rows=seen_last - end,
        nees=float(np.mean(squares)),
        rms_m=float(np.sqrt(np.mean(errors))),
        named=named,
        row_ms=row_ms,
        others=_of_others(of_others, seen_first),
    )


def _of_others(rows: FloatArray, born: int) -> dict[str, float]:
    """NEES of the others while the last magnet slides in and is not told, for a while after that, and later.

    Of the first two, how many rows have more than 3 and are not flagged; and NEES of what is told of the last one.
    """
    begins = int(SLIDE_BEGINS_S * RATE_HZ)
    told = max(born, begins)
    spans = {"before": slice(begins, told), "after": slice(told, told + ROWS_AFTER_BIRTH)}
    found: dict[str, float] = {"born": float(born)}
    for name, span in (spans | {"later": slice(told + ROWS_AFTER_BIRTH, None)}).items():
        found[name] = float(np.nanmean(rows[span, 0])) if np.isfinite(rows[span, 0]).any() else np.nan
        newcomer = rows[span, 2][np.isfinite(rows[span, 2])]
        found[f"its own {name}"] = float(np.mean(newcomer)) if len(newcomer) else np.nan
    silent = (rows[:, 0] > 3.0) & (rows[:, 1] == 0.0)
    return found | {"silent": float(np.count_nonzero(silent[begins : told + ROWS_AFTER_BIRTH]))}


def followed(array: SensorArray, readings_T: FloatArray, **options: object) -> tuple[list[SourcesPoint], FloatArray]:
    """Points of all rows, and the processor time of each [ms]."""
    tracker = magloc.SourcesTracker(array, **options)  # type: ignore[arg-type]
    points, took = [], []
    for row, values in enumerate(readings_T):
        begin = time.thread_time()
        points.append(tracker.update(magloc.Readings(values[None], time_s=np.array([row / RATE_HZ]))))
        took.append(1e3 * (time.thread_time() - begin))
    return points, np.array(took)
