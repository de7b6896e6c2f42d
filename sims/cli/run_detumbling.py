"""``adcs run detumbling``: B-dot of a satellite that tumbles."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from cyclopts import Parameter

from arrays.io.arguments import Count, Flag, Seed
from arrays.io.errors import InputError
from magloc.cli.framework import QuietOptions, print_result, progress

_LONGEST_S = 50_000.0


def detumbling(
    *,
    rate_deg_s: float = 10.0,
    moment_Am2: Annotated[float, Parameter(name="--moment-Am2")] = 0.2,
    duty: float = 0.8,
    seeds: Annotated[Count, Parameter(name=["--seeds", "--runs"])] = 40,
    seed: Seed = 0,
    duration: float = 5000.0,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Take the rate out of a tumbling satellite of three units by torquers, with B-dot of its magnetometer's readings.

    Printed is how long it takes until the rate stays below 0.5°/s, beside what the mean torque along the orbit says.

    Parameters
    ----------
    rate_deg_s : float
        At the start, about any axis.
    moment_Am2 : float
        Largest moment of each of three torquers.
    duty : float
        Part of each second in which they are on; the magnetometer is read while they are off.
    seeds : int
        Number of runs.
    seed : int
        Of the first run; the next ones follow.
    duration : float
        Seconds.
    json : bool
        Print one JSON object.
    common : QuietOptions
        Common options.
    """
    from sims import experiments

    if not 1.0 <= duration <= _LONGEST_S:
        raise InputError(f"--duration: found {duration:g}, expected 1 to {_LONGEST_S:g}.")
    for name, value, most in (
        ("--rate-deg-s", rate_deg_s, 30.0),
        ("--moment-Am2", moment_Am2, 100.0),
        ("--duty", duty, 1.0),
    ):
        if not 0.0 < value <= most:
            raise InputError(f"{name}: found {value:g}, expected more than 0 and at most {most:g}.")
    with progress(round(duration) + 1, "seconds", quiet=common.quiet) as advanced:
        found = experiments.detumbling(
            range(seed, seed + seeds),
            rate_deg_s=rate_deg_s,
            largest_Am2=moment_Am2,
            duty=duty,
            duration_s=duration,
            advanced=advanced,
        )
    # A slow spin about the axis of the smallest moment has a momentum that is below from the start.
    done = np.isfinite(found.time_s) & (found.theory_s > 0.0)
    ratio = found.time_s[done] / found.theory_s[done]
    numbers = {
        "time_s": float(np.median(found.time_s[done])) if done.any() else None,
        "theory_s": float(np.median(found.theory_s[done])) if done.any() else None,
        "ratio": float(np.median(ratio)) if done.any() else None,
        "within_20_percent": float(np.mean(np.abs(ratio - 1.0) <= 0.2)) if done.any() else None,
        "detumbled_runs": int(np.isfinite(found.time_s).sum()),
        "runs": seeds,
    }
    lines = [f"detumbling: {seeds} runs of {duration:g} s from {rate_deg_s:g}°/s; {moment_Am2:g} A·m², duty {duty:g}"]
    if done.any():
        lines += [
            f"{'below 0.5°/s after, median':34s}{numbers['time_s']:.0f} s",
            f"{'by the mean torque':34s}{numbers['theory_s']:.0f} s",
            f"{'ratio, median':34s}{numbers['ratio']:.3g}, {numbers['within_20_percent']:.0%} within 20 %",
        ]
    lines.append(f"{'runs that are slow in the end':34s}{numbers['detumbled_runs']}")
    print_result(numbers, lines, as_json=json)
