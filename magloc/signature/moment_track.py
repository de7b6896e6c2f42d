"""Tracks of the moment of an object whose path is known."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.errors import InputError
from arrays.typing import FloatArray
from magloc.chi_square import normalised_square
from magloc.localization.fit.results import is_misfit
from magloc.measurement.nuisances import BackgroundDrift
from magloc.measurement.plausibility import usable_readings
from magloc.measurement.rows import check_magnitudes
from magloc.navigation.rotations import cross_matrix, rotation_matrix
from magloc.readings import Readings
from magloc.signature.moment_filter import (
    Basis,
    MomentModel,
    MomentStep,
    filter_rows,
    relinearise,
)
from magloc.signature.path import ObjectPath, PathError
from magloc.state_space import estimability
from magloc.tracking.consistency import consistency_lines, mean_nis, root_mean
from magloc.tracking.measurement import RowMeasurements
from magloc.tracking.motion import N_SOURCE
from magloc.tracking.results import TrackPoint, warn_of_strengths
from magloc.tracking.rows import rows_of
from magloc.tracking.track import TURN_RAD_S, TrackColumns
from magloc.tracking.whole_records.smoother import states_of
from magloc.truth import Truth, truth_of_rows

EXACT = PathError()
"""A path without errors."""
_UNDETERMINED = 0.1
"""Share of the initial σ: a moment counts as known when the σ of every direction is smaller."""
# Distance from a sensor, in radii of the array, at which an object counts as inside it.
_TOUCHING = 1e-9
_SIGN_UNKNOWN = (
    "Input array must have a vector sensor, or an ambient field for its scalar ones; instead received moduli alone,"
    " which leave the sign of the moment open."
)


@dataclass(frozen=True)
class MomentConsistency:
    """Errors of a moment track against the truth.

    Attributes
    ----------
    rows : int
        Rows with a moment and a true one.
    moment_rms_Am2, moment_bound_Am2 : float
        Root of the mean squared distance from the true moment, and the least that is possible (posterior Cramér-Rao
        bound, of a smoother where later rows are used).
    nees_per_dimension, nis_per_dimension : float
        1 if the covariance is right, and if the model explains the readings.
    nis_bounds : tuple of 2 floats
        Two-sided 99 % bounds of the NIS; NEES has none because errors of successive rows are correlated.
    """

    rows: int
    moment_rms_Am2: float
    moment_bound_Am2: float
    nees_per_dimension: float
    nis_per_dimension: float
    nis_bounds: tuple[float, float]

    def lines(self) -> list[str]:
        """Return the errors against the truth, and their expected values."""
        return [
            f"against the truth, {self.rows} rows:",
            f"  moment rms {self.moment_rms_Am2:.4g} A·m², least possible {self.moment_bound_Am2:.4g} A·m² (posterior"
            " Cramér-Rao bound)",
            *consistency_lines(self.nees_per_dimension, self.nis_per_dimension, self.nis_bounds),
        ]


@dataclass(frozen=True, eq=False, repr=False)
class MomentTrack(TrackColumns):
    """Moment of an object on a known path: columns, and a :class:`TrackPoint` per row.

    Attributes
    ----------
    points : tuple of TrackPoint
        One point per row. Positions are from the path, corrected if it is uncertain.
    readings : Readings
        Readings of the track.
    model : MomentModel
        Model of the rows.
    chi2 : float
        Sum of the normalised innovations squared of all rows, including rows that were not used.
    dof : int
        Its degrees of freedom.
    is_smoothed : bool
        True if later rows were used too.

    Examples
    --------
    >>> import magloc
    >>> ship = magloc.datasets.load("ship")
    >>> path = magloc.ObjectPath(ship.truth.time_s, ship.truth.position_m)
    >>> track = magloc.track_moment(ship.array, ship.readings, path, smooth=True)
    >>> len(track), track.misfit, track.frame
    (121, False, 'array')
    """

    points: tuple[TrackPoint, ...]
    readings: Readings
    model: MomentModel
    chi2: float
    dof: int
    is_smoothed: bool = False

    @property
    def misfit(self) -> bool:
        """True if χ² is so large that noise explains it once in a million (no such dipole)."""
        return bool(is_misfit(self.chi2, self.dof))

    @np.errstate(over="ignore", divide="ignore", invalid="ignore")
    def consistency(self, truth: Truth) -> MomentConsistency:
        """Return the errors of the moment, NEES, NIS, and the least possible error.

        Raises
        ------
        InputError
            The truth has none of the times of the readings, or no moments.
        """
        if truth.moment_Am2 is None:
            raise InputError(f"{truth.name}: found no moment, expected columns mx_Am2, my_Am2 and mz_Am2.")
        moment_Am2 = truth_of_rows(self.readings, truth).moment_Am2
        true = np.full_like(self.moment_Am2, np.nan) if moment_Am2 is None else moment_Am2
        known = self.tracked & np.isfinite(true).all(axis=1)
        error, covariance = (self.moment_Am2 - true)[known], self.covariance[known][:, 3:, 3:]
        nees, dof = float(np.sum(normalised_square(error, covariance))), 3 * int(known.sum())
        bound = _covariances_at(self.model, true, smooth=self.is_smoothed)[known]
        nis_per_dimension, nis_bounds = mean_nis(self)
        return MomentConsistency(
            rows=int(known.sum()),
            moment_rms_Am2=root_mean(np.sum(error**2, axis=1)),
            moment_bound_Am2=root_mean(np.trace(bound, axis1=1, axis2=2)),
            nees_per_dimension=nees / dof if dof else math.nan,
            nis_per_dimension=nis_per_dimension,
            nis_bounds=nis_bounds,
        )


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def track_moment(
    array: SensorArray,
    readings: Readings | ArrayLike,
    path: ObjectPath | ArrayLike,
    *,
    turn_rad_s: float = TURN_RAD_S,
    path_error: PathError = EXACT,
    smooth: bool = False,
) -> MomentTrack:
    """Follow the moment of an object whose path is known.

    This is equation (29), MotionMV of Pavlov et al.

    Parameters
    ----------
    array : SensorArray
        Three independent differences are enough.
    readings : Readings or array_like, shape (n, C)
        Raw readings [T] in the order of time, NaN where missing. Saturated readings are not used.
    path : ObjectPath or array_like, shape (3,) or (n, 3)
        Position of the object in the frame of the results [m]: one place, one for every row, or a path whose times
        enclose those of the readings; rows outside it are ignored. The moment turns with the attitude of the path if
        there is one, otherwise with the rates of the readings.
    turn_rad_s : float
        Characteristic rate at which the moment turns, or changes in another way.
    path_error : PathError
        Uncertainty of the path; exact by default.
    smooth : bool
        Use later rows too (fixed-interval smoother).

    Returns
    -------
    MomentTrack
        In the world frame if the readings have the array's pose, otherwise in the array's frame.

    Raises
    ------
    ValueError
        Time does not increase from row to row, the path has no position, or moduli alone leave the sign open.
    InputError
        The path has none of the times of the readings.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> array = arrays.tetrahedron(1.5, noise_T=1e-10)
    >>> field_T = magloc.dipole.field(array.positions, [5.0, 0.0, 0.3], [0.0, 10.0, 300.0])
    >>> readings_T = [array.readings_of(field_T)] * 20
    >>> magloc.track_moment(array, readings_T, [5.0, 0.0, 0.3]).moment_Am2[-1, 1:].round(1)
    array([ 10., 300.])
    """
    used = usable_readings(array, readings)
    position_m, rotations, used = rows_on_path(used, path)
    (found,) = _track_sources(array, used, position_m[:, None], rotations, turn_rad_s, path_error, smooth=smooth)
    return found


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def track_moments(
    array: SensorArray,
    readings: Readings | ArrayLike,
    positions_m: ArrayLike,
    *,
    turn_rad_s: float = TURN_RAD_S,
    smooth: bool = False,
) -> tuple[MomentTrack, ...]:
    """Follow the moments of several sources at known places, such as the cells of a sample.

    Parameters
    ----------
    array : SensorArray
        Three independent differences for every source are enough.
    readings : Readings or array_like, shape (n, C)
        Raw readings [T] in the order of time, NaN where missing. Saturated readings are not used.
    positions_m : array_like, shape (K, 3)
        Positions of the sources, at rest in the frame of the results [m].
    turn_rad_s : float
        Characteristic rate at which the moments turn, or change in another way [rad/s].
    smooth : bool
        Use later rows too (fixed-interval smoother).

    Returns
    -------
    tuple of MomentTrack
        One track per source. Covariances allow for the other unknown moments; χ² contains all sources together.

    Raises
    ------
    ValueError
        As in :func:`magloc.track_moment`, or two sources are at one place.

    Examples
    --------
    >>> import arrays
    >>> import magloc
    >>> array = arrays.grid(3, 3, 0.05, noise_T=1e-10)
    >>> places_m = [[0.0, 0.0, 0.05], [0.05, 0.0, 0.05]]
    >>> moments_Am2 = [[0.0, 0.0, 0.01], [0.0, 0.02, 0.0]]
    >>> fields_T = (magloc.dipole.field(array.positions, p, m) for p, m in zip(places_m, moments_Am2))
    >>> readings_T = [array.readings_of(sum(fields_T))] * 20
    >>> first, second = magloc.track_moments(array, readings_T, places_m)
    >>> first.moment_Am2[-1, 2].round(4), second.moment_Am2[-1, 1].round(4)
    (np.float64(0.01), np.float64(0.02))
    """
    used = usable_readings(array, readings)
    places = np.asarray(positions_m, dtype=np.float64)
    if places.ndim != 2 or places.shape[1] != 3 or not len(places) or not np.isfinite(places).all():
        raise ValueError(f"Input positions_m must be finite, of shape (K, 3); instead received {places.tolist()}.")
    if len(np.unique(places, axis=0)) < len(places):
        raise ValueError(f"Input positions_m must be different places; instead received {places.tolist()}.")
    position_m = np.broadcast_to(places, (len(used), *places.shape))
    return _track_sources(array, used, position_m, None, turn_rad_s, EXACT, smooth=smooth)


def _track_sources(
    array: SensorArray,
    used: Readings,
    position_m: FloatArray,
    rotations: FloatArray | None,
    turn_rad_s: float,
    path_error: PathError,
    *,
    smooth: bool,
) -> tuple[MomentTrack, ...]:
    """Return the tracks of all sources at places (n, K, 3)."""
    if array.channel_is_scalar.all() and used.ambient_T is None and array.ambient_T is None:
        raise ValueError(_SIGN_UNKNOWN)
    if rotations is None:
        rotations = _integrate_rates(used)
        if used.motion is not None:
            rates = used.motion.rate_sigma_rad_s
            turn_rad_s = math.hypot(turn_rad_s, math.sqrt(float(np.mean(np.sum(rates**2, axis=1)))))
    n_sources = position_m.shape[1]
    basis = turning_basis(np.kron(np.eye(n_sources), rotations).astype(np.float64))
    model = moment_model(array, [used], [position_m], basis, path_error, turn_rad_s)
    steps = relinearise(model, gate=True) if smooth else filter_rows(model)
    chi2, dof = goodness_of_fit(model, steps)
    found = [tuple(_points(model, steps, k, smooth=smooth)) for k in range(n_sources)]
    warn_of_strengths(point for points in found for point in points)
    return tuple(MomentTrack(points, used, model, chi2, dof, smooth) for points in found)


def rows_on_path(readings: Readings, path: ObjectPath | ArrayLike) -> tuple[FloatArray, FloatArray | None, Readings]:
    """Return positions (n, 3), rotations (n, 3, 3) if known, and readings of rows on the path."""
    if isinstance(path, ObjectPath):
        position_m, rotations = path.at(readings.time_s)
        on = np.flatnonzero(np.isfinite(position_m).all(axis=1))
        return position_m[on], None if rotations is None else rotations[on], readings[on]
    given = np.asarray(path, dtype=np.float64)
    if given.shape not in ((3,), (len(readings), 3)) or not np.isfinite(given).all():
        raise ValueError(f"Input path must have finite positions (3,) or (n, 3); instead received shape {given.shape}.")
    return np.broadcast_to(given, (len(readings), 3)), None, readings


def _integrate_rates(readings: Readings) -> FloatArray:
    """Return the object's rotations (n, 3, 3) since the first row, from measured rates.

    They are in the array's axes, without its pose.
    """
    R = np.tile(np.eye(3), (len(readings), 1, 1))
    if readings.motion is None:
        return R
    rates = readings.motion.of_steps().rate_rad_s
    by_step = (rates[:, 1] - rates[:, 0]) * np.diff(readings.time_s, prepend=readings.time_s[0])[:, None]
    for j in range(1, len(R)):
        R[j] = rotation_matrix(by_step[j]) @ R[j - 1]
    return R


def turning_basis(M: FloatArray) -> Basis:
    """Return the basis of moments M (n, 3 K, q) that turn with the object as a whole."""
    n, size, q = M.shape
    by_turn = np.einsum("aij,nkjq->nakiq", cross_matrix(np.eye(3)), M.reshape(n, -1, 3, q))
    return Basis(M, by_turn.reshape(n, 3, size, q))


def moment_model(
    array: SensorArray,
    passes: Sequence[Readings],
    positions_m: Sequence[FloatArray],
    basis: Basis,
    path_error: PathError,
    turn_rad_s: float,
) -> MomentModel:
    """Return the model of successive records, each with its own places (n, K, 3)."""
    check_magnitudes(array)
    background = BackgroundDrift.of(passes[0].background, np.concatenate([of_pass.time_s for of_pass in passes]))
    measurements = RowMeasurements(array, N_SOURCE, background)
    rows = tuple(measurements.of(row) for of_pass in passes for row in rows_of(of_pass))
    times = np.array([row.row.time_s for row in rows])
    if not (np.diff(times) > 0.0).all():
        late = int(np.argmax(np.diff(times) <= 0.0))
        raise ValueError(
            f"Input time_s must increase from row to row; instead {times[late + 1]:.15g} s follows"
            f" {times[late]:.15g} s."
        )
    for row, places in zip(rows, np.concatenate(positions_m), strict=True):
        for p in places:
            offset = row.row.R_world_from_array.T @ (p - row.row.origin_m) - array.positions
            if np.linalg.norm(offset, axis=1).min() <= _TOUCHING * array.circumradius:
                raise ValueError(f"Input path must not pass through a sensor; instead received {p.tolist()}.")
    begins = np.concatenate([np.arange(len(of_pass)) == 0 for of_pass in passes])
    return MomentModel(rows, np.concatenate(positions_m), basis, measurements.errors, path_error, turn_rad_s, begins)


def goodness_of_fit(model: MomentModel, steps: Sequence[MomentStep]) -> tuple[float, int]:
    """Return χ² of all rows that have a prediction, and its degrees of freedom."""
    judged = [(step.nis, row.z.size) for step, row in zip(steps, model.rows, strict=True) if step.status != "acquired"]
    chi2 = sum(nis for nis, _ in judged if math.isfinite(nis))
    return chi2, sum(size for nis, size in judged if math.isfinite(nis)) - model.n_parameters


def _points(model: MomentModel, steps: Sequence[MomentStep], k: int, *, smooth: bool) -> list[TrackPoint]:
    """Return the points of the track of source k, from the filter or from the smoother."""
    states = states_of(steps, smooth=smooth)
    array = model.rows[0].model.array
    # S_0: covariance propagated from the start without measurements; MeasureS is relative to it.
    x_0, open_loop = model.start()
    unknown = float(open_loop[model.moment.start, model.moment.start])
    points = []
    for i, (step, (x, S)) in enumerate(zip(steps, states, strict=True)):
        if i:
            F, S_q = model.step(x_0, i)
            open_loop = np.diag(np.linalg.norm(np.concatenate([np.diag(F) @ open_loop, S_q], axis=1), axis=1))
        row, J = model.rows[i].row, model.sources_jacobian(i, x)[k]
        source, root = model.sources(i, x)[k], J @ S
        known = np.linalg.norm(root[3:], ord=2) < _UNDETERMINED * unknown
        with np.errstate(invalid="ignore"):
            learned = np.nan_to_num(estimability(root, J @ open_loop))
        points.append(
            TrackPoint(
                row.time_s,
                source[:3] if known else None,
                source[3:] if known else None,
                root @ root.T if known else None,
                learned if known else None,
                step.iterations,
                nis=step.nis,
                nis_dof=model.rows[i].z.size,
                status=step.status if known else "not determined: the readings do not yet determine the whole moment",
                centroid_m=row.origin_m + row.R_world_from_array @ array.centroid,
                radius_m=array.circumradius or 1.0,  # a unit of ranges; a single sensor has no circumradius
            )
        )
    return points


def _covariances_at(model: MomentModel, moment_Am2: FloatArray, *, smooth: bool) -> FloatArray:
    """Return the moment's covariances (n, 3, 3) for a filter linearised at the true moments."""
    at = []
    for i, moment in enumerate(np.nan_to_num(moment_Am2)):
        state = np.zeros(model.moment.stop + model.errors.n_states)
        state[model.moment] = np.linalg.lstsq(model.basis.M[i], moment, rcond=None)[0]
        at.append(state)
    steps = filter_rows(model, at=at, gate=False)
    states = states_of(steps, smooth=smooth)
    roots = [(model.sources_jacobian(i, x)[0] @ S)[3:] for i, (x, S) in enumerate(states)]
    return np.array([root @ root.T for root in roots])
