"""Compiled dipole field and gradient tensor.

:mod:`magloc.fields.dipole` is the readable twin and has the formulas.

Two layers:

- ``*_components``: one dipole and one point in scalars, from the displacement d = s - p. Other kernels call these; two
  of them called with the same d share one square root and one division.
- :func:`field_at_points`: arrays of points, in parallel. Each point is summed over the dipoles in their order by one
  thread, so the result does not depend on the number of threads.

The arithmetic is that of the twin with n = d/r multiplied out, which saves three multiplications; the two agree to
rounding for distances from 1e-50 m to 1e50 m. On the source both are NaN.
"""

import math

import numpy as np
from numba import prange
from numpy.typing import ArrayLike, NDArray

from magloc.compilation import compiled, compiled_parallel, internal
from magloc.fields.dipole import MU0_OVER_4PI

Array = NDArray[np.float64]
SymmetricComponents = tuple[float, float, float, float, float, float]
# Points are worked through in blocks: the workspace of a block stays in the first-level cache, and one block is what a
# thread takes at a time. A row of the workspace holds one quantity for all points of a block, and all rows lie in one
# flat array at offsets known to the compiler, which can then see that they do not overlap, and vectorise. A row is
# longer than a block by one cache line, lest the rows compete for the same cache sets.
BLOCK = 256
ROW = BLOCK + 8


@compiled
def field_components(dx: float, dy: float, dz: float, mx: float, my: float, mz: float) -> tuple[float, float, float]:
    """Induction (bx, by, bz) in T at the displacement d (m) from a dipole of moment m (A m^2), equation (2)."""
    inv_r = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
    inv_r2 = inv_r * inv_r
    scale = MU0_OVER_4PI * inv_r2 * inv_r
    radial = 3.0 * (dx * mx + dy * my + dz * mz) * inv_r2
    return scale * (radial * dx - mx), scale * (radial * dy - my), scale * (radial * dz - mz)


@compiled
def field_matrix_components(dx: float, dy: float, dz: float) -> SymmetricComponents:
    """Matrix A with B = A m at the displacement d (m), in T/(A m^2), as (xx, xy, xz, yy, yz, zz), equation (2)."""
    inv_r = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    inv_r2 = inv_r * inv_r
    scale = MU0_OVER_4PI * inv_r2 * inv_r
    x = 3.0 * inv_r2 * dx
    y = 3.0 * inv_r2 * dy
    z = 3.0 * inv_r2 * dz
    return (
        scale * (x * dx - 1.0),
        scale * (x * dy),
        scale * (x * dz),
        scale * (y * dy - 1.0),
        scale * (y * dz),
        scale * (z * dz - 1.0),
    )


@compiled
def gradient_components(dx: float, dy: float, dz: float, mx: float, my: float, mz: float) -> SymmetricComponents:
    """Gradient tensor in T/m at the displacement d (m) from a dipole, as (xx, xy, xz, yy, yz, zz), equation (3)."""
    inv_r = 1.0 / math.sqrt(dx * dx + dy * dy + dz * dz)
    inv_r2 = inv_r * inv_r
    scale = 3.0 * MU0_OVER_4PI * inv_r2 * inv_r2 * inv_r
    radial = dx * mx + dy * my + dz * mz
    five = 5.0 * radial * inv_r2
    # m - 5 (n.m) n, the vector that is multiplied by d in each component
    x = mx - five * dx
    y = my - five * dy
    z = mz - five * dz
    return (
        scale * (radial + dx * (x + mx)),
        scale * (dx * my + dy * x),
        scale * (dx * mz + dz * x),
        scale * (radial + dy * (y + my)),
        scale * (dy * mz + dz * y),
        scale * (radial + dz * (z + mz)),
    )


def field_at_points(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> Array:
    """
    Induction of K dipoles together at N points; compiled twin of :func:`magloc.fields.dipole.total_field`.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Where the field is wanted, m.
    sources : array_like, shape (K, 3)
        Positions of the dipoles, m.
    moments : array_like, shape (K, 3)
        Moments of the dipoles, A m^2.

    Returns
    -------
    ndarray, shape (N, 3)
        Induction in T; NaN on any of the sources, zero for K = 0.

    Raises
    ------
    ValueError
        If an argument has another shape, or the numbers of sources and moments differ.
    """
    s, p, m = _rows("points", points, "N"), _rows("sources", sources, "K"), _rows("moments", moments, "K")
    if len(p) != len(m):
        raise ValueError(
            f"Inputs sources and moments must have the same length; instead received {len(p)} and {len(m)}."
        )
    out = np.empty((len(s), 3))
    _fill_fields(s, p, m, out)
    return out


def gradient_at_points(points: Array, sources: Array, moments: Array) -> Array:
    """Gradient tensors (N, 3, 3) at points of dipoles together; twin of :func:`dipole.total_gradient_tensor`."""
    out = np.zeros((len(points), 3, 3))
    _fill_gradients(_rows("points", points, "N"), _rows("sources", sources, "K"), _rows("moments", moments, "K"), out)
    return out


@compiled_parallel
def _fill_gradients(points: Array, sources: Array, moments: Array, out: Array) -> None:
    """Add the gradients at points (N, 3) to out (N, 3, 3)."""
    for i in prange(len(points)):
        G = out[i]
        for k in range(len(sources)):
            x, y, z = points[i, 0] - sources[k, 0], points[i, 1] - sources[k, 1], points[i, 2] - sources[k, 2]
            xx, xy, xz, yy, yz, zz = gradient_components(x, y, z, moments[k, 0], moments[k, 1], moments[k, 2])
            G[0, 0] += xx
            G[0, 1] += xy
            G[0, 2] += xz
            G[1, 1] += yy
            G[1, 2] += yz
            G[2, 2] += zz
        G[1, 0], G[2, 0], G[2, 1] = G[0, 1], G[0, 2], G[1, 2]


def _rows(name: str, values: ArrayLike, n: str) -> Array:
    """Return values as a contiguous, read-only float array of shape (n, 3)."""
    array = np.asarray(values, dtype=np.float64, order="C")
    if array.ndim != 2 or array.shape[-1] != 3:
        raise ValueError(f"Input {name} must have shape ({n}, 3); instead received shape {array.shape}.")
    # numba compiles again for each mix of writable and read-only arguments: all read-only is one version.
    array = array.view()
    array.setflags(write=False)
    return array


@compiled_parallel
def _fill_fields(points: Array, sources: Array, moments: Array, out: Array) -> None:
    """Write the fields at points (N, 3) to out (N, 3), block by block."""
    n_blocks = -(-len(points) // BLOCK)
    if n_blocks == 1:  # waking the threads takes longer than a block
        _fill_field_block(points, sources, moments, out)
        return
    for block in prange(n_blocks):
        span = slice(BLOCK * block, BLOCK * (block + 1))
        _fill_field_block(points[span], sources, moments, out[span])


@internal
def _fill_field_block(points: Array, sources: Array, moments: Array, out: Array) -> None:
    """Write the fields at up to BLOCK points."""
    n = len(points)
    xyz, flat = points.reshape(-1), out.reshape(-1)  # LLVM vectorises strides in one dimension only
    work = np.empty(6 * ROW)  # x, y, z, bx, by, bz
    for i in range(n):
        work[i] = xyz[3 * i]
        work[ROW + i] = xyz[3 * i + 1]
        work[2 * ROW + i] = xyz[3 * i + 2]
    work[3 * ROW :] = 0.0
    for k in range(sources.shape[0]):
        px, py, pz = sources[k, 0], sources[k, 1], sources[k, 2]
        mx, my, mz = moments[k, 0], moments[k, 1], moments[k, 2]
        for i in range(n):
            bx, by, bz = field_components(work[i] - px, work[ROW + i] - py, work[2 * ROW + i] - pz, mx, my, mz)
            work[3 * ROW + i] += bx
            work[4 * ROW + i] += by
            work[5 * ROW + i] += bz
    for i in range(n):
        flat[3 * i] = work[3 * ROW + i]
        flat[3 * i + 1] = work[4 * ROW + i]
        flat[3 * i + 2] = work[5 * ROW + i]
