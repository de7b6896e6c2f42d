"""The filters of a convergence map on a graphics processor: its threads run the kernel that a processor's do.

A thread is a lane of :mod:`magloc.convergence.filters_compiled`, which holds the mathematics. The 32 lanes of a block
are the threads of a warp, so that the numbers which they read together lie side by side. Needs an NVIDIA device and
the CUDA toolkit's libNVVM, as numba does.
"""

from __future__ import annotations

import numpy as np
from numba import cuda
from numpy.typing import NDArray

from arrays.typing import FloatArray
from magloc.convergence.filters_compiled import Ends, Rules, Workspace, n_rows, run_every
from magloc.convergence.linearisation_compiled import Model
from magloc.convergence.workspace_compiled import LANES

_WARPS_PER_BLOCK = 2
_MOST_BLOCKS = 512  # as many as the registers of a large device hold, whose workspaces fill its cache


@cuda.jit
def run_lane(  # type: ignore[no-untyped-def]
    method, starts, rules, model, rows, fields, before, residuals, states, chi2, iterations, stopped
) -> None:
    """Every n-th start, with n the number of threads; the workspace (warps, …) has a part for each warp."""
    thread = cuda.grid(1)  # type: ignore[attr-defined]
    warp = thread // LANES
    space = Workspace(rows[warp], fields[warp], before[warp], residuals[warp])
    out = Ends(states, chi2, iterations, stopped)
    n_threads = cuda.gridsize(1)  # type: ignore[attr-defined]
    run_every(method, starts, thread, n_threads, rules, model, space, out, thread % LANES)


def check_device() -> None:
    """Refuse a machine without an NVIDIA device, its driver and libNVVM."""
    if not cuda.is_available():  # type: ignore[no-untyped-call]
        raise ValueError("Input device must be cpu where numba finds no NVIDIA device; instead received cuda.")


def run_on_device(
    method: int, starts: FloatArray, rules: Rules, model: Model
) -> tuple[FloatArray, FloatArray, NDArray[np.int64], NDArray[np.bool_]]:
    """States (n, 6), χ², iterations and whether the stop rule was met, for starts in the model's units."""
    check_device()
    n, threads = len(starts), _WARPS_PER_BLOCK * LANES
    n_blocks = min(_MOST_BLOCKS, -(-n // threads))
    warps = n_blocks * _WARPS_PER_BLOCK
    n_w, n_fields, n_residuals = n_rows(model)
    spaces = [cuda.device_array((warps, k * LANES)) for k in (n_w, max(n_fields, 1))]
    spaces += [cuda.to_device(np.zeros((warps, n_residuals * LANES))) for _ in range(2)]
    out = np.empty((n, 6)), np.empty(n), np.empty(n, np.int64), np.empty(n, np.bool_)
    run_lane[n_blocks, threads](method, starts, rules, model, *spaces, *out)
    return out
