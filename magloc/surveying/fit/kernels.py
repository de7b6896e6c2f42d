"""Compiled kernels of a survey: whitening filter, and columns of sources.

The tests have the readable references: the whole covariance matrix, and the fields of :mod:`magloc.fields.dipole`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc import core

_TERMS_A_BLOCK = 100_000
"""Number of fields, or products of matrix elements, in one call, which takes about a millisecond."""


class WhiteningFilter:
    """Kalman filter over measurements of unit noise, one after the other, and its gains.

    The last two states are a value and its slope.

    Parameters
    ----------
    H : ndarray, shape (n, k, S)
        Measurement matrices.
    kept, added : ndarray, shape (n, S)
        Part of each state that remains after a step, and growth of its variance.
    dt_s : ndarray, shape (n,)
        Steps.
    start : ndarray, shape (S,)
        Variances before the first step.

    Attributes
    ----------
    gains : ndarray, shape (n, k, S + 1)
        Kalman gains, and behind them 1/σ of each innovation.
    """

    def __init__(self, H: FloatArray, kept: FloatArray, added: FloatArray, dt_s: FloatArray, start: FloatArray) -> None:
        n, k, S = H.shape
        self.gains: FloatArray = np.empty((n, k, S + 1))
        self._filter = core.problem(
            "survey_filter",
            n_states=S,
            n_measurements=k,
            H=H,
            kept=kept,
            added=added,
            dt=dt_s,
            start=start,
            gains=self.gains,
        )
        core.run("survey_gains", self._filter, n, block=1 + _TERMS_A_BLOCK // (S * S * (k + 1)), chain=n)

    def whiten(self, columns: FloatArray, rows: IntArray) -> None:
        """Replace columns (g, k, m) at some rows by normalised innovations; others are zero."""
        work = core.problem(
            "survey_whitening",
            filter=self._filter,
            n_columns=columns.shape[2],
            rows=rows,
            columns=columns,
        )
        block = 1 + _TERMS_A_BLOCK // (1 + columns.shape[2] * self.gains[0].size)
        core.run("survey_whiten", work, len(rows), block=block, chain=len(rows))


class MeasuredRows(NamedTuple):
    """Measurement model of groups of rows, as a function of sources.

    Attributes
    ----------
    sensors_m : ndarray, shape (n, N, 3)
        Places of the sensors.
    directions : ndarray, shape (n, C, 3)
        Derivatives of the channels by the field at their sensors.
    U : ndarray, shape (k, C)
        Matrix from channels to measurements.
    channel_sensor : ndarray of int, shape (C,)
    first_row : ndarray of int, shape (g + 1,)
        First row of each group. A group's measurement is the sum over its rows, divided by the root of their number.
    """

    sensors_m: FloatArray
    directions: FloatArray
    U: FloatArray
    channel_sensor: IntArray
    first_row: IntArray

    def moment_columns(self, places_m: FloatArray, groups: IntArray) -> FloatArray:
        """Return columns (g, k, 3 m) of unit moments at places (m, 3), by axis, then by place."""
        return self._columns("survey_moments", 3, places_m, groups)

    def source_columns(self, positions_m: FloatArray, moments_Am2: FloatArray) -> FloatArray:
        """Return derivatives (g, k, 6 K) by position and moment of sources (K, 3), by source."""
        return self._columns("survey_sources", 6, positions_m, None, np.ascontiguousarray(moments_Am2))

    def pole_columns(self, poles_m: FloatArray) -> FloatArray:
        """Return columns (g, k, P) of unit poles (P, 3), whose field is away/|away|³."""
        return self._columns("survey_poles", 1, poles_m, None)

    def _columns(
        self, kernel: str, n: int, places_m: FloatArray, groups: IntArray | None, moments: FloatArray | None = None
    ) -> FloatArray:
        if groups is None:
            groups = np.arange(len(self.first_row) - 1)
        k, C = self.U.shape
        out = np.empty((len(groups), k, n * len(places_m)))
        work = core.problem(
            "survey_columns",
            n_sensors=self.sensors_m.shape[1],
            n_channels=C,
            n_measurements=k,
            n_sources=len(places_m),
            sensors=np.ascontiguousarray(self.sensors_m),
            directions=np.ascontiguousarray(self.directions),
            mixing=np.ascontiguousarray(self.U),
            sensor_of_channel=self.channel_sensor,
            sources=np.ascontiguousarray(places_m),
            moments=moments,
            first_row=self.first_row,
            groups=groups,
            out=out,
        )
        terms = C * len(places_m) * len(self.sensors_m) / max(1, len(self.first_row) - 1)
        core.run(kernel, work, len(groups), block=1 + int(_TERMS_A_BLOCK / max(1.0, terms)))
        return out
