"""How much of the machine's arithmetic the compiled filters of the convergence map use."""

from __future__ import annotations

from collections.abc import Iterator

import numba
import numpy as np
from numba import prange

from arrays.geometries import tetrahedron
from magloc.compilation import compiled, compiled_parallel
from magloc.convergence.filters import DampedFilter, IekfFilter, RepeatedFilter
from magloc.convergence.over_starts import StartsScenario, simulated_measurement
from tests.bench.maps import starts_of
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved

TITLE = "machine: an iteration of the map's filters, against its arithmetic at the measured multiply-add peak"
# Floating-point operations of one iteration for four vector sensors: an estimate by counting, the same for all filters.
FLOPS = 1500
LANES = 64
REPEATS = 20_000
FLOPS_PER_THREAD = 2 * 8 * LANES * REPEATS


def rows(size: Size) -> Iterator[Row]:
    """The peer is the time that the operations would take as fused multiply-adds alone: a ratio of 1 is ideal."""
    scenario = StartsScenario(array=tetrahedron(1.5, noise_T=1e-9))
    _, measurement, z = simulated_measurement(scenario)
    starts = starts_of(scenario, size.grid)
    methods = {method.name: method for method in (IekfFilter(), RepeatedFilter(), DampedFilter())}
    all_threads = numba.get_num_threads()
    powers = {2**i for i in range(all_threads.bit_length())}
    for threads in sorted(powers | {all_threads}):
        iterations = threads * FLOPS_PER_THREAD / FLOPS
        contestants = {"peak": Contestant(lambda n=threads: multiply_add_chains(n, REPEATS), threads, iterations)}
        for name, method in methods.items():
            count = int(method.run(measurement, z, starts).iterations.sum())
            contestants[name] = Contestant(lambda m=method: m.run(measurement, z, starts), threads, count)
        timings = interleaved(contestants, size.rounds)
        peak = 1e-9 * FLOPS / timings["peak"].best
        for name in methods:
            ours = 1e-9 * FLOPS / timings[name].best
            yield Row(
                f"{name}, an iteration, {threads} thr.",
                timings[name],
                "peak",
                timings["peak"],
                f"{ours:.0f} of {peak:.0f} GFLOP/s, {FLOPS:,} an iteration being an estimate"
                + ("; above the peak: disturbed, or the estimate is high" if ours > peak else ""),
            )


@compiled_parallel
def multiply_add_chains(threads: int, repeats: int) -> float:
    """Run one set of chains on every thread."""
    total = 0.0
    for i in prange(threads):
        total += _chains(1.0 + 1e-3 * i, repeats)
    return total


@compiled
def _chains(first: float, repeats: int) -> float:
    """64 independent chains of fused multiply-adds: as many as fill the vector units of any processor so far."""
    x = np.empty(LANES)
    for i in range(LANES):
        x[i] = first + 1e-6 * i
    a, b = 0.999999, 1e-6
    for _ in range(repeats):
        for i in range(LANES):
            y = x[i]
            y = (((y * a + b) * a + b) * a + b) * a + b
            x[i] = (((y * a + b) * a + b) * a + b) * a + b
    return x.sum()
