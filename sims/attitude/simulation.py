"""Truth and readings of many attitude runs at once; the first axis of all arrays is the run.

:func:`simulate` lets the control see the true state. A filter that knows the commanded torque is not
affected. For a loop that is closed by an estimate, :func:`prepare` gives everything that does not depend on it, and
:func:`sense` and :func:`advance` continue from instant to instant.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import signal

from adcs import quaternion
from adcs.environment.environment import Environment, environment
from adcs.environment.sun import earth_radius_rad
from adcs.frames import turned
from adcs.satellite import dynamics, sensors
from adcs.satellite.attitude_track import AttitudeTrack
from adcs.satellite.magnetic_control import MU0
from adcs.satellite.telemetry import AttitudeReadings, Record, is_read, orbital_from_eci
from arrays.typing import BoolArray, FloatArray
from magloc import core
from sims.attitude.scenario import AttitudeScenario
from sims.attitude.starts import starts
from sims.noise import HOUR_S, random_walk, stream

_SENSORS = ("star", "gyro", "field", "sun")
_WILD_RAD_S, _WILD_T = math.radians(2.0), 30e-6
"""Standard deviations of a wild reading of a component, of gyro and magnetometer."""
_INSTANTS_A_CALL = 20_000
"""Instants that one call computes for at most eight runs: about ten milliseconds."""
State = tuple[FloatArray, FloatArray, FloatArray]
Command = Callable[[Record, int], FloatArray]
"""Moment (runs, 3) until the next instant, from a record that ends with the readings of an instant."""


@dataclass(frozen=True, eq=False)
class PreparedRuns:
    """Part of some runs that does not depend on their motion.

    ``q`` (runs, 4), ``w`` (runs, 3), ``momentum_Nms`` (runs, 3): true state at the start.
    """

    scenario: AttitudeScenario
    seeds: tuple[int, ...]
    environment: Environment  # as the filters know it; leading axis runs
    true_field_orbital_T: FloatArray  # (runs, n, 3): with the error of the model
    q: FloatArray
    w: FloatArray
    momentum_Nms: FloatArray
    torque_Nm: FloatArray  # (runs, n, 3): disturbing torque in body axes, held from each instant to the next
    dipole_Am2: FloatArray  # (runs, n, 3): besides the residual dipole of the satellite, held likewise
    torquers_Am2: FloatArray  # (runs, n, 3): commanded, as the filters know it
    gyro_bias_rad_s: FloatArray  # (runs, n, 3)
    field_bias_T: FloatArray  # (runs, n, 3)
    field_gain: FloatArray  # (runs, 3, 3): D of a magnetometer that reads (E + D) b
    wild: dict[str, BoolArray]  # (runs, n): readings of ``star``, ``gyro``, ``field`` and ``sun`` that are anything
    noise: dict[str, FloatArray]  # (runs, n, 3): standard normal numbers for ``star``, ``gyro``, ``field`` and ``sun``


@dataclass(frozen=True, eq=False)
class AttitudeRuns(Record):
    """Truth and readings of runs.

    Attributes
    ----------
    q : ndarray, shape (runs, n, 4)
        Attitude, orbital from body.
    w : ndarray, shape (runs, n, 3)
        Rate against inertial space, body axes [rad/s].
    """

    prepared: PreparedRuns
    q: FloatArray
    w: FloatArray

    @classmethod
    def of(
        cls, prepared: PreparedRuns, q: FloatArray, w: FloatArray, momentum_Nms: FloatArray, wheel_torque_Nm: FloatArray
    ) -> AttitudeRuns:
        """Return the runs of a motion, with its readings."""
        scenario, readings = prepared.scenario, sense(prepared, q, w)
        known = scenario.satellite, scenario.dt_s, prepared.environment
        return cls(*known, readings, momentum_Nms, wheel_torque_Nm, prepared.torquers_Am2, prepared, q, w)

    @property
    def scenario(self) -> AttitudeScenario:
        """Scenario of the simulation."""
        return self.prepared.scenario

    @property
    def states(self) -> dict[str, FloatArray]:
        """True rate [rad/s], biases and disturbance d = J⁻¹·torque [1/s²] by name, (runs, n, 3)."""
        return {
            "rate": self.w,
            "field-bias": self.prepared.field_bias_T,
            "gyro-bias": self.prepared.gyro_bias_rad_s,
            "disturbance": self.prepared.torque_Nm @ self.satellite.body.inverse,
            "field-model": self.prepared.true_field_orbital_T - self.environment.b_orbital_T,
            "dipole": self.prepared.dipole_Am2,
            "field-gain": np.repeat(self.prepared.field_gain.reshape(-1, 1, 9), self.q.shape[1], axis=1),
        }

    def error_deg(self, track: AttitudeTrack) -> FloatArray:
        """Return the angle between the first run and a track of its log (n,) [°]; NaN before its start."""
        eci_from_orbital = quaternion.conjugate(orbital_from_eci(self.environment)[0])
        true = quaternion.multiply(eci_from_orbital, self.q[0])[-len(track) :]
        error = np.full(self.q.shape[1], np.nan)
        error[-len(track) :] = np.degrees(quaternion.angle_between(track.q, true))
        return error

    @property
    def time_s(self) -> FloatArray:
        """Time since the start of every run, shape (n,) [s]."""
        return self.environment.time_s


def prepare(scenario: AttitudeScenario, seeds: Sequence[int]) -> PreparedRuns:
    """Draw start, environment, disturbances, biases and noise of one run for every seed.

    ``seeds``: the numbers of a run depend on its seed alone, and every sensor has its own stream.
    """
    numbers = [int(seed) for seed in seeds]
    if not numbers:
        raise ValueError("Input seeds must hold one seed at least; instead received none.")
    n = scenario.n_instants
    time_s = scenario.dt_s * np.arange(n)
    satellite = scenario.satellite
    around = environment(satellite.orbit, starts(scenario, numbers), time_s, model=satellite.field_model)
    q = quaternion.exp(scenario.start_attitude_rad * _normal(numbers, "start attitude", 1)[:, 0])
    w_relative = scenario.start_rate_rad_s * _normal(numbers, "start rate", 1)[:, 0]
    wave = np.cos(2.0 * math.pi * time_s / scenario.torque_period_s)
    return PreparedRuns(
        scenario=scenario,
        seeds=tuple(numbers),
        environment=around,
        true_field_orbital_T=around.b_orbital_T + _field_error(scenario, numbers),
        q=q,
        w=dynamics.absolute_rate(q, w_relative, around.orbital_rate_rad_s[:, 0]),
        momentum_Nms=np.zeros((len(numbers), 3)),
        torque_Nm=scenario.torque_Nm * _directions(numbers, "torque")[:, None] * wave[:, None],
        dipole_Am2=np.tile(np.array(scenario.dipole_Am2, dtype=np.float64), (len(numbers), n, 1)),
        torquers_Am2=np.zeros((len(numbers), n, 3)),
        gyro_bias_rad_s=_bias(scenario, numbers, "gyro", scenario.gyro_bias_rad_s, satellite.gyro.bias_walk_rad_s),
        field_bias_T=_bias(scenario, numbers, "field", scenario.field_bias_T, satellite.magnetometer.bias_walk_T),
        field_gain=np.where(np.eye(3), scenario.field_gain, scenario.field_axes_rad)
        * np.stack([stream(seed, "field gain").standard_normal((3, 3)) for seed in numbers]),
        wild={name: _wild(numbers, name, n, scenario.wild_share) for name in _SENSORS},
        noise={name: _normal(numbers, f"{name} noise", n) for name in _SENSORS},
    )


def simulate(scenario: AttitudeScenario, seeds: Sequence[int]) -> AttitudeRuns:
    """Simulate one run for every seed, with a control that knows the true state."""
    return simulate_motion(prepare(scenario, seeds))


@np.errstate(over="ignore", divide="ignore", invalid="ignore")
def simulate_motion(prepared: PreparedRuns) -> AttitudeRuns:
    """Simulate prepared runs, whose start, torques and dipoles may have been changed."""
    scenario, around = prepared.scenario, prepared.environment
    runs, n = prepared.torque_Nm.shape[:2]
    body, control, rods = scenario.satellite.body, scenario.satellite.control, scenario.rods
    q, w, momentum, wheel_torque = np.empty((runs, n, 4)), *np.empty((3, runs, n, 3))
    q[:, 0], w[:, 0], momentum[:, 0] = prepared.q, prepared.w, prepared.momentum_Nms
    axes = np.empty((0, 3)) if rods is None else rods.axes
    work = core.problem(
        "attitude_motion",
        n_runs=runs,
        n_instants=n,
        n_rods=len(axes),
        first_instant=0,
        last_instant=0,
        dt=scenario.dt_s,
        inertia=_array(body.inertia_kgm2),
        inverse_inertia=_array(body.inverse),
        attitude_gain=_array(control.attitude_gain_Nm),
        rate_gain=_array(control.rate_gain_Nms),
        torque_limit=control.torque_limit_Nm,
        momentum_limit=control.momentum_limit_Nms,
        reference=_array(quaternion.IDENTITY),
        rod_axes=_array(axes),
        coercivity=0.0 if rods is None else rods.coercivity_A_m,
        steepness=0.0 if rods is None else rods.steepness_m_A,
        rod_strength=0.0 if rods is None else 2.0 / np.pi * rods.saturation_T * rods.volume_m3 / MU0,
        torque=_array(prepared.torque_Nm),
        dipole=_array(body.residual_dipole_Am2 + prepared.dipole_Am2 + prepared.torquers_Am2),
        orbital_rate=_array(around.orbital_rate_rad_s),
        gravity=_array(around.gravity_s2),
        field=_array(prepared.true_field_orbital_T),
        q=q,
        w=w,
        momentum=momentum,
        wheel_torque=wheel_torque,
        rod_fields=np.zeros((runs, len(axes), 2)),
    )
    for first in range(0, max(n - 1, 1), _INSTANTS_A_CALL):
        last = min(first + _INSTANTS_A_CALL, n - 1)
        work.struct.first_instant, work.struct.last_instant = first, last
        core.run("attitude_motion_runs", work, runs, block=max(8, _INSTANTS_A_CALL // (last - first + 1)))
    if not (np.isfinite(q).all() and np.isfinite(w).all()):
        raise ValueError("Input found a motion beyond double precision, expected smaller torques, dipoles and rates.")
    return AttitudeRuns.of(prepared, q, w, momentum, wheel_torque)


def _array(values: ArrayLike) -> FloatArray:
    return np.ascontiguousarray(values, dtype=np.float64)


def sense(prepared: PreparedRuns, q: FloatArray, w: FloatArray, rows: slice = slice(None)) -> AttitudeReadings:
    """Return the readings of the instants ``rows`` of all runs.

    Shapes ``q`` (runs, len(rows), 4), ``w`` (runs, len(rows), 3). ``rows``: all instants, unless given.
    """
    satellite, around = prepared.scenario.satellite, prepared.environment
    sun_orbital, lit = around.sun_orbital[:, rows], around.illuminated[:, rows]
    earth_radius = earth_radius_rad(around.position_eci_m[:, rows])
    b_body = quaternion.rotate_back(q, prepared.true_field_orbital_T[:, rows])
    b_body = b_body + turned(prepared.field_gain[:, None], b_body)
    noise = {name: numbers[:, rows] for name, numbers in prepared.noise.items()}
    good = AttitudeReadings(
        star=sensors.star_tracker_readings(satellite.star_tracker, q, w, sun_orbital, earth_radius, lit, noise["star"]),
        gyro_rad_s=sensors.gyro_readings(satellite.gyro, w, prepared.gyro_bias_rad_s[:, rows], noise["gyro"]),
        field_T=sensors.magnetometer_readings(
            satellite.magnetometer, b_body, prepared.field_bias_T[:, rows], noise["field"]
        ),
        sun=sensors.sun_readings(satellite.sun_sensor, quaternion.rotate_back(q, sun_orbital), lit, noise["sun"]),
    )
    return _with_wild(prepared, good, rows)


def _with_wild(prepared: PreparedRuns, good: AttitudeReadings, rows: slice) -> AttitudeReadings:
    """Replace some readings by wild ones: random attitudes, directions, fields and rates."""
    if not any(wild.any() for wild in prepared.wild.values()):
        return good

    def mixed(name: str, values: FloatArray, scale: float | None) -> FloatArray:
        anything = np.stack(
            [
                stream(seed, f"{name} wild reading").standard_normal((prepared.torque_Nm.shape[1], values.shape[-1]))
                for seed in prepared.seeds
            ]
        )[:, rows]
        anything = anything / np.linalg.norm(anything, axis=-1, keepdims=True) if scale is None else scale * anything
        replaced = prepared.wild[name][:, rows] & is_read(values)
        return np.where(replaced[..., None], anything, values)

    return AttitudeReadings(
        star=mixed("star", good.star, None),
        gyro_rad_s=mixed("gyro", good.gyro_rad_s, _WILD_RAD_S),
        field_T=mixed("field", good.field_T, _WILD_T),
        sun=mixed("sun", good.sun, None),
    )


def advance(prepared: PreparedRuns, state: State, wheel_torque_Nm: FloatArray, row: int) -> State:
    """Advance the true state (q, w, momentum) of all runs from ``row`` to ``row`` + 1, without rods.

    Shape ``state`` (runs, 4), (runs, 3), (runs, 3). ``wheel_torque_Nm`` (runs, 3): as set, by
    the control of an estimate.
    """
    around = prepared.environment
    return dynamics.step(
        prepared.scenario.satellite.body,
        *state,
        wheel_torque_Nm,
        prepared.torque_Nm[:, row],
        around.orbital_rate_rad_s[:, row],
        around.gravity_s2[:, row],
        prepared.true_field_orbital_T[:, row],
        prepared.scenario.dt_s,
        prepared.dipole_Am2[:, row] + prepared.torquers_Am2[:, row],
    )


def simulate_control(
    prepared: PreparedRuns, command: Command, advanced: Callable[[int], None] | None = None
) -> AttitudeRuns:
    """Simulate prepared runs without wheels; the commands go into the record.

    Raises ValueError: the scenario has rods, which only :func:`simulate_motion` simulates.
    """
    if prepared.scenario.rods is not None:
        raise ValueError(
            "Input prepared must have no rods where moments are commanded; instead received a scenario with rods."
        )
    runs, n = prepared.torque_Nm.shape[:2]
    none = np.zeros((runs, 3))
    record = AttitudeRuns.of(prepared, np.tile(quaternion.IDENTITY, (runs, n, 1)), *np.zeros((3, runs, n, 3)))
    read = [getattr(record.readings, name) for name in ("star", "gyro_rad_s", "field_T", "sun")]
    for values in read:
        values[:] = np.nan
    state = (prepared.q, prepared.w, prepared.momentum_Nms)
    for row in range(n):
        only = slice(row, row + 1)
        record.q[:, row], record.w[:, row] = state[:2]
        now = sense(prepared, record.q[:, only], record.w[:, only], only)
        for values, reading in zip(read, (now.star, now.gyro_rad_s, now.field_T, now.sun), strict=True):
            values[:, only] = reading
        prepared.torquers_Am2[:, row] = command(record, row)
        if row < n - 1:
            state = advance(prepared, state, none, row)
        if advanced is not None:
            advanced(1)
    return record


def start_estimates(
    prepared: PreparedRuns, attitude_error_rad: float, rate_error_rad_s: float
) -> tuple[FloatArray, FloatArray]:
    """Return starts of a filter: true attitudes and rates with normal errors in body axes.

    ``attitude_error_rad``, ``rate_error_rad_s``: standard deviations per axis. Returns ``q, w`` (runs, 4), (runs, 3).
    """
    seeds = list(prepared.seeds)
    error = quaternion.exp(attitude_error_rad * _normal(seeds, "estimate attitude", 1)[:, 0])
    rate_error = rate_error_rad_s * _normal(seeds, "estimate rate", 1)[:, 0]
    return quaternion.multiply(prepared.q, quaternion.conjugate(error)), prepared.w - rate_error


def _bias(scenario: AttitudeScenario, seeds: list[int], sensor: str, size: float, walk: float) -> FloatArray:
    """Return biases (runs, n, 3) that walk from a size at the start, ``walk`` per √s."""
    n, rate_Hz, per_root_hour = scenario.n_instants, 1.0 / scenario.dt_s, walk * math.sqrt(HOUR_S)
    walks = [random_walk(n, 3, rate_Hz, per_root_hour, stream(seed, f"{sensor} walk")) for seed in seeds]
    return size * _directions(seeds, f"{sensor} bias")[:, None] + np.stack(walks)


def _normal(seeds: list[int], feature: str, n: int) -> FloatArray:
    """Return standard normal numbers (runs, n, 3)."""
    return np.stack([stream(seed, feature).standard_normal((n, 3)) for seed in seeds])


def _field_error(scenario: AttitudeScenario, seeds: list[int]) -> FloatArray:
    """Return the error of the field model (runs, n, 3), constant or an Ornstein-Uhlenbeck process."""
    if math.isinf(scenario.field_error_correlation_s):
        return np.repeat(
            scenario.field_error_T * _directions(seeds, "field error")[:, None], scenario.n_instants, axis=1
        )
    decay = math.exp(-scenario.dt_s / scenario.field_error_correlation_s)
    noise = _normal(seeds, "field error", scenario.n_instants)
    noise[:, 1:] *= math.sqrt(1.0 - decay**2)
    return scenario.field_error_T * np.asarray(signal.lfilter([1.0], [1.0, -decay], noise, axis=1))


def _wild(seeds: list[int], sensor: str, n: int, share: float) -> BoolArray:
    """Return a mask (runs, n) of wild readings."""
    return np.stack([stream(seed, f"{sensor} wild").random(n) < share for seed in seeds])


def _directions(seeds: list[int], feature: str) -> FloatArray:
    """Return unit vectors (runs, 3), uniform on the sphere."""
    vectors = _normal(seeds, feature, 1)[:, 0]
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
