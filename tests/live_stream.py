"""Rows of thirty sensors sent to ``magloc live`` by a socket, or of a tetrahedron on its standard input.

``python -m tests.live_stream --seconds 600`` sends 200 rows a second, or ``--rate-hz`` others, and prints the time from
the send to the line, the processor time of a row, and the memory from minute to minute; ``--lost 0.1 --garbled 0.01``
damages the stream, and ``--stdin 1000000`` counts rows a second. ``--rest-s`` is passed on.
"""

from __future__ import annotations

import argparse
import json
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

import arrays
from arrays.array import SensorArray
from arrays.typing import FloatArray
from magloc.measurement.differences import predicted_channels
from tests.moving_magnets import board

TOO_FAR_M = 0.01


def header(array: SensorArray) -> str:
    """The columns of a row."""
    return ",".join(["time_s", *(f"{name}_nT" for name in array.channel_names)]) + "\n"


def rows_of(
    array: SensorArray, n: int, scale_m: float, rest_s: float, rng: np.random.Generator, rate_Hz: float = 200.0
) -> list[str]:
    """Lines of a source that circles, and of a rest before it."""
    time_s = np.arange(n) / rate_Hz
    place, moment = path(time_s, scale_m), np.tile([0.01, 0.03, 0.05], (n, 1)) * (scale_m / 0.05) ** 3
    values = predicted_channels(array, place, moment) * (time_s >= rest_s)[:, None]
    values += array.channel_noise_T * rng.normal(size=values.shape)
    return [f"{t:.3f}," + ",".join(f"{v:.1f}" for v in row) + "\n" for t, row in zip(time_s, 1e9 * values, strict=True)]


def path(time_s: FloatArray, scale_m: float) -> FloatArray:
    """Where the source is."""
    ways = 0.6 * np.sin(0.7 * time_s), 0.4 * np.cos(0.5 * time_s), 1.0 + 0.2 * np.sin(0.3 * time_s)
    return scale_m * np.stack(ways, axis=-1)


def memory_MiB(pid: int) -> float:
    """Resident memory of a process (Linux)."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def processor_s(pid: int) -> float:
    """Processor time of a process so far (Linux)."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def by_socket(given: argparse.Namespace, array: SensorArray, folder: Path) -> None:
    """As many rows a second as are wanted."""
    rng, rate_Hz = np.random.default_rng(given.seed), given.rate_hz
    n = int(given.seconds * rate_Hz)
    lines = rows_of(array, n, 0.05, given.rest_s, rng, rate_Hz)
    lost, garbled = (rng.random(n) < share for share in (given.lost, given.garbled))
    lost[:50] = garbled[:50] = False
    server = socket.create_server(("127.0.0.1", 0))
    options = ["--speed-m-s", "0.1", "--turn-deg-s", "20"]
    options += ["--rest-s", str(given.rest_s)] if given.rest_s else []
    command = [sys.executable, "-m", "magloc.cli", "live", "--array"]
    command += [str(folder / "array.toml"), "--from", f"tcp://127.0.0.1:{server.getsockname()[1]}", *options]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    peer, _ = server.accept()
    sent = np.full(n, np.nan)
    used: list[tuple[float, float]] = []

    def send() -> None:
        peer.sendall(header(array).encode())
        begin = time.perf_counter()
        for i, line in enumerate(lines):
            time.sleep(max(0.0, begin + i / rate_Hz - time.perf_counter()))
            if lost[i]:
                continue
            at = int(rng.integers(len(line) - 1))
            shown = line[:at] + "x;\0"[i % 3] + line[at + 1 :] if garbled[i] else line
            sent[i] = time.perf_counter()
            peer.sendall(shown.encode())
            if i % int(30 * rate_Hz) == int(10 * rate_Hz):
                used.append((memory_MiB(process.pid), processor_s(process.pid)))
        used.append((memory_MiB(process.pid), processor_s(process.pid)))
        peer.close()

    sender = threading.Thread(target=send)
    sender.start()
    latency, far, tracked, acquired = [], 0, 0, 0
    assert process.stdout is not None
    for line in process.stdout:
        arrived, entry = time.perf_counter(), json.loads(line)
        latency.append(arrived - sent[round(entry["time_s"] * rate_Hz)])
        acquired += entry["status"] == "acquired"
        if entry["position_m"] is not None and entry["time_s"] >= given.rest_s:
            tracked += 1
            off_m = np.linalg.norm(entry["position_m"] - path(np.array(entry["time_s"]), 0.05))
            far += bool(off_m > TOO_FAR_M)
    sender.join()
    median, most, longest = 1e3 * np.nanquantile(latency[200:], [0.5, 0.999, 1.0])
    took_ms = 1e3 * (used[-1][1] - used[0][1]) / (n - 10 * rate_Hz)
    print(
        f"{n} rows, {int(lost.sum())} lost, {int(garbled.sum())} garbled: {len(latency)} answered, {tracked} tracked,"
        f" {acquired} tracks begun, {far} more than {1e3 * TOO_FAR_M:.0f} mm off; from the send to the line median"
        f" {median:.2f} ms, 99.9 % within {most:.1f} ms, longest {longest:.0f} ms; {took_ms:.2f} ms of processor a row;"
        f" memory {', '.join(f'{m:.0f}' for m, _ in used)} MiB; exit {process.wait()}"
    )


def by_pipe(given: argparse.Namespace, array: SensorArray, folder: Path) -> None:
    """As many rows as it takes."""
    n, part = given.stdin, 20_000
    options = ["--speed-m-s", "10", "--turn-deg-s", "20"]
    command = [sys.executable, "-m", "magloc.cli", "live", "--array"]
    command += [str(folder / "array.toml"), *options]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True)
    assert process.stdin is not None
    lines = rows_of(array, part, 5.0, 0.0, np.random.default_rng(given.seed))
    cut = [line.split(",", 1)[1] for line in lines]
    # There and back again, so that no place jumps.
    cut += cut[::-1]
    process.stdin.write(header(array))
    used, begin = [], time.perf_counter()
    for i in range(n):
        process.stdin.write(f"{i / given.rate_hz:.3f},{cut[i % len(cut)]}")
        if i % (n // 10) == n // 20:
            used.append(memory_MiB(process.pid))
    spent = processor_s(process.pid)
    process.stdin.close()
    status = process.wait()
    took = time.perf_counter() - begin
    print(
        f"{n} rows in {took:.0f} s: {n / took:.0f} a second, {n / spent:.0f} a second of processor time; memory"
        f" {', '.join(f'{m:.0f}' for m in used)} MiB; exit {status}"
    )


def main() -> None:
    """Send rows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate-hz", type=float, default=200.0)
    parser.add_argument("--lost", type=float, default=0.0)
    parser.add_argument("--garbled", type=float, default=0.0)
    parser.add_argument("--rest-s", type=float, default=0.0)
    parser.add_argument("--stdin", type=int)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    array = board() if given.stdin is None else arrays.tetrahedron(1.5, noise_T=1e-9)
    with tempfile.TemporaryDirectory() as folder:
        arrays.write_array(Path(folder) / "array.toml", array)
        (by_socket if given.stdin is None else by_pipe)(given, array, Path(folder))


if __name__ == "__main__":
    main()
