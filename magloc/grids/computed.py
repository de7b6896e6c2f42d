"""Whole maps: here or on a cluster, in memory or streamed to a store from which an interrupted one goes on."""

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
    """All values of a map over (x, y, z), here, in a zarr store that resumes, or by the workers of a scheduler.

    `out` is the store's folder: what is there of the same map is not computed again, and the dataset is loaded piece by
    piece. `progress` is called with the number of points finished since the last call, at first with those in the
    store.
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
    """Write chunks as they are computed; however that ends, say how to go on."""

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
