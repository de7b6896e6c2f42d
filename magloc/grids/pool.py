"""Processes of this machine that compute beside each other."""

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
    """New interpreters of one thread each, ended at once where the block is left by an exception.

    A fork of a process with threads, such as those of compiled code, may never come back.
    """
    pool = ProcessPoolExecutor(processes, mp_context=get_context("spawn"), initializer=_prepare)
    try:
        yield pool
    except BaseException:
        for process in list((pool._processes or {}).values()):  # what a pool has no public name for before 3.14
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _prepare() -> None:
    """Settings of a process: one thread, and an interruption is the business of the process that started it."""
    core.set_threads(1)
    warnings.simplefilter("ignore")  # those of NumPy: what a user is told is logged
    one_blas_thread.__enter__()  # for good
    signal.signal(signal.SIGINT, signal.SIG_IGN)
