"""Computation of whole maps: here or on a cluster, in memory or streamed to a store that can resume."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable
from functools import partial
from typing import TYPE_CHECKING

from arrays.io.errors import InputError
from magloc.grids.cube import Chunk, CubeMap, boxes, computed, in_memory
from magloc.grids.store import Sweep, open_map
from magloc.grids.work import runner

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)


def computed_map(
    cube: CubeMap,
    out: str | os.PathLike[str] | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """Compute all values of a map over (x, y, z), here or by the workers of a scheduler.

    `out` is the folder of a zarr store, or None for a map in memory. Finished parts of the same map in the store are
    not computed again, and the dataset is loaded piece by piece. `progress` is called with the number of points
    finished since the last call; the first call counts those in the store.
    """
    chunks = partial(runner(scheduler), partial(computed, cube))
    if out is None:
        return in_memory(cube, progress, chunks(boxes(cube)))
    with Sweep(cube, out) as sweep:
        for sentence in sweep.unreadable:
            _LOG.info(sentence)
        if progress is not None:
            progress(sweep.points_done)
        if sweep.chunks_done < sweep.n_chunks:
            _write(sweep, chunks(sweep.unfinished()), progress)
    return open_map(out)


def _write(sweep: Sweep, chunks: Iterable[Chunk], progress: Callable[[int], None] | None) -> None:
    """Write chunks as they are computed; if that is interrupted or fails, state how to resume."""

    def kept() -> str:
        return f"{sweep.chunks_done} of {sweep.n_chunks} chunks are done, the same command goes on with the others"

    try:
        sweep.write(chunks, progress)
    except KeyboardInterrupt as interruption:
        raise KeyboardInterrupt(f"{str(interruption) or 'interrupted'}: {kept()}") from None
    except InputError as error:
        raise type(error)(f"{str(error).rstrip('.')}; {kept()}.") from None
    except OSError as error:
        raise InputError(f"{sweep.path} cannot be written ({error.strerror or error}); {kept()}.") from None
