"""Compiled linearisation of the differences at the states of a block of lanes.

The readable twin is :class:`magloc.measurement.differences.DifferenceMeasurement`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray
from magloc.compilation import inlined, internal
from magloc.convergence.workspace_compiled import (
    BASE,
    CHANGE,
    CHI2,
    COMMON,
    LANES,
    NORMAL,
    RIGHT,
    ROW,
    SENSOR,
    SENSOR_ROWS,
    STATE,
    lanes_of,
)
from magloc.fields.dipole_compiled import field_matrix_components, gradient_components


class Model(NamedTuple):
    """Differences of an array; lengths in `length`, moments in `moment`, fields in moment / length³.

    The arrays of one of the two forms of the differences are empty.
    """

    length: float  # [m]
    moment: float  # [A·m²]
    sensors: FloatArray  # (3 N,)
    # Recursive contrasts, for noise that is the same along the axes of each sensor; the base sensor comes first.
    readings: FloatArray = np.zeros(0)  # (3 N,), up to a field common to all
    blend: FloatArray = np.zeros(0)  # (N,), share of a sensor in the mean over the sensors so far
    whiten: FloatArray = np.zeros(0)  # (N,), 1/σ of a sensor minus the mean over those before it
    # The matrix form, for any noise.
    rows: FloatArray = np.zeros((0, 0, 3))  # (k, N, 3), weights of the fields in the differences, over the latter's σ
    measured: FloatArray = np.zeros(0)  # (k,), differences over their σ
    variance: FloatArray = np.zeros(0)  # (k,)

    @classmethod
    def of(
        cls,
        z: FloatArray,
        variance: FloatArray,
        sensors: FloatArray,
        weights: FloatArray,
        length: float,
        moment: float,
    ) -> Model:
        """From SI."""
        field = moment / length**3
        z, variance, sensors = z / field, variance / field**2, sensors / length
        base, noise = _base_and_noise(weights, variance)
        if noise is None:
            sigma = np.sqrt(variance)
            rows = weights / sigma[:, None, None]
            return cls(length, moment, sensors.ravel(), rows=rows, measured=z / sigma, variance=variance)
        order = np.argsort(np.arange(len(sensors)) != base, kind="stable")
        noise = noise[order]
        total = np.cumsum(1.0 / noise)  # inverse variance of the mean
        readings = np.asarray(np.linalg.lstsq(weights.reshape(z.size, -1), z, rcond=None)[0], dtype=np.float64)
        return cls(
            length,
            moment,
            sensors[order].ravel(),
            readings=readings.reshape(-1, 3)[order].ravel(),
            blend=1.0 / (noise * total),
            whiten=np.concatenate([[0.0], 1.0 / np.sqrt(noise[1:] + 1.0 / total[:-1])]),
        )


def _base_and_noise(weights: FloatArray, variance: FloatArray) -> tuple[int, FloatArray | None]:
    """Base sensor of the differences and the sensors' variances (N,), or None unless both are of the recursive form.

    The information of the differences about the sensors' fields must be ``(diag(c) - c cᵀ / Σc) ⊗ I₃`` with c the
    inverse variances, and the plain sum of their squares that of the differences against the base sensor.
    """
    n = weights.shape[1]
    information = np.einsum("jsa,jtb,j->satb", weights, weights, 1.0 / variance)
    squares = np.einsum("jsa,jtb->satb", weights, weights)
    base = int(np.argmax(squares[:, 0, :, 0].diagonal()))
    contrasts = np.delete(np.eye(n), base, axis=0)
    contrasts[:, base] = -1.0
    p = information[:, 0, :, 0]
    if n == 2:
        certainty = np.full(2, 2.0 * p[0, 0])
    else:
        # The off-diagonal elements are -v_i v_j with v = c / √Σc.
        i, j, k = np.arange(n), np.roll(np.arange(n), 1), np.roll(np.arange(n), 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            certainty = p[i, i] - p[i, j] * p[i, k] / p[j, k]
    if not np.all(certainty > 0.0):
        return base, None
    expected = np.diag(certainty) - np.outer(certainty, certainty) / np.sum(certainty)
    scale = np.sqrt(np.outer(certainty, certainty))[:, None, :, None]
    same = np.eye(3)[:, None, :]
    recursive = (
        np.max(np.abs(information - expected[:, None, :, None] * same) / scale) < 1e-12
        and np.max(np.abs(squares - (contrasts.T @ contrasts)[:, None, :, None] * same)) < 1e-12 * n
    )
    return base, 1.0 / certainty if recursive else None


@internal
def linearise_contrasts(
    w: FloatArray,
    before: FloatArray,
    residuals: FloatArray,
    model: Model,
    lane: int | None,
) -> None:
    """Add all sensors to NORMAL, RIGHT and CHI2 by recursive contrasts; CHANGE, and the residuals that it compares."""
    sensors, readings, blend, whiten = model.sensors, model.readings, model.blend, model.whiten
    for s in range(blend.size):
        _sensor_fields(
            lane, w, sensors[3 * s], sensors[3 * s + 1], sensors[3 * s + 2],
            readings[3 * s], readings[3 * s + 1], readings[3 * s + 2],
        )  # fmt: skip
        if s == 0:
            for r in range(SENSOR_ROWS):
                for i in lanes_of(lane):
                    w[COMMON + r * LANES + i] = w[SENSOR + r * LANES + i]
            for r in range(3):
                for i in lanes_of(lane):
                    w[BASE + r * LANES + i] = w[SENSOR + r * LANES + i]
        # An orthonormal transform of the differences leaves the sum of their squares alone: no need to transform them.
        for r in range(3):
            for i in lanes_of(lane):
                residual = w[SENSOR + r * LANES + i] - w[BASE + r * LANES + i]
                change = residual - before[(3 * s + r) * LANES + i]
                residuals[(3 * s + r) * LANES + i] = residual
                w[CHANGE + r * LANES + i] += change * change
        if s == 0:
            continue
        a, b = blend[s], whiten[s]
        for i in lanes_of(lane):
            ex, ey, ez = _contrast(w, 0, i, a, b), _contrast(w, 1, i, a, b), _contrast(w, 2, i, a, b)
            gxx, gxy, gxz = _contrast(w, 3, i, a, b), _contrast(w, 4, i, a, b), _contrast(w, 5, i, a, b)
            gyy, gyz = _contrast(w, 6, i, a, b), _contrast(w, 7, i, a, b)
            axx, axy, axz = _contrast(w, 8, i, a, b), _contrast(w, 9, i, a, b), _contrast(w, 10, i, a, b)
            ayy, ayz = _contrast(w, 11, i, a, b), _contrast(w, 12, i, a, b)
            # Both tensors are symmetric and traceless, and ∂B/∂p = -G.
            _add_difference(w, i, ex, -gxx, -gxy, -gxz, axx, axy, axz)
            _add_difference(w, i, ey, -gxy, -gyy, -gyz, axy, ayy, ayz)
            _add_difference(w, i, ez, -gxz, -gyz, gxx + gyy, axz, ayz, -(axx + ayy))


@internal
def linearise_rows(
    w: FloatArray,
    fields: FloatArray,
    before: FloatArray,
    residuals: FloatArray,
    model: Model,
    lane: int | None,
) -> None:
    """:func:`linearise_contrasts` for any weights of the fields in the differences, row by row."""
    sensors, rows, measured, variance = model.sensors, model.rows, model.measured, model.variance
    for s in range(rows.shape[1]):
        _sensor_fields(lane, w, sensors[3 * s], sensors[3 * s + 1], sensors[3 * s + 2], 0.0, 0.0, 0.0)
        for r in range(SENSOR_ROWS):
            for i in lanes_of(lane):
                fields[(SENSOR_ROWS * s + r) * LANES + i] = w[SENSOR + r * LANES + i]
    for j in range(measured.size):
        for r in range(7):
            for i in lanes_of(lane):
                w[ROW + r * LANES + i] = 0.0 if r else measured[j]
        for s in range(rows.shape[1]):
            if rows[j, s, 0] != 0.0 or rows[j, s, 1] != 0.0 or rows[j, s, 2] != 0.0:
                of_sensor = slice(SENSOR_ROWS * LANES * s, SENSOR_ROWS * LANES * (s + 1))
                _add_to_row(lane, w, fields[of_sensor], rows[j, s, 0], rows[j, s, 1], rows[j, s, 2])
        _add_row(lane, w, before[j * LANES : (j + 1) * LANES], residuals[j * LANES : (j + 1) * LANES], variance[j])


@inlined
def _sensor_fields(
    lane: int | None, w: FloatArray, sx: float, sy: float, sz: float, yx: float, yy: float, yz: float
) -> None:
    """Rows SENSOR: reading minus field of the states at one sensor, and the field's derivatives."""
    for i in lanes_of(lane):
        dx, dy, dz = sx - w[STATE + i], sy - w[STATE + LANES + i], sz - w[STATE + 2 * LANES + i]
        mx, my, mz = w[STATE + 3 * LANES + i], w[STATE + 4 * LANES + i], w[STATE + 5 * LANES + i]
        axx, axy, axz, ayy, ayz, azz = field_matrix_components(dx, dy, dz)
        gxx, gxy, gxz, gyy, gyz, _ = gradient_components(dx, dy, dz, mx, my, mz)
        w[SENSOR + i] = yx - (axx * mx + axy * my + axz * mz)
        w[SENSOR + LANES + i] = yy - (axy * mx + ayy * my + ayz * mz)
        w[SENSOR + 2 * LANES + i] = yz - (axz * mx + ayz * my + azz * mz)
        w[SENSOR + 3 * LANES + i] = gxx
        w[SENSOR + 4 * LANES + i] = gxy
        w[SENSOR + 5 * LANES + i] = gxz
        w[SENSOR + 6 * LANES + i] = gyy
        w[SENSOR + 7 * LANES + i] = gyz
        w[SENSOR + 8 * LANES + i] = axx
        w[SENSOR + 9 * LANES + i] = axy
        w[SENSOR + 10 * LANES + i] = axz
        w[SENSOR + 11 * LANES + i] = ayy
        w[SENSOR + 12 * LANES + i] = ayz


@inlined
def _contrast(w: FloatArray, quantity: int, i: int, blend: float, whiten: float) -> float:
    """One quantity at the sensor minus its mean so far, divided by the standard deviation; the mean moves on."""
    difference = w[SENSOR + quantity * LANES + i] - w[COMMON + quantity * LANES + i]
    w[COMMON + quantity * LANES + i] += blend * difference
    return whiten * difference


@internal
def _add_to_row(lane: int | None, w: FloatArray, f: FloatArray, x: float, y: float, z: float) -> None:
    """Add one sensor, whose rows SENSOR are f, to a difference with the weights x, y, z of its field."""
    for i in lanes_of(lane):
        gxx, gxy, gxz, gyy = f[3 * LANES + i], f[4 * LANES + i], f[5 * LANES + i], f[6 * LANES + i]
        gyz = f[7 * LANES + i]
        axx, axy, axz, ayy = f[8 * LANES + i], f[9 * LANES + i], f[10 * LANES + i], f[11 * LANES + i]
        ayz = f[12 * LANES + i]
        w[ROW + i] += x * f[i] + y * f[LANES + i] + z * f[2 * LANES + i]
        w[ROW + LANES + i] -= x * gxx + y * gxy + z * gxz
        w[ROW + 2 * LANES + i] -= x * gxy + y * gyy + z * gyz
        w[ROW + 3 * LANES + i] -= x * gxz + y * gyz - z * (gxx + gyy)
        w[ROW + 4 * LANES + i] += x * axx + y * axy + z * axz
        w[ROW + 5 * LANES + i] += x * axy + y * ayy + z * ayz
        w[ROW + 6 * LANES + i] += x * axz + y * ayz - z * (axx + ayy)


@internal
def _add_row(lane: int | None, w: FloatArray, before: FloatArray, residuals: FloatArray, variance: float) -> None:
    """Add a difference to NORMAL, RIGHT and CHI2, and its part of ‖ΔG‖² to CHANGE."""
    for i in lanes_of(lane):
        r = w[ROW + i]
        change = r - before[i]
        w[CHANGE + i] += variance * (change * change)
        residuals[i] = r
        _add_difference(
            w, i, r, w[ROW + LANES + i], w[ROW + 2 * LANES + i], w[ROW + 3 * LANES + i],
            w[ROW + 4 * LANES + i], w[ROW + 5 * LANES + i], w[ROW + 6 * LANES + i],
        )  # fmt: skip


@inlined
def _add_difference(
    w: FloatArray, i: int, r: float, h0: float, h1: float, h2: float, h3: float, h4: float, h5: float
) -> None:
    """Add one whitened difference with residual r and Jacobian h to JᵀJ, Jᵀr and χ²."""
    w[NORMAL + i] += h0 * h0
    w[NORMAL + LANES + i] += h0 * h1
    w[NORMAL + 2 * LANES + i] += h0 * h2
    w[NORMAL + 3 * LANES + i] += h0 * h3
    w[NORMAL + 4 * LANES + i] += h0 * h4
    w[NORMAL + 5 * LANES + i] += h0 * h5
    w[NORMAL + 6 * LANES + i] += h1 * h1
    w[NORMAL + 7 * LANES + i] += h1 * h2
    w[NORMAL + 8 * LANES + i] += h1 * h3
    w[NORMAL + 9 * LANES + i] += h1 * h4
    w[NORMAL + 10 * LANES + i] += h1 * h5
    w[NORMAL + 11 * LANES + i] += h2 * h2
    w[NORMAL + 12 * LANES + i] += h2 * h3
    w[NORMAL + 13 * LANES + i] += h2 * h4
    w[NORMAL + 14 * LANES + i] += h2 * h5
    w[NORMAL + 15 * LANES + i] += h3 * h3
    w[NORMAL + 16 * LANES + i] += h3 * h4
    w[NORMAL + 17 * LANES + i] += h3 * h5
    w[NORMAL + 18 * LANES + i] += h4 * h4
    w[NORMAL + 19 * LANES + i] += h4 * h5
    w[NORMAL + 20 * LANES + i] += h5 * h5
    w[RIGHT + i] += h0 * r
    w[RIGHT + LANES + i] += h1 * r
    w[RIGHT + 2 * LANES + i] += h2 * r
    w[RIGHT + 3 * LANES + i] += h3 * r
    w[RIGHT + 4 * LANES + i] += h4 * r
    w[RIGHT + 5 * LANES + i] += h5 * r
    w[CHI2 + i] += r * r
