"""Compiled information of many moments of one source at once, where axes or noise depend on the moment.

So it is with scalar sensors, with noise or errors of the calibration that grow with the field, and with bodies. A
moment is a lane (docs/theory/lanes.md), 64 of them at most a block: ``w[ROW + i]`` or ``columns[c, k, i]`` for lane i.
A sensor's covariance, :func:`arrays.noise.reading_covariance`, is divided out of its axes: a row of the whitened
Jacobian is that of a channel with a whitened axis, by the formulas of docs/theory/cramer-rao-bounds.md.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.bounds.frame_compiled import (
    AMBIENT,
    BODY,
    COMMON_MODULUS,
    LOST_INFORMATION,
    SHIFT,
    TURN,
    BoundModel,
    turned,
)
from magloc.compilation import internal
from magloc.fields.dipole_compiled import field_components, gradient_components
from magloc.fields.multipole import N_BODY_ERRORS
from magloc.fields.multipole_compiled import fill_finite_body_errors

LANES = 64  # at most
# Rows of the workspace w, as offsets.
MOMENT = 0  # in the axes u, v, n (3)
MEAN = 3 * LANES  # of the vector sensors' fields (3), of the scalar ones' moduli
AXES = 7 * LANES  # of one sensor's channels, whitened (3 × 3)
GAIN = 16 * LANES  # of a scalar sensor, whitened
NOTHING = 17 * LANES  # zero
ROW = 18 * LANES  # derivatives of one channel with respect to moment and position (6)
WORKSPACE = 24 * LANES
# A sensor's rows: field (3), its modulus.
FIELD = 4 * LANES
# What reading_covariance adds to the singular covariance of turns and gains.
_REGULAR = 1.0 + 1e-13


class Block(NamedTuple):
    """Workspaces, and the array in the axes of the place.

    Attributes
    ----------
    w, fields : ndarray
        Flat.
    columns : ndarray, shape (rows, q + 6, lanes in use)
        A row stands for a channel, or for a prior of a nuisance or of the moment's modulus.
    factors : ndarray, shape (q + 6, lanes in use)
        Of the columns in a projection.
    squares : ndarray, shape (3, lanes in use)
        Of the moment's columns before they are freed of each other.
    displacements, ambient, axes, rotations : ndarray
        As in the model.
    arm : ndarray, shape (3,)
        From the point about which the array turns to the source.
    bodies : ndarray, shape (N, n, 6)
        Of :func:`fill_finite_body_errors`, for every sensor.
    """

    w: FloatArray
    fields: FloatArray
    columns: FloatArray
    factors: FloatArray
    squares: FloatArray
    displacements: FloatArray
    ambient: FloatArray
    axes: FloatArray
    rotations: FloatArray
    arm: FloatArray
    bodies: FloatArray


@internal
def new_block(model: BoundModel, n_moments: int) -> Block:
    """Workspaces for an array and blocks of equal size that together have a lane for every moment."""
    n_rows, n_columns = model.noise.size, model.nuisances.size + 6
    for prior in model.prior:
        n_rows += 1 if prior > 0.0 else 0
    n_rows += 1 if model.modulus_prior > 0.0 else 0
    n_blocks = (n_moments - 1) // LANES + 1
    n_lanes = (n_moments - 1) // n_blocks + 1
    return Block(
        np.zeros(WORKSPACE),
        np.empty(model.scalar.size * FIELD),
        np.empty((n_rows, n_columns, n_lanes)),
        np.empty((n_columns, n_lanes)),
        np.zeros((3, n_lanes)),
        np.empty(model.sensors.shape),
        np.empty(model.sensors.shape),
        np.empty(model.axes.shape),
        np.empty(model.rotations.shape),
        np.empty(3),
        np.empty((model.scalar.size, N_BODY_ERRORS, 6)),
    )


@internal
def fill_entries(
    model: BoundModel,
    position: FloatArray,
    length_m: float,
    moments: FloatArray,
    frame: FloatArray,
    block: Block,
    entries: FloatArray,
) -> None:
    """Information about (u, v, n) for every moment (M, 3), into entries (9, M + LANES or more).

    Rows: uu, uv, vv, un, vn, nn; then uu, vv, nn of what it would be for a known moment.
    """
    _place(model, position, frame, block)
    if model.nuisances.size > 0 and model.nuisances[-1] >= BODY:
        for s in range(model.scalar.size):
            fill_finite_body_errors(block.displacements[s], length_m, block.bodies[s])
    n_lanes = block.columns.shape[2]
    for begin in range(0, moments.shape[0], n_lanes):
        _fill_moments(moments, begin, n_lanes, frame, block.w)
        _fill_fields(model, block)
        if model.noise_fraction.any():
            _fill_means(model.scalar, block)
        _fill_columns(model, block)
        _eliminate(block, entries[:, begin : begin + n_lanes])


@internal
def _place(model: BoundModel, position: FloatArray, frame: FloatArray, block: Block) -> None:
    """Turn the array to the axes u, v, n."""
    arm = position + model.lever_arm
    _turn_into(block.arm, frame, arm[0], arm[1], arm[2])
    for s in range(model.scalar.size):
        d, b = model.sensors[s], model.ambient[s]
        _turn_into(block.displacements[s], frame, d[0] - position[0], d[1] - position[1], d[2] - position[2])
        _turn_into(block.ambient[s], frame, b[0], b[1], b[2])
        r = model.rotations[s]
        for k in range(3):
            _turn_into(block.rotations[s, :, k], frame, r[0, k], r[1, k], r[2, k])
    for c in range(model.noise.size):
        a = model.axes[c]
        _turn_into(block.axes[c], frame, a[0], a[1], a[2])


@internal
def _turn_into(out: FloatArray, frame: FloatArray, x: float, y: float, z: float) -> None:
    out[0], out[1], out[2] = turned(frame, x, y, z)


@internal
def _fill_moments(moments: FloatArray, begin: int, n_lanes: int, frame: FloatArray, w: FloatArray) -> None:
    for i in range(n_lanes):
        j = min(begin + i, moments.shape[0] - 1)  # an idle lane computes something, too
        u, v, n = turned(frame, moments[j, 0], moments[j, 1], moments[j, 2])
        w[MOMENT + i], w[MOMENT + LANES + i], w[MOMENT + 2 * LANES + i] = u, v, n


@internal
def _fill_fields(model: BoundModel, block: Block) -> None:
    w, fields, n_lanes = block.w, block.fields, block.columns.shape[2]
    for s in range(model.scalar.size):
        dx, dy, dz = block.displacements[s, 0], block.displacements[s, 1], block.displacements[s, 2]
        ax, ay, az = block.ambient[s, 0], block.ambient[s, 1], block.ambient[s, 2]
        f = s * FIELD
        for i in range(n_lanes):
            x, y, z = field_components(
                dx, dy, dz, w[MOMENT + i], w[MOMENT + LANES + i], w[MOMENT + 2 * LANES + i]
            )  # fmt: skip
            x, y, z = x + ax, y + ay, z + az
            fields[f + i], fields[f + LANES + i], fields[f + 2 * LANES + i] = x, y, z
            fields[f + 3 * LANES + i] = math.sqrt(x * x + y * y + z * z)


@internal
def _fill_means(scalar: NDArray[np.bool_], block: Block) -> None:
    """Mean field of the vector sensors, mean modulus of the scalar ones."""
    w, fields, n_lanes = block.w, block.fields, block.columns.shape[2]
    w[MEAN : MEAN + 4 * LANES] = 0.0
    n_scalar = 0
    for is_scalar in scalar:
        n_scalar += 1 if is_scalar else 0
    for s in range(scalar.size):
        first, end, share = (3, 4, 1.0 / n_scalar) if scalar[s] else (0, 3, 1.0 / (scalar.size - n_scalar))
        for k in range(first, end):
            for i in range(n_lanes):
                w[MEAN + k * LANES + i] += share * fields[s * FIELD + k * LANES + i]


@internal
def _fill_columns(model: BoundModel, block: Block) -> None:
    """Columns of the nuisances, of the moment and of the position."""
    w, columns = block.w, block.columns
    n_channels, n_nuisances, n_lanes = model.noise.size, model.nuisances.size, columns.shape[2]
    for s in range(model.scalar.size):
        if model.scalar[s]:
            _fill_scalar_axis(model, s, block)
        else:
            _fill_vector_axes(model, s, block)
        first = model.channel[s]
        for c in range(first, first + (1 if model.scalar[s] else 3)):
            axis = AXES + 3 * (c - first) * LANES
            _fill_row(block.displacements[s], w[axis:], n_lanes, w)
            for q in range(n_nuisances):
                nuisance = model.nuisances[q]
                if TURN <= nuisance < SHIFT:
                    _fill_turn(nuisance - TURN, block.arm, block.ambient[s], w[axis:], w, columns[c, q])
                    continue
                if nuisance >= BODY:
                    _fill_body(block.bodies[s, nuisance - BODY], w[axis:], w, columns[c, q])
                    continue
                effect = w[_effect(nuisance, model.scalar[s], axis) :]
                for i in range(n_lanes):
                    columns[c, q, i] = effect[i]
            for k in range(6):
                for i in range(n_lanes):
                    columns[c, n_nuisances + k, i] = w[ROW + k * LANES + i]
    columns[n_channels:] = 0.0
    row = n_channels
    for q in range(n_nuisances):
        if model.prior[q] > 0.0:
            columns[row, q] = model.prior[q]
            row += 1
    if model.modulus_prior > 0.0:
        for i in range(n_lanes):
            u, v, n = w[MOMENT + i], w[MOMENT + LANES + i], w[MOMENT + 2 * LANES + i]
            along = model.modulus_prior / math.sqrt(u * u + v * v + n * n)
            columns[row, n_nuisances, i] = along * u
            columns[row, n_nuisances + 1, i] = along * v
            columns[row, n_nuisances + 2, i] = along * n


@internal
def _effect(nuisance: int, scalar: bool, axis: int) -> int:
    """Where it stands what a channel reads of a nuisance."""
    if nuisance == COMMON_MODULUS:
        return GAIN if scalar else NOTHING
    if nuisance < COMMON_MODULUS:
        return NOTHING if scalar else axis + nuisance * LANES
    if nuisance >= SHIFT:
        return ROW + (3 + nuisance - SHIFT) * LANES
    return axis + (nuisance - AMBIENT) * LANES


@internal
def _fill_row(displacement: FloatArray, axis: FloatArray, n_lanes: int, w: FloatArray) -> None:
    """Derivatives of a channel with respect to moment and position; the latter's sign does not matter."""
    dx, dy, dz = displacement[0], displacement[1], displacement[2]
    for i in range(n_lanes):
        ax, ay, az = axis[i], axis[LANES + i], axis[2 * LANES + i]
        mx, my, mz = w[MOMENT + i], w[MOMENT + LANES + i], w[MOMENT + 2 * LANES + i]
        x, y, z = field_components(dx, dy, dz, ax, ay, az)
        w[ROW + i], w[ROW + LANES + i], w[ROW + 2 * LANES + i] = x, y, z
        xx, xy, xz, yy, yz, zz = gradient_components(dx, dy, dz, ax, ay, az)
        w[ROW + 3 * LANES + i] = xx * mx + xy * my + xz * mz
        w[ROW + 4 * LANES + i] = xy * mx + yy * my + yz * mz
        w[ROW + 5 * LANES + i] = xz * mx + yz * my + zz * mz


@internal
def _fill_turn(k: int, arm: FloatArray, ambient: FloatArray, axis: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """What a channel reads of a turn about axis k: the source's place, its moment and the ambient field turn back."""
    a, b = (k + 1) % 3, (k + 2) % 3  # component a of v × e_k is v_b, component b is -v_a
    for i in range(out.size):
        by_moment = (
            w[ROW + a * LANES + i] * w[MOMENT + b * LANES + i] - w[ROW + b * LANES + i] * w[MOMENT + a * LANES + i]
        )
        by_place = w[ROW + (3 + a) * LANES + i] * arm[b] - w[ROW + (3 + b) * LANES + i] * arm[a]
        out[i] = by_moment - by_place + axis[a * LANES + i] * ambient[b] - axis[b * LANES + i] * ambient[a]


@internal
def _fill_body(e: FloatArray, axis: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """What a channel reads of one error of a body, which is a symmetric matrix times the moment."""
    for i in range(out.size):
        mx, my, mz = w[MOMENT + i], w[MOMENT + LANES + i], w[MOMENT + 2 * LANES + i]
        x, y, z = (
            e[0] * mx + e[1] * my + e[2] * mz,
            e[1] * mx + e[3] * my + e[4] * mz,
            e[2] * mx + e[4] * my + e[5] * mz,
        )
        out[i] = axis[i] * x + axis[LANES + i] * y + axis[2 * LANES + i] * z


@internal
def _fill_scalar_axis(model: BoundModel, s: int, block: Block) -> None:
    """Direction of the field times the gain, over the noise."""
    w, fields, n_lanes = block.w, block.fields, block.columns.shape[2]
    f, c = s * FIELD, model.channel[s]
    gain = model.axes[c, 0]
    constant = model.noise[c] ** 2
    by_field = gain**2 * (model.uncertainty[s, 1] ** 2 + model.uncertainty[s, 2] ** 2)
    by_difference = (gain * model.noise_fraction[s]) ** 2
    for i in range(n_lanes):
        modulus = fields[f + 3 * LANES + i]
        difference = modulus - w[MEAN + 3 * LANES + i]
        variance = constant + by_field * modulus * modulus + by_difference * difference * difference
        whitened = gain / math.sqrt(variance)
        along = whitened / modulus
        w[GAIN + i] = whitened
        w[AXES + i] = along * fields[f + i]
        w[AXES + LANES + i] = along * fields[f + LANES + i]
        w[AXES + 2 * LANES + i] = along * fields[f + 2 * LANES + i]


@internal
def _fill_vector_axes(model: BoundModel, s: int, block: Block) -> None:
    """Axes times the inverse root of the covariance, by substitution in its Cholesky factor."""
    w, fields, n_lanes = block.w, block.fields, block.columns.shape[2]
    f, c = s * FIELD, model.channel[s]
    r, g, noise = block.rotations[s], model.scales[s], model.noise
    p0, p1, p2 = block.axes[c, 0], block.axes[c, 1], block.axes[c, 2]
    q0, q1, q2 = block.axes[c + 1, 0], block.axes[c + 1, 1], block.axes[c + 1, 2]
    t0, t1, t2 = block.axes[c + 2, 0], block.axes[c + 2, 1], block.axes[c + 2, 2]
    turn, gain, induced = model.uncertainty[s, 0], model.uncertainty[s, 1], model.uncertainty[s, 2]
    fraction = model.noise_fraction[s]
    # Three channels p, q, t: axes p0, p1, p2, errors by turns pu, pv, pn and by gains px, py, pz, covariance qp.
    for i in range(n_lanes):
        x, y, z = fields[f + i], fields[f + LANES + i], fields[f + 2 * LANES + i]
        dx, dy, dz = x - w[MEAN + i], y - w[MEAN + LANES + i], z - w[MEAN + 2 * LANES + i]
        proportional = fraction * fraction * (dx * dx + dy * dy + dz * dz)
        # Errors of the calibration: a turn θ adds θ · (b × a) to a channel of the axis a, gains their part of it.
        bx, by, bz = turn * x, turn * y, turn * z
        pu, pv, pn = by * p2 - bz * p1, bz * p0 - bx * p2, bx * p1 - by * p0
        qu, qv, qn = by * q2 - bz * q1, bz * q0 - bx * q2, bx * q1 - by * q0
        tu, tv, tn = by * t2 - bz * t1, bz * t0 - bx * t2, bx * t1 - by * t0
        own0 = gain * (r[0, 0] * x + r[1, 0] * y + r[2, 0] * z)
        own1 = gain * (r[0, 1] * x + r[1, 1] * y + r[2, 1] * z)
        own2 = gain * (r[0, 2] * x + r[1, 2] * y + r[2, 2] * z)
        px, py, pz = g[0, 0] * own0, g[0, 1] * own1, g[0, 2] * own2
        qx, qy, qz = g[1, 0] * own0, g[1, 1] * own1, g[1, 2] * own2
        tx, ty, tz = g[2, 0] * own0, g[2, 1] * own1, g[2, 2] * own2
        # What the field induces has no axis.
        stray = induced * induced * (x * x + y * y + z * z)
        p_p, q_p, q_q = p0 * p0 + p1 * p1 + p2 * p2, q0 * p0 + q1 * p1 + q2 * p2, q0 * q0 + q1 * q1 + q2 * q2
        t_p, t_q, t_t = t0 * p0 + t1 * p1 + t2 * p2, t0 * q0 + t1 * q1 + t2 * q2, t0 * t0 + t1 * t1 + t2 * t2
        pp = pu * pu + pv * pv + pn * pn + px * px + py * py + pz * pz + stray * p_p
        qp = qu * pu + qv * pv + qn * pn + qx * px + qy * py + qz * pz + stray * q_p
        qq = qu * qu + qv * qv + qn * qn + qx * qx + qy * qy + qz * qz + stray * q_q
        tp = tu * pu + tv * pv + tn * pn + tx * px + ty * py + tz * pz + stray * t_p
        tq = tu * qu + tv * qv + tn * qn + tx * qx + ty * qy + tz * qz + stray * t_q
        tt = tu * tu + tv * tv + tn * tn + tx * tx + ty * ty + tz * tz + stray * t_t
        pp = _REGULAR * pp + noise[c] ** 2 + proportional * p_p
        qq = _REGULAR * qq + noise[c + 1] ** 2 + proportional * q_q
        tt = _REGULAR * tt + noise[c + 2] ** 2 + proportional * t_t

        inverse = 1.0 / math.sqrt(pp)
        qp, tp = inverse * qp, inverse * tp
        e0, e1, e2 = inverse * p0, inverse * p1, inverse * p2
        w[AXES + i], w[AXES + LANES + i], w[AXES + 2 * LANES + i] = e0, e1, e2
        inverse = 1.0 / math.sqrt(qq - qp * qp)
        tq = inverse * (tq - tp * qp)
        f0, f1, f2 = inverse * (q0 - qp * e0), inverse * (q1 - qp * e1), inverse * (q2 - qp * e2)
        w[AXES + 3 * LANES + i], w[AXES + 4 * LANES + i], w[AXES + 5 * LANES + i] = f0, f1, f2
        inverse = 1.0 / math.sqrt(tt - tp * tp - tq * tq)
        w[AXES + 6 * LANES + i] = inverse * (t0 - tp * e0 - tq * f0)
        w[AXES + 7 * LANES + i] = inverse * (t1 - tp * e1 - tq * f1)
        w[AXES + 8 * LANES + i] = inverse * (t2 - tp * e2 - tq * f2)


@internal
def _eliminate(block: Block, entries: FloatArray) -> None:
    """Gram matrix of the position's columns, at right angles to those of the nuisances, and then to the moment's.

    The columns themselves are turned (modified Gram-Schmidt), for the Gram matrix of all has half the digits.
    """
    columns, factors, squares = block.columns, block.factors, block.squares
    n_columns = columns.shape[1]
    moment, position = n_columns - 6, n_columns - 3
    squares[:] = 0.0
    for k in range(moment):
        _project(columns, k, squares[0], factors)
    for k in range(3):
        _fill_product(columns, position + k, position + k, entries[6 + k])
        _fill_product(columns, moment + k, moment + k, squares[k])
    for k in range(3):
        _project(columns, moment + k, squares[k], factors)
    entry = 0
    for k in range(3):
        for j in range(k + 1):
            _fill_product(columns, position + j, position + k, entries[entry])
            entry += 1


@internal
def _project(columns: FloatArray, k: int, before: FloatArray, factors: FloatArray) -> None:
    """Turn the columns behind column k to right angles to it, unless next to nothing is left of its square before."""
    n_rows, n_columns, n_lanes = columns.shape
    for j in range(k, n_columns):
        _fill_product(columns, k, j, factors[j])
    for i in range(n_lanes):
        square = factors[k, i]
        factors[k, i] = 0.0 if square <= LOST_INFORMATION * before[i] else 1.0 / square
    for j in range(k + 1, n_columns):
        for i in range(n_lanes):
            factors[j, i] *= factors[k, i]
        for c in range(n_rows):
            for i in range(n_lanes):
                columns[c, j, i] -= factors[j, i] * columns[c, k, i]


@internal
def _fill_product(columns: FloatArray, j: int, k: int, out: FloatArray) -> None:
    """Scalar product of two columns."""
    out[:] = 0.0
    for c in range(columns.shape[0]):
        for i in range(out.size):
            out[i] += columns[c, j, i] * columns[c, k, i]
