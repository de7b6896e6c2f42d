"""How a program ends when it is interrupted: in order, while it still loads, too, and wherever that is raised."""

from __future__ import annotations

import gc
import importlib
import signal
import sys

INTERRUPTED = 130
TERMINATED = 143


def entered(program: str) -> int:
    """Run one command of ``magloc`` or ``adcs``: its exit status, or that of the signal which ended it.

    SIGTERM interrupts as Ctrl-C does, once, so that what is half done is taken away.
    """
    came: list[int] = []

    def interrupt(number: int, _: object) -> None:
        came.append(number)
        if number == signal.SIGINT or came.count(number) == 1:
            raise KeyboardInterrupt(*(["terminated"] if number == signal.SIGTERM else []))

    def swallowed(what: sys.UnraisableHookArgs) -> None:
        """An interruption comes again that was raised where none can be, as in a callback of the collector."""
        if issubclass(what.exc_type, KeyboardInterrupt):
            import _thread
            import threading

            threading.Timer(0.01, _thread.interrupt_main).start()
        elif not came:  # else it is what the interruption left half made
            sys.__unraisablehook__(what)

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
    gc.freeze()  # the interpreter looks for circles as it ends: half a second over all that numba holds
    if signal.SIGTERM in came:
        return TERMINATED
    return INTERRUPTED if came and status else status
