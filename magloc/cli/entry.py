"""Begin and end of a program: one thread of BLAS, and an orderly end after a signal.

This module imports only what the interpreter has loaded already, so that the handlers exist before anything else loads.
An earlier signal ends the process as the system does.
"""

from __future__ import annotations

import gc
import importlib
import os
import signal
import sys
import time
from types import FrameType

INTERRUPTED = 130
TERMINATED = 143
# On small matrices the threads of BLAS mostly wait for each other. A choice of the user stays.
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
# The command `timeout` sends its signal twice, to the process and to its group; a user takes longer for a second one.
_SAME_SIGNAL_S = 0.05


def run_program(program: str) -> int:
    """Run one command of ``magloc`` or ``adcs``, and return its exit status or that of a signal.

    The first SIGINT or SIGTERM interrupts the command, which removes unfinished files. The next one ends the process.
    """
    for name in _BLAS_THREADS:
        os.environ.setdefault(name, "1")
    received: dict[int, float] = {}
    repeats: list[bool] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not repeats and received:
            if time.monotonic() - min(received.values()) > _SAME_SIGNAL_S:
                os._exit(128 + number)
            return
        if not repeats:
            received[number] = time.monotonic()
        repeats.clear()
        _raise_outside_imports(frame, *(["terminated"] if signal.SIGTERM in received else []))

    def repeat_swallowed(unraisable: sys.UnraisableHookArgs) -> None:
        """Repeat an interruption that was raised where none can be, as in a callback of the collector."""
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            import _thread
            import threading

            repeats.append(True)
            threading.Timer(0.01, _thread.interrupt_main).start()
        elif not received:  # else it follows from the interruption
            sys.__unraisablehook__(unraisable)

    numbers = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    for number in numbers:
        signal.signal(number, interrupt)
    sys.unraisablehook = repeat_swallowed
    status = INTERRUPTED
    try:
        status = importlib.import_module(f"{program}.cli.app").main()
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)  # only the interpreter's shutdown remains
    except (Exception, KeyboardInterrupt) as error:  # an interruption while an extension loads is an ImportError
        if not received and isinstance(error, Exception):
            raise
        print(f"{program}: {'terminated' if signal.SIGTERM in received else 'interrupted'}", file=sys.stderr)
    gc.freeze()  # else the interpreter looks for cycles among all modules at its end
    if signal.SIGTERM in received:
        return TERMINATED
    return INTERRUPTED if received and status else status


def _raise_outside_imports(frame: FrameType | None, *text: str) -> None:
    """Raise KeyboardInterrupt, after the end of a running import: modules swallow it while they load."""
    importing = None
    while frame is not None and frame.f_code is not run_program.__code__:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>" and frame.f_code.co_name == "_find_and_load":
            importing = frame
        frame = frame.f_back
    if importing is None:
        raise KeyboardInterrupt(*text)

    def after(frame: FrameType, event: str, _: object) -> None:
        if frame is importing and event == "return":
            sys.setprofile(None)
            raise KeyboardInterrupt(*text)

    sys.setprofile(after)
