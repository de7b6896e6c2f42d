"""Steps of the simulated satellite and of its multiplicative Kalman filter, against their readable twins."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from adcs import quaternion
from adcs.kalman.mekf import run_filter
from sims.attitude.simulation import AttitudeRuns, advance, simulate
from tests.adcs.attitudes import commanded_torque
from tests.adcs.filter_runs import ANY_START, settings, start_of, tabletsat
from tests.adcs.kalman.readable import run_readable
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved

TITLE = "attitude: one step of one run, 1 thread; the compiled simulation draws its readings besides"
N_RUNS, TWIN_ROWS = 20, 50


def rows(size: Size) -> Iterator[Row]:
    """Many runs at once; the twins take few rows of them."""
    duration_s = float(max(TWIN_ROWS, size.points // 100))
    scenario, chosen = replace(tabletsat(duration_s), conditions=ANY_START), settings("mag+sun+gyro")
    runs = simulate(scenario, range(N_RUNS))
    few = simulate(replace(scenario, duration_s=float(TWIN_ROWS)), range(N_RUNS))
    start, start_of_few = start_of(runs), start_of(few)
    steps, few_steps = N_RUNS * len(runs.time_s), N_RUNS * len(few.time_s)
    timings = interleaved(
        {
            "simulation": Contestant(lambda: simulate(scenario, range(N_RUNS)), 1, steps),
            "simulation's twin": Contestant(lambda: readable_truth(few), 1, few_steps),
            "filter": Contestant(lambda: run_filter(runs, chosen, start), 1, steps),
            "filter's twin": Contestant(lambda: run_readable(few, chosen, start_of_few), 1, few_steps),
        },
        size.rounds,
    )
    for name in ("simulation", "filter"):
        ours = timings[name]
        yield Row(
            f"{name}, {N_RUNS} runs", ours, "NumPy twin", timings[f"{name}'s twin"], f"{1e-3 / ours.best:,.0f} k/s"
        )


def readable_truth(runs: AttitudeRuns) -> None:
    """Truth of the runs, step by step."""
    prepared, satellite = runs.prepared, runs.satellite
    state = (prepared.q, prepared.w, prepared.momentum_Nms)
    for row in range(len(runs.time_s) - 1):
        rate = prepared.environment.orbital_rate_rad_s[:, row]
        torque = commanded_torque(satellite.body, satellite.control, *state, quaternion.IDENTITY, rate, runs.dt_s)
        state = advance(prepared, state, torque, row)
