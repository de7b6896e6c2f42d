"""Sensors, optional states and settings of an attitude filter. See docs/theory/attitude-kalman-filters.md."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import chdtri

from adcs.kalman.names import MEASURED_BY, TOGETHER, is_measured
from adcs.satellite.sensors import SENSOR_WORDS, SENSORS
from arrays.io.errors import check_not_negative, check_positive
from arrays.typing import BoolArray, FloatArray
from magloc.levels import CONTRADICTION

SIZES = {"field-bias": 3, "gyro-bias": 3, "disturbance": 3, "field-model": 3, "dipole": 3, "field-gain": 9}
"""Optional states in the order of the error state, with their numbers of components."""
STATES = tuple(SIZES)
FIELD_ERROR_T = 150e-9
"""Error of each component of a model of the core field: crust, currents around the Earth, and the model itself."""
DISTURBANCE_S2 = 2e-6
"""Standard deviation of the state ``disturbance`` at the start, for a least moment of inertia of 0.5 kg·m²."""
OPEN_RAD = 2.0
"""Standard deviation of the angle about an unknown axis, close to that of a uniform distribution."""
RATE_RAD_S = math.radians(0.5)
"""Standard deviation of the rate against the orbital frame without a gyro."""
ALWAYS = 6
"""Components of attitude and rate, which every filter has."""


@dataclass(frozen=True)
class SensorSet:
    """Sensors in use and optional states; made by :func:`sensor_set`, which checks them.

    ``states``: names of the optional states, in the order of :data:`STATES`.
    """

    star: bool = False
    gyro: bool = False
    magnetometer: bool = False
    sun: bool = False
    states: tuple[str, ...] = ()

    @property
    def sensors(self) -> str:
        """Names of the sensors, such as ``"st+gyro"``."""
        used = (self.star, self.gyro, self.magnetometer, self.sun)
        return "+".join(name for name, one in zip(SENSORS, used, strict=True) if one)

    @property
    def size(self) -> int:
        """Number of components of the error state."""
        return ALWAYS + sum(SIZES[state] for state in self.states)

    def slice_of(self, state: str) -> slice:
        """Return the slice of an optional state in the error state."""
        before = self.states[: self.states.index(state)]
        first = ALWAYS + sum(SIZES[name] for name in before)
        return slice(first, first + SIZES[state])

    def split(self, error: FloatArray) -> dict[str, FloatArray]:
        """Split errors or standard deviations (..., N) by state, (..., k); attitude becomes an angle."""
        always = {"attitude": 2.0 * error[..., :3], "rate": error[..., 3:6]}
        return always | {state: error[..., self.slice_of(state)] for state in self.states}

    def drop(self, state: str) -> SensorSet:
        """Return the set without an optional state."""
        return replace(self, states=tuple(name for name in self.states if name != state))


def sensor_set(sensors: str, states: Iterable[str] = ()) -> SensorSet:
    """Return a set of sensors and states by their names.

    ``sensors``: names of :data:`SENSORS` in any order with + between them. ``states``: names of :data:`STATES` in any
    order, or of :data:`adcs.kalman.names.TOGETHER`.
    """
    names = [name.strip().lower() for name in sensors.split("+")]
    optional = [state.strip().lower() for state in states]
    for given, known, what in ((names, SENSORS, "sensors"), (optional, (*STATES, *TOGETHER), "states")):
        unknown = [name for name in given if name not in known]
        if unknown or len(set(given)) != len(given):
            raise ValueError(
                f"Input {what} must be different names of {', '.join(known)}; instead received {'+'.join(given)!r}."
            )
    wanted = {one for state in optional for one in TOGETHER.get(state, (state,))}
    used = SensorSet(
        star="st" in names,
        gyro="gyro" in names,
        magnetometer="mag" in names,
        sun="sun" in names,
        states=tuple(state for state in STATES if state in wanted),
    )
    check_observable(used)
    return used


def check_observable(used: SensorSet) -> None:
    """Raise ValueError if a set cannot observe the attitude, or one of its states.

    One direction leaves the rotation about it open. The field changes its direction along the orbit: with a gyro, or
    with the equations of motion, its readings then observe that rotation too. The direction of the Sun stays constant,
    so a Sun sensor alone never does.
    """
    for state in used.states:
        if not is_measured(state, used.sensors):
            sensor = MEASURED_BY[state]
            raise ValueError(
                f"Input states must not have {state} without a {SENSOR_WORDS[sensor]}; add {sensor} to the sensors."
            )
    if used.star or used.magnetometer:
        return
    seen = "the Sun sensor leaves the rotation about the Sun open" if used.sun else "no sensor measures attitude"
    raise ValueError(
        f"Input sensors must observe attitude; instead received {used.sensors!r}: {seen}. Add a star tracker (st) or a "
        "magnetometer (mag)."
    )


@dataclass(frozen=True)
class ProcessNoise:
    """Standard deviations that each step adds to each component of the error state.

    Attributes
    ----------
    attitude : float
        q_λ of the vector part of the quaternion.
    rate_rad_s : float
        q_ω of the rate.
    field_bias_T : float
        q_b of the magnetometer's bias.
    gyro_bias_rad_s : float
        q_g of the gyro's bias.
    disturbance_s2 : float
        q_d of the disturbing acceleration.
    dipole_Am2 : float
        q_m of the dipole.
    field_gain : float
        q_D of each of the nine components of the magnetometer's gains.

    Raises
    ------
    ValueError
        A number is negative or not finite.
    """

    attitude: float
    rate_rad_s: float
    field_bias_T: float = 1e-9
    gyro_bias_rad_s: float = 1e-8
    disturbance_s2: float = 1e-8
    dipole_Am2: float = 1e-7
    field_gain: float = 1e-8

    def __post_init__(self) -> None:
        check_not_negative(**vars(self))


@dataclass(frozen=True)
class FilterSettings:
    """Settings of an attitude filter.

    Attributes
    ----------
    sensors : SensorSet
        Sensors in use and optional states.
    noise : ProcessNoise
        Process noise of a usual step.
    field_error_T : float
        Standard deviation of each component of the field model's error. It is added to the magnetometer's noise. With
        the state ``field-model`` it is the state's, and 0 means :data:`FIELD_ERROR_T`.
    field_correlation_s : float
        Time constant of the state ``field-model``; 1,000 km of a low orbit.
    disturbance_correlation_s : float
        Time constant of the state ``disturbance``, which keeps its initial standard deviation; if infinite, the state
        is a random walk.
    field_bias_sigma_T, gyro_bias_sigma_rad_s, disturbance_sigma_s2, dipole_sigma_Am2 : float
        Initial standard deviations of those states, whose initial values are zero. The dipole is added to the known
        residual dipole of the satellite.
    field_gain_sigma, field_axes_sigma_rad : float
        Initial standard deviations of the magnetometer's gains and of the misalignment of its axes, the state
        ``field-gain``.
    gate : float
        Probability that the gate rejects a good reading; with 0 all readings are used.
    """

    sensors: SensorSet
    noise: ProcessNoise
    field_error_T: float = 0.0
    field_bias_sigma_T: float = 1000e-9
    gyro_bias_sigma_rad_s: float = 1e-3
    disturbance_sigma_s2: float = DISTURBANCE_S2
    dipole_sigma_Am2: float = 0.1
    field_gain_sigma: float = 0.05
    field_axes_sigma_rad: float = math.radians(1.0)
    field_correlation_s: float = 132.0
    disturbance_correlation_s: float = math.inf
    gate: float = CONTRADICTION

    def __post_init__(self) -> None:
        check_not_negative(field_error_T=self.field_error_T)
        if not 0.0 <= self.gate < 1.0:
            raise ValueError(f"Input gate must be a probability below 1; instead received {self.gate}.")
        sigmas = {name: value for name, value in vars(self).items() if "_sigma" in name}
        check_positive(**sigmas, field_correlation_s=self.field_correlation_s)
        if not self.disturbance_correlation_s > 0.0:
            raise ValueError(
                f"Input disturbance_correlation_s must be positive; instead received {self.disturbance_correlation_s}."
            )

    @property
    def field_model_sigma_T(self) -> float:
        """Standard deviation of the state ``field-model``."""
        return self.field_error_T or FIELD_ERROR_T

    def decay(self, step_s: float | FloatArray) -> FloatArray:
        """Return the factors by which a step multiplies the error state.

        Shape (N,), or (k, N) for steps (k, 1); below 1 for states with a time constant.
        """
        rate = np.zeros(self.sensors.size)
        for state, time_s in (
            ("field-model", self.field_correlation_s),
            ("disturbance", self.disturbance_correlation_s),
        ):
            if state in self.sensors.states:
                rate[self.sensors.slice_of(state)] = 1.0 / time_s
        return np.exp(-np.asarray(step_s) * rate)

    def process_variance(self, step_s: float | FloatArray, usual_s: float) -> FloatArray:
        """Return the diagonal of Q, (N,), or (k, N) for steps (k, 1); ``noise`` holds for a usual step."""
        noise = self.noise
        walks = {
            "field-bias": noise.field_bias_T,
            "gyro-bias": noise.gyro_bias_rad_s,
            "disturbance": noise.disturbance_s2,
            "field-model": 0.0,
            "dipole": noise.dipole_Am2,
            "field-gain": noise.field_gain,
        }
        always = np.repeat(np.square([noise.attitude, noise.rate_rad_s]), 3)
        variance = np.concatenate([always, self._variances(walks)]) * (np.asarray(step_s) / usual_s)
        return variance + np.concatenate([np.zeros(ALWAYS), self.start_variance]) * (1.0 - self.decay(step_s) ** 2)

    @property
    def start_variance(self) -> FloatArray:
        """Initial variances of the optional states, shape (N - 6,)."""
        return self._variances(
            {
                "field-bias": self.field_bias_sigma_T,
                "gyro-bias": self.gyro_bias_sigma_rad_s,
                "disturbance": self.disturbance_sigma_s2,
                "field-model": self.field_model_sigma_T,
                "dipole": self.dipole_sigma_Am2,
                "field-gain": np.where(np.eye(3), self.field_gain_sigma, self.field_axes_sigma_rad).ravel(),
            }
        )

    def _variances(self, deviation: Mapping[str, ArrayLike]) -> FloatArray:
        """Return the variance of each component of the optional states, from standard deviations."""
        each = [np.broadcast_to(deviation[state], SIZES[state]) for state in self.sensors.states]
        return np.square(np.concatenate([np.zeros(0), *each]))

    @property
    def open_variance(self) -> FloatArray:
        """Variances of an unknown error state, shape (N,)."""
        return np.concatenate([np.repeat(np.square([0.5 * OPEN_RAD, RATE_RAD_S]), 3), self.start_variance])

    @property
    def gate_limit(self) -> float:
        """Largest NIS of an accepted reading, from χ² with three degrees of freedom."""
        return float(chdtri(3, self.gate)) if self.gate > 0.0 else math.inf


@dataclass(frozen=True, eq=False)
class FilterStart:
    """Estimates before the first reading.

    Optional states that it lacks are zero, with the standard deviations of the settings.
    """

    q: FloatArray  # (runs, 4)
    w: FloatArray  # (runs, 3)
    covariance: FloatArray  # (runs, 6, 6) of (δq, δω), δq being half of the angle, or (runs, N, N) of all states
    optional: Mapping[str, FloatArray] = field(default_factory=dict)  # (runs, k), by name

    def select_runs(self, runs: NDArray[np.intp]) -> FilterStart:
        """Return the start of the runs with these indices, which may repeat."""
        optional = {name: values[runs] for name, values in self.optional.items()}
        return FilterStart(self.q[runs], self.w[runs], self.covariance[runs], optional)


def start_near(q: FloatArray, w: FloatArray, attitude_rad: float, rate_rad_s: float) -> FilterStart:
    """Return a start from estimates with independent errors.

    Shapes ``q`` (runs, 4), ``w`` (runs, 3). ``attitude_rad``, ``rate_rad_s``: standard deviations per axis.
    """
    variance = np.repeat(np.square([0.5 * attitude_rad, rate_rad_s]), 3)
    return FilterStart(np.array(q), np.array(w), np.tile(np.diag(variance), (len(q), 1, 1)))


def concatenate_starts(starts: Sequence[FilterStart]) -> FilterStart:
    """Join starts with the same optional states into one start of all their runs."""
    q, w, covariance = (np.concatenate([getattr(one, of) for one in starts]) for of in ("q", "w", "covariance"))
    names = starts[0].optional
    return FilterStart(
        q, w, covariance, {name: np.concatenate([one.optional[name] for one in starts]) for name in names}
    )


@dataclass(frozen=True, eq=False)
class AttitudeState:
    """Estimate of all runs at one instant.

    ``q`` (runs, 4), ``w`` (runs, 3), ``optional``: optional states (runs, k) by name.
    """

    q: FloatArray
    w: FloatArray
    optional: Mapping[str, FloatArray]
    P: FloatArray  # (runs, N, N): covariance of the error state

    def optional_state(self, state: str) -> FloatArray:
        """Return an optional state (runs, k); zero if the filter does not have it."""
        return self.optional[state] if state in self.optional else np.zeros((len(self.q), SIZES[state]))


@dataclass(frozen=True, eq=False)
class AttitudeTracks:
    """Estimates at the n instants of some runs.

    Attributes
    ----------
    q, w : ndarray, shape (runs, n, 4), (runs, n, 3)
        Attitude (orbital from body), rate against inertial space.
    optional : mapping of str to ndarray, shape (runs, n, k)
        Optional states by name.
    covariance : ndarray, shape (runs, n, N, N)
        Covariance of the error state; δq is half of the angle.
    nis : ndarray, shape (runs, n, 4)
        Normalised innovation squared of star tracker, gyro, magnetometer and Sun sensor, each given those before it;
        NaN where there was no reading. It is χ² with 3 degrees of freedom, 2 for the Sun sensor.
    rejected : ndarray of bool, shape (runs, n, 4)
        Readings that failed the gate and were not used.
    log_det : ndarray, shape (runs, n, 4)
        Logarithm of the determinant of the innovation covariance over that of the noise; NaN except for the MEKF.
    tuned_disturbance_s2 : ndarray, shape (runs, n), or None
        Standard deviation of the disturbance as estimated by a bank of filters; None for a single filter.
    """

    settings: FilterSettings
    q: FloatArray
    w: FloatArray
    optional: Mapping[str, FloatArray]
    covariance: FloatArray
    nis: FloatArray
    rejected: BoolArray
    log_det: FloatArray
    tuned_disturbance_s2: FloatArray | None = None

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations of the error state, shape (runs, n, N)."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    @property
    def sigma_by_state(self) -> dict[str, FloatArray]:
        """Standard deviations (runs, n, k) by name of the state."""
        return self.settings.sensors.split(self.sigma)

    @property
    def definite(self) -> BoolArray:
        """Mask (runs,) of runs with positive variances; the others have diverged."""
        variances = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.asarray((variances > 0.0).all(axis=(1, 2)))

    @property
    def states(self) -> dict[str, FloatArray]:
        """Rate [rad/s] and optional states by name, shape (runs, n, k)."""
        return {"rate": self.w, **self.optional}

    def at(self, row: int) -> AttitudeState:
        """Return the estimate of all runs at one instant."""
        optional = {state: values[:, row] for state, values in self.optional.items()}
        return AttitudeState(self.q[:, row], self.w[:, row], optional, self.covariance[:, row])
