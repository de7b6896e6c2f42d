"""Whole maps: here or on a cluster, in memory or streamed to a store from which an interrupted one goes on."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

from arrays.io.errors import InputError
from magloc.grids.cluster import check_address, computed_by
from magloc.grids.cube import Box, Chunk, CubeMap, boxes, computed_here, in_memory
from magloc.grids.store import Sweep, open_map

if TYPE_CHECKING:
    import xarray as xr

_LOG = logging.getLogger(__name__)


def computed_map(
    cube: CubeMap,
    out: str | os.PathLike[str] | None = None,
    scheduler: str | None = None,
    progress: Callable[[int], None] | None = None,
) -> xr.Dataset:
    """All values of a map.

    Parameters
    ----------
    cube : CubeMap
    out : path-like, optional
        Folder of a zarr store: the map is written there chunk by chunk, what is there of the same map is not computed
        again, and the dataset is loaded piece by piece as it is used.
    scheduler : str, optional
        Address of a dask scheduler (tcp://HOST:PORT) whose workers compute the map.
    progress : callable, optional
        Called with the number of points finished since the last call, first of all with those that were there before.

    Returns
    -------
    xarray.Dataset
        Over (x, y, z), with attributes that reproduce the run.

    Raises
    ------
    InputError
        The store holds something else, or cannot be written; the scheduler or a worker failed. The text says what is
        done.
    """
    if scheduler is not None:
        check_address(scheduler)

    def chunks(wanted: Iterable[Box]) -> Iterator[Chunk]:
        return computed_here(cube, wanted) if scheduler is None else computed_by(scheduler, cube, wanted)

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
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted: {kept()}") from None
    except InputError as error:
        raise type(error)(f"{str(error).rstrip('.')}; {kept()}.") from None
    except OSError as error:
        raise InputError(f"{sweep.path} cannot be written ({error.strerror or error}); {kept()}.") from None
