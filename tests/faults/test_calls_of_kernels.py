"""Calls of kernels after a fork, in two threads at once, and interrupted.

Each runs in a process of its own, with a time limit.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from tests.conftest import REPOSITORY

LIMIT_S = 240.0
MAP = """
import os, sys, threading
import arrays, magloc

array, source = arrays.tetrahedron(1.0), magloc.Source((5.0, 4.0, 3.0), (100.0, 0.0, 0.0))

def compute():
    magloc.convergence_map(array, source, n=5)

compute()
"""
FORK = """
child = os.fork()
if not child:
    compute()
    os._exit(0)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
THREADS = """
threads = [threading.Thread(target=lambda: [compute() for _ in range(50)]) for _ in range(2)]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join()
"""
# Ctrl-C at the first call of every function that a track calls, those of libraries first.
INTERRUPTED = """
import signal, sys
import magloc

board = magloc.datasets.load("board")

def run(watch):
    sys.setprofile(watch)
    try:
        magloc.track_sources(board.array, board.readings[:3], sources=2)
    finally:
        sys.setprofile(None)

called = {}
run(lambda frame, event, _: called.setdefault(frame.f_code) if event == "call" else None)
called = {}
run(lambda frame, event, _: called.setdefault(frame.f_code) if event == "call" else None)  # loaded
ours = lambda code: "magloc" in code.co_filename
for code in sorted(called, key=ours)[::EVERY]:
    sent = []
    def interrupt(frame, event, _):
        if event == "call" and frame.f_code is code:
            sys.setprofile(None)
            sent.append(code)
            signal.raise_signal(signal.SIGINT)
    try:
        run(interrupt)
    except KeyboardInterrupt:
        continue
    assert not sent, f"swallowed in {code}"
"""

pytestmark = pytest.mark.skipif(os.name != "posix", reason="needs signals and fork")


def status_of(program: str) -> int:
    """Exit status of a program; one that does not end in time is killed, with its children."""
    with subprocess.Popen(
        [sys.executable, "-c", program],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    ) as process:
        try:
            return process.wait(LIMIT_S)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return process.wait()


def test_a_map_after_a_fork() -> None:
    assert status_of(MAP + FORK) == 0


def test_two_threads_without_openmp() -> None:
    assert status_of(MAP + THREADS) == 0


@pytest.mark.parametrize("every", [5, pytest.param(1, marks=pytest.mark.slow)])
def test_an_interruption_stays_one(every: int) -> None:
    """At the first call of each function, or of each fifth one."""
    assert status_of(INTERRUPTED.replace("EVERY", str(every))) == 0
