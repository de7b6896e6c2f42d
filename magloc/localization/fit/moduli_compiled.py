"""Compiled fits of one source by moduli, or by moduli and components: lanes of variable projection.

Moduli are linear in the field about that of a trial state: there the moment is fitted, twice, and the state is judged
by the exact χ² of that moment. The readable twin is :func:`magloc.localization.fit.gauss_newton.damped_gauss_newton`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray, IntArray
from magloc.compilation import compiled, inlined, internal, own
from magloc.localization.fit.linearisation_compiled import (
    BASIS,
    CHI2,
    DIRECTION,
    END,
    GAIN,
    JACOBIAN,
    LANES,
    LEFT,
    MOMENT,
    PRODUCT,
    RESIDUAL,
    SENSOR_ROWS,
    SIGNAL,
    SQUARE,
    TANGENT,
    TRIAL,
    WORKSPACE,
    column,
    dot,
    fill_basis,
    fill_directions,
    fill_jacobian,
    fill_normal,
    fill_tangents,
    less,
    orthogonalise,
    project,
    three,
)
from magloc.localization.fit.variable_projection_compiled import FAILED, Refined, Rules, fill_lanes, judge, step
from magloc.measurement.whitened import WhitenedModel
from magloc.measurement.whitened_compiled import LaneModel, signals

# Rows of a modulus, as offsets: what it reads above the ambient field's, one over its noise, the ambient field.
READING = 0 * LANES
WEIGHT = 1 * LANES
AMBIENT = 2 * LANES
MODULUS_ROWS = 5 * LANES
# Rows of the workspace that nothing else uses before tangents are filled: the moment that a trial state comes with.
HELD = TANGENT
# With one, of 1500 rows by moduli in no ambient field three lost their optimum.
_FITS_OF_MOMENT = 2


class Moduli(NamedTuple):
    """Sensors (m,) that read moduli, ambient fields (fields, m, 3) there, and the field of a row."""

    sensor: IntArray
    ambient: FloatArray
    field_of_row: IntArray

    @classmethod
    def of(cls, model: WhitenedModel) -> Moduli:
        """Those of all rows of a model."""
        sensor = model.channel_sensor[model.channel_is_scalar]
        fields = model.ambient[:1] if model.shares_ambient else model.ambient
        of_row = np.zeros(len(model), dtype=np.intp) if len(fields) == 1 else np.arange(len(model), dtype=np.intp)
        return cls(sensor, own(fields[:, sensor]), of_row)


def refined_by_moduli(
    model: WhitenedModel,
    y: FloatArray,
    q: FloatArray,
    mu: FloatArray,
    max_iterations: int,
    free_range: float,
    tolerance: float,
) -> Refined:
    """Refinements from starts q (b, 4) and mu (b, 3) of rows of whitened readings (b, C); a moment may be zero."""
    out = Refined.empty(len(q))
    refine_by_moduli(
        signals(model, y - model.of_ambient),
        np.arange(len(q)),
        np.concatenate([q, mu], axis=1),
        model.lanes,
        Moduli.of(model),
        free_range,
        Rules(tolerance, float(max_iterations), np.full(len(q), math.inf), False),
        out,
    )
    return out


@compiled
def refine_by_moduli(
    signal: FloatArray,
    reading: IntArray,
    starts: FloatArray,
    model: LaneModel,
    moduli: Moduli,
    free_range: float,
    rules: Rules,
    out: Refined,
) -> None:
    """:func:`magloc.localization.fit.variable_projection_compiled.refine` where some sensors read moduli.

    Starts (n, 7) have a moment about whose field moduli are linear first.
    """
    n_sensors, n_triples = len(model.sensors), model.common.shape[1]
    if len(starts) == 0:
        return
    w, rows = np.zeros(WORKSPACE), np.zeros((n_sensors, SENSOR_ROWS))
    bent = np.zeros((len(moduli.sensor), MODULUS_ROWS))
    common, dots = np.zeros((n_sensors, n_triples, 9 * LANES)), np.empty((n_triples, 9 * LANES))
    start_of_lane, set_of_lane, held = np.full(LANES, -1), np.full(LANES, -1), np.full(LANES, -1)
    w[END : END + LANES] = FAILED
    next_start: int = np.int64(0)  # type: ignore[assignment]  # no literal: it would be compiled for itself
    while True:
        next_start, n_running = fill_lanes(
            next_start, start_of_lane, set_of_lane, signal, reading, starts, model, w, rows, common, rules, out
        )
        if n_running == 0:
            return
        for i in range(LANES):
            k = start_of_lane[i]
            if k >= 0 and k != held[i]:
                held[i], row = k, reading[k]
                _load(
                    i,
                    signal[row],
                    model.gain[model.set_of_row[row]],
                    moduli.ambient[moduli.field_of_row[row]],
                    moduli.sensor,
                    bent,
                )
        fill_directions(model.sensors, w, rows)
        _hold(w)
        for _ in range(_FITS_OF_MOMENT):
            _linearise(moduli.sensor, w, rows, bent)
            fill_basis(rows)
            project(BASIS, rows, common, dots)
            orthogonalise(w, rows)
        _begin(w)
        _fill_exact(moduli.sensor, w, rows, bent)
        _project_residual(rows, common, dots)
        _fill_left(w, rows)
        fill_tangents(w, free_range)
        fill_jacobian(model.sensors, w, rows)
        project(JACOBIAN, rows, common, dots)
        fill_normal(w, rows)
        judge(w, rules)
        step(w, free_range)
        for i in range(3 * LANES):
            w[TRIAL + MOMENT + i] = w[MOMENT + i]


@internal
def _load(
    i: int, signal: FloatArray, gain: FloatArray, ambient: FloatArray, sensor: IntArray, bent: FloatArray
) -> None:
    """Moduli of the start in lane i."""
    for m in range(len(sensor)):
        bent[m, READING + i], bent[m, WEIGHT + i] = signal[sensor[m], 0], gain[sensor[m], 0]
        for a in range(3):
            bent[m, AMBIENT + a * LANES + i] = ambient[m, a]


@internal
def _hold(w: FloatArray) -> None:
    """Keep the moments that trial states come with."""
    for i in range(3 * LANES):
        w[HELD + i] = w[TRIAL + MOMENT + i]


@internal
def _begin(w: FloatArray) -> None:
    """A start that has a moment is judged with it: no fit may end above it."""
    for i in range(LANES):
        m0, m1, m2 = three(w, HELD, i)
        begins = w[CHI2 + i] == math.inf and m0 * m0 + m1 * m1 + m2 * m2 > 0.0
        w[TRIAL + MOMENT + i] = m0 if begins else w[TRIAL + MOMENT + i]
        w[TRIAL + MOMENT + LANES + i] = m1 if begins else w[TRIAL + MOMENT + LANES + i]
        w[TRIAL + MOMENT + 2 * LANES + i] = m2 if begins else w[TRIAL + MOMENT + 2 * LANES + i]


@inlined
def _field(r: FloatArray, w: FloatArray, i: int) -> tuple[float, float, float]:
    """Field of the trial moment at a sensor."""
    n, m, inverse = three(r, DIRECTION, i), three(w, TRIAL + MOMENT, i), r[DIRECTION + 3 * LANES + i]
    cube, along = inverse * inverse * inverse, 3.0 * dot(n, m)
    return (along * n[0] - m[0]) * cube, (along * n[1] - m[1]) * cube, (along * n[2] - m[2]) * cube


@inlined
def _excess(b: tuple[float, float, float], a: tuple[float, float, float]) -> tuple[float, tuple[float, float, float]]:
    """By how much a field b raises the modulus of the ambient one a, to its digits, and the direction of their sum."""
    t = (a[0] + b[0], a[1] + b[1], a[2] + b[2])
    length = math.sqrt(dot(t, t))
    both = length + math.sqrt(dot(a, a))
    raised = dot(b, (a[0] + t[0], a[1] + t[1], a[2] + t[2])) / both if both > 0.0 else 0.0
    scale = 1.0 / length if length > 0.0 else 0.0
    return raised, (t[0] * scale, t[1] * scale, t[2] * scale)


@internal
def _linearise(sensor: IntArray, w: FloatArray, rows: FloatArray, bent: FloatArray) -> None:
    """Gains and readings of moduli that are linear about the field of the trial moment."""
    for m in range(len(sensor)):
        r, k = rows[sensor[m]], bent[m]
        for i in range(LANES):
            weight, b = k[WEIGHT + i], _field(r, w, i)
            raised, direction = _excess(b, three(k, AMBIENT, i))
            r[GAIN + i], r[GAIN + LANES + i] = weight * direction[0], weight * direction[1]
            r[GAIN + 2 * LANES + i] = weight * direction[2]
            r[SIGNAL + i] = k[READING + i] - weight * (raised - dot(direction, b))


@internal
def _fill_exact(sensor: IntArray, w: FloatArray, rows: FloatArray, bent: FloatArray) -> None:
    """Residuals of the trial moments, of moduli those of the exact ones."""
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            b = _field(r, w, i)
            r[RESIDUAL + i] = r[SIGNAL + i] - dot(three(r, GAIN, i), b)
            r[RESIDUAL + LANES + i] = r[SIGNAL + LANES + i] - dot(three(r, GAIN + 3 * LANES, i), b)
            r[RESIDUAL + 2 * LANES + i] = r[SIGNAL + 2 * LANES + i] - dot(three(r, GAIN + 6 * LANES, i), b)
    for m in range(len(sensor)):
        r, k = rows[sensor[m]], bent[m]
        for i in range(LANES):
            raised, _ = _excess(_field(r, w, i), three(k, AMBIENT, i))
            r[RESIDUAL + i] = k[READING + i] - k[WEIGHT + i] * raised


@internal
def _project_residual(rows: FloatArray, common: FloatArray, dots: FloatArray) -> None:
    """Remove the common field from the residual."""
    for k in range(len(dots)):
        d = dots[k]
        d[:] = 0.0
        for s in range(len(rows)):
            r, c = rows[s], common[s, k]
            for i in range(LANES):
                y = three(r, RESIDUAL, i)
                d[i] += dot(column(c, 0, i), y)
                d[LANES + i] += dot(column(c, LANES, i), y)
                d[2 * LANES + i] += dot(column(c, 2 * LANES, i), y)
        for s in range(len(rows)):
            r, c = rows[s], common[s, k]
            for i in range(LANES):
                y = less(three(r, RESIDUAL, i), d[i], column(c, 0, i))
                y = less(less(y, d[LANES + i], column(c, LANES, i)), d[2 * LANES + i], column(c, 2 * LANES, i))
                r[RESIDUAL + i], r[RESIDUAL + LANES + i], r[RESIDUAL + 2 * LANES + i] = y


@internal
def _fill_left(w: FloatArray, rows: FloatArray) -> None:
    """χ² of the trial states, and what of it the linear moduli would still take by another moment."""
    w[PRODUCT + 3 * LANES : PRODUCT + 6 * LANES] = 0.0
    w[TRIAL + CHI2 : TRIAL + CHI2 + LANES] = 0.0
    for s in range(len(rows)):
        r = rows[s]
        for i in range(LANES):
            y = three(r, RESIDUAL, i)
            w[TRIAL + CHI2 + i] += dot(y, y)
            w[PRODUCT + 3 * LANES + i] += dot(column(r, BASIS, i), y)
            w[PRODUCT + 4 * LANES + i] += dot(column(r, BASIS + LANES, i), y)
            w[PRODUCT + 5 * LANES + i] += dot(column(r, BASIS + 2 * LANES, i), y)
    for i in range(LANES):
        p0, p1, p2 = three(w, PRODUCT + 3 * LANES, i)
        i0, i1, i2 = three(w, SQUARE + 3 * LANES, i)
        w[TRIAL + LEFT + i] = p0 * p0 * i0 + p1 * p1 * i1 + p2 * p2 * i2
