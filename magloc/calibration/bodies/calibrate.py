"""Calibration of a body's magnets and an array's sensors together, by the body in motion.

The poses are known (jigs), unknown, or known in some rows, such as those of a rest. Least squares over all rows
(:mod:`magloc.calibration.least_squares`) estimates the poses with the sensors and the magnets; the nominal array and
body are the prior.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from arrays.array import SensorArray
from arrays.io.errors import check_positive
from arrays.noise import proportional_noise
from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.bodies.body import MagnetBody
from magloc.bodies.field import body_fields
from magloc.bodies.locator import BodyLocator
from magloc.bodies.plausibility import check_lengths
from magloc.bodies.poses import BodyPoses
from magloc.calibration import least_squares as body_fit
from magloc.calibration.array import CalibrationPrior
from magloc.calibration.bodies.gauges import unobservable_of_body, wider_limits
from magloc.calibration.bodies.model import DIRECTION, PER_MAGNET, PLACE, STRENGTH, BodyProblem, BodyState, changed_body
from magloc.calibration.bodies.results import BodyCalibration, PoseErrors
from magloc.calibration.bodies.tolerances import with_posterior
from magloc.calibration.continuation import (
    SHARES,
    apply_calibration,
    fit_calibration,
    inflate_field_noise,
    inflate_noise,
)
from magloc.calibration.least_squares import CalibrationIterate
from magloc.calibration.sensors import AXES, GAINS, OFFSET
from magloc.least_squares import Optimum
from magloc.measurement.plausibility import warn_of_array
from magloc.measurement.rows import check_magnitudes
from magloc.readings import Readings, without_saturated
from magloc.truth import Truth, rows_of_same_time

FOLDS = 5
_FEWEST_ROWS = 4 * FOLDS
_ROUGHLY = 1.0
_ITERATIONS = 60
# Rows whose χ² exceeds the median by this factor after the coarse fits stand in a wrong optimum.
_BADLY = 20.0
# Rows whose positions are compared with the stated ones; factor that only another unit explains; extent over the
# array's radius below which positions have no unit to be seen.
_COMPARED, _SCALE, _STILL = 60, 20.0, 1e-3
_FAR_SIGMAS = 5.0


@dataclass(frozen=True)
class BodyPrior:
    """Uncertainty of a nominal body, for magnets whose file states none.

    Attributes
    ----------
    position_m, strength, direction_rad : float
        Standard deviations of a magnet's position along each axis [m], of its relative strength, and of its direction
        about each of two axes across it [rad].

    Raises
    ------
    ValueError
        A standard deviation is not positive.

    Examples
    --------
    >>> import magloc
    >>> magloc.BodyPrior(position_m=2e-4).strength
    0.1
    """

    position_m: float = 5e-4
    strength: float = 0.1
    direction_rad: float = math.radians(3.0)

    def __post_init__(self) -> None:
        check_positive(position_m=self.position_m, strength=self.strength, direction_rad=self.direction_rad)

    def deviations(self, body: MagnetBody) -> FloatArray:
        """Return the standard deviations of the magnets' unknowns (K, 6); what the body states comes first."""
        rows = np.empty((len(body.magnets), PER_MAGNET))
        for row, magnet in zip(rows, body.magnets, strict=True):
            row[PLACE] = magnet.position_sigma_m or self.position_m
            row[STRENGTH] = math.hypot(magnet.relative_sigma, body.common_strength_sigma) or self.strength
            row[DIRECTION] = magnet.direction_sigma_rad or self.direction_rad
        return rows


def calibrate_body(
    array: SensorArray,
    body: MagnetBody,
    readings: Readings,
    *,
    truth: Truth | None = None,
    free_rows: bool = False,
    prior: CalibrationPrior = CalibrationPrior(position_m=5e-4),
    body_prior: BodyPrior = BodyPrior(),
    validate: bool = True,
) -> BodyCalibration:
    """Calibrate the sensors of an array and the magnets of a rigid body together, by the body in motion.

    With `truth` the poses are known, as in a jig. Without it they are estimated; then the readings do not show where
    array and body as a whole stand in their frames, how they are turned, and their common size and strength.

    Parameters
    ----------
    array, body : SensorArray, MagnetBody
        Nominal vector sensors and magnets. Uncertainties of gains, axes and offsets that the array states, and those of
        the magnets that the body states, take the place of the priors.
    readings : Readings
        Readings that saturate do not count.
    truth : Truth, optional
        Poses of the body in the readings' frame, for rows of the same time: positions and rotations, exact or with
        `sigma_m` and `sigma_rad`.
    free_rows : bool
        Use rows without a pose in the truth too, and estimate their poses. So a rest with a known pose and a few free
        turns calibrate.
    prior : CalibrationPrior
        Uncertainty of the nominal array.
    body_prior : BodyPrior
        Uncertainty of the nominal body.
    validate : bool
        Hold rows out in turn, to test the calibration on rows that it did not use.

    Returns
    -------
    BodyCalibration
        If it did not converge, no number in it is a result.

    Raises
    ------
    ValueError
        The array has scalar sensors or a single one, the truth has no attitudes, no time of the readings or another
        unit of length, or there are fewer readings than unknowns.

    Examples
    --------
    >>> import numpy as np
    >>> import magloc
    >>> from sims.magnetics import joystick
    >>> rng = np.random.default_rng(0)
    >>> device, poses = joystick.draw_joystick(rng), joystick.random_poses(rng, 60)
    >>> readings = device.read(*poses, rng)
    >>> truth = joystick.jig_truth(readings, *poses, rng)
    >>> result = magloc.calibrate_body(joystick.nominal_array(), joystick.nominal_knob(), readings, truth=truth)
    >>> result.converged, [part.name for part in result.unobservable]
    (True, ['common gain against the strength of the magnets'])
    """
    check_magnitudes(array)
    warn_of_array(array)
    rows = without_saturated(readings, array)
    if array.channel_is_scalar.any():
        raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
    if array.n_sensors < 2:
        raise ValueError(f"Input array must have two sensors or more; instead received {array.n_sensors}.")
    check_lengths(array, body)
    used, poses = _poses(array, body, rows, truth, free_rows)
    plain = _without_errors(array)
    problem = BodyProblem(
        array=plain,
        readings_T=rows.values_T[used],
        noise_T=proportional_noise(plain, rows.values_T[used]),
        prior=_sensor_deviations(array, prior),
        free=prior.free(array),
        body=body,
        magnet_prior=body_prior.deviations(body),
        **poses,
    )
    _check_counts(problem)
    _check_units(problem)
    problem, start, kept = _start(problem)
    used[np.flatnonzero(used)[~kept]] = False
    weighted, optimum = fit_calibration(problem, _approach(problem, start))
    result = _result(weighted, optimum, array, used)
    return replace(result, cross_validation=_leave_rows_out(problem, optimum.point.state)) if validate else result


def _without_errors(array: SensorArray) -> SensorArray:
    """Return the array without the errors of its sensors that are estimated here, so that only noise remains."""
    sensors = [
        replace(sensor, gain_uncertainty=0.0, misalignment_rad=0.0, offset_uncertainty_T=0.0)
        for sensor in array.sensors
    ]
    return replace(array, sensors=tuple(sensors))


def _sensor_deviations(array: SensorArray, prior: CalibrationPrior) -> FloatArray:
    """Return the standard deviations of the sensors' unknowns (N, 15); what the array states comes first."""
    deviations = prior.deviations(array.n_sensors)
    for row, sensor in zip(deviations, array.sensors, strict=True):
        row[GAINS] = sensor.gain_uncertainty or row[GAINS]
        row[AXES] = sensor.misalignment_rad or row[AXES]
        row[OFFSET] = sensor.offset_uncertainty_T or row[OFFSET]
    return deviations


def _poses(
    array: SensorArray, body: MagnetBody, rows: Readings, truth: Truth | None, free_rows: bool
) -> tuple[BoolArray, dict[str, Any]]:
    """Return which rows are used, and their measured poses in the array's frame; the pose at rest where unknown."""
    n = len(rows)
    position, sigma = np.tile(_rest_position(array, body), (n, 1)), np.full((n, 2), np.inf)
    R = np.tile(np.eye(3), (n, 1, 1))
    if truth is not None:
        if truth.rotation is None:
            raise ValueError("Input truth must have the attitude of the body: qx, qy, qz, qw; instead it has none.")
        in_readings, in_truth = rows_of_same_time(rows, truth)
        if not in_readings.size:
            raise ValueError("Input truth must have times of the readings; instead it has none of them.")
        if np.isnan(truth.position_m[in_truth]).any():
            raise ValueError("Input truth must have x, y and z; instead a position lacks one of them.")
        position[in_readings], rotation = truth.position_m[in_truth], truth.rotation[in_truth]
        if rows.pose is not None:
            origin, attitude = rows.pose[0][in_readings], rows.pose[1][in_readings].inv()
            position[in_readings], rotation = attitude.apply(position[in_readings] - origin), attitude * rotation
        R[in_readings] = rotation.as_matrix()
        for column, stated in enumerate((truth.sigma_m, truth.sigma_rad)):
            sigma[in_readings, column] = 0.0 if stated is None else stated[in_truth]
    is_known = np.isfinite(sigma).all(axis=1)
    fewest = np.where(is_known, 1, 7 + 3 * (array.common_field_T is None))
    used = (np.isfinite(rows.values_T).sum(axis=1) >= fewest) & (is_known | free_rows | (truth is None))
    return used, {"pose_m": position[used], "pose_R": R[used], "pose_sigma": sigma[used]}


def _rest_position(array: SensorArray, body: MagnetBody) -> FloatArray:
    """Return the middle of the body's range, or a place above the array, one radius away."""
    if body.limits.is_bounded:
        return 0.5 * (np.array(body.limits.low_m) + np.array(body.limits.high_m))
    height = np.array([0.0, 0.0, array.circumradius + body.radius_m])
    return np.asarray(array.centroid + height - body.centre_m)


def _check_counts(problem: BodyProblem) -> None:
    unknowns, left = len(problem.estimated_indices), problem.n_numbers
    if left < unknowns:
        common = problem.array.common_field_T is None
        cure = (
            "; state common_field_nT in the array file, because every row has an unknown common field" if common else ""
        )
        raise ValueError(
            f"Input readings must have more readings than unknowns; instead {len(problem.readings_T)} usable rows leave"
            f" {left} numbers for {unknowns} unknowns of the sensors and the magnets{cure}."
        )


def _check_units(problem: BodyProblem) -> None:
    """Refuse readings far from those of the nominal body, and known positions in another unit of length than metres."""
    rest = _rest_position(problem.array, problem.body)
    expected = problem.array.readings_of(
        body_fields(problem.body, problem.array.positions, rest[None], np.eye(3)[None])
    )
    read, nominal = (float(np.nanmedian(np.abs(each))) for each in (problem.readings_T, expected))
    if not nominal / _SCALE**2 <= read <= nominal * _SCALE**2:
        raise ValueError(
            f"Input readings must be those of the body; instead they are about {read:.3g} T, and the nominal body at"
            f" rest gives {nominal:.3g} T: another unit, or no body."
        )
    known = np.flatnonzero(problem.has_pose)
    if known.size < 2:
        return
    chosen = known[np.unique(np.linspace(0, known.size - 1, _COMPARED).round().astype(np.intp))]
    found = _locate(problem, chosen)
    if found.solved.sum() < 2:
        return
    positions = problem.pose_m[chosen[found.solved]], found.position_m[found.solved, 0]
    stated, located = (float(np.linalg.norm(np.ptp(each, axis=0))) for each in positions)
    if not located / _SCALE <= stated <= located * _SCALE and stated > _STILL * problem.array.circumradius:
        raise ValueError(
            f"Input truth must have positions in metres and of these readings; instead they extend over {stated:.3g} m,"
            f" while the readings show a motion of about {located:.3g} m."
        )


def _nominal_state(problem: BodyProblem) -> BodyState:
    return BodyState(
        np.zeros(problem.prior.shape),
        np.zeros(problem.magnet_prior.shape),
        problem.pose_m,
        problem.pose_R,
        np.zeros((len(problem.readings_T), 3)),
    )


def _locate(problem: BodyProblem, rows: IntArray) -> BodyPoses:
    """Return the poses of some rows with the nominal array and body, without a start."""
    doubtful = inflate_field_noise(problem, np.zeros(problem.prior.shape))
    return BodyLocator(doubtful, problem.body, find_causes=False).fit_rows(problem.readings_T[rows])


def _start(problem: BodyProblem) -> tuple[BodyProblem, BodyState, BoolArray]:
    """Return a problem and a state near its optimum, and which rows are kept.

    Rows without a pose, or in a wrong optimum, are excluded.
    """
    state = _nominal_state(problem)
    unknown = np.flatnonzero(~problem.has_pose)
    solved = np.ones(len(state.R), dtype=np.bool_)
    if unknown.size:
        found = _locate(problem, unknown)
        solved[unknown] = found.solved
        position, R = state.position_m.copy(), state.R.copy()
        position[unknown], R[unknown] = found.position_m[:, 0], found.R[:, 0]
        if solved.sum() < 0.5 * len(solved):
            raise ValueError(
                f"Input readings must be those of the body; instead only {int(solved.sum())} of {len(solved)} rows have"
                " a pose with the nominal array and body. Check the moments of the magnets and the axes of the sensors."
            )
        problem, state = _some(problem, solved), _rows_of(replace(state, position_m=position, R=R), solved)
        _check_counts(problem)
    for share in SHARES[:2]:
        lenient = inflate_noise(problem, state.sensors, share)
        state = body_fit.fit_state(lenient, state, tolerance=_ROUGHLY, max_iterations=_ITERATIONS).point.state
    chi2 = np.sum(lenient.residuals(lenient.prediction_T(state)) ** 2, axis=1)
    fitted = problem.has_pose | (chi2 <= _BADLY * np.median(chi2))
    solved[solved] = fitted
    return _some(problem, fitted), _rows_of(state, fitted), solved


def _fixed(problem: BodyProblem) -> BodyProblem:
    """Return the problem with exact sensors and magnets, so that only the poses are fitted."""
    return replace(problem, free=np.zeros_like(problem.free), magnets_free=False)


def _some(problem: BodyProblem, rows: BoolArray) -> BodyProblem:
    chosen: dict[str, Any] = {
        name: getattr(problem, name)[rows] for name in ("readings_T", "noise_T", "pose_m", "pose_R", "pose_sigma")
    }
    return replace(problem, **chosen)


def _rows_of(state: BodyState, rows: BoolArray) -> BodyState:
    return replace(state, position_m=state.position_m[rows], R=state.R[rows], common_T=state.common_T[rows])


def _approach(problem: BodyProblem, state: BodyState) -> BodyState:
    for share in SHARES[2:]:
        lenient = inflate_noise(problem, state.sensors, share)
        state = body_fit.fit_state(lenient, state, tolerance=_ROUGHLY).point.state
    return state


def _result(
    problem: BodyProblem, optimum: Optimum[CalibrationIterate[BodyState]], stated_array: SensorArray, used: BoolArray
) -> BodyCalibration:
    state = optimum.point.state
    stated = replace(problem, noise_scale=1.0)
    nominal = _fixed(stated)
    before = body_fit.fit_state(nominal, replace(state, sensors=0.0 * state.sensors, magnets=0.0 * state.magnets))
    told = body_fit.information_of_sensors(problem, state)
    relative = body_fit.posterior_covariance(told)
    unit = np.concatenate([problem.prior[problem.free], problem.magnet_prior.ravel()])
    covariance = relative * np.outer(unit, unit)
    n = int(problem.free.sum())
    sigma = np.zeros(problem.prior.shape)
    sigma[problem.free] = np.sqrt(np.diagonal(covariance)[:n])
    magnet_sigma = np.sqrt(np.diagonal(covariance)[n:]).reshape(problem.magnet_prior.shape)
    array = apply_calibration(stated_array, state.sensors)
    body = changed_body(problem.body, state.magnets)
    array, body = with_posterior(problem, state, told, array, body)
    unobservable = unobservable_of_body(problem, state, told)
    body = replace(body, limits=wider_limits(problem, unobservable))
    return BodyCalibration(
        nominal=stated_array,
        array=array,
        nominal_body=problem.body,
        body=body,
        converged=optimum.converged,
        iterations=optimum.iterations,
        change=state.sensors,
        sigma=sigma,
        magnet_change=state.magnets,
        magnet_sigma=magnet_sigma,
        rows=used,
        chi2=stated.chi2(state),
        dof=stated.n_numbers - (len(told) - float(np.trace(relative))),
        chi2_before=nominal.chi2(before.point.state),
        dof_before=stated.n_numbers,
        rms_T=(nominal.residual_rms_T(before.point.state), stated.residual_rms_T(state)),
        estimated=problem.free,
        covariance=covariance,
        unobservable=unobservable,
        far_from_prior=_far_from_prior(problem, state),
        position_m=state.position_m,
        rotation=Rotation.from_matrix(state.R),
    )


def _far_from_prior(problem: BodyProblem, state: BodyState) -> tuple[str, ...]:
    """Return the sensors and magnets with a change beyond five standard deviations of the prior."""
    sensors = np.where(problem.free, np.abs(state.sensors) / problem.prior, 0.0).max(axis=1) > _FAR_SIGMAS
    magnets = (np.abs(state.magnets) / problem.magnet_prior).max(axis=1) > _FAR_SIGMAS
    named = [*(f"sensor {name}" for name in problem.array.ids), *(f"magnet {name}" for name in problem.body.ids)]
    return tuple(name for name, far in zip(named, [*sensors.tolist(), *magnets.tolist()], strict=True) if far)


def _leave_rows_out(problem: BodyProblem, start: BodyState) -> PoseErrors | None:
    """Return the errors of blocks of rows located with a calibration on the others, which starts at that of all."""
    known = problem.has_pose
    candidates = np.ones(len(known), dtype=np.bool_) if known.all() else ~known  # else known rows hold the frame
    n = int(candidates.sum())
    if n < _FEWEST_ROWS:
        return None
    fold = np.full(len(known), -1)
    fold[candidates] = np.arange(n) * FOLDS // n
    chi2, dof = 0.0, 0.0
    errors: list[tuple[FloatArray, ...]] = []
    for k in range(FOLDS):
        others, out = _some(problem, fold != k), fold == k
        if others.n_numbers < len(others.estimated_indices):
            return None
        _, optimum = fit_calibration(others, _rows_of(start, fold != k))
        found = optimum.point.state
        left_out = replace(_fixed(_some(problem, out)), pose_sigma=np.full((int(out.sum()), 2), np.inf))
        poses = replace(_rows_of(start, out), sensors=found.sensors, magnets=found.magnets)
        located = body_fit.fit_state(left_out, poses).point.state
        chi2 += left_out.chi2(located)
        dof += left_out.n_numbers
        turned = Rotation.from_matrix(np.swapaxes(left_out.pose_R, -1, -2) @ located.R).as_rotvec()
        shifted = located.position_m - left_out.pose_m
        errors.append(tuple(np.linalg.norm(each[known[out]], axis=1) for each in (shifted, turned)))
    error_m, error_rad = (np.concatenate(parts) for parts in zip(*errors, strict=True))
    return PoseErrors(chi2, dof, error_m, error_rad)
