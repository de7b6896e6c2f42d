"""Detection and exclusion of sensors that fail during a track."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray

_LOG = logging.getLogger(__name__)
SENSOR_LIMIT = 32.0
"""χ² of a sensor's residual above which it contradicts the others (3 degrees of freedom, probability 5e-7)."""
RIVAL_WITHIN = 9.0
"""Least difference of χ² between excluding a sensor and excluding any other, for which it is at fault."""
ROWS_TO_DIE = 3.0
"""Rows in which a sensor is excluded before it counts as dead, so that single spikes do not count."""
ROWS_TO_RETURN = 50
"""Successive good rows after which a dead sensor is used again."""
DRIFT_LIMIT = 40.0
"""χ² of a sensor's mean residual over some rows above which it drifts (3 degrees of freedom, probability 1e-8)."""
MOST_DRIFTING = 2
"""Most sensors that may drift at a time: if more do, the model is wrong."""
_GOOD = 16.27  # one good row in a thousand is worse
# Strikes that a good row removes.
_FORGIVEN = 0.25
# Factor of the excess χ² of suspects for each row without a fault.
_REMEMBERED = 0.9
# Rows over which residuals are averaged.
_MEMORIES = np.array([4.0, 16.0, 64.0, 256.0])

# Least share of the squared misfit that is common to all rows of a lasting misfit; of independent rows it is 1/n.
_LASTING = 0.5
# Fewest rows for this test, and for its warning.
_FEWEST_ALIKE, _ROWS_TO_TELL = 3, 10
OFFSETS = "not acquired: no dipole fits the readings, which have offsets that are not stated"


@dataclass(frozen=True, eq=False)
class Misfits:
    """Misfits of successive rows that no source explains, in units of noise.

    Attributes
    ----------
    rows : int
    mean : ndarray, shape (k,)
    energy : float
        Mean of the squared length.
    pause : int
        Rows between two searches after a warning, 0 before.
    waits : int
        Rows to skip before the next search.
    """

    rows: int = 0
    mean: FloatArray = field(default_factory=lambda: np.zeros(0))
    energy: float = 0.0
    pause: int = 0
    waits: int = 0

    @property
    def are_alike(self) -> bool:
        """True if most of the misfit is the same in all rows, which offsets cause."""
        return self.rows >= _FEWEST_ALIKE and float(self.mean @ self.mean) > _LASTING * self.energy

    def skip_row(self) -> Misfits:
        """Return the state after a row without a search."""
        return replace(self, waits=self.waits - 1)

    def after(self, misfit: FloatArray, noise_T: float) -> Misfits:
        """Return the state after one more row; warn once if the misfit lasts."""
        if len(misfit) < len(self.mean):
            return self  # a row without some sensors
        before = self if len(misfit) == len(self.mean) else Misfits(0, np.zeros(len(misfit)), pause=self.pause)
        n = before.rows + 1
        mean = before.mean + (misfit - before.mean) / n
        energy = before.energy + (float(misfit @ misfit) - before.energy) / n
        found = Misfits(n, mean, energy, before.pause)
        if n < _ROWS_TO_TELL or not found.are_alike:
            return found
        if not found.pause:
            size_uT = 1e6 * noise_T * float(np.sqrt(np.mean(mean**2)))
            _LOG.warning(
                f"no source explains {n} rows, and their misfit is nearly the same, {size_uT:.2g} µT rms where the"
                f" noise is {1e6 * noise_T:.2g} µT: the sensors have offsets that are not stated, or iron or another"
                " magnet rests nearby. State offset_uncertainty_nT of the sensors, calibrate them, or subtract a"
                " rest: the mean of rows without the source"
            )
        pause = max(_ROWS_TO_TELL, 2 * found.pause)
        return replace(found, pause=pause, waits=pause)


@dataclass(frozen=True, eq=False)
class SensorHealth:
    """State of each sensor by earlier rows.

    Attributes
    ----------
    dead : ndarray of bool, shape (N,)
        Sensors that are excluded until they recover.
    drifting : ndarray of bool, shape (N,)
        Dead sensors that drifted.
    strikes : ndarray, shape (N,)
        Count of recent rows in which a sensor was excluded.
    good : ndarray of int, shape (N,)
        Successive good rows of a dead sensor.
    sums : ndarray, shape (4, N, 3)
        Sums of standardised residuals with memories of 4, 16, 64 and 256 rows.
    weight : ndarray, shape (4, N)
        Variance of the sums.
    """

    dead: BoolArray
    drifting: BoolArray
    strikes: FloatArray
    good: IntArray
    sums: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, n_sensors: int) -> SensorHealth:
        """Return the state of sensors without a fault."""
        none = np.zeros(n_sensors, dtype=bool)
        memories = (len(_MEMORIES), n_sensors)
        return cls(
            none, none, np.zeros(n_sensors), np.zeros(n_sensors, np.intp), np.zeros((*memories, 3)), np.zeros(memories)
        )

    @property
    def is_well(self) -> bool:
        """True if no sensor is dead or was excluded recently."""
        return not (self.dead.any() or self.strikes.any())

    @property
    def means(self) -> FloatArray:
        """Means (4, N, 3) of residuals, of unit variance without a fault."""
        return self.sums / np.sqrt(np.maximum(self.weight, 1e-300))[..., None]

    @property
    def suspect(self) -> int | None:
        """Index of the sensor whose mean residual is most significant; None if none is."""
        chi2 = np.max(np.vecdot(self.sums, self.sums) / np.maximum(self.weight, 1e-300), axis=0)
        worst = int(np.argmax(chi2))
        return worst if chi2[worst] > DRIFT_LIMIT else None

    @property
    def may_drift(self) -> bool:
        """True if one more sensor may count as drifting."""
        return int(np.count_nonzero(self.drifting)) < MOST_DRIFTING

    def after(self, residuals: FloatArray, out: BoolArray, dead_chi2: FloatArray) -> SensorHealth:
        """Return the state after one more row.

        Parameters
        ----------
        residuals : ndarray, shape (N, 3)
            Standardised residuals, NaN without a reading.
        out : ndarray of bool, shape (N,)
            Sensors excluded from the row.
        dead_chi2 : ndarray, shape (N,)
            χ² of the dead sensors given the others.
        """
        read = np.isfinite(residuals[:, 0])
        keep = (1.0 - 1.0 / _MEMORIES)[:, None]
        sums = np.where(read[:, None], keep[..., None] * self.sums + residuals, self.sums)
        weight = np.where(read, keep**2 * self.weight + 1.0, self.weight)
        strikes = np.where(out & ~self.dead, self.strikes + 1.0, np.maximum(0.0, self.strikes - _FORGIVEN))
        good = np.where(self.dead & (dead_chi2 < _GOOD), self.good + 1, 0)
        recovers = good >= ROWS_TO_RETURN
        dies = ~self.dead & (strikes >= ROWS_TO_DIE)
        factor: FloatArray = np.where(recovers | dies, 0.0, 1.0)
        return replace(
            self,
            dead=(self.dead & ~recovers) | dies,
            drifting=self.drifting & ~recovers,
            strikes=factor * strikes,
            good=np.where(recovers, 0, good),
            sums=factor[:, None] * sums,
            weight=factor * weight,
        )

    def without(self, sensor: int) -> SensorHealth:
        """Return the state with a sensor as drifting, and without residuals, which are biased."""
        drifts = np.arange(len(self.dead)) == sensor
        return replace(self.forget_residuals(), dead=self.dead | drifts, drifting=self.drifting | drifts)

    def forget_residuals(self) -> SensorHealth:
        """Return the state without residuals, which belong to another state of the sources."""
        return replace(self, sums=np.zeros_like(self.sums), weight=np.zeros_like(self.weight))


@dataclass(frozen=True, eq=False)
class Suspects:
    """Candidates for the sensor at fault, in rows that several single faults could explain.

    Attributes
    ----------
    excess : ndarray, shape (N,)
        χ² of recent rows without each sensor, above the least of them.
    """

    excess: FloatArray

    @classmethod
    def of(cls, n_sensors: int) -> Suspects:
        """Return the state before the first row."""
        return cls(np.zeros(n_sensors))

    def after(self, chi2: FloatArray) -> Suspects:
        """Return the state after a row, by its χ² (N,) without each sensor."""
        return Suspects(self.excess + chi2 - chi2.min())

    def decay(self, n_rows: int) -> Suspects:
        """Return the state after rows without a fault."""
        return Suspects(_REMEMBERED**n_rows * self.excess)

    @property
    def faulty_sensor(self) -> int | None:
        """Index of the sensor at fault, if it is far likelier than all others; otherwise None."""
        first = int(np.argmin(self.excess))
        others = np.delete(self.excess, first)
        return first if others.size and others.min() - self.excess[first] > RIVAL_WITHIN else None
