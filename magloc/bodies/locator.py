"""Locate a body in single rows of readings: search, uncertainty, limits, and what is wrong where no pose fits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import placed_magnets
from magloc.bodies.fit import linearise, refine_poses
from magloc.bodies.optima import (
    RowOptima,
    inverses,
    ranked,
    turned_covariances,
    with_alternatives,
    with_places,
    without_gaps,
)
from magloc.bodies.plausibility import check_lengths, warn_of_inside, warn_of_no_check
from magloc.bodies.poses import BodyPoses, with_bends, with_doubts
from magloc.bodies.search import (
    KEEP_WITHIN,
    N_CANDIDATES,
    N_STARTS,
    PoseOptima,
    PoseTable,
    pose_table,
    refine_dipoles,
    search_poses,
)
from magloc.bodies.symmetry import BodySymmetry, body_symmetry
from magloc.chi_square import quantile
from magloc.levels import CREDIBLE_FIT, MISFIT
from magloc.localization.uncertainty.range_interval import is_detected
from magloc.measurement.plausibility import warn_of_doubts
from magloc.measurement.rows import NO_SIGNAL, WhitenedRows, check_magnitudes, check_rows, check_spans, whitened_rows
from magloc.readings import Readings, as_readings, without_saturated

_WIDE_RAD = 1.2  # largest rotation beyond which the search has more candidates
_MORE_CANDIDATES, _MORE_STARTS = 16384, 64
_FEW = 3  # differences beyond the unknowns, up to which wrong poses explain readings too
_ROWS_AT_ONCE = 2048
_LIMIT_SIGMAS = 3.0
_OPEN_SIGMA_RAD = np.pi / np.sqrt(3.0)  # of an angle that may be anything
_ABSENT = 1e-9
_ROUNDS, _UNSETTLED = 5, 3.0
_NO_POSE = "no start leads to a pose that fits"


@dataclass(frozen=True, eq=False)
class BodyLocator:
    """Locator of one body by one array.

    Parameters
    ----------
    array : SensorArray
    body : MagnetBody
    find_causes : bool
        Look for a missing magnet or a faulty sensor where no pose fits.

    Raises
    ------
    ValueError
        The array has one sensor without a prior of the common field, or its numbers are out of range, or the lengths of
        array and body contradict each other.
    """

    array: SensorArray
    body: MagnetBody
    find_causes: bool = True
    _tables: dict[tuple[bytes, bool, MagnetBody], PoseTable] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.array.common_field_T is None:
            check_spans(self.array)
        check_magnitudes(self.array)
        if self.find_causes:
            check_lengths(self.array, self.body)
        object.__setattr__(self, "array", with_offsets_as_noise(self.array))
        object.__setattr__(self, "symmetry", body_symmetry(self.body))
        object.__setattr__(self, "_dipoles", self.body.as_dipoles() if self.body.has_shapes else self.body)

    symmetry: BodySymmetry = field(init=False)
    _dipoles: MagnetBody = field(init=False)

    @property
    def n_unknowns(self) -> int:
        """Unknowns of a pose that the field depends on: 6, or 5 for a body with an axis of symmetry."""
        return 6 if self.symmetry.axis is None else 5

    def fit_rows(
        self,
        readings_T: ArrayLike,
        ambient_T: FloatArray | None = None,
        *,
        time_s: FloatArray | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> BodyPoses:
        """Return the poses of rows of raw readings (n, C) [T], NaN where missing, in ambient fields (n, 3) [T]."""
        readings = check_rows(self.array, readings_T)
        parts: list[tuple[IntArray, BodyPoses]] = []
        for rows in whitened_rows(self.array, readings, ambient_T, _ROWS_AT_ONCE):
            parts.append((rows.index, self._fit(rows, ambient_T)))
            if progress is not None:
                progress(len(rows))
        if len(parts) == 1:  # its rows are all rows, in their order
            return parts[0][1] if time_s is None else replace(parts[0][1], time_s=time_s)
        width = max((part.chi2.shape[1] for _, part in parts), default=1)
        poses = BodyPoses.none(len(readings), width, self.symmetry.words)
        for index, part in parts:
            poses.put(index, _widened(part, width))
        return poses if time_s is None else replace(poses, time_s=time_s)

    def _fit(self, rows: WhitenedRows, ambient_T: FloatArray | None) -> BodyPoses:
        n = len(rows)
        dof = rows.n_differences - self.n_unknowns
        if dof < 0:
            poses = BodyPoses.none(n, 1, self.symmetry.words)
            given = f"{int(rows.mask.sum())} readings give {rows.n_differences} independent differences"
            return replace(poses, reason=[f"{given}, {self.n_unknowns} are needed"] * n)
        found = self._found(rows, self._dipoles)
        absent = rows.is_silent | ~is_detected(rows.energy, rows.n_differences)
        if found.is_plain.all() and not absent.any():
            return with_bends(self._poses_of(RowOptima.of(found), dof), found.bend)
        poses = self._poses(rows, self._optima(rows, self._dipoles, found), dof)
        for i in np.flatnonzero(absent).tolist():
            poses.reason[i] = NO_SIGNAL if rows.is_silent[i] else "nothing stands out of the noise"
            for values in (poses.position_m, poses.R, poses.chi2, poses.covariance):
                values[i] = np.nan
        if self.find_causes and dof > 0:
            self._name_causes(rows, poses, ambient_T)
        return with_bends(with_doubts(poses), self._bends(rows, poses))

    def _bends(self, rows: WhitenedRows, poses: BodyPoses) -> FloatArray:
        """Return the nonlinearity of readings (n,) over one σ of the best poses, in units of the noise."""
        magnets, _ = placed_magnets(self.body, poses.position_m[:, 0], poses.R[:, 0])
        ways = magnets[:, :, None] - self.array.positions
        square_m = np.vecdot(ways, ways).min(axis=(1, 2))
        variance = np.diagonal(poses.covariance[:, 0], axis1=1, axis2=2)
        spread = 6.0 * variance[:, :3].sum(axis=1) / square_m + 0.5 * variance[:, 3:].sum(axis=1)
        return np.asarray(spread * np.sqrt(np.vecdot(rows.y, rows.y) / rows.y.shape[1]))

    def _table(self, rows: WhitenedRows, body: MagnetBody, again: bool) -> PoseTable:
        """Return the table of candidates for the channels of rows, which is kept."""
        key = (rows.mask.tobytes(), again, body)
        if key not in self._tables:
            n_candidates, n_starts = (2 * N_CANDIDATES, 3 * N_STARTS) if self._is_wide else (N_CANDIDATES, N_STARTS)
            if again:
                n_candidates, n_starts = _MORE_CANDIDATES, _MORE_STARTS
            if has_twins := self._has_twins(rows):
                n_candidates, n_starts = _MORE_CANDIDATES, (4 if again else 2) * _MORE_STARTS
            exact = body is self._dipoles and not (self._has_errors or self.body.has_shapes or has_twins)
            judged = exact and self.symmetry.order == 1 and self.symmetry.axis is None
            dof = max(rows.n_differences - self.n_unknowns, 1)
            self._tables[key] = pose_table(
                rows.model,
                self.array,
                body,
                n_candidates,
                n_starts=n_starts,
                keep_within=KEEP_WITHIN if exact else np.inf,
                most_chi2=quantile(dof, 1.0 - CREDIBLE_FIT) if judged else -np.inf,
            )
        return self._tables[key]

    def _found(self, rows: WhitenedRows, body: MagnetBody, *, again: bool = False) -> PoseOptima:
        """Return what the kernel finds for rows, with more candidates and starts in a second search."""
        return search_poses(rows.model, rows.y, self._table(rows, body, again))

    def _optima(self, rows: WhitenedRows, body: MagnetBody, found: PoseOptima | None = None) -> RowOptima:
        """Return the distinct optima of rows, after a second search for those that no pose fits."""
        optima = self._settled_optima(rows, body, found or self._found(rows, body))
        dof = max(rows.n_differences - self.n_unknowns, 1)
        doubtful = ~(optima.chi2[:, 0] < quantile(dof, 1.0 - CREDIBLE_FIT))
        if doubtful.any():
            some = rows.select(doubtful)
            again = self._settled_optima(some, body, self._found(some, body, again=True))
            before = np.nan_to_num(optima.chi2[doubtful, 0], nan=np.inf)
            better = np.nan_to_num(again.chi2[:, 0], nan=np.inf) < before
            width = max(again.chi2.shape[1], optima.chi2.shape[1])
            optima = with_places(optima, width)
            optima.put(np.flatnonzero(doubtful)[better], RowOptima(*(v[better] for v in vars(again).values())))
        return optima

    def _settled_optima(self, rows: WhitenedRows, body: MagnetBody, found: PoseOptima) -> RowOptima:
        """Return the distinct optima of rows within Δχ² 20, best first, with the body's shapes, errors and symmetry."""
        optima = RowOptima.of(found)
        if self._has_twins(rows):
            optima = with_alternatives(rows, body, optima)
        if body is self._dipoles and (self._has_errors or self.body.has_shapes):
            optima = self._settled(rows, optima)
        if self.symmetry.order > 1:
            position, R, lead = self.symmetry.nearest_to_rest(optima.position_m, optima.R)
            optima = RowOptima(position, R, optima.chi2, turned_covariances(optima.covariance, lead))
        if self.symmetry.axis is not None:
            optima = replace(optima, covariance=self._with_open_axis(rows, optima, body))
        return ranked(optima, self.body.radius_m)

    @cached_property
    def _is_wide(self) -> bool:
        """True if the limits leave more room than the search of a narrow range covers."""
        limits = self.body.limits
        return self._turns_far or bool(np.subtract(limits.high_m, limits.low_m).max() > 2.0 * self.array.circumradius)

    @property
    def _turns_far(self) -> bool:
        return not self.body.limits.is_bounded or self.body.limits.angle_rad > _WIDE_RAD

    def _has_twins(self, rows: WhitenedRows) -> bool:
        """Return whether several poses may explain rows equally well."""
        return self._turns_far and rows.n_differences - self.n_unknowns <= _FEW

    @property
    def _has_errors(self) -> bool:
        magnets = self.body.magnets
        return bool(self.body.moment_root.size) or any(m.position_sigma_m or m.direction_sigma_rad for m in magnets)

    def _settled(self, rows: WhitenedRows, optima: RowOptima) -> RowOptima:
        """Return optima with exact shapes, the stated errors of the magnets counted as noise."""
        row, place = np.nonzero(np.isfinite(optima.chi2))
        if not row.size:
            return optima
        some = rows.select(row)
        position, R = optima.position_m[row, place], optima.R[row, place]
        settled = RowOptima(*(np.full_like(values, np.nan) for values in vars(optima).values()))
        for _ in range(_ROUNDS if self._has_errors else 1):  # the columns of the errors follow the pose
            refined = some
            if self._has_errors:
                *_, errors = linearise(some.model, self.body, position, R)
                refined = some.marginalise(np.nan_to_num(errors))
            if self.body.has_shapes:
                fits = refine_poses(refined.model, refined.y, self.body, position, R)
                _, jacobian, _ = linearise(refined.model, self.body, fits.position_m, fits.R)
                covariance = inverses(jacobian)
            else:
                fits, covariance = refine_dipoles(refined.model, refined.y, self.body, position, R)
            turn = Rotation.from_matrix(R.mT @ fits.R).as_rotvec()
            moved = np.concatenate([fits.position_m - position, turn], axis=1)
            position, R = fits.position_m, fits.R
        if self._has_errors:  # what the last round still changed is not known better than that
            covariance = covariance + _UNSETTLED**2 * moved[:, :, None] * moved[:, None]
        settled.position_m[row, place], settled.R[row, place] = position, R
        settled.covariance[row, place] = covariance
        settled.chi2[row, place] = np.where(fits.converged, fits.chi2, np.nan)
        return settled

    def _with_open_axis(self, rows: WhitenedRows, optima: RowOptima, body: MagnetBody) -> FloatArray:
        """Return covariances in which the angle about the body's axis may be anything."""
        row, place = np.nonzero(np.isfinite(optima.chi2))
        covariance = optima.covariance.copy()
        if row.size:
            model = rows.model.rows(row)
            _, jacobian, _ = linearise(model, body, optima.position_m[row, place], optima.R[row, place])
            prior = np.zeros((6, 6))
            axis = np.asarray(self.symmetry.axis)
            prior[3:, 3:] = np.outer(axis, axis) / _OPEN_SIGMA_RAD**2
            covariance[row, place] = np.linalg.inv(jacobian.mT @ jacobian + prior)
        return covariance

    def _poses(self, rows: WhitenedRows, optima: RowOptima, dof: int) -> BodyPoses:
        """Return the poses of optima within the body's limits, and the reasons of rows without one."""
        within, known = self._within_limits(optima, dof), np.isfinite(optima.chi2)
        best_within, best = (np.where(mask, optima.chi2, np.inf).min(axis=1) for mask in (within, known))
        # A pose beyond the limits that alone explains the readings is the truth, and one within them is none.
        left = (best_within > quantile(max(dof, 1), 1.0 - CREDIBLE_FIT)) & (best < best_within - KEEP_WITHIN)
        kept = within & ~left[:, None]
        chosen = optima
        if (kept != known).any():
            chosen = without_gaps(replace(optima, chi2=np.where(kept, optima.chi2, np.nan)))
        poses = self._poses_of(chosen, dof)
        for i in np.flatnonzero(~poses.solved).tolist():
            k = int(np.argmin(np.nan_to_num(optima.chi2[i], nan=np.inf)))
            poses.reason[i] = self._outside(optima.position_m[i, k], optima.R[i, k]) if best[i] < np.inf else _NO_POSE
        return poses

    def _poses_of(self, optima: RowOptima, dof: int) -> BodyPoses:
        """Return optima as poses without flags."""
        n, words = len(optima.chi2), self.symmetry.words
        time_s, all_dof = np.arange(n, dtype=np.float64), np.full(n, dof, dtype=np.intp)
        return BodyPoses(time_s, **vars(optima), dof=all_dof, flags=[()] * n, reason=[""] * n, symmetry=words)

    def _within_limits(self, optima: RowOptima, dof: int) -> BoolArray:
        """Return whether optima (b, W) lie in the limits of the body, or at most three standard deviations outside."""
        limits = self.body.limits
        variance = np.diagonal(optima.covariance, axis1=-2, axis2=-1)
        factor = np.fmax(optima.chi2 / max(dof, 1), 1.0)[..., None]
        sigma = np.sqrt(np.fmax(variance, 0.0) * factor)
        beyond_m = np.maximum(limits.low_m - optima.position_m, optima.position_m - np.array(limits.high_m))
        R = optima.R
        cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
        beyond_rad = np.arccos(np.minimum(np.maximum(cosine, -1.0), 1.0)) - limits.angle_rad
        inside = (beyond_m <= _LIMIT_SIGMAS * sigma[..., :3]).all(axis=-1)
        return inside & (beyond_rad <= _LIMIT_SIGMAS * sigma[..., 3:].max(axis=-1)) & np.isfinite(optima.chi2)

    def _outside(self, position_m: FloatArray, R: FloatArray) -> str:
        """Return the sentence about a pose beyond the limits."""
        limits = self.body.limits
        for axis, x, low, high in zip("xyz", position_m, limits.low_m, limits.high_m, strict=True):
            if not low <= x <= high:
                return (
                    f"the pose that fits lies outside the limits of the body: {axis} = {1e3 * x:.4g} mm, expected"
                    f" {1e3 * low:g} to {1e3 * high:g} mm"
                )
        angle = np.degrees(Rotation.from_matrix(R).magnitude())
        return (
            f"the pose that fits lies outside the limits of the body: {angle:.3g}° from rest, expected"
            f" {np.degrees(limits.angle_rad):.3g}° at most"
        )

    def _name_causes(self, rows: WhitenedRows, poses: BodyPoses, ambient_T: FloatArray | None) -> None:
        """Name a missing magnet or a faulty sensor in rows that no pose fits, and take the pose without it."""
        dof = rows.n_differences - self.n_unknowns
        worst = np.nan_to_num(poses.chi2[:, 0], nan=np.inf) > quantile(dof, MISFIT)
        if not worst.any():
            return
        bad = np.flatnonzero(worst & is_detected(rows.energy, rows.n_differences) & ~rows.is_silent)
        if not bad.size:
            return
        some = rows.select(bad)
        best = np.full(bad.size, quantile(dof, 1.0 - CREDIBLE_FIT))
        for k, magnet in enumerate(self.body.magnets):
            optima = self._optima(some, _without(self._dipoles, k))
            without = self._poses(some, optima, dof)
            better = np.nan_to_num(without.chi2[:, 0], nan=np.inf) < best
            self._put_cause(poses, without, bad, better, f"missing {magnet.id}")
            best[better] = without.chi2[better, 0]
        locator = replace(self, find_causes=False)
        for s, sensor in enumerate(self.array.sensors):
            readings = some.readings_T.copy()
            readings[:, self.array.channel_sensor == s] = np.nan
            ambient = None if ambient_T is None else ambient_T[some.index]
            without = locator.fit_rows(readings, ambient)
            # Fewer readings fit more easily, so compare probabilities rather than χ².
            credible = (without.dof > 0) & (
                without.chi2[:, 0] < np.array([quantile(max(d, 1), 1.0 - CREDIBLE_FIT) for d in without.dof])
            )
            better = credible & (best >= quantile(dof, 1.0 - CREDIBLE_FIT))
            self._put_cause(poses, without, bad, better, f"sensor {sensor.id}")
            best[better] = 0.0

    def _put_cause(self, poses: BodyPoses, others: BodyPoses, rows: IntArray, better: BoolArray, flag: str) -> None:
        if not better.any():
            return
        width = poses.chi2.shape[1]
        chosen = np.flatnonzero(better)
        narrow = _widened(others, width)
        poses.put(
            rows[chosen],
            replace(
                narrow,
                position_m=narrow.position_m[chosen],
                R=narrow.R[chosen],
                covariance=narrow.covariance[chosen],
                chi2=narrow.chi2[chosen],
                dof=narrow.dof[chosen],
                flags=[(flag,)] * chosen.size,
                reason=[""] * chosen.size,
            ),
        )


def with_offsets_as_noise(array: SensorArray) -> SensorArray:
    """Return the array with errors of the offsets as noise of a single row."""
    if not any(sensor.offset_uncertainty_T for sensor in array.sensors):
        return array
    sensors = tuple(
        replace(sensor, noise_T=math.hypot(sensor.noise_T, sensor.offset_uncertainty_T), offset_uncertainty_T=0.0)
        for sensor in array.sensors
    )
    return replace(array, sensors=sensors)


def _without(body: MagnetBody, index: int) -> MagnetBody:
    """Return a body whose magnet has lost its moment; without it a body of two would be none."""
    magnet = body.magnets[index]
    lost = replace(magnet, moment_Am2=tuple(_ABSENT * np.array(magnet.moment_Am2)))
    return replace(body, magnets=(*body.magnets[:index], lost, *body.magnets[index + 1 :]))


def _widened(poses: BodyPoses, width: int) -> BodyPoses:
    """Return poses with another number of places per row; places are cut or empty."""
    of_places = {name: getattr(poses, name) for name in ("position_m", "R", "covariance", "chi2")}
    n = min(width, poses.chi2.shape[1])
    wide: dict[str, Any] = {name: np.full((len(v), width, *v.shape[2:]), np.nan) for name, v in of_places.items()}
    for name, values in of_places.items():
        wide[name][:, :n] = values[:, :n]
    return replace(poses, **wide)


def locate_body(
    array: SensorArray,
    body: MagnetBody,
    readings: Readings | ArrayLike,
    *,
    ambient_T: ArrayLike | None = None,
    progress: Callable[[int], None] | None = None,
) -> BodyPoses:
    """Find the pose of a body of several magnets in every row of readings, each row independent of the others.

    Parameters
    ----------
    array : SensorArray
        Array with the positions, noise and calibration of its sensors.
    body : MagnetBody
        Body with its magnets and the limits of its pose.
    readings : Readings or array_like, shape (n, C) or (C,)
        Raw readings [T], NaN where missing. The pose of a moving array is not used: poses are in the array's frame.
    ambient_T : array_like, shape (n, 3) or (3,), optional
        Ambient field in the array's frame [T], instead of that of the readings or the array.
    progress : callable, optional
        Called with the number of rows finished since the last call.

    Returns
    -------
    BodyPoses
        All distinct poses of every row, best first.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> from sims import joystick
    >>> rng = np.random.default_rng(0)
    >>> device = joystick.draw_joystick(rng)
    >>> readings = device.read(*joystick.random_poses(rng, 3), rng)
    >>> magloc.locate_body(device.true_array, device.true_knob, readings).R[:, 0].shape
    (3, 3, 3)
    """
    measured = as_readings(readings)
    warn_of_doubts(array, measured)
    measured = without_saturated(measured, array)
    ambient = measured.ambient_T
    if ambient_T is not None:
        ambient = np.broadcast_to(np.asarray(ambient_T, dtype=np.float64), (len(measured), 3))
    locator = BodyLocator(array, body)
    warn_of_no_check(array, locator.n_unknowns)
    poses = locator.fit_rows(measured.values_T, ambient, time_s=measured.time_s, progress=progress)
    warn_of_inside(array, body, poses)
    return poses
