"""Sensors that die while sources are followed: named, left out, and taken back when they are well."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from arrays.typing import BoolArray, FloatArray, IntArray
from magloc.tracking.multi_target.update import JointUpdate

ROWS_TO_DIE = 3.0
"""Rows in which a sensor is left out before it is named: single spikes are none of its death."""
ROWS_TO_RETURN = 50
"""Good rows in a row after which a sensor is taken back."""
DRIFT_LIMIT = 40.0
"""χ² with three degrees of freedom of a sensor's mean residual over some rows above which it drifts: 1e-8."""
MOST_DRIFTING = 2
"""Sensors that may be said to drift: where more of them do, it is the model that is wrong."""
_GOOD = 16.27  # one good row in a thousand is worse
# How much a row that is well undoes of one that is not.
_FORGIVEN = 0.25
# Rows over which residuals are averaged.
_MEMORIES = np.array([4.0, 16.0, 64.0, 256.0])


@dataclass(frozen=True, eq=False)
class SensorHealth:
    """What earlier rows say of every sensor.

    Attributes
    ----------
    dead : ndarray of bool, shape (N,)
        Left out until they are well.
    drifting : ndarray of bool, shape (N,)
        Of these, the ones that drifted away.
    strikes : ndarray, shape (N,)
        Recent rows in which they were left out.
    good : ndarray of int, shape (N,)
        Of the dead, good rows in a row.
    sums : ndarray, shape (4, N, 3)
        Of standardised residuals, with the memories of some numbers of rows.
    weight : ndarray, shape (4, N)
        Their variance.
    """

    dead: BoolArray
    drifting: BoolArray
    strikes: FloatArray
    good: IntArray
    sums: FloatArray
    weight: FloatArray

    @classmethod
    def of(cls, n_sensors: int) -> SensorHealth:
        """All well."""
        none = np.zeros(n_sensors, dtype=bool)
        memories = (len(_MEMORIES), n_sensors)
        return cls(
            none, none, np.zeros(n_sensors), np.zeros(n_sensors, np.intp), np.zeros((*memories, 3)), np.zeros(memories)
        )

    @property
    def suspect(self) -> int | None:
        """The sensor whose mean residual is beyond noise, the worst one if there are several."""
        chi2 = np.max(np.vecdot(self.sums, self.sums) / np.maximum(self.weight, 1e-300), axis=0)
        worst = int(np.argmax(chi2))
        return worst if chi2[worst] > DRIFT_LIMIT else None

    @property
    def may_drift(self) -> bool:
        """Whether another sensor may be said to drift."""
        return int(np.count_nonzero(self.drifting)) < MOST_DRIFTING

    def after(self, update: JointUpdate, out: BoolArray, of_dead: FloatArray) -> SensorHealth:
        """After one more row: sensors (N,) that were left out of it, and χ² (N,) of the dead against the others."""
        read: BoolArray = np.asarray(update.row.used.reshape(-1, 3).all(axis=1), dtype=np.bool_)
        keep = (1.0 - 1.0 / _MEMORIES)[:, None]
        sums = np.where(read[:, None], keep[..., None] * self.sums + update.standardised, self.sums)
        weight = np.where(read, keep**2 * self.weight + 1.0, self.weight)
        strikes = np.where(out & ~self.dead, self.strikes + 1.0, np.maximum(0.0, self.strikes - _FORGIVEN))
        good = np.where(self.dead & (of_dead < _GOOD), self.good + 1, 0)
        well = good >= ROWS_TO_RETURN
        died = ~self.dead & (strikes >= ROWS_TO_DIE)
        kept: FloatArray = np.where(well | died, 0.0, 1.0)
        return replace(
            self,
            dead=(self.dead & ~well) | died,
            drifting=self.drifting & ~well,
            strikes=kept * strikes,
            good=np.where(well, 0, good),
            sums=kept[:, None] * sums,
            weight=kept * weight,
        )

    def without(self, sensor: int) -> SensorHealth:
        """After a sensor is said to drift; what it has bent is no fault of the others."""
        named = np.arange(len(self.dead)) == sensor
        return replace(self.forgetful, dead=self.dead | named, drifting=self.drifting | named)

    @property
    def forgetful(self) -> SensorHealth:
        """With no memory of residuals, which were those of another state."""
        return replace(self, sums=np.zeros_like(self.sums), weight=np.zeros_like(self.weight))
