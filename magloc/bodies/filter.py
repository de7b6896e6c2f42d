"""Track a body through time: pose, rates, and lasting errors of magnets and sensors, by ``pose_track.hpp``.

Velocity and rotation rate are Ornstein-Uhlenbeck processes, driven by white acceleration. Errors of the magnets'
moments and of the sensors are constants, or processes, that the whole track estimates. So are errors of the magnets'
positions and directions, whose effects are those at the pose of the row by itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc import core
from magloc.bodies.body import MagnetBody
from magloc.bodies.locator import BodyLocator
from magloc.bodies.plausibility import n_checks, warn_of_no_check
from magloc.bodies.readable_filter import FilterState, predicted_state, updated_state
from magloc.bodies.search import fit_problem, packed, signals_of_rows, unpacked
from magloc.bodies.track import (
    BodyMotion,
    BodyTrack,
    TrackRows,
    flag_misfits,
    joined_rows,
    nearest_poses,
    placement_effects,
)
from magloc.chi_square import quantile
from magloc.levels import CONTRADICTION
from magloc.measurement.channels import signals_of
from magloc.measurement.nuisances import SensorErrors, without_lasting_errors
from magloc.measurement.plausibility import warn_of_doubts
from magloc.measurement.rows import WhitenedRows, check_order, check_rows, whitened_rows, whitenings_of
from magloc.measurement.whitened import WhitenedModel
from magloc.readings import Readings, as_readings, without_saturated

MOST_CONTRADICTIONS = 3
"""Rows in succession that contradict a track, after which it ends."""
TRACKED, CONTRADICTS = "tracked", "this row contradicts the track"
_POSE, _RATES = 6, 6
_WIDENED = 1e4  # on the covariance of the fix that starts a track: its row is used again
_LOOK_AHEAD = 20
_STEADY = 0.025  # time over which a pose is nearly the same, in correlation times of the motion
_ROWS_A_BLOCK = 500
_MAX_ITERATIONS, _TOLERANCE = 12, 1e-6


class BodyTracker:
    """Tracker of one body; rows come in order, in one call or in many.

    Parameters
    ----------
    array : SensorArray
    body : MagnetBody
    motion : BodyMotion
    """

    def __init__(self, array: SensorArray, body: MagnetBody, motion: BodyMotion | None = None) -> None:
        self.array, self.body, self.motion = array, body, motion or BodyMotion()
        self.locator = BodyLocator(array, body)
        self._errors = SensorErrors.of(array)
        self._white = without_lasting_errors(array) if self._errors.n_states else array
        # Without a check of its rows, a track would learn the moments from the curvature of its own model.
        is_checked = n_checks(array, self.locator.n_unknowns) >= 0.5
        self.followed = body if is_checked else body.with_known_moments()
        self._n_placement = body.n_errors - self.followed.moment_root.shape[1]
        self._last_s: float | None = None
        self._recent = np.zeros((0, 2))
        self._located_pose, self._located_step = (np.full(3, np.nan), np.eye(3)), math.nan
        self._state: _State | None = None
        self._problems: tuple[core.Problem, core.Problem] | None = None
        self._lasting: tuple[FloatArray, FloatArray] | None = None  # of the errors: mean, covariance

    @property
    def is_compiled(self) -> bool:
        """True if a kernel makes the steps: for dipoles alone."""
        return not self.body.has_shapes

    def restart(self) -> None:
        """Begin a new track at the next row, whose time may be earlier; what is known of lasting errors stays."""
        self._keep_errors()
        self._state = self._last_s = None

    def follow(self, readings_T: ArrayLike, time_s: FloatArray, ambient_T: FloatArray | None = None) -> BodyTrack:
        """Return the track over rows of raw readings (n, C) [T] at times (n,), which come after all rows before."""
        values = check_rows(self.array, readings_T)
        n = len(values)
        track = replace(BodyTrack.none(n, 1, self.locator.symmetry.words), time_s=np.asarray(time_s, dtype=np.float64))
        rows = self._rows(values, ambient_T, track.time_s)
        problem = _TrackProblem(self, rows, track.time_s, self._last_s)
        row = 0
        while row < n:
            if self._state is None or (self._last_s is None and row == 0) or problem.is_lost[row]:
                started = self._start(problem, values, ambient_T, row, track)
                if not started:
                    row += 1
                    continue
            if (state := self._state) is None:
                continue
            row = problem.run(state, row, problem.until_gap(row), track)
            if not state.progress[1]:
                self._keep_errors()
                self._state = None
        self._last_s = float(track.time_s[-1]) if n else self._last_s
        self._recent = flag_misfits(track, self._recent)
        return track

    def _start(
        self, problem: _TrackProblem, values: FloatArray, ambient_T: FloatArray | None, row: int, track: BodyTrack
    ) -> bool:
        """Start a track at a row; return whether it shows the body."""
        self._keep_errors()
        self._state = None
        ambient = None if ambient_T is None else ambient_T[row : row + 1]
        found = self.locator.fit_rows(values[row : row + 1], ambient)
        if not found.solved[0] or set(found.flags[0]) - {"bent"}:
            track.status[row] = f"not acquired: {found.reason[0] or ', '.join(found.flags[0])}"
            track.flags[row], track.reason[row] = found.flags[0], track.status[row]
            return False
        states = [
            self._state_of(problem.rows.model, found.position_m[0, k], found.R[0, k], found.covariance[0, k])
            for k in range(int(found.n_poses[0]))
        ]
        self._state = states[0] if len(states) == 1 else min(states, key=lambda state: problem.cost(state, row))
        return True

    def _state_of(self, model: WhitenedModel, position_m: FloatArray, R: FloatArray, covariance: FloatArray) -> _State:
        """Return the state of a fix, whose row is used again, with unknown rates."""
        q, a = self.followed.moment_root.shape[1], self._errors.n_states
        n_errors = q + a + self._n_placement
        n = _POSE + n_errors + _RATES
        P = np.zeros((n, n))
        unit = np.repeat([1.0 / model.radius, 1.0], 3)
        P[:_POSE, :_POSE] = _WIDENED * unit[:, None] * np.nan_to_num(covariance, nan=0.0) * unit
        errors, of_errors = np.zeros(n_errors), np.eye(n_errors)
        of_errors[q : q + a, q : q + a] = np.diag(self._errors.sigma**2)
        if self._lasting is not None:
            errors, of_errors = self._lasting
        P[_POSE : _POSE + n_errors, _POSE : _POSE + n_errors] = of_errors
        rates = np.repeat([self.motion.speed_m_s / model.radius, self.motion.turn_rad_s], 3)
        P[-_RATES:, -_RATES:] = np.diag(rates**2)
        return _State(
            packed(model, position_m, R), np.zeros(_RATES), errors.copy(), P, np.array([0, 1], np.int64), True
        )

    def kernel_problems(self, model: WhitenedModel) -> tuple[core.Problem, core.Problem]:
        """Return the fit and the filter for the kernel, without rows."""
        if self._problems is None:
            of_rows = ("sensor_errors", "lasting", "added", "steps", "nis_limits", "curvature")
            of_state = ("pose", "rates", "errors", "covariance", "progress")
            results = ("poses", "all_rates", "covariances", "nis", "status")
            fit = fit_problem(model, self.followed, None, None, _MAX_ITERATIONS)
            track = core.problem(
                "pose_track",
                fit=fit,
                n_magnet_errors=self.followed.moment_root.shape[1],
                n_sensor_errors=self._errors.n_states + self._n_placement,
                max_iterations=_MAX_ITERATIONS,
                most_contradictions=MOST_CONTRADICTIONS,
                tolerance=_TOLERANCE,
                magnet_errors=np.ascontiguousarray(self.followed.moment_root),
                **dict.fromkeys(of_rows + of_state + results),
            )
            self._problems = fit, track
        return self._problems

    def _keep_errors(self) -> None:
        """Keep what a track has learnt of lasting errors for the next one."""
        if self._state is not None and self._state.errors.size:
            errors = slice(_POSE, _POSE + self._state.errors.size)
            self._lasting = self._state.errors.copy(), self._state.covariance[errors, errors].copy()

    def _rows(self, values: FloatArray, ambient_T: FloatArray | None, time_s: FloatArray) -> TrackRows:
        """Return whitened rows in their order."""
        groups = list(whitened_rows(self._white, values, ambient_T, max(len(values), 1)))
        effects = [self._effects(group) for group in groups]
        if self._n_placement and len(values):
            poses = self._located(values, ambient_T, time_s)
            effects = [
                np.concatenate([one, placement_effects(self.body, self._n_placement, group, *poses)], axis=1)
                for one, group in zip(effects, groups, strict=True)
            ]
        if len(groups) == 1:
            (group,) = groups
            n_differences = np.full(len(values), group.n_differences, dtype=np.intp)
            return TrackRows(group.model, group.y, n_differences, effects[0])
        return joined_rows(groups, len(values), effects)

    def _located(
        self, values: FloatArray, ambient_T: FloatArray | None, time_s: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return poses (n, 3) and (n, 3, 3) near those of rows, from rows that are located without a track."""
        step = np.floor(time_s / (_STEADY * self.motion.correlation_s))
        is_new = np.concatenate([[step[0] != self._located_step], np.diff(step) != 0])
        ambient = None if ambient_T is None else ambient_T[is_new]
        places, turns = nearest_poses(self.locator.fit_rows(values[is_new], ambient), *self._located_pose)
        self._located_pose, self._located_step = (places[-1], turns[-1]), float(step[-1])
        of_row = np.cumsum(is_new)
        return places[of_row], turns[of_row]

    def error_step(self, dt_s: float) -> tuple[FloatArray, FloatArray]:
        """Return what is left of lasting errors after a step, and the standard deviations that it adds."""
        left, added = self._errors.step(dt_s)
        # Their effects are linear near the pose alone, so that farther away they are as unknown as at first.
        kept = np.full(self._n_placement, math.exp(-dt_s / self.motion.correlation_s))
        return np.concatenate([left, kept]), np.concatenate([added, np.sqrt(1.0 - kept**2)])

    def _effects(self, group: WhitenedRows) -> FloatArray:
        """Return the whitened readings (b, a, C) of one standard unit of every lasting error of the sensors."""
        a = self._errors.n_states
        if not a:
            return np.zeros((len(group), 0, group.y.shape[1]))
        whitening = whitenings_of(self._white, group.mask, group.readings_T)
        if self._errors.has_induced:
            of_rows = np.array([self._errors.effect(self.array, row) for row in group.readings_T])
        else:
            of_rows = self._errors.effect(self.array, group.readings_T)  # (b, C, a)
        if group.model.shares_whitening:
            effects = of_rows.transpose(0, 2, 1)
            flat = whitening.of_unit_noise(effects.reshape(-1, effects.shape[2]))
            return group.model.whiten(flat).reshape(effects.shape)
        unit = np.stack([whitening.of_unit_noise(of_rows[..., e]) for e in range(a)], axis=-1)
        return np.ascontiguousarray(group.model.whiten(unit).transpose(0, 2, 1))


@dataclass(eq=False)
class _State:
    """State of a track between rows, which the kernel changes."""

    pose: FloatArray
    rates: FloatArray
    errors: FloatArray
    covariance: FloatArray
    progress: NDArray[np.int64]
    is_new: bool = False

    def copy(self) -> _State:
        """Return a state with memory that it does not share."""
        arrays = (self.pose.copy(), self.rates.copy(), self.errors.copy(), self.covariance.copy())
        return _State(*arrays, self.progress.copy(), self.is_new)


class _TrackProblem:
    """Rows for the kernel, with the steps between them."""

    def __init__(self, tracker: BodyTracker, rows: TrackRows, time_s: FloatArray, last_s: float | None) -> None:
        self.tracker, self.rows, self.time_s = tracker, rows, time_s
        n, radius = len(time_s), rows.model.radius
        before = np.concatenate([[time_s[0] if last_s is None else last_s] if n else [], time_s[:-1]])
        self.dt_s = time_s - before
        self.is_lost = tracker.motion.is_lost(self.dt_s, radius)
        steps = self.dt_s.tolist()
        of_steps = {dt: tracker.motion.step(dt, radius) for dt in set(steps)}
        self.steps = np.array([of_steps[dt] for dt in steps]).reshape(n, 10)
        kept_added = {dt: tracker.error_step(dt) for dt in set(steps)}
        self.lasting, self.added = (np.array([kept_added[dt][part] for dt in steps]).reshape(n, -1) for part in (0, 1))
        self.limits = np.array([quantile(d, CONTRADICTION) for d in rows.n_differences.tolist()])
        self._signals = signals_of_rows(rows.model, rows.y)
        a = rows.effects.shape[1]
        index = np.repeat(np.arange(n), a)
        flat = signals_of(rows.model.rows(index), rows.effects.reshape(n * a, rows.effects.shape[2])) if a else None
        self._effects = None if flat is None else np.ascontiguousarray(flat.reshape(n, a, -1))

    def until_gap(self, row: int) -> int:
        """Return the first row after a row that a track does not reach over a gap."""
        later = np.flatnonzero(self.is_lost[row + 1 :])
        return row + 1 + int(later[0]) if later.size else len(self.is_lost)

    def cost(self, state: _State, row: int) -> float:
        """Return the NIS of a state over the next rows, with a penalty for contradictions."""
        end = min(self.until_gap(row), row + _LOOK_AHEAD)
        *_, nis, status = self._follow(state.copy(), row, end)
        return float(
            np.minimum(np.nan_to_num(nis, nan=0.0), 2.0 * self.limits[row:end])[status > 0].sum()
        ) + 1e6 * float((status == 0).sum())

    def run(self, state: _State, row: int, end: int, track: BodyTrack) -> int:
        """Follow a state over rows into a track; return the first row that is not used."""
        is_new = state.is_new
        poses, rates, covariances, nis, status = self._follow(state, row, end)
        state.is_new = False
        used = np.flatnonzero(status > 0)
        if not state.progress[1]:
            # Rows that contradict a track to its end do not belong to it: the next track begins with them.
            agreeing = np.flatnonzero(status == 1)
            used = used[: int(agreeing[-1]) + 1 if agreeing.size else 0]
        at = row + used
        radius = self.rows.model.radius
        position, R = unpacked(self.rows.model, poses[used])
        track.position_m[at, 0], track.R[at, 0], track.chi2[at, 0] = position, R, nis[used]
        unit = np.repeat([radius, 1.0], 3)
        track.covariance[at, 0] = unit[:, None] * covariances[used, :6, :6] * unit
        track.velocity_m_s[at], track.rate_rad_s[at] = radius * rates[used, :3], rates[used, 3:]
        track.dof[at] = self.rows.n_differences[at]
        if is_new and used.size:
            track.dof[at[0]] -= self.tracker.locator.n_unknowns
        for i, s in zip(at.tolist(), status[used].tolist(), strict=True):
            track.status[i] = TRACKED if s == 1 else CONTRADICTS
        if state.progress[1]:
            return end
        if not used.size:  # not even its first row: a track must not begin there again
            track.status[row] = track.reason[row] = CONTRADICTS
            return row + 1
        return row + int(used[-1]) + 1

    def _follow(
        self, state: _State, row: int, end: int
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
        n = end - row
        poses, rates, covariances = np.empty((n, 12)), np.empty((n, _RATES)), np.empty((n, 12, 12))
        nis, status = np.full(n, np.nan), np.zeros(n, np.int64)
        steps = self.steps[row:end].copy()
        lasting, added = self.lasting[row:end].copy(), self.added[row:end].copy()
        curvature = np.ones(n)
        if state.is_new:  # it begins at its row
            steps[0] = [0.0, 1.0, 0.0, 0.0, 0.0] * 2
            lasting[0], added[0], curvature[0] = 1.0, 0.0, 1.0 / _WIDENED
        if not self.tracker.is_compiled:
            return self._follow_shapes(
                state, row, (steps, lasting, added), curvature, (poses, rates, covariances, nis, status)
            )
        fit, work = self.tracker.kernel_problems(self.rows.model)
        work = work.with_fields(
            fit=fit.with_fields(channels=self.rows.model.channels, signals=self._signals, row=np.arange(row, end)),
            sensor_errors=None if self._effects is None else self._effects[row:end],
            lasting=lasting,
            added=added,
            steps=steps,
            nis_limits=self.limits[row:end],
            curvature=curvature,
            pose=state.pose,
            rates=state.rates,
            errors=state.errors,
            covariance=state.covariance,
            progress=state.progress,
            poses=poses,
            all_rates=rates,
            covariances=covariances,
            nis=nis,
            status=status,
        )
        core.run("follow_body", work, n, block=_ROWS_A_BLOCK, chain=n)
        return poses, rates, covariances, nis, status

    def _follow_shapes(
        self,
        state: _State,
        row: int,
        steps: tuple[FloatArray, FloatArray, FloatArray],
        curvature: FloatArray,
        results: tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.int64]],
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, NDArray[np.int64]]:
        """Follow a body of magnets with shapes, as the kernel does for dipoles."""
        poses, rates, covariances, nis, status = results
        d = len(state.covariance) - _RATES
        shown = np.r_[:_POSE, d : d + _RATES]
        for i in range(len(nis)):
            if not state.progress[1]:
                break
            at = FilterState(state.pose[:3], state.pose[3:].reshape(3, 3), state.errors, state.rates, state.covariance)
            at = predicted_state(at, *(part[i] for part in steps))
            index = np.array([row + i])
            after, nis[i] = updated_state(
                at,
                self.rows.model.rows(index),
                self.rows.y[index],
                self.tracker.followed,
                self.rows.effects[row + i],
                curvature=float(curvature[i]),
                max_iterations=_MAX_ITERATIONS,
                tolerance=_TOLERANCE,
            )
            agrees = nis[i] < self.limits[row + i]
            at = after if agrees else at
            status[i] = 1 if agrees else 2
            state.progress[0] = 0 if agrees else state.progress[0] + 1
            state.progress[1] = state.progress[0] < MOST_CONTRADICTIONS
            state.pose, state.rates = np.concatenate([at.x, at.R.ravel()]), at.rates
            state.errors, state.covariance = at.errors, at.covariance
            poses[i], rates[i], covariances[i] = state.pose, state.rates, state.covariance[np.ix_(shown, shown)]
        return results


def track_body(
    array: SensorArray,
    body: MagnetBody,
    readings: Readings | ArrayLike,
    *,
    motion: BodyMotion | None = None,
    ambient_T: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
) -> BodyTrack:
    """Track the pose of a body of several magnets through time.

    Parameters
    ----------
    array : SensorArray
        Array with the positions, noise and calibration of its sensors; lasting errors of theirs are estimated too.
    body : MagnetBody
        Body with its magnets; stated errors of their moments, positions and directions are estimated too.
    readings : Readings or array_like, shape (n, C)
        Raw readings [T] in order of time, NaN where missing. Poses are in the array's frame.
    motion : BodyMotion, optional
        Typical speed and rotation rate, and how long they last.
    ambient_T : array_like, shape (n, 3) or (3,), optional
        Ambient field in the array's frame [T].
    progress : callable, optional
        Called with the number of rows.

    Returns
    -------
    BodyTrack
        A pose for every row that is tracked.
    """
    measured = as_readings(readings)
    warn_of_doubts(array, measured)
    measured = without_saturated(measured, array)
    check_order(measured)
    ambient = measured.ambient_T
    if ambient_T is not None:
        ambient = np.broadcast_to(np.asarray(ambient_T, dtype=np.float64), (len(measured), 3))
    tracker = BodyTracker(array, body, motion)
    warn_of_no_check(array, tracker.locator.n_unknowns)
    track = tracker.follow(measured.values_T, measured.time_s, ambient)
    if progress is not None:
        progress(len(track))
    return track
