"""Roll and yaw of a satellite from a horizon sensor and gyros, with guaranteed ellipsoids.

See docs/theory/guaranteed-ellipsoids.md. Source: Pankratova, Sholokhov, Cybernetics and Systems Analysis 55(1), 2019,
section 4. Ours: increments of the gyros as known inputs, exact for a constant rate, and the control law of
:class:`AttitudeLoop`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from adcs.ellipsoids.ellipsoid import Ellipsoid, quadratic_form, segment_shape
from adcs.ellipsoids.names import StepRule
from adcs.ellipsoids.observer import BoundedSystem, EllipsoidObserver
from arrays.io.errors import check_positive
from arrays.typing import FloatArray
from magloc.state_space import predict, update

IntArray = NDArray[np.int64]
EARTH_MU_M3_S2 = 3.986004418e14
ORBIT_RADIUS_M = 6_878_000.0
ORBITAL_RATE = math.sqrt(EARTH_MU_M3_S2 / ORBIT_RADIUS_M**3)  # [rad/s]
ORBITAL_PERIOD_S = 2.0 * math.pi / ORBITAL_RATE
STEP_S = 2.0
NOMINAL_INERTIA_KGM2 = np.array([90.0, 60.0, 90.0])  # about the principal axes, which are roll, pitch and yaw
ROLL, YAW = 0, 1


def transition(orbital_rate: float = ORBITAL_RATE, step_s: float = STEP_S) -> FloatArray:
    """Return the rotation of (roll, yaw) in a step without rates, exp(Ω Δt), shape (2, 2)."""
    angle = orbital_rate * step_s
    return np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])


def input_matrix(orbital_rate: float = ORBITAL_RATE, step_s: float = STEP_S) -> FloatArray:
    """Return the change of (roll, yaw) per increment of the roll and yaw gyros, (1/Δt) ∫ exp(Ω t) dt, (2, 2).

    It is exact for a constant rate. The source paper has the unit matrix, which is its first order.
    """
    angle = orbital_rate * step_s
    s, c = math.sin(angle) / angle, (1.0 - math.cos(angle)) / angle
    return np.array([[s, c], [-c, s]])


def roll_yaw_system(
    noise_rad: float, drift_rad_s: float, *, orbital_rate: float = ORBITAL_RATE, step_s: float = STEP_S
) -> BoundedSystem:
    """Return the bounded system of roll and yaw.

    ``noise_rad``: c, largest error of the horizon sensor, positive. ``drift_rad_s``: largest zero shift of the yaw gyro
    in use, positive. ``orbital_rate``: ω₀ [rad/s]. The source paper takes the rate of the pitch gyro, whose zero shift
    no bound covers: 0.02 °/s is a third of ω₀ and voids the guarantee.
    """
    check_positive(noise_rad=noise_rad, drift_rad_s=drift_rad_s)
    drift = drift_rad_s * step_s * input_matrix(orbital_rate, step_s)[:, YAW]
    return BoundedSystem(
        A=transition(orbital_rate, step_s),
        disturbance=segment_shape(drift, float(np.linalg.norm(drift)), 2),
        directions=np.array([[1.0, 0.0]]),
        bounds=np.array([noise_rad]),
    )


def first_set(noise_rad: float) -> Ellipsoid:
    """Return the set of the first state: roll and yaw within a circle of radius 3 c."""
    return Ellipsoid(np.zeros(2), (3.0 * noise_rad) ** 2 * np.eye(2))


def roll_yaw_observer(
    system: BoundedSystem, n_runs: int, rule: StepRule = "tightened", *, reinflation_rad: float | None = None
) -> EllipsoidObserver:
    """Return an observer of many runs.

    ``system``: see :func:`roll_yaw_system`. ``rule``: 'tightened', 'optimal' or 'lemma'; the first has the smallest
    sets for this satellite, and recovers best from a wrong bound. ``reinflation_rad``: radius of the circle that is
    added to a set if a reading contradicts it, by default 4 c; zero as in the source paper.
    """
    c = float(system.bounds[0])
    radius = 4.0 * c if reinflation_rad is None else reinflation_rad
    return EllipsoidObserver(system, first_set(c), n_runs, rule=rule, reinflation=radius**2 * np.eye(2))


@dataclass(frozen=True, eq=False)
class SetTrack:
    """Sets of many runs over time, beginning with the set of the start."""

    centres: FloatArray  # (n_runs, n_steps + 1, 2): (roll, yaw) [rad]
    shapes: FloatArray  # (n_runs, n_steps + 1, 2, 2): [rad²]
    bounds: FloatArray  # (n_runs, n_steps + 1): bound of the horizon sensor in force [rad]
    resets: IntArray  # (n_runs, n_steps + 1): contradictions until then

    @property
    def yaw_half_widths(self) -> FloatArray:
        """√H₂₂ [rad], shape (n_runs, n_steps + 1)."""
        return np.sqrt(self.shapes[..., YAW, YAW])


class Recorder:
    """Recorder of an observer's sets, step by step."""

    def __init__(self, observer: EllipsoidObserver, n_steps: int) -> None:
        n, shape = observer.system.n, (len(observer), n_steps + 1)
        self._observer, self._next = observer, 0
        self.track = SetTrack(
            np.empty((*shape, n)), np.empty((*shape, n, n)), np.empty(shape), np.empty(shape, dtype=np.int64)
        )
        self.record()

    def record(self) -> None:
        """Record the current sets of the observer."""
        observer, step = self._observer, self._next
        self.track.centres[:, step] = observer.centres
        self.track.shapes[:, step] = observer.shapes
        self.track.bounds[:, step] = observer.bounds[:, 0]
        self.track.resets[:, step] = observer.resets
        self._next = step + 1


def observe(observer: EllipsoidObserver, readings_rad: FloatArray) -> SetTrack:
    """Return the sets of many runs without known inputs: the dynamics of the error alone.

    ``observer``: observer at its start, which the call advances to the end. ``readings_rad`` (n_runs, n_steps): roll
    readings after every step, NaN where missing.
    """
    recorder = Recorder(observer, readings_rad.shape[1])
    for readings in readings_rad.T:
        observer.predict()
        observer.correct(readings[:, None])
        recorder.record()
    return recorder.track


class AttitudeLoop:
    r"""Attitude control of many runs from the centre of the guaranteed set.

    The torque is :math:`-J (k_p\,\alpha + k_d\,\omega_{rel})`, J the nominal inertia, α the estimated roll and yaw and
    the measured pitch, ω_rel the gyros' rates relative to the orbital frame.
    ``n_steps``: largest number of cycles. ``orbital_rate``: ω₀ in the control law [rad/s].
    """

    KP = 0.0025
    KD = 0.07

    def __init__(self, observer: EllipsoidObserver, n_steps: int, *, orbital_rate: float = ORBITAL_RATE) -> None:
        self._observer, self._rate = observer, orbital_rate
        self._input = input_matrix(orbital_rate)
        self.recorder = Recorder(observer, n_steps)

    def __call__(self, horizon_rad: FloatArray, increments_rad: FloatArray, rates_rad_s: FloatArray) -> FloatArray:
        """Process the readings at the end of a cycle; return the torque to hold during the next one.

        ``horizon_rad`` (n_runs, 2): roll and pitch readings. ``increments_rad`` (n_runs, 3): increments of the three
        gyros in the cycle. ``rates_rad_s`` (n_runs, 3): rates of the three gyros at its end. Returns (n_runs, 3):
        torque, body axes [N·m].
        """
        self._observer.predict(np.einsum("ij,rj->ri", self._input, increments_rad[:, [0, 2]]))
        self._observer.correct(horizon_rad[:, :1])
        self.recorder.record()
        roll, yaw = self._observer.centres.T
        angles = np.stack([roll, horizon_rad[:, 1], yaw], axis=1)
        orbital = self._rate * np.stack([yaw, np.ones_like(roll), -roll], axis=1)
        return -(self.KP * angles + self.KD * (rates_rad_s + orbital)) * NOMINAL_INERTIA_KGM2


@dataclass(frozen=True, eq=False)
class KalmanTrack:
    """Kalman estimates of one run over time, beginning with that of the start."""

    means: FloatArray  # (n_steps + 1, 2): (roll, yaw) [rad]
    covariances: FloatArray  # (n_steps + 1, 2, 2): [rad²]


def kalman_track(
    system: BoundedSystem, readings_rad: FloatArray, increments_rad: FloatArray | None = None
) -> KalmanTrack:
    """Return the estimates of a Kalman filter with the same readings, for random errors within the same bounds.

    Uniform errors within ±b have the variance b²/3. The initial standard deviation is a third of the first set's
    radius, so that the 3 σ ellipse equals that set.
    ``system``: see :func:`roll_yaw_system`. ``readings_rad`` (n_steps,): roll readings after every step, NaN where
    missing. ``increments_rad`` (n_steps, 3): increments of the gyros in every step; without them the dynamics of the
    error alone.
    """
    noise_rad = float(system.bounds[0])
    eigenvalue, eigenvector = np.linalg.eigh(system.disturbance / 3.0)
    S_q = eigenvector * np.sqrt(np.maximum(eigenvalue, 0.0))
    x, S, sigma_rad = np.zeros(2), noise_rad * np.eye(2), noise_rad / math.sqrt(3.0)
    means, roots = [x], [S]
    inputs = np.zeros((len(readings_rad), 2))
    if increments_rad is not None:
        inputs = increments_rad[:, [0, 2]] @ input_matrix().T
    for y, known_input in zip(readings_rad, inputs, strict=True):
        x, S = system.A @ x + known_input, predict(S, system.A, S_q)
        if not np.isnan(y):
            x, S, _ = update(x, S, system.directions / sigma_rad, (y - system.directions @ x) / sigma_rad)
        means.append(x)
        roots.append(S)
    S_all = np.array(roots)
    return KalmanTrack(np.array(means), S_all @ np.swapaxes(S_all, 1, 2))


def violations(track: SetTrack, states_rad: FloatArray, tolerance: float = 1e-9) -> IntArray:
    """Count the instants at which the true state is outside of the set.

    A state is outside if its quadratic form exceeds 1 + `tolerance`.

    ``states_rad`` (n_runs, n_steps + 1, 2): true (roll, yaw) [rad]. Returns shape (n_runs,).
    """
    forms = quadratic_form(track.centres, track.shapes, states_rad)
    return np.count_nonzero(forms > 1.0 + tolerance, axis=1).astype(np.int64)
