"""``adcs run detumbling``: a tumbling satellite with torquers or hysteresis rods."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from cyclopts import Parameter

from magloc.cli.framework import ABOVE_ZERO, Flag, QuietOptions, Seed, print_result, progress, refuse_outside
from sims.cli.run_tabletsat import Runs

_LONGEST_S, _MOST_S = 200_000.0, 2_000_000.0
_STRONGEST_AM2 = 10.0


def detumbling(
    *,
    damping: Literal["readings", "estimate", "rods"] = "readings",
    rate_deg_s: float = 10.0,
    moment_Am2: Annotated[float, Parameter(name="--moment-Am2")] = 0.2,
    duty: float = 0.8,
    magnet_Am2: Annotated[float, Parameter(name="--magnet-Am2")] = 0.0,
    seeds: Runs = 40,
    seed: Seed = 0,
    duration: float = 5000.0,
    json: Flag = False,
    common: QuietOptions = QuietOptions(),  # noqa: B008 - frozen
) -> None:
    """Stop the tumbling of a satellite of three units, by torquers with B-dot or by hysteresis rods.

    Prints the time until the rate stays below 0.5°/s, the time that the mean torque along the orbit predicts, the rate
    at the end, and the angle between the axis of a magnet and the field.

    Parameters
    ----------
    damping : str
        Torquers controlled by the "readings" of the magnetometer, or by the "estimate" of a filter of magnetometer, Sun
        sensor and gyro; or hysteresis "rods" along x and y, 1 cm³ each.
    rate_deg_s : float
        Rate at the start, about a random axis [°/s].
    moment_Am2 : float
        Largest moment of each of three torquers [A·m²].
    duty : float
        Fraction of each second in which the torquers are on; the magnetometer is read while they are off.
    magnet_Am2 : float
        Moment of a magnet along the axis z [A·m²], which aligns with the field.
    seeds : int
        Number of runs.
    seed : int
        Seed of the first run; the next runs take the next seeds.
    duration : float
        Duration of a run [s].
    json : bool
        Print one JSON object, instead of the text.
    common : QuietOptions
        Common options.
    """
    from sims import experiments

    longest_s = min(_LONGEST_S, _MOST_S / seeds)
    refuse_outside(1.0, longest_s, f"1 to {longest_s:g} of {seeds} runs", duration=duration)
    refuse_outside(ABOVE_ZERO, 30.0, "more than 0 and at most 30", rate_deg_s=rate_deg_s)
    refuse_outside(ABOVE_ZERO, 100.0, "more than 0 and at most 100", moment_Am2=moment_Am2)
    refuse_outside(ABOVE_ZERO, 1.0, "more than 0 and at most 1", duty=duty)
    refuse_outside(0.0, _STRONGEST_AM2, f"0 to {_STRONGEST_AM2:g}", magnet_Am2=magnet_Am2)
    with progress(round(duration) + 1, "seconds") as advanced:
        found = experiments.detumbling(
            range(seed, seed + seeds),
            damping=damping,
            rate_deg_s=rate_deg_s,
            largest_Am2=moment_Am2,
            duty=duty,
            magnet_Am2=magnet_Am2,
            duration_s=duration,
            advanced=advanced,
        )
    # A slow spin about the axis of the smallest moment of inertia is below the limit from the start.
    compared = np.isfinite(found.time_s) & (found.theory_s > 0.0)
    ratio = found.time_s[compared] / found.theory_s[compared]
    done = compared if compared.any() else np.isfinite(found.time_s)
    numbers = {
        "time_s": float(np.median(found.time_s[done])) if done.any() else None,
        "theory_s": float(np.median(found.theory_s[compared])) if compared.any() else None,
        "ratio": float(np.median(ratio)) if compared.any() else None,
        "within_20_percent": float(np.mean(np.abs(ratio - 1.0) <= 0.2)) if compared.any() else None,
        "detumbled_runs": int(np.isfinite(found.time_s).sum()),
        "runs": seeds,
        "last_rate_deg_s": float(np.median(found.last_rate_deg_s)),
        "last_off_field_deg": float(np.median(found.last_off_field_deg)) if magnet_Am2 else None,
    }
    by = "rods" if damping == "rods" else f"{moment_Am2:g} A·m² by {damping}, duty {duty:g}"
    lines = [f"detumbling: {seeds} runs of {duration:g} s from {rate_deg_s:g}°/s; {by}"]
    if done.any():
        lines.append(f"{'below 0.5°/s after, median':34s}{numbers['time_s']:.0f} s")
    if compared.any():
        lines += [
            f"{'by the mean torque':34s}{numbers['theory_s']:.0f} s",
            f"{'ratio, median':34s}{numbers['ratio']:.3g}, {numbers['within_20_percent']:.0%} within 20 %",
        ]
    lines.append(f"{'runs that are slow in the end':34s}{numbers['detumbled_runs']}")
    lines.append(f"{'rate of the last ten minutes':34s}{numbers['last_rate_deg_s']:.2g}°/s")
    if magnet_Am2:
        lines.append(f"{'magnet off the field, last orbit':34s}{numbers['last_off_field_deg']:.2g}°")
    print_result(numbers, lines, as_json=json)
