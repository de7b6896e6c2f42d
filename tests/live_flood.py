"""A good sender beside a flood of foreign datagrams, followed by ``magloc live``: ``python -m tests.live_flood``.

Prints, for each kind of foreign datagram, how many rows of the good sender were answered, the time from the send to the
line, the memory of the program and how many datagrams a second the flood sent. All sockets are on 127.0.0.1.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import numpy as np

import arrays
from tests.live_stream import header, memory_MiB, processor_s, rows_of
from tests.passing_source import ARRAY

RATE_HZ = 5.0
KINDS = {
    "text": b"hello",
    "bytes": bytes(range(256)) * 5,
    "cells": b",".join([b"x"] * (1 + ARRAY.n_channels)),
    "lines": b"1\n" * 500,
    "object": b'{"time_s": 1.0, "s1_x_nT": 2.0}',
    "header": b"time_s,s9_x_nT\n1,2",
}
FLOOD = """
import random, socket, sys, time
address, data, rate, ports, end = ("127.0.0.1", int(sys.argv[1])), bytes.fromhex(sys.argv[2]), *map(float, sys.argv[3:])
own = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(int(ports))]
begin, sent = time.monotonic(), 0
while (now := time.monotonic() - begin) < end:
    for _ in range(int(now * rate) - sent):
        random.choice(own).sendto(data, address)
        sent += 1
    time.sleep(0.002)
print(sent)
"""


@dataclass(frozen=True)
class Flooded:
    """Figures of the good sender."""

    sent: int
    answered: int
    latency_s: float  # the longest
    memory_MiB: float  # the largest
    processor: float  # share of one
    foreign_per_s: float
    status: int
    said: str


def flooded(data: bytes, seconds: float, rate_Hz: float, ports: int, seed: int = 0) -> Flooded:
    """Follow a good sender of five rows a second beside a flood from so many ports."""
    with socket(AF_INET, SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    n = int(seconds * RATE_HZ)
    lines = rows_of(ARRAY, n, 2.0, 0.0, np.random.default_rng(seed))
    cells = [line.split(",", 1)[1] for line in lines]
    sent, came, used = np.full(n, np.nan), np.full(n, np.nan), [0.0]
    with tempfile.TemporaryDirectory() as folder:
        arrays.write_array(Path(folder) / "array.toml", ARRAY)
        command = [sys.executable, "-m", "magloc.cli", "live", "--array", f"{folder}/array.toml"]
        command += ["--from", f"udp://127.0.0.1:{port}"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            assert process.stderr is not None
            said = [process.stderr.readline()]  # waiting for rows
            told = threading.Thread(target=lambda: said.extend(process.stderr))  # type: ignore[arg-type]
            told.start()

            def listen() -> None:
                for line in process.stdout:  # type: ignore[union-attr]
                    came[round(json.loads(line)["time_s"] * RATE_HZ)] = time.perf_counter()

            listener = threading.Thread(target=listen)
            listener.start()
            words = [str(port), data.hex(), str(rate_Hz), str(ports), str(seconds + 1.0)]
            foreign = subprocess.Popen([sys.executable, "-c", FLOOD, *words], stdout=subprocess.PIPE, text=True)
            with socket(AF_INET, SOCK_DGRAM) as own:
                time.sleep(1.0)
                begin, spent_s = time.perf_counter(), processor_s(process.pid)
                own.sendto(header(ARRAY).encode(), ("127.0.0.1", port))
                for i in range(n):
                    time.sleep(max(0.0, begin + i / RATE_HZ - time.perf_counter()))
                    sent[i] = time.perf_counter()
                    own.sendto(f"{i / RATE_HZ},{cells[i]}".encode(), ("127.0.0.1", port))
                    used.append(memory_MiB(process.pid))
                share = (processor_s(process.pid) - spent_s) / (time.perf_counter() - begin)
            n_foreign = int(foreign.communicate(timeout=60.0)[0])
            time.sleep(1.0)
            process.terminate()
            status = process.wait(timeout=60.0)
            listener.join()
            told.join()
    latency = float(np.nanmax(came - sent, initial=0.0))
    answered, foreign_per_s = int(np.isfinite(came).sum()), n_foreign / (seconds + 1.0)
    return Flooded(n, answered, latency, max(used), share, foreign_per_s, status, "".join(said))


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=1e4)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--ports", type=int, nargs="*", default=[1, 500])
    given = parser.parse_args()
    for kind in given.kinds:
        for ports in given.ports:
            found = flooded(KINDS[kind], given.seconds, given.rate, ports)
            print(
                f"{kind} from {ports} ports: {found.answered} of {found.sent} rows answered, latest after"
                f" {1e3 * found.latency_s:.0f} ms, {found.memory_MiB:.0f} MiB, {found.processor:.0%} of a processor,"
                f" {found.foreign_per_s:.0f} foreign datagrams a second; {found.said.splitlines()[-2:-1]}",
                flush=True,
            )


if __name__ == "__main__":
    main()
