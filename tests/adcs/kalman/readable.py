"""The error-state filter with its gate, instant by instant in NumPy: the oracle of the compiled one.

A reading whose normalised innovation squared is beyond its limit is not used. That alone never comes back from a wild
first fix, and giving the estimate up after some rejections makes a lie the truth. So a rejected reading begins a second
filter, which lives beside the main one until one of them is believed. See docs/theory/attitude-kalman-filters.md;
adcs/gate.hpp of the core is the compiled form.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import AttitudeState, AttitudeTracks, FilterSettings, FilterStart, SensorSet
from adcs.kalman.mekf import (
    PATIENT_READINGS,
    apply_error,
    check_start,
    collect_tracks,
    deviations,
    initial_state,
    joseph_update,
    patience,
    predict,
    residuals,
)
from adcs.satellite.dynamics import RigidBody, WheelControl, error_jacobian
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Record, is_read, part
from arrays.typing import FloatArray
from magloc.navigation.rotations import cross_matrix

STAR, GYRO, FIELD, SUN = range(len(SENSORS))
AGREE = 3
"""Readings of its sensor that a hypothesis must have taken to count, and that it must miss in a row to be dropped."""
CLIP = 25.0
"""Most that one reading says against a hypothesis, as a χ²: a wild one must not decide."""
BETTER, WORSE = 15.0, -30.0
"""Log-likelihood ratio of the other sensors with which the second hypothesis is believed, and with which it is dropped:
a good one gets to the first with two readings, a lie of some σ loses slowly, and noise alone reaches neither."""
STRAIN, OPEN = 4, 80
"""A rejection that no second hypothesis explains adds so much, a reading that fits takes 1 away; from :data:`OPEN` on
the sensor's readings are used: after twenty in a row, or where more than a fifth are rejected."""
FAR = 6.0
"""Twice the log of the odds by which a reading that fits both must fit the second better: two that are the same go on
as one."""


class Fit(NamedTuple):
    """NIS of a reading, the same with what linearising may add to its noise, and log|S| of its innovation."""

    nis: float
    eased: float
    log_determinant: float


def eased(nis: float, variance: float, length: float, attitude_variance: float) -> float:
    """NIS of a direction of some length, at least, with the error of linearising it: half of the angle's square.

    ``variance``: of a component of its noise. ``attitude_variance``: of δq, the trace; δq is half of the angle.
    """
    return nis * variance / (variance + (2.0 * attitude_variance * length) ** 2)


@dataclass
class Contest:
    """The main hypothesis of one run, and the second one where there is one."""

    settings: FilterSettings
    dt_s: float
    row: int = 0
    taken: list[int] = field(default_factory=lambda: [0] * len(SENSORS))  # readings by the main one, of every sensor
    last_taken: list[int] = field(default_factory=lambda: [0] * len(SENSORS))  # instant of the last of them
    last_read: list[int] = field(default_factory=lambda: [0] * len(SENSORS))  # and of the last reading there was
    interval: list[int] = field(default_factory=lambda: [1] * len(SENSORS))  # between the last two
    strain: list[int] = field(default_factory=lambda: [0] * len(SENSORS))  # of rejections that nothing explains
    began: int = -1  # sensor of the reading that began the second hypothesis
    agreed: int = 0  # readings of that sensor that the second has taken
    main_agreed: int = 0  # and the main one meanwhile
    missed: int = 0  # that the second has not taken, in a row
    after_gap: bool = False
    score: float = 0.0  # log-likelihood ratio of the other sensors, second over main

    def decided(self, sensor: int, main: Fit, second: Fit | None) -> tuple[bool, bool]:
        """Who takes a reading, main and second."""
        limit = self.settings.gate_limit
        fits, use_second = main.eased <= limit, second is not None and second.eased <= limit
        # Where a sensor is rejected again and again, and nothing else explains it, the model is wrong, not the sensor.
        use = fits or self.strain[sensor] >= OPEN
        if fits:
            self.strain[sensor] = max(self.strain[sensor] - 1, 0)
        elif sensor != self.began or self.agreed < PATIENT_READINGS:
            self.strain[sensor] = min(self.strain[sensor] + STRAIN, 2 * OPEN)
        if second is not None and sensor == self.began:
            if use and use_second and self.agreed >= AGREE:
                # Each reading belongs to one of them: to the main one unless the other is far more likely.
                use = main.eased + main.log_determinant <= second.eased + second.log_determinant + FAR
                use_second = not use
            self.agreed += use_second
            self.main_agreed += use
            self.missed = 0 if use_second else self.missed + 1
        elif second is not None and self.agreed > 1:
            # At its first instant everything fits the second.
            self.score += 0.5 * (min(main.eased, CLIP) - min(second.eased, CLIP))
        if use:
            self.taken[sensor] += 1
            self.last_taken[sensor] = self.row
        return use, use_second

    def may_begin(self, sensor: int, *, both: bool) -> bool:
        """Whether a rejected reading can begin a second hypothesis; ``both``: field and Sun are read at this instant.

        That of a gyro can if it may have a bias. One direction leaves a turn open, which would fit too much: it does so
        only where the main hypothesis has waited in vain.
        """
        if self.began >= 0 or (sensor == GYRO and "gyro-bias" not in self.settings.sensors.states):
            return False
        return sensor in (STAR, GYRO) or both or self._waited(sensor)

    def begin(self, sensor: int) -> None:
        """Count from a reading that begins a second hypothesis."""
        self.began, self.agreed, self.main_agreed, self.missed, self.score = sensor, 1, 0, 0, 0.0
        self.after_gap = self.row - self.last_read[sensor] > PATIENT_READINGS * self.interval[sensor]

    def read(self, sensor: int) -> None:
        """Count a reading, after it has been decided on."""
        if self.row > self.last_read[sensor]:
            if (
                self.row - self.last_read[sensor] <= PATIENT_READINGS * self.interval[sensor]
                or self.last_read[sensor] == 0
            ):
                self.interval[sensor] = self.row - self.last_read[sensor]
            self.last_read[sensor] = self.row

    def verdict(self) -> bool | None:
        """At the end of an instant: whether the second hypothesis is believed (True), dropped (False), or neither."""
        if self.score < WORSE:
            self.strain[self.began] = 0
            return False
        if self.missed >= AGREE or self.main_agreed >= PATIENT_READINGS:
            return False
        if self.agreed < AGREE:
            return None
        unsupported = self.after_gap or self.taken[self.began] < AGREE or self._waited(self.began)
        return True if self.score > BETTER or (unsupported and self.score > -BETTER) else None

    def end(self, *, believed: bool) -> None:
        """Go on with the hypothesis that was believed."""
        if believed:
            self.taken[self.began], self.last_taken[self.began] = self.agreed, self.row
        self.began = -1

    def _waited(self, sensor: int) -> bool:
        return self.row - self.last_taken[sensor] >= patience(sensor, self.dt_s)


def begun(record: Record, row: int, state: AttitudeState, settings: FilterSettings, sensor: int) -> AttitudeState:
    """First state of a hypothesis in which a reading is right, before that reading; one run.

    Of a gyro its bias is open; else the attitude is that of the readings, and everything is as open as at the start.
    """
    used, variance = settings.sensors, settings.open_variance
    if sensor == GYRO:
        P = state.P.copy()
        of_bias = used.slice_of("gyro-bias")
        P[:, of_bias], P[:, :, of_bias] = 0.0, 0.0
        P[:, of_bias, of_bias] = np.diag(variance[of_bias])
        return replace(state, P=P)
    readings, around = record.readings, record.environment
    q = state.q
    if sensor == STAR:
        q = quaternion.normalised(readings.star[:, row])
    else:
        there = used.magnetometer and bool(is_read(readings.field_T[:, row]).all())
        if used.sun and is_read(readings.sun[:, row]).all():
            q = quaternion.turned_onto(q, readings.sun[:, row], around.sun_orbital[:, row])
            if there:
                q = turned_about(q, readings.sun[:, row], readings.field_T[:, row], around.b_orbital_T[:, row])
        else:
            q = quaternion.turned_onto(q, readings.field_T[:, row], around.b_orbital_T[:, row])
    return replace(state, q=q, P=np.diag(variance)[None])


def turned_about(q: FloatArray, axis: FloatArray, body: FloatArray, reference: FloatArray) -> FloatArray:
    """Attitude (runs, 4) after the turn about a unit axis that brings a direction nearest to that of the frame."""
    there = quaternion.rotate_back(q, reference)
    sine = np.sum(axis * np.cross(body, there), axis=-1)
    along, along_there = (np.sum(axis * one, axis=-1) for one in (body, there))
    angle = np.arctan2(sine, np.sum(body * there, axis=-1) - along * along_there)
    return quaternion.normalised(quaternion.multiply(q, quaternion.exp(angle[:, None] * axis)))


class Hypothesis(NamedTuple):
    """A state of one run, predicted, with the covariance after some of the readings, and the correction (1, N) by them.

    All readings of an instant are linearised at the predicted state.
    """

    state: AttitudeState
    dx: FloatArray
    attitude_variance: float  # trace of that of δq, as predicted

    @classmethod
    def of(cls, state: AttitudeState, dx: FloatArray) -> Hypothesis:
        """Hypothesis before the readings of an instant, or before some of them."""
        return cls(state, dx, float(np.trace(state.P[0, :3, :3])))

    def with_reading(
        self, record: Record, row: int, settings: FilterSettings, sensor: int
    ) -> tuple[Hypothesis, Fit] | None:
        """The hypothesis with one more reading, and how that fits; None where there is no reading."""
        parts = residuals(record, row, self.state, settings.sensors)
        residual, rows = next((residual, rows) for place, residual, rows in parts if place == sensor)
        if not is_read(residual).all():
            return None
        sigma = deviations(record, settings)[sensor]
        H = rows / sigma
        nu = residual / sigma - (H @ self.dx[..., None])[..., 0]
        S = H @ self.state.P @ H.mT + np.eye(3)
        nis = float((nu @ np.linalg.solve(S[0], nu[0]))[0])
        dx, P = joseph_update(self.state.P, H, nu)
        around = record.environment
        model = {FIELD: around.b_orbital_T, SUN: around.sun_orbital}.get(sensor)
        length = 0.0 if model is None else float(np.linalg.norm(model[0, row]))
        fit = Fit(nis, eased(nis, sigma**2, length, self.attitude_variance), float(np.linalg.slogdet(S[0])[1]))
        return self._replace(state=replace(self.state, P=P), dx=self.dx + dx), fit

    def corrected(self, used: SensorSet) -> AttitudeState:
        """State with the correction in it."""
        return apply_error(self.state, self.dx, used)


class _Readable:
    """Filter of one run with its gate, instant by instant."""

    def __init__(self, record: Record, settings: FilterSettings, start: FilterStart) -> None:
        self.record, self.settings = record, settings
        self.main, self.second = initial_state(settings, start), None
        self.contest = Contest(settings, record.dt_s)
        n = record.momentum_Nms.shape[1]
        self.nis, self.log_det = np.full((2, 1, n, len(SENSORS)), np.nan)
        self.rejected = np.zeros((1, n, len(SENSORS)), dtype=np.bool_)

    second: AttitudeState | None

    def state_of(self, row: int) -> AttitudeState:
        """State after the readings of an instant, from that of the instant before."""
        if row:
            ahead = self.record, row - 1
            self.main = predict(*ahead, self.main, self.settings)[0]
            if self.second is not None:
                self.second = predict(*ahead, self.second, self.settings)[0]
        self._correct(row)
        return self.main

    def _correct(self, row: int) -> None:
        settings, used, contest = self.settings, self.settings.sensors, self.contest
        contest.row = row
        zero = np.zeros((1, used.size))
        main = Hypothesis.of(self.main, zero)
        second = None if self.second is None else Hypothesis.of(self.second, zero)
        for name in used.sensors.split("+"):
            sensor = SENSORS.index(name)
            tried = main.with_reading(self.record, row, settings, sensor)
            if tried is None:
                continue
            with_it, fits = tried
            other = None if second is None else second.with_reading(self.record, row, settings, sensor)
            use, use_second = contest.decided(sensor, fits, None if other is None else other[1])
            self.nis[0, row, sensor], self.log_det[0, row, sensor] = fits.nis, fits.log_determinant
            self.rejected[0, row, sensor] = not use
            if not use and contest.may_begin(sensor, both=self._both(row)):
                state = begun(self.record, row, main.state, settings, sensor)
                first = Hypothesis.of(state, main.dx if sensor == GYRO else zero)
                other, use_second = first.with_reading(self.record, row, settings, sensor), True
                contest.begin(sensor)
            contest.read(sensor)
            main = with_it if use else main
            second = other[0] if use_second and other is not None else second
        self.main = main.corrected(used)
        self.second = None if second is None else second.corrected(used)
        if self.second is not None:
            verdict = contest.verdict()
            if verdict:
                self.main = self.second
            if verdict is not None:
                contest.end(believed=verdict)
                self.second = None

    def _both(self, row: int) -> bool:
        """Whether field and Sun are in use, and read at an instant."""
        used, readings = self.settings.sensors, self.record.readings
        read = is_read(readings.field_T[0, row]) and is_read(readings.sun[0, row])
        return used.magnetometer and used.sun and bool(read)


def run_readable(record: Record, settings: FilterSettings, start: FilterStart) -> AttitudeTracks:
    """Filter of whole runs in NumPy, the reference of :func:`adcs.kalman.mekf.run_filter`."""
    check_start(record, start)
    tracks = []
    for run in range(len(start.q)):
        only = np.array([run])
        one = _Readable(part(record, only), settings, start.select_runs(only))
        states = [one.state_of(row) for row in range(record.momentum_Nms.shape[1])]
        tracks.append(collect_tracks(settings, states, one.nis, one.rejected, one.log_det))
    names = ("q", "w", "covariance", "nis", "rejected", "log_det")
    whole = {name: np.concatenate([getattr(one, name) for one in tracks]) for name in names}
    optional = {name: np.concatenate([one.optional[name] for one in tracks]) for name in settings.sensors.states}
    return AttitudeTracks(settings, optional=optional, **whole)


def closed_loop_error_jacobian(
    body: RigidBody, control: WheelControl, q: FloatArray, w: FloatArray, gravity_s2: float
) -> FloatArray:
    r"""F of the error as the source paper has it, as if the control saw the true state (``closed_loop_F``).

    .. math:: F_{21} = J^{-1}\left(6\frac{\mu}{r^3}F_g - K_\lambda W_\lambda\right), \quad F_{22} = -J^{-1}K_\omega

    with :math:`W_\lambda = \lambda_0 E + W(\lambda)`. The torque is computed from the estimate, so this is not the F of
    an estimate's error, and filters with it are overconfident; even as the Jacobian of the closed loop it lacks
    :math:`2J^{-1}K_\omega W(A\omega_o)` in F21.
    """
    F = error_jacobian(replace(body, residual_dipole_Am2=np.zeros(3)), q, w, np.zeros(3), gravity_s2, np.zeros(3))
    turn = np.where(q[..., :1] < 0.0, -q, q)
    W_lambda = turn[..., 0, None, None] * np.eye(3) + cross_matrix(turn[..., 1:])
    F[..., 3:, :3] -= body.inverse @ (control.attitude_gain_Nm[:, None] * W_lambda)
    F[..., 3:, 3:] = -body.inverse * control.rate_gain_Nms
    return F
