"""How a program begins and ends: one thread of BLAS, and an orderly end where a signal interrupts it.

Only what the interpreter itself has loaded is imported here, so that the handlers stand before anything else loads.
What comes earlier, while the interpreter starts, ends the process as the system does.
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
# The threads of BLAS do little but wait for each other over small matrices; a choice of the user stays.
_BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")
# `timeout` sends its signal twice, to the process and to its group; a user who insists takes longer.
_SAME_SIGNAL_S = 0.05


def entered(program: str) -> int:
    """Run one command of ``magloc`` or ``adcs``: its exit status, or that of the signal which ended it.

    The first SIGINT or SIGTERM interrupts, so that what is half done is taken away; the next one ends the process.
    """
    for name in _BLAS_THREADS:
        os.environ.setdefault(name, "1")
    came: dict[int, float] = {}
    again: list[bool] = []

    def interrupt(number: int, frame: FrameType | None) -> None:
        if not again and came:
            if time.monotonic() - min(came.values()) > _SAME_SIGNAL_S:
                os._exit(128 + number)
            return
        if not again:
            came[number] = time.monotonic()
        again.clear()
        _raise_outside_imports(frame, *(["terminated"] if signal.SIGTERM in came else []))

    def swallowed(unraisable: sys.UnraisableHookArgs) -> None:
        """An interruption comes again that was raised where none can be, as in a callback of the collector."""
        if issubclass(unraisable.exc_type, KeyboardInterrupt):
            import _thread
            import threading

            again.append(True)
            threading.Timer(0.01, _thread.interrupt_main).start()
        elif not came:  # else it is what the interruption left half made
            sys.__unraisablehook__(unraisable)

    numbers = [number for number in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(number) != signal.SIG_IGN]
    for number in numbers:
        signal.signal(number, interrupt)
    sys.unraisablehook = swallowed
    status = INTERRUPTED
    try:
        status = importlib.import_module(f"{program}.cli.app").main()
        for number in numbers:
            signal.signal(number, signal.SIG_DFL)  # what is left is the interpreter's own end
    except (Exception, KeyboardInterrupt) as error:  # an extension that does not load because of it is an ImportError
        if not came and isinstance(error, Exception):
            raise
        print(f"{program}: {'terminated' if signal.SIGTERM in came else 'interrupted'}", file=sys.stderr)
    gc.freeze()  # else the interpreter looks for circles among all modules as it ends
    if signal.SIGTERM in came:
        return TERMINATED
    return INTERRUPTED if came and status else status


def _raise_outside_imports(frame: FrameType | None, *said: str) -> None:
    """Raise KeyboardInterrupt, inside an import only when it is over: modules swallow it while they load."""
    importing = None
    while frame is not None and frame.f_code is not entered.__code__:
        if frame.f_code.co_filename == "<frozen importlib._bootstrap>" and frame.f_code.co_name == "_find_and_load":
            importing = frame
        frame = frame.f_back
    if importing is None:
        raise KeyboardInterrupt(*said)

    def after(frame: FrameType, event: str, _: object) -> None:
        if frame is importing and event == "return":
            sys.setprofile(None)
            raise KeyboardInterrupt(*said)

    sys.setprofile(after)
