"""Computation of boxes of a map, or other work, by the workers of a dask cluster.

The results return to this process, and only this process writes them. So workers need magloc, but no shared disk.
"""

from __future__ import annotations

import asyncio
import logging
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from itertools import islice
from typing import Any, TypeVar

from arrays.blas_threads import one_blas_thread
from arrays.io.errors import InputError, of_extra
from magloc import core

Item = TypeVar("Item")
Result = TypeVar("Result")
# Items sent to each worker: one that it computes, and the next one.
_PER_WORKER = 2
# Addresses with TLS also need dask's own configuration.
_ADDRESS = re.compile(r"(?:(?:tcp|tls)://)?(?:[^\s/:@\[\]]+|\[[0-9a-fA-F:.]+\]):(?P<port>[0-9]{1,5})")
_LARGEST_PORT = 65535
# A process computes one chunk at a time, with all its threads.
_one_chunk = threading.Lock()


def check_address(scheduler: str) -> None:
    """Raise InputError if a text cannot be the address of a scheduler."""
    address = _ADDRESS.fullmatch(scheduler)
    if address is None or not 0 < int(address["port"]) <= _LARGEST_PORT:
        raise InputError(f"Input scheduler: found {scheduler!r}, expected tcp://HOST:PORT or HOST:PORT.")


def worked_by(
    scheduler: str, work: Callable[[Item], Result], items: Iterable[Item], timeout_s: float = 10.0
) -> Iterator[Result]:
    """Yield results of the workers of a dask scheduler in the order in which they finish.

    Each worker has a few items at any time.
    """
    check_address(scheduler)
    with of_extra("cluster", "a scheduler"):
        from distributed import as_completed
    waiting = iter(items)
    with _client(scheduler, timeout_s) as client:
        try:
            running = as_completed(loop=client.loop)
            while True:
                for item in islice(waiting, max(0, _PER_WORKER * len(client.nthreads()) - running.count())):
                    running.add(client.submit(_by_worker, work, item, pure=False))
                if running.is_empty():
                    return
                yield next(running).result()
        except (CancelledError, OSError):
            raise InputError(f"Input scheduler {scheduler}: the connection to the scheduler was lost.") from None
        except Exception as error:
            raise InputError(f"Input scheduler {scheduler}: a worker failed: {error!r}.") from None


def _by_worker(work: Callable[[Item], Result], item: Item) -> Result:
    from distributed import get_worker

    with _one_chunk, one_blas_thread:
        core.set_threads(get_worker().state.nthreads)
        return work(item)


@contextmanager
def _client(scheduler: str, timeout_s: float) -> Iterator[Any]:
    """Connect to a scheduler that has workers; a lost connection is not logged."""
    from distributed import Client

    logger = logging.getLogger("distributed")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        _check_answer(scheduler, timeout_s)
        try:
            client = Client(scheduler, timeout=timeout_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise InputError(f"Input scheduler {scheduler}: found no scheduler there ({error}).") from None
        with client:
            try:
                client.wait_for_workers(1, timeout=timeout_s)
            except TimeoutError:
                raise InputError(f"Input scheduler {scheduler}: found no workers within {timeout_s:g} s.") from None
            yield client
    finally:
        logger.setLevel(level)


def _check_answer(scheduler: str, timeout_s: float) -> None:
    """Raise InputError if no scheduler answers at an address.

    The check does not use dask's client: a client that cannot connect waits when it is deleted, and prints a traceback.
    """
    from distributed import Security, rpc

    try:
        by_tls = Security().get_connection_args("client")  # TLS settings in dask's own configuration
    except OSError as error:
        raise InputError(f"Input scheduler {scheduler}: dask's certificates cannot be read ({error}).") from None
    if scheduler.startswith("tls:") and by_tls["ssl_context"] is None:
        raise InputError(
            f"Input scheduler {scheduler}: found no certificates, expected some in dask's distributed.comm.tls."
        )

    async def answer() -> object:
        async with rpc(scheduler, timeout=timeout_s, connection_args=by_tls) as there:
            return (await there.identity())["type"]

    async def answer_in_time() -> object:
        return await asyncio.wait_for(answer(), timeout_s)

    try:
        found = asyncio.run(answer_in_time())
    except TimeoutError:
        raise InputError(
            f"Input scheduler {scheduler}: found no scheduler there (no answer within {timeout_s:g} s)."
        ) from None
    except OSError as error:
        raise InputError(f"Input scheduler {scheduler}: found no scheduler there ({error}).") from None
    except Exception:  # the answer of another service may raise any error in dask
        raise InputError(f"Input scheduler {scheduler}: found another service there, expected a scheduler.") from None
    if found != "Scheduler":
        raise InputError(f"Input scheduler {scheduler}: found a {found} of dask there, expected a scheduler.")
