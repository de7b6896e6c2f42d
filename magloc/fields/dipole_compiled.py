"""Compiled dipole field, gradient tensor and Jacobian.

:mod:`magloc.fields.dipole` is the readable twin and has the formulas.

Two layers:

- ``*_components``: one dipole and one point in scalars, from the displacement d = s - p. Other kernels call these; two
  of them called with the same d share one square root and one division.
- ``*_at_points``: arrays of points, in parallel. Each point is summed over the dipoles in their order by one thread, so
  the result does not depend on the number of threads.

The arithmetic is that of the twin with n = d/r multiplied out, which saves three multiplications; the two agree to
rounding for distances from 1e-50 m to 1e50 m. On the source both are NaN.
"""

import numpy as np
from numba import prange
from numpy.typing import ArrayLike, NDArray

from magloc.compilation import compiled, compiled_parallel
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
    inv_r = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
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
    inv_r = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
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
    points, sources, moments = _points_and_dipoles(points, sources, moments)
    out = np.empty((len(points), 3))
    _fill_fields(points, sources, moments, out)
    return out


def gradient_at_points(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> Array:
    """Gradient tensor of K dipoles together at N points; twin of :func:`magloc.fields.dipole.total_gradient_tensor`.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Where the gradient is wanted, m.
    sources : array_like, shape (K, 3)
        Positions of the dipoles, m.
    moments : array_like, shape (K, 3)
        Moments of the dipoles, A m^2.

    Returns
    -------
    ndarray, shape (N, 3, 3)
        Gradient tensor in T/m; NaN on any of the sources, zero for K = 0.

    Raises
    ------
    ValueError
        If an argument has another shape, or the numbers of sources and moments differ.
    """
    points, sources, moments = _points_and_dipoles(points, sources, moments)
    out = np.empty((len(points), 3, 3))
    _fill_gradients(points, sources, moments, out)
    return out


def jacobian_at_points(points: ArrayLike, source: ArrayLike, moment: ArrayLike) -> Array:
    """Jacobian [dB/dp, dB/dm] of one dipole's field at N points; twin of :func:`magloc.fields.dipole.field_jacobian`.

    Parameters
    ----------
    points : array_like, shape (N, 3)
        Where the field is observed, m.
    source : array_like, shape (3,)
        Position p of the dipole, m.
    moment : array_like, shape (3,)
        Moment m of the dipole, A m^2.

    Returns
    -------
    ndarray, shape (N, 3, 6)
        The first three columns in T/m, the last three in T/(A m^2); NaN on the source.

    Raises
    ------
    ValueError
        If an argument has another shape.
    """
    points = _kernel_input("points", points, ("N", 3))
    source = _kernel_input("source", source, (3,))
    moment = _kernel_input("moment", moment, (3,))
    out = np.empty((len(points), 3, 6))
    _fill_jacobians(points, source, moment, out)
    return out


def _points_and_dipoles(points: ArrayLike, sources: ArrayLike, moments: ArrayLike) -> tuple[Array, Array, Array]:
    """Check the inputs of a sum over dipoles, and return them as kernel inputs."""
    p = _kernel_input("sources", sources, ("K", 3))
    m = _kernel_input("moments", moments, ("K", 3))
    if len(p) != len(m):
        raise ValueError(
            f"Inputs sources and moments must have the same length; instead received {len(p)} and {len(m)}."
        )
    return _kernel_input("points", points, ("N", 3)), p, m


def _kernel_input(name: str, values: ArrayLike, shape: tuple[str, int] | tuple[int]) -> Array:
    """Return values as a contiguous, read-only float array of the given shape, where a letter stands for any length."""
    array = np.asarray(values, dtype=np.float64, order="C")
    if array.ndim != len(shape) or array.shape[-1] != shape[-1]:
        wanted = "(3,)" if len(shape) == 1 else f"({shape[0]}, 3)"
        raise ValueError(f"Input {name} must have shape {wanted}; instead received shape {array.shape}.")
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


@compiled_parallel
def _fill_gradients(points: Array, sources: Array, moments: Array, out: Array) -> None:
    """Write the gradient tensors at points (N, 3) to out (N, 3, 3), block by block."""
    n_blocks = -(-len(points) // BLOCK)
    if n_blocks == 1:
        _fill_gradient_block(points, sources, moments, out)
        return
    for block in prange(n_blocks):
        span = slice(BLOCK * block, BLOCK * (block + 1))
        _fill_gradient_block(points[span], sources, moments, out[span])


@compiled_parallel
def _fill_jacobians(points: Array, source: Array, moment: Array, out: Array) -> None:
    """Write the Jacobians at points (N, 3) to out (N, 3, 6), block by block."""
    n_blocks = -(-len(points) // BLOCK)
    if n_blocks == 1:
        _fill_jacobian_block(points, source, moment, out)
        return
    for block in prange(n_blocks):
        span = slice(BLOCK * block, BLOCK * (block + 1))
        _fill_jacobian_block(points[span], source, moment, out[span])


@compiled
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


@compiled
def _fill_gradient_block(points: Array, sources: Array, moments: Array, out: Array) -> None:
    """Write the gradient tensors at up to BLOCK points."""
    n = len(points)
    xyz, flat = points.reshape(-1), out.reshape(-1)  # LLVM vectorises strides in one dimension only
    work = np.empty(9 * ROW)  # x, y, z, gxx, gxy, gxz, gyy, gyz, gzz
    for i in range(n):
        work[i] = xyz[3 * i]
        work[ROW + i] = xyz[3 * i + 1]
        work[2 * ROW + i] = xyz[3 * i + 2]
    work[3 * ROW :] = 0.0
    for k in range(sources.shape[0]):
        px, py, pz = sources[k, 0], sources[k, 1], sources[k, 2]
        mx, my, mz = moments[k, 0], moments[k, 1], moments[k, 2]
        for i in range(n):
            gxx, gxy, gxz, gyy, gyz, gzz = gradient_components(
                work[i] - px, work[ROW + i] - py, work[2 * ROW + i] - pz, mx, my, mz
            )
            work[3 * ROW + i] += gxx
            work[4 * ROW + i] += gxy
            work[5 * ROW + i] += gxz
            work[6 * ROW + i] += gyy
            work[7 * ROW + i] += gyz
            work[8 * ROW + i] += gzz
    for i in range(n):
        flat[9 * i] = work[3 * ROW + i]
        flat[9 * i + 1] = flat[9 * i + 3] = work[4 * ROW + i]
        flat[9 * i + 2] = flat[9 * i + 6] = work[5 * ROW + i]
        flat[9 * i + 4] = work[6 * ROW + i]
        flat[9 * i + 5] = flat[9 * i + 7] = work[7 * ROW + i]
        flat[9 * i + 8] = work[8 * ROW + i]


@compiled
def _fill_jacobian_block(points: Array, source: Array, moment: Array, out: Array) -> None:
    """Write the Jacobians at up to BLOCK points."""
    xyz, flat = points.reshape(-1), out.reshape(-1)
    for i in range(len(points)):
        dx, dy, dz = xyz[3 * i] - source[0], xyz[3 * i + 1] - source[1], xyz[3 * i + 2] - source[2]
        gxx, gxy, gxz, gyy, gyz, gzz = gradient_components(dx, dy, dz, moment[0], moment[1], moment[2])
        axx, axy, axz, ayy, ayz, azz = field_matrix_components(dx, dy, dz)
        flat[18 * i + 0], flat[18 * i + 1], flat[18 * i + 2] = -gxx, -gxy, -gxz
        flat[18 * i + 3], flat[18 * i + 4], flat[18 * i + 5] = axx, axy, axz
        flat[18 * i + 6], flat[18 * i + 7], flat[18 * i + 8] = -gxy, -gyy, -gyz
        flat[18 * i + 9], flat[18 * i + 10], flat[18 * i + 11] = axy, ayy, ayz
        flat[18 * i + 12], flat[18 * i + 13], flat[18 * i + 14] = -gxz, -gyz, -gzz
        flat[18 * i + 15], flat[18 * i + 16], flat[18 * i + 17] = axz, ayz, azz
