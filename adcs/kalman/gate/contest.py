"""Readings that contradict a filter, and the second hypothesis that they may begin: the rules, and its first state.

A reading whose normalised innovation squared is beyond its limit is not used. That alone never comes back from a wild
first fix, and giving the estimate up after some rejections makes a lie the truth. So a rejected reading begins a second
filter, which lives beside the main one until one of them is believed. See docs/theory/attitude-kalman-filters.md;
adcs/gate.hpp of the core is its compiled form.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from adcs import quaternion
from adcs.kalman.error_state import FilterSettings, State
from adcs.satellite.sensors import SENSORS
from adcs.satellite.telemetry import Record, is_read
from arrays.typing import FloatArray

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
PATIENCE_S = 300.0
"""A main hypothesis that has taken no reading of the sensor for so long loses against readings that agree, though no
other sensor tells: what lasts as long is the truth."""
PATIENT_READINGS = 10
"""The same for a gyro's bias, which costs the attitude nothing, in instants. Also: a main hypothesis that takes as many
readings of that sensor meanwhile is not wrong, and a sensor is back from a gap after as many of its intervals."""


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


def patience(sensor: int, dt_s: float) -> int:
    """Instants after which a hypothesis that a reading of a sensor began is believed though no other sensor tells."""
    return PATIENT_READINGS if sensor == GYRO else round(PATIENCE_S / dt_s)


def begun(record: Record, row: int, state: State, settings: FilterSettings, sensor: int) -> State:
    """First state of a hypothesis in which a reading is right, before that reading; one run.

    Of a gyro its bias is open; else the attitude is that of the readings, and everything is as open as at the start.
    """
    used, variance = settings.sensors, settings.open_variance
    if sensor == GYRO:
        P = state.P.copy()
        of_bias = used.place("gyro-bias")
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
            q = turned_onto(q, readings.sun[:, row], around.sun_orbital[:, row])
            if there:
                q = turned_about(q, readings.sun[:, row], readings.field_T[:, row], around.b_orbital_T[:, row])
        else:
            q = turned_onto(q, readings.field_T[:, row], around.b_orbital_T[:, row])
    return replace(state, q=q, P=np.diag(variance)[None])


def turned_onto(q: FloatArray, body: FloatArray, reference: FloatArray) -> FloatArray:
    """Attitude (runs, 4) after the shortest turn that makes a direction in body axes that of the reference frame."""
    length = np.linalg.norm(body, axis=-1, keepdims=True) * np.linalg.norm(reference, axis=-1, keepdims=True)
    there = quaternion.rotate_back(q, reference)
    cosine = np.sum(body * there, axis=-1, keepdims=True) / length
    turn = np.concatenate([1.0 + cosine, np.cross(body, there) / length], axis=-1)
    # Half a turn is one about any axis across.
    opposite = 1.0 + cosine[..., 0] < 1e-12
    across = np.cross(body[opposite], np.eye(3)[np.argmin(np.abs(body[opposite]), axis=-1)])
    turn[opposite] = np.insert(across, 0, 0.0, axis=-1)
    return quaternion.normalised(quaternion.multiply(q, quaternion.normalised(turn)))


def turned_about(q: FloatArray, axis: FloatArray, body: FloatArray, reference: FloatArray) -> FloatArray:
    """Attitude (runs, 4) after the turn about a unit axis that brings a direction nearest to that of the frame."""
    there = quaternion.rotate_back(q, reference)
    sine = np.sum(axis * np.cross(body, there), axis=-1)
    along, along_there = (np.sum(axis * one, axis=-1) for one in (body, there))
    angle = np.arctan2(sine, np.sum(body * there, axis=-1) - along * along_there)
    return quaternion.normalised(quaternion.multiply(q, quaternion.exp(angle[:, None] * axis)))
