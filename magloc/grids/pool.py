"""Parallel processes on this machine."""

from __future__ import annotations

import signal
import warnings
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context

from arrays.blas_threads import one_blas_thread
from magloc import core


@contextmanager
def process_pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """Start interpreters of one thread each; an exception in the block ends them at once.

    They are not forked: a fork of a process with threads, such as those of compiled code, may hang.
    """
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_prepare)
    try:
        yield pool
    except BaseException:
        for process in list((pool._processes or {}).values()):  # no public name before Python 3.14
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    """Limit a process to one thread, and leave interruptions to the process that started it."""
    core.set_threads(1)
    warnings.simplefilter("ignore")  # NumPy's warnings; messages for users are logged
    one_blas_thread.__enter__()  # never left: the limit lasts as long as the process
    signal.signal(signal.SIGINT, signal.SIG_IGN)
