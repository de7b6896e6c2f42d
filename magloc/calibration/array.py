"""Calibration of an array of vector sensors by a source that moves past it.

Least squares over all rows (:mod:`magloc.calibration.least_squares`) estimates positions, gains, axes and offsets of
the sensors together with the source; the nominal array is the prior. :func:`calibrate_on_path` needs the path of the
source; :func:`self_calibrate` estimates it too. :mod:`magloc.calibration.observability` lists what the readings do not
determine; there the estimate stays at the nominal array.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from arrays.array import SensorArray
from arrays.io.errors import check_positive
from arrays.noise import proportional_noise
from arrays.typing import BoolArray, FloatArray
from magloc.calibration import continuation as calibration_steps
from magloc.calibration import least_squares as source_fit
from magloc.calibration.model import CalibrationProblem, CalibrationState, MomentKind
from magloc.calibration.observability import unobservable_of_source
from magloc.calibration.results import SourceCalibration
from magloc.calibration.sensors import AXES, GAINS, OFFSET, PER_SENSOR, POSITION
from magloc.localization.locator import Locator
from magloc.measurement.rows import check_rows

Quantity = Literal["positions", "gains", "axes", "offsets"]
QUANTITIES: tuple[Quantity, ...] = get_args(Quantity)
# For the source with the nominal array, whose χ² is only a comparison.
_ITERATIONS_BEFORE = 10
_PLACES = {"positions": POSITION, "gains": GAINS, "axes": AXES, "offsets": OFFSET}


@dataclass(frozen=True)
class CalibrationPrior:
    """Uncertainty of the nominal array, and which of its quantities are estimated.

    Attributes
    ----------
    position_m, gain, axes_rad, offset_T : float
        Standard deviations of a position along each axis [m], of a channel's relative gain, of a channel's direction
        towards each of the two other axes [rad], and of an offset [T].
    estimate : tuple of str
        Quantities to estimate, from positions, gains, axes and offsets; the others stay nominal.
    trusted_positions, trusted_scales : tuple of str
        Ids of sensors with exact nominal positions, and of those with exact nominal gains and axes.

    Raises
    ------
    ValueError
        A standard deviation is not positive, or `estimate` names an unknown quantity.

    Examples
    --------
    >>> import magloc
    >>> prior = magloc.CalibrationPrior(gain=0.02, estimate=("gains", "offsets"))
    >>> prior.gain
    0.02
    """

    position_m: float = 5e-3
    gain: float = 0.2
    axes_rad: float = math.radians(3.0)
    offset_T: float = 1e-4
    estimate: tuple[Quantity, ...] = QUANTITIES
    trusted_positions: tuple[str, ...] = ()
    trusted_scales: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        check_positive(position_m=self.position_m, gain=self.gain, axes_rad=self.axes_rad, offset_T=self.offset_T)
        for quantity in self.estimate:
            if quantity not in QUANTITIES:
                raise ValueError(
                    f"Input estimate must be some of {', '.join(QUANTITIES)}; instead received {quantity!r}."
                )
        if not self.estimate:
            raise ValueError(f"Input estimate must be some of {', '.join(QUANTITIES)}; instead received none.")

    def deviations(self, n_sensors: int) -> FloatArray:
        """Return the standard deviations of all unknowns of the sensors, shape (N, 15)."""
        row = np.empty(PER_SENSOR)
        row[POSITION], row[GAINS], row[AXES], row[OFFSET] = self.position_m, self.gain, self.axes_rad, self.offset_T
        return np.tile(row, (n_sensors, 1))

    def free(self, array: SensorArray) -> BoolArray:
        """Return which unknowns of an array's sensors are estimated, shape (N, 15)."""
        free = np.zeros((array.n_sensors, PER_SENSOR), dtype=np.bool_)
        for quantity in self.estimate:
            free[:, _PLACES[quantity]] = True
        for ids, places in ((self.trusted_positions, (POSITION,)), (self.trusted_scales, (GAINS, AXES))):
            for name in ids:
                if name not in array.ids:
                    raise ValueError(f"Input prior must trust ids of sensors of the array; instead received {name!r}.")
                for place in places:
                    free[array.ids.index(name), place] = False
        return free


def calibrate_on_path(
    array: SensorArray,
    readings_T: ArrayLike,
    position_m: ArrayLike,
    *,
    position_sigma_m: ArrayLike | None = None,
    moment_Am2: ArrayLike | None = None,
    axis: ArrayLike | None = None,
    moment: Literal["constant", "free"] = "constant",
    unknown_height: bool = False,
    prior: CalibrationPrior = CalibrationPrior(),
    world_from_array: ArrayLike | None = None,
) -> SourceCalibration:
    """Calibrate by a source at known positions (n, 3) in the array's frame.

    With `unknown_height` a constant is added to all positions along the world's z, and estimated. With
    `position_sigma_m` (n,) the positions have errors of that standard deviation per axis, and are estimated too. With
    `axis` (n, 3), unit vectors in the world frame, the moment has these directions and one unknown strength.
    """
    readings, attitude = _check_inputs(array, readings_T, world_from_array)
    position = _check_vectors("position_m", position_m, len(readings))
    known = None if moment_Am2 is None else _check_vectors("moment_Am2", moment_Am2, len(readings))
    model: MomentKind = moment if known is None else "known"
    problem = _problem(array, readings, attitude, prior, position_sigma_m is not None, unknown_height, model)
    if position_sigma_m is not None:
        sigma_m = np.broadcast_to(np.asarray(position_sigma_m, dtype=np.float64), len(readings))
        problem = replace(problem, path_m=position, path_sigma_m=sigma_m)
    if axis is not None:
        problem = replace(problem, moment="axis", axis=_check_vectors("axis", axis, len(readings)))
    rows = _usable_rows(problem)
    problem = _select_rows(problem, rows)
    _check_counts(problem)
    start = calibration_steps.nominal_state(
        problem, position[rows], np.zeros_like(position[rows]) if known is None else known[rows]
    )
    return _fit(problem, calibration_steps.fit_source_on_path(problem, start), rows)


def self_calibrate(
    array: SensorArray,
    readings_T: ArrayLike,
    *,
    moment: Literal["constant", "free"] = "constant",
    prior: CalibrationPrior = CalibrationPrior(),
    world_from_array: ArrayLike | None = None,
) -> SourceCalibration:
    """Calibrate by a source on an unknown path, from fixes with the nominal array."""
    readings, attitude = _check_inputs(array, readings_T, world_from_array)
    problem = _problem(array, readings, attitude, prior, True, False, moment)
    doubtful = calibration_steps.inflate_field_noise(problem, np.zeros(problem.prior.shape))
    fixes = Locator(doubtful, body_length_m=0.0, exclude_faulty=False).fit_rows(readings)
    rows = fixes.solved & _usable_rows(problem)
    if not rows.any():
        raise ValueError(
            "Input readings_T must have rows that can be located with the nominal array; instead none can."
        )
    problem = _select_rows(problem, rows)
    _check_counts(problem)
    start = calibration_steps.state_from_fixes(problem, [fixes[row] for row in np.flatnonzero(rows).tolist()])
    # With a moment for each row the rows are independent and converge from rough fixes.
    start = calibration_steps.approach_optimum(replace(problem, moment="free"), start, calibration_steps.SHARES[:1])
    if moment == "constant":
        # A row on the wrong side of the array would bias the common moment, so all rows are fixed again.
        start = calibration_steps.with_common_moment(problem, start)
    return _fit(problem, start, rows)


def _check_inputs(
    array: SensorArray, readings_T: ArrayLike, world_from_array: ArrayLike | None
) -> tuple[FloatArray, FloatArray]:
    if array.channel_is_scalar.any():
        raise ValueError("Input array must have vector sensors only; instead received one with scalar sensors.")
    readings = check_rows(array, readings_T)
    attitude = np.eye(3) if world_from_array is None else np.asarray(world_from_array, dtype=np.float64)
    if attitude.shape not in ((3, 3), (len(readings), 3, 3)):
        raise ValueError(
            f"Input world_from_array must have shape ({len(readings)}, 3, 3); instead received {attitude.shape}."
        )
    return readings, np.broadcast_to(attitude, (len(readings), 3, 3))


def _check_vectors(name: str, value: ArrayLike, n: int) -> FloatArray:
    rows = np.asarray(value, dtype=np.float64)
    if rows.shape != (n, 3) or not np.isfinite(rows).all():
        raise ValueError(f"Input {name} must be finite and have shape ({n}, 3); instead received shape {rows.shape}.")
    return rows


def _problem(
    array: SensorArray,
    readings: FloatArray,
    attitude: FloatArray,
    prior: CalibrationPrior,
    unknown_position: bool,
    unknown_height: bool,
    moment: MomentKind,
) -> CalibrationProblem:
    return CalibrationProblem(
        array=array,
        readings_T=readings,
        noise_T=proportional_noise(array, readings),
        prior=prior.deviations(array.n_sensors),
        free=prior.free(array),
        world_from_array=attitude,
        unknown_position=unknown_position,
        unknown_height=unknown_height,
        moment=moment,
    )


def _usable_rows(problem: CalibrationProblem) -> BoolArray:
    """Return which rows have more readings than unknowns of their own."""
    unknown = problem.n_row_unknowns - 3 * (problem.path_sigma_m is not None)
    return np.isfinite(problem.readings_T).sum(axis=1) > unknown


def _select_rows(problem: CalibrationProblem, rows: BoolArray) -> CalibrationProblem:
    names = ("readings_T", "noise_T", "world_from_array", "path_m", "path_sigma_m", "axis")
    of_rows = {name: getattr(problem, name) for name in names}
    chosen: dict[str, Any] = {name: values[rows] for name, values in of_rows.items() if values is not None}
    return replace(problem, **chosen)


def _check_counts(problem: CalibrationProblem) -> None:
    unknowns, left = len(problem.estimated_indices), problem.n_numbers
    if left < unknowns:
        raise ValueError(
            f"Input readings_T must have more readings than unknowns; instead {len(problem.readings_T)} usable rows "
            f"leave {left} numbers for {unknowns} unknowns of the sensors and the source."
        )


def _fit(problem: CalibrationProblem, start: CalibrationState, rows: BoolArray) -> SourceCalibration:
    start = calibration_steps.approach_optimum(problem, start)
    problem, optimum = calibration_steps.fit_calibration(problem, start)
    state = optimum.point.state
    stated = replace(problem, noise_scale=1.0)
    nominal = replace(stated, free=np.zeros_like(problem.free))
    nominal_sensors = replace(state, sensors=np.zeros_like(state.sensors))
    before = source_fit.fit_state(nominal, nominal_sensors, max_iterations=_ITERATIONS_BEFORE)
    after = stated.chi2(state)
    told = source_fit.information_of_sensors(problem, state)
    n = len(told)
    relative = source_fit.posterior_covariance(told)
    covariance = relative * np.outer(problem.prior[problem.free], problem.prior[problem.free])
    deviation = np.zeros(problem.prior.shape)
    deviation[problem.free] = np.sqrt(np.diagonal(covariance))
    told_numbers = n - float(np.trace(relative))
    array_from_world = np.swapaxes(problem.world_from_array, -1, -2)
    return SourceCalibration(
        nominal=problem.array,
        array=calibration_steps.apply_calibration(problem.array, state.sensors),
        converged=optimum.converged,
        iterations=optimum.iterations,
        rows=rows,
        chi2_before=nominal.chi2(before.point.state),
        chi2=after,
        dof_before=problem.n_numbers - problem.n_globals,
        dof=problem.n_numbers - problem.n_globals - told_numbers,
        residual_rms_T=stated.residual_rms_T(state),
        change=state.sensors,
        sigma=deviation,
        estimated=problem.free,
        covariance=covariance,
        unobservable=unobservable_of_source(problem, state, told),
        position_m=state.position_m + state.height_m * array_from_world[..., 2],
        moment_Am2=np.array(state.moment_Am2),
        readings_T=problem.readings_T,
        world_from_array=problem.world_from_array,
    )
