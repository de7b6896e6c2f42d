r"""Compiled information of one source for every moment, where neither axes nor noise depend on the moment.

The derivatives of a channel with the axis a follow from A a and the symmetric G(d; a), see
docs/theory/cramer-rao-bounds.md: nine columns, three of the former and six of the latter, hold them for **every**
moment. Before them stand the columns of the nuisances, each with a further row that holds its prior: what is left of
the six at right angles to all before them has a 6×6 Gram matrix K, with :math:`M_{ij} = \sum_{ab} m_a m_b K_{(ia)(jb)}`
the information about the position. It is formed once for a position; a moment then costs 100 operations.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from arrays.typing import FloatArray
from magloc.bounds.frame_compiled import LOST_INFORMATION, BoundModel, turned
from magloc.compilation import internal
from magloc.fields.dipole_compiled import field_components, gradient_components

# Place of (i, a) among the six entries xx, xy, xz, yy, yz, zz of a symmetric tensor.
_PAIR = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
# Rows and columns of the entries uu, uv, vv, un, vn, nn, and of uu, vv, nn.
_ROWS = np.array([0, 0, 1, 0, 1, 2, 0, 1, 2])
_COLUMNS_OF = np.array([0, 1, 1, 2, 2, 2, 0, 1, 2])


class Forms(NamedTuple):
    """Arrays that are written anew for every source, and the products of the moments' components."""

    columns: FloatArray
    factors: FloatArray
    gram: FloatArray
    whole: FloatArray
    forms: FloatArray
    squares: FloatArray


@internal
def new_forms(model: BoundModel, moments: FloatArray) -> Forms:
    """Workspaces for an array and some moments (M, 3)."""
    squares = np.empty((6, moments.shape[0]))
    for j in range(moments.shape[0]):
        x, y, z = moments[j, 0], moments[j, 1], moments[j, 2]
        squares[0, j], squares[1, j], squares[2, j] = x * x, x * y, x * z
        squares[3, j], squares[4, j], squares[5, j] = y * y, y * z, z * z
    n_nuisances = model.nuisances.size
    return Forms(
        np.empty((model.noise.size + n_nuisances, n_nuisances + 9)),
        np.empty(n_nuisances + 9),
        np.empty((6, 6)),
        np.empty((6, 6)),
        np.empty((9, 6)),
        squares,
    )


@internal
def fill_entries(model: BoundModel, position: FloatArray, frame: FloatArray, work: Forms, entries: FloatArray) -> None:
    """Information about (u, v, n) for every moment, into entries (9, M or more).

    Rows: uu, uv, vv, un, vn, nn; then uu, vv, nn of what it would be for a known moment.
    """
    _fill_columns(model, position, frame, work.columns)
    _eliminate(work)
    _fill_forms(work.gram, work.whole, frame, work.forms)
    forms, squares = work.forms, work.squares
    for i in range(9):
        xx, xy, xz, yy, yz, zz = forms[i, 0], forms[i, 1], forms[i, 2], forms[i, 3], forms[i, 4], forms[i, 5]
        for j in range(squares.shape[1]):
            entries[i, j] = (
                xx * squares[0, j] + xy * squares[1, j] + xz * squares[2, j]
                + yy * squares[3, j] + yz * squares[4, j] + zz * squares[5, j]
            )  # fmt: skip


@internal
def _fill_columns(model: BoundModel, position: FloatArray, frame: FloatArray, columns: FloatArray) -> None:
    """Columns of the nuisances, of the moment (3) and of the six, in units of the noise."""
    sensors, n_channels, n_nuisances = model.sensors, model.noise.size, model.nuisances.size
    for q in range(n_nuisances):
        for j in range(n_nuisances + 9):
            columns[n_channels + q, j] = model.prior[q] if j == q else 0.0
    for s in range(sensors.shape[0]):
        du, dv, dn = turned(
            frame, sensors[s, 0] - position[0], sensors[s, 1] - position[1], sensors[s, 2] - position[2]
        )
        first = model.channel[s]
        for c in range(first, first + 3):
            unit = 1.0 / model.noise[c]
            ax, ay, az = unit * model.axes[c, 0], unit * model.axes[c, 1], unit * model.axes[c, 2]
            if n_nuisances > 0:  # the three components of the common field
                columns[c, 0], columns[c, 1], columns[c, 2] = ax, ay, az
            au, av, an = turned(frame, ax, ay, az)
            i = n_nuisances
            columns[c, i], columns[c, i + 1], columns[c, i + 2] = field_components(du, dv, dn, au, av, an)
            g = gradient_components(du, dv, dn, au, av, an)
            columns[c, i + 3], columns[c, i + 4], columns[c, i + 5] = g[0], g[1], g[2]
            columns[c, i + 6], columns[c, i + 7], columns[c, i + 8] = g[3], g[4], g[5]


@internal
def _eliminate(work: Forms) -> None:
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


@internal
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


@internal
def _fill_gram(columns: FloatArray, gram: FloatArray) -> None:
    first = columns.shape[1] - 6
    gram[:] = 0.0
    for c in range(columns.shape[0]):
        for i in range(6):
            value = columns[c, first + i]
            for j in range(6):
                gram[i, j] += value * columns[c, first + j]


@internal
def _fill_forms(gram: FloatArray, whole: FloatArray, frame: FloatArray, forms: FloatArray) -> None:
    """Coefficients (9, 6) of xx, xy, xz, yy, yz, zz of the moment, array frame, in what :func:`fill_entries` writes."""
    form, turned_form = np.empty((3, 3)), np.empty((3, 3))
    for entry in range(9):
        i, j = _ROWS[entry], _COLUMNS_OF[entry]
        of = gram if entry < 6 else whole
        for a in range(3):
            for b in range(3):
                form[a, b] = 0.5 * (of[_PAIR[i, a], _PAIR[j, b]] + of[_PAIR[i, b], _PAIR[j, a]])
        for a in range(3):
            for x in range(3):
                turned_form[a, x] = form[a, 0] * frame[0, x] + form[a, 1] * frame[1, x] + form[a, 2] * frame[2, x]
        for x in range(3):
            for y in range(x, 3):
                total = turned_form[0, y] * frame[0, x] + turned_form[1, y] * frame[1, x]
                total += turned_form[2, y] * frame[2, x]
                forms[entry, _PAIR[x, y]] = total if x == y else 2.0 * total
