"""How a program begins and ends: Ctrl-C ends it in order while it still loads, too, and wherever it is raised."""

from __future__ import annotations

import importlib
import signal
import sys


def entered(program: str) -> int:
    """Run one command of ``magloc`` or ``adcs``; its exit status."""
    sys.unraisablehook = _come_again
    try:
        status: int = importlib.import_module(f"{program}.cli.app").main()
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # what is left is the interpreter's own end
    except KeyboardInterrupt:
        print(f"{program}: interrupted", file=sys.stderr)
        return 130
    return status


def _come_again(swallowed: sys.UnraisableHookArgs) -> None:
    """Let an interruption come once more that was raised where none can be, as in a callback of the collector."""
    if not issubclass(swallowed.exc_type, KeyboardInterrupt):
        sys.__unraisablehook__(swallowed)
        return
    import _thread
    import threading

    threading.Timer(0.01, _thread.interrupt_main).start()
