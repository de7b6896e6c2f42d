r"""Compiled Cramér-Rao bounds of range and bearing; the readable twin is :func:`magloc.bounds.bounds_of`.

A channel with the axis a reads a·B. Its derivatives follow from the field and the gradient tensor of a dipole of
"moment" a, for both are symmetric: with d from the source to the sensor

.. math:: ∂(a·B)/∂m_j = (A(d) a)_j, \qquad ∂(a·B)/∂p_i = -\sum_j m_j G_{ij}(d; a)

So nine columns, three of A a and six of the symmetric G(d; a), hold the derivatives for **every** moment. Before them
stand the columns of the nuisances, each with a further row that holds its prior: what is left of the six at right
angles to all before them has a 6×6 Gram matrix K, with :math:`M_{ij} = \sum_{ab} m_a m_b K_{(ia)(jb)}` the
information about the position. It is formed once for a position; a moment then costs 100 operations. Where the moment
turns the axes, as of scalar sensors, or changes the noise, it is formed for every moment.

All is done in axes (u, v, n) with n along the line from the sensors' centroid to the source.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from arrays.sensor import SensorArray
from magloc.kernels import compiled, over_rows
from magloc.kernels.dipole import field_components, gradient_components

FloatArray = NDArray[np.float64]

# Information about a parameter that is less than this part of what it would be were the others known is none.
LOST_INFORMATION = 1e-12
# Place of (i, a) among the six entries xx, xy, xz, yy, yz, zz of a symmetric tensor.
_PAIR = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
# Rows and columns of the entries uu, uv, vv, un, vn, nn, and of uu, vv, nn.
_ROWS = np.array([0, 0, 1, 0, 1, 2, 0, 1, 2])
_COLUMNS_OF = np.array([0, 1, 1, 2, 2, 2, 0, 1, 2])
# Nuisances: components of the common field, its modulus for scalar sensors, components of the ambient field's error.
_COMMON, _COMMON_MODULUS, _AMBIENT = 0, 3, 4


class BoundModel(NamedTuple):
    """What the kernel needs of an array.

    Attributes
    ----------
    centroid : ndarray, shape (3,)
    sensors : ndarray, shape (N, 3)
        Positions [m].
    ambient : ndarray, shape (N, 3)
        Ambient field at the sensors [T].
    scalar : ndarray of bool, shape (N,)
    channel : ndarray, shape (N,)
        First channel of every sensor.
    axes : ndarray, shape (C, 3)
        Row a of every vector channel; (g, 0, 0) of a scalar one.
    rotations, scales : ndarray, shape (N, 3, 3)
        From the sensors' axes to the array's; calibration.
    noise : ndarray, shape (C,)
        [T]
    uncertainty : ndarray, shape (N, 2)
        Standard deviations of turns [rad] and gains.
    noise_fraction : float
    nuisances : ndarray, shape (q,)
        Which ones there are.
    prior : ndarray, shape (q,)
        Their inverse standard deviations, 0 if nothing is known [1/T].
    varies : bool
        Whether axes or noise depend on the moment.
    """

    centroid: FloatArray
    sensors: FloatArray
    ambient: FloatArray
    scalar: NDArray[np.bool_]
    channel: NDArray[np.intp]
    axes: FloatArray
    rotations: FloatArray
    scales: FloatArray
    noise: FloatArray
    uncertainty: FloatArray
    noise_fraction: float
    nuisances: NDArray[np.intp]
    prior: FloatArray
    varies: bool

    @classmethod
    def of(cls, array: SensorArray, ambient_uncertainty_T: float = 0.0) -> BoundModel:
        """Model of an array whose ambient field is known to a standard deviation [T] per axis."""
        scales = np.tile(np.eye(3), (array.n_sensors, 1, 1))
        for scale, sensor in zip(scales, array.sensors, strict=True):
            scale[: sensor.n_channels, : sensor.n_channels] = sensor.calibration.scale
        scalar = np.array([sensor.kind == "scalar" for sensor in array.sensors])
        deviation = 3 * [0.0 if scalar.all() else _or_infinite(array.common_field_T)]
        deviation += [_or_infinite(array.common_field_T) if scalar.any() else 0.0]
        deviation += 3 * [ambient_uncertainty_T if scalar.any() else 0.0]
        nuisances = np.flatnonzero(deviation)
        return cls(
            centroid=_read_only(array.centroid),
            sensors=_read_only(array.positions),
            ambient=_read_only(array.ambient_fields),
            scalar=_read_only(scalar),
            channel=_read_only(array.sensor_channels[:, 0]),
            axes=_read_only(array.channel_gain),
            rotations=_read_only(array.rotation_matrices),
            scales=_read_only(scales),
            noise=_read_only(array.channel_noise_T),
            uncertainty=_read_only(np.array([(s.misalignment_rad, s.gain_uncertainty) for s in array.sensors])),
            noise_fraction=float(array.noise_fraction),
            nuisances=_read_only(nuisances),
            prior=_read_only(1.0 / np.array(deviation)[nuisances]),
            varies=bool(scalar.any() or array.noise_depends_on_reading),
        )


class _Work(NamedTuple):
    """Arrays that are written anew for every source, and the products of the moments' components."""

    frame: FloatArray
    fields: FloatArray
    root: FloatArray
    columns: FloatArray
    factors: FloatArray
    gram: FloatArray
    whole: FloatArray
    forms: FloatArray
    squares: FloatArray
    entries: FloatArray


def table(model: BoundModel, positions: FloatArray, moments: FloatArray) -> FloatArray:
    """σ of range [m], bearing [rad] and position [m], shape (3, P, M), of positions (P, 3) with moments (M, 3)."""
    out = np.empty((len(positions), len(moments), 3))
    over_rows(_fill_table, len(positions), _read_only(positions), _read_only(moments), model, out)
    return np.ascontiguousarray(np.moveaxis(out, -1, 0))


def spreads(model: BoundModel, positions: FloatArray, moments: FloatArray, quantiles: FloatArray) -> FloatArray:
    """Mean, quantiles and greatest of each of the three σ over the moments, shape (P, 3, 2 + quantiles)."""
    out = np.empty((len(positions), 3, 2 + quantiles.size))
    ranks = np.ceil(quantiles * len(moments)).astype(np.intp) - 1
    over_rows(_fill_spreads, len(positions), _read_only(positions), _read_only(moments), model, ranks, out)
    return out


def _or_infinite(deviation: float | None) -> float:
    return math.inf if deviation is None else deviation


def _read_only(values: NDArray) -> NDArray:  # type: ignore[type-arg]
    """Contiguous and read-only: numba compiles again for each mix of both."""
    array = np.ascontiguousarray(values).view()
    array.setflags(write=False)
    return array


@compiled
def _work(model: BoundModel, moments: FloatArray) -> _Work:
    n_moments = moments.shape[0]
    squares = np.empty((6, n_moments))
    for j in range(n_moments):
        x, y, z = moments[j, 0], moments[j, 1], moments[j, 2]
        squares[0, j], squares[1, j], squares[2, j] = x * x, x * y, x * z
        squares[3, j], squares[4, j], squares[5, j] = y * y, y * z, z * z
    n_sensors, n_nuisances = model.sensors.shape[0], model.nuisances.size
    return _Work(
        np.empty((3, 3)),
        np.empty((n_sensors, 3)),
        np.empty((3, 3)),
        np.empty((model.noise.size + n_nuisances, n_nuisances + 9)),
        np.empty(n_nuisances + 9),
        np.empty((6, 6)),
        np.empty((6, 6)),
        np.empty((9, 6)),
        squares,
        np.empty((9, n_moments)),
    )


@compiled
def _frame(line: FloatArray, frame: FloatArray) -> float:
    """Axes u, v, n as rows, n along a line, and its length. Duff et al., "Building an orthonormal basis, revisited"."""
    length = math.sqrt(line[0] * line[0] + line[1] * line[1] + line[2] * line[2])
    x, y, z = line[0] / length, line[1] / length, line[2] / length
    sign = math.copysign(1.0, z)
    a = -1.0 / (sign + z)
    b = x * y * a
    frame[0, 0], frame[0, 1], frame[0, 2] = 1.0 + sign * x * x * a, sign * b, -sign * x
    frame[1, 0], frame[1, 1], frame[1, 2] = b, sign + y * y * a, -y
    frame[2, 0], frame[2, 1], frame[2, 2] = x, y, z
    return length


@compiled
def _square(vectors: FloatArray, i: int) -> float:
    return vectors[i, 0] * vectors[i, 0] + vectors[i, 1] * vectors[i, 1] + vectors[i, 2] * vectors[i, 2]


@compiled
def _turned(frame: FloatArray, x: float, y: float, z: float) -> tuple[float, float, float]:
    return (
        frame[0, 0] * x + frame[0, 1] * y + frame[0, 2] * z,
        frame[1, 0] * x + frame[1, 1] * y + frame[1, 2] * z,
        frame[2, 0] * x + frame[2, 1] * y + frame[2, 2] * z,
    )


@compiled
def _fill_columns(model: BoundModel, position: FloatArray, moment: FloatArray, work: _Work) -> None:
    """Columns of the nuisances, of the moment (3) and of the six, in units of the noise."""
    sensors, scalar, columns, fields = model.sensors, model.scalar, work.columns, work.fields
    n_channels, n_nuisances = model.noise.size, model.nuisances.size
    for j in range(n_nuisances + 9):
        for q in range(n_nuisances):
            columns[n_channels + q, j] = model.prior[q] if j == q else 0.0
    for s in range(sensors.shape[0]):
        dx, dy, dz = sensors[s, 0] - position[0], sensors[s, 1] - position[1], sensors[s, 2] - position[2]
        if model.varies:
            bx, by, bz = field_components(dx, dy, dz, moment[0], moment[1], moment[2])
            fields[s, 0], fields[s, 1] = bx + model.ambient[s, 0], by + model.ambient[s, 1]
            fields[s, 2] = bz + model.ambient[s, 2]
        du, dv, dn = _turned(work.frame, dx, dy, dz)
        first = model.channel[s]
        for c in range(first, first + (1 if scalar[s] else 3)):
            ax, ay, az = model.axes[c, 0], model.axes[c, 1], model.axes[c, 2]
            if scalar[s]:
                gain = ax / math.sqrt(_square(fields, s))
                ax, ay, az = gain * fields[s, 0], gain * fields[s, 1], gain * fields[s, 2]
            for q in range(n_nuisances):
                columns[c, q] = _effect(model.nuisances[q], scalar[s], ax, ay, az, model.axes[c, 0])
            au, av, an = _turned(work.frame, ax, ay, az)
            i = n_nuisances
            columns[c, i], columns[c, i + 1], columns[c, i + 2] = field_components(du, dv, dn, au, av, an)
            g = gradient_components(du, dv, dn, au, av, an)
            columns[c, i + 3], columns[c, i + 4], columns[c, i + 5] = g[0], g[1], g[2]
            columns[c, i + 6], columns[c, i + 7], columns[c, i + 8] = g[3], g[4], g[5]
    for s in range(sensors.shape[0]):
        _whiten(model, s, work)


@compiled
def _effect(nuisance: int, scalar: bool, ax: float, ay: float, az: float, gain: float) -> float:
    """What a channel of the axis a reads of a nuisance."""
    if nuisance == _COMMON_MODULUS:
        return gain if scalar else 0.0
    if nuisance < _COMMON_MODULUS and scalar:
        return 0.0
    component = nuisance - (_AMBIENT if nuisance >= _AMBIENT else _COMMON)
    if component == 0:
        return ax
    return ay if component == 1 else az


@compiled
def _whiten(model: BoundModel, s: int, work: _Work) -> None:
    """Divide the rows of one sensor by the root of their covariance, :func:`arrays.differences.reading_covariance`."""
    columns, root, fields, axes, first = work.columns, work.root, work.fields, model.axes, model.channel[s]
    n = 1 if model.scalar[s] else 3
    turn, gain = model.uncertainty[s, 0], model.uncertainty[s, 1]
    if turn == 0.0 and gain == 0.0 and model.noise_fraction == 0.0:
        for c in range(first, first + n):
            inverse = 1.0 / model.noise[c]
            for j in range(columns.shape[1]):
                columns[c, j] *= inverse
        return
    root[:] = 0.0
    proportional = 0.0
    if model.noise_fraction > 0.0:
        proportional = (model.noise_fraction * _deviation(model, s, work)) ** 2
    for i in range(n):
        root[i, i] = model.noise[first + i] ** 2 + proportional * _square(axes, first + i)
    if model.scalar[s]:
        root[0, 0] += gain * gain * axes[first, 0] ** 2 * _square(fields, s)
    elif turn > 0.0 or gain > 0.0:
        _add_calibration(model.rotations[s], model.scales[s], turn, gain, fields[s], root)
    for i in range(n):  # Cholesky, in place
        for j in range(i + 1):
            for k in range(j):
                root[i, j] -= root[i, k] * root[j, k]
            root[i, j] = math.sqrt(root[i, i]) if i == j else root[i, j] / root[j, j]
    for i in range(n):
        for k in range(i):
            for j in range(columns.shape[1]):
                columns[first + i, j] -= root[i, k] * columns[first + k, j]
        for j in range(columns.shape[1]):
            columns[first + i, j] /= root[i, i]


@compiled
def _add_calibration(
    rotation: FloatArray, scale: FloatArray, turn: float, gain: float, field: FloatArray, covariance: FloatArray
) -> None:
    """Add ``S (σ_θ² (|b|² I - b bᵀ) + σ_g² diag(b²)) Sᵀ`` with the field b in the sensor's axes."""
    b, error = np.empty(3), np.empty((3, 3))
    for k in range(3):
        b[k] = rotation[0, k] * field[0] + rotation[1, k] * field[1] + rotation[2, k] * field[2]
    square = b[0] * b[0] + b[1] * b[1] + b[2] * b[2]
    for i in range(3):
        for j in range(3):
            error[i, j] = -turn * turn * b[i] * b[j]
        error[i, i] += turn * turn * square + gain * gain * b[i] * b[i]
    for i in range(3):
        for j in range(3):
            for k in range(3):
                for m in range(3):
                    covariance[i, j] += scale[i, k] * error[k, m] * scale[j, m]


@compiled
def _deviation(model: BoundModel, s: int, work: _Work) -> float:
    """How much the field at a sensor, or its modulus, differs from the mean over the sensors of its kind."""
    fields, scalar = work.fields, model.scalar
    count, x, y, z = 0, 0.0, 0.0, 0.0
    for other in range(scalar.size):
        if scalar[other] == scalar[s]:
            count += 1
            if scalar[s]:
                x += math.sqrt(_square(fields, other))
            else:
                x, y, z = x + fields[other, 0], y + fields[other, 1], z + fields[other, 2]
    if scalar[s]:
        return abs(math.sqrt(_square(fields, s)) - x / count)
    x, y, z = fields[s, 0] - x / count, fields[s, 1] - y / count, fields[s, 2] - z / count
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _eliminate(work: _Work) -> None:
    """Gram matrix (6, 6) of the last six columns: at right angles to the nuisances (whole), and to the moment (gram).

    The columns themselves are turned (modified Gram-Schmidt), for the Gram matrix of all has half the digits.
    """
    columns = work.columns
    n_nuisances = columns.shape[1] - 9
    for k in range(n_nuisances):
        _project(columns, k, 0.0, work.factors)
    _fill_gram(columns, work.whole)
    x, y, z = 0.0, 0.0, 0.0
    for c in range(columns.shape[0]):
        x += columns[c, n_nuisances] ** 2
        y += columns[c, n_nuisances + 1] ** 2
        z += columns[c, n_nuisances + 2] ** 2
    _project(columns, n_nuisances, x, work.factors)
    _project(columns, n_nuisances + 1, y, work.factors)
    _project(columns, n_nuisances + 2, z, work.factors)
    _fill_gram(columns, work.gram)


# Sums over the rows keep their order, so the inner loops go over the columns: these can be vectorised.


@compiled
def _project(columns: FloatArray, k: int, before: float, factors: FloatArray) -> None:
    """Turn the columns behind column k to right angles to it, unless next to nothing is left of its square before."""
    n_rows, n_columns = columns.shape
    factors[:] = 0.0
    for c in range(n_rows):
        value = columns[c, k]
        for j in range(k, n_columns):
            factors[j] += value * columns[c, j]
    square = factors[k]
    if square <= LOST_INFORMATION * before:
        return
    for j in range(k + 1, n_columns):
        factors[j] /= square
    for c in range(n_rows):
        value = columns[c, k]
        for j in range(k + 1, n_columns):
            columns[c, j] -= value * factors[j]


@compiled
def _fill_gram(columns: FloatArray, gram: FloatArray) -> None:
    first = columns.shape[1] - 6
    gram[:] = 0.0
    for c in range(columns.shape[0]):
        for i in range(6):
            value = columns[c, first + i]
            for j in range(6):
                gram[i, j] += value * columns[c, first + j]


@compiled
def _fill_forms(gram: FloatArray, whole: FloatArray, frame: FloatArray, forms: FloatArray) -> None:
    """Coefficients (9, 6) of what is quadratic in the moment: six entries of the information, three of its bounds.

    The information about (u, v, n) is uu, uv, vv, un, vn, nn; the bounds are uu, vv, nn of what it would be for a known
    moment. They are multiplied by xx, xy, xz, yy, yz, zz of the moment, which is in the array's frame.
    """
    form, turned = np.empty((3, 3)), np.empty((3, 3))
    for entry in range(9):
        i, j = _ROWS[entry], _COLUMNS_OF[entry]
        of = gram if entry < 6 else whole
        for a in range(3):
            for b in range(3):
                form[a, b] = 0.5 * (of[_PAIR[i, a], _PAIR[j, b]] + of[_PAIR[i, b], _PAIR[j, a]])
        for a in range(3):
            for x in range(3):
                turned[a, x] = form[a, 0] * frame[0, x] + form[a, 1] * frame[1, x] + form[a, 2] * frame[2, x]
        for x in range(3):
            for y in range(x, 3):
                total = turned[0, y] * frame[0, x] + turned[1, y] * frame[1, x] + turned[2, y] * frame[2, x]
                forms[entry, _PAIR[x, y]] = total if x == y else 2.0 * total


@compiled
def _sigmas(
    length: float, uu: float, uv: float, vv: float, un: float, vn: float, nn: float, u: float, v: float, n: float
) -> tuple[float, float, float]:
    """σ of range, bearing and position from the information, and from what it would be for a known moment."""
    # LDLᵀ in this order leaves for n what it tells of the range when the bearing is not known.
    u_known = uu > LOST_INFORMATION * u
    l_vu = uv / uu if u_known else 0.0
    l_nu = un / uu if u_known else 0.0
    vv -= l_vu * uv
    v_known = vv > LOST_INFORMATION * v
    vn -= l_vu * un
    l_nv = vn / vv if v_known else 0.0
    nn -= l_nu * un + l_nv * vn
    n_known = nn > LOST_INFORMATION * n
    range_variance = 1.0 / nn if n_known else math.inf
    x_u = l_nu - l_vu * l_nv
    with_range = x_u * x_u + l_nv * l_nv  # how the bearing goes with the range
    across = 1.0 / uu + (1.0 + l_vu * l_vu) / vv if u_known and v_known else math.inf
    if n_known or with_range > LOST_INFORMATION:
        across += with_range * range_variance
    return math.sqrt(range_variance), math.sqrt(across) / length, math.sqrt(range_variance + across)


@compiled
def _sigmas_of_moments(
    model: BoundModel, position: FloatArray, moments: FloatArray, work: _Work, out: FloatArray
) -> None:
    """The three σ of one position for every moment, into out (M, 3)."""
    length = _frame(position - model.centroid, work.frame)
    if not (length > 0.0 and math.isfinite(length)):
        out[:] = math.nan
        return
    n_moments = moments.shape[0]
    # As many moments at once as have the same columns.
    step = 1 if model.varies else n_moments
    for begin in range(0, n_moments, step):
        _fill_columns(model, position, moments[begin], work)
        _eliminate(work)
        if not math.isfinite(work.whole[0, 0]):  # on a sensor
            out[:] = math.nan
            return
        _fill_forms(work.gram, work.whole, work.frame, work.forms)
        _fill_entries(work.forms, work.squares, begin, begin + step, work.entries)
    e = work.entries
    for j in range(n_moments):
        out[j, 0], out[j, 1], out[j, 2] = _sigmas(
            length, e[0, j], e[1, j], e[2, j], e[3, j], e[4, j], e[5, j], e[6, j], e[7, j], e[8, j]
        )


@compiled
def _fill_entries(forms: FloatArray, squares: FloatArray, begin: int, end: int, entries: FloatArray) -> None:
    """Apply the forms (9, 6) to some of the moments' squares (6, M)."""
    for i in range(9):
        xx, xy, xz, yy, yz, zz = forms[i, 0], forms[i, 1], forms[i, 2], forms[i, 3], forms[i, 4], forms[i, 5]
        for j in range(begin, end):
            entries[i, j] = (
                xx * squares[0, j] + xy * squares[1, j] + xz * squares[2, j]
                + yy * squares[3, j] + yz * squares[4, j] + zz * squares[5, j]
            )  # fmt: skip


@compiled
def _fill_table(
    begin: int, end: int, positions: FloatArray, moments: FloatArray, model: BoundModel, out: FloatArray
) -> None:
    work = _work(model, moments)
    for i in range(begin, end):
        _sigmas_of_moments(model, positions[i], moments, work, out[i])


@compiled
def _fill_spreads(
    begin: int,
    end: int,
    positions: FloatArray,
    moments: FloatArray,
    model: BoundModel,
    ranks: NDArray[np.intp],
    out: FloatArray,
) -> None:
    work = _work(model, moments)
    n_moments = moments.shape[0]
    sigmas, ordered = np.empty((n_moments, 3)), np.empty(n_moments)
    for i in range(begin, end):
        _sigmas_of_moments(model, positions[i], moments, work, sigmas)
        for quantity in range(3):
            total = 0.0
            for j in range(n_moments):
                ordered[j] = sigmas[j, quantity]
                total += ordered[j]
            if math.isnan(total):
                out[i, quantity] = math.nan
                continue
            ordered.sort()
            out[i, quantity, 0] = total / n_moments
            for k in range(ranks.size):
                out[i, quantity, 1 + k] = ordered[ranks[k]]
            out[i, quantity, 1 + ranks.size] = ordered[n_moments - 1]
